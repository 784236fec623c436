"""Jobs: their life from acceptance to oblivion. Knows `localize`, not HTTP.

    accepted (photo and row on disk) -> queued -> running -> succeeded | failed | cancelled | interrupted

The store is the truth; what runs is in memory besides, so that listeners hear of each record at once. An attempt's
records go to the store in batches, the last ones together with its end.
"""

from __future__ import annotations

import hashlib
import secrets
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

from service.errors import Interrupted, JobNotReady, QueueFull, RecordNotFound, StorageFailed
from service.jobs.context import Desk, ending
from service.jobs.live_job import LiveJob
from service.jobs.photo_store import Photos
from service.jobs.queue import Executor, ThreadExecutor
from service.jobs.sqlite_store import Ending, JobFilter, JobStore, NewJob, Retention, StoredJob
from service.jobs.worker import Attempts
from service.photos.images import encode_image
from service.scene_manager.manager import Scenes
from service.types import Query
from service.web.metrics import Metrics
from service.web.schemas.conversion import intrinsics_out
from service.web.schemas.jobs import PhotoOut
from service.web.schemas.parsing import Body, Task, make_task
from service.web.schemas.requests import LocalizeFields
from service.web.settings import Settings

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

    def __init__(self, settings: Settings, scenes: Scenes, folder: Path, metrics: Metrics) -> None:
        """Open the folder. Raises StorageFailed."""
        self._settings, self._scenes = settings, scenes
        self._photos, self._store = Photos(folder / "photos"), JobStore(folder / "jobs.sqlite")
        self._desk = Desk(settings, scenes, self._store, self._photos, metrics)
        self._live = self._desk.live
        attempts = Attempts(self._desk)
        self._executor: Executor = ThreadExecutor(
            attempts.run,
            attempts.give_up,
            workers=settings.workers,
            queue_size=settings.queue_size,
            queue_bytes=settings.queue_bytes,
            stuck_s=settings.stuck_s,
        )
        self._housekeeper = threading.Thread(target=self._keep_house, name="housekeeper", daemon=True)

    def start(self) -> None:
        """Take up what an ended process left behind."""
        error = Interrupted(f"the service ended {self._settings.crashes} times while this job ran.")
        for job in self._store.recover(self._settings.crashes, ending("interrupted", error)):
            live = self._live[job.id] = LiveJob(job.id, job.scene)
            self._scenes.when_settled(job.scene, lambda live=live: self._executor.submit(live, reserved=False))
        for orphan in self._photos.ids() - self._store.ids():
            self._photos.delete(orphan)
        for job_id in self._photos.unsettled() - self._live.keys():
            self._photos.settle(job_id, None)
        self._housekeeper.start()

    # ------------------------------------------------------------------ from outside

    def accept(self, order: Order) -> StoredJob:
        """Take a job; it is on disk when this returns.

        Raises BadInput, SceneError, QueueFull, IdempotencyConflict, StorageFailed.
        """
        if known := self._store.repeated(order.client, order.idempotency_key, order.digest):
            return known
        ids = self._scenes.chosen(order.fields.scene)
        held = self._scenes.acquire(ids)
        try:
            task, query = make_task(
                order.body, order.fields, held[0], self._settings.estimator, self._settings.max_frames
            )
            new = _new_job(order, ids[0], task, query)
            job = self._stored(new, order.body.photo)
        except BaseException:
            self._scenes.release(held)
            raise
        if job.id != new.id:  # the same key came twice at once
            self._scenes.release(held)
            return job
        live = self._live[job.id] = LiveJob(job.id, job.scene, task, query, held)
        self._executor.submit(live)
        return job

    def _stored(self, new: NewJob, photo: bytes) -> StoredJob:
        """Put a job on disk, with its place in the queue reserved; or return the one that has its key."""
        self._executor.reserve()
        taken = False
        try:
            self._photos.accept(new.id, photo)
            job = self._store.accept(new)
            taken = job.id == new.id
            return job
        except StorageFailed as error:
            self._desk.note_storage(error)
            raise
        finally:
            if not taken:
                self._executor.release()
                self._photos.delete(new.id)

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
        """Return the photo as the estimator sees it, as JPEG. Raises PhotoGone, JobNotReady."""
        live = self._live.get(job.id)
        if live is None:
            return self._photos.kept(job.id)
        if live.query is None:
            raise JobNotReady("after a restart the photo is read again when the job starts.", where="photo")
        return encode_image(live.query.rgb)

    def waiting(self) -> int:
        return self._store.count("queued")

    def running(self) -> int:
        return self._store.count("running")

    def room(self, client: str, key: str | None) -> None:
        """Raises QueueFull if a new job would be refused; a repeated one never is."""
        if self._executor.full() and not (key and self._store.knows(client, key)):
            raise QueueFull(f"{self._executor.waiting()} jobs are waiting.", hint="Try again later.")

    def stuck_workers(self) -> int:
        return self._executor.stuck()

    def ailments(self) -> list[str]:
        """Say what keeps jobs from being done; a supervisor should restart the process."""
        stuck = self._executor.stuck()
        told = [f"{stuck} workers are stuck"] if stuck >= _STUCK_LIMIT else []
        return [*told, *([self._desk.storage_error] if self._desk.storage_error else [])]

    def cancel(self, job: StoredJob) -> None:
        """Cancel at once if the job waits, between two records if it runs; no effect once it has ended."""
        live = self._live.get(job.id)
        if live is None:
            return
        self._store.ask_to_cancel(job.id)
        live.cancel.set()
        if self._store.end_queued(job, Ending("cancelled"), self._desk.photo_until()):
            self._executor.withdraw(live)
            self._desk.retire(live)

    def close(self) -> None:
        """Let what runs finish within the grace period; the rest waits on disk for the next start."""
        self._desk.closing.set()
        self._executor.close(self._settings.shutdown_s)
        for live in tuple(self._live.values()):
            live.cancel.set()
        self._executor.close(1.0)
        for live in tuple(self._live.values()):
            live.end()
        self._housekeeper.join(_HOUSEKEEPING_S + 1)
        self._store.close()

    def _current(self, job: StoredJob) -> StoredJob:
        """Return the job with what its thread has told since the last batch."""
        live = self._live.get(job.id)
        if live is None or not live.attempt or job.ended:
            return job
        return replace(job, records=len(live.records), stage=live.stage)

    def _keep_house(self) -> None:
        """Delete what is over its time."""
        kept = Retention(self._settings.keep_jobs, self._settings.keep_days * 86_400, self._settings.keep_bytes)
        while not self._desk.closing.wait(_HOUSEKEEPING_S):
            try:
                for job_id in [*self._store.stale_photos(), *self._store.forget(kept)]:
                    self._photos.delete(job_id)
                if self._desk.storage_error:
                    self._store.probe()
                    self._desk.storage_error = ""
            except StorageFailed as error:
                self._desk.note_storage(error)


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
