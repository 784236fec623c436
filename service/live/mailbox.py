"""Holds the newest frame of a session until it is used; an older one that was not used makes room for it."""

from __future__ import annotations

import threading
import time

from service.live.live_values import LiveFrame


class Mailbox:
    """At most one frame waits. Safe to call from several threads."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: tuple[LiveFrame, float] | None = None
        self._dropped: list[int] = []
        self._closed = False

    def put(self, frame: LiveFrame) -> None:
        """Let a frame wait in place of the one that waits so far."""
        with self._changed:
            if self._waiting is not None:
                self._dropped.append(self._waiting[0].id)
            self._waiting = frame, time.perf_counter()
            self._changed.notify()

    def take(self) -> tuple[LiveFrame, float, tuple[int, ...]] | None:
        """Wait for a frame; return it, when it came (`time.perf_counter`), and the ids of those dropped since the last.

        None after `close`, even if a frame waits: nobody would read its answer.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._waiting is not None)
            if self._closed or self._waiting is None:
                return None
            frame, came = self._waiting
            dropped, self._dropped, self._waiting = tuple(self._dropped), [], None
            return frame, came, dropped

    def close(self) -> None:
        """End the wait of `take`, now and for ever."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
