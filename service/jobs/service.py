"""All jobs of a service, from acceptance until they are deleted. Uses an engine and stores; knows no HTTP.

    accepted (photo and row on disk) -> queued -> running -> succeeded | failed | cancelled | interrupted

The store has the authoritative state. Unfinished jobs are in memory, too, so that listeners get each record at once;
an attempt's records are stored in batches, the last batch together with its end. The leases of running attempts are
renewed here; an attempt whose lease has ended is made again, and listeners see the new attempt. Where several
processes share the store, jobs of the others are in memory as long as somebody listens (`shared_jobs`).
"""

from __future__ import annotations

import logging
import math
import threading
import time
from dataclasses import replace

from service.errors import (
    Failure,
    Interrupted,
    JobNotFound,
    JobNotReady,
    RecordNotFound,
    SplatfixError,
    StorageFailed,
)
from service.jobs.acceptance import Acceptance
from service.jobs.config import JobsConfig, Observer
from service.jobs.engine import Engine
from service.jobs.job_order import JobOrder
from service.jobs.left_over_photos import LeftOverPhotos
from service.jobs.live_job import LiveJob
from service.jobs.model import (
    Ending,
    JobFilter,
    JobRecord,
    JobResult,
    JobState,
    Retention,
    StoredJob,
)
from service.jobs.photo_store import PhotoStore
from service.jobs.queue import JobQueue
from service.jobs.read_photo import read_photo
from service.jobs.scene_wait import SceneWait
from service.jobs.shared_jobs import SharedJobs
from service.jobs.store import JobStore
from service.jobs.worker import Worker
from service.lenses.lens_memory import LensMemory
from service.photos.images import encode_image, undistorted_jpeg
from service.types import NO_CORRECTION, Query

_log = logging.getLogger(__name__)

_MAINTENANCE_S = 2.0
_RENEWALS = 3
"""Of a lease before it ends."""
_STUCK_LIMIT = 2
"""Abandoned threads keep their memory: from this number on the process should be restarted."""


