"""Where lenses are kept, as a protocol, and an implementation that forgets them with the process.

`service/jobs/sql_lens_store.py` is the implementation of the service.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from service.lenses.lens_estimate import LensEstimate
from service.lenses.lens_key import LensKey


@dataclass(frozen=True, slots=True)
class StoredLens:
    """A lens as it is kept: whose it is, and its estimate."""

    key: LensKey
    estimate: LensEstimate
    updated: float
    """When it was learnt from last, in seconds since 1970."""


@runtime_checkable
class LensStore(Protocol):
    """Lenses by their key's id, a limited number of them. Safe to call from several threads.

    Writing raises StorageFailed if it can't be done.
    """

    def find(self, lens_id: str) -> StoredLens | None:
        """Return a lens."""
        ...

    def change(self, key: LensKey, learn: Callable[[LensEstimate | None], LensEstimate]) -> None:
        """Replace a lens' estimate, None if there is none, by what `learn` makes of it; nobody changes it meanwhile.

        Where there are more lenses than the limit then, those that were changed longest ago go.
        """
        ...

    def lenses(self, owner: str | None = None) -> list[StoredLens]:
        """Return the lenses of an owner, or of all, latest change first."""
        ...

    def delete(self, lens_id: str | None = None, owner: str | None = None) -> int:
        """Delete a lens, or all, if they are the owner's, or anybody's; return how many."""
        ...

    def close(self) -> None:
        """Close files and connections; nothing is called afterwards."""
        ...


class MemoryLensStore:
    """Implements `LensStore`."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lenses: dict[str, StoredLens] = {}
        """In the order of their last change."""
        self._lock = threading.Lock()

    def find(self, lens_id: str) -> StoredLens | None:
        with self._lock:
            return self._lenses.get(lens_id)

    def change(self, key: LensKey, learn: Callable[[LensEstimate | None], LensEstimate]) -> None:
        with self._lock:
            known = self._lenses.get(key.id)
            changed = StoredLens(key, learn(known and known.estimate), time.time())
            # A dictionary keeps a changed entry's old place: it has to be taken out to become the latest.
            self._lenses.pop(key.id, None)
            self._lenses[key.id] = changed
            while len(self._lenses) > self._limit:
                del self._lenses[next(iter(self._lenses))]

    def lenses(self, owner: str | None = None) -> list[StoredLens]:
        with self._lock:
            return [lens for lens in reversed(self._lenses.values()) if owner in (None, lens.key.owner)]

    def delete(self, lens_id: str | None = None, owner: str | None = None) -> int:
        with self._lock:
            kept = {
                known: lens
                for known, lens in self._lenses.items()
                if (lens_id not in (None, known)) or (owner not in (None, lens.key.owner))
            }
            deleted = len(self._lenses) - len(kept)
            self._lenses = kept
            return deleted

    def close(self) -> None: ...
