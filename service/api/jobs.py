"""Jobs: their life from acceptance to oblivion. Knows `localize`, not HTTP.

    accepted (photo and row on disk) -> queued -> running -> succeeded | failed | cancelled | interrupted

The store is the truth; what runs is in memory besides, so that listeners hear of each record at once. An attempt's
records go to the store in batches, the last ones together with its end.
"""

from __future__ import annotations

import hashlib
import logging
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from service.api.convert import intrinsics_out, record_out, result_out, timing_out
from service.api.documents import versions
from service.api.executor import Executor, ThreadExecutor
from service.api.intake import Body, Task, make_task
from service.api.live import LiveJob
from service.api.photos import Photos
from service.api.problems import problem_of
from service.api.requests import LocalizeFields
from service.api.scenes import Scenes
from service.api.schemas import PhotoOut
from service.api.settings import Settings
from service.api.store import Batch, Ending, JobFilter, JobStore, NewJob, Retention, StoredJob
from service.errors import (
    DeadlineExceeded,
    Interrupted,
    JobNotReady,
    RecordNotFound,
    SceneError,
    StorageFailed,
)
from service.images import encode_image
from service.localize import Cancelled, LoadedScene, localize
from service.types import IterationRecord, PoseEstimate, Query

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

_BATCH_S = 0.5
_RETRY_S = 0.5
_HOUSEKEEPING_S = 2.0
_STUCK_LIMIT = 2
"""Abandoned threads keep their memory; so many, and it is time for a new process."""


@dataclass(frozen=True, slots=True)
class Order:
    """A request to localize, read but not yet judged."""

    body: Body
    fields: LocalizeFields
    client: str
    """Who asks: the scope of idempotency keys."""
    idempotency_key: str | None
    photo_sha256: str

    @property
    def digest(self) -> str:
        """Of what the request means."""
        return hashlib.sha256((self.fields.model_dump_json() + self.photo_sha256).encode()).hexdigest()


