"""The driver: clock, budget, cancel and gate are the same for every estimator. All parts are fakes."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import service.loaded_scene
import service.localize
import service.searched_scene
from service.errors import BackendMissing, EstimatorFault
from service.geometry import moved
from service.interfaces import Features, Frame, Rasterizer, SceneGradients
from service.loaded_scene import LoadedScene
from service.localize import Cancelled, Request, localize
from service.results import IterationRecord, Reason, Status
from service.types import Camera, GaussianScene, Intrinsics, IntrinsicsCorrection, Pose, Query, SceneInfo

LENS = Intrinsics(64, 64, 60.0, 60.0, 32.0, 32.0)
QUERY = Query(np.zeros((64, 64, 3), np.uint8), LENS, "guessed", LENS.resized(128, 128), warnings=("from the photo",))
POSES = [moved(Pose(np.eye(4)), np.array([0, 0, 0, 0.1 * i, 0, 0])) for i in range(20)]


class Nothing(Rasterizer):
    """A rasterizer of an empty scene and a matcher without matches."""

    name = "nothing"

    def over(self, background_rgb: tuple[float, float, float]) -> Nothing:
        return self

    def trained_at(self, long_side_px: int) -> Nothing:
        self.assumed_px = long_side_px
        return self

    def render(self, cameras: Sequence[Camera], **options: object) -> list[Frame]:
        shape = (cameras[0].intrinsics.height, cameras[0].intrinsics.width)
        zero = np.zeros(shape, np.float32)
        return [Frame(np.zeros((*shape, 3), np.float32), zero, zero, zero) for _ in cameras]

    def pose_gradient(self, *args: object) -> np.ndarray:
        raise NotImplementedError

    def scene_gradients(self, *args: object) -> SceneGradients:
        raise NotImplementedError

    def extract(self, rgb: np.ndarray, limit: int) -> Features:
        return Features(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros((0, 8), np.float32))

    def match(self, a: Features, b: Features) -> np.ndarray:
        return np.zeros((0, 2), np.int32)


class Script:
    """An estimator that yields a pose a step and notes what is done to it."""

    def __init__(self, steps: int = 5, pause_s: float = 0.0, fail_at: int | None = None) -> None:
        self.steps, self.pause_s, self.fail_at = steps, pause_s, fail_at
        self.closed_in: threading.Thread | None = None
        self.made = 0
        self.prepared: list[Any] = []

    Options = SimpleNamespace

    def prepare(self, tools: Any, cache_dir: Any) -> str:
        self.prepared.append(cache_dir)
        return "prepared"

    def run(self, query: Query, tools: Any, options: Any) -> Iterator[IterationRecord]:
        assert tools.prepared == "prepared"
        self.drawn = float(tools.rng.random())
        try:
            for i in range(self.steps):
                time.sleep(self.pause_s)
                if i == self.fail_at:
                    raise RuntimeError("a bug")
                self.made = i + 1
                yield IterationRecord(f"stage_{i // 2}", POSES[i])
        finally:
            self.closed_in = threading.current_thread()


@pytest.fixture
def loaded() -> LoadedScene:
    one = np.ones((1, 3), np.float32)
    quats = np.array([[1, 0, 0, 0]], np.float32)
    info = SceneInfo("s", "scene", "f" * 64, "ply", training_long_side_px=640, warnings=("from the scene",))
    scene = GaussianScene(one, quats, one, np.ones(1, np.float32), np.zeros((1, 1, 3), np.float32), info)
    return LoadedScene(scene, Nothing(), Nothing())


def use(monkeypatch: pytest.MonkeyPatch, script: Script) -> Script:
    for module in (service.localize, service.loaded_scene):
        monkeypatch.setattr(module, "ESTIMATORS", SimpleNamespace(load=lambda name: script))
    return script


def test_stamps_the_records_and_answers_with_the_last(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    use(monkeypatch, Script(5, pause_s=0.01))
    seen: list[IterationRecord] = []
    found = localize(QUERY, loaded, Request("script", seed=3), seen.append)
    assert [record.index for record in found.records] == [0, 1, 2, 3, 4]
    elapsed = [record.elapsed_s for record in found.records]
    assert all(b - a >= 0.01 for a, b in zip([0.0, *elapsed], elapsed, strict=False))
    assert tuple(seen) == found.records
    assert found.pose is POSES[4]
    assert not found.budget_exhausted
    assert found.verdict.status is Status.NOT_LOCALIZED
    assert found.verdict.reason is Reason.FEW_FEATURES
    assert (found.estimator, found.rasterizer, found.matcher, found.seed) == ("script", "nothing", "nothing", 3)
    assert found.intrinsics == QUERY.photo_intrinsics
    assert found.intrinsics_source == "guessed"
    assert found.warnings == ("from the photo", "from the scene")
    assert found.scene_sha256 == "f" * 64


@pytest.mark.parametrize(("photo_px", "assumed_px"), [(300, 800), (1200, 1200), (4000, 1600)])
def test_where_the_size_of_training_is_unknown_the_photos_is_assumed_and_told(
    monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene, photo_px: int, assumed_px: int
) -> None:
    use(monkeypatch, Script())
    info = replace(loaded.scene.info, training_long_side_px=None)
    nothing = Nothing()
    bare = LoadedScene(replace(loaded.scene, info=info), nothing, nothing)
    found = localize(replace(QUERY, photo_intrinsics=LENS.resized(photo_px, photo_px // 2)), bare)
    assert nothing.assumed_px == assumed_px
    assert f"{assumed_px} px is assumed" in found.warnings[-1]
    # Also a scene that was uploaded as a bare file can follow it.
    assert "scene.json beside the scene file, both in one folder or ZIP" in found.warnings[-1]


def test_the_lens_of_the_last_record_is_the_answers(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    """The photo's own intrinsics are corrected, in its own size."""

    class Zoomed(Script):
        def run(self, query, tools, options):
            for record in super().run(query, tools, options):
                yield replace(record, correction=IntrinsicsCorrection(1.25, 0.01, -0.02))

    use(monkeypatch, Zoomed(2))
    found, photo = localize(QUERY, loaded).intrinsics, QUERY.photo_intrinsics
    assert (found.fx, found.fy) == (1.25 * photo.fx, 1.25 * photo.fy)
    assert found.cx - photo.cx == pytest.approx(0.01 * photo.long_side)
    assert found.cy - photo.cy == pytest.approx(-0.02 * photo.long_side)


