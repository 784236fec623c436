"""The demo scene with the shipped gate model: its 16 photos, and the documents' examples as they are written.

Lines that call curl or `splatfix localize` are run in a folder with the names that they use; those that would not end
(`serve`), install or build are only checked, by test_docs.py. So are marked blocks.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from api_server import ROOT, create_app, serving, settings, until_ready
from documents import blocks, lines_of
from rest_in_ci import rest_in_ci

from service import jit
from service.geometry import moved, pose_distance
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.photos.images import read_query
from service.types import Intrinsics, Pose

STUDIO = ROOT / "scenes" / "studio"
TRUTH = json.loads((STUDIO / "truth.json").read_text())
# test_clients.py, test_frames.py and test_registration.py run these.
ELSEWHERE = ("docs/clients.md", "docs/frames.md", "docs/registration.md")
BLOCKS = [block for block in blocks() if block.document not in ELSEWHERE and not block.not_run]
PYTHON = [block for block in BLOCKS if block.language == "python"]
LOCALIZES = re.compile(r"curl .*/localize$|\S*splatfix localize .*path/to/scene_folder")
LINES = [
    pytest.param(line, id=f"{block}-{i}", marks=() if block.document == "README.md" else pytest.mark.ci)
    for block in BLOCKS
    if block.language == "sh"
    for i, line in enumerate(lines_of(block.text))
    if LOCALIZES.match(line)
]


@pytest.fixture(scope="module")
def studio(scene_cache) -> LoadedScene:
    loaded = LoadedScene.load(STUDIO, cache_dir=scene_cache)
    loaded.prepare("view_index")
    return loaded


# ------------------------------------------------------------------ the photos


def test_the_numerics_run_on_one_thread():
    """With more, what a photo costs is chance: they wait for one another in busy loops."""
    assert os.environ.get("OPENBLAS_NUM_THREADS") == "1", "numpy was imported before conftest.py: see addopts"


@pytest.mark.ci
@pytest.mark.parametrize(("lens", "bound"), [("given", 8), ("withheld", 24)])  # seen: 4.1 and 6.5
def test_the_demo_photos_are_localized_and_none_falsely(lens, bound):
    command = [sys.executable, ROOT / "tests" / "demo_times.py", lens]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    told = json.loads(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)
    assert len(told["found"]) == 16
    assert ["localized", False] not in told["found"]
    assert told["found"].count(["localized", True]) >= 15
    assert told["ratio"] < bound


@pytest.mark.parametrize("name", rest_in_ci("evening_08.jpg", "evening_11.jpg", "evening_16.jpg"))
def test_photos_of_the_evening_are_localized_by_matches_and_gradients(studio, name):
    """Low warm sun through the windows: the colours' signals are below their floors (0.41 to 0.79, floor 0.935)."""
    folder = ROOT / "scenes" / "studio_another_day" / "evening"
    rows = {row["photo"]: row for row in json.loads((folder / "truth.json").read_text())}
    intrinsics = Intrinsics(**rows[name]["intrinsics"])
    answer = localize(read_query((folder / name).read_bytes(), intrinsics=intrinsics), studio, Request(seed=0))
    assert answer.verdict.status == "localized"
    assert answer.verdict.signals["local_colour_correlation"] < 0.9
    degrees, units = pose_distance(answer.pose, Pose(np.array(rows[name]["world_from_camera"])))
    assert degrees < 0.5  # seen: 0.04 to 0.13
    assert units < 0.05  # seen in normalized units: 0.004 to 0.009


