"""A scene whose files are in an object store, from where they are fetched into a folder before it is loaded."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from service.disk_cache import mark_used
from service.errors import CorruptScene, StorageFailed
from service.object_store import ObjectStore, open_objects


@dataclass(frozen=True, slots=True)
class RemoteFile:
    """One file of a scene."""

    path: str
    """Below the scene's folder, with slashes."""
    sha256: str
    bytes: int

    def __post_init__(self) -> None:
        """Check that the file stays in its folder. Raises CorruptScene."""
        parts = PurePosixPath(self.path).parts
        if not parts or "\\" in self.path or ":" in self.path or any(part in ("/", "..") for part in parts):
            raise CorruptScene(f"'{self.path[:80]}' leads out of the scene's folder.", where="catalogue")

    @classmethod
    def of(cls, path: Path, folder: Path) -> RemoteFile:
        """Describe a file on disk."""
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        return cls(path.relative_to(folder).as_posix(), sha256, path.stat().st_size)


@dataclass(frozen=True, slots=True)
class RemoteScene:
    """What an entry of the catalogue says of a scene."""

    address: str
    """Of the object store."""
    prefix: str
    """Of the keys of all that belongs to the scene; ends in a slash. Each upload has another one."""
    files: tuple[RemoteFile, ...]

    @property
    def store(self) -> ObjectStore:
        return open_objects(self.address)

    def key(self, file: RemoteFile) -> str:
        """Return the key of a file: it is called after its content."""
        return f"{self.prefix}files/{file.sha256}"

    def fetch(self, folder: Path) -> None:
        """Write the files that the folder lacks, each verified by its hash.

        Several processes may fetch a scene at once. Raises CorruptScene if a file is lost or damaged, StorageFailed.
        """
        for file in self.files:
            path = folder / file.path
            if not path.is_file() or path.stat().st_size != file.bytes:
                self._fetch(file, path)
        mark_used(folder)

    def _fetch(self, file: RemoteFile, path: Path) -> None:
        # Beside its place, so that the file is there as a whole or not at all.
        draft = path.with_name(f".{path.name}.{os.urandom(4).hex()}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            found = self.store.get_file(self.key(file), draft)
            if not found or RemoteFile.of(draft, draft.parent).sha256 != file.sha256:
                what = "damaged" if found else "lost"
                text = f"{file.path} is {what} in the object store."
                raise CorruptScene(text, where="scene", hint="Upload it again.")
            draft.replace(path)
        except OSError as error:
            raise StorageFailed(f"the cache of scenes can't be written: {error.strerror}.") from error
        finally:
            draft.unlink(missing_ok=True)