class Jobs:
    """All jobs of one service."""

    def __init__(self, settings: Settings, scenes: Scenes, folder: Path) -> None:
        """Open the folder. Raises StorageFailed."""
        self._settings, self._scenes = settings, scenes
        self._photos = Photos(folder / "photos")
        self._store = JobStore(folder / "jobs.sqlite")
        self._live: dict[str, LiveJob] = {}
        self._closing = threading.Event()
        self._executor: Executor = ThreadExecutor(
            self._run,
            self._give_up,
            workers=settings.workers,
            queue_size=settings.queue_size,
            queue_bytes=settings.queue_bytes,
            stuck_s=settings.stuck_s,
        )
        self._housekeeper = threading.Thread(target=self._keep_house, name="housekeeper", daemon=True)
        self.storage_error = ""
        """Why nothing can be written to disk; empty while it can."""

    def start(self) -> None:
        """Take up what an ended process left behind."""
        error = Interrupted(f"the service ended {self._settings.crashes} times while this job ran.")
        for job in self._store.recover(self._settings.crashes, _ending("interrupted", error)):
            live = self._live[job.id] = LiveJob(job.id, job.scene)
            self._scenes.when_settled(job.scene, lambda live=live: self._executor.submit(live, reserved=False))
        for orphan in self._photos.ids() - self._store.ids():
            self._photos.delete(orphan)
        for job_id in self._photos.unsettled() - self._live.keys():
            self._photos.settle(job_id, None)
        self._housekeeper.start()

    # ------------------------------------------------------------------ from outside

    def accept(self, order: Order, scene: LoadedScene) -> StoredJob:
        """Take a job; it is on disk when this returns.

        Raises BadInput, QueueFull, IdempotencyConflict, StorageFailed.
        """
        if known := self._store.repeated(order.client, order.idempotency_key, order.digest):
            return known
        task, query = make_task(order.body, order.fields, scene, self._settings.estimator)
        new = _new_job(order, scene.scene.info.id, task, query)
        self._executor.reserve()
        try:
            self._photos.accept(new.id, order.body.photo)
            job = self._store.accept(new)
        except Exception as error:
            self._executor.release()
            self._photos.delete(new.id)
            self._note_storage(error)
            raise
        if job.id != new.id:  # the same key came twice at once
            self._executor.release()
            self._photos.delete(new.id)
            return job
        live = self._live[job.id] = LiveJob(job.id, job.scene, task, query)
        self._executor.submit(live)
        return job

    def get(self, job_id: str) -> StoredJob:
        """Raises JobNotFound."""
        return self._current(self._store.get(job_id))

    def page(self, wanted: JobFilter, limit: int) -> list[StoredJob]:
        """Return the newest jobs that fit, at most `limit`."""
        return [self._current(job) for job in self._store.page(wanted, limit)]

    def live(self, job_id: str) -> LiveJob | None:
        """Return the job if it hasn't ended."""
        return self._live.get(job_id)

    def records(self, job: StoredJob, first: int = 0) -> list[str]:
        """Return the records of the latest attempt from number `first` on, as JSON."""
        live = self._live.get(job.id)
        return live.records[first:] if live and live.attempt else self._store.records(job.id, first)

    def record(self, job: StoredJob, index: int | None) -> str:
        """Return a record as JSON; None: the latest. Raises JobNotReady if it may still come, else RecordNotFound."""
        records = self.records(job)
        if records and (index is None or index < len(records)):
            return records[-1 if index is None else index]
        kind = RecordNotFound if job.ended else JobNotReady
        raise kind(f"the job has {len(records)} records and is {job.state}.", where="iterations")

    def photo(self, job: StoredJob) -> bytes:
        """Return the photo as the estimator sees it, as JPEG. Raises PhotoGone."""
        live = self._live.get(job.id)
        if live is None:
            return self._photos.kept(job.id)
        query = live.query or self._decoded(job, self._scenes.get(job.scene))[1]
        return encode_image(query.rgb)

    def waiting(self) -> int:
        return self._store.count("queued")

    def running(self) -> int:
        return self._store.count("running")

    def ailments(self) -> list[str]:
        """Say what keeps jobs from being done; a supervisor should restart the process."""
        stuck = self._executor.stuck()
        told = [f"{stuck} workers are stuck"] if stuck >= _STUCK_LIMIT else []
        return [*told, *([self.storage_error] if self.storage_error else [])]

    def cancel(self, job: StoredJob) -> None:
        """Cancel at once if the job waits, between two records if it runs; no effect once it has ended."""
        live = self._live.get(job.id)
        if live is None:
            return
        self._store.ask_to_cancel(job.id)
        live.cancel.set()
        if self._store.end_queued(job, Ending("cancelled"), self._photo_until()):
            self._executor.withdraw(live)
            self._retire(live)

    def close(self) -> None:
        """Let what runs finish within the grace period; the rest waits on disk for the next start."""
        self._closing.set()
        self._executor.close(self._settings.shutdown_s)
        for live in tuple(self._live.values()):
            live.cancel.set()
        self._executor.close(1.0)
        for live in tuple(self._live.values()):
            live.end()
        self._housekeeper.join(_HOUSEKEEPING_S + 1)
        self._store.close()

    # ------------------------------------------------------------------ on a worker's thread

    def _run(self, live: LiveJob) -> None:
        job = self._store.get(live.id)
        attempt = self._persisted(live, lambda: self._store.claim(job))
        if attempt is None:
            return
        live.attempt = attempt
        live.announce()
        sent = _Sent()
        ending = self._attempt(live, job, sent)
        if ending is None:
            self._persisted(live, lambda: self._store.requeue(job.id, attempt))
            return
        batch = Batch(sent.count, live.records[sent.count :], live.stage)
        until = self._photo_until()
        if self._persisted(live, lambda: self._store.finish(job.id, attempt, batch, ending, until)):
            self._retire(live)

    def _attempt(self, live: LiveJob, job: StoredJob, sent: _Sent) -> Ending | None:
        """Localize; None if it was stopped because the service ends."""
        try:
            loaded = self._scenes.get(job.scene)
            if live.query is None:
                live.task, live.query = self._decoded(job, loaded)
            assert live.task
            request = replace(live.task.request, cancel=live.cancel, budget_s=self._budget_s(job))
            estimate = localize(live.query, loaded, request, lambda record: self._tell(live, record, sent))
            return _success(estimate, live.task, loaded)
        except Cancelled:
            stopped = self._closing.is_set() and not self._store.get(job.id).cancelled
            return None if stopped else Ending("cancelled")
        except Exception as error:  # a job's failure, even by a bug, must not end its worker
            expected = isinstance(error, DeadlineExceeded | SceneError)
            _log.error("job %s failed: %s", job.id, error, exc_info=not expected)
            return _ending("interrupted" if isinstance(error, SceneError) else "failed", error)

    def _tell(self, live: LiveJob, record: IterationRecord, sent: _Sent) -> None:
        live.tell(record_out(record).model_dump_json(), record.stage)
        if time.monotonic() - sent.at < _BATCH_S:
            return
        batch = Batch(sent.count, live.records[sent.count :], live.stage)
        try:
            self._store.append(live.id, live.attempt, batch)
        except StorageFailed as error:  # they stay in memory, and go with the next batch
            self._note_storage(error)
        else:
            sent.count += len(batch.records)
        sent.at = time.monotonic()

    def _decoded(self, job: StoredJob, loaded: LoadedScene) -> tuple[Task, Query]:
        body = Body(self._photos.original(job.id), "", {})
        return make_task(body, LocalizeFields.model_validate_json(job.fields), loaded, job.estimator)

    def _budget_s(self, job: StoredJob) -> float:
        """What is left of the caller's budget, the caller's deadline and the operator's limit."""
        asked = LocalizeFields.model_validate_json(job.fields).budget_s
        left = None if job.deadline is None else job.deadline - time.time()
        if left is not None and left <= 0:
            raise DeadlineExceeded("the deadline was over before the job could start.", where="deadline_s")
        return min(limit for limit in (asked, left, self._settings.max_job_s) if limit is not None)

    def _persisted(self, live: LiveJob, write: Callable[[], _T]) -> _T | None:
        """Write to the store, again and again while the disk is full. None if the service ends before that."""
        while True:
            try:
                result = write()
            except StorageFailed as error:
                self._note_storage(error)
                live.beat()
                if self._closing.wait(_RETRY_S):
                    return None
            else:
                self.storage_error = ""
                return result

    def _give_up(self, live: LiveJob) -> None:
        """End a job whose worker is stuck."""
        error = Interrupted(f"the job told nothing for {self._settings.stuck_s:g} s and was given up.")
        nothing = Batch(len(self._store.records(live.id)), (), live.stage)
        ending = _ending("interrupted", error)
        if self._store.finish(live.id, live.attempt, nothing, ending, self._photo_until()):
            live.cancel.set()
            self._retire(live)

    # ------------------------------------------------------------------ afterwards

    def _retire(self, live: LiveJob) -> None:
        """Let go of an ended job's memory, and of its photo as it was sent."""
        job = self._store.get(live.id)
        wanted = live.query is not None and (job.keep_photo or self._settings.photo_grace_s > 0)
        self._photos.settle(live.id, encode_image(live.query.rgb) if wanted and live.query else None)
        self._live.pop(live.id, None)
        live.end()

    def _photo_until(self) -> float:
        return time.time() + self._settings.photo_grace_s

    def _current(self, job: StoredJob) -> StoredJob:
        """Return the job with what its thread has told since the last batch."""
        live = self._live.get(job.id)
        if live is None or not live.attempt or job.ended:
            return job
        return replace(job, records=len(live.records), stage=live.stage)

    def _note_storage(self, error: Exception) -> None:
        if isinstance(error, StorageFailed):
            if not self.storage_error:
                _log.error("%s", error)
            self.storage_error = error.message

    def _keep_house(self) -> None:
        """Delete what is over its time."""
        kept = Retention(self._settings.keep_jobs, self._settings.keep_days * 86_400, self._settings.keep_bytes)
        while not self._closing.wait(_HOUSEKEEPING_S):
            try:
                for job_id in [*self._store.stale_photos(), *self._store.forget(kept)]:
                    self._photos.delete(job_id)
                if self.storage_error:
                    self._store.probe()
                    self.storage_error = ""
            except StorageFailed as error:
                self._note_storage(error)


