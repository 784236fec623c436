"""Jobs of a store that several processes share: each, a front, follows the jobs of the others and takes over from them.

Whoever asks a front for a job of another one gets a `LiveJob` all the same; here it is filled from the store, as soon
as the store announces a change, and once a second in any case. A front that has idle workers takes jobs that wait
elsewhere; the store's claim decides between fronts that want the same job.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from service.errors import JobNotFound, SceneNotFound, SplatfixError, StorageFailed
from service.jobs.engine import Engine
from service.jobs.live_job import LiveJob
from service.jobs.model import StoredJob
from service.jobs.queue import JobQueue
from service.jobs.store import JobStore, JobWatch
from service.jobs.worker import Worker
from service.scene_manager.status import AUTO

_log = logging.getLogger(__name__)

_POLL_S = 1.0
_UNHEARD_S = 5.0
"""A job that nobody listens to is followed for so long."""


class SharedJobs:
    """Safe to use from several threads."""

    def __init__(
        self,
        watch: JobWatch,
        store: JobStore,
        engine: Engine,
        queue: JobQueue,
        worker: Worker,
        take: Callable[[StoredJob], None],
    ) -> None:
        """`take` queues a stored job here."""
        self._watch, self._store, self._engine = watch, store, engine
        self._queue, self._worker, self._take = queue, worker, take
        self._followed: dict[str, LiveJob] = {}
        self._heard: dict[str, float] = {}
        """When somebody listened to a followed job last, on the monotonic clock."""
        self._waited: set[str] = set()
        """Jobs of others that waited at the last poll."""
        self._poll_at = 0.0
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="shared jobs", daemon=True)
        worker.lost = self.hand_over

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def dismiss(self) -> None:
        """Send all away who listen to jobs of other fronts."""
        with self._lock:
            for live in self._followed.values():
                live.dismiss()

    def close(self) -> None:
        """Stop listening; for those who follow jobs it is over here."""
        self._closing.set()
        self._watch.close()
        with self._lock:
            for live in self._followed.values():
                live.end()
        if self._thread.is_alive():
            self._thread.join(2 * _POLL_S)

    def follow(self, job: StoredJob) -> LiveJob:
        """Return a job of another front, as it stands and as it goes on. Raises StorageFailed."""
        with self._lock:
            live = self._followed.setdefault(job.id, LiveJob(job.id, job.scene))
            self._heard[job.id] = time.monotonic()
            self._refresh(live)
        return live

    def hand_over(self, live: LiveJob) -> None:
        """Let go of a job that isn't this front's any more; its listeners hear of it as before."""
        self._queue.withdraw(live)
        self._worker.live.pop(live.id, None)
        held, live.held, live.photo, live.shown = live.held, None, None, None
        if held is not None:
            self._engine.release(held.token)
        with self._lock:
            self._followed[live.id], self._heard[live.id] = live, time.monotonic()
            self._refresh(live)

    def adopt(self, job_id: str) -> LiveJob | None:
        """Stop following a job that is to run here, and return it, with its listeners; None if it isn't followed."""
        with self._lock:
            return self._followed.pop(job_id, None)

    def knows_scenes(self, job: StoredJob) -> bool:
        """Return whether this front has the scenes that a job names."""
        asked = job.spec.scene if job.spec.names_several_scenes else job.scene
        if asked == AUTO:
            return bool(self._engine.scenes())
        try:
            for scene_id in (asked,) if asked is None or isinstance(asked, str) else asked:
                self._engine.scene(scene_id)
        except SceneNotFound:
            return False
        return True

    # ------------------------------------------------------------------ on the listening thread

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._look(self._watch.wait(_POLL_S))
            except StorageFailed as error:
                if not self._closing.is_set():  # else it is how the wait was ended
                    self._worker.note_storage(error)
                self._closing.wait(_POLL_S)
            except SplatfixError as error:  # of the engine
                _log.warning("the jobs of other fronts: %s", error)
            except Exception:  # a bug must not end the thread
                _log.exception("the jobs of other fronts could not be read")
                self._closing.wait(_POLL_S)

    def _look(self, changed: set[str]) -> None:
        """Look at the jobs that have changed; once in a while at all."""
        due = time.monotonic() >= self._poll_at
        with self._lock:
            followed = [live for live in self._followed.values() if due or live.id in changed]
            for live in followed:
                self._refresh(live)
        for live in tuple(self._worker.live.values()):
            if due or live.id in changed:
                self._check_own(live)
        if due:
            self._poll_at = time.monotonic() + _POLL_S
            self._forget_unheard()
            self._take_waiting()

    def _refresh(self, live: LiveJob) -> None:
        """Bring a followed job to what is in the store."""
        try:
            job = self._store.get(live.id)
            fresh = self._store.records(live.id, len(live.records) if job.attempt == live.attempt else 0)
            # Records may belong to an attempt that began between the two: they come with the next change.
            if self._store.get(live.id).attempt != job.attempt:
                return
        except JobNotFound:
            self._followed.pop(live.id, None)
            live.end()
            return
        if job.attempt != live.attempt:
            live.begin(job.attempt)
        for record in fresh:
            live.add(record)
        if job.ended:
            self._followed.pop(live.id, None)
            live.end()

    def _check_own(self, live: LiveJob) -> None:
        """Act on what another front has done to a job that waits or runs here."""
        attempt = live.attempt
        try:
            job = self._store.get(live.id)
        except JobNotFound:
            self.hand_over(live)
            return
        # Looked at after the store: an attempt of this process is among `busy` before the store has it.
        busy, ours = live.id in self._worker.busy, live.id in self._worker.live
        if not ours:
            return
        if job.cancelled and not job.ended and not live.cancelled.is_set():
            live.cancelled.set()
            self._engine.cancel(live.task_id)
        elif busy:
            if job.attempt > attempt and (live.id, attempt) in self._worker.running:
                self._engine.cancel(f"{live.id}.{attempt}")  # another front has made the next one
        elif job.ended or (job.state == "running" and job.attempt > attempt):
            self.hand_over(live)

    def _forget_unheard(self) -> None:
        now = time.monotonic()
        with self._lock:
            for job_id, live in list(self._followed.items()):
                if live.has_listeners:
                    self._heard[job_id] = now
                elif now - self._heard.get(job_id, 0.0) > _UNHEARD_S:
                    del self._followed[job_id]
            self._heard = {job_id: at for job_id, at in self._heard.items() if job_id in self._followed}

    def _take_waiting(self) -> None:
        """Queue jobs that wait elsewhere, or whose front is gone, if workers are idle here."""
        idle = self._queue.idle()
        if idle <= 0:
            self._waited = set()
            return
        others = [job for job in self._store.queued() if job.id not in self._worker.live]
        # Not at once: their own front may be about to run them.
        for job in [job for job in others if job.id in self._waited and self.knows_scenes(job)][:idle]:
            self._take(job)
        self._waited = {job.id for job in others}
