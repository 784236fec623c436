"""The cache folder: what was not used for longest goes, and whoever reads an entry uses it."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from api_server import create_app, serving, settings, until_ready
from test_scenes import TRANSFORMS, ply

from service import disk_cache
from service.disk_cache import cache_bytes, evict
from service.mapped_arrays import write_arrays
from service.pose.retrieval.view_files import read_views
from service.scene_formats import load_scene
from service.scene_formats.cache import mapped_scene


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """Three entries of 1000 bytes, the first used longest ago, and what is none."""
    folder = tmp_path / "cache"
    (folder / "scenes" / "b").mkdir(parents=True)
    for age, path in enumerate(("coverage-c.json", "scenes/b/means.npy", "view-index-a.npz")):
        (folder / path).write_bytes(bytes(1000))
        os.utime(folder / path, (0, 1e9 - age))
    os.utime(folder / "scenes" / "b", (0, 1e9 - 1))
    (folder / "kernels").mkdir()
    (folder / "kernels" / "k.nbi").write_bytes(bytes(5000))
    (folder / "notes.txt").write_bytes(bytes(5000))
    return folder


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("most", "left"),
    [
        (3000, {"coverage-c.json", "scenes/b/means.npy", "view-index-a.npz"}),
        (2999, {"coverage-c.json", "scenes/b/means.npy"}),
        (1000, {"coverage-c.json"}),
        (0, set()),
    ],
)
def test_the_oldest_entries_go(cache: Path, most: int, left: set[str]) -> None:
    assert cache_bytes(cache) == 3000
    assert evict(cache, most) == 3 - len(left)
    assert names(cache) == left | {"kernels/k.nbi", "notes.txt"}
    assert cache_bytes(cache) == 1000 * len(left)
    assert evict(cache, most) == 0


def test_what_can_not_be_deleted_is_left_and_told(cache: Path, monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(disk_cache.Path, "unlink", refuse)
    # The next oldest goes instead.
    assert evict(cache, 2000) == 1
    assert names(cache) >= {"view-index-a.npz", "coverage-c.json"}
    assert "view-index-a.npz can't be deleted" in caplog.text
    assert evict(cache / "none", 0) == 0


def test_who_reads_an_entry_uses_it(tmp_path: Path) -> None:
    cache, scene = tmp_path / "cache", tmp_path / "scene"
    scene.mkdir()
    (scene / "scene.ply").write_bytes(ply())
    mapped_scene(scene, cache)
    views = cache / "view-index-x"
    none = {"counts": np.zeros(0, int), "sizes": np.zeros((0, 2), int)}
    write_arrays(views, none | dict.fromkeys(("points_px", "scores", "descriptors", "points_in_world"), np.zeros(0)))
    entries = [next((cache / "scenes").iterdir()), views]
    for entry in entries:
        os.utime(entry, (0, 1.0))
    mapped_scene(scene, cache)
    assert read_views(views) is not None
    for entry in entries:
        assert time.time() - entry.stat().st_mtime < 60, entry


def test_a_scene_is_cached_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    cache, scene = tmp_path / "cache", tmp_path / "scene"
    scene.mkdir()
    (scene / "scene.ply").write_bytes(ply())
    mapped_scene(scene, cache)
    (entry,) = (cache / "scenes").iterdir()
    shutil.rmtree(entry)
    # Of a process of the same number that was killed while it wrote.
    draft = entry.with_name(f"{entry.name}.{os.getpid()}")
    draft.mkdir()
    (draft / "half.npy").write_bytes(b"half")
    expected = load_scene(scene)
    found = mapped_scene(scene, cache)
    assert np.array_equal(found.means, expected.means)
    assert list((cache / "scenes").iterdir()) == [entry]
    assert not (entry / "half.npy").exists()
    assert "not cached" not in caplog.text
    # A full disk: the scene is in memory, and nothing is left behind.
    shutil.rmtree(entry)
    save = np.save

    def full(path: Path, *arguments, **options) -> None:
        if path.name == "scales.npy":
            raise OSError(28, "No space left on device")
        save(path, *arguments, **options)

    monkeypatch.setattr(np, "save", full)
    assert np.array_equal(mapped_scene(scene, cache).scales, expected.scales)
    assert list((cache / "scenes").iterdir()) == []
    assert "not cached: [Errno 28]" in caplog.text


@pytest.mark.ci
def test_a_service_keeps_its_cache_within_the_limit_and_tells_of_it(stepping, tmp_path: Path) -> None:
    (tmp_path / "hall").mkdir()
    (tmp_path / "hall" / "scene.ply").write_bytes(ply())
    (tmp_path / "hall" / "transforms.json").write_text(json.dumps(TRANSFORMS))
    cache = tmp_path / "cache"
    mapped_scene(tmp_path / "hall", cache)
    assert cache_bytes(cache) > 0
    chosen = settings(scenes=[tmp_path / "hall"], cache_dir=cache, cache_bytes=0, data_dir=tmp_path / "data")
    with serving(create_app(chosen)) as client:
        until_ready(client)
        lines = client.get("/metrics").text.splitlines()
    assert cache_bytes(cache) == 0
    told = dict(line.rsplit(" ", 1) for line in lines if line.startswith("splatfix_"))
    for name, value in (("cache_limit_bytes", 0), ("cache_bytes", 0), ("ready", 1)):
        assert float(told[f"splatfix_{name}"]) == value
    for folder in ("data", "cache"):
        free = float(told[f'splatfix_disk_free_bytes{{folder="{folder}"}}'])
        assert abs(free - shutil.disk_usage(tmp_path).free) < 1e9