@dataclass(slots=True)
class _Sent:
    """How many records of an attempt are in the store, and since when."""

    count: int = 0
    at: float = 0.0


def _new_job(order: Order, scene: str, task: Task, query: Query) -> NewJob:
    fields, now = order.fields, time.time()
    photo = PhotoOut(name=order.body.name, sha256=order.photo_sha256, intrinsics=intrinsics_out(query.intrinsics))
    return NewJob(
        id=secrets.token_hex(8),
        client=order.client,
        idempotency_key=order.idempotency_key,
        digest=order.digest,
        created=now,
        deadline=fields.deadline_s and now + fields.deadline_s,
        scene=scene,
        estimator=task.request.estimator,
        fields=fields.model_dump_json(),
        photo=photo.model_dump_json(),
        photo_sha256=order.photo_sha256,
        photo_bytes=len(order.body.photo),
        keep_photo=fields.keep_photo,
    )


def _ending(state: str, error: Exception) -> Ending:
    return Ending(state, error=problem_of(error, "").model_dump_json())


def _success(estimate: PoseEstimate, task: Task, loaded: LoadedScene) -> Ending:
    anchor = loaded.scene.info.geo_anchor
    result = result_out(estimate, timing_out(task.decode), versions(), anchor)
    return Ending("succeeded", result.status, result.score, result.model_dump_json())
