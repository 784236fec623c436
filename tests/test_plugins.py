"""Plug-ins from the package's folder, from a folder that a setting names, and from installed distributions."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_room import INTRINSICS, training_poses, write_room

from service import jit
from service.cli.diagnostics import plugin_findings
from service.errors import BackendMissing, InvalidRequest, UnknownName
from service.estimators import ESTIMATORS
from service.geometry import pose_distance
from service.matchers import MATCHERS
from service.photos.images import encode_image
from service.plugins import BUILT_IN, FOLDER, PLUGINS_DIR, PluginRegistry
from service.scene_formats import SCENE_FORMATS, load_scene
from service.scene_formats.discovery import find_scenes
from service.scene_formats.formats import is_scene_file
from service.types import Pose
from service.web.schemas import resources
from service.web.settings import Settings

ROOT = Path(__file__).parents[1]

MATCHER = """
def create():
    return "a matcher"
"""

NPZ_FORMAT = """
import numpy as np

from service.scene_formats.gaussians import RawGaussians

SUFFIXES = (".npz",)


def accepts(head, suffix):
    return suffix in SUFFIXES


def read(path):
    with np.load(path) as arrays:
        return RawGaussians(**{name: arrays[name] for name in ("means", "quats", "scales", "opacities", "sh")})
"""

NEAREST_CAMERA = """
from dataclasses import dataclass

from service.results import IterationRecord


@dataclass(frozen=True)
class Options:
    number: int = 0


