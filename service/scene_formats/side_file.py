"""A file that belongs to a scene without being a part of it: beside the scene, else in the data folder.

It doesn't count for the scene's digest, so that a change of it makes no index anew.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

from service.errors import StorageFailed


@dataclass(frozen=True, slots=True)
class SideFile:
    """One file of one scene; readers never see half of it."""

    scene: Path
    """Scene folder or scene file."""
    name: str
    """Of the file, e.g. `anchors.json`."""
    data_folder: Path | None = None
    """Where the file goes if it can't be written beside the scene; in a folder with the plural of the file's stem."""

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
        elsewhere = self.elsewhere
        return elsewhere if elsewhere is not None and elsewhere.is_file() else self.beside

    def write(self, text: str) -> None:
        """Replace the file. Raises StorageFailed."""
        places = [self.path, *([self.elsewhere] if self.elsewhere else [])]
        for number, path in enumerate(places, 1):
            try:
                _replace(path, text)
            except OSError as error:
                if number == len(places):
                    raise StorageFailed(f"{path.name} can't be written: {error.strerror}.") from error
            else:
                return


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
