"""A scene's registrations on disk: `registration.json` beside the scene, or in the data folder where that can't be.

The file holds the latest revisions, the last of which is in force; undoing drops it, and its number isn't used again.
It is no part of the scene's digest: a registration changes no render, so no index is made again.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from pathlib import Path

from service.codec import decode, encode
from service.errors import CorruptScene, RegistrationNotFound
from service.registration.registration import Registration
from service.scene_formats.remote_scene import RemoteScene
from service.scene_formats.side_file import SideFile

FILE = "registration.json"
KEPT = 20
"""Revisions; older ones are dropped."""
_MAX_BYTES = 16 * 1024 * 1024
# One for all scenes: `RegistrationFile` is a value, several of which may name one file, and registering is rare.
_LOCK = threading.Lock()


@dataclass(frozen=True, slots=True)
class History:
    """The registrations of a scene that are kept, oldest first."""

    last_revision: int = 0
    """The highest number that was ever given."""
    revisions: tuple[Registration, ...] = ()


@dataclass(frozen=True, slots=True)
class RegistrationFile:
    """The file of one scene; safe from several threads; readers never see half a file."""

    scene: Path
    """Scene folder or scene file."""
    data_folder: Path | None = None
    """Where the file goes if it can't be written beside the scene."""
    remote: RemoteScene | None = None
    """Where the scene comes from, if it is in an object store."""

    @property
    def path(self) -> Path:
        """Where the registrations are."""
        return self._file.path

    @property
    def _file(self) -> SideFile:
        return SideFile(self.scene, FILE, self.data_folder, self.remote)

    def current(self) -> Registration | None:
        """Return the registration in force. Raises CorruptScene."""
        revisions = self.history().revisions
        return revisions[-1] if revisions else None

    def history(self) -> History:
        """Return all revisions that are kept. Raises CorruptScene."""
        path = self.path
        try:
            if path.stat().st_size > _MAX_BYTES:
                raise CorruptScene(f"larger than {_MAX_BYTES} bytes.", where=path.name)
            return decode(History, path.read_text("utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            return History()
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            raise CorruptScene(
                f"no registrations can be read: {str(error)[:200]}.", where=path.name, hint="Delete it, register again."
            ) from None

    def add(self, registration: Registration) -> Registration:
        """Put a registration in force; return it with its revision. Raises StorageFailed, CorruptScene."""
        with _LOCK:
            self._file.forget_copy()
            before = self.history()
            number = before.last_revision + 1
            added = replace(registration, revision=number)
            self._write(History(number, (*before.revisions, added)[-KEPT:]))
        return added

    def undo(self) -> Registration | None:
        """Drop the registration in force; return the one before it, if there is one.

        Raises RegistrationNotFound, CorruptScene.
        """
        with _LOCK:
            self._file.forget_copy()
            before = self.history()
            if not before.revisions:
                raise RegistrationNotFound("the scene is not registered.", where="scene")
            self._write(replace(before, revisions=before.revisions[:-1]))
        return before.revisions[-2] if len(before.revisions) > 1 else None

    def _write(self, history: History) -> None:
        self._file.write(encode(history) + "\n")
