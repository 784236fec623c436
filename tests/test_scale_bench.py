"""`splatfix bench scale` with a planted clock, memory and answers: what is timed, what is counted, in which order."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from test_bench import LENS, estimate, poses

from service.bench import scale
from service.bench.pose_metrics import Units
from service.cli.bench_scale import bench_scale
from service.errors import BackendMissing, InvalidRequest
from service.geometry import moved
from service.photos.images import encode_image
from service.results import Status
from service.types import Camera

UNITS = Units(np.zeros(3), 1.0, False)


class Clock:
    """Wall time; the processor's is half of it."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now

    def process_time(self) -> float:
        return self.now / 2


def test_memory_is_read_in_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    status = tmp_path / "status"
    status.write_text("Name:\tpython\nVmHWM:\t  300 kB\nVmRSS:\t  200 kB\nRssAnon:\t   50 kB\nThreads:\t4\n")
    monkeypatch.setattr(scale, "_STATUS", status)
    assert scale.process_memory() == {"VmHWM": 300 * 1024, "VmRSS": 200 * 1024, "RssAnon": 50 * 1024}


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(scale, "time", clock)
    return clock


def test_a_folder_is_loaded_indexed_and_localized_in_and_loaded_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    done: list[str] = []
    memory = iter([(1, 1, 1), (70, 60, 50), (90, 40, 30)])

    def takes(what: str, seconds: float, result: Any = None) -> Any:
        done.append(what)
        clock.now += seconds
        return result

    index = SimpleNamespace(views=[0] * 7)
    info = SimpleNamespace(background_rgb=(0.0, 0.0, 0.0))
    loads = iter([(8.0, 4.0), (2.0, 1.0)])

    def load(folder: Path, cache_dir: Path | None) -> SimpleNamespace:
        assert cache_dir == tmp_path / "cache"
        load_s, index_s = next(loads)
        usable = lambda estimator: takes("first views", 0.5, index)  # noqa: E731
        prepare = lambda estimator: takes("index", index_s, index)  # noqa: E731
        scene = SimpleNamespace(info=info)
        return takes("load", load_s, SimpleNamespace(usable=usable, prepare=prepare, scene=scene))

    (tmp_path / "a.png").write_bytes(encode_image(np.full((48, 64, 3), 0.5, np.float32), "png"))
    camera = Camera(LENS, poses()[0])
    photos = [SimpleNamespace(path=tmp_path / "a.png", camera=camera) for _ in range(4)]
    # The first photo's first time takes long; one is wrong, one refused, one within 5 degrees only.
    answers = iter([(9.0, 0.0, "localized"), (1.0, 0.0, "localized"), (2.0, 2.0, "localized"), (3.0, 90.0, "localized"),
                    (6.0, 0.0, "uncertain")])  # fmt: skip

    def localize(query: Any, loaded: Any) -> Any:
        seconds, degrees, status = next(answers)
        pose = moved(camera.pose, np.array([0, 0, np.radians(degrees), 0, 0, 0]))
        return takes("localize", seconds, estimate(pose, Status(status)))

    def process_memory() -> dict[str, int]:
        done.append("memory")
        return dict(zip(("VmHWM", "VmRSS", "RssAnon"), next(memory), strict=True))

    monkeypatch.setattr(scale.LoadedScene, "load", load)
    monkeypatch.setattr(scale, "_warm_up", lambda: takes("warm up", 16.0))
    monkeypatch.setattr(scale, "find_photos", lambda folder: photos)
    monkeypatch.setattr(scale, "localize", localize)
    monkeypatch.setattr(scale, "process_memory", process_memory)
    found = scale.measure_folder(tmp_path, UNITS)
    first = ["warm up", "memory", "load", "first views", "index", "memory"]
    assert done == [*first, *["localize"] * 5, "memory", "load", "index"]
    seconds = {"warm_up": 16.0, "load": 8.0, "first_views": 0.5, "index": 4.5, "load_again": 2.0, "index_again": 1.0}
    assert {name: found[f"{name}_s"] for name in seconds} == seconds
    assert {name: 2 * found[f"{name}_cpu_s"] for name in seconds} == seconds
    assert (found["bytes_before"], found["peak_bytes"]) == (1, 70)
    assert (found["resident_bytes"], found["anonymous_bytes"]) == (40, 30)
    assert (found["views"], found["photos"]) == (7, 4)
    assert (found["success_5deg_0p05"], found["success_1deg_0p01"], found["false_localized"]) == (2, 1, 1)
    assert (found["latency_ms_p50"], found["cpu_ms_p50"]) == (2500.0, 1250.0)


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A run whose large scenes are files of a byte a Gaussian, measured at once."""
    seen = SimpleNamespace(written=[], loaded=[], measured=[], progress=[], resized=[])
    scene = SimpleNamespace(cameras=[SimpleNamespace(camera=Camera(LENS, pose)) for pose in poses()], sh_degree=2)
    seen.scene = scene

    def load_scene(folder: Path, without_photos: Any = None) -> Any:
        seen.loaded.append((folder.name, without_photos))
        return scene

    def write_folder(large: Any, at: Path, source: Path, cameras: bool, compressed: bool) -> Path:
        seen.written.append((at, cameras, compressed))
        at.mkdir()
        (at / "scene.ply").write_bytes(b"x" * large.count)
        return at / "scene.ply"

    class AtOnce:
        def __init__(self, workers: int, context: Any) -> None:
            assert (workers, context.get_start_method()) == (1, "spawn")

        def __enter__(self) -> AtOnce:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def submit(self, call: Any, folder: Path, units: Units) -> Any:
            assert call is scale.measure_folder
            seen.measured.append((folder.name, folder.is_dir(), units.units_per_scene_unit))
            return SimpleNamespace(result=lambda: {"photos": 3})

    monkeypatch.setattr(scale, "find_spec", lambda name: object())
    monkeypatch.setattr(scale, "find_photos", lambda folder: [SimpleNamespace(names=("a.jpg", "b.jpg"))])
    monkeypatch.setattr(scale, "load_scene", load_scene)
    monkeypatch.setattr(scale, "units_of", lambda cameras, depth_of: Units(np.zeros(3), float(len(cameras)), False))
    monkeypatch.setattr(scale, "_depth_of", lambda scene: None)
    monkeypatch.setattr(
        scale, "_resize", lambda scene, count, others: seen.resized.append((count, len(others)))
        or SimpleNamespace(count=count, sh_degree=2),
    )  # fmt: skip
    monkeypatch.setattr(scale, "ProcessPoolExecutor", AtOnce)
    monkeypatch.setitem(sys.modules, "service.bench.large_scenes", SimpleNamespace(write_folder=write_folder))
    return seen


def test_each_size_is_a_folder_of_its_own_that_is_gone_afterwards(planted: SimpleNamespace, tmp_path: Path) -> None:
    rows = scale.run(
        Path("room"), others=[Path("x"), Path("y")], sizes=(10, 20), work=tmp_path,
        progress=lambda *now: planted.progress.append(now),
    )  # fmt: skip
    common = {"sh_degree": 2, "file": "scene.ply", "cameras": "ignored", "photos": 3}
    assert rows == [{"gaussians": size, "file_bytes": size, **common} for size in (10, 20)]
    # No index view may rest on a test photo's pose.
    assert planted.loaded == [("room", ["a.jpg", "b.jpg"]), ("x", None), ("y", None)]
    assert planted.resized == [(10, 2), (20, 2)]
    assert planted.measured == [("10", True, 8.0), ("20", True, 8.0)]
    assert planted.progress == [(1, 2), (2, 2)]
    assert [(cameras, compressed) for _, cameras, compressed in planted.written] == [(False, False)] * 2
    assert all(tmp_path in at.parents for at, _, _ in planted.written)
    assert list(tmp_path.iterdir()) == []
    scale.run(Path("room"), sizes=(5,), cameras="given", compressed=True)
    assert planted.written[-1][1:] == (True, True)


def test_what_a_run_needs_is_told(planted: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planted.scene.cameras = []
    with pytest.raises(InvalidRequest, match="needs training cameras"):
        scale.run(Path("room"))
    monkeypatch.setattr(scale, "_STATUS", tmp_path / "nothing")
    with pytest.raises(InvalidRequest, match="/proc"):
        scale.run(Path("room"))
    monkeypatch.setattr(scale, "find_spec", lambda name: None)
    with pytest.raises(BackendMissing, match="gsply"):
        scale.run(Path("room"))


def test_a_scene_is_thinned_or_surrounded_to_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: Any = SimpleNamespace(
        keep_most_contributing=lambda scene, count, rasterizer: ("kept", count, rasterizer),
        surround_with_copies=lambda scene, count, others: ("surrounded", count, others),
    )
    monkeypatch.setitem(sys.modules, "service.bench.large_scenes", calls)
    monkeypatch.setattr(scale.LoadedScene, "of", lambda scene: SimpleNamespace(rasterizer="renderer"))
    scene: Any = SimpleNamespace(count=100)
    assert scale._resize(scene, 99, ()) == ("kept", 99, "renderer")
    assert scale._resize(scene, 100, ("x",)) == ("surrounded", 100, ("x",))


def test_a_street_is_measured_with_its_cameras(
    planted: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    street = SimpleNamespace(clean=planted.scene, trained=SimpleNamespace(count=7, sh_degree=0))
    monkeypatch.setattr(scale, "make_street", lambda config: made.append(config) or street)
    monkeypatch.setattr(scale, "write_photos", lambda street, folder, seed: made.append((folder.name, seed)))
    (row,) = scale.run_street(replace(scale.STREET, seed=5), work=tmp_path)
    assert made == [replace(scale.STREET, seed=5), ("photos", 5)]
    assert row == {
        "gaussians": 7,
        "sh_degree": 0,
        "file": "scene.ply",
        "cameras": "given",
        "file_bytes": 7,
        "photos": 3,
    }
    assert planted.written[-1][1:] == (True, False)
    assert planted.measured == [("street", True, 8.0)]
    assert list(tmp_path.iterdir()) == []
    for folder, with_street in ((None, False), (tmp_path, True)):
        with pytest.raises(typer.BadParameter, match="either"):
            bench_scale(folder, with_street)
