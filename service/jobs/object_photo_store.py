"""The photos of jobs in an object store, `photos/ID.upload` and `photos/ID.jpg`.

They are called after their job and not after their content: a photo goes with its job, whoever else sent the same.
"""

from __future__ import annotations

from pathlib import PurePosixPath

from service.errors import StorageFailed
from service.jobs.photo_store import photo_gone
from service.object_store import ObjectStore

_FOLDER = "photos/"


class ObjectPhotoStore:
    """Implements `PhotoStore`."""

    def __init__(self, objects: ObjectStore) -> None:
        self._objects = objects

    def accept(self, job_id: str, data: bytes) -> None:
        self._objects.put(f"{_FOLDER}{job_id}.upload", data)

    def original(self, job_id: str) -> bytes:
        return self._read(f"{job_id}.upload")

    def discard_original(self, job_id: str, jpeg: bytes | None) -> None:
        if jpeg is not None:
            try:
                self._objects.put(f"{_FOLDER}{job_id}.jpg", jpeg)
            except StorageFailed:  # full: the photo isn't kept
                self._objects.delete(f"{_FOLDER}{job_id}.jpg")
        self._objects.delete(f"{_FOLDER}{job_id}.upload")

    def kept(self, job_id: str) -> bytes:
        return self._read(f"{job_id}.jpg")

    def delete(self, job_id: str) -> None:
        for suffix in ("upload", "jpg"):
            self._objects.delete(f"{_FOLDER}{job_id}.{suffix}")

    def with_original(self) -> set[str]:
        return {path.stem for path in self._paths() if path.suffix == ".upload"}

    def ids(self) -> set[str]:
        return {path.stem for path in self._paths()}

    def _paths(self) -> list[PurePosixPath]:
        return [PurePosixPath(key) for key in self._objects.versions(_FOLDER)]

    def _read(self, name: str) -> bytes:
        data = self._objects.get(f"{_FOLDER}{name}")
        if data is None:
            raise photo_gone()
        return data
