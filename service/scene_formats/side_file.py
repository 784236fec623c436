"""A file that belongs to a scene without being a part of it: beside the scene, else in the data folder.

Of a scene in an object store it is an object, too, and its file on disk a copy that is looked after when it is used.

It doesn't count for the scene's digest, so that a change of it makes no index anew.
"""

from __future__ import annotations

import hashlib
import logging
import os
import time
from dataclasses import dataclass
from pathlib import Path

from service.errors import StorageFailed
from service.scene_formats.remote_scene import RemoteScene

_log = logging.getLogger(__name__)
_REFRESH_S = 2.0
"""So old a copy may be."""
_REFRESHED: dict[Path, float] = {}
"""When each copy was compared with its object last, on the monotonic clock."""


@dataclass(frozen=True, slots=True)
class SideFile:
    """One file of one scene; readers never see half of it."""

    scene: Path
    """Scene folder or scene file."""
    name: str
    """Of the file, e.g. `anchors.json`."""
    data_folder: Path | None = None
    """Where the file goes if it can't be written beside the scene; in a folder with the plural of the file's stem."""
    remote: RemoteScene | None = None
    """Where the scene comes from, if it is in an object store."""

    @property
    def beside(self) -> Path:
        return self.scene / self.name if self.scene.is_dir() else self.scene.with_suffix(f".{self.name}")

    @property
    def elsewhere(self) -> Path | None:
        place = hashlib.sha256(str(self.scene.resolve()).encode()).hexdigest()[:16]
        return self.data_folder and self.data_folder / self._folder / f"{place}.json"

    @property
    def _folder(self) -> str:
        return f"{Path(self.name).stem.removesuffix('s')}s"

    @property
    def path(self) -> Path:
        """Where the file is: once it was written to the data folder it stays there."""
        if self.remote is not None:
            return self._refreshed(self.remote)
        elsewhere = self.elsewhere
        return elsewhere if elsewhere is not None and elsewhere.is_file() else self.beside

    def write(self, text: str) -> None:
        """Replace the file. Raises StorageFailed."""
        if self.remote is not None:
            self.remote.store.put(f"{self.remote.prefix}{self.name}", text.encode())
            self.forget_copy()
            return
        places = [self.path, *([self.elsewhere] if self.elsewhere else [])]
        for number, path in enumerate(places, 1):
            try:
                _replace(path, text)
            except OSError as error:
                if number == len(places):
                    raise StorageFailed(f"{path.name} can't be written: {error.strerror}.") from error
            else:
                return

    def forget_copy(self) -> None:
        """Have the next reader look at the object store: to be called before what is read is changed."""
        _REFRESHED.pop(self._copy, None)

    @property
    def _copy(self) -> Path:
        # Not in the scene's folder, which goes with the cache.
        return self.scene.parent.with_name("side-files") / f"{self.scene.name}.{self.name}"

    def _refreshed(self, remote: RemoteScene) -> Path:
        """Bring the copy to what the object store has, at most once in a while; return it."""
        copy = self._copy
        if time.monotonic() - _REFRESHED.get(copy, -_REFRESH_S) < _REFRESH_S:
            return copy
        _REFRESHED[copy] = time.monotonic()
        try:
            data = remote.store.get(f"{remote.prefix}{self.name}")
            if data is None:
                copy.unlink(missing_ok=True)
            # Only if it is another: readers look at the time of the file.
            elif not copy.is_file() or copy.read_bytes() != data:
                _replace(copy, data.decode())
        except (StorageFailed, OSError, ValueError) as error:
            _log.warning("%s may be outdated: %s", copy.name, error)
        return copy


def _replace(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
