"""Jobs: their life, the queue, the threads that run them. Knows `localize`, not HTTP.

A job is queued, runs on one thread, and ends as succeeded, failed or cancelled. Everything is in memory:
finished jobs are remembered up to a number, their photos as JPEG. Where jobs run is behind `Executor`.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, Protocol, runtime_checkable

from service.api.schemas import JobState
from service.errors import JobNotFound, JobNotReady, QueueFull, RecordNotFound
from service.images import encode_image
from service.localize import Cancelled, LoadedScene, Request, localize
from service.types import IterationRecord, Pose, PoseEstimate, Query, StageTiming

_log = logging.getLogger(__name__)

_GRACE_S = 5.0
FINISHED: frozenset[JobState] = frozenset({"succeeded", "failed", "cancelled"})


@dataclass(frozen=True, slots=True)
class Task:
    """What a job has to do besides its photo; validated."""

    scene: LoadedScene
    request: Request
    options: dict[str, Any]
    """As the caller gave them; `request.options` is the same, parsed."""
    photo_name: str
    photo_sha256: str
    decode: StageTiming
    truth: Pose | None
    """For measuring errors; neither the query nor the request has it."""


@dataclass(frozen=True, slots=True)
class JobFilter:
    """Which jobs to list; None: any."""

    scene: str | None = None
    estimator: str | None = None
    state: str | None = None
    status: str | None = None
    """Of the result."""
    photo: str | None = None
    """sha256 of the file."""
    before: int | None = None
    """Only jobs accepted before the one with that number."""

    def fits(self, job: Job) -> bool:
        estimate = job.estimate
        facts = {
            "scene": job.task.scene.scene.info.id,
            "estimator": job.task.request.estimator,
            "state": job.state,
            "status": estimate and estimate.verdict.status,
            "photo": job.task.photo_sha256,
        }
        wanted = {name: getattr(self, name) for name in facts}
        return all(value in (None, facts[name]) for name, value in wanted.items()) and (
            self.before is None or job.number < self.before
        )


class Job:
    """One localization and all that is known of it. Changed by its worker's thread, read by any."""

    def __init__(self, task: Task, query: Query) -> None:
        self.id = secrets.token_hex(8)
        self.number = 0
        """In the order of acceptance, from 1."""
        self.task = task
        self.intrinsics = query.intrinsics
        """Of the photo that `jpeg` returns."""
        self.prior = query.prior
        self.cancel = threading.Event()
        self.created = datetime.now(UTC)
        self.started: datetime | None = None
        self.finished: datetime | None = None
        self.records: list[IterationRecord] = []
        self.estimate: PoseEstimate | None = None
        self.error: Exception | None = None
        self._state: JobState = "queued"
        self._query: Query | None = query
        self._jpeg = b""
        self._listeners: set[Callable[[], None]] = set()
        self._lock = threading.Lock()

    @property
    def state(self) -> JobState:
        return self._state

    @property
    def done(self) -> bool:
        return self._state in FINISHED

    def record(self, index: int | None) -> IterationRecord:
        """Return a record; None: the latest. Raises JobNotReady if it may still come, else RecordNotFound."""
        known = len(self.records)
        if known and (index is None or index < known):
            return self.records[-1 if index is None else index]
        kind = RecordNotFound if self.done else JobNotReady
        raise kind(f"the job has {known} records and is {self.state}.", where="iterations")

    def jpeg(self) -> bytes:
        """Return the photo as the estimator saw it: upright, undistorted, perhaps reduced."""
        query = self._query  # read before _jpeg, since `shrink` writes them in the other order
        return self._jpeg or (encode_image(query.rgb) if query else b"")

    def run(self) -> None:
        """Localize on the calling thread, unless the job was cancelled while it waited."""
        query = self._query
        if query is None or not self.advance("queued", "running"):
            return
        try:
            request = replace(self.task.request, cancel=self.cancel)
            self.estimate = localize(query, self.task.scene, request, self._add)
        except Cancelled:
            self.advance("running", "cancelled")
        except Exception as error:  # a job's failure, even by a bug, must not end its worker
            _log.exception("job %s failed", self.id)
            self.error = error
            self.advance("running", "failed")
        else:
            self.advance("running", "succeeded")

    def shrink(self) -> None:
        """Keep the photo of an ended job as JPEG only."""
        self._jpeg = self.jpeg()
        self._query = None

    def advance(self, expected: JobState, state: JobState) -> bool:
        """Change the state if it still is what the caller believes it to be."""
        with self._lock:
            if self._state != expected:
                return False
            if state == "running":
                self.started = datetime.now(UTC)
            if state in FINISHED:
                self.finished = datetime.now(UTC)
            self._state = state
        self._announce()
        return True

    async def changes(self) -> AsyncIterator[bool]:
        """Yield `done` at once and after each change, up to the first True. Changes may be merged."""
        loop, changed = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            loop.call_soon_threadsafe(changed.set)

        with self._lock:
            self._listeners.add(wake)
        try:
            done = False
            while not done:
                changed.clear()
                done = self.done
                yield done
                if not done:
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

    def _add(self, record: IterationRecord) -> None:
        self.records.append(record)
        self._announce()

    def _announce(self) -> None:
        with self._lock:
            for wake in self._listeners:
                wake()