class Jobs:
    """All jobs of one service."""

    def __init__(
        self,
        config: JobsConfig,
        engine: Engine,
        store: JobStore,
        photos: PhotoStore,
        observer: Observer,
        lenses: LensMemory | None = None,
    ) -> None:
        """Make the jobs of a service; without `lenses` nothing is learnt of them, and nothing recalled."""
        self._config, self._engine = config, engine
        self._photos, self._store = photos, store
        self._worker = Worker(config, engine, store, photos, observer, lenses)
        self._live = self._worker.live
        self._queue = JobQueue(
            self._worker.run,
            self._worker.give_up,
            workers=config.workers,
            queue_size=config.queue_size,
            queue_bytes=config.queue_bytes,
            stuck_s=config.stuck_s,
        )
        self._scene_wait = SceneWait(engine, self._queue, store, self._worker)
        self._acceptance = Acceptance(
            config, engine, store, photos, self._queue, self._scene_wait, self._worker, lenses
        )
        watch, take = store.watch(), self._enqueue_when_ready
        self._shared = SharedJobs(watch, store, engine, self._queue, self._worker, take) if watch else None
        self._left_over = LeftOverPhotos(store, photos)
        self._renew_at = 0.0
        self._dismissing = threading.Event()
        """Set once this process is to end."""
        self._maintenance = threading.Thread(target=self._maintain, name="maintenance", daemon=True)

    def start(self) -> None:
        """Queue the unfinished jobs of an earlier process.

        A data folder is locked for this process, so no other worker can be alive: all leases are over. In a store that
        is shared they end by themselves, and what waits belongs to other fronts until it has waited for a while.
        """
        if self._shared:
            self._shared.start()
        else:
            self._reclaim(math.inf)
            for job in self._store.queued():
                if job.id not in self._live:
                    self._enqueue_when_ready(job)
            self._left_over.delete()
        self._maintenance.start()

    # ------------------------------------------------------------------ from outside

    def accept(self, order: JobOrder) -> StoredJob:
        """Take a job; it is on disk when this returns.

        Raises BadInput, SceneError, QueueFull, IdempotencyConflict, StorageFailed.
        """
        return self._acceptance.accept(order)

    def get(self, job_id: str) -> StoredJob:
        """Return a job as it stands. Raises JobNotFound."""
        return self._current(self._store.get(job_id))

    def result(self, job: StoredJob) -> JobResult:
        """Return what a job that succeeded found. Raises JobNotReady; JobNotFound if it expired just now."""
        if job.state != "succeeded":
            raise JobNotReady(f"the job is {job.state}.", where="job")
        result = self._store.result(job.id)
        if result is None:
            raise JobNotFound(f"job '{job.id}' not found or expired.", where="job")
        return result

    def page(self, wanted: JobFilter, limit: int) -> list[StoredJob]:
        """Return the newest jobs that fit, at most `limit`."""
        return [self._current(job) for job in self._store.page(wanted, limit)]

    def unfinished(self, scene_id: str) -> int:
        """Return how many jobs of a scene wait or run, at any front; at most 1000."""
        states: tuple[JobState, ...] = "queued", "running"
        return sum(len(self.page(JobFilter(scene=scene_id, state=state), 500)) for state in states)

    def live(self, job: StoredJob) -> LiveJob | None:
        """Return the job as it goes on, here or at another front; None if it has ended, or nobody may wait for it.

        Not for the event loop.
        """
        if self._dismissing.is_set():
            return None
        if (live := self._live.get(job.id)) or self._shared is None or job.ended:
            return live
        return self._shared.follow(job)

    def records(self, job: StoredJob, first: int = 0) -> list[JobRecord]:
        """Return the records of the latest attempt from number `first` on."""
        live = self._live.get(job.id)
        ours = live and live.attempt and live.attempt >= job.attempt
        return live.records[first:] if live and ours else self._store.records(job.id, first)

    def record(self, job: StoredJob, index: int | None) -> JobRecord:
        """Return a record; None: the latest. Raises JobNotReady if it may still come, else RecordNotFound."""
        records = self.records(job)
        if records and (index is None or index < len(records)):
            return records[-1 if index is None else index]
        kind = RecordNotFound if job.ended else JobNotReady
        raise kind(f"the job has {len(records)} records and is {job.state}.", where="iterations")

    def undistorted_photo(self, job: StoredJob) -> bytes:
        """Return the photo without the distortion that the latest record estimates: as its render has it, as JPEG.

        Raises PhotoGone, JobNotReady.
        """
        photo, records = self.photo(job), self.records(job)
        correction = records[-1].step.correction if records else NO_CORRECTION
        if not correction.k1:
            return photo
        camera = job.photo.intrinsics.corrected(correction)
        return undistorted_jpeg(photo, replace(camera, model="SIMPLE_RADIAL", distortion=(correction.k1,)))

    def photo(self, job: StoredJob) -> bytes:
        """Return the photo as the estimator sees it, as JPEG. Raises PhotoGone, JobNotReady."""
        live = self._live.get(job.id)
        if live is None and not job.ended and self._shared:  # another front has it
            return encode_image(self._read_again(job).rgb)
        if live is None:
            return self._photos.kept(job.id)
        if live.shown is None:
            raise JobNotReady("after a restart the photo is read again when the job starts.", where="photo")
        return encode_image(live.shown.rgb)

    def _read_again(self, job: StoredJob) -> Query:
        """Return the photo of a job that isn't in memory here."""
        info = self._engine.scene(job.scene).info
        background = info.background_rgb if info else (0.0, 0.0, 0.0)
        return read_photo(self._photos.original(job.id), job.spec, background, self._config.max_frames).query

    def waiting(self, client: str | None = None) -> int:
        """Return how many jobs wait for a worker; of one client, or of all (None)."""
        return self._store.count("queued", client)

    def running(self, client: str | None = None) -> int:
        """Return how many jobs run; of one client, or of all (None)."""
        return self._store.count("running", client)

    def require_queue_capacity(self, client: str, most: int | None, key: str | None) -> None:
        """Raises QueueFull if a new job would be refused; a repeated one never is.

        `most`: how many jobs of the client may wait at once; None: as many as the queue takes.
        """
        self._acceptance.require_capacity(client, most, key)

    def stuck_workers(self) -> int:
        """Return how many workers were given up."""
        return self._queue.stuck()

    def problems(self) -> list[str]:
        """Return what keeps jobs from running, as sentences; a supervisor should restart the process."""
        stuck, storage_error = self._queue.stuck(), self._worker.storage_error
        found = [f"{stuck} workers are stuck: restart the service."] if stuck >= _STUCK_LIMIT else []
        remedy = "Free space on the disk of the data folder, and check that it is writable."
        return [*found, *([f"{storage_error} {remedy}"] if storage_error else [])]

    def cancel(self, job: StoredJob) -> None:
        """Cancel at once if the job waits, between two records if it runs; no effect once it has ended.

        One that another front has ends as soon as that one hears of it.
        """
        live = self._live.get(job.id)
        if live is None and self._shared is None:
            return
        # On disk before the attempt stops, so that a crash in between does not run it again.
        self._store.request_cancel(job.id)
        if live:
            self._stop(live)
        if self._store.end_queued(job, Ending("cancelled"), self._worker.photo_until()):
            self._ended(job.id)

    def _ended(self, job_id: str) -> None:
        """Clean up after a job that ended without a worker."""
        if live := self._live.get(job_id):
            self._queue.withdraw(live)
            self._worker.clean_up(live)
        else:
            self._photos.discard_original(job_id, None)

    def delete(self, job: StoredJob) -> None:
        """Delete an ended job with its records, result and photo. Raises JobNotReady while it is queued or running."""
        if not self._store.delete(job.id) and job.id in self._store.ids():
            raise JobNotReady(f"the job is {job.state}.", where="job", hint="Cancel it first: DELETE /jobs/ID.")
        self._photos.delete(job.id)

    def dismiss(self) -> None:
        """Send all away who listen to jobs: what they wait for is told by the next process, or another one.

        Jobs go on, and are accepted as before.
        """
        self._dismissing.set()
        for live in tuple(self._live.values()):
            live.dismiss()
        if self._shared:
            self._shared.dismiss()

    def close(self) -> None:
        """Let what runs finish within the grace period; the rest waits on disk for the next start."""
        self._worker.closing.set()
        self._queue.close(self._config.shutdown_s)
        for live in tuple(self._live.values()):
            self._stop(live)
        # Cancelled attempts end at their next record.
        self._queue.close(1.0)
        for live in tuple(self._live.values()):
            live.end()
        # It writes to the store, which is closed next.
        self._maintenance.join(_MAINTENANCE_S + 1)
        if self._shared:
            self._shared.close()
        self._store.close()

    def _stop(self, live: LiveJob) -> None:
        live.cancelled.set()
        self._engine.cancel(live.task_id)

    def _current(self, job: StoredJob) -> StoredJob:
        """Return the job with the records that have come since the last batch."""
        live = self._live.get(job.id)
        if live is None or not live.attempt or live.attempt < job.attempt or job.ended:
            return job
        return replace(job, records=len(live.records), stage=live.stage)

    # ------------------------------------------------------------------ maintenance

    def _maintain(self) -> None:
        """Until the service ends: renew leases, repeat lost attempts, delete what exceeds its retention."""
        kept = Retention(self._config.keep_jobs, self._config.keep_days * 86_400, self._config.keep_bytes)
        closing = self._worker.closing
        while not closing.wait(min(_MAINTENANCE_S, self._config.lease_s / _RENEWALS)):
            try:
                self._renew()  # before `_reclaim`, which must not take attempts that are alive
                self._reclaim(self._store.now())
                self._scene_wait.expire()
                for job_id in [*self._store.expire_photos(), *self._store.prune(kept)]:
                    self._photos.delete(job_id)
                if self._shared:
                    self._left_over.delete_old()
                # No job may come that would show that the disk has space again: the service is not ready meanwhile.
                if self._worker.storage_error:
                    self._store.probe()
                    self._worker.storage_error = ""
            except StorageFailed as error:
                self._worker.note_storage(error)
            except SplatfixError as error:  # of the engine
                _log.warning("maintenance of jobs: %s", error)
            except Exception:  # a bug must not end the thread: leases would end, and attempts be repeated
                _log.exception("jobs could not be maintained")

    def _renew(self) -> None:
        """Renew the leases of this process; attempts that are stuck are ended by the queue, not by their lease."""
        if time.monotonic() < self._renew_at:
            return
        if running := tuple(self._worker.running):
            self._store.renew(running, self._store.now() + self._config.lease_s)
        self._renew_at = time.monotonic() + self._config.lease_s / _RENEWALS

    def _reclaim(self, before: float) -> None:
        most = self._config.max_lost
        failure = Failure.of(Interrupted(f"the service ended {most} times while this job ran."))
        for job in self._store.reclaim(before, most, failure):
            _log.warning("job %s: attempt %d was lost; it is %s", job.id, job.attempt, job.state)
            if job.ended:
                self._ended(job.id)
            elif self._shared is None or self._shared.knows_scenes(job):
                self._enqueue_when_ready(job)

    def _enqueue_when_ready(self, job: StoredJob) -> None:
        """Queue a stored job as soon as its scenes are loaded or have failed to load; keep its listeners."""
        # Clients may be waiting for the events of an attempt that was lost.
        followed = self._shared.adopt(job.id) if self._shared else None
        live = self._live.setdefault(job.id, followed or LiveJob(job.id, job.scene))
        live.refused = None
        asked = job.spec.scene if job.spec.names_several_scenes else job.scene
        self._scene_wait.submit(live, asked, reserved=False)
