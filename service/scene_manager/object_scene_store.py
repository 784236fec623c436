"""The catalogue of scenes in an object store, which several fronts share: what one adds or deletes all see.

`scenes/NAME.json` is the entry of an uploaded scene. What belongs to the scene is below `uploads/NAME-NUMBER/`: its
files, called after their content, and those that were added to it (`SideFile`). Each upload has a number of its own, so
that deleting a scene never takes what a later one of that name has.
"""

from __future__ import annotations

import logging
import os
import shutil
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from service.codec import decode, encode
from service.errors import SceneNotFound, SplatfixError, StorageFailed
from service.object_store import open_objects
from service.scene_formats.remote_scene import RemoteFile, RemoteScene
from service.scene_manager.scene_store import FolderDraft, check_scene_id, scene_exists
from service.scene_manager.status import StoredScene

_log = logging.getLogger(__name__)
_ENTRIES = "scenes/"


@dataclass(frozen=True, slots=True)
class _Entry:
    """What is in an entry's object."""

    prefix: str
    files: tuple[RemoteFile, ...]


class ObjectSceneStore:
    """Implements `SceneStore`: the operator's scenes, and those of the object store as `refresh` has seen them last."""

    def __init__(
        self,
        named: Sequence[StoredScene],
        address: str,
        cache: Path,
        incoming: Path,
        max_bytes: int,
        *,
        allow_checkpoints: bool = False,
    ) -> None:
        """`cache` is the folder to which scenes are fetched, in `fetched-scenes`; `incoming`, this process' own, holds
        what is not checked yet. Raises StorageFailed."""
        self._named = {scene.id: scene for scene in named}
        self._address, self._objects = address, open_objects(address)
        self._folder, self._incoming = cache / "fetched-scenes", incoming
        shutil.rmtree(incoming, ignore_errors=True)  # of an ended process
        self._max_bytes, self._allow_checkpoints = max_bytes, allow_checkpoints
        self._uploaded: dict[str, StoredScene] = {}
        self._seen: dict[str, str] = {}
        """Versions of the entries, by their keys."""
        self._lock = threading.Lock()
        self.refresh()
        for scene_id in self._named.keys() & self._uploaded.keys():
            _log.warning("the uploaded scene %s is hidden by another of that name", scene_id)

    def scenes(self) -> list[StoredScene]:
        with self._lock:
            uploads = [scene for name, scene in sorted(self._uploaded.items()) if name not in self._named]
        return [*self._named.values(), *uploads]

    def find(self, scene_id: str) -> StoredScene | None:
        return self._named.get(scene_id) or self._uploaded.get(scene_id)

    def draft(self, scene_id: str) -> ObjectDraft:
        check_scene_id(scene_id)
        if self.find(scene_id) is not None:
            raise scene_exists(scene_id)
        return ObjectDraft(self, scene_id)

    def delete(self, scene_id: str) -> None:
        scene = self.find(scene_id)
        if scene is None or scene.remote is None:
            raise SceneNotFound(f"uploaded scene '{scene_id}' not found.", where="scene")
        # The entry first: what it names must be there.
        self._objects.delete(f"{_ENTRIES}{scene_id}.json")
        with self._lock:
            self._uploaded.pop(scene_id, None)
        self._delete_all(scene.remote.prefix)
        shutil.rmtree(scene.path, ignore_errors=True)

    def refresh(self) -> tuple[list[StoredScene], list[str]]:
        """Look at the catalogue; return scenes that have come or changed, and the ids of those that have gone.

        Raises StorageFailed. Entries that can't be read are left out.
        """
        versions = self._objects.versions(_ENTRIES)
        changed = {key for key, version in versions.items() if self._seen.get(key) != version}
        read = {key: self._read(key) for key in changed}
        with self._lock:
            before = dict(self._uploaded)
            for scene in read.values():
                if scene is not None:
                    self._uploaded[scene.id] = scene
            kept = {_id_of(key) for key in versions}
            gone = [name for name in before if name not in kept and f"{_ENTRIES}{name}.json" in self._seen]
            for name in gone:
                del self._uploaded[name]
            self._seen = versions
            found = [s for s in read.values() if s and s.id not in self._named and before.get(s.id) != s]
        return found, [name for name in gone if name not in self._named]

    def _read(self, key: str) -> StoredScene | None:
        try:
            data = self._objects.get(key)
            check_scene_id(_id_of(key))
            return None if data is None else self._stored(_id_of(key), decode(_Entry, data.decode()))
        except StorageFailed:
            raise
        except (SplatfixError, ValueError, KeyError, TypeError, AttributeError) as error:
            _log.error("the entry %s of the object store is left out: %s", key, str(error)[:200])
            return None

    def _stored(self, scene_id: str, entry: _Entry) -> StoredScene:
        folder = self._folder / entry.prefix.strip("/").rpartition("/")[2]
        remote = RemoteScene(self._address, entry.prefix, entry.files)
        return StoredScene(scene_id, folder, uploaded=True, remote=remote)

    def folder_draft(self, work: Path, scene_id: str) -> FolderDraft:
        """Return a draft on disk, which becomes a folder of the scene's name."""
        return FolderDraft(work / ".draft", work / scene_id, self._max_bytes, self._allow_checkpoints)

    def make_work_folder(self) -> Path:
        """Make a folder for one upload. Raises StorageFailed."""
        work = self._incoming / os.urandom(8).hex()
        try:
            work.mkdir(parents=True)
        except OSError as error:
            raise StorageFailed(f"the service can't write the scene to disk: {error.strerror}.") from error
        return work

    def publish(self, scene_id: str, folder: Path) -> StoredScene:
        """Upload a scene's folder, then its entry. Raises SceneExists, StorageFailed."""
        prefix = f"uploads/{scene_id}-{os.urandom(8).hex()}/"
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        entry = _Entry(prefix, tuple(RemoteFile.of(path, folder) for path in paths))
        stored = self._stored(scene_id, entry)
        assert stored.remote is not None
        for path, file in zip(paths, entry.files, strict=True):
            self._objects.put_file(stored.remote.key(file), path)
        key, data = f"{_ENTRIES}{scene_id}.json", encode(entry).encode()
        # An answer may have been lost: the second attempt finds what the first has made.
        if not self._objects.create(key, data) and self._objects.get(key) != data:
            self._delete_all(prefix)
            raise scene_exists(scene_id)
        with self._lock:
            self._uploaded[scene_id] = stored
        with suppress(OSError):  # what was sent need not be fetched again
            stored.path.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(folder, stored.path)
        return stored

    def _delete_all(self, prefix: str) -> None:
        for key in self._objects.versions(prefix):
            self._objects.delete(key)


class ObjectDraft:
    """A scene that comes in, on disk until it is checked."""

    def __init__(self, store: ObjectSceneStore, scene_id: str) -> None:
        self._store, self._id = store, scene_id
        self._work = store.make_work_folder()
        self._draft = store.folder_draft(self._work, scene_id)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._draft.__exit__(kind, error, trace)
        shutil.rmtree(self._work, ignore_errors=True)

    def write(self, data: bytes) -> None:
        self._draft.write(data)

    def commit(self, file_name: str) -> StoredScene:
        return self._store.publish(self._id, self._draft.commit(file_name).path)


def _id_of(key: str) -> str:
    return key.removeprefix(_ENTRIES).removesuffix(".json")
