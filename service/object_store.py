"""Objects by their keys, as a protocol and as the files of a folder; `s3_objects` keeps them in a bucket.

A key is a path of names between slashes. An object is there as a whole or not at all, and is replaced as a whole.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Protocol, runtime_checkable

from service.errors import BackendMissing, BadInput, StorageFailed
from service.operating_system import sync_folder


@runtime_checkable
class ObjectStore(Protocol):
    """Safe to call from several threads and processes. Methods raise StorageFailed."""

    def get(self, key: str) -> bytes | None:
        """Return an object, None if there is none."""
        ...

    def put(self, key: str, data: bytes) -> None:
        """Make or replace an object; it survives a power loss when this returns."""
        ...

    def create(self, key: str, data: bytes) -> bool:
        """Make an object unless there is one; return whether it was made. Of several at once one makes it."""
        ...

    def get_file(self, key: str, path: Path) -> bool:
        """Write an object to a file, piece by piece; return whether there was one."""
        ...

    def put_file(self, key: str, path: Path) -> None:
        """Make or replace an object by a file, piece by piece."""
        ...

    def delete(self, key: str) -> None:
        """Delete an object; without effect if there is none."""
        ...

    def versions(self, prefix: str) -> dict[str, str]:
        """Return the keys below a prefix that ends in a slash, each with what changes when its object does."""
        ...


@cache
def open_objects(address: str) -> ObjectStore:
    """Return the store at an address: s3://bucket/prefix, or a folder.

    Raises BackendMissing, BadInput, StorageFailed.
    """
    scheme, separator, rest = address.partition("://")
    if separator and scheme != "file":
        # Not above: the library is there only where the extra is installed.
        try:
            from service.s3_objects import S3Objects
        except ImportError as error:
            hint = "pip install 'splatfix[cloud]'"
            raise BackendMissing(f"obstore: {error}.", where="object_store", hint=hint) from error
        return S3Objects(address)
    folder = Path(rest if separator else address)
    if not folder.is_absolute():
        raise BadInput(f"'{address}' is no absolute path.", where="object_store", hint="E.g. s3://bucket, /mnt/shared.")
    return FolderObjects(folder)


class FolderObjects:
    """Implements `ObjectStore`; several machines may share the folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._drafts = folder / ".drafts"
        with _storing("write"):
            self._drafts.mkdir(parents=True, exist_ok=True)

    def get(self, key: str) -> bytes | None:
        with _storing("read"):
            try:
                return (self._folder / key).read_bytes()
            except FileNotFoundError:
                return None

    def put(self, key: str, data: bytes) -> None:
        with self._draft(key) as draft:
            draft.write_bytes(data)

    def create(self, key: str, data: bytes) -> bool:
        path = self._folder / key
        try:
            with self._draft(key, os.link) as draft:
                if path.exists():
                    return False
                draft.write_bytes(data)
        except StorageFailed as error:
            if isinstance(error.__cause__, FileExistsError):
                return False
            raise
        return True

    def get_file(self, key: str, path: Path) -> bool:
        with _storing("read"):
            try:
                shutil.copyfile(self._folder / key, path)
            except FileNotFoundError:
                return False
        return True

    def put_file(self, key: str, path: Path) -> None:
        with self._draft(key) as draft:
            shutil.copyfile(path, draft)

    def delete(self, key: str) -> None:
        with _storing("write"):
            (self._folder / key).unlink(missing_ok=True)

    def versions(self, prefix: str) -> dict[str, str]:
        found = {}
        with _storing("read"):
            for path in (self._folder / prefix).rglob("*"):
                with suppress(FileNotFoundError):  # deleted meanwhile
                    facts = path.stat()
                    if path.is_file():
                        key = path.relative_to(self._folder).as_posix()
                        found[key] = f"{facts.st_ino}.{facts.st_mtime_ns}"
        return found

    @contextmanager
    def _draft(self, key: str, publish=os.replace) -> Iterator[Path]:
        """Lend a file that becomes the object at the end."""
        path, draft = self._folder / key, self._drafts / os.urandom(8).hex()
        with _storing("write"):
            try:
                yield draft
                if not draft.exists():
                    return
                with draft.open("rb+") as file:
                    os.fsync(file.fileno())
                path.parent.mkdir(parents=True, exist_ok=True)
                publish(draft, path)
                sync_folder(path.parent)
            finally:
                draft.unlink(missing_ok=True)


@contextmanager
def _storing(what: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageFailed(f"the service can't {what} its object store: {error.strerror}.") from error