def test_times_add_up_by_stage(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    use(monkeypatch, Script(5, pause_s=0.01))
    found = localize(QUERY, loaded)
    stages = {timing.stage: timing for timing in found.timings}
    assert list(stages) == ["stage_0", "stage_1", "stage_2", "verify"]
    assert stages["stage_0"].wall_s >= 0.02
    assert stages["stage_0"].cpu_s < 0.02  # sleeping costs no CPU
    total = sum(timing.wall_s for timing in found.timings)
    assert total >= found.records[-1].elapsed_s


def test_the_budget_ends_the_search_with_the_best_so_far(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    script = use(monkeypatch, Script(20, pause_s=0.02))
    found = localize(QUERY, loaded, Request(budget_s=0.05))
    assert found.budget_exhausted
    assert found.verdict.reason is Reason.BUDGET_EXHAUSTED
    assert 1 <= len(found.records) == script.made < 20
    assert found.pose is POSES[script.made - 1]
    assert script.closed_in is threading.current_thread()


def test_one_record_is_made_even_without_a_budget(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    use(monkeypatch, Script())
    assert len(localize(QUERY, loaded, Request(budget_s=0.0)).records) == 1


def test_cancel_closes_the_estimator_in_the_worker_thread(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    script = use(monkeypatch, Script(20, pause_s=0.01))
    cancel, outcome = threading.Event(), []

    def work() -> None:
        try:
            localize(QUERY, loaded, Request(cancel=cancel), lambda record: cancel.set())
        except Cancelled:
            outcome.append("cancelled")

    worker = threading.Thread(target=work)
    worker.start()
    worker.join(20)
    assert outcome == ["cancelled"]
    assert script.made == 2  # cancelled while the second was made; it isn't passed on
    assert script.closed_in is worker


def test_the_estimator_is_closed_when_the_listener_fails(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    script = use(monkeypatch, Script())

    def fail(record: IterationRecord) -> None:
        raise ValueError("the listener's own")

    with pytest.raises(ValueError, match="listener"):
        localize(QUERY, loaded, on_record=fail)
    assert script.closed_in is not None
    assert script.made == 1


def test_an_estimators_bug_is_not_hidden(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    script = use(monkeypatch, Script(5, fail_at=2))
    with pytest.raises(RuntimeError, match="a bug"):
        localize(QUERY, loaded)
    assert script.closed_in is not None


def test_an_estimator_without_a_record_is_at_fault(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    use(monkeypatch, Script(0))
    with pytest.raises(EstimatorFault, match="without a record"):
        localize(QUERY, loaded)


def test_the_seed_is_the_only_randomness(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    script = use(monkeypatch, Script())
    drawn = []
    for seed in (0, 0, 1):
        localize(QUERY, loaded, Request(seed=seed))
        drawn.append(script.drawn)
    assert drawn[0] == drawn[1] != drawn[2]


def test_a_scene_is_prepared_once_for_all_jobs(monkeypatch: pytest.MonkeyPatch, loaded: LoadedScene) -> None:
    script = use(monkeypatch, Script())
    workers = [threading.Thread(target=localize, args=(QUERY, loaded)) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(20)
    assert script.prepared == [None]


class Gpu:
    """A rasterizer plug-in beside the CPU's; `full`: its memory."""

    def __init__(self, reason: str | None = None, full: bool = False) -> None:
        self.reason, self.full = reason, full

    def missing(self, name: str) -> str | None:
        return self.reason if name == "gsplat_cuda" else None

    def load(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(create=lambda scene: self._create(name))

    def _create(self, name: str) -> Nothing:
        if name == "gsplat_cuda" and self.full:
            raise BackendMissing("the GPU has no memory left.")
        made = Nothing()
        made.name = name
        return made


def choose_from(monkeypatch: pytest.MonkeyPatch, rasterizers: Gpu) -> None:
    for module in (service.loaded_scene, service.searched_scene):
        monkeypatch.setattr(module, "RASTERIZERS", rasterizers)


@pytest.mark.parametrize(
    ("gpu", "named", "expected", "skipped_rasterizers", "warned"),
    [
        (Gpu(), None, "gsplat_cuda", "", False),
        (Gpu(), "cpu", "cpu", "", False),
        (Gpu("no driver"), None, "cpu", "gsplat_cuda: no driver", False),
        (Gpu(full=True), None, "cpu", "the GPU has no memory left.", True),
    ],
)
def test_the_gpu_is_used_where_it_can_be(monkeypatch, loaded, gpu, named, expected, skipped_rasterizers, warned):
    choose_from(monkeypatch, gpu)
    use(monkeypatch, Script(1))
    bound = LoadedScene.of(loaded.scene, rasterizer=named)
    assert (bound.rasterizer.name, bound.skipped_rasterizers) == (expected, skipped_rasterizers)
    found = localize(QUERY, bound, Request("script"))
    assert found.rasterizer == expected
    assert any("GPU" in warning for warning in found.warnings) == warned


def test_a_gpu_that_was_asked_for_is_no_other(monkeypatch, loaded):
    choose_from(monkeypatch, Gpu(full=True))
    with pytest.raises(BackendMissing, match="no memory"):
        LoadedScene.of(loaded.scene, rasterizer="gsplat_cuda")
