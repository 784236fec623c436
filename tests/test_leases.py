"""Jobs without HTTP, on stores in memory: an attempt is its worker's as long as the lease is renewed."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
from api_server import GO_ON, photo, until
from memory_stores import MemoryJobStore, MemoryPhotoStore
from stand_ins import make_scene

from service.errors import IdempotencyConflict, PhotoGone, SceneNotReady
from service.jobs.config import JobsConfig
from service.jobs.embedded_engine import EmbeddedEngine, EngineConfig
from service.jobs.job_order import JobOrder
from service.jobs.model import JobSpec, StoredJob
from service.jobs.service import Jobs
from service.jobs.worker import Worker


class CountingObserver:
    """Counts what happens to jobs."""

    def __init__(self) -> None:
        self.seen: Counter[str] = Counter()

    def started(self, waited_s: float) -> None:
        self.seen["started"] += 1

    def ended(self, job: StoredJob, seconds: float | None) -> None:
        self.seen[f"{job.estimator} {job.state} {job.status}"] += 1

    def stage(self, estimator: str, stage: str, seconds: float) -> None:
        self.seen[f"stage {stage}"] += 1

    def renders(self, estimator: str, count: int) -> None:
        self.seen["renders"] += count


class UnrenewedStore(MemoryJobStore):
    """Loses the heartbeats of every first attempt."""

    def renew(self, attempts: Sequence[tuple[str, int]], lease_until: float) -> None:
        super().renew([(job_id, attempt) for job_id, attempt in attempts if attempt > 1], lease_until)


@contextmanager
def running(store: MemoryJobStore, observer: CountingObserver | None = None, **config) -> Iterator[Jobs]:
    engine = EmbeddedEngine(EngineConfig("stepping"))
    engine.add_loaded("room", make_scene())
    engine.start()
    until(lambda: engine.readiness().ready)
    config = {"workers": 2, "lease_s": 0.6, "shutdown_s": 0, "photo_grace_s": 0} | config
    jobs = Jobs(JobsConfig(**config), engine, store, MemoryPhotoStore(), observer or CountingObserver())
    jobs.start()
    try:
        yield jobs
    finally:
        GO_ON.set()
        jobs.close()
        engine.close()


def order(key: str | None = None, **options) -> JobOrder:
    data = photo()
    spec = JobSpec("stepping", options=options, seed=5)
    return JobOrder(data, "p.jpg", hashlib.sha256(data).hexdigest(), spec, "me", key, repr(options))


def ended(jobs: Jobs, job: StoredJob) -> StoredJob:
    until(lambda: jobs.get(job.id).ended and jobs.live(job) is None)
    return jobs.get(job.id)


def test_a_job_runs_on_stores_in_memory(stepping):
    observer = CountingObserver()
    with running(MemoryJobStore(), observer) as jobs:
        accepted = jobs.accept(order("key", steps=4))
        assert jobs.accept(order("key", steps=4)).id == accepted.id
        with pytest.raises(IdempotencyConflict):
            jobs.accept(order("key", steps=5))
        job = ended(jobs, accepted)
        assert (job.state, job.attempt, job.records, job.stage, job.scene) == ("succeeded", 1, 4, "step", "room")
        assert [record.step.index for record in jobs.records(job)] == [0, 1, 2, 3]
        assert jobs.result(job).estimate.seed == 5
        with pytest.raises(PhotoGone):
            jobs.photo(job)
        assert observer.seen == {
            **{"started": 1, "stepping succeeded not_localized": 1, "stage step": 1, "stage verify": 1, "renders": 0}
        }


def test_a_lease_that_is_renewed_keeps_the_attempt(stepping):
    with running(MemoryJobStore(), lease_s=0.3) as jobs:
        job = jobs.accept(order(steps=6, pause_s=0.2))
        job = ended(jobs, job)  # four leases long
        assert (job.state, job.attempt, job.lost) == ("succeeded", 1, 0)


@pytest.mark.parametrize("error", [SceneNotReady("away.", where="scene"), ValueError("a bug")], ids=["engine", "bug"])
def test_leases_are_renewed_though_maintenance_fails(stepping, error):
    """As while a cluster doesn't answer: an error that ended its thread would end all leases, and repeat attempts."""

    class TroubledStore(MemoryJobStore):
        failed = 0

        def expire_photos(self):
            self.failed += 1
            raise error

    store = TroubledStore()
    with running(store, lease_s=0.3) as jobs:
        job = ended(jobs, jobs.accept(order(steps=6, pause_s=0.2)))  # four leases long
        assert (job.state, job.attempt, job.lost) == ("succeeded", 1, 0)
    assert store.failed > 3


def test_a_lost_attempt_is_made_again_and_its_late_result_is_refused(stepping):
    observer = CountingObserver()
    with running(UnrenewedStore(), observer) as jobs:
        accepted = jobs.accept(order(hold=True))
        live = jobs.live(accepted)
        assert live
        until(lambda: jobs.get(accepted.id).attempt == 2)  # another worker has it, while the first one still holds on
        until(lambda: len(live.records) == 1)
        stepping.GO_ON.set()
        job = ended(jobs, accepted)
        assert (job.state, job.attempt, job.lost, job.records) == ("succeeded", 2, 1, 3)
        assert [record.step.index for record in jobs.records(job)] == [0, 1, 2]
        assert (observer.seen["started"], observer.seen["stepping succeeded not_localized"]) == (2, 1)


def test_a_job_whose_attempts_are_all_lost_is_interrupted(stepping):
    with running(UnrenewedStore(), max_lost=1) as jobs:
        job = ended(jobs, jobs.accept(order(hold=True)))
        assert (job.state, job.attempt, job.lost) == ("interrupted", 1, 1)
        assert job.failure
        assert job.failure.code == "interrupted"


@pytest.mark.parametrize(
    ("state", "cancelled", "ended_here", "refused", "cleaned"),
    [
        ("queued", True, True, True, True),
        ("queued", True, False, True, False),  # somebody else was faster to end it
        ("cancelled", True, False, True, False),
        ("running", True, False, False, False),  # another process makes an attempt, and will end it
        ("queued", False, True, False, False),
        ("succeeded", False, False, False, False),
    ],
)
def test_a_job_that_was_cancelled_before_it_began_is_ended_by_who_can_not_claim_it(
    state: str, cancelled: bool, ended_here: bool, refused: bool, cleaned: bool
) -> None:
    ended, cleaned_up = [], []
    job = SimpleNamespace(cancelled=cancelled, state=state, ended=state in ("cancelled", "succeeded"))
    store = SimpleNamespace(
        get=lambda job_id: job, end_queued=lambda job, ending, until: ended.append(ending.state) or ended_here
    )
    worker: Any = SimpleNamespace(_store=store, photo_until=lambda: None, clean_up=cleaned_up.append)
    live: Any = SimpleNamespace(id="j")
    assert Worker._refused(worker, live) is refused
    assert ended == (["cancelled"] if cancelled else [])
    assert cleaned_up == ([live] if cleaned else [])
