"""GPU memory that the renders and features of concurrent jobs share under one budget.

A call tells what it is going to take, by an estimate, and waits until that fits beside what other calls have taken.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

FREE_SHARE = 0.8
"""Of the memory that is free beside the scenes: the budget where none is set. Estimates are rough, and pools have
gaps."""


class DeviceMemory:
    """The memory of one device; safe to use from several threads."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._set_bytes: int | None = None
        self._free_bytes: float = math.inf
        self._taken: list[float] = []
        self._waiting: deque[object] = deque()

    @property
    def budget_bytes(self) -> float:
        """What calls may take together: what was set, else a share of what was free; infinite if neither is known."""
        return FREE_SHARE * self._free_bytes if self._set_bytes is None else self._set_bytes

    def set_budget(self, budget_bytes: int | None) -> None:
        """Set the budget; None: a share of what is free."""
        with self._changed:
            self._set_bytes = budget_bytes
            self._changed.notify_all()

    def note_free(self, free_bytes: float) -> None:
        """Tell what the device has left for calls, scenes having been copied to it."""
        with self._changed:
            self._free_bytes = free_bytes
            self._changed.notify_all()

    @contextmanager
    def taken(self, wanted_bytes: float) -> Iterator[None]:
        """Wait until so much fits into the budget, and take it for the block; more than the budget: until alone.

        In the order of asking, so that none waits for ever.
        """
        turn = object()
        with self._changed:
            self._waiting.append(turn)
            self._changed.wait_for(lambda: self._waiting[0] is turn and self._fits(wanted_bytes))
            self._waiting.popleft()
            self._taken.append(wanted_bytes)
            self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._taken.remove(wanted_bytes)
                self._changed.notify_all()

    def _fits(self, wanted_bytes: float) -> bool:
        return not self._taken or sum(self._taken) + wanted_bytes <= self.budget_bytes


DEVICE_MEMORY = DeviceMemory()
"""Of the one device that a process uses."""
