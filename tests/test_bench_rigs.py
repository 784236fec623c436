"""Benches of rigs, coverage maps, fleets and digests: what they ask, and the figures that they make of the answers."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_bench import LENS, estimate, poses

from service.bench import coverage, fleet_simulation, rigs, scale
from service.bench import localize as bench
from service.bench.bench_photos import BenchPhoto, SentPhoto
from service.bench.pose_metrics import Units
from service.coverage.coverage_map import FOUND_AT
from service.errors import SceneNotFound, UnknownName
from service.geometry import moved, pose_distance
from service.results import Status
from service.types import Camera, Pose

UNITS = Units(np.zeros(3), 0.5, False)


def turned(pose: Pose, degrees: float, units: float = 0.0) -> Pose:
    return moved(pose, np.array([0, 0, np.radians(degrees), 2 * units, 0, 0]))


# ------------------------------------------------------------------ rigs


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A scene of six photos, of which all but the last one fail alone; a rig is found a little beside the truth."""
    seen = SimpleNamespace(sent=[], rigs=[], prepared=[], now=0.0, off=[(0.5, 0.0)], odd=(0.0, 0.0))
    found = []
    for k, pose in enumerate(poses()[:6]):
        Image.fromarray(np.full((48, 64, 3), 40 * k, np.uint8)).save(tmp_path / f"{k}.png")
        found.append(BenchPhoto(f"{k}.png", tmp_path / f"{k}.png", Camera(LENS, pose)))
    scene = SimpleNamespace(info=SimpleNamespace(name="room", background_rgb=(0.1, 0.2, 0.3)), cameras=[])
    loaded = SimpleNamespace(scene=scene, rasterizer=None, prepare=seen.prepared.append)

    def prepare_photo(photo: BenchPhoto, modify: Any, background: Any, seed: int, occluders: Any) -> SentPhoto:
        assert background == (0.1, 0.2, 0.3)
        (kind,) = modify
        seen.sent.append((photo.name, kind, seed))
        seen.occluders = [float(picture.mean()) for picture in occluders]
        return SentPhoto(photo.path.read_bytes(), LENS, photo.camera)

    def localize(query: Any, loaded: Any, request: Any) -> Any:
        number = int(query.rgb[0, 0, 0]) // 40
        alone = number == 5 or (number == 4 and seen.sent[-1][1] == "occlusion=0.65")
        pose = turned(poses()[5], *seen.odd) if number == 5 else poses()[number]
        return estimate(pose, Status.LOCALIZED if alone else Status.UNCERTAIN)

    def localize_rig(photos: Any, loaded: Any) -> Any:
        seen.now += 2.0 + len(seen.rigs)
        seen.rigs.append(photos)
        degrees, units = seen.off[(len(seen.rigs) - 1) // 2 % len(seen.off)]
        truth = poses()[int(photos[0].query.rgb[0, 0, 0]) // 40]
        status = Status.LOCALIZED if len(seen.rigs) % 2 else Status.UNCERTAIN  # the control is not found
        pose = turned(truth, degrees, units)
        return SimpleNamespace(world_from_rig=pose, estimate=estimate(pose, status))

    monkeypatch.setattr(rigs, "load_scene", lambda folder: scene)
    monkeypatch.setattr(rigs.LoadedScene, "of", lambda scene, cache_dir: loaded)
    monkeypatch.setattr(rigs, "units_of", lambda cameras, depth_of: UNITS)
    monkeypatch.setattr(rigs, "find_photos", lambda folder: found if folder == Path("room") else found[1:3])
    monkeypatch.setattr(rigs, "prepare_photo", prepare_photo)
    monkeypatch.setattr(rigs, "localize", localize)
    monkeypatch.setattr(rigs, "localize_rig", localize_rig)
    monkeypatch.setattr(rigs, "time", SimpleNamespace(perf_counter=lambda: seen.now))
    return seen


def test_rigs_are_drawn_among_photos_of_one_kind_that_fail_alone(asked: SimpleNamespace) -> None:
    shown: list[tuple[int, int]] = []
    found = rigs.run(Path("room"), Path("other"), rigs=8, photos=4, seed=3, progress=lambda *now: shown.append(now))
    assert (found["alone_tried"], found["alone_failed"], found["alone_wrong_localized"]) == (48, 2 * (3 * 5 + 4), 0)
    assert shown == [(k + 1, 8) for k in range(8)]
    assert asked.prepared == ["view_index"]
    # Each way of modifying each photo is drawn anew, by the seed alone.
    seeds = [(name, seed) for name, _, seed in asked.sent]
    assert len({seed for _, seed in seeds}) == 12
    assert max(seed for _, seed in seeds) > 2**28
    assert asked.occluders == pytest.approx([40 / 255, 80 / 255])
    # Kinds in turn; the control has the same photos, with each one's place taken by the next one's.
    kinds = [query["kind"] for query in found["per_query"]]
    assert kinds == [*rigs.MODIFICATIONS] * 2
    assert set(found["by_kind"]) == set(rigs.MODIFICATIONS)
    assert [found["by_kind"][kind]["queries"] for kind in rigs.MODIFICATIONS] == [2] * 4
    for query, right, wrong in zip(found["per_query"], asked.rigs[::2], asked.rigs[1::2], strict=True):
        names = query["photos"]
        assert len(set(names)) == 4
        assert set(names) <= {f"{k}.png" for k in range(4 if query["kind"] == "occlusion=0.65" else 5)}
        assert [photo.name for photo in right] == [photo.name for photo in wrong] == names
        true = [poses()[int(name[0])] for name in names]
        for photos, order in ((right, [0, 1, 2, 3]), (wrong, [1, 2, 3, 0])):
            for photo, mount in zip(photos, order, strict=True):
                placed = Pose(true[0].world_from_camera @ photo.rig_from_camera.world_from_camera)
                assert pose_distance(placed, true[mount]) == pytest.approx((0, 0), abs=1e-5)
                assert photo.query.intrinsics.trust == "exact"
    again = rigs.run(Path("room"), Path("other"), rigs=2, photos=4, seed=3)
    assert [query["photos"] for query in again["per_query"]] == [q["photos"] for q in found["per_query"][:2]]


def test_a_rigs_figures_are_those_of_planted_errors(asked: SimpleNamespace) -> None:
    # Degrees and normalized units; the bounds are 1 and 0.01, 5 and 0.05.
    asked.off = [(0.9, 0.0), (1.1, 0.0), (0.0, 0.009), (0.0, 0.011), (4.9, 0.049), (5.1, 0.0), (0.0, 0.051), (0.0, 0.0)]
    asked.odd = (5.2, 0.0)
    found = rigs.run(Path("room"), Path("other"), rigs=8, photos=3, variants=1)
    assert found["alone_wrong_localized"] == 4
    assert (found["queries"], found["wrong_and_localized"]) == (8, 2)
    assert found["right_and_localized"] == 6 / 8
    assert found["fine_and_localized"] == 3 / 8
    assert (found["wrong_order_queries"], found["wrong_order_right_and_localized"]) == (8, 0)
    assert found["wrong_order_wrong_and_localized"] == 0
    # The rigs take 2, 4, 6 ... 16 s, the controls a second more.
    assert found["wall_s_p50"] == pytest.approx(9.0)
    assert found["wrong_order_wall_s_p50"] == pytest.approx(10.0)
    first = found["per_query"][0]
    assert first["error_deg"] == pytest.approx(0.9)
    assert found["per_query"][2]["error_units"] == pytest.approx(0.009)


def test_a_rig_needs_enough_photos_that_fail(asked: SimpleNamespace) -> None:
    found = rigs.run(Path("room"), Path("other"), rigs=4, photos=5)
    assert set(found["by_kind"]) == set(rigs.MODIFICATIONS) - {"occlusion=0.65"}
    with pytest.raises(SceneNotFound, match="fewer than 6 photos"):
        rigs.run(Path("room"), Path("other"), photos=6)
    asked.sent.clear()
    with pytest.raises(UnknownName):
        rigs.run(Path("room"), Path("other"), modify=("upside_up",))
    assert asked.sent == []  # told before anything is localized


# ------------------------------------------------------------------ coverage maps


def test_maps_are_measured_scene_by_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[Any] = []

    def measured_coverage(loaded: Any, how: Any) -> str:
        how.progress(1, 2)
        how.progress(2, 2)
        return f"{how.photos} of {loaded.name}"

    def load(folder: Path, cache_dir: Path | None) -> Any:
        return SimpleNamespace(name=folder.name, prepare=lambda name: done.append((folder.name, name)))

    monkeypatch.setattr(coverage.LoadedScene, "load", load)
    monkeypatch.setattr(coverage, "Measurement", lambda photos, report: SimpleNamespace(photos=photos, progress=report))
    monkeypatch.setattr(coverage, "held_out_photos", lambda folder: "photos")
    monkeypatch.setattr(coverage, "measured_coverage", measured_coverage)
    photos = [
        {"photo": "a", "predicted": FOUND_AT, "uncalibrated": 1.0, "found": True},
        {"photo": "b", "predicted": 0.2, "uncalibrated": 0.5, "found": False},
    ]
    monkeypatch.setattr(coverage, "scene_row", lambda name, found: {"scene": name, "map": found, "photos": photos})
    found = coverage.run([Path("x/one"), Path("x/two")], lambda *now: done.append(now))
    assert [row["map"] for row in found["scenes"]] == ["photos of one", "photos of two"]
    assert done == [
        ("one", "view_index"), ("one", 1, 2), ("one", 2, 2), ("two", "view_index"), ("two", 1, 2), ("two", 2, 2),
    ]  # fmt: skip
    assert coverage.run([Path("one")])["all"]["count"] == 2
    # Two of each; a photo at the bound itself is shown as sure.
    assert (found["all"]["count"], found["all"]["found"], found["all"]["sure"]) == (4, 2, 2)
    assert found["all"]["sure_found"] == 2
    # Mean squares of 0.1 and 0.2, of 0 and 0.5.
    assert found["all"]["brier"] == pytest.approx((0.01 + 0.04) / 2)
    assert found["all"]["brier_uncalibrated"] == pytest.approx(0.125)
    assert coverage.figures([])["brier"] is None


# ------------------------------------------------------------------ a fleet, a digest, a warm-up


def test_each_fleet_is_told_before_it_is_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[Any] = []

    class Simulation:
        def __init__(self, model: Any) -> None:
            self.model = model

        def run(self) -> str:
            done.append(("run", self.model))
            return f"figures of {self.model}"

    monkeypatch.setattr(fleet_simulation, "FLEETS", ("small", "large"))
    monkeypatch.setattr(fleet_simulation, "FleetSimulation", Simulation)
    rows = fleet_simulation.run(lambda model: done.append(("told", model)))
    assert rows == [("small", "figures of small"), ("large", "figures of large")]
    assert done == [("told", "small"), ("run", "small"), ("told", "large"), ("run", "large")]
    assert fleet_simulation.run() == rows


def test_what_a_digest_takes_is_counted_without_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(bench, "time", SimpleNamespace(process_time=lambda: now[0], perf_counter=lambda: 0.0))
    digests = iter([(30.0, 0), (2.0, 1)])

    def digest_photos(data: Path) -> Any:
        assert data == Path("data")
        seconds, number = next(digests)
        now[0] += seconds
        points = SimpleNamespace(photo=[0] * 700)
        return SimpleNamespace(names=["a", "b", "c", "d"], nbytes=1000, points=points, number=number)

    one: Any = SimpleNamespace(loaded=SimpleNamespace(digest_photos=digest_photos, photo_digest=None))
    found = bench.digested(one, Path("data"))
    assert one.loaded.photo_digest.number == 1
    assert found == {
        "digest_photos": 4, "digest_points": 700, "digest_cpu_ms_a_photo": 500.0, "digest_bytes_a_photo": 250.0,
    }  # fmt: skip


def test_kernels_are_compiled_and_networks_loaded_before_a_scale_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    loaded = SimpleNamespace(
        rasterizer=SimpleNamespace(render=lambda cameras: done.append(f"render {len(cameras)}")),
        matcher=SimpleNamespace(extract=lambda rgb, most: done.append(f"extract {rgb.dtype}")),
    )
    monkeypatch.setattr(scale.LoadedScene, "of", lambda scene: loaded)
    scale._warm_up()
    assert done == ["render 6", "extract uint8"]
