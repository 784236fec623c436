"""One attempt of a job on a worker's thread: claim it, localize, store its records in batches and its end once."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from service.errors import DeadlineExceeded, Failure, Interrupted, SceneError, StorageFailed
from service.jobs.config import JobsConfig, Observer
from service.jobs.engine import Engine, EngineAnswer, EngineLost
from service.jobs.live_job import LiveJob
from service.jobs.model import Batch, Ending, JobRecord, StoredJob
from service.jobs.photo_store import PhotoStore
from service.jobs.read_photo import read_photo
from service.jobs.store import JobStore
from service.lenses.lens_memory import LensMemory
from service.localize import Cancelled
from service.logs import bound
from service.photos.images import encode_image
from service.types import Query

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

_BATCH_S = 0.5
_RETRY_S = 0.5


class _AttemptLost(Exception):
    """The attempt's lease has ended, or the job has: its records and its result would be refused."""


class Worker:
    """Runs attempts, one on each thread that calls `run`."""

    def __init__(
        self,
        config: JobsConfig,
        engine: Engine,
        store: JobStore,
        photos: PhotoStore,
        observer: Observer,
        lenses: LensMemory | None,
    ) -> None:
        self._config, self._engine, self._observer, self._lenses = config, engine, observer, lenses
        self._store, self._photos = store, photos
        self.live: dict[str, LiveJob] = {}
        """The jobs that haven't ended."""
        self.running: set[tuple[str, int]] = set()
        """The attempts (job, number) whose leases are to be renewed."""
        self.busy: Counter[str] = Counter()
        """The threads that are at a job, from before its claim until after its end: two if it lost its lease here."""
        self._busy_lock = threading.Lock()
        self.lost: Callable[[LiveJob], None] = lambda live: None
        """Called with a job that isn't this process' any more, where others share the store."""
        self.closing = threading.Event()
        """Set while the service ends: unfinished jobs are queued again for the next start."""
        self.storage_error = ""
        """Why the stores can't be written; empty while they can."""

    # ------------------------------------------------------------------ an attempt

    def run(self, live: LiveJob) -> None:
        """Make one attempt, unless the job was cancelled while it waited."""
        with bound(job_id=live.id):
            with self._busy_lock:
                self.busy[live.id] += 1
            ours = False
            try:
                ours = self._run(live)
            finally:
                with self._busy_lock:
                    self.busy[live.id] -= 1
                    self.busy += Counter()  # without those that are at zero
                if not ours and live.id not in self.busy:
                    self.lost(live)

    def give_up(self, live: LiveJob) -> None:
        """End a job whose thread is stuck."""
        error = Interrupted(f"the job had no new record for {self._config.stuck_s:g} s and was given up.")
        # The records in memory are left out: the stuck thread may still add to them.
        nothing = Batch(len(self._store.records(live.id)), ())
        end = Ending("interrupted", failure=Failure.of(error))
        if self._store.finish(live.id, live.attempt, nothing, end, self.photo_until()):
            live.cancelled.set()
            self._engine.cancel(live.task_id)
            self.clean_up(live)

    def _run(self, live: LiveJob) -> bool:
        """Claim a job and make an attempt; return False if the job is another's, or will be made again."""
        job = self._persisted(live, lambda: self._store.get(live.id))
        if job is None:
            return True  # the service ends
        attempt = self._persisted(live, lambda: self._store.claim(job, self._store.now() + self._config.lease_s))
        if attempt is None:
            return self.closing.is_set() or self._refused(live)
        self._observer.started(time.time() - job.created)
        live.begin(attempt)
        self.running.add((job.id, attempt))
        try:
            return self._carry_out(live, job, attempt)
        finally:
            self.running.discard((job.id, attempt))

    def _refused(self, live: LiveJob) -> bool:
        """End a job that can't be claimed because it was cancelled; return False if that isn't why."""
        job = self._store.get(live.id)
        if not job.cancelled:
            return False
        if self._store.end_queued(job, Ending("cancelled"), self.photo_until()):
            self.clean_up(live)
        return job.ended or job.state == "queued"

    def _carry_out(self, live: LiveJob, job: StoredJob, attempt: int) -> bool:
        """Make an attempt that was claimed, and put its end on record; return whether that was done."""
        stored = _Stored(attempt)
        try:
            end = self._attempt(live, job, stored)
        except _AttemptLost:
            _log.warning("job %s: attempt %d was lost to another", job.id, attempt)
            return False
        except EngineLost:
            # Without its lease it counts as lost: a job that crashes its engine must not be tried without end.
            _log.error("job %s: its engine ended in attempt %d", job.id, attempt)
            live.held = None
            self.running.discard((job.id, attempt))
            self._persisted(live, lambda: self._store.renew([(job.id, attempt)], 0.0))
            return False
        if end is None:
            self._persisted(live, lambda: self._store.requeue(job.id, attempt))
            return True
        batch = Batch(stored.count, live.records[stored.count :])
        until = self.photo_until()
        if not self._persisted(live, lambda: self._store.finish(job.id, attempt, batch, end, until)):
            return False
        status = end.result.estimate.verdict.status if end.result else ""
        _log.info("job %s: %s %s", job.id, end.state, status)
        self.clean_up(live)
        return True

    def _attempt(self, live: LiveJob, job: StoredJob, stored: _Stored) -> Ending | None:
        """Localize; None if it was stopped because the service ends."""
        try:
            answer = self._localize(live, job, stored)
            for timing in answer.result.estimate.timings:
                self._observer.stage(job.estimator, timing.stage, timing.wall_s)
            self._observer.renders(job.estimator, answer.result.estimate.renders)
            self._learn(live, job, answer)
            several = job.spec.names_several_scenes
            return Ending("succeeded", answer.result, scene=answer.scene if several else None)
        except Cancelled:
            stopped = self.closing.is_set() and not self._store.get(job.id).cancelled
            return None if stopped else Ending("cancelled")
        except (_AttemptLost, EngineLost):
            raise
        except Exception as error:  # a job's failure, even by a bug, must not end its worker
            expected = isinstance(error, DeadlineExceeded | SceneError)
            _log.error("job %s failed: %s", job.id, error, exc_info=not expected)
            state = "interrupted" if isinstance(error, SceneError) else "failed"
            return Ending(state, failure=Failure.of(error))

    def _localize(self, live: LiveJob, job: StoredJob, stored: _Stored) -> EngineAnswer:
        spec, budget_s = job.spec, self._budget_s(job)
        if live.refused:
            raise live.refused
        # Of an attempt whose engine ended nothing is in memory; a job of several scenes looks in all of them again.
        if live.held is None:
            live.held = self._engine.hold(spec.scene if spec.names_several_scenes else job.scene)
        if live.photo is None:
            data = self._photos.original(job.id)
            live.photo = read_photo(data, spec, live.held.background_rgb, self._config.max_frames)
            live.shown = live.photo.query
        task = live.photo.task(spec, live.task_id, live.held.token, budget_s)

        def on_record(record: JobRecord, shown: Query | None) -> None:
            # `cancel` may have come before the engine knew the attempt.
            if live.cancelled.is_set():
                raise Cancelled
            if shown is not None:
                live.shown = shown
            self._add(live, stored, record)

        return self._engine.localize(task, on_record)

    def _learn(self, live: LiveJob, job: StoredJob, answer: EngineAnswer) -> None:
        """Update the memory of the photo's lens: before the end is on record, so that the next photo profits.

        An attempt that is lost now is made again, and its answer, from the same viewpoint, changes nothing more.
        """
        if self._lenses is None or job.spec.lens is None or live.photo is None:
            return
        use, estimate = job.spec.lens, answer.result.estimate
        try:
            self._lenses.learn(use.owner, job.spec.camera_id, live.photo.camera, use.recalled, estimate)
        except StorageFailed as error:  # the answer is as good without
            self.note_storage(error)

    def _add(self, live: LiveJob, stored: _Stored, record: JobRecord) -> None:
        # The thread of an attempt that was given up may come to life again.
        if live.attempt != stored.attempt:
            raise _AttemptLost
        live.add(record)
        # Each batch is a commit that waits for the disk: one for each record would slow the search.
        if time.monotonic() - stored.at < _BATCH_S:
            return
        batch = Batch(stored.count, live.records[stored.count :])
        try:
            if not self._store.append(live.id, stored.attempt, batch):
                raise _AttemptLost
        except StorageFailed as error:  # they stay in memory, and go with the next batch
            self.note_storage(error)
        else:
            stored.count += len(batch.records)
        stored.at = time.monotonic()

    def _budget_s(self, job: StoredJob) -> float:
        """What is left of the caller's budget, the caller's deadline and the operator's limit."""
        left = None if job.deadline is None else job.deadline - time.time()
        if left is not None and left <= 0:
            raise DeadlineExceeded("the deadline was over before the job could start.", where="deadline_s")
        return min(limit for limit in (job.spec.budget_s, left, self._config.max_job_s) if limit is not None)

    # ------------------------------------------------------------------ its end

    def clean_up(self, live: LiveJob) -> None:
        """Free an ended job's memory and scenes, and replace its upload by the image that people are shown."""
        job = self._store.get(live.id)
        took_s = job.finished - job.started if job.finished and job.started else None
        self._observer.ended(job, took_s)
        wanted = live.shown is not None and (job.keep_photo or self._config.photo_grace_s > 0)
        self._photos.discard_original(live.id, encode_image(live.shown.rgb) if wanted and live.shown else None)
        # After the photo is replaced: until then it is returned from memory.
        self.live.pop(live.id, None)
        live.end()
        # After its end, which those who wait for its scenes look at: scenes that come now are let go by them.
        if live.held is not None:
            self._engine.release(live.held.token)

    def photo_until(self) -> float:
        """Return when the photo of a job that ends now is deleted."""
        return time.time() + self._config.photo_grace_s

    def note_storage(self, error: StorageFailed) -> None:
        """Remember that the stores can't be written, and log it once."""
        if not self.storage_error:
            _log.error("%s", error)
        self.storage_error = error.message

    def _persisted(self, live: LiveJob, write: Callable[[], _T]) -> _T | None:
        """Write to the store; retry while the disk is full. Return None if the service ends first."""
        while True:
            try:
                result = write()
            except StorageFailed as error:
                self.note_storage(error)
                # Waiting for the disk is not being stuck.
                live.mark_alive()
                if self.closing.wait(_RETRY_S):
                    return None
            else:
                self.storage_error = ""
                return result


@dataclass(slots=True)
class _Stored:
    """How many records of an attempt are in the store, and when the last batch was written."""

    attempt: int
    count: int = 0
    at: float = 0.0