def run(query, tools, options):
    yield IterationRecord("guess", tools.scene.cameras[options.number].camera.pose)
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install a distribution as pip does: modules, and a dist-info with entry points, in a folder on sys.path."""

    def installed(name: str, group: str, entries: dict[str, str], **modules: str) -> None:
        site = tmp_path / "site-packages" / name
        site.mkdir(parents=True)
        monkeypatch.syspath_prepend(site)
        for module, source in modules.items():
            (site / f"{module}.py").write_text(source)
        info = site / f"{name.replace('-', '_')}-1.2.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
        lines = [f"{entry} = {module}" for entry, module in entries.items()]
        (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines, ""]))

    return installed


@pytest.fixture
def registry(tmp_path, monkeypatch):
    """Of a package made for the test, with a plug-in `own` and a part `shared`; and the folder to add others to."""
    package = tmp_path / "made" / "kinds_for_test"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "own.py").write_text(MATCHER)
    (package / "shared.py").write_text("VALUE = 1\n")
    added = tmp_path / "plugins" / "kinds_for_test"
    added.mkdir(parents=True)
    monkeypatch.syspath_prepend(package.parent)
    monkeypatch.setenv("SPLATFIX_PLUGINS_DIR", str(added.parent))
    for name in [name for name in sys.modules if name.split(".")[0] == "kinds_for_test"]:
        monkeypatch.delitem(sys.modules, name)
    __import__("kinds_for_test")
    return PluginRegistry("kinds_for_test", "splatfix.kinds_for_test", ("create",)), added


def test_an_installed_package_adds_a_matcher(install):
    install("added-matchers", "splatfix.matchers", {"added": "added_matcher"}, added_matcher=MATCHER)
    assert MATCHERS.names()[-1] == "added"
    assert "added_matcher" not in sys.modules  # listed without an import
    assert (MATCHERS.source("added"), MATCHERS.source("sift")) == ("added-matchers 1.2", "built-in")
    assert MATCHERS.missing("added") is None
    assert MATCHERS.load("added").create() == "a matcher"


def test_a_folder_adds_plugins_but_not_their_parts(registry):
    kinds, folder = registry
    (folder / "added.py").write_text(f"from kinds_for_test.part import VALUE\n{MATCHER}")
    (folder / "part.py").write_text("VALUE = 2\n")
    assert kinds.names() == ("own", "added")
    assert (kinds.source("own"), kinds.source("added")) == ("built-in", "plug-in folder")
    assert kinds.load("added").VALUE == 2


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import a_library_that_nobody_has\n", "ModuleNotFoundError: No module named 'a_library_that_nobody_has'"),
        ("raise SystemExit(3)\n", "SystemExit: 3"),
        ("def create(\n", "SyntaxError"),
        ("def other():\n    ...\n", "it doesn't define create"),
        ("def create():\n    ...\n\n\ndef missing():\n    return 1 / 0\n", "ZeroDivisionError"),
        ("def create():\n    ...\n\n\ndef missing():\n    return 'no antenna'\n", "no antenna"),
    ],
)
def test_a_broken_plugin_is_listed_with_its_reason_and_breaks_nothing_else(install, monkeypatch, source, reason):
    monkeypatch.delitem(sys.modules, "broken_matcher", raising=False)
    install("broken-matchers", "splatfix.matchers", {"broken": "broken_matcher"}, broken_matcher=source)
    assert reason in str(MATCHERS.missing("broken"))
    with pytest.raises(BackendMissing, match=r"matchers: 'broken' can't run here: .*") as refused:
        MATCHERS.load("broken")
    assert reason in str(refused.value)
    assert [m.__name__ for m in MATCHERS.available() if "broken" in m.__name__] == []
    assert MATCHERS.load("sift").create().name == "sift"
    listed = {matcher.name: matcher for matcher in resources.plugins(MATCHERS)}
    assert (listed["broken"].available, listed["broken"].source) == (False, "broken-matchers 1.2")
    assert reason in str(listed["broken"].reason)


def test_a_broken_file_of_the_folder_is_listed_with_its_reason(registry):
    kinds, folder = registry
    (folder / "broken.py").write_text("import a_library_that_nobody_has\n\n\ndef create():\n    ...\n")
    assert kinds.names() == ("own", "broken")
    assert "a_library_that_nobody_has" in str(kinds.missing("broken"))
    assert kinds.load("own").create() == "a matcher"


def test_a_package_can_not_take_a_built_in_name(install):
    install("false-sift", "splatfix.matchers", {"sift": "false_sift"}, false_sift=MATCHER)
    with pytest.raises(InvalidRequest, match=r"'sift' from the package false-sift 1\.2 .* taken \(built-in\)"):
        MATCHERS.load("sift")
    assert "false_sift" not in sys.modules


@pytest.mark.parametrize("name", ["own", "shared"])
def test_a_file_of_the_folder_can_not_take_the_name_of_a_module(registry, name):
    """Of a part neither: the import would find the part."""
    kinds, folder = registry
    (folder / f"{name}.py").write_text(MATCHER)
    with pytest.raises(InvalidRequest, match=rf"'{name}' from .*plugins.*{name}\.py has a name that is taken"):
        kinds.names()


def test_two_packages_can_not_share_a_name(install):
    for package in ("one-more", "yet-another"):
        install(package, "splatfix.estimators", {"magic": package.replace("-", "_")})
    with pytest.raises(InvalidRequest, match=r"'magic' from the package .* taken \((one-more|yet-another) 1\.2\)"):
        ESTIMATORS.names()


@pytest.mark.parametrize("name", ["this", "os", "..types", "view_index.Options", "../view_index", ""])
def test_a_name_that_is_not_listed_imports_nothing(name):
    before = set(sys.modules)
    with pytest.raises(UnknownName, match="known: "):
        ESTIMATORS.load(name)
    with pytest.raises(UnknownName):
        ESTIMATORS.missing(name)
    assert set(sys.modules) == before


def test_an_estimator_whose_options_have_no_schema_does_not_hide_the_others(install):
    source = "class Options:\n    ...\n\n\ndef run(query, tools, options):\n    ...\n"
    install("odd-options", "splatfix.estimators", {"odd": "odd_estimator"}, odd_estimator=source)
    listed = {e.name: e for e in resources.capabilities(Settings(viewer=False)).estimators}
    assert (listed["odd"].available, listed["odd"].options_schema) == (False, None)
    assert "JSON schema" in str(listed["odd"].reason)
    assert listed["view_index"].options_schema
    assert listed["view_index"].source == "built-in"


def test_doctor_lists_plugins_with_where_they_come_from(install, monkeypatch):
    entries = {"added": "doctors_matcher", "broken": "a_module_that_nobody_has"}
    install("doctors-matchers", "splatfix.matchers", entries, doctors_matcher=MATCHER)
    found = {finding.subject: finding for finding in plugin_findings()}
    assert (found["matcher added"].ok, found["matcher added"].detail) == (True, "available (from doctors-matchers 1.2)")
    assert not found["matcher broken"].ok
    assert not found["matcher broken"].needed
    assert found["matcher broken"].detail.startswith("ModuleNotFoundError")
    assert (found["matcher sift"].ok, found["matcher sift"].detail) == (True, "available")
    monkeypatch.setattr(PluginRegistry, "source", lambda self, name: FOLDER if name == "sift" else BUILT_IN)
    found = {finding.subject: finding.detail for finding in plugin_findings()}
    assert (found["matcher sift"], found["matcher added"]) == (f"available (from {PLUGINS_DIR})", "available")


def write_npz(path: Path, room: Path) -> None:
    scene = load_scene(room)
    arrays = {name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    np.savez(path, **arrays)


def test_a_scene_format_brings_its_suffix(install, tmp_path):
    room = write_room(tmp_path / "room")
    other = tmp_path / "other"
    other.mkdir()
    write_npz(other / "scene.npz", room)
    assert not is_scene_file(other / "scene.npz")
    install("npz-scenes", "splatfix.scene_formats", {"npz": "npz_scenes"}, npz_scenes=NPZ_FORMAT)
    assert find_scenes(tmp_path) == [other, room]
    assert load_scene(other).info.format == "npz_scenes"
    assert np.array_equal(load_scene(other).means, load_scene(room).means)
    assert SCENE_FORMATS.missing("npz") is None
    (tmp_path / "bare").mkdir()
    with pytest.raises(Exception, match=r"no scene file \((\.[\w.]+, )*\.ply, (\.[\w.]+, )*\.npz\)"):
        load_scene(tmp_path / "bare")


def test_a_reader_that_fails_does_not_keep_another_from_its_files(install, tmp_path):
    room = write_room(tmp_path / "room")
    failing = NPZ_FORMAT.replace("return suffix in SUFFIXES", "raise IndexError(head)")
    entries = {"a_failing": "failing_scenes", "npz": "npz_scenes_too"}
    install("scenes", "splatfix.scene_formats", entries, failing_scenes=failing, npz_scenes_too=NPZ_FORMAT)
    write_npz(tmp_path / "scene.npz", room)
    assert load_scene(tmp_path / "scene.npz").count == load_scene(room).count


@pytest.mark.ci
def test_an_estimator_and_a_scene_format_of_the_folder_localize(tmp_path):
    """In a process of its own, for the folder is read at start; the method answers with the first training camera."""
    room = write_room(tmp_path / "room")
    write_npz(room / "scene.npz", room)
    (room / "scene.ply").unlink()
    for kind, name, source in (("estimators", "nearest", NEAREST_CAMERA), ("scene_formats", "npz", NPZ_FORMAT)):
        (tmp_path / "plugins" / kind).mkdir(parents=True)
        (tmp_path / "plugins" / kind / f"{name}.py").write_text(source)
    photo = tmp_path / "photo.png"
    photo.write_bytes(encode_image(np.full((INTRINSICS["height"], INTRINSICS["width"], 3), 99, np.uint8), "png"))
    environment = {
        **os.environ,
        "SPLATFIX_PLUGINS_DIR": str(tmp_path / "plugins"),
        "SPLATFIX_CACHE_DIR": str(tmp_path / "cache"),
        "NUMBA_CACHE_DIR": str(jit.numba.config.CACHE_DIR),  # type: ignore[attr-defined]
    }
    command = [sys.executable, "-m", "service", "localize", str(photo), "--scene", str(room), "--json"]
    command += ["--estimator", "nearest", "--intrinsics", json.dumps(INTRINSICS)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (result,) = json.loads(done.stdout)
    found = Pose(np.array(result["pose"]["world_from_camera"]["matrix"]))
    assert pose_distance(found, training_poses(24)[0]) == pytest.approx((0.0, 0.0), abs=1e-6)
