"""Actions posted by many threads and run by one."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable

Action = Callable[[], None]


class ActionQueue:
    """Waiting actions in order of their first posting.

    An action posted under the key of a waiting one replaces it, so that a dragged slider or a fast job never queues
    up work.
    """

    def __init__(self) -> None:
        self._actions: dict[Hashable, Action] = {}
        self._closed = False
        self._changed = threading.Condition()

    def post(self, action: Action, key: Hashable = None) -> None:
        """Queue an action; by default its key is the action itself."""
        with self._changed:
            # A dict keeps the place of a key whose value is replaced.
            self._actions[action if key is None else key] = action
            self._changed.notify()

    def take(self, timeout_s: float | None) -> list[Action] | None:
        """Return all waiting actions; wait for one until the timeout (None: without end). None once it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._actions, timeout_s)
            actions, self._actions = list(self._actions.values()), {}
            return None if self._closed else actions

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._closed

    def close(self) -> None:
        """Let `take` return None from now on."""
        with self._changed:
            self._closed = True
            self._changed.notify()
