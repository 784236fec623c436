"""The catalogue of scenes: which there are, where their files lie, and what was added to them over HTTP.

An upload is streamed to disk, checked, and only then becomes visible under its name. It is a scene file, or a ZIP of a
scene folder or of what is in it (`scene_archive`). Some scene files are ZIPs themselves.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import zipfile
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from service.errors import (
    BadInput,
    CorruptScene,
    InvalidRequest,
    SceneError,
    SceneExists,
    SceneNotFound,
    StorageFailed,
    UnsupportedFormat,
)
from service.scene_formats import load_scene
from service.scene_formats.discovery import find_scenes
from service.scene_formats.formats import all_kinds, readable_suffixes, reader_for, suffix_of
from service.scene_formats.layouts import is_scene_folder, scene_file
from service.scene_formats.manifest import read_manifest
from service.scene_manager.scene_archive import unpack
from service.scene_manager.status import AUTO, StoredScene

_log = logging.getLogger(__name__)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_HEAD_BYTES = 4096


@runtime_checkable
class SceneDraft(Protocol):
    """An upload that is coming in; as a context manager it deletes what was not committed."""

    def write(self, data: bytes) -> None:
        """Append to the file that is uploaded. Raises StorageFailed."""
        ...

    def commit(self, file_name: str) -> StoredScene:
        """Check what was written, and add it to the store under the draft's id.

        The suffix of `file_name` decides the format. Raises InvalidRequest, SceneError, StorageFailed.
        """
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


@runtime_checkable
class SceneStore(Protocol):
    """The scenes that there are, in memory or not, and their files. Safe to call from several threads."""

    def scenes(self) -> list[StoredScene]:
        """Return all scenes: the operator's in their order, then the uploaded ones by name."""
        ...

    def find(self, scene_id: str) -> StoredScene | None:
        """Return a scene, None if there is none of that name."""
        ...

    def draft(self, scene_id: str) -> SceneDraft:
        """Begin an upload. Raises InvalidRequest for a name that no scene can have, SceneExists, StorageFailed."""
        ...

    def delete(self, scene_id: str) -> None:
        """Delete an uploaded scene with its files. Raises SceneNotFound, StorageFailed."""
        ...


def named_scenes(paths: Iterable[Path]) -> list[StoredScene]:
    """Return the scenes at the paths that an operator names, without reading them. Raises SceneNotFound, BadInput.

    Of several scenes with one name the first keeps it; the others' ids begin with the folder that they are in.
    """
    found: dict[str, StoredScene] = {}
    named: set[Path] = set()
    for path in (scene for given in paths for scene in find_scenes(given)):
        place = path.resolve()
        scene_id = place.stem if path.is_file() else place.name
        if scene_id == AUTO:
            raise BadInput(f"'{AUTO}' is a reserved name: it means all scenes.", where=str(path))
        if place in named:
            continue
        named.add(place)
        if scene_id in found:
            free = _free_id(f"{place.parent.name}-{scene_id}", found)
            _log.warning("scene %s already exists: the one at %s gets the id %s", scene_id, path, free)
            scene_id = free
        found[scene_id] = StoredScene(scene_id, path)
    return list(found.values())


def _free_id(wanted: str, taken: Container[str]) -> str:
    numbered = (f"{wanted}-{number}" for number in count(2))
    return next(name for name in chain([wanted], numbered) if name not in taken)


class FolderSceneStore:
    """Scenes that the operator names, and one folder of uploads; `.incoming` in it holds what is not checked yet."""

    def __init__(
        self, named: Sequence[StoredScene], folder: Path, max_bytes: int, *, allow_checkpoints: bool = False
    ) -> None:
        self._allow_checkpoints = allow_checkpoints
        self._named = {scene.id: scene for scene in named}
        self._folder, self._max_bytes = folder, max_bytes
        self._incoming = folder / ".incoming"
        shutil.rmtree(self._incoming, ignore_errors=True)  # of an ended process
        self._incoming.mkdir(parents=True, exist_ok=True)
        # The operator's scene wins, and the upload stays: it is there again once the other one has gone.
        for scene_id in self._named.keys() & {path.name for path in self._uploads()}:
            _log.warning("the uploaded scene %s is hidden by another of that name", scene_id)

    def scenes(self) -> list[StoredScene]:
        uploads = [StoredScene(p.name, p, uploaded=True) for p in self._uploads() if p.name not in self._named]
        return [*self._named.values(), *uploads]

    def find(self, scene_id: str) -> StoredScene | None:
        return next((scene for scene in self.scenes() if scene.id == scene_id), None)

    def draft(self, scene_id: str) -> FolderDraft:
        check_scene_id(scene_id)
        if scene_id in self._named or (self._folder / scene_id).exists():
            raise scene_exists(scene_id)
        return FolderDraft(
            # Two uploads of one name may come at once; the first that is whole gets it.
            self._incoming / f"{scene_id}.{os.urandom(4).hex()}",
            self._folder / scene_id,
            self._max_bytes,
            self._allow_checkpoints,
        )

    def delete(self, scene_id: str) -> None:
        scene = self.find(scene_id)
        if scene is None or not scene.uploaded:
            raise SceneNotFound(f"uploaded scene '{scene_id}' not found.", where="scene")
        try:
            shutil.rmtree(scene.path)
        except OSError as error:
            raise StorageFailed(f"the service can't delete the scene: {error.strerror}.") from error

    def _uploads(self) -> list[Path]:
        return sorted(p for p in self._folder.iterdir() if p.is_dir() and _NAME.fullmatch(p.name) and p.name != AUTO)


