"""`splatfix bench gpu`: to its end with a stand-in for the GPU, parts that fail, runs cut short, its tables."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import small_room
import torch
from typer.testing import CliRunner

from service.bench import gpu, gpu_equality, gpu_memory, gpu_runner, gpu_speed
from service.bench.gpu_equality import image_differences
from service.bench.gpu_runner import Part, run_parts
from service.bench.gpu_shared import SMALL, Shared, machine
from service.bench.gpu_table import markdown
from service.bench.large_scenes import write_folder
from service.bench.pose_metrics import Units
from service.cli import app as command_line
from service.cli.app import app
from service.errors import BackendMissing, UnknownName
from service.geometry import pose_distance
from service.interfaces import Frame, SceneGradients
from service.photos.images import encode_image
from service.render.cpu import CpuRasterizer
from service.results import Status
from service.scene_formats import load_scene
from service.types import Camera, Intrinsics, NamedCamera, Pose

ROOT = Path(__file__).parents[1]
SETUP = "bench_parts:Shared", ("scene",)


def part(name: str, limit_s: float = 60.0) -> Part:
    return Part(name, f"bench_parts:{name}", limit_s)


def run(*parts: Part, **options) -> list[dict]:
    return run_parts(parts, SETUP, **{"facts": {"a": 1}, "limit_s": 60.0, **options})["parts"]


class TestRunner:
    def test_parts_share_what_was_set_up(self, tmp_path):
        seen = []
        file = tmp_path / "f.json"
        first, second = run(part("good"), part("good"), file=file, progress=lambda *done: seen.append(done))
        assert (first["state"], second["state"]) == ("done", "done")
        assert first["rows"][0]["name"] == "scene"
        assert first["rows"][0]["process"] == second["rows"][0]["process"] != os.getpid()
        assert [each["rows"][1]["parts"] for each in (first, second)] == [1, 2]
        assert seen == [(1, 2), (2, 2)]
        assert json.loads(file.read_text()) == {"a": 1, "parts": [first, second]}

    @pytest.mark.parametrize(
        ("name", "state", "told"),
        [("failing", "failed", "ArithmeticError: no result"), ("dying", "died", "exit code 7"),
         ("unwritable", "failed", "JSON"), ("endless", "too late", "after 1 s")],
    )  # fmt: skip
    def test_the_next_part_runs_whatever_becomes_of_one(self, tmp_path, name, state, told):
        file = tmp_path / "f.json"
        good, bad, after = run(part("good"), part(name, 1.0 if name == "endless" else 60.0), part("good"), file=file)
        assert (bad["state"], bad["rows"]) == (state, [{"row": 1}])
        assert told in bad["error"]
        assert after["state"] == "done"
        # In a process of its own: the other one's GPU may be unusable.
        assert after["rows"][1]["parts"] == 1
        assert json.loads(file.read_text())["parts"] == [good, bad, after]

    def test_without_the_first_part_nothing_is_run(self):
        first, second = run(part("failing"), part("good"))
        assert (first["state"], second["state"], second["rows"]) == ("failed", "not run", [])

    def test_what_there_is_no_time_for_is_not_run(self):
        good, late, after = run(part("good"), part("endless"), part("good"), limit_s=4.0)
        assert (good["state"], late["state"], after["state"]) == ("done", "too late", "not run")
        assert late["rows"] == [{"row": 1}]


def test_a_killed_run_leaves_a_whole_file(tmp_path):
    """The rows so far, which are a table, too."""
    file = tmp_path / "f.json"
    code = (
        "from pathlib import Path; from service.bench.gpu_runner import Part, run_parts\n"
        "if __name__ == '__main__':\n"
        "    parts = [Part(n, f'bench_parts:{n}', 60) for n in ('good', 'endless')]\n"
        f"    run_parts(parts, {SETUP!r}, facts={{}}, limit_s=60, file=Path({str(file)!r}))\n"
    )
    (tmp_path / "main.py").write_text(code)
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    running = subprocess.Popen([sys.executable, str(tmp_path / "main.py")], env=os.environ | {"PYTHONPATH": path})
    try:
        until = time.monotonic() + 60
        while '"row": 1' not in (file.read_text() if file.exists() else ""):
            assert running.poll() is None
            assert time.monotonic() < until
            time.sleep(0.02)
    finally:
        running.send_signal(signal.SIGKILL)
        running.wait(10)
    good, endless = json.loads(file.read_text())["parts"]
    assert (good["state"], endless["state"], endless["rows"]) == ("done", "running", [{"row": 1}])


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """The small room with one photo; no two Gaussians of it at the same depth, which would be blended in any order."""
    path = tmp_path_factory.mktemp("room")
    source = small_room.write_room(path / "grid", 6)
    scene = load_scene(source)
    shaken = scene.means + np.random.default_rng(0).normal(0, 2e-3, scene.means.shape).astype(np.float32)
    scene = replace(scene, means=shaken)
    folder = path / "room"
    write_folder(scene, folder, source, cameras=True, compressed=False)
    pose = small_room.pose_at(0.4, 0.1)
    (frame,) = CpuRasterizer(scene).render([Camera(Intrinsics(**small_room.INTRINSICS), pose)])
    (folder / "photo.jpg").write_bytes(encode_image(np.clip(frame.rgb, 0, 1)))
    truth = {"photo": "photo.jpg", "intrinsics": small_room.INTRINSICS}
    (folder / "truth.json").write_text(json.dumps([truth | {"world_from_camera": pose.world_from_camera.tolist()}]))
    return folder


@pytest.mark.ci
@pytest.mark.timeout(240)
def test_it_runs_to_its_end_with_the_stand_in(room, tmp_path, monkeypatch):
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    monkeypatch.setenv("SPLATFIX_PLUGINS_DIR", str(ROOT / "tests" / "gpu_plugins"))
    file = tmp_path / "gpu.json"
    command = ["bench", "gpu", str(room), "--renderer", "stand_in_gpu", "--small", "--json", str(file)]
    done = CliRunner().invoke(app, command)
    outcome = json.loads(file.read_text())
    parts = {each["part"]: each for each in outcome["parts"]}
    assert {name: (each["state"], each.get("error")) for name, each in parts.items()} == {
        each.name: ("done", None) for each in gpu.PARTS
    }
    assert done.exit_code == 0
    rows = {name: each["rows"] for name, each in parts.items()}
    # float64 by the reference renderer, against float32 by the CPU's.
    (picture,), (gradient,) = rows["pictures"], rows["gradients"]
    assert picture["within"]
    assert picture["alpha"] > 0.1
    assert 0 < picture["differences"]["rgb"][0] < 1e-6
    assert gradient["within"]
    assert gradient["gaussians"] > 50
    assert 0 < gradient["differences"]["pose"] < 1e-4
    assert [row["status"] for row in rows["poses"]] == ["localized"] * 2
    assert all(row["within"] for row in rows["poses"])
    assert rows["poses"][0]["truth_deg_units"][0] < 0.5
    assert {row["renderer"] for row in rows["latency"]} == {"stand_in_gpu", "cpu"}
    assert all(row["ms_p50"] >= max(row["stages_ms_p50"].values()) > 0 for row in rows["latency"])
    assert all(row["jobs"] >= row["at_a_time"] for row in rows["throughput"])
    assert [row["gaussians"] for row in rows["sizes"]] == [20_000, 30_000]
    assert rows["sizes"][0]["bytes"] < rows["sizes"][1]["bytes"]
    scene, image, after = (row["happens"] for row in rows["out of memory"])
    assert scene.startswith("BackendMissing: render: the GPU has no memory left")
    assert image.startswith("DeviceMemoryFull: render: the GPU has too little memory left")
    assert after == "the same image"
    assert rows["many jobs"][-1]["jobs"] == 4
    # What was printed is the table of the file.
    told = CliRunner().invoke(app, ["bench", "gpu", "--table-of", str(file)])
    assert told.exit_code == 0
    assert done.stdout == told.stdout
    assert "| 40 px | 1 of 1 |" in done.stdout


def test_a_renderer_that_cannot_run_is_an_error(room, capsys, monkeypatch):
    """The first part fails, so that no other is run; the command ends with its message and exit code 2."""
    with pytest.raises(UnknownName) as unknown:
        list(machine(Shared(room, "none", small=True)))
    told = f"UnknownName: {unknown.value}"
    assert "unknown value 'none'" in told
    states = [{"part": each.name, "state": "not run", "seconds": 0.0, "rows": []} for each in gpu.PARTS]
    states[0] |= {"state": "failed", "error": told}
    monkeypatch.setattr(gpu, "run", lambda folder, **options: {**options, "scene": "room", "parts": states})
    monkeypatch.setattr(sys, "argv", ["splatfix", "bench", "gpu", str(room), "--renderer", "none"])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 2
    assert "unknown value 'none'" in capsys.readouterr().err


def test_unknown_part(room):
    with pytest.raises(UnknownName, match="unknown part 'speed'"):
        gpu.run(room, names=["speed"])


@pytest.mark.parametrize("facts", [None, {"commit": "abc"}])
def test_facts_of_a_run_are_in_its_outcome_and_the_machine_in_every_run(facts, tmp_path, monkeypatch):
    def outcome_of(parts, setup, *, facts, **options):
        return {"parts": [part.name for part in parts], "facts": facts, "setup": setup}

    monkeypatch.setattr(gpu, "run_parts", outcome_of)
    found = gpu.run(tmp_path / "room", renderer="cpu", small=True, names=["index"], facts=facts)
    assert found["facts"] == {**(facts or {}), "scene": "room", "renderer": "cpu", "small": True}
    assert found["parts"] == ["machine", "index"]
    assert len(gpu.run(tmp_path / "room")["parts"]) == len(gpu.PARTS)


def test_a_result_that_is_none(tmp_path):
    (tmp_path / "x.json").write_text('{"parts": []}')
    done = CliRunner().invoke(app, ["bench", "gpu", "--table-of", str(tmp_path / "x.json")])
    assert "not a result of `bench gpu`" in str(done.exception)


def test_differences_of_images_by_hand():
    flat = np.zeros((10, 100), np.float32)
    a = Frame(np.zeros((10, 100, 3), np.float32), flat, flat, flat)
    depth = flat.copy()
    depth[:2] = 0.5  # a fifth of the pixels
    found = image_differences(replace(a, depth=depth, alpha=flat + np.float32(np.nan)), a)
    assert found["rgb"] == (0, 0)
    assert found["depth"] == pytest.approx((0.05, 0.25))  # over 2 scene units
    assert found["alpha"] == (None, None)


def test_the_table_of_a_run_that_was_cut_short():
    """Parts without rows, a size that didn't fit, a pose that differs, a value that isn't finite."""
    pose = {"photo": "a.jpg", "status": "localized", "cpu_status": "uncertain", "rotation_deg": 0.5}
    rows = {
        "machine": [{"versions": {"torch": "2.11.0", "gsplat": "unknown"}}, {"device": {"name": "card"}}],
        "gradients": [{"camera": "a", "width": 200, "within": False, "differences": {"pose": None, "sh": 2e-5}}],
        "poses": [pose | {"translation_units": 0.25, "within": False}],
        "sizes": [{"gaussians": 1000, "create_s": 0.5, "bytes": 2_000_000}, {"gaussians": 9000, "error": "a | b"}],
    }
    parts = [
        {"part": each.name, "state": "done" if each.name in rows else "not run", "seconds": 1.0,
         "rows": rows.get(each.name, [])} for each in gpu.PARTS
    ]  # fmt: skip
    text = markdown({"renderer": "gsplat_cuda", "scene": "studio", "small": False, "parts": parts})
    assert "`gsplat_cuda` on card" in text
    assert "torch 2.11.0" in text
    assert "gsplat unknown" not in text
    assert "| pictures | not run | 1.0 |  |" in text
    assert "| relative difference | 0 of 1 | ? | 2e-05 |" in text
    assert "| differs: a.jpg | localized, CPU uncertain; 0.5 deg, 0.25 units |" in text
    assert "| 1,000 | 0.5 | 2 |" in text
    assert "| 9,000 | a / b |  |" in text


# ------------------------------------------------------------------ each part, by a planted clock and planted renders


class Clock:
    """Time that passes only when something takes some."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now

    def takes(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    for module in (gpu_speed, gpu_memory):
        monkeypatch.setattr(module, "time", clock)
    return clock


class PlantedScene:
    """Two photos and two renderers, `a` being tested and twice as slow; memory grows by a byte a localization."""

    def __init__(self, clock: Clock, **work) -> None:
        self.clock, self.work = clock, replace(SMALL, **work)
        self.photos = ["p", "q"]
        self.tested, self.reference = self.loaded(2.0), self.loaded(1.0)
        self.both = ("a", self.tested), ("b", self.reference)
        self.localized: list[str] = []
        self.prepared: list[tuple[float, int]] = []
        """How slow the renderer is, and how many photos had been localized before."""

    def loaded(self, slow: float) -> SimpleNamespace:
        def render(cameras):
            self.clock.takes(0.5 * slow * len(cameras))

        rasterizer = SimpleNamespace(render=render)
        return SimpleNamespace(
            slow=slow,
            prepare=lambda _: self.prepared.append((slow, len(self.localized))),
            rasterizer=rasterizer,
            scene=None,
            matcher=None,
        )

    def localize(self, photo: str, loaded: SimpleNamespace) -> SimpleNamespace:
        """Localize `p` in 1 s, of which 0.75 s are a stage; `q` in 3 s, in two stages of 1 s."""
        self.localized.append(photo)
        stages = {"p": {"retrieve": 0.75}, "q": {"retrieve": 1.0, "refine": 1.0}}[photo]
        self.clock.takes(loaded.slow * {"p": 1.0, "q": 3.0}[photo])
        timings = [SimpleNamespace(stage=name, wall_s=loaded.slow * took) for name, took in stages.items()]
        return SimpleNamespace(timings=timings)

    def device_memory(self) -> dict[str, int]:
        return {"peak_bytes": len(self.localized)}


def test_latency_is_the_median_of_the_photos_and_of_each_stage(clock):
    shared = PlantedScene(clock, repeats=3)
    of_a, of_b = gpu_speed.latency(shared)
    assert shared.localized == ["p", *["p", "q"] * 3] * 2  # the first isn't counted
    assert (of_b["renderer"], of_b["localizations"]) == ("b", 6)
    assert of_b["ms_p50"] == pytest.approx(2000)
    assert of_b["ms_p95"] == pytest.approx(3000)
    # Decoding is what no stage took: 0.25 s of `p`, 1 s of `q`.
    assert of_b["stages_ms_p50"] == pytest.approx({"retrieve": 875, "refine": 1000, "decode": 625})
    assert of_b["stages_count"] == {"retrieve": 6, "refine": 3, "decode": 6}
    assert of_a["stages_ms_p50"] == pytest.approx({name: 2 * ms for name, ms in of_b["stages_ms_p50"].items()})


def test_throughput_counts_the_jobs_that_began_in_time(clock):
    shared = PlantedScene(clock, at_a_time=(1,), throughput_s=8.5)
    of_a, of_b = gpu_speed.throughput(shared)
    assert shared.prepared == [(2.0, 0), (1.0, 3)]  # no job waits for the index
    # p, q, p, q, p end at 1, 4, 5, 8 and 9 s; twice as slow, p, q, p at 2, 8 and 10 s.
    assert of_b == {"renderer": "b", "at_a_time": 1, "jobs": 5, "jobs_per_s": pytest.approx(5 / 9)}
    assert (of_a["jobs"], of_a["jobs_per_s"]) == (3, pytest.approx(3 / 10))
    # One at least, though the time is over before.
    (slow, _) = gpu_speed.throughput(PlantedScene(clock, at_a_time=(1,), throughput_s=0.0))
    assert (slow["jobs"], slow["jobs_per_s"]) == (1, pytest.approx(1 / 2))


def test_the_index_is_timed_with_and_without_its_renders(clock, monkeypatch):
    def prepared_index(tools, _):
        clock.takes(6.0)
        return SimpleNamespace(views=[SimpleNamespace(camera=k) for k in range(3)])

    monkeypatch.setattr(gpu_speed, "prepared_index", prepared_index)
    of_a, of_b = gpu_speed.index(PlantedScene(clock))
    assert of_b == {"renderer": "b", "views": 3, "seconds": 6.0, "views_per_s": 0.5, "renders_per_s": 2.0}
    assert of_a["renders_per_s"] == 1.0


def test_memory_is_read_after_every_tenth_of_the_jobs(clock):
    shared = PlantedScene(clock, jobs=40)
    rows = list(gpu_memory.many_jobs(shared))
    assert [row["jobs"] for row in rows] == [2, *range(4, 41, 4)]
    # Photos in turn, each once: 1 s and 3 s, twice as slow.
    assert [row["seconds"] for row in rows] == [4.0 * row["jobs"] for row in rows]
    assert [row["device_peak_bytes"] for row in rows] == [row["jobs"] for row in rows]
    assert all(row["resident_bytes"] > 1e6 for row in rows)
    assert sorted(shared.localized) == ["p"] * 20 + ["q"] * 20
    assert [row["jobs"] for row in gpu_memory.many_jobs(PlantedScene(clock, jobs=3))] == [1, 2, 3]


class OutOfMemoryError(RuntimeError):
    """Of the same name as PyTorch's."""


LENS = Intrinsics(80, 60, 70.0, 70.0, 40.0, 30.0)


def named_cameras(count: int) -> tuple[NamedCamera, ...]:
    poses = [Pose(np.array([[1, 0, 0, k], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])) for k in range(count)]
    return tuple(NamedCamera(f"{k}.jpg", Camera(LENS, pose)) for k, pose in enumerate(poses))


def test_each_size_of_a_scene_is_timed_until_one_does_not_fit(clock, room, monkeypatch):
    scene = replace(load_scene(room), cameras=named_cameras(2))
    widths = []

    class Module:
        @staticmethod
        def create(part):
            clock.takes(part.count / 1000)
            if part.count > 3000:
                raise OutOfMemoryError("full")

            def render(cameras):
                widths.extend(camera.intrinsics.width for camera in cameras)
                clock.takes(0.1 if len(cameras) == 1 else 0.04 * len(cameras))  # together they take less

            return SimpleNamespace(render=render, nbytes=7 * part.count)

    shared = PlantedScene(clock, sizes=(1000, 2000, 4000), sizes_px=80, views=2)
    shared.scene, shared.module = scene, Module
    monkeypatch.setattr(gpu_memory, "surround_with_copies", lambda scene, count: gpu_memory._first(scene, count))
    monkeypatch.setattr(gpu_memory, "keep_most_contributing", lambda scene, count, _: gpu_memory._first(scene, count))
    small, larger, full = gpu_memory.sizes(shared)
    assert [row["gaussians"] for row in (small, larger, full)] == [1000, 2000, 4000]
    assert (small["create_s"], larger["create_s"]) == pytest.approx((1.0, 2.0))
    assert (small["bytes"], larger["bytes"]) == (7000, 14000)
    for width in (20, 80):
        assert (small[f"ms_{width}px"], small[f"ms_{width}px_together"]) == pytest.approx((100, 40))
    # Two cameras, five times one by one and once together, in both widths of both sizes.
    assert widths == ([20] * 12 + [80] * 12) * 2
    assert small["device_peak_bytes"] == 0
    assert full["error"] == "OutOfMemoryError: full"
    monkeypatch.setattr(Module, "create", lambda part: (_ for _ in ()).throw(RuntimeError("lost")))
    with pytest.raises(RuntimeError, match="lost"):
        list(gpu_memory.sizes(shared))
    monkeypatch.setattr(Module, "create", lambda part: (_ for _ in ()).throw(BackendMissing("no GPU", where="render")))
    assert [row["gaussians"] for row in gpu_memory.sizes(shared)] == [1000]


@pytest.mark.parametrize("size", [LENS.width, LENS.width // 2])
def test_a_scene_then_a_render_and_nothing_afterwards_lacks_memory(clock, room, size):
    shared = PlantedScene(clock, sizes_px=size)
    shared.scene, shared.renderer = replace(load_scene(room), cameras=named_cameras(1)), "a"
    limits: list[int | None] = [None]

    class Planted:
        def render(self, cameras):
            (camera,) = cameras
            assert camera.intrinsics.width == size
            if limits[-1] == 0:
                raise OutOfMemoryError("no image")
            flat = np.full((2, 2), np.float32(len(limits) if size < LENS.width else 1))
            return [Frame(np.stack([flat] * 3, 2), flat, flat, flat)]

        def of(self, scene):
            assert limits[-1] == scene.nbytes // 2
            raise BackendMissing("no memory left", where="render")

    shared.tested.rasterizer, shared.module = Planted(), SimpleNamespace(limit_device_memory=limits.append)
    rows = {row["case"]: row["happens"] for row in gpu_memory.out_of_memory(shared)}
    same = "the same image" if size == LENS.width else "another image"
    assert list(rows.values()) == ["BackendMissing: render: no memory left", "OutOfMemoryError: no image", same]
    assert limits == [None, shared.scene.nbytes // 2, 0, None]
    shared.module = SimpleNamespace()
    assert [row["case"] for row in gpu_memory.out_of_memory(shared)] == ["none"]


class OffBy:
    """A renderer whose images are off by some amount at a share of the pixels, its gradients by a share."""

    def __init__(self, amount: float = 0.0, share: float = 1.0, gradient: float = 0.0) -> None:
        self.amount, self.share, self.gradient = amount, share, gradient

    def render(self, cameras):
        (camera,) = cameras
        shape = camera.intrinsics.height, camera.intrinsics.width
        off = np.zeros(shape[0] * shape[1])
        off[: round(self.share * len(off))] = self.amount
        flat = (0.5 + off.reshape(shape)).astype(np.float32)
        return [Frame(np.stack([flat] * 3, 2), flat, flat, flat)]

    def pose_gradient(self, camera, d_rgb, d_depth, d_alpha):
        assert d_rgb.shape == (*d_depth.shape, 3) == (camera.intrinsics.height, camera.intrinsics.width, 3)
        return np.arange(1.0, 7.0) * (1 + self.gradient)

    def scene_gradients(self, camera, d_rgb, d_depth, d_alpha):
        rows = {name: np.ones((2, size), np.float32) for name, size in (("means", 3), ("quats", 4), ("scales", 3))}
        rows |= {"opacities": np.ones(2, np.float32), "sh": np.ones((2, 1, 3), np.float32)}
        rows["scales"] *= np.float32(1 + self.gradient)
        return SceneGradients(np.array([4, 1], np.int32), **rows)


def compared(clock, room, ours: OffBy) -> PlantedScene:
    shared = PlantedScene(clock, views=2, widths=(40, 80), compared=None)
    shared.scene = replace(load_scene(room), cameras=named_cameras(3))
    shared.tested.rasterizer, shared.reference.rasterizer = ours, OffBy()
    return shared


@pytest.mark.parametrize(
    ("ours", "within"),
    [
        (OffBy(5e-7), True),
        (OffBy(2e-6), False),  # the mean's bound is 1e-6
        (OffBy(9e-5, 0.002), True),
        (OffBy(2e-4, 0.002), False),  # a quantile's is 1e-4: more than a thousandth of the pixels are beyond
        (OffBy(8e-4, 0.0005), True),
    ],
)
def test_images_agree_within_the_bounds_of_mean_and_quantile(clock, room, ours, within):
    rows = list(gpu_equality.pictures(compared(clock, room, ours)))
    assert [(row["camera"], row["width"]) for row in rows] == [(n, w) for w in (40, 80) for n in ("0.jpg", "2.jpg")]
    assert all(row["within"] is within for row in rows)
    assert all(row["alpha"] == 0.5 for row in rows)


@pytest.mark.parametrize(("off", "within"), [(0.9e-4, True), (1.1e-4, False)])
def test_gradients_agree_within_a_ten_thousandth_of_their_norm(clock, room, off, within):
    rows = list(gpu_equality.gradients(compared(clock, room, OffBy(gradient=off))))
    assert [row["width"] for row in rows] == [80, 80]
    for row in rows:
        assert row["differences"]["pose"] == pytest.approx(off)
        assert row["differences"]["scales"] == pytest.approx(off, rel=2e-3)
        assert row["differences"]["means"] == 0
        assert (row["gaussians"], row["within"]) == (2, within)


@pytest.mark.parametrize(
    ("statuses", "units", "within"),
    [
        (("localized", "localized"), 0.0009, True),
        (("localized", "localized"), 0.0011, False),
        (("localized", "uncertain"), 0.0, False),
        (("uncertain", "uncertain"), 5.0, True),  # both refused: nothing to agree about
    ],
)
def test_poses_agree_if_one_is_localized(clock, tmp_path, monkeypatch, statuses, units, within):
    shared = PlantedScene(clock, degraded=0)
    truth = named_cameras(1)[0].camera
    (tmp_path / "p.png").write_bytes(encode_image(np.full((60, 80, 3), 0.5, np.float32), "png"))
    shared.photos = [SimpleNamespace(name="p", path=tmp_path / "p.png", camera=truth)]
    shared.scene = SimpleNamespace(info=SimpleNamespace(background_rgb=(0, 0, 0)))
    shared.units = Units(np.zeros(3), 0.5, False)
    monkeypatch.setattr(gpu_equality, "degraded_renders", lambda *_: iter(()))

    def localize(query, loaded):
        assert query.intrinsics.fx == LENS.fx
        first = loaded is shared.tested
        shifted = np.eye(4)
        shifted[0, 3] = 2 * units if first else 0.0  # half a unit a scene unit
        verdict = SimpleNamespace(status=Status(statuses[0 if first else 1]))
        return SimpleNamespace(pose=Pose(shifted), verdict=verdict)

    monkeypatch.setattr(gpu_equality, "localize", localize)
    (row,) = gpu_equality.poses(shared)
    assert (row["status"], row["cpu_status"], row["within"]) == (*statuses, within)
    assert row["translation_units"] == pytest.approx(units)
    assert row["truth_deg_units"] == pytest.approx([0, units])
    assert row["cpu_truth_deg_units"] == [0, 0]


def test_degraded_renders_are_taken_near_cameras_and_are_the_same_every_time():
    large = LENS.resized(320, 240)
    cameras = tuple(NamedCamera(each.name, Camera(large, each.camera.pose)) for each in named_cameras(4))
    loaded = SimpleNamespace(scene=SimpleNamespace(cameras=cameras), rasterizer=OffBy())
    found = list(gpu_equality.degraded_renders(loaded, 60, 160, units_per_scene_unit=10.0))
    again = list(gpu_equality.degraded_renders(loaded, 2, 160, units_per_scene_unit=10.0))
    assert [data for _, data, _ in again] == [data for _, data, _ in found[:2]]
    turned, shifted = [], []
    for number, (name, _, camera) in enumerate(found):
        label, taken_from, *specs = name.split()
        assert (int(label), tuple(specs)) == (number, gpu_equality.DEGRADED_BY[number % 6])
        start = next(each.camera.pose for each in cameras if each.name == taken_from)
        if "roll=12" not in specs:
            degrees, distance = pose_distance(camera.pose, start)
            turned.append(degrees)
            shifted.append(distance)
            assert max(camera.intrinsics.width, camera.intrinsics.height) <= 160
    # The root mean square of three normal components is sqrt(3) times theirs; ten units are one scene unit.
    assert np.sqrt(np.mean(np.square(turned))) == pytest.approx(np.degrees(0.15) * np.sqrt(3), rel=0.15)
    assert np.sqrt(np.mean(np.square(shifted))) == pytest.approx(0.01 * np.sqrt(3), rel=0.15)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_the_memory_of_the_device_is_limited():
    from service.render import gsplat_cuda

    gsplat_cuda.limit_device_memory(0)
    try:
        with pytest.raises(torch.OutOfMemoryError):
            torch.zeros(2**28, device="cuda")
    finally:
        gsplat_cuda.limit_device_memory(None)
    assert gsplat_cuda.device_memory()["peak_bytes"] >= 0
    assert gsplat_cuda.device_facts()["memory_bytes"] > 2**30


def test_parts_run_in_turn_on_what_the_first_one_made() -> None:
    """As in the process of its own, whose lines no other test can see."""
    ours, theirs = multiprocessing.Pipe()
    worker = threading.Thread(target=gpu_runner._work, args=(theirs, ("bench_parts:Shared", ("s",))))
    worker.start()
    said = []
    for name in ("good", "failing", "good", "unwritable", "missing"):
        ours.send(f"bench_parts:{name}")
        while True:
            assert ours.poll(20)
            said.append(ours.recv())
            if said[-1][0] != "row":
                break
    ours.close()
    worker.join(20)
    assert not worker.is_alive()
    assert [state for state, _ in said] == [
        "row", "row", gpu_runner.DONE, "row", gpu_runner.FAILED, "row", "row", gpu_runner.DONE, "row",
        gpu_runner.FAILED, gpu_runner.FAILED,
    ]  # fmt: skip
    assert said[0][1]["name"] == "s"
    assert (said[1][1], said[6][1]) == ({"parts": 1}, {"parts": 2})
    assert said[4][1]["error"] == "ArithmeticError: no result"
    assert "bench_parts.py" in said[4][1]["traceback"]
    assert said[9][1]["error"].startswith("ValueError")
