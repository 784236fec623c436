"""One call at a time on a thread of lower priority, for what takes longer than a frame may."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

from service.operating_system import lower_priority

Result = TypeVar("Result")


class Background(Generic[Result]):
    """Runs one call at a time, on a thread that yields the core to its owner's. Its methods are for one thread."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "live", lower_priority)
        self._running: Future[Result] | None = None
        self._cancel = threading.Event()

    @property
    def idle(self) -> bool:
        """Whether nothing runs, and no result waits to be taken."""
        return self._running is None

    def start(self, call: Callable[[threading.Event], Result]) -> None:
        """Begin a call; the event that it gets is set when its result isn't wanted any more. Only while idle."""
        assert self._running is None
        # An event of its own: a call that was cancelled may still be ending, and must not be taken for this one.
        self._cancel = threading.Event()
        self._running = self._pool.submit(call, self._cancel)

    def result(self) -> Result | None:
        """Return what the call returned; None while it runs, or if none does. Raises what the call raised."""
        if self._running is None or not self._running.done():
            return None
        done, self._running = self._running, None
        return done.result()

    def cancel(self) -> None:
        """Set the call's event: its result isn't wanted."""
        self._cancel.set()

    def close(self) -> None:
        """Cancel the call, and wait until it has ended: it uses the scene."""
        self.cancel()
        self._pool.shutdown(wait=True)
