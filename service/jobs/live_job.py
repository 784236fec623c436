"""An unfinished job in memory: what its thread tells, and who listens. The store has the rest."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress

from service.localize import LoadedScene
from service.types import Query
from service.web.schemas.parsing import Task


class LiveJob:
    """Changed by its worker's thread, read by any."""

    def __init__(
        self,
        job_id: str,
        scene: str,
        task: Task | None = None,
        query: Query | None = None,
        held: tuple[LoadedScene, ...] = (),
    ) -> None:
        self.id, self.scene = job_id, scene
        self.task, self.query = task, query
        """The decoded request; None after a restart, when it is on disk only."""
        self.held = held
        """Scenes that stay in memory for this job; none after a restart."""
        self.cancel = threading.Event()
        self.attempt = 0
        """0: not started."""
        self.records: list[str] = []
        """Of this attempt, as JSON."""
        self.stage: str | None = None
        self.ended = threading.Event()
        """Its end is on disk, or it is over with this process."""
        self._heard = time.monotonic()
        self._listeners: set[Callable[[], None]] = set()
        self._lock = threading.Lock()

    @property
    def memory_bytes(self) -> int:
        return self.query.rgb.nbytes if self.query else 0

    def beat(self) -> None:
        """Take note that its thread is at work."""
        self._heard = time.monotonic()

    def silent_s(self) -> float:
        return time.monotonic() - self._heard

    def tell(self, record: str, stage: str) -> None:
        """Publish a record."""
        self.beat()
        self.records.append(record)
        self.stage = stage
        self.announce()

    def end(self) -> None:
        self.ended.set()
        self.announce()

    def announce(self) -> None:
        """Wake those who listen."""
        with self._lock:
            for wake in self._listeners:
                with suppress(RuntimeError):  # the loop is closed: the service ends
                    wake()

    async def changes(self) -> AsyncIterator[bool]:
        """Yield `ended` at once and after each change, up to the first True. Changes may be merged."""
        loop, changed = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            loop.call_soon_threadsafe(changed.set)

        with self._lock:
            self._listeners.add(wake)
        try:
            ended = False
            while not ended:
                changed.clear()
                ended = self.ended.is_set()
                yield ended
                if not ended:
                    await changed.wait()
        finally:
            with self._lock:
                self._listeners.discard(wake)

    async def wait(self, seconds: float) -> None:
        """Return when the job has ended, or after that time."""
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                async for _ in self.changes():
                    pass
