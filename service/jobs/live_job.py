"""An unfinished job in memory: its decoded photo, the records of its attempt, and listeners for both."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress

from service.errors import SplatfixError
from service.jobs.engine import HeldScenes
from service.jobs.model import JobRecord
from service.jobs.read_photo import DecodedPhoto
from service.types import Query


class LiveJob:
    """Changed by its worker's thread, read by any."""

    def __init__(
        self, job_id: str, scene: str, photo: DecodedPhoto | None = None, held: HeldScenes | None = None
    ) -> None:
        self.id, self.scene = job_id, scene
        self.photo = photo
        """Decoded; None after a restart, when it is on disk only."""
        self.shown: Query | None = photo and photo.query
        """The photo that clients get: of a sequence, the last that was localized."""
        self.held = held
        """Scenes that stay in memory for this job; None while it waits for them."""
        self.refused: SplatfixError | None = None
        """Why its scenes won't come into memory."""
        self.cancelled = threading.Event()
        self.progress: tuple[int, list[JobRecord]] = (0, [])
        """The attempt, 0 before the first, and its records: one value, so that readers never mix two attempts."""
        self.ended = threading.Event()
        """Its end is on disk, or it is over with this process."""
        self._dismissed = threading.Event()
        self._heard = time.monotonic()
        self._listeners: set[Callable[[], None]] = set()
        self._lock = threading.Lock()

    @property
    def attempt(self) -> int:
        """Number of the attempt, from 1; 0 before the first."""
        return self.progress[0]

    @property
    def records(self) -> list[JobRecord]:
        """Records of this attempt, in their order."""
        return self.progress[1]

    @property
    def stage(self) -> str | None:
        """Stage of the latest record; None before the first."""
        records = self.records
        return records[-1].step.stage if records else None

    @property
    def task_id(self) -> str:
        """The name of the attempt that runs."""
        return f"{self.id}.{self.attempt}"

    @property
    def has_listeners(self) -> bool:
        """Whether somebody waits for changes."""
        with self._lock:
            return bool(self._listeners)

    @property
    def memory_bytes(self) -> int:
        """Memory of the photo, bytes."""
        return self.shown.rgb.nbytes if self.shown else 0

    def mark_alive(self) -> None:
        """Record that its thread is alive."""
        self._heard = time.monotonic()

    def silent_s(self) -> float:
        """Return the seconds since its thread gave the last sign of life."""
        return time.monotonic() - self._heard

    def begin(self, attempt: int) -> None:
        """Begin an attempt, without the records of the one before."""
        self.mark_alive()
        self.progress = attempt, []
        self.announce()

    def add(self, record: JobRecord) -> None:
        """Publish a record."""
        self.mark_alive()
        self.records.append(record)
        self.announce()

    def end(self) -> None:
        """Announce that the job has ended."""
        self.ended.set()
        self.announce()

    def dismiss(self) -> None:
        """Send those away who listen; the job goes on."""
        self._dismissed.set()
        self.announce()

    def announce(self) -> None:
        """Wake those who listen."""
        with self._lock:
            for wake in self._listeners:
                with suppress(RuntimeError):  # the loop is closed: the service ends
                    wake()

    async def changes(self) -> AsyncIterator[bool]:
        """Yield whether it is over for listeners, at once and after each change, up to the first True.

        Changes may be merged.
        """
        loop, changed = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            # `asyncio.Event` may be set on its own thread only.
            loop.call_soon_threadsafe(changed.set)

        with self._lock:
            self._listeners.add(wake)
        try:
            ended = False
            while not ended:
                # Cleared before `ended` is read: a change after that sets it again, and none is missed.
                changed.clear()
                ended = self.ended.is_set() or self._dismissed.is_set()
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
