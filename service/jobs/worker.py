"""A job's attempt, on a worker's thread: claim it, localize, store the records in batches and the end once."""

from __future__ import annotations

import logging
import time
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

from service.errors import DeadlineExceeded, Interrupted, SceneError, StorageFailed
from service.jobs.context import Desk, ending
from service.jobs.live_job import LiveJob
from service.jobs.sqlite_store import Batch, Ending, StoredJob
from service.jobs.trajectory import Trajectory
from service.localize import Cancelled, LoadedScene, Request, localize
from service.logs import bound
from service.multi_scene import SceneEstimate, localize_in_scenes
from service.photos.sequence import Reading, read_sequence
from service.results import IterationRecord
from service.scene_manager.manager import several
from service.tracking import localize_sequence
from service.types import Query
from service.web.schemas.conversion import record_out, result_out, timing_out
from service.web.schemas.job_results import Record, Result
from service.web.schemas.requests import LocalizeFields
from service.web.schemas.resources import versions

_log = logging.getLogger(__name__)

_BATCH_S = 0.5


class Attempts:
    def __init__(self, desk: Desk) -> None:
        self._desk = desk

    def run(self, live: LiveJob) -> None:
        """Make one attempt, unless the job was cancelled while it waited."""
        with bound(job_id=live.id):
            self._run(live)

    def give_up(self, live: LiveJob) -> None:
        """End a job whose worker is stuck."""
        desk = self._desk
        error = Interrupted(f"the job told nothing for {desk.settings.stuck_s:g} s and was given up.")
        nothing = Batch(len(desk.store.records(live.id)), (), live.stage)
        end = ending("interrupted", error)
        if desk.store.finish(live.id, live.attempt, nothing, end, desk.photo_until()):
            live.cancel.set()
            desk.retire(live)

    def _run(self, live: LiveJob) -> None:
        desk = self._desk
        job = desk.store.get(live.id)
        attempt = desk.persisted(live, lambda: desk.store.claim(job))
        if attempt is None:
            return
        desk.metrics.started(time.time() - job.created)
        live.attempt = attempt
        live.announce()
        sent = _Sent()
        end = self._attempt(live, job, sent)
        if end is None:
            desk.persisted(live, lambda: desk.store.requeue(job.id, attempt))
            return
        batch = Batch(sent.count, live.records[sent.count :], live.stage)
        until = desk.photo_until()
        if desk.persisted(live, lambda: desk.store.finish(job.id, attempt, batch, end, until)):
            _log.info("job %s: %s %s", job.id, end.state, end.status or "")
            desk.retire(live)

    def _attempt(self, live: LiveJob, job: StoredJob, sent: _Sent) -> Ending | None:
        """Localize; None if it was stopped because the service ends."""
        desk = self._desk
        try:
            if not live.held:
                asked = LocalizeFields.model_validate_json(job.fields).scene
                live.held = desk.scenes.acquire(desk.scenes.chosen(asked if several(asked) else job.scene))
            if live.task is None or live.query is None:
                live.task, live.query = desk.decoded(job, live.held[0])
            request = replace(live.task.request, cancel=live.cancel, budget_s=self._budget_s(job))
            if live.task.reading is not None:
                result, renders = self._sequence(live, live.task.reading, request, live.held[0], sent)
                scene = None  # it was named
            else:
                found = self._found(live, live.query, request, sent)
                anchor, renders = found.loaded.scene.info.geo_anchor, found.estimate.renders
                result = result_out(found.estimate, timing_out(live.task.decode), versions(), anchor)
                scene = desk.scenes.id_of(found.loaded)
            for timing in result.timings[1:]:
                desk.metrics.stage(job.estimator, timing.stage, timing.wall_s)
            desk.metrics.renders(job.estimator, renders)
            return Ending("succeeded", result.status, result.score, result.model_dump_json(), scene=scene)
        except Cancelled:
            stopped = desk.closing.is_set() and not desk.store.get(job.id).cancelled
            return None if stopped else Ending("cancelled")
        except Exception as error:  # a job's failure, even by a bug, must not end its worker
            expected = isinstance(error, DeadlineExceeded | SceneError)
            _log.error("job %s failed: %s", job.id, error, exc_info=not expected)
            return ending("interrupted" if isinstance(error, SceneError) else "failed", error)

    def _found(self, live: LiveJob, query: Query, request: Request, sent: _Sent) -> SceneEstimate:
        """Localize one photo in the job's scene, or in the one of several that it shows."""
        told = partial(self._tell_step, live, sent)
        loaded, *others = live.held
        if others:
            return localize_in_scenes(query, live.held, request, told)
        return SceneEstimate(localize(query, loaded, request, told), loaded)

    def _sequence(
        self, live: LiveJob, reading: Reading, request: Request, loaded: LoadedScene, sent: _Sent
    ) -> tuple[Result, int]:
        """Localize several photos; the one that the result shows becomes the job's photo. Return renders, too."""
        trajectory = Trajectory()
        photos = read_sequence(self._desk.photos.original(live.id), reading)
        with closing(photos), closing(localize_sequence(photos, loaded, request)) as poses:
            for found in poses:
                record = trajectory.add(found)
                if trajectory.shown is found.estimate:
                    live.query = found.photo.query
                self._tell(live, sent, record)
        return trajectory.result(loaded.scene.info.geo_anchor), trajectory.renders

    def _tell_step(self, live: LiveJob, sent: _Sent, record: IterationRecord) -> None:
        self._tell(live, sent, record_out(record))

    def _tell(self, live: LiveJob, sent: _Sent, record: Record) -> None:
        live.tell(record.model_dump_json(), record.stage)
        if time.monotonic() - sent.at < _BATCH_S:
            return
        batch = Batch(sent.count, live.records[sent.count :], live.stage)
        try:
            self._desk.store.append(live.id, live.attempt, batch)
        except StorageFailed as error:  # they stay in memory, and go with the next batch
            self._desk.note_storage(error)
        else:
            sent.count += len(batch.records)
        sent.at = time.monotonic()

    def _budget_s(self, job: StoredJob) -> float:
        """What is left of the caller's budget, the caller's deadline and the operator's limit."""
        asked = LocalizeFields.model_validate_json(job.fields).budget_s
        left = None if job.deadline is None else job.deadline - time.time()
        if left is not None and left <= 0:
            raise DeadlineExceeded("the deadline was over before the job could start.", where="deadline_s")
        return min(limit for limit in (asked, left, self._desk.settings.max_job_s) if limit is not None)


@dataclass(slots=True)
class _Sent:
    """How many records of an attempt are in the store, and since when."""

    count: int = 0
    at: float = 0.0
