"""`splatfix bench gpu`: to its end with a stand-in for the GPU, parts that fail, runs cut short, its tables."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_room
import torch
from typer.testing import CliRunner

from service.bench import gpu
from service.bench.gpu_equality import image_differences
from service.bench.gpu_runner import Part, run_parts
from service.bench.gpu_shared import Shared, machine
from service.bench.gpu_table import markdown
from service.bench.large_scenes import write_folder
from service.cli import app as command_line
from service.cli.app import app
from service.errors import UnknownName
from service.interfaces import Frame
from service.photos.images import encode_image
from service.render.cpu import CpuRasterizer
from service.scene_formats import load_scene
from service.types import Camera, Intrinsics

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
    assert image.startswith("OutOfMemoryError")
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
