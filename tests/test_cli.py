"""The command line, in process; and `splatfix serve` as a process of its own, with the line that it prints."""

from __future__ import annotations

import csv
import importlib
import io
import itertools
import json
import os
import pkgutil
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import uvicorn
from numba.core.caching import NullCache
from numba.core.registry import CPUDispatcher
from PIL import ExifTags, Image

import service
import service.__main__
from service import jit
from service.accuracy import Accuracy
from service.bench.rigs import MODIFICATIONS as RIG_MODIFICATIONS
from service.cli.graceful_server import GracefulServer
from service.cli.render import render
from service.cli.server import _listener
from service.geometry import moved, pose_distance
from service.scene_manager.anchor_store import Anchor, FileAnchorStore
from service.scene_manager.status import StoredScene
from service.types import Pose
from service.web.app import data_folder
from service.web.settings import unknown_variables
from tests.small_room import INTRINSICS, pose_at, write_room

ROOT = Path(__file__).parents[1]
# Tilted: seen level, the Gaussians in a column of a wall are equally far, and which is in front is chance.
TRUTH = moved(pose_at(1.0, 0.1), np.array([0.05, 0.0, 0.04, 0.0, 0.0, 0.0]))


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return write_room(tmp_path_factory.mktemp("scenes") / "room")


@pytest.fixture(scope="module", autouse=True)
def cache(scene_cache):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPLATFIX_CACHE_DIR", str(scene_cache))
        yield


