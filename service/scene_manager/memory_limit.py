"""Which scenes are dropped so that another one fits: the least recently used, and none in vain."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from service.scene_manager.entry import Entry
from service.scene_manager.scene_errors import too_large


@dataclass(frozen=True, slots=True)
class MemoryLimit:
    """`most_bytes` for all scenes together; None: no limit."""

    most_bytes: int | None

    def require(self, entry: Entry, needed: int) -> None:
        """Raise SceneTooLarge if a scene can't fit even alone: nothing is dropped for it."""
        if not self.could_hold(needed):
            raise too_large(f"scene '{entry.id}' takes", needed, self.most_bytes or 0, "serve a smaller scene")

    def require_together(self, entries: Sequence[Entry]) -> None:
        """Raise SceneTooLarge if scenes that are searched together can't be in memory together."""
        if self.most_bytes is None or all(entry.loaded for entry in entries):
            return
        sizes = [entry.memory_bytes or entry.expected_bytes() for entry in entries]
        for entry, needed in zip(entries, sizes, strict=True):
            self.require(entry, needed)
        if not self.could_hold(sum(sizes)):
            what, otherwise = f"the {len(entries)} scenes take", "name fewer scenes in one request"
            raise too_large(what, sum(sizes), self.most_bytes, otherwise)

    def could_hold(self, needed: int) -> bool:
        """Whether so much fits if nothing else is there."""
        return self.most_bytes is None or needed <= self.most_bytes

    def to_drop(
        self, entry: Entry, needed: int, entries: Sequence[Entry], kept: Collection[str] = ()
    ) -> list[Entry] | None:
        """Return what to drop so that `needed` bytes fit beside the rest; None if that isn't possible now.

        `kept`: ids of scenes that stay though no job uses them yet.
        """
        there = [other for other in entries if other.loaded and other is not entry]
        total = sum(other.memory_bytes for other in there)
        dropped: list[Entry] = []
        if self.most_bytes is None:
            return dropped
        for other in sorted((e for e in there if e.is_idle and e.id not in kept), key=lambda e: e.used):
            if total + needed <= self.most_bytes:
                break
            total -= other.memory_bytes
            dropped.append(other)
        return dropped if total + needed <= self.most_bytes else None

    def that_fit(self, entries: Sequence[Entry]) -> list[Entry]:
        """Return scenes that fit into memory together: first what is there, then the most recently used.

        Without a limit those that are there, or else on their way, or else all: nobody has said how many may come.
        """
        ready = [entry for entry in entries if entry.state == "ready"]
        coming = [entry for entry in entries if entry.state in ("loading", "preparing")]
        if self.most_bytes is None:
            return ready or coming or [entry for entry in entries if _may_come(entry)]
        # What jobs use stays beside them.
        total = sum(e.memory_bytes for e in entries if e.loaded and (e.jobs or e in ready))
        found = list(ready)
        for entry in sorted((e for e in entries if e not in ready and _may_come(e)), key=lambda e: -e.used):
            needed = entry.memory_bytes or entry.expected_bytes()
            # Of unknown size: it would be found out by loading it.
            if needed and total + needed <= self.most_bytes:
                found.append(entry)
                total += needed
        return found


def _may_come(entry: Entry) -> bool:
    return entry.wanted and entry.state in ("unloaded", "loading", "preparing")