@runtime_checkable
class Executor(Protocol):
    """Where jobs run: here threads; machines, if one is not enough, fit behind the same four calls."""

    def submit(self, job: Job) -> None:
        """Take the job, to run it some time. Raises QueueFull."""
        ...

    def withdraw(self, job: Job) -> None:
        """Give back the place in the queue of a job that needn't run any more."""
        ...

    def waiting(self) -> int:
        """Return how many jobs wait."""
        ...

    def close(self) -> None:
        """Take and start no more jobs; return when none is running, or soon anyway."""
        ...


class ThreadExecutor:
    """A bounded queue and a fixed number of threads; each runs one job at a time."""

    def __init__(self, run: Callable[[Job], None], workers: int, queue_size: int) -> None:
        self._run, self._queue_size = run, queue_size
        self._queue: deque[Job] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._idle = workers
        # Daemons: a job that doesn't come to its next record must not keep the process from ending.
        self._threads = [threading.Thread(target=self._work, name=f"job-{i}", daemon=True) for i in range(workers)]
        for thread in self._threads:
            thread.start()

    def submit(self, job: Job) -> None:
        with self._changed:
            if self._closed or len(self._queue) >= self._queue_size + self._idle:
                raise QueueFull(f"{len(self._queue)} jobs are waiting.", hint="Try again later.")
            self._queue.append(job)
            self._changed.notify()

    def withdraw(self, job: Job) -> None:
        with self._changed, suppress(ValueError):
            self._queue.remove(job)

    def waiting(self) -> int:
        return len(self._queue)

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._queue.clear()
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(_GRACE_S)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._closed)
                if self._closed:
                    return
                job = self._queue.popleft()
                self._idle -= 1
            self._run(job)
            with self._changed:
                self._idle += 1


class Jobs:
    """All jobs that are remembered."""

    def __init__(self, workers: int, queue_size: int, keep: int) -> None:
        self._keep = keep
        self._jobs: dict[str, Job] = {}
        self._accepted = 0
        self._lock = threading.Lock()
        self._executor: Executor = ThreadExecutor(self._run, workers, queue_size)

    def submit(self, task: Task, query: Query) -> Job:
        """Queue a job. Raises QueueFull."""
        job = Job(task, query)
        with self._lock:
            self._executor.submit(job)
            self._accepted += 1
            job.number = self._accepted
            self._jobs[job.id] = job
        return job

    def get(self, job_id: str) -> Job:
        """Raises JobNotFound."""
        with self._lock:
            job = self._jobs.get(job_id)
        if job is None:
            raise JobNotFound(f"there is no job '{job_id}', or it was forgotten.", where="job")
        return job

    def newest_first(self) -> list[Job]:
        with self._lock:
            return list(reversed(self._jobs.values()))

    def page(self, wanted: JobFilter, limit: int) -> list[Job]:
        """Return the newest jobs that fit, at most `limit`."""
        return [job for job in self.newest_first() if wanted.fits(job)][:limit]

    def waiting(self) -> int:
        return self._executor.waiting()

    def running(self) -> int:
        return sum(job.state == "running" for job in self.newest_first())

    def cancel(self, job: Job) -> None:
        """Cancel at once if the job waits, between two records if it runs; no effect once it has ended."""
        job.cancel.set()
        if job.advance("queued", "cancelled"):
            self._executor.withdraw(job)
            self._retire(job)

    def close(self) -> None:
        """Cancel everything and wait for the workers."""
        for job in self.newest_first():
            self.cancel(job)
        self._executor.close()

    def _run(self, job: Job) -> None:
        job.run()
        self._retire(job)

    def _retire(self, job: Job) -> None:
        job.shrink()
        with self._lock:
            ended = [j for j in self._jobs.values() if j.done]
            for old in ended[: max(0, len(ended) - self._keep)]:
                del self._jobs[old.id]
