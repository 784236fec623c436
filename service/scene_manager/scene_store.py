"""Scenes that come over HTTP: streamed to disk, checked, and only then given a name that others see.

An archive is a ZIP of a scene folder (or of what is in it). Only files that a scene is read from are taken out of it,
under their own names; what the archive says of paths, links and sizes is not trusted.
"""

from __future__ import annotations

import os
import re
import shutil
import zipfile
import zlib
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO

from anyio import to_thread

from service.errors import (
    CorruptScene,
    InvalidRequest,
    SceneError,
    SceneExists,
    SceneNotFound,
    StorageFailed,
    UnsupportedFormat,
)
from service.scene_formats import load_scene
from service.scene_formats.folder import COLMAP_FOLDER
from service.scene_formats.formats import is_scene_file, readable_suffixes
from service.scene_formats.manifest import MANIFEST

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_MAX_MEMBERS = 20_000
_COPY_BYTES = 1 << 20
_MAX_NAME_BYTES = 255
"""On all usual file systems."""


class Uploads:
    """One folder of scenes; `.incoming` in it holds what is not checked yet."""

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self._folder, self._max_bytes = folder, max_bytes
        self._incoming = folder / ".incoming"
        shutil.rmtree(self._incoming, ignore_errors=True)  # of an ended process
        self._incoming.mkdir(parents=True, exist_ok=True)

    def scenes(self) -> list[Path]:
        """Return the scenes that were uploaded before."""
        return sorted(p for p in self._folder.iterdir() if p.is_dir() and _NAME.fullmatch(p.name))

    async def receive(self, scene_id: str, file_name: str, body: AsyncIterator[bytes]) -> Path:
        """Store a scene file, or an archive of a scene folder. Raises InvalidRequest, SceneError, StorageFailed."""
        check_scene_id(scene_id)
        if (self._folder / scene_id).exists():
            raise _exists(scene_id)
        draft = self._incoming / f"{scene_id}.{os.urandom(4).hex()}"
        try:
            draft.mkdir()
            await self._written(draft / "upload", body)
            await to_thread.run_sync(self._check, draft, file_name)
            target = self._folder / scene_id
            await to_thread.run_sync(draft.rename, target)
        except OSError as error:
            if (self._folder / scene_id).exists():  # sent twice at once, and the other came first
                raise _exists(scene_id) from error
            raise StorageFailed(f"the service can't store the scene: {error.strerror}.") from error
        finally:
            await to_thread.run_sync(lambda: shutil.rmtree(draft, ignore_errors=True))
        return target

    def delete(self, path: Path) -> None:
        """Delete an uploaded scene. Raises StorageFailed."""
        try:
            shutil.rmtree(path)
        except OSError as error:
            raise StorageFailed(f"the service can't delete the scene: {error.strerror}.") from error

    async def _written(self, path: Path, body: AsyncIterator[bytes]) -> None:
        with path.open("wb") as file:
            async for chunk in body:
                await to_thread.run_sync(file.write, chunk)
            await to_thread.run_sync(lambda: os.fsync(file.fileno()))

    def _check(self, draft: Path, file_name: str) -> None:
        """Make a scene folder of what was sent, and read it once."""
        upload = draft / "upload"
        if zipfile.is_zipfile(upload):
            self._unpack(upload, draft)
            upload.unlink()
            if not any(is_scene_file(path) for path in draft.iterdir()):
                raise UnsupportedFormat(
                    f"the archive holds no scene file ({', '.join(readable_suffixes())}).", where="archive"
                )
        else:
            if not is_scene_file(Path(file_name)):
                names = " or ".join(f"`scene{suffix}`" for suffix in readable_suffixes())
                raise InvalidRequest(f"say what kind of file it is: {names}, or send a ZIP.", where="query.file")
            upload.rename(draft / f"scene{Path(file_name).suffix.lower()}")
        try:
            load_scene(draft)
        except SceneError as error:
            error.where = error.where.replace(str(draft), "archive")  # our folders are nobody's business
            raise CorruptScene(str(error), where="archive") if isinstance(error, SceneNotFound) else error from None

    def _unpack(self, archive: Path, folder: Path) -> None:
        """Take a scene's files out of an archive. Raises CorruptScene, UnsupportedFormat, OSError."""
        left = self._max_bytes
        with _reading():
            opened = zipfile.ZipFile(archive)
        with opened:
            members = [m for m in opened.infolist() if not m.filename.endswith("/")]
            if len(members) > _MAX_MEMBERS:
                raise CorruptScene(f"the archive holds more than {_MAX_MEMBERS} files.", where="archive")
            paths = [PurePosixPath(m.filename.lstrip("/")) for m in members]
            top = _common_top(paths)
            for member, path in zip(members, paths, strict=True):
                if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    # LZMA takes as much memory as the archive says, up to 4 GB.
                    raise UnsupportedFormat("only stored and deflated files are read.", where="archive")
                name = _wanted(path.relative_to(top))
                if name is not None:
                    with _reading():
                        source = opened.open(member)
                    with source:
                        left = _copied(source, folder / name, left)


@contextmanager
def _reading() -> Iterator[None]:
    """Blame the archive, not our disk. Raises CorruptScene."""
    try:
        yield
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError, RuntimeError, ValueError, OSError) as error:
        raise CorruptScene(f"the archive can't be read: {str(error)[:200]}.", where="archive") from error


def _exists(scene_id: str) -> SceneExists:
    return SceneExists(f"there is a scene '{scene_id}'.", where="scene", hint="Delete it first.")


def check_scene_id(scene_id: str) -> None:
    """Raises InvalidRequest unless it can be the name of a folder anywhere."""
    if not _NAME.fullmatch(scene_id):
        raise InvalidRequest("must be 1 to 64 letters, digits, _ and -, the first no sign.", where="path.scene_id")


def _common_top(paths: list[PurePosixPath]) -> PurePosixPath:
    """Return the folder that all files are in, if there is one: many pack the folder, others what is in it."""
    tops = {path.parts[:1] for path in paths}
    nested = all(len(path.parts) > 1 for path in paths)
    if len(tops) == 1 and nested and tops != {COLMAP_FOLDER.parts[:1]}:
        return PurePosixPath(*tops.pop())
    return PurePosixPath()


def _wanted(path: PurePosixPath) -> str | None:
    """Return under what name a member is stored, None for what a scene isn't read from."""
    name = path.name
    if path.parts == (name,) and (
        is_scene_file(Path(name)) or name == MANIFEST or re.fullmatch(r"transforms\w*\.json", name)
    ):
        return name if re.fullmatch(r"[\w. -]+", name) and len(name.encode()) <= _MAX_NAME_BYTES else None
    if path.parent == PurePosixPath(*COLMAP_FOLDER.parts) and re.fullmatch(r"[a-z]{1,40}\.(bin|txt)", name):
        return str(path)
    return None


def _copied(source: IO[bytes], path: Path, left: int) -> int:
    """Copy at most `left` bytes into a new file; return how many more there may be. Raises CorruptScene, OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        target = path.open("xb")
    except FileExistsError as error:
        raise CorruptScene("two files of the archive have the same name.", where="archive") from error
    with target:
        while True:
            with _reading():
                chunk = source.read(_COPY_BYTES)
            if not chunk:
                return left
            left -= len(chunk)
            if left < 0:
                raise CorruptScene("the archive holds more than the service takes.", where="archive")
            target.write(chunk)
