"""The acceptance of jobs: scenes held, photo decoded, job on disk, each with its place in the queue.

order -> known by its key? -> scenes held -> photo decoded -> place reserved -> photo and row on disk -> queued
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from service.errors import QueueFull, SceneNotReady, StorageFailed
from service.jobs.config import JobsConfig
from service.jobs.engine import Engine, HeldScenes
from service.jobs.job_order import JobOrder, new_job
from service.jobs.live_job import LiveJob
from service.jobs.model import LensUse, NewJob, StoredJob
from service.jobs.photo_store import PhotoStore
from service.jobs.queue import JobQueue
from service.jobs.read_photo import Recall, read_photo
from service.jobs.scene_wait import SceneWait
from service.jobs.store import JobStore, require_share
from service.jobs.worker import Worker
from service.lenses.lens_memory import LensMemory
from service.scene_manager.status import AUTO


class Acceptance:
    """Takes orders, or refuses them. Safe to use from several threads."""

    def __init__(
        self,
        config: JobsConfig,
        engine: Engine,
        store: JobStore,
        photos: PhotoStore,
        queue: JobQueue,
        scene_wait: SceneWait,
        worker: Worker,
        lenses: LensMemory | None,
    ) -> None:
        self._config, self._engine, self._lenses = config, engine, lenses
        self._store, self._photos = store, photos
        self._queue, self._scene_wait, self._worker = queue, scene_wait, worker

    def require_capacity(self, client: str, most: int | None, key: str | None) -> None:
        """Raises QueueFull if a new job would be refused; a repeated one never is.

        `most`: how many jobs of the client may wait at once; None: as many as the queue takes.
        """
        if key and self._store.has_key(client, key):
            return
        if self._queue.full():
            raise QueueFull(f"the queue is full: {self._queue.waiting()} jobs.", hint="Try again later.")
        if most is not None:
            require_share(self._store.count("queued", client), most)

    def accept(self, order: JobOrder) -> StoredJob:
        """Take a job; it is on disk when this returns.

        Raises BadInput, SceneError, QueueFull, IdempotencyConflict, StorageFailed.
        """
        if known := self._store.find_by_key(order.client, order.idempotency_key, order.digest):
            return known
        held = self._held(order.spec.scene)
        try:
            if held is None:
                # The photo is checked now, and decoded again before the search, over the scene's background.
                scene, background = self._first_scene(order.spec.scene), (0.0, 0.0, 0.0)
            else:
                scene, background = held.ids[0], held.background_rgb
                # Only lengths in metres need the scenes, which may be on another machine.
                for scene_id in held.ids if order.spec.accuracy.metres is not None else ():
                    order.spec.accuracy.in_units(scene_id, self._engine.require(scene_id).metres_per_unit)
            recall = self._recall(order)
            photo = read_photo(order.photo, order.spec, background, self._config.max_frames, recall)
            if recall:
                # On record with the job: the same prior after a restart, whatever was learnt meanwhile.
                lens = LensUse(order.lens_owner, photo.recalled)
                order = replace(order, spec=replace(order.spec, lens=lens))
            new = new_job(order, scene, photo)
            job = self._stored(new, order)
        # Also on KeyboardInterrupt: scenes that are never released could not be unloaded.
        except BaseException:
            self._release(held)
            raise
        if job.id != new.id:  # two requests with the same idempotency key at the same time
            self._release(held)
        elif held is None:
            live = self._worker.live[job.id] = LiveJob(job.id, job.scene)
            self._scene_wait.submit(live, order.spec.scene, reserved=True)
        else:
            live = self._worker.live[job.id] = LiveJob(job.id, job.scene, photo, held)
            self._queue.submit(live)
        return job

    def _held(self, asked: str | Sequence[str] | None) -> HeldScenes | None:
        """Return the scenes, held; None if one is not in memory yet: the job waits for it."""
        try:
            return self._engine.hold(asked)
        except SceneNotReady:
            return None

    def _release(self, held: HeldScenes | None) -> None:
        if held is not None:
            self._engine.release(held.token)

    def _first_scene(self, asked: str | Sequence[str] | None) -> str:
        """Return the scene under which a job is listed until it has found the one that its photo shows."""
        if asked == AUTO:
            return self._engine.scenes()[0].id
        names = [asked] if asked is None or isinstance(asked, str) else asked
        return next(self._engine.scene(name).id for name in names)

    def _recall(self, order: JobOrder) -> Recall | None:
        """Return what recalls the lens of the order's photo; None: lenses aren't remembered."""
        if self._lenses is None or not order.lens_owner:
            return None
        return partial(self._lenses.recall, order.lens_owner, order.spec.camera_id)

    def _stored(self, new: NewJob, order: JobOrder) -> StoredJob:
        """Put a job on disk, with its place in the queue reserved; or return the one that has its key.

        Raises QueueFull, also where its client has as many waiting as it may, and StorageFailed.
        """
        # Reserved first: once the job is on disk it can no longer be refused.
        self._queue.reserve()
        taken = False
        try:
            # The photo first: a stored job without its photo could not be run after a crash.
            self._photos.accept(new.id, order.photo)
            job = self._store.accept(new, order.most_queued)
            taken = job.id == new.id
            return job
        except StorageFailed as error:
            self._worker.note_storage(error)
            raise
        finally:
            if not taken:
                self._queue.release()
                self._photos.delete(new.id)