@pytest.fixture
def splatfix(monkeypatch, capsys):
    """Run a command line; return exit code, standard output, standard error."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["splatfix", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            service.__main__.main()
        told = capsys.readouterr()
        return int(left.value.code or 0), told.out, told.err

    return run


@pytest.fixture(scope="module")
def photo(room) -> Path:
    """A render of the room from TRUTH, made by the command line itself."""
    path = room / "photos" / "query.png"
    path.parent.mkdir()
    pose = json.dumps({"world_from_camera": TRUTH.world_from_camera.tolist()})
    render(room, pose, path)
    return path


def environment() -> dict[str, str]:
    """Of a process that shall find the kernels compiled."""
    return {**os.environ, "NUMBA_CACHE_DIR": str(jit.numba.config.CACHE_DIR)}  # type: ignore[attr-defined]


def test_render_draws_the_scene_as_a_training_camera_sees_it(photo):
    image = Image.open(photo)
    assert image.size == (INTRINSICS["width"], INTRINSICS["height"])
    assert np.asarray(image).std() > 30  # coloured patches, not one grey


def test_localize_finds_the_photo_and_tells_it_three_ways(splatfix, room, photo, tmp_path):
    table = tmp_path / "poses.csv"
    given = ("--scene", room, "--intrinsics", json.dumps(INTRINSICS), "--seed", 5)
    ahead = TRUTH.position_in_world + 2 * TRUTH.axis_in_world
    FileAnchorStore(lambda _: StoredScene("room", room), None).put("room", Anchor("ahead", ahead))
    code, told, _ = splatfix("localize", photo, *given, "--json", "--csv", table)
    assert code == 0
    (result,) = json.loads(told)
    assert (result["photo"], result["status"], result["seed"]) == (str(photo), "localized", 5)
    found = Pose(np.array(result["pose"]["world_from_camera"]["matrix"]))
    degrees, units = pose_distance(found, TRUTH)
    # Seen: 0.02 degrees, 0.0002 units.
    assert degrees < 0.2
    assert units < 0.005
    (anchor,) = result["anchors"]
    # In the middle of the photo, as far as the pose is right: 0.1 px seen.
    assert anchor["pixel"] == pytest.approx([INTRINSICS["cx"], INTRINSICS["cy"]], abs=1.0)
    (room / "anchors.json").unlink()
    (row,) = csv.DictReader(table.read_text().splitlines())
    assert [float(row[c]) for c in "xyz"] == pytest.approx(found.position_in_world.tolist())
    assert row["status"] == "localized"
    code, told, _ = splatfix("localize", photo, *given)
    assert told.startswith(f"{photo}: localized, score ")
    grey = tmp_path / "grey.png"
    Image.new("RGB", (INTRINSICS["width"], INTRINSICS["height"]), (90, 90, 90)).save(grey)
    code, told, _ = splatfix("localize", photo, grey, *given)
    assert (code, "not_localized" in told) == (0, True)
    assert splatfix("localize", photo, grey, *given, "--fail")[0] == 1
    assert splatfix("localize", photo, *given, "--fail")[0] == 0


def test_photos_tell_the_lens_of_the_next_ones_where_that_is_asked_for(splatfix, room, photo, tmp_path):
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "phone"
    photos = [tmp_path / f"{k}.png" for k in range(2)]
    for path in photos:
        Image.open(photo).save(path, exif=exif)
    for asked, sources in (((), ["guessed", "guessed"]), (("--learn-lenses",), ["guessed", "memory"])):
        code, told, _ = splatfix("localize", *photos, "--scene", room, "--json", *asked)
        assert code == 0
        results = json.loads(told)
        assert [result["status"] for result in results] == ["localized", "localized"]
        assert [result["intrinsics_source"] for result in results] == sources
    code, _, told = splatfix("localize", *photos, "--sequence", "--scene", room, "--learn-lenses")
    assert (code, "--learn-lenses" in told) == (2, True)


def test_a_video_is_followed_and_told_four_ways(splatfix, room, tmp_path):
    film, table, trajectory = (tmp_path / name for name in ("walk.avi", "poses.csv", "poses.tum"))
    truth = [moved(pose_at(1.0 + 0.02 * i, 0.1), np.array([0.15, 0, 0, 0, 0, 0])) for i in range(4)]
    frames = []
    for i, pose in enumerate(truth):
        frames.append(tmp_path / f"{i}.png")
        render(room, json.dumps({"world_from_camera": pose.world_from_camera.tolist()}), frames[-1])
    size = (INTRINSICS["width"], INTRINSICS["height"])
    writer = cv2.VideoWriter(str(film), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), 10.0, size)
    for frame in frames:
        writer.write(cv2.imread(str(frame)))
    writer.release()
    given = ("--scene", room, "--intrinsics", json.dumps(INTRINSICS))
    code, told, _ = splatfix("localize", film, *given, "--json", "--csv", table, "--tum", trajectory)
    assert code == 0
    found = json.loads(told)["frames"]
    for frame, pose in zip(found, truth, strict=True):
        degrees, units = pose_distance(Pose(np.array(frame["world_from_camera"]["matrix"])), pose)
        assert degrees < 0.2  # seen: 0.02
        assert units < 0.01  # seen: 0.0006
    assert [frame["tracked"] for frame in found] == [False, True, True, True]
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [row["time_s"] for row in rows] == ["0.0", "0.1", "0.2", "0.3"]
    lines = np.loadtxt(trajectory)
    assert lines[:, 0] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    places = [frame["world_from_camera"]["translation"] for frame in found]
    assert lines[:, 1:4] == pytest.approx(np.array(places))
    assert lines[:, 7] == pytest.approx([frame["world_from_camera"]["quaternion_wxyz"][0] for frame in found])
    code, told, _ = splatfix("localize", *frames, "--sequence", *given, "--every", 2, "--times", "[5, 6, 7, 8]")
    first, second = told.splitlines()
    assert first.startswith(f"5.000 s, {frames[0]}: localized")
    assert second.startswith(f"7.000 s, {frames[2]}: localized")


def test_scenes_are_listed_and_inspected(splatfix, room, tmp_path):
    assert splatfix("scenes", "list", room.parent)[:2] == (0, f"{room}\n")
    code, told, _ = splatfix("scenes", "inspect", room)
    facts = {line[:18].strip(): line[18:].strip() for line in told.splitlines()}
    assert (code, facts["training cameras"], facts["format"]) == (0, "24", "ply")
    assert facts["name"] == "room (id room)"
    assert facts["training size"] == "320 px (from the training cameras)"
    drawn = tmp_path / "scene.png"
    code, told, _ = splatfix("scenes", "inspect", room / "scene.ply", "--json", "--image", drawn)
    with Image.open(drawn) as image:
        assert image.size[0] == 600 + 440  # the plan, and renders beside it
    bare = json.loads(told)
    assert (code, bare["training_cameras"], bare["training_size"]["px"]) == (0, 0, None)
    assert bare["index"]["interior"]
    assert bare["index"]["coverage"] > 0.9
    assert bare["floaters"] == {"found": 0, "veil": 0.0, "left_out": False}
    assert facts["floaters"] == "none"
    assert "training size is unknown" in " ".join(bare["warnings"])
    code, told, _ = splatfix("scenes", "convert", room, tmp_path / "again")
    wanted = f"{bare['gaussians']} Gaussians, SH degree 0, 24 training cameras: {tmp_path / 'again'}\n"
    assert (code, told) == (0, wanted)


def test_a_photo_that_cannot_be_read_keeps_no_other_from_its_result(splatfix, room, photo, tmp_path):
    broken, table = tmp_path / "broken.jpg", tmp_path / "out.csv"
    broken.write_bytes(encoded_noise()[:2000])
    given = ("localize", photo, broken, photo, "--scene", room)
    code, told, complaint = splatfix(*given, "--csv", table)
    assert (code, [line.split(",")[0].split(": ")[1] for line in told.splitlines()]) == (2, ["localized"] * 2)
    assert complaint.startswith(f"error: {broken}: the JPEG can't be decoded")
    with table.open(newline="") as file:
        rows = [(row["photo"], row["status"], row["reason"]) for row in csv.DictReader(file)]
    assert [row[1] for row in rows] == ["localized", "error", "localized"]
    assert rows[1] == (str(broken), "error", "invalid_image")
    code, told, _ = splatfix(*given, "--json")
    first, second, third = json.loads(told)
    assert (code, first["status"], third["status"]) == (2, "localized", "localized")
    assert second["error"]["code"] == "invalid_image"
    assert str(broken) in second["error"]["message"]


def encoded_noise() -> bytes:
    stream = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (100, 120, 3), np.uint8)
    Image.fromarray(noise).save(stream, "JPEG")
    return stream.getvalue()


def test_what_a_user_can_mend_is_one_line_and_exit_code_2(splatfix, room, photo, tmp_path):
    torn = tmp_path / "torn.ply"
    torn.write_bytes(b"ply\n")
    text = tmp_path / "photo.jpg"
    text.write_text("no photo")
    pose = '{"world_from_camera": [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]}'
    bad = [
        (("localize", photo, "--scene", tmp_path / "none"), "none"),
        (("localize", photo, "--scene", torn), "torn.ply"),
        (("localize", tmp_path / "none.jpg", "--scene", room), "none.jpg"),
        (("localize", text, "--scene", room), "not a JPEG"),
        (("localize", photo, "--scene", room, "--estimator", "magic"), "magic"),
        (("localize", photo, "--scene", room, "--matcher", "magic"), "sift, xfeat, xfeat_lighterglue"),
        (("localize", photo, "--scene", room, "--intrinsics", '{"fx": 0}'), "intrinsics"),
        (("localize", photo, "--scene", room, "--intrinsics", "none.json"), "none.json"),
        (("localize", photo, "--scene", room, "--prior", "{"), "prior"),
        (("localize", photo, "--scene", room, "--budget-s", "-1"), "budget_s"),
        (("localize", photo, "--scene", room, "--sequence"), "two photos"),
        (("localize", photo, photo, "--scene", room, "--sequence", "--times", "[1]"), "times_s"),
        (("localize", photo, photo, "--scene", room, "--every", "2"), "every"),
        (("localize", photo, "--scene", room, "--tum", tmp_path / "t.txt"), "--sequence"),
        (("render", "--scene", room, "--pose", pose, "--out", tmp_path / "a.png"), "not a rotation"),
        (("render", "--scene", room, "--pose", "{}", "--out", tmp_path / "a.gif"), ".png"),
        (("scenes", "list", tmp_path / "none"), "none"),
        (("scenes", "convert", room, tmp_path), "is there already"),
        (("serve", tmp_path / "none", "--port", 0), "none"),
    ]
    for arguments, expected in bad:
        code, told, complaint = splatfix(*arguments)
        assert (code, told) == (2, ""), arguments
        assert complaint.startswith("error: "), complaint
        assert expected in complaint
        assert complaint.count("\n") == 1


def test_a_variable_that_is_no_setting_is_told():
    environment = dict.fromkeys(("SPLATFIX_WORKRES", "SPLATFIX_FOO", "SPLATFIX_WORKERS", "SPLATFIX_KEY", "HOME"), "1")
    kubernetes = dict.fromkeys(("SPLATFIX_SERVICE_HOST", "SPLATFIX_PORT_8000_TCP_ADDR"), "1")
    foo, workers = unknown_variables(environment | kubernetes)
    assert foo.startswith("unknown setting SPLATFIX_FOO")
    assert workers.endswith("is SPLATFIX_WORKERS meant?")


def test_a_port_in_use_a_used_folder_and_a_bad_setting_are_told(splatfix, monkeypatch, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        code, _, complaint = splatfix("serve", "--port", taken.getsockname()[1])
    assert (code, "in use" in complaint) == (2, True)
    with data_folder(tmp_path / "data"):
        monkeypatch.setenv("SPLATFIX_DATA_DIR", str(tmp_path / "data"))
        code, _, complaint = splatfix("serve", "--port", 0)
    assert (code, "another process uses it" in complaint) == (2, True)
    assert "Traceback" not in complaint
    assert complaint.count("\n") == 1
    monkeypatch.setenv("SPLATFIX_WORKERS", "0")
    code, _, complaint = splatfix("serve")
    assert (code, complaint.startswith("error: workers: ")) == (2, True)


def test_bench_hands_its_flags_on_and_writes_json(splatfix, monkeypatch, tmp_path):
    import service.bench.localize

    asked = {}

    def run(folder, **options):
        options["progress"](1, 2)
        asked.update(options, folder=folder)
        return {"scene": "x", "success_5deg_0p05": 0.5, "per_query": [{"photo": "a"}]}

    monkeypatch.setattr(service.bench.localize, "run", run)
    flags = "--estimator view_index --start hard --trials 3 --seed 4 --intrinsics withheld --cameras ignored"
    flags += " --budget-renders 9 --matcher sift --background white"
    written = tmp_path / "out.json"
    code, told, complaint = splatfix(
        "bench",
        "localize",
        tmp_path,
        *flags.split(),
        "--occluders",
        tmp_path,
        "--modify",
        "blur=2",
        "--modify-scene",
        "dark=0.5",
        "--options",
        '{"candidates": 3}',
        "--accuracy",
        '{"units": 0.5}',
        "--misses",
        tmp_path / "misses",
        "--photos",
        "--json",
        written,
    )
    assert code == 0, complaint
    assert asked.pop("progress")
    assert asked.pop("on_miss")
    assert (tmp_path / "misses").is_dir()
    assert asked.pop("options").candidates == 3
    assert asked.pop("accuracy") == Accuracy(units=0.5)
    assert asked.pop("budget") == service.bench.localize.Budget(None, 9)
    assert asked.pop("cache_dir") == Path(os.environ["SPLATFIX_CACHE_DIR"])
    assert asked == {
        "folder": tmp_path, "estimator": "view_index", "matcher": "sift", "start": "hard", "trials": 3, "seed": 4,
        "intrinsics": "withheld", "cameras": "ignored", "modify": ("blur=2",),
        "modify_scene": ("dark=0.5",), "data": None, "layout": "auto", "background": "white", "occluders": tmp_path,
        "photos": True,
    }  # fmt: skip
    assert json.loads(written.read_text())["per_query"] == [{"photo": "a"}]
    assert "success_5deg_0p05" in told
    assert "cores" in complaint  # the machine and its load


def kernels() -> dict[str, Any]:
    """The kernels that have machine code of their own on disk."""
    names = [each.name for each in pkgutil.walk_packages(service.__path__, "service.")]
    modules = [importlib.import_module(n) for n in names if n.startswith(("service.render.", "service.pose."))]
    found = {f"{m.__name__}.{name}": value for m in modules for name, value in vars(m).items()}
    compiled = {name: value for name, value in found.items() if isinstance(value, CPUDispatcher)}
    return {name: value for name, value in compiled.items() if not isinstance(value._cache, NullCache)}


def test_doctor_finds_the_parts_at_work(splatfix):
    """And warms all kernels up: each finds its machine code, or compiles it."""
    for each in kernels().values():
        each._reset_overloads()
    code, told, _ = splatfix("doctor", "--warm")
    assert [name for name, each in kernels().items() if not each.signatures] == []
    lines = {line[5:29].strip(): line[:4].strip() for line in told.splitlines()}
    assert code == 0, told
    assert (lines["renderer cpu"], lines["matcher"], lines["estimator view_index"]) == ("ok", "ok", "ok")
    assert "SPLATFIX_WORKERS" in told


@pytest.mark.ci
def test_serve_prints_a_line_that_works_opens_the_browser_and_ends_when_told(room, photo, tmp_path):
    curl = shutil.which("curl")
    if not curl:
        pytest.skip("no curl here")
    opened = tmp_path / "opened"
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho "$1" > "{opened}"\n', "utf-8")
    browser.chmod(0o755)
    command = [sys.executable, "-m", "service", "serve", str(room), "--port", "0", "--no-viewer", "--browser"]
    env = environment() | {"BROWSER": f"{browser} %s"}
    with subprocess.Popen(command, cwd=ROOT, env=env, stdout=subprocess.PIPE, text=True) as server:
        try:
            line = next(line for line in server.stdout or () if line.startswith("  curl "))
            done = subprocess.run([*shlex.split(line), "-s"], capture_output=True, text=True, check=True)
            job = json.loads(done.stdout)
            assert opened.read_text("utf-8").strip() == line.split()[-1].removesuffix("localize")
            assert job["result"]["status"] == "localized"
            found = Pose(np.array(job["result"]["pose"]["world_from_camera"]["matrix"]))
            assert pose_distance(found, TRUTH)[0] < 0.2
        finally:
            began = time.monotonic()
            server.send_signal(signal.SIGTERM)
            server.wait(20)
    assert time.monotonic() - began < 10
    assert server.returncode in (0, -signal.SIGTERM)


def test_bench_device_tells_the_machine_and_what_it_measured(splatfix, room, photo, tmp_path):
    folder = shutil.copytree(room, tmp_path / "with truth")
    entry = {"photo": photo.name, "intrinsics": INTRINSICS, "world_from_camera": TRUTH.world_from_camera.tolist()}
    (folder / "truth.json").write_text(json.dumps([entry]), "utf-8")
    began = time.monotonic()
    code, told, _ = splatfix("bench", "device", folder, "--limit-s", "1", "--emulated", "--json", tmp_path / "f.json")
    elapsed_ms = 1e3 * (time.monotonic() - began)
    assert code == 0
    outcome = json.loads((tmp_path / "f.json").read_text("utf-8"))
    assert (outcome["system"], outcome["machine"]) == (os.uname().sysname, os.uname().machine)
    assert outcome["emulated"]
    assert "EMULATED" in told
    for kind, errors in (("given", (1.0, 0.05)), ("withheld", (5.0, 0.2))):
        found = outcome["photos"][kind]
        assert (found["queries"], found["localized"], found["false_localized"]) == (1, 1, 0)
        assert found["median_rotation_deg"] < errors[0]
        assert found["median_translation_units"] < errors[1]
        assert 0 < sum(found["stages_ms_p50"].values()) <= found["latency_ms_p50"] < elapsed_ms
        assert f"intrinsics {kind}: 1 of 1 localized, 0 wrongly" in told


def test_bench_paper_hands_its_flags_on_and_refuses_unknown_names(splatfix, monkeypatch, tmp_path):
    from service.bench.paper import runs

    seen = []
    monkeypatch.setattr(runs, "run", lambda asked, show: seen.append(asked))
    scenes = [tmp_path / "chair", f"{tmp_path / 'fern.ply'}={tmp_path / 'llff'}"]
    flags = "--trials 7 --slow-trials 1 --seed 3 --study table2 --protocol hard --method mc_do --matcher sift"
    assert splatfix("bench", "paper", *scenes, "--out", tmp_path / "out", *flags.split())[0] == 0
    (asked,) = seen
    assert asked.scenes == {"chair": (scenes[0], None), "fern": (tmp_path / "fern.ply", tmp_path / "llff")}
    assert [cell.name for cell in asked.cells] == ["table2/mc_do/hard"]
    assert (asked.trials, asked.slow_trials, asked.seed, asked.matcher) == (7, 1, 3, "sift")
    for flag, known in (("--study", "table5"), ("--protocol", "hard"), ("--method", "view_index")):
        code, _, complaint = splatfix("bench", "paper", scenes[0], "--out", tmp_path / "out", flag, "magic")
        assert (code, "magic" in complaint, known in complaint) == (2, True, True)
    code, _, complaint = splatfix("bench", "paper", tmp_path / "a", f"{tmp_path / 'b' / 'a'}", "--out", tmp_path)
    assert (code, "two scenes have the name 'a'" in complaint) == (2, True)


def test_bench_field_runs_what_its_flags_say_and_prints_the_table(splatfix, monkeypatch, tmp_path):
    from service.bench import field

    seen = []
    monkeypatch.setattr(field, "run", lambda asked, show: seen.append(asked))
    line = {"scene": "s", "localized": True, "right": True, "reason": "verified", "below_floor": [], "cpu_ms": 1.0}
    line |= {"rotation_deg": 0.1, "translation_units": 0.01, "nees": 5.0, "focal_error": 0.0, "k1_error": 0.0}
    rows = [("lens/told", "lens"), ("photo/blur=4", "photo"), ("random/exif", "random")]
    lines = [line | {"row": row, "pool": row, "group": group, "code": group[:1]} for row, group in rows]
    monkeypatch.setattr(field, "read_results", lambda asked: lines)
    scenes = [tmp_path / "room", f"{tmp_path / 'room'}={tmp_path / 'night'}"]
    code, told, _ = splatfix("bench", "field", *scenes, "--out", tmp_path, "--row", "lens/told", "--photos", "3")
    (asked,) = seen
    assert code == 0
    assert asked.scenes == {"room": (scenes[0], None), "room-night": (tmp_path / "room", tmp_path / "night")}
    assert ([row.name for row in asked.rows], asked.photos, asked.random) == (["lens/told"], 3, 0)
    assert ("| lens/told | 1 | 1 |" in told, "blur" in told, "random" in told) == (True, False, False)
    told = splatfix("bench", "field", *scenes, "--out", tmp_path, "--random", "5")[1]
    assert (seen[1].rows, seen[1].random, "random/exif" in told, "lens/told" in told) == ([], 5, True, False)
    told = splatfix("bench", "field", *scenes, "--out", tmp_path, "--table-only")[1]
    assert (len(seen), "random/exif" in told, "blur" in told) == (2, True, True)
    assert "several versions of the code: l, p, r" in told
    assert "lens/k1=-0.1/exif" in splatfix("bench", "field", "--list")[1].splitlines()
    assert splatfix("bench", "field", "--row", "lens/nothing", "--list")[0] == 2


def test_bench_paper_shows_how_far_it_is():
    from rich.console import Console

    from service.bench.paper.runs import Progress
    from service.cli.bench_paper import _progress_table

    cells = ("table2/mc_do/hard", "table2/icomma/hard", "table5/mc_do:mc/random")
    standing = Progress(total={(scene, cell): 5 for scene in ("chair", "fern") for cell in cells})
    standing.done |= {("chair", cells[0]): 3, ("chair", cells[1]): 1}
    standing.within |= {("chair", cells[0]): 2}
    standing.seconds |= {cells[0]: [4.0, 6.0], cells[1]: [60.0]}
    # mc_do: 7 to go at 5 s; icomma: 9 at 60 s; the third has no pace yet: 10 at the mean of all, 70 / 3 s
    assert standing.eta_s == pytest.approx(35 + 540 + 700 / 3)
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(_progress_table(standing))
    told = console.export_text()
    assert re.search(r"mc_do/hard .*2 / 3 / 5 .*0 / 0 / 5", told)
    assert "table5" not in told
    assert "4 of 30 queries, 13 minutes to go" in told


def test_bench_paper_says_once_a_minute_how_far_it_is_where_no_table_can_be_drawn(monkeypatch, capsys):
    from service.bench.paper.runs import Progress
    from service.cli import bench_paper

    seconds = iter([100.0, 130.0, 160.0, 160.5, 161.0, 220.4, 220.6, 221.0])
    monkeypatch.setattr(bench_paper, "time", SimpleNamespace(monotonic=lambda: next(seconds)))
    standing = Progress(total={("fern", "a"): 30, ("fern", "b"): 6}, done={("fern", "a"): 3}, expected_s=40.0)
    with bench_paper._live_table() as show:
        for _ in range(5):  # 30, 60, 60.5, 59.4 and 59.6 seconds after the last line
            show(standing)
    assert capsys.readouterr().err.splitlines() == ["3 of 36 queries, 22 minutes to go"]


def test_bench_peer_has_a_line_for_each_scene_and_method(splatfix, monkeypatch, tmp_path):
    from service.bench.peer import comparison

    given: list = []
    row = {
        "scene": "chair-of-materials", "method": "dog_direct", "photos": 20, "right_1deg_0p01": 7,
        "right_5deg_0p05": 9, "false_localized": 2, "median_rotation_deg": 1.23456,
        "median_translation_units": 0.012345, "cpu_ms_p50": 432.4, "build_cpu_s": 12.34, "peak_bytes": 1_234_000_000,
    }  # fmt: skip

    def run(tasks, methods, progress):
        given.append((tasks, methods))
        progress(1, 2)
        yield row

    monkeypatch.setattr(comparison, "run", run)
    flags = ("--layout", "scene", "--modify", "gain=2", "--seed", "3", "--json", tmp_path / "o.json")
    code, told, complaints = splatfix("bench", "peer", "A", "B", *flags)
    assert code == 0
    assert "core" in complaints
    tasks = [comparison.Task(Path(name), None, "scene", ("gain=2",), 3) for name in "AB"]
    assert given == [(tasks, comparison.METHODS)]
    assert json.loads((tmp_path / "o.json").read_text()) == [row]
    names, figures = told.splitlines()
    assert names.split()[:2] == ["scene", "method"]
    assert figures.split() == [
        "chair-of-mat", "dog_direct", "7/20", "9/20", "2", "1.235", "0.01235", "432", "12.3", "1234",
    ]  # fmt: skip
    assert splatfix("bench", "peer", "A", "--data", "D", "--method", "sift_best10")[0] == 0
    assert given[1] == ([comparison.Task(Path("A"), Path("D"))], ["sift_best10"])
    code, _, complaint = splatfix("bench", "peer", "A", "B", "--data", "D")
    assert (code, "Name one scene" in complaint) == (2, True)


def test_bench_fleet_has_a_row_for_each_fleet(splatfix, monkeypatch, tmp_path):
    from service.bench import fleet_simulation

    model = fleet_simulation.FleetModel(100, 2000, failures_per_hour=20.0)
    found = fleet_simulation.FleetFigures(0.123, 1.239, 4.0, 0.01234, 0.5, 0.616, 0, 9)
    monkeypatch.setattr(fleet_simulation, "run", lambda: [(model, found)])
    code, told, _ = splatfix("bench", "fleet", "--json", tmp_path / "o.json")
    assert code == 0
    cells = [cell.strip() for cell in told.splitlines()[3].strip("│ ").split("│")]
    assert cells == ["100", "2000", "20", "20", "0.12", "1.24", "4.00", "0.0123", "62%"]
    (written,) = json.loads((tmp_path / "o.json").read_text())
    assert (written["model"]["scenes"], written["figures"]["p95_s"]) == (2000, 1.239)


def test_benches_draw_and_write_the_files_that_are_named(splatfix, monkeypatch, tmp_path):
    from service.bench.paper import figures
    from service.pose.verification import gate_model

    drawn: list = []
    parts = {name: {"scenes": 1, "reliability": [name]} for name in ("with_matches", "photometric", "tracked")}
    shipped = json.loads(Path(gate_model.__file__).with_name("model.json").read_text())
    monkeypatch.setattr("service.bench.gate.run", lambda *_, **__: {**parts, "model": shipped})
    monkeypatch.setattr("service.bench.scale.run", lambda *_, **__: [{"seconds": 1.5}])
    for name in ("reliability", "growth"):
        monkeypatch.setattr(figures, name, lambda values: drawn.append(values) or b"a picture")
    files = {"--model": tmp_path / "m.json", "--plot": tmp_path / "g.png"}
    code, told, _ = splatfix("bench", "gate", "S", *itertools.chain(*files.items()))
    assert code == 0
    assert "reliability" not in told
    assert json.loads(files["--model"].read_text()) == shipped
    assert splatfix("bench", "scale", "S", "--plot", tmp_path / "s.png")[0] == 0
    # What tracked poses have is not drawn: they aren't judged by a probability alone.
    assert drawn == [{"with_matches": ["with_matches"], "photometric": ["photometric"]}, [{"seconds": 1.5}]]
    assert (tmp_path / "g.png").read_bytes() == (tmp_path / "s.png").read_bytes() == b"a picture"


@pytest.mark.parametrize(
    ("flags", "bench", "asked"),
    [
        ("scale S", "scale", {"others": (), "sizes": (100_000, 300_000, 1_000_000, 3_000_000), "compressed": False}),
        ("scale S --size 2000 --size 3000 --compressed", "scale", {"sizes": [2000, 3000], "compressed": True}),
        ("scale S --around A --cameras given", "scale", {"others": [Path("A")], "cameras": "given"}),
        ("render", "render", {"repeats": 30}),
        ("render --repeats 2", "render", {"repeats": 2}),
        ("ablation S T", "ablation", {"parts": (), "": [Path("S"), Path("T")]}),
        ("ablation S T --part mirror", "ablation", {"parts": ["mirror"]}),
        ("gate S", "gate", {"seed": 0, "": [Path("S")]}),
        ("gate S --seed 4", "gate", {"seed": 4}),
        (
            "rigs S --occluders T",
            "rigs",
            {"rigs": 30, "photos": 4, "variants": 2, "seed": 0, "modify": RIG_MODIFICATIONS},
        ),
        ("rigs S --occluders T --modify blur=2", "rigs", {"modify": ("blur=2",), "": Path("S")}),
        ("track S", "track", {"frames": 300, "seed": 0, "intrinsics": "given"}),
        ("track S --frames 7 --seed 2 --intrinsics withheld", "track", {"frames": 7, "seed": 2}),
    ],
)
def test_every_bench_is_handed_its_flags_and_writes_what_it_returns(
    splatfix, monkeypatch, tmp_path, flags, bench, asked
):
    """And says on which processor: without that times mean nothing."""
    rows = [{"part": "whole", "seconds": 1.23456}]
    outcome = {"with_matches": {"scenes": 1}, "photometric": {}, "tracked": {}} if bench == "gate" else rows
    left_out = {"track": "per_frame", "rigs": "per_query"}.get(bench)
    outcome = {"localized": 7, left_out: []} if left_out else outcome
    given: dict = {}

    def run(*positional, progress, **options):
        given.update(options | {"": positional[0] if positional else None})
        progress(1, 2)
        return outcome

    monkeypatch.setattr(f"service.bench.{bench}.run", run)
    monkeypatch.setattr("service.bench.ablation.table", lambda rows: f"| {rows[0]['part']} |")
    code, told, complaints = splatfix("bench", *flags.split(), "--json", tmp_path / "o.json")
    assert code == 0
    assert given | asked == given
    assert json.loads((tmp_path / "o.json").read_text()) == outcome
    assert re.search(
        {"gate": "scenes +1", "track": "localized +7", "rigs": "localized +7", "ablation": r"\| whole \|"}.get(
            bench, "1.235"
        ),
        told,
    )
    assert str(left_out) not in told
    assert "core" in complaints


@pytest.mark.parametrize(
    ("flags", "asked"),
    [
        ("S", {"seconds": 40, "sessions": 1, "cores": 1, "seed": 0, "withheld": False, "odometry": True}),
        ("S --seconds 10 --sessions 4 --cores 2 --seed 3", {"seconds": 10, "sessions": 4, "cores": 2, "seed": 3}),
        ("S --intrinsics withheld --no-odometry", {"withheld": True, "odometry": False}),
    ],
)
def test_the_live_bench_is_handed_its_flags_and_tells_of_each_session(splatfix, monkeypatch, tmp_path, flags, asked):
    given: dict = {}

    def run(folder, *, progress, cache_dir, **options):
        given.update(options)
        progress(1, 2)
        return {"service_cpu_share": 0.25, "sessions": [{"right": 0.5}, {"right": 0.75}]}

    monkeypatch.setattr("service.bench.live.run", run)
    code, told, complaints = splatfix("bench", "live", *flags.split(), "--json", tmp_path / "o.json")
    assert code == 0
    assert given | asked == given
    assert json.loads((tmp_path / "o.json").read_text())["sessions"] == [{"right": 0.5}, {"right": 0.75}]
    assert re.search(r"service_cpu_share +0\.25", told)
    assert re.search(r"session 0 right +0\.5", told)
    assert re.search(r"session 1 right +0\.75", told)
    assert "sessions" not in told
    assert "core" in complaints
    assert (
        splatfix("bench", "live", "S", "--seconds", "9")[0] == splatfix("bench", "live", "S", "--sessions", "5")[0] == 2
    )


@pytest.mark.parametrize(
    ("flags", "asked"),
    [
        ("S", {"layout": "auto", "estimator": "view_index", "start": "none", "trials": 1, "seed": 0, "data": None,
               "intrinsics": "given", "cameras": "given", "modify": (), "modify_scene": (), "background": "scene"}),
        ("S --data D --modify blur=4 --modify gain=2 --modify-scene dark=0.5 --occluders O --trials 3 --seed 2",
         {"data": Path("D"), "modify": ("blur=4", "gain=2"), "modify_scene": ("dark=0.5",), "occluders": Path("O"),
          "trials": 3, "seed": 2}),
        ("S --intrinsics withheld --cameras ignored --start hard --estimator mc_do --background white",
         {"intrinsics": "withheld", "cameras": "ignored", "start": "hard", "estimator": "mc_do",
          "background": "white"}),
    ],
)  # fmt: skip
def test_the_bench_of_photos_is_handed_its_flags_and_says_all_but_the_photos(
    splatfix, monkeypatch, tmp_path, flags, asked
):
    given: dict = {}

    def run(folder, *, progress, **options):
        given.update(options)
        progress(1, 2)
        return {"queries": 3, "success_asked": 0.667, "per_query": ["a", "b", "c"]}

    monkeypatch.setattr("service.bench.localize.run", run)
    limits = ("--budget-s", "1.5", "--budget-renders", "9")
    code, told, complaints = splatfix("bench", "localize", *flags.split(), *limits, "--json", tmp_path / "o.json")
    assert code == 0
    assert given | asked == given
    assert (given["budget"].seconds, given["budget"].renders) == (1.5, 9)
    assert json.loads((tmp_path / "o.json").read_text())["per_query"] == ["a", "b", "c"]
    assert re.search(r"queries +3", told)
    assert "per_query" not in told
    assert "core" in complaints


def test_the_bench_of_coverage_prints_a_row_a_scene_and_one_for_all(splatfix, monkeypatch, tmp_path):
    row = {"seconds": 12.0, "count": 8, "found": 6, "brier": 0.125}
    found = {"scenes": [{"scene": "room", **row}], "all": {**row, "count": 9}}

    def run(scenes, progress, cache_dir):
        assert scenes == [Path("S"), Path("T")]
        progress("room", 1, 2)
        return found

    monkeypatch.setattr("service.bench.coverage.run", run)
    code, told, complaints = splatfix("bench", "coverage", "S", "T", "--json", tmp_path / "o.json")
    assert code == 0
    assert json.loads((tmp_path / "o.json").read_text()) == found
    assert re.search(r"room .* 8 .* 6 .*0\.125", told)
    assert re.search(r"all .* 9 .* 6 .*0\.125", told)
    assert "core" in complaints


def test_an_ablation_needs_two_scenes(splatfix):
    code, _, complaint = splatfix("bench", "ablation", "S")
    assert code == 2
    assert "needs two scenes" in complaint


def test_a_scene_is_registered_by_photos_and_results_are_in_metres(splatfix, room, tmp_path):
    """Of five photos one has a wrong position; the frame is turned about z by a quarter, 3 m a unit."""
    scene = tmp_path / "room"
    shutil.copytree(room, scene)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    lines = ["name,x,y,z"]
    for number, (angle, height) in enumerate([(1.0, 0.1), (0.6, 0.2), (0.0, 0.0), (2.6, 0.1), (4.0, 0.3)]):
        pose = moved(pose_at(angle, height), np.array([0.05, 0.0, 0.04, 0.0, 0.0, 0.0]))
        told = json.dumps({"world_from_camera": pose.world_from_camera.tolist()})
        render(room, told, tmp_path / f"{number}.png")
        x, y, z = 3 * turn @ pose.position_in_world + [10, 20, 30] + ([0, 5, 0] if number == 3 else [0, 0, 0])
        lines.append(f"{number}.png,{x},{y},{z}")
    (tmp_path / "places.csv").write_text("\n".join(lines))
    code, told, errors = splatfix("scenes", "register", scene, "--places", tmp_path / "places.csv", "--json")
    assert code == 0, errors
    found = json.loads(told)
    assert [(r["name"], r["used"]) for r in found["residuals"]] == [(f"{n}.png", n != 3) for n in range(5)]
    assert found["metres_per_unit"] == pytest.approx(3, rel=0.02)  # seen: 0.002
    assert np.array(found["target_from_world"])[:3, :3] / 3 == pytest.approx(turn, abs=0.03)
    code, told, _ = splatfix("localize", tmp_path / "1.png", "--scene", scene, "--json")
    placed = json.loads(told)[0]["registered"]
    expected = [float(v) for v in lines[2].split(",")[1:]]
    assert placed["target_from_camera"]["translation"] == pytest.approx(expected, abs=0.1)
    assert placed["revision"] == 1
    assert 0 < placed["sigma_m"] < 1
    code, told, _ = splatfix("scenes", "register", scene, "--undo")
    assert "not registered any more" in told


def test_a_scene_is_registered_by_a_length_and_a_floor(splatfix, room, tmp_path):
    scene = tmp_path / "room"
    shutil.copytree(room, scene)
    points = {
        "lengths": [{"from_in_world": [0, 0, 0], "to_in_world": [0, 2, 0], "metres": 5}],
        "floor": [[0, 0, -1], [1, 0, -1], [0, 1, -1]],
    }
    code, told, errors = splatfix("scenes", "register", scene, "--points", json.dumps(points))
    assert code == 0, errors
    assert "determined: scale, up" in told
    assert "metres per unit: 2.5" in told
    assert (scene / "registration.json").is_file()
    code, _, errors = splatfix("scenes", "register", scene)
    assert code == 2
    assert "nothing to register by" in errors


@pytest.mark.ci
def test_a_scene_is_registered_by_another_one(splatfix, room, tmp_path):
    """By renders of the room turned about z and twice as large, in the room itself, whose unit is 3 m."""
    scene, other = tmp_path / "turned", tmp_path / "room"
    shutil.copytree(room, scene)
    shutil.copytree(room, other)
    similarity = np.array([[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, 0.0, 5.0], [0.0, 0.0, 2.0, -3.0], [0.0, 0.0, 0.0, 1.0]])
    (scene / "scene.json").write_text(json.dumps({"world_from_scene": similarity.tolist()}))
    code, _, errors = splatfix("scenes", "register", scene, "--onto", other, "--count", 3)
    assert code == 2
    assert "neither registered, nor is its unit known" in errors
    length = {"from_in_world": [0, 0, 0], "to_in_world": [1, 0, 0], "metres": 3}
    assert splatfix("scenes", "register", other, "--points", json.dumps({"lengths": [length]}))[0] == 0
    code, told, errors = splatfix("scenes", "register", scene, "--onto", other, "--count", 3, "--json")
    assert code == 0, errors
    found = np.array(json.loads(told)["target_from_world"])
    assert found @ similarity == pytest.approx(np.diag([3.0, 3.0, 3.0, 1.0]), abs=0.05)


def test_a_server_whose_port_another_one_has_taken_since_ends_with_a_message(caplog: pytest.LogCaptureFixture) -> None:
    """Both were bound before either listened."""
    ended: list[str] = []

    async def app(scope: dict, receive: Callable, send: Callable) -> None:
        while (message := (await receive())["type"]) != "lifespan.shutdown":
            await send({"type": f"{message}.complete"})
        ended.append(message)
        await send({"type": f"{message}.complete"})

    with _listener("127.0.0.1", 0) as first, _listener("127.0.0.1", first.getsockname()[1]) as second:
        first.listen()
        server = GracefulServer(uvicorn.Config(app, log_config=None), lambda: None)
        with pytest.raises(SystemExit, match="1"):
            server.run(sockets=[second])
    assert "can't listen there: Address already in use" in caplog.text
    assert ended == ["lifespan.shutdown"]