@pytest.mark.ci
def test_photos_at_night_are_refined_with_local_light_taken_out(studio):
    """One lamp: comparing intensities moved these by 0.05 to 0.1 normalized units, or left them uncertain."""
    folder = ROOT / "scenes" / "studio_another_day" / "night"
    rows = {row["photo"]: row for row in json.loads((folder / "truth.json").read_text())}
    for name in ("night_17.jpg", "night_21.jpg"):
        intrinsics = Intrinsics(**rows[name]["intrinsics"])
        answer = localize(read_query((folder / name).read_bytes(), intrinsics=intrinsics), studio, Request(seed=0))
        assert answer.verdict.status == "localized"
        degrees, units = pose_distance(answer.pose, Pose(np.array(rows[name]["world_from_camera"])))
        assert degrees < 0.5  # seen: 0.07 and 0.15
        assert units < 0.05  # seen in normalized units: 0.003 and 0.008


# ------------------------------------------------------------------ the documents' examples


@pytest.fixture(scope="module")
def folder(studio, tmp_path_factory) -> Path:
    """What the examples name: the repository's parts, a scene, a photo, three in a row, a video."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "path" / "to").mkdir(parents=True)
    for name, target in {"scenes": ROOT / "scenes", "path/to/scene_folder": STUDIO}.items():
        (folder / name).symlink_to(target)
    (folder / "photo.jpg").write_bytes((STUDIO / "photos" / "photo_00.jpg").read_bytes())
    program = folder / ".venv" / "bin" / "splatfix"
    program.parent.mkdir(parents=True)
    program.write_text(f"#!/bin/sh\nexec '{sys.executable}' -m service \"$@\"\n")
    program.chmod(0o755)
    camera = studio.scene.cameras[0].camera
    steps = [moved(camera.pose, np.array([0, 0.01 * i, 0, 0.01 * i, 0, 0])) for i in range(4)]
    frames = studio.rasterizer.render([type(camera)(camera.intrinsics, pose) for pose in steps])
    pictures = [cv2.cvtColor((255 * frame.rgb).astype(np.uint8), cv2.COLOR_RGB2BGR) for frame in frames]
    film = cv2.VideoWriter(str(folder / "walk.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 5.0, pictures[0].shape[1::-1])
    for i, picture in enumerate(pictures):
        film.write(picture)
        cv2.imwrite(str(folder / f"{i}.jpg"), picture)
    film.release()
    (folder / "3.jpg").unlink()
    return folder


@pytest.fixture(scope="module")
def url(studio, scene_cache) -> Iterator[str]:
    app = create_app(settings(estimator="view_index", cache_dir=scene_cache), {"studio": studio})
    with serving(app) as client:
        until_ready(client)
        yield str(client.base_url).rstrip("/")


@pytest.mark.parametrize("line", LINES)
def test_a_command_line_works_as_written(line, folder, scene_cache, request):
    if line.startswith("curl "):
        line = line.replace("http://127.0.0.1:8000", request.getfixturevalue("url"))
    environment = os.environ | {
        "SPLATFIX_CACHE_DIR": str(scene_cache),
        "NUMBA_CACHE_DIR": str(jit.numba.config.CACHE_DIR),  # type: ignore[attr-defined]
        "PYTHONPATH": str(ROOT),
        "PATH": f"{folder / '.venv' / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "NO_PROXY": "*",
    }
    done = subprocess.run(["bash", "-c", line], cwd=folder, env=environment, capture_output=True, text=True, timeout=90)
    assert done.returncode == 0, done.stderr
    assert re.search(r"\blocalized\b", done.stdout), done.stdout
    assert "not_localized" not in done.stdout


@pytest.mark.parametrize("document", sorted({block.document for block in PYTHON}))
def test_the_python_of_a_document_runs(document, folder, scene_cache, monkeypatch):
    """Its blocks one after the other in one namespace; scenes take the index that lies in the cache."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(LoadedScene, "load", partial(LoadedScene.load, cache_dir=scene_cache))
    namespace = {}
    for block in PYTHON:
        if block.document == document:
            exec(compile(block.text, str(block), "exec"), namespace)
    # A document may explain results without localizing a photo.
    assert "estimate" not in namespace or namespace["estimate"].verdict.status == "localized"
