"""Files that are written beside their place and renamed: there as a whole or not at all, whatever fails."""

from __future__ import annotations

import errno
import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.coverage.coverage_cache import write_coverage
from service.errors import StorageFailed
from service.interfaces import Features
from service.jobs.photo_store import FolderPhotoStore
from service.mapped_arrays import open_arrays, write_arrays
from service.object_store import FolderObjects
from service.pose.features.rendered_views import View
from service.pose.retrieval.view_files import read_views, write_views
from service.scene_formats import side_file
from service.scene_formats.remote_scene import RemoteFile, RemoteScene
from service.scene_manager.camera_frame import FoundFrame
from service.types import Camera, Intrinsics, Pose
from service.web.key_file import add_key, write_private

LENS = Intrinsics(4, 3, 5.0, 6.0, 2.0, 1.5)
DATA = b"some bytes"


def a_view() -> View:
    features = Features(*(np.ones(s, np.float32) for s in ((1, 2), 1, (1, 4))))
    return View(Camera(LENS, Pose(np.eye(4))), features, np.ones((1, 3), np.float32))


def fetched(folder: Path) -> None:
    store = FolderObjects(folder / "store")
    file = RemoteFile("a/scene.ply", hashlib.sha256(DATA).hexdigest(), len(DATA))
    remote = RemoteScene(str(folder / "store"), "it/", (file,))
    if store.get(remote.key(file)) is None:
        store.put(remote.key(file), DATA)
    remote.fetch(folder / "copy")


def described(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    FoundFrame(np.eye(4), 4, 4, 4, 0.1, 0.1).write(folder)


WRITERS: dict[str, Callable[[Path], Any]] = {
    "text beside a scene": lambda folder: side_file._replace(folder / "a.json", "{}"),
    "coverage": lambda folder: write_coverage(LENS, folder / "c.json"),  # type: ignore[arg-type]
    "views": lambda folder: write_views(folder / "v.npz", [a_view()], {}),
    "arrays": lambda folder: write_arrays(folder / "arrays", {"a": np.arange(3)}, {"t.txt": "text"}),
    "cameras' frame": described,
    "object": lambda folder: FolderObjects(folder).put("k/a", DATA),
    "new object": lambda folder: FolderObjects(folder).create("k/a", DATA),
}
"""By what they write; each makes the folders that it needs."""


def left(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("write", WRITERS.values(), ids=list(WRITERS))
def test_what_can_not_be_put_in_its_place_leaves_nothing(write, tmp_path: Path, monkeypatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    folder = tmp_path / "new" / "folder"
    with monkeypatch.context() as patch:
        for owner, name in ((os, "replace"), (os, "fsync"), (Path, "replace")):
            patch.setattr(owner, name, full)
        if write is WRITERS["coverage"]:  # the map is there without its file
            write(folder)
        else:
            with pytest.raises((OSError, StorageFailed), match="no space left"):
                write(folder)
    assert left(tmp_path) == []
    write(folder)
    names = left(folder)
    assert names
    assert not [name for name in names if "partial" in name or "draft" in name or str(os.getpid()) in name]
    if write is not WRITERS["arrays"]:  # these are of a key of their own, and deleted before they are written again
        write(folder)
        assert left(folder) == names


def test_arrays_come_back_as_they_are(tmp_path: Path) -> None:
    for kept in ({"a": np.arange(3), "b": np.eye(2)}, {"a": np.arange(5), "b": np.eye(3)}):
        folder = tmp_path / f"of {len(kept['a'])}"
        (draft := folder.with_name(f"{folder.name}.{os.getpid()}")).mkdir()
        (draft / "c.npy").touch()  # of a process that ended, with this one's number
        write_arrays(folder, kept, {"t.txt": "text"})
        assert left(folder) == ["a.npy", "b.npy", "t.txt"]
        found = open_arrays(folder, kept)
        assert all(np.array_equal(found[name], kept[name]) and not found[name].flags.writeable for name in kept)
        assert open_arrays(folder, kept, "c")["a"].flags.writeable
    (folder / "a.npy").write_bytes(b"")
    with pytest.raises(ValueError, match="No data left"):
        open_arrays(folder, kept)
    with pytest.raises(FileNotFoundError):
        open_arrays(folder, ["none"])


def test_a_scene_is_fetched_with_all_its_folders_or_not_at_all(tmp_path: Path, monkeypatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "no space left")))
        with pytest.raises(StorageFailed, match="no space left"):
            fetched(tmp_path)
    assert left(tmp_path / "copy") == []
    fetched(tmp_path)
    assert (tmp_path / "copy" / "a" / "scene.ply").read_bytes() == DATA
    assert left(tmp_path / "copy") == ["a/scene.ply"]
    os.utime(tmp_path / "copy", (0, 0))
    fetched(tmp_path)  # nothing is missing
    assert time.time() - 60 < (tmp_path / "copy").stat().st_mtime  # it is used, and not the next that goes
    (tmp_path / "copy" / "a" / "scene.ply").write_bytes(DATA[:3])
    fetched(tmp_path)
    assert (tmp_path / "copy" / "a" / "scene.ply").read_bytes() == DATA


def test_views_that_are_whole_are_read(tmp_path: Path) -> None:
    write_views(tmp_path / "new" / "v.npz", [a_view()], {})
    (view,), _ = read_views(tmp_path / "new" / "v.npz") or ((), {})
    assert view.camera.intrinsics == LENS


def test_keys_have_a_new_folder_and_leave_no_draft(tmp_path: Path, monkeypatch) -> None:
    add_key(tmp_path / "new" / "keys.json", "robot", "localize")
    assert left(tmp_path) == ["new/keys.json", "new/keys.json.lock"]
    monkeypatch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "no space left")))
    with pytest.raises(OSError, match="no space left"):
        write_private(tmp_path / "secret", DATA)
    assert left(tmp_path) == ["new/keys.json", "new/keys.json.lock"]


@pytest.mark.parametrize(
    ("write", "name", "data"),
    [
        (lambda folder: side_file._replace(folder / "a.json", "{}"), "a.json", b"{}"),
        (lambda folder: FolderObjects(folder).put("k/a", DATA), "k/a", DATA),
        (lambda folder: FolderPhotoStore(folder).accept("j", DATA), "j.upload", DATA),
        (lambda folder: FolderPhotoStore(folder).discard_original("j", DATA), "j.jpg", DATA),
    ],
    ids=["text", "object", "photo", "kept photo"],
)
def test_bytes_are_on_disk_before_they_are_called_by_their_name(write, name, data, tmp_path, monkeypatch) -> None:
    synced: list[tuple[bytes | None, bool]] = []

    def fsync(descriptor: int) -> None:
        # What the system has of the file: what Python still buffers is not in it.
        facts = os.fstat(descriptor)
        (found,) = (p for p in (tmp_path, *tmp_path.rglob("*")) if os.path.samestat(p.stat(), facts))
        synced.append((None if found.is_dir() else found.read_bytes(), (tmp_path / name).exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    write(tmp_path)
    assert (tmp_path / name).read_bytes() == data
    # A photo is written in its place: whose job has not been accepted yet is not looked for.
    assert synced[0] == (data, name.startswith("j."))
    if name != "a.json":
        assert synced[1:] == [(None, True)]  # its name
