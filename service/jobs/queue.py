"""A bounded queue of jobs and a fixed number of threads that work it off, watched over.

Python threads can't be stopped from outside. A thread whose job has no new record for `stuck_s` is abandoned: its job
is ended, another thread replaces it, and the store refuses what it may still write.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from service.errors import QueueFull
from service.jobs.live_job import LiveJob

_log = logging.getLogger(__name__)

_WATCH_S = 0.5


class JobQueue:
    """Each thread runs one job at a time. `give_up` is called with a job whose thread was abandoned."""

    def __init__(
        self,
        run: Callable[[LiveJob], None],
        give_up: Callable[[LiveJob], None],
        *,
        workers: int,
        queue_size: int,
        queue_bytes: int,
        stuck_s: float,
    ) -> None:
        self._run, self._give_up = run, give_up
        self._queue_size, self._queue_bytes, self._stuck_s = queue_size, queue_bytes, stuck_s
        self._queue: deque[LiveJob] = deque()
        self._reserved = self._stuck = 0
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._workers: set[_Worker] = set()
        for _ in range(workers):
            self._add_worker()
        threading.Thread(target=self._watch, name="watch", daemon=True).start()

    def full(self) -> bool:
        """Return whether another job would be refused."""
        with self._changed:
            return self._full()

    def _full(self) -> bool:
        idle = sum(worker.job is None for worker in self._workers)
        taken = len(self._queue) + self._reserved
        # The number of jobs alone does not limit what their photos take.
        held = sum(job.memory_bytes for job in self._queue)
        return self._closed.is_set() or taken >= self._queue_size + idle or held > self._queue_bytes

    def reserve(self) -> None:
        """Take a place in the queue for a job that is about to come. Raises QueueFull."""
        with self._changed:
            if self._full():
                raise QueueFull(f"the queue is full: {len(self._queue)} jobs.", hint="Try again later.")
            self._reserved += 1

    def release(self) -> None:
        """Give back a place that was reserved for a job that doesn't come."""
        with self._changed:
            self._reserved -= 1

    def submit(self, job: LiveJob, *, reserved: bool = True) -> None:
        """Queue the job, on the place that was reserved for it."""
        with self._changed:
            self._reserved -= reserved
            self._queue.append(job)
            self._changed.notify()

    def withdraw(self, job: LiveJob) -> None:
        """Give back the place of a job that needn't run any more."""
        with self._changed, suppress(ValueError):
            self._queue.remove(job)

    def idle(self) -> int:
        """Return how many workers have nothing to do, and won't have by what waits here."""
        with self._changed:
            return sum(worker.job is None for worker in self._workers) - len(self._queue) - self._reserved

    def waiting(self) -> int:
        """Return how many jobs wait."""
        return len(self._queue)

    def stuck(self) -> int:
        """Return how many threads were abandoned."""
        return self._stuck

    def close(self, grace_s: float) -> None:
        """Take and start no more jobs; return when none is running, or after the grace period."""
        with self._changed:
            self._closed.set()
            self._queue.clear()  # they wait on disk
            self._changed.notify_all()
            workers = list(self._workers)
        deadline = time.monotonic() + grace_s
        for worker in workers:
            worker.thread.join(max(0.0, deadline - time.monotonic()))

    def _add_worker(self) -> None:
        worker = _Worker()
        # Daemons: a job that doesn't come to its next record must not keep the process from ending.
        worker.thread = threading.Thread(target=self._work, args=(worker,), name="job", daemon=True)
        self._workers.add(worker)
        worker.thread.start()

    def _work(self, worker: _Worker) -> None:
        while not worker.abandoned:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._closed.is_set())
                if self._closed.is_set():
                    return
                worker.job = self._queue.popleft()
                worker.job.mark_alive()
            try:
                self._run(worker.job)
            except Exception:
                _log.exception("job %s: its end could not be recorded", worker.job.id)
            worker.job = None

    def _watch(self) -> None:
        while not self._closed.wait(_WATCH_S):
            for worker in tuple(self._workers):
                job = worker.job
                if job is not None and job.silent_s() > self._stuck_s:
                    self._abandon(worker, job)

    def _abandon(self, worker: _Worker, job: LiveJob) -> None:
        worker.abandoned = True
        with self._changed:
            self._workers.discard(worker)
            # A thread cannot be killed: it is left alone, and another one takes its place.
            self._stuck += 1
            self._add_worker()
        _log.error("job %s had no new record for %.0f s: its worker is abandoned", job.id, self._stuck_s)
        try:
            self._give_up(job)
        except Exception:
            _log.exception("job %s: its end could not be recorded", job.id)


class _Worker:
    def __init__(self) -> None:
        self.thread = threading.current_thread()
        self.job: LiveJob | None = None
        self.abandoned = False