class FolderDraft:
    """A folder that becomes the scene's when all is well."""

    def __init__(self, folder: Path, target: Path, max_bytes: int, allow_checkpoints: bool) -> None:
        self._folder, self._target, self._max_bytes = folder, target, max_bytes
        self._allow_checkpoints = allow_checkpoints
        with _storing(target):
            folder.mkdir()
            self._file = (folder / "upload").open("wb")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def write(self, data: bytes) -> None:
        with _storing(self._target):
            self._file.write(data)

    def commit(self, file_name: str) -> StoredScene:
        with _storing(self._target):
            self._file.flush()
            # Before the rename: after a crash there must be no scene whose file is empty.
            os.fsync(self._file.fileno())
            self._file.close()
            self._check(file_name)
            # Atomic on one file system: a scene is there as a whole or not at all.
            self._folder.rename(self._target)
        return StoredScene(self._target.name, self._target, uploaded=True)

    def _check(self, file_name: str) -> None:
        """Make a scene folder of what was sent, and read it once."""
        upload = self._folder / "upload"
        suffix = suffix_of(Path(file_name))
        with upload.open("rb") as file:
            # A ZIP may be a scene by itself (.sog, .pt); one that is called .ply is none.
            named = suffix != ".ply" and reader_for(file.read(_HEAD_BYTES), suffix) is not None
        if not named and zipfile.is_zipfile(upload):
            unpack(upload, self._folder, self._max_bytes)
            upload.unlink()
            if not is_scene_folder(self._folder):
                raise UnsupportedFormat(
                    f"the archive holds no scene file ({', '.join(readable_suffixes())}).", where="archive"
                )
        else:
            if suffix not in all_kinds():
                names = " or ".join(f"`scene{suffix}`" for suffix in readable_suffixes())
                raise InvalidRequest(
                    "the file's format is unknown.", where="query.file", hint=f"Name it, {names}, or send a ZIP."
                )
            upload.rename(self._folder / f"scene{suffix}")
        try:
            self._require_allowed()
            # Read once, so that a broken file is refused at the upload, not at the first job.
            load_scene(self._folder)
        except SceneError as error:
            # Clients must not learn where the service keeps its files.
            error.where = error.where.replace(str(self._folder), "archive")
            raise CorruptScene(str(error), where="archive") if isinstance(error, SceneNotFound) else error from None

    def _require_allowed(self) -> None:
        """Raise UnsupportedFormat for a checkpoint unless the operator allows them: they are pickles."""
        _, reader = scene_file(self._folder, read_manifest(self._folder))
        if getattr(reader, "UNPICKLES", False) and not self._allow_checkpoints:
            raise UnsupportedFormat(
                "checkpoints can't be uploaded to this service.",
                where="archive",
                hint="Export the scene as .ply, or have the operator set upload_checkpoints.",
            )


@contextmanager
def _storing(target: Path) -> Iterator[None]:
    """Report what the disk refuses. Raises StorageFailed; SceneExists if the same upload came twice at once."""
    try:
        yield
    except OSError as error:
        if target.exists():
            raise scene_exists(target.name) from error
        raise StorageFailed(f"the service can't store the scene: {error.strerror}.") from error


def scene_exists(scene_id: str) -> SceneExists:
    """Return the error of every store for a name that another scene has."""
    return SceneExists(f"scene '{scene_id}' already exists.", where="scene", hint="Delete it first.")


def check_scene_id(scene_id: str) -> None:
    """Raises InvalidRequest unless it can be the name of a folder anywhere."""
    if not _NAME.fullmatch(scene_id):
        raise InvalidRequest(
            "must be 1 to 64 letters, digits, _ and -, beginning with a letter or digit.", where="path.scene_id"
        )
    if scene_id == AUTO:
        raise InvalidRequest(f"'{AUTO}' is a reserved name: it means all scenes.", where="path.scene_id")
