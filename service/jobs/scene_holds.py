"""Who holds which scenes in which replica, and which fronts are alive."""

from __future__ import annotations

import time
from dataclasses import dataclass

from service.jobs.engine import HeldScenes

_FRONT_S = 30.0
"""A front without a heartbeat for so long is taken to have ended."""


@dataclass(frozen=True, slots=True)
class HeldAt:
    """Scenes that are held, and the replica where they are."""

    held: HeldScenes
    replica: str
    """Its name: an answer with a handle takes some ms longer."""


@dataclass(frozen=True, slots=True)
class Hold:
    """Scenes that a front uses in a replica; the front is "" where none does."""

    front: str
    replica: str
    ids: tuple[str, ...]


class SceneHolds(dict[str, Hold]):
    """Holds by their tokens."""

    def __init__(self) -> None:
        super().__init__()
        self._fronts: dict[str, float] = {}

    def record(self, token: str, hold: Hold) -> None:
        """Add a hold. Its front is alive."""
        if hold.front:
            self._fronts.setdefault(hold.front, time.monotonic())
        self[token] = hold

    def jobs(self, scene_id: str) -> int:
        """Return how many hold a scene."""
        return sum(scene_id in hold.ids for hold in self.values())

    def forget_replica(self, replica: str) -> None:
        """Drop the holds in a replica that has ended."""
        for token in [token for token, hold in self.items() if hold.replica == replica]:
            del self[token]

    def heard(self, front: str) -> None:
        """Note that a front is alive."""
        self._fronts[front] = time.monotonic()

    def ended_fronts(self) -> dict[str, list[str]]:
        """Return the fronts that weren't heard of for 30 s, once, and the tokens that each still holds."""
        late = time.monotonic() - _FRONT_S
        ended = [front for front, heard in self._fronts.items() if heard < late]
        for front in ended:
            del self._fronts[front]
        return {front: [token for token, hold in self.items() if hold.front == front] for front in ended}
