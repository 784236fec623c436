"""What the command line prints and decides, part by part, on planted values: no scene is loaded, no process started."""

from __future__ import annotations

import csv
import io
import json
import shlex
import socket
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_service import orbit
from PIL import ExifTags, Image
from rich.console import Console
from test_exports import POSE, result

from service.cli import diagnostics, scene_facts, server, terminal
from service.cli.example_request import curl_line, example_photo
from service.cli.result_tables import frame_line, photo_line, write_frame_table, write_photo_table
from service.errors import InvalidRequest
from service.jobs.model import SequenceFrame
from service.results import Reason, StageTiming, Status
from service.types import Camera, Intrinsics, NamedCamera
from service.web.api_keys import KeyRing
from service.web.key_file import add_key
from service.web.schemas.conversion import frame_out, timing_out
from service.web.schemas.job_results import RankedScene
from service.web.settings import Settings

# ------------------------------------------------------------------ doctor


@pytest.mark.parametrize(
    ("info", "loads", "told"),
    [
        (
            "processor: 0\nmodel name: Old\nflags: fma\n\nprocessor : 1\nmodel name : Xeon 9\nflags : fpu avx2 fma\n",
            (1.24, 0.5),
            "Xeon 9, 6 cores (avx2 fma), load 1.2, 0.5",
        ),
        ("model name : Neoverse\nFeatures : fp asimd sve\n", (), "Neoverse, 6 cores (asimd sve), load unknown"),
        ("model name : 486\nflags : fpu\n", (0.0,), "486, 6 cores (no SIMD known), load 0.0"),
        (None, (), "some arch, 6 cores (no SIMD known), load unknown"),
    ],
)
def test_a_processor_is_described_by_name_cores_simd_and_load(
    info: str | None, loads: tuple[float, ...], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "cpuinfo"
    if info is not None:
        file.write_text(info)
    monkeypatch.setattr(diagnostics, "Path", lambda path: file if path == "/proc/cpuinfo" else Path(path))
    monkeypatch.setattr(diagnostics, "load_averages", lambda: loads)
    monkeypatch.setattr(diagnostics, "os", SimpleNamespace(cpu_count=lambda: 6))
    monkeypatch.setattr(diagnostics, "platform", SimpleNamespace(processor=lambda: "", machine=lambda: "some arch"))
    assert diagnostics.processor() == told


@pytest.mark.parametrize(
    ("driver", "listed", "gsplat", "found"),
    [
        (False, "", True, (False, "no NVIDIA driver; rendering is on the CPU")),
        (True, "GPU 0: H200", False, (False, "GPU 0: H200; gsplat is not installed")),
        (True, "", False, (False, "none; gsplat is not installed")),
        (True, "", True, (False, "none")),
        (True, "GPU 0: H200\n", True, (True, "GPU 0: H200")),
    ],
)
def test_a_gpu_needs_a_driver_a_device_and_gsplat(
    driver: bool, listed: str, gsplat: bool, found: tuple[bool, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnostics.shutil, "which", lambda tool: f"/usr/bin/{tool}" if driver else None)
    monkeypatch.setattr(diagnostics.subprocess, "run", lambda *_, **__: SimpleNamespace(stdout=listed))
    monkeypatch.setattr(diagnostics.importlib.util, "find_spec", lambda name: gsplat or None)
    told = diagnostics._gpu()
    assert (told.ok, told.detail) == found
    assert not told.needed  # the CPU does as well


def test_any_error_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails() -> str:
        raise ArithmeticError("a red Gaussian came out green")

    told = diagnostics._tried("renderer x", fails)
    assert (told.subject, told.ok, told.needed) == ("renderer x", False, True)
    assert told.detail == "ArithmeticError: a red Gaussian came out green"
    told = diagnostics._tried("renderer x", lambda: "right")
    assert told.ok
    assert told.detail.startswith("right (0.0 s)")
    missing = diagnostics._package("a-package-that-nobody-has", "dreams")
    assert (missing.ok, missing.detail) == (False, "a-package-that-nobody-has is not installed")
    assert diagnostics._package("rich", "colours").ok
    paths = {"chromium-browser": "/usr/bin/chromium-browser"}
    monkeypatch.setattr(diagnostics.shutil, "which", paths.get)
    assert (diagnostics._browser().ok, diagnostics._browser().detail) == (True, "/usr/bin/chromium-browser")
    paths.clear()
    assert (diagnostics._browser().ok, diagnostics._browser().needed) == (False, False)


@pytest.mark.parametrize(("error", "passes"), [(0.04, True), (0.06, False)])
def test_a_renderer_passes_if_a_red_gaussian_is_red(
    error: float, passes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight-bit colours and an opacity of almost 1 leave 0.05."""
    image = np.full((64, 64, 3), 0.5)
    image[32, 32] = [1.0 - error, 0.0, error]
    drawn = SimpleNamespace(create=lambda scene: SimpleNamespace(render=lambda cameras: [SimpleNamespace(rgb=image)]))
    monkeypatch.setattr(diagnostics.RASTERIZERS, "load", lambda name: drawn)
    if passes:
        assert diagnostics._try_renderer("cpu") == "a test image is right"
    else:
        with pytest.raises(ArithmeticError, match="a red Gaussian came out as"):
            diagnostics._try_renderer("cpu")


@pytest.mark.parametrize(("count", "passes"), [(20, True), (19, False)])
def test_a_matcher_passes_if_an_image_matches_itself(count: int, passes: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    matcher = SimpleNamespace(name="m", extract=lambda image, number: image, match=lambda a, b: [0] * count)
    monkeypatch.setattr(diagnostics.MATCHERS, "load", lambda name: SimpleNamespace(create=lambda: matcher))
    if passes:
        assert diagnostics._try_matcher().startswith("m has its weights")
    else:
        with pytest.raises(ArithmeticError, match="at 19 points only"):
            diagnostics._try_matcher()


# ------------------------------------------------------------------ options


def test_json_is_given_as_text_or_as_a_file(tmp_path: Path) -> None:
    assert terminal.parsed_option("", "prior") is None
    assert terminal.parsed_option('  {"a": 1}', "prior") == {"a": 1}
    assert terminal.parsed_option("[1, 2]", "times") == [1, 2]
    file = tmp_path / "a.json"
    file.write_text('{"b": 2}')
    assert terminal.parsed_option(str(file), "prior") == {"b": 2}
    with pytest.raises(InvalidRequest) as refused:
        terminal.parsed_option("{bad", "times")
    assert "times" in str(refused.value)
    with pytest.raises(InvalidRequest, match="No such file") as refused:
        terminal.parsed_option(str(tmp_path / "none.json"), "prior")
    assert "none.json" in str(refused.value)


def test_scenes_are_named_by_their_stems() -> None:
    found = terminal.scene_arguments(["a/studio.ply", "b/chair=data/x", "fox="])
    assert found == {
        "studio": (Path("a/studio.ply"), None),
        "chair": (Path("b/chair"), Path("data/x")),
        "fox": (Path("fox"), None),
    }
    with pytest.raises(InvalidRequest, match="'studio'"):
        terminal.scene_arguments(["a/studio.ply", "b/studio=d"])
    both = ["s=day", "s=night", "s"]
    assert list(terminal.scene_arguments(both, named_by_photos=True)) == ["s-day", "s-night", "s"]


def test_numbers_have_four_digits_and_other_values_are_as_they_are() -> None:
    assert [terminal.short(value) for value in (1.23456, 123456, "1.23456", None)] == [
        "1.235",
        "123456",
        "1.23456",
        "None",
    ]


def test_json_goes_to_a_file_only_where_one_is_named(tmp_path: Path) -> None:
    terminal.write_json(None, {"a": 1})
    assert not list(tmp_path.iterdir())
    terminal.write_json(tmp_path / "a.json", {"a": 1})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": 1}


# ------------------------------------------------------------------ results as text


def test_a_photo_has_a_line_with_its_scene_where_several_were_searched() -> None:
    one = result()
    position = " ".join(f"{value:.4f}" for value in POSE.position_in_world)
    line = photo_line("a.jpg", one.model_copy(update={"hint": ""}))
    assert line.startswith(f"a.jpg: localized, score 0.90, position {position}, quaternion_wxyz ")
    quaternion = np.array(line.split("quaternion_wxyz ")[1].split(), float)
    assert np.linalg.norm(quaternion) == pytest.approx(1, abs=1e-3)
    assert photo_line("a.jpg", one.model_copy(update={"hint": "Go nearer."})) == f"{line}. Go nearer."
    told = one.model_copy(update={"search_summary": "No feature matches.", "hint": "Go nearer."})
    assert photo_line("a.jpg", told) == f"{line}. No feature matches. Go nearer."
    rank = RankedScene(id="room", inliers=9)
    several = one.model_copy(update={"hint": "", "scene_ranking": [rank]})
    assert photo_line("a.jpg", several) == line.replace("localized", "localized in room", 1)


def frames(count: int, lost: tuple[int, ...] = ()) -> list:
    status = [Status.NOT_LOCALIZED if k in lost else Status.LOCALIZED for k in range(count)]
    answers = [
        SequenceFrame(k, f"{k}.jpg", 0.25 * k, status[k], Reason.VERIFIED, 0.9, k > 0, POSE, 1e-4 * np.eye(6))
        for k in range(count)
    ]
    return [frame_out(answer) for answer in answers]


def test_a_frame_says_when_it_was_searched_for_anew() -> None:
    first, second = frames(2)
    assert frame_line(first).startswith("0.000 s, 0.jpg: localized, score 0.90, position ")
    assert frame_line(first).endswith(", searched")
    assert frame_line(second).startswith("0.250 s, 1.jpg: localized")
    assert "searched" not in frame_line(second)


def test_tables_have_a_row_for_each_photo_and_time_in_milliseconds(tmp_path: Path) -> None:
    spent = [timing_out(StageTiming(stage, wall, 9.0)) for stage, wall in (("match", 0.25), ("solve", 1.00004))]
    write_photo_table(tmp_path / "photos.csv", [("a,b.jpg", result().model_copy(update={"timings": spent}))])
    (row,) = csv.DictReader((tmp_path / "photos.csv").read_text().splitlines())
    assert row["photo"] == "a,b.jpg"
    assert (row["scene"], row["status"], row["score"], row["inliers"]) == ("room", "localized", "0.9", "100")
    assert float(row["latency_ms"]) == 1250.0
    assert [float(row[name]) for name in "xyz"] == pytest.approx(POSE.position_in_world.tolist())
    write_frame_table(tmp_path / "frames.csv", frames(3, lost=(1,)))
    rows = list(csv.DictReader((tmp_path / "frames.csv").read_text().splitlines()))
    assert [row["followed"] for row in rows] == ["0", "1", "1"]
    assert "smoothed" not in rows[0]
    write_frame_table(tmp_path / "frames.csv", frames(3, lost=(0,)), smooth=True)
    # Before the first photo that was localized there is nothing to interpolate from.
    assert [row["smoothed"] for row in csv.DictReader((tmp_path / "frames.csv").read_text().splitlines())] == [
        "",
        *["smoothed"] * 2,
    ]


# ------------------------------------------------------------------ facts of a scene


def facts(**changes: Any) -> dict[str, Any]:
    index = {"placed_by": "the scene itself", "views": 40, "coverage": 0.875}
    expected = {"title": "upper bound", "found": 0.934, "median_rotation_deg": 0.123, "median_position_units": 0.02}
    searched = {"candidates": 300, "good_candidates": 90, "typical_distance": 2.3456, "interior": True}
    return {
        "name": "Room", "id": "room", "format": "ply", "render_mode": "default", "gaussians": 1234567, "sh_degree": 3,
        "memory_bytes": {"scene": 2.5e8, "renderer": 4.6e7}, "bounds": [[-1.0, -2.0, -3.0], [1.0, 2.0, 3.14159]],
        "middle_98_percent": [[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]], "extent": 5.0,
        "floaters": {"found": 0, "veil": 0.0, "left_out": False}, "up": [0, 0, 1.0],
        "metres_per_unit": 0.5, "on_earth": True, "registration": 3, "training_cameras": 12,
        "training_size": {"px": 800, "source": "manifest"}, "index": index | searched, "sha256": "0" * 64,
        "warnings": ["first", "second"], "background": [0, 0, 0], "frames": [],
        "expected_accuracy": expected,
        "training_photos": {
            "photos": 12, "points": 3456, "bytes": 1.25e6, "reprojection_px": 0.256, "poses_refined": False,
            "distance_without": 0.0123, "distance_with": 0.00456,
        },
    } | changes  # fmt: skip


def test_facts_are_told_with_units() -> None:
    lines = scene_facts.as_lines(facts())
    assert lines["name"] == "Room (id room)"
    assert lines["format"] == "ply"
    assert lines["gaussians"] == "1,234,567, SH degree 3"
    assert lines["memory"] == "250 MB, and 46 MB for the renderer"
    assert lines["bounds"] == "(-1, -2, -3) to (1, 2, 3.142)"
    assert lines["middle 98 %"] == "(0, 0, 0) to (3, 4, 0); diagonal 5"
    assert lines["floaters"] == "none"
    # 0.02 units of half a metre.
    assert lines["expected accuracy"] == "median 0.12 degrees, 0.01 m; 93% of photos are found (upper bound)"
    assert lines["up"] == "(0, 0, 1)"
    assert lines["metres per unit"] == "0.5"
    assert (lines["geo anchor"], lines["registration"]) == ("yes", "revision 3")
    frames = [{"name": name, "decided_by": "transforms.json", "verified": name == "a"} for name in "ab"]
    named = scene_facts.as_lines(facts(frames=frames))
    assert (named["frame 'a'"], named["frame 'b'"]) == ("transforms.json", "transforms.json (unverified)")
    assert lines["training size"] == "800 px (from the manifest)"
    placed = "40 views, placed by the scene itself (an interior; 90 good ones of 300 tried; typical distance 2.35)"
    assert lines["index"] == placed
    assert lines["coverage"].startswith("87.5%")
    assert (lines["warning 1"], lines["warning 2"]) == ("first", "second")


@pytest.mark.parametrize(
    ("found", "left_out", "cameras", "told"),
    [
        (1234, True, 12, "1,234, of optical depth 0.75 before the content: left out when photos are localized"),
        (1234, False, 12, "too thin a veil"),
        (1234, True, 0, "not looked for without training cameras"),
        (0, False, 12, "none"),
    ],
)
def test_floaters_are_told_with_what_becomes_of_them(found: int, left_out: bool, cameras: int, told: str) -> None:
    changes = {"floaters": {"found": found, "veil": 0.75, "left_out": left_out}, "training_cameras": cameras}
    assert told in scene_facts.as_lines(facts(**changes))["floaters"]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({}, "training photos are localized 0.012 units off without them, 0.0046 with them"),
        ({"poses_refined": True}, "the camera file's poses are not those of the scene"),
        ({"distance_with": None}, "no photo was localized by them"),
    ],
)
def test_a_digest_of_training_photos_is_told_with_its_effect(changes: dict[str, Any], told: str) -> None:
    line = scene_facts.as_lines(facts(training_photos=facts()["training_photos"] | changes))["training photos"]
    assert line.startswith("3,456 points of 12 photos, 1.2 MB; they agree within 0.26 px; ")
    assert told in line


def test_what_is_unknown_is_told_as_such() -> None:
    by_cameras = {"placed_by": "training cameras", "views": 12, "coverage": 0.5}
    changes = {
        "up": None,
        "metres_per_unit": None,
        "on_earth": False,
        "registration": None,
        "expected_accuracy": None,
        "training_photos": None,
        "render_mode": "antialiased",
        "warnings": [],
    }
    size = {"px": None, "source": "unknown: each photo's own, within 640 to 960"}
    lines = scene_facts.as_lines(facts(**changes, index=by_cameras, training_size=size))
    assert lines["up"] == lines["metres per unit"] == "unknown"
    assert lines["training photos"] == "no digest of them: splatfix scenes index --photos"
    assert (lines["geo anchor"], lines["registration"]) == ("no", "none")
    assert lines["format"] == "ply, antialiased"
    assert lines["expected accuracy"].startswith("not measured")
    assert lines["training size"] == size["source"]
    assert lines["index"] == "12 views, placed by training cameras"
    assert not any(label.startswith("warning") for label in lines)


# ------------------------------------------------------------------ the example request

LENS = Intrinsics(160, 120, 200.0, 201.0, 80.0, 60.0)


def photo_file(path: Path, size: tuple[int, int] = (160, 120), focal_mm: float | None = None) -> Path:
    exif = Image.Exif()
    if focal_mm:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal_mm
    path.parent.mkdir(exist_ok=True, parents=True)
    Image.new("RGB", size).save(path, exif=exif)
    return path


def camera_named(name: str) -> NamedCamera:
    return NamedCamera(name, Camera(LENS, orbit(0.1)))


def test_an_example_is_a_photo_that_the_scene_was_not_trained_with(tmp_path: Path) -> None:
    assert example_photo(tmp_path, []) is None
    trained = photo_file(tmp_path / "images" / "a.jpg")
    (tmp_path / "images" / "0.txt").write_text("no photo")
    (tmp_path / "0.png").mkdir()  # a folder of such a name
    assert example_photo(tmp_path, [camera_named("a.jpg")]) == trained
    other = photo_file(tmp_path / "images" / "b.JPG")
    assert example_photo(tmp_path, [camera_named("a.jpg")]) == other
    assert example_photo(tmp_path, []) == trained


def test_an_example_request_has_what_the_service_could_not_know(tmp_path: Path) -> None:
    plain = shlex.split(curl_line("http://h", None, []))
    assert plain == ["curl", "-H", "Prefer: wait=30", "-F", "photo=@PHOTO.jpg", "http://h/localize"]
    lonely = photo_file(tmp_path / "a.jpg")
    assert shlex.split(curl_line("http://h", lonely, [])) == plain  # a file is no folder of photos
    told = shlex.split(curl_line("http://h", tmp_path, [camera_named("z.jpg")], scene_id="s"))
    fields = [part for part in told if "=" in part]
    given = {key: value for key, _, value in (field.partition("=") for field in fields)}
    assert (given["photo"], given["scene"]) == (f"@{lonely}", "s")
    assert json.loads(given["intrinsics"]) == {
        "width": 160, "height": 120, "fx": 200, "fy": 201, "cx": 80, "cy": 60,
    }  # fmt: skip
    # Of another size it is another camera's; EXIF has the focal length; no camera is known; it is no photo at all.
    other = NamedCamera("z.jpg", Camera(replace(LENS, width=161), orbit(0.1)))
    assert "intrinsics" not in curl_line("http://h", tmp_path, [other])
    assert "intrinsics" not in curl_line("http://h", tmp_path, [])
    photo_file(tmp_path / "a.jpg", focal_mm=28)
    assert "intrinsics" not in curl_line("http://h", tmp_path, [camera_named("z.jpg")])
    lonely.write_bytes(b"no JPEG")
    assert "intrinsics" not in curl_line("http://h", tmp_path, [camera_named("z.jpg")])


def test_an_example_request_leaves_a_keys_variable_to_the_shell() -> None:
    assert curl_line("http://h", None, [], key="$SPLATFIX_KEY").startswith(
        'curl -H "Authorization: Bearer $SPLATFIX_KEY" -H '
    )


# ------------------------------------------------------------------ serve


class Ready(Exception):
    """Everything is decided, and the server would start."""


@pytest.mark.parametrize(
    ("port", "folder", "kept"),
    [(8123, None, "port-8123"), (8123, "mine", "mine"), (0, None, None), (0, "mine", "mine")],
)
def test_data_are_kept_by_port_unless_a_folder_is_named(
    port: int, folder: str | None, kept: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A random port is never the same again: nothing would be found under it."""
    decided = []

    def create_app(settings: Settings, **_: Any) -> None:
        decided.append(settings)
        raise Ready

    monkeypatch.setattr(server, "DATA_HOME", tmp_path)
    monkeypatch.setattr(server, "create_app", create_app)
    monkeypatch.setattr(server, "_listener", lambda host, port: socket.socket())
    given = Settings(
        scenes=[], port=port, data_dir=tmp_path / folder if folder else None, keys_file=tmp_path / "none.json",
        log_json=False,
    )  # fmt: skip
    with pytest.raises(Ready):
        server.run(given, Console(file=io.StringIO()), Console(file=io.StringIO()))
    assert decided[0].data_dir == (tmp_path / kept if kept else None)


@pytest.mark.parametrize(
    ("lasting", "open_to_all", "host", "made"),
    [
        (False, False, "127.0.0.1", False),
        (False, False, "0.0.0.0", True),  # whoever can reach it could use it
        (False, True, "0.0.0.0", False),
        (True, False, "0.0.0.0", False),
        (True, False, "127.0.0.1", False),
    ],
)
def test_a_key_is_made_where_anybody_could_come_in_without_one(
    lasting: bool, open_to_all: bool, host: str, made: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, temporary = [], []

    def create_app(settings: Settings, keys: Any) -> None:
        given.append(keys)
        raise Ready

    class Ring(KeyRing):
        def make_temporary(self, name: str, role: Any) -> str:
            temporary.append(role)
            return super().make_temporary(name, role)

    monkeypatch.setattr(server, "KeyRing", Ring)

    monkeypatch.setattr(server, "create_app", create_app)
    monkeypatch.setattr(server, "_listener", lambda host, port: socket.socket())
    file = tmp_path / "keys.json"
    if lasting:
        add_key(file, "ann", "admin")
    settings = Settings(
        scenes=[], port=0, host=host, open=open_to_all, keys_file=file, data_dir=tmp_path / "data", log_json=False
    )
    with pytest.raises(Ready):
        server.run(settings, Console(file=io.StringIO()), Console(file=io.StringIO()))
    assert bool(given[0]) is (lasting or made)
    assert bool(KeyRing(file)) is lasting  # of this run only
    assert bool(temporary) is made


def announced(scenes: list[tuple[str, str]], key: str = "", shell_key: str = "", **changes: Any) -> tuple[str, str]:
    readiness = SimpleNamespace(
        pending=[], failed=changes.pop("failed", []), ready=any(state == "ready" for _, state in scenes)
    )
    engine = SimpleNamespace(
        readiness=lambda: readiness,
        scenes=lambda: [SimpleNamespace(id=name, state=state) for name, state in scenes],
        contents=lambda name: SimpleNamespace(cameras=()),
    )
    state = SimpleNamespace(engine=engine, scene_store=SimpleNamespace(find=lambda name: None))
    application: Any = SimpleNamespace(state=SimpleNamespace(app_state=state))
    out, err = io.StringIO(), io.StringIO()
    settings = Settings(scenes=[], port=8123, host="127.0.0.1", **changes)
    started: Any = SimpleNamespace(started=True)
    consoles = Console(file=out), Console(file=err)
    server._announce(started, application, settings, (key, shell_key), *consoles, browser=False)
    return out.getvalue(), err.getvalue()


def test_the_start_is_announced_with_addresses_and_an_example() -> None:
    told, _ = announced([("attic", "failed"), ("room", "ready")], failed=["attic: no such file"])
    assert "is ready:" in told
    assert "http://127.0.0.1:8123/\n" in told
    assert "/viewer/" in told
    assert "Try it:\n  curl " in told
    assert "scene=room" in told  # of two scenes it has to be named
    assert "key" not in told
    told, complaints = announced([("room", "ready")], failed=["attic: no such file"], viewer=False)
    assert "not usable: attic: no such file" in complaints
    assert "scene=" not in told
    assert "viewer" not in told
    told, _ = announced([])
    assert "runs, but has no usable scene:" in told
    assert "curl" not in told


def test_a_key_of_this_run_is_in_the_addresses_and_a_lasting_one_is_not_known() -> None:
    told, _ = announced([("room", "ready")], key="sfx_a", shell_key="sfx_a")
    assert "/?key=sfx_a\n" in told
    assert "/viewer/?key=sfx_a\n" in told
    assert "made for this run only" in told
    assert "Try it:" in told
    assert "Bearer sfx_a" in told
    told, _ = announced([("room", "ready")], shell_key="$SPLATFIX_KEY")
    assert "?key" not in told
    assert "Try it (SPLATFIX_KEY: a key from `splatfix keys add NAME`):" in told
    assert "made for this run" not in told


def test_an_address_that_is_taken_is_refused_with_its_port() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InvalidRequest, match="can't listen there") as refused:
            server._listener("127.0.0.1", port)
        assert f"127.0.0.1:{port}" in str(refused.value)
    if socket.has_ipv6:
        with server._listener("::1", 0) as found:
            assert found.family is socket.AF_INET6
