"""The photos of jobs, as a protocol and as the files of one folder.

A photo is there as it was sent until the job has ended, then as the upright JPEG that people look at. No name comes
from outside: a file is called after its job, whose id we made. What was sent, with its EXIF data, is gone when the job
has ended.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Protocol, runtime_checkable

from service.errors import PhotoGone, StorageFailed
from service.operating_system import sync_folder


@runtime_checkable
class PhotoStore(Protocol):
    """The photos of jobs, by the job's id. Safe to call from several threads."""

    def accept(self, job_id: str, data: bytes) -> None:
        """Keep a photo as it was sent; it survives a power loss when this returns. Raises StorageFailed."""
        ...

    def original(self, job_id: str) -> bytes:
        """Return what was sent. Raises PhotoGone."""
        ...

    def discard_original(self, job_id: str, jpeg: bytes | None) -> None:
        """Delete the photo as it was sent, and keep a JPEG for display if one is given and the disk has space."""
        ...

    def kept(self, job_id: str) -> bytes:
        """Return the JPEG. Raises PhotoGone."""
        ...

    def delete(self, job_id: str) -> None:
        """Delete all of a job; without effect if there is nothing."""
        ...

    def with_original(self) -> set[str]:
        """Return the ids of the jobs whose photo is there as it was sent."""
        ...

    def ids(self) -> set[str]:
        """Return the ids of all jobs with a photo of either form."""
        ...


class FolderPhotoStore:
    """Two files a job at most, `ID.upload` and `ID.jpg`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def accept(self, job_id: str, data: bytes) -> None:
        path = self._folder / f"{job_id}.upload"
        try:
            write_durably(path, data)
        except OSError as error:
            with suppress(OSError):
                path.unlink(missing_ok=True)
            raise StorageFailed(f"the service can't write the photo to disk: {error.strerror}.") from error

    def original(self, job_id: str) -> bytes:
        return self._read(f"{job_id}.upload")

    def discard_original(self, job_id: str, jpeg: bytes | None) -> None:
        if jpeg is not None:
            path = self._folder / f"{job_id}.jpg"
            try:
                write_durably(path, jpeg)
            except OSError:  # a full disk: the photo isn't kept
                path.unlink(missing_ok=True)
        (self._folder / f"{job_id}.upload").unlink(missing_ok=True)

    def kept(self, job_id: str) -> bytes:
        return self._read(f"{job_id}.jpg")

    def delete(self, job_id: str) -> None:
        for suffix in ("upload", "jpg"):
            (self._folder / f"{job_id}.{suffix}").unlink(missing_ok=True)

    def with_original(self) -> set[str]:
        return {path.stem for path in self._folder.glob("*.upload")}

    def ids(self) -> set[str]:
        return {path.stem for path in self._folder.iterdir()}

    def _read(self, name: str) -> bytes:
        try:
            return (self._folder / name).read_bytes()
        except FileNotFoundError:
            raise photo_gone() from None


def photo_gone() -> PhotoGone:
    """Return the error of every store for a photo that isn't there any more."""
    hint = "Send keep_photo=true to have it kept as long as the job."
    return PhotoGone("the photo was deleted after the job.", where="photo", hint=hint)


def write_durably(path: Path, data: bytes) -> None:
    """Write a file and wait until it and its name are on disk. Raises OSError."""
    with path.open("wb") as file:
        file.write(data)
        # The file and then its entry in the folder: either alone may be lost with the power.
        file.flush()
        os.fsync(file.fileno())
    sync_folder(path.parent)
