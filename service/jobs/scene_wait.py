"""Jobs whose scenes are not in memory yet: they are queued as soon as the scenes are, or won't come."""

from __future__ import annotations

import time
from collections.abc import Sequence

from service.errors import DeadlineExceeded, Failure, SplatfixError
from service.jobs.engine import Engine, HeldScenes
from service.jobs.live_job import LiveJob
from service.jobs.model import Ending
from service.jobs.queue import JobQueue
from service.jobs.store import JobStore
from service.jobs.worker import Worker


class SceneWait:
    """Safe to use from several threads."""

    def __init__(self, engine: Engine, queue: JobQueue, store: JobStore, worker: Worker) -> None:
        self._engine, self._queue, self._store, self._worker = engine, queue, store, worker
        self._jobs: dict[str, LiveJob] = {}

    def submit(self, live: LiveJob, asked: str | Sequence[str] | None, *, reserved: bool) -> None:
        """Queue a job once its scenes are in memory, where they stay for it, or certain not to come there.

        `reserved`: a place in the queue is kept for it meanwhile.
        """
        self._jobs[live.id] = live

        def take(found: HeldScenes | SplatfixError) -> None:
            if isinstance(found, SplatfixError):
                live.refused = found
            else:
                live.held = found
            self._jobs.pop(live.id, None)
            if not live.ended.is_set():
                self._queue.submit(live, reserved=reserved)
                return
            if live.held is not None:  # it was cancelled meanwhile
                self._engine.release(live.held.token)
            if reserved:
                self._queue.release()

        self._engine.hold_later(asked, take)

    def expire(self) -> None:
        """End the jobs whose deadlines are over. Raises StorageFailed."""
        for live in tuple(self._jobs.values()):
            job = self._store.get(live.id)
            if job.deadline is not None and job.deadline < time.time():
                error = DeadlineExceeded("the deadline was over before its scene was in memory.", where="deadline_s")
                end = Ending("failed", failure=Failure.of(error))
                if self._store.end_queued(job, end, self._worker.photo_until()):
                    self._worker.clean_up(live)
