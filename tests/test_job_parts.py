"""Parts of jobs by themselves: the answer to a sequence, jobs that wait for scenes, photos on a full disk."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from memory_stores import MemoryJobStore
from test_store_contracts import new_job, record, result

from service.errors import (
    InvalidImage,
    JobNotFound,
    JobNotReady,
    QueueFull,
    RecordNotFound,
    SceneNotReady,
    SceneTooLarge,
    StorageFailed,
)
from service.jobs import acceptance, photo_store, service, shared_jobs, trajectory
from service.jobs.acceptance import Acceptance
from service.jobs.job_order import JobOrder
from service.jobs.live_job import LiveJob
from service.jobs.model import Batch, Ending, JobSpec
from service.jobs.photo_store import FolderPhotoStore
from service.jobs.scene_wait import SceneWait
from service.jobs.service import Jobs
from service.jobs.shared_jobs import SharedJobs
from service.jobs.trajectory import Trajectory
from service.results import StageTiming, Status

# ------------------------------------------------------------------ the answer to several photos


def answer(status: Status, *, stage: str = "match", exhausted: bool = False, warnings: tuple[str, ...] = ()) -> Any:
    """One photo's answer, whose stage takes 1 s of which half is computing."""
    estimate = result(status).estimate
    steps = (replace(estimate.records[0], stage=stage),)
    timings = (StageTiming("match", 1.0, 0.5), StageTiming(stage + "!", 0.25, 0.125))
    estimate = replace(estimate, records=steps, timings=timings, warnings=warnings, renders=3)
    return SimpleNamespace(estimate=estimate, photo=SimpleNamespace(name="p.jpg", time_s=2.5), exhausted=exhausted)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Any:
    made = SimpleNamespace(wall_s=0.0, cpu_s=0.0)
    monkeypatch.setattr(trajectory, "Clock", lambda: made)
    return made


def test_the_last_localized_photo_is_shown_and_all_are_counted(clock):
    found = Trajectory()
    answers = [
        answer(Status.UNCERTAIN, warnings=("a",)),
        answer(Status.LOCALIZED, stage="track", warnings=("b", "a")),
        answer(Status.NOT_LOCALIZED),
        answer(Status.LOCALIZED),
        answer(Status.UNCERTAIN),
    ]
    shown = []
    for number, one in enumerate(answers):
        clock.wall_s, clock.cpu_s = 2.0 * number, number
        record = found.add(one)
        assert (record.step.index, record.step.elapsed_s, record.step.cpu_s) == (number, 2.0 * number, number)
        assert record.frame is not None
        assert (record.frame.index, record.frame.name, record.frame.time_s) == (number, "p.jpg", 2.5)
        assert record.step.stage == ("track" if number == 1 else "localize")
        assert record.frame.tracked is (number == 1)
        shown.append(next(i for i, each in enumerate(answers) if each.estimate is found.shown))
    assert shown == [0, 1, 1, 3, 3]
    clock.wall_s, clock.cpu_s = 10.0, 4.0
    whole = found.result(None)
    spent = {timing.stage: (timing.wall_s, timing.cpu_s) for timing in whole.estimate.timings}
    assert spent == {"match": (5.0, 2.5), "match!": (1.0, 0.5), "track!": (0.25, 0.125)}
    assert whole.decode == StageTiming("decode", 3.75, 0.875)  # what no stage took
    assert whole.estimate.renders == 15
    assert whole.estimate.warnings == ("a", "b", "3 of 5 photos were not localized.")
    assert not whole.estimate.budget_exhausted
    assert len(whole.frames) == 5


def test_a_sequence_tells_that_its_budget_ended(clock):
    found = Trajectory()
    found.add(answer(Status.LOCALIZED))
    found.add(answer(Status.LOCALIZED, exhausted=True))
    whole = found.result(None)
    assert whole.estimate.budget_exhausted
    assert whole.estimate.warnings == ("The budget ended after 2 photos.",)


# ------------------------------------------------------------------ jobs that wait for scenes


class Waiting:
    """A scene wait whose engine answers when it is told."""

    def __init__(self) -> None:
        self.took: list[tuple[Any, Any]] = []
        self.queued: list[tuple[str, bool]] = []
        self.released: list[str] = []
        self.given_back: list[int] = []
        self.cleaned: list[str] = []
        self.store = MemoryJobStore()
        engine: Any = SimpleNamespace(
            hold_later=lambda asked, take: self.took.append((asked, take)), release=self.released.append
        )
        queue: Any = SimpleNamespace(
            submit=lambda live, reserved: self.queued.append((live.id, reserved)),
            release=lambda: self.given_back.append(1),
        )
        worker: Any = SimpleNamespace(photo_until=lambda: 5.0, clean_up=lambda live: self.cleaned.append(live.id))
        self.wait = SceneWait(engine, queue, self.store, worker)


@pytest.mark.parametrize("reserved", [True, False])
def test_a_job_is_queued_once_its_scenes_are_there_or_refused(reserved):
    waiting, held = Waiting(), SimpleNamespace(token="token")
    for found in (held, SceneTooLarge("too large.", where="scene")):
        live = LiveJob("j", "s")
        waiting.wait.submit(live, ["s"], reserved=reserved)
        assert waiting.queued == []
        asked, take = waiting.took.pop()
        assert asked == ["s"]
        take(found)
        assert (live.held, live.refused) == ((held, None) if found is held else (None, found))
        assert waiting.queued == [("j", reserved)]
        waiting.queued.clear()
    assert (waiting.released, waiting.given_back) == ([], [])


@pytest.mark.parametrize("reserved", [True, False])
def test_of_a_job_that_was_cancelled_meanwhile_nothing_is_left(reserved):
    waiting = Waiting()
    for found in (SimpleNamespace(token="token"), SceneTooLarge("too large.", where="scene")):
        live = LiveJob("j", "s")
        waiting.wait.submit(live, None, reserved=reserved)
        live.end()
        waiting.took.pop()[1](found)
    assert waiting.queued == []
    assert waiting.released == ["token"]
    assert len(waiting.given_back) == 2 * reserved


def test_a_deadline_ends_the_wait(monkeypatch):
    waiting, now = Waiting(), time.time()
    for name, deadline in (("late", now - 1), ("early", now + 60), ("never", None)):
        waiting.store.accept(new_job(name, deadline=deadline))
        waiting.wait.submit(LiveJob(name, "s"), None, reserved=False)
    waiting.wait.expire()
    late = waiting.store.get("late")
    assert (late.state, late.failure and late.failure.code, late.photo_until) == ("failed", "deadline_exceeded", 5.0)
    assert waiting.cleaned == ["late"]
    assert waiting.store.get("early").state == waiting.store.get("never").state == "queued"
    for _, take in waiting.took:
        take(SceneTooLarge("too large.", where="scene"))
    waiting.queued.clear()
    waiting.wait.expire()  # nobody waits any more
    assert waiting.cleaned == ["late"]


# ------------------------------------------------------------------ orders


class Taking:
    """An acceptance whose other parts note what they are asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done: list[tuple[str, Any]] = []
        self.held: Any = SimpleNamespace(token="token", ids=("s",), background_rgb=(0.5, 0.5, 0.5))
        self.store, self.waiting, self.next = MemoryJobStore(), 0, "new"
        note: Any = lambda name: lambda *what, **more: self.done.append((name, *what, *more.values()))  # noqa: E731
        engine: Any = SimpleNamespace(
            hold=self.hold, release=note("released"), require=lambda scene: SimpleNamespace(metres_per_unit=None),
            scene=lambda name: SimpleNamespace(id=f"id of {name}"),
        )  # fmt: skip
        queue: Any = SimpleNamespace(reserve=note("reserved"), release=note("place back"), submit=note("queued"))
        wait: Any = SimpleNamespace(submit=note("waits"))
        self.photos: Any = SimpleNamespace(accept=note("photo"), delete=note("photo deleted"))
        self.live: dict[str, LiveJob] = {}
        worker: Any = SimpleNamespace(live=self.live, note_storage=note("disk"))
        config: Any = SimpleNamespace(max_frames=3)
        self.accept = Acceptance(config, engine, self.store, self.photos, queue, wait, worker, None).accept
        self.read: Any = lambda *_: SimpleNamespace(query=None)
        monkeypatch.setattr(acceptance, "read_photo", lambda *asked: self.read(*asked))
        monkeypatch.setattr(
            acceptance, "new_job", lambda order, scene, _: new_job(self.next, scene=scene, **self.of(order))
        )

    def of(self, order: JobOrder) -> dict[str, Any]:
        return {"client": order.client, "idempotency_key": order.idempotency_key, "digest": order.digest}

    def hold(self, asked: Any) -> Any:
        if self.held is None:
            raise SceneNotReady("not in memory.")
        return self.held

    def names(self) -> list[str]:
        return [each[0] for each in self.done]


@pytest.fixture
def taking(monkeypatch: pytest.MonkeyPatch) -> Taking:
    return Taking(monkeypatch)


ORDER = JobOrder(b"jpeg", "p.jpg", "0", replace(JobSpec("e"), scene="s"), "c", "key", "digest")


def test_an_order_is_on_disk_before_it_is_queued_and_known_by_its_key(taking):
    job = taking.accept(ORDER)
    assert taking.names() == ["reserved", "photo", "queued"]
    assert taking.live[job.id].held is taking.held
    assert taking.accept(ORDER).id == job.id
    assert len(taking.done) == 3


def test_an_order_whose_scene_is_not_in_memory_waits_for_it(taking):
    taking.held = None
    job = taking.accept(ORDER)
    assert taking.names() == ["reserved", "photo", "waits"]
    assert taking.done[-1] == ("waits", taking.live[job.id], "s", True)
    assert taking.live[job.id].scene == "id of s"


def test_a_photo_that_can_not_be_read_lets_its_scenes_go(taking):
    def broken(*_: Any) -> Any:
        raise InvalidImage("no photo.")

    taking.read = broken
    with pytest.raises(InvalidImage):
        taking.accept(ORDER)
    assert taking.done == [("released", "token")]
    assert not taking.live


def test_of_two_requests_with_one_key_at_the_same_time_one_becomes_a_job(taking):
    def meanwhile(*_: Any) -> str:
        taking.store.accept(new_job("other", **taking.of(ORDER)))
        return "photo"  # decoded

    taking.read = meanwhile
    assert taking.accept(ORDER).id == "other"
    assert taking.done[1:] == [
        ("photo", "new", b"jpeg"),
        ("place back",),
        ("photo deleted", "new"),
        ("released", "token"),
    ]
    assert not taking.live


def test_a_full_disk_leaves_neither_a_place_nor_a_photo(taking):
    def full(*_: Any) -> None:
        raise StorageFailed("full.")

    taking.photos.accept = full
    with pytest.raises(StorageFailed):
        taking.accept(ORDER)
    assert taking.names() == ["reserved", "disk", "place back", "photo deleted", "released"]


def test_a_job_beyond_its_clients_share_leaves_neither_a_place_nor_a_photo(taking):
    limited = replace(ORDER, most_queued=1)
    assert taking.accept(limited).id == "new"
    taking.next = "second"
    with pytest.raises(QueueFull, match="1 jobs of this key, its share"):
        taking.accept(replace(limited, idempotency_key=None))
    assert taking.names()[3:] == ["reserved", "photo", "place back", "photo deleted", "released"]
    assert taking.accept(replace(limited, idempotency_key=None, most_queued=2)).id == "second"


# ------------------------------------------------------------------ jobs of other fronts


@pytest.mark.parametrize("due", [True, False])
def test_jobs_that_changed_are_looked_at_and_all_once_in_a_while(due, monkeypatch):
    done: list[Any] = []
    other: Any = SharedJobs.__new__(SharedJobs)
    other._lock, other._poll_at = threading.RLock(), 10.0
    other._followed = {name: LiveJob(name, "s") for name in "ab"}
    other._worker = SimpleNamespace(live={name: LiveJob(name, "s") for name in "cd"})
    for name in ("_refresh", "_check_own"):
        monkeypatch.setattr(SharedJobs, name, lambda _, live, name=name: done.append((name, live.id)))
    for name in ("_forget_unheard", "_take_waiting"):
        monkeypatch.setattr(SharedJobs, name, lambda _, name=name: done.append(name))
    monkeypatch.setattr(shared_jobs.time, "monotonic", lambda: 10.0 if due else 9.99)
    other._look({"a", "d"})
    changed = [("_refresh", "a"), ("_check_own", "d")]
    every = [*(("_refresh", name) for name in "ab"), *(("_check_own", name) for name in "cd")]
    assert done == ([*every, "_forget_unheard", "_take_waiting"] if due else changed)
    assert other._poll_at == (10.0 + shared_jobs._POLL_S if due else 10.0)


# ------------------------------------------------------------------ photos


def test_what_can_not_be_written_leaves_no_photo(tmp_path, monkeypatch):
    photos = FolderPhotoStore(tmp_path / "photos")
    photos.accept("kept", b"photo")

    def full(path, data):
        path.write_bytes(data[:2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(photo_store, "write_durably", full)
    with pytest.raises(StorageFailed, match="No space left"):
        photos.accept("new", b"photo")
    photos.discard_original("kept", b"jpeg")
    assert photos.ids() == set()
    assert list((tmp_path / "photos").iterdir()) == []


# ------------------------------------------------------------------ a service's jobs, without a worker


@pytest.fixture
def jobs() -> Any:
    made: Any = Jobs.__new__(Jobs)
    made._store, made._live, made._shared = MemoryJobStore(), {}, None
    made._queue = SimpleNamespace(full=lambda: False, waiting=lambda: 7, stuck=lambda: 0)
    made._worker, made._dismissing = SimpleNamespace(storage_error=""), threading.Event()
    made._acceptance = Acceptance.__new__(Acceptance)
    made._acceptance._store, made._acceptance._queue = made._store, made._queue
    return made


def test_records_are_those_of_the_newest_attempt(jobs):
    job = jobs._store.accept(new_job("j"))
    jobs._store.claim(job, 9e9)
    jobs._store.append("j", 1, Batch(0, (record("stored"), record("stored", 1))))
    job = jobs._store.get("j")
    live = jobs._live["j"] = LiveJob("j", "s")
    for attempt, stages in ((0, ["stored", "stored"]), (1, ["here"] * 3), (2, ["here"] * 3)):
        live.begin(attempt)
        for number in range(3):
            live.add(record("here", number))
        assert [each.step.stage for each in jobs.records(job)] == stages
        assert len(jobs.records(job, 1)) == len(stages) - 1
    assert (jobs.get("j").records, jobs.get("j").stage) == (3, "here")
    live.begin(0)
    assert (jobs.get("j").records, jobs.get("j").stage) == (2, "stored")
    del jobs._live["j"]
    assert jobs.get("j").records == 2
    assert [jobs.record(job, index).step.index for index in (0, 1, None)] == [0, 1, 1]
    with pytest.raises(JobNotReady, match="has 2 records and is running"):
        jobs.record(job, 2)
    jobs._store.finish("j", 1, Batch(2, ()), Ending("cancelled"), None)
    with pytest.raises(RecordNotFound):
        jobs.record(jobs._store.get("j"), 2)
    with pytest.raises(JobNotReady, match="is cancelled"):
        jobs.result(jobs._store.get("j"))
    with pytest.raises(JobNotFound):
        jobs.result(SimpleNamespace(state="succeeded", id="j"))


def test_a_share_of_the_queue_counts_the_clients_own_jobs_that_wait(jobs):
    for number in range(3):
        jobs._store.accept(new_job(f"j{number}", client="a", idempotency_key=f"k{number}"))
    jobs.require_queue_capacity("a", 4, None)
    jobs.require_queue_capacity("a", None, None)
    jobs.require_queue_capacity("b", 1, None)
    with pytest.raises(QueueFull, match="3 jobs of this key"):
        jobs.require_queue_capacity("a", 3, None)
    jobs.require_queue_capacity("a", 3, "k1")  # a repeated request
    jobs._queue.full = lambda: True
    jobs.require_queue_capacity("a", 3, "k1")
    with pytest.raises(QueueFull, match="full: 7 jobs"):
        jobs.require_queue_capacity("b", None, "k1")


def test_two_stuck_workers_are_a_problem_and_a_full_disk_is(jobs):
    assert jobs.problems() == []
    jobs._queue.stuck = lambda: 1
    assert jobs.problems() == []
    jobs._queue.stuck = lambda: 2
    assert jobs.problems() == ["2 workers are stuck: restart the service."]
    jobs._worker.storage_error = "The disk is full."
    assert [problem[:17] for problem in jobs.problems()] == ["2 workers are stu", "The disk is full."]


def test_who_asks_for_a_job_that_another_front_has_follows_it(jobs):
    job = jobs._store.accept(new_job("j"))
    assert jobs.live(job) is None
    followed = LiveJob("j", "s")
    jobs._shared = SimpleNamespace(follow=lambda job: followed)
    assert jobs.live(job) is followed
    own = jobs._live["j"] = LiveJob("j", "s")
    assert jobs.live(job) is own
    del jobs._live["j"]
    jobs._store.end_queued(job, Ending("cancelled"), None)
    assert jobs.live(jobs._store.get("j")) is None
    jobs._live["j"] = own
    jobs._dismissing.set()  # the front ends: whoever waits asks another one
    assert jobs.live(job) is None


def test_only_an_ended_job_is_deleted_with_its_photo(jobs):
    deleted: list[str] = []
    jobs._photos = SimpleNamespace(delete=deleted.append)
    job = jobs._store.accept(new_job("j"))
    with pytest.raises(JobNotReady, match="is queued"):
        jobs.delete(job)
    assert deleted == []
    jobs._store.end_queued(job, Ending("cancelled"), None)
    jobs.delete(job)
    jobs.delete(job)  # somebody else was quicker
    assert deleted == ["j", "j"]


def test_leases_are_renewed_three_times_before_they_end(jobs, monkeypatch):
    clock = SimpleNamespace(now=100.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(service, "time", clock)
    renewed: list[tuple[Any, float]] = []
    jobs._store = SimpleNamespace(renew=lambda running, until: renewed.append((running, until)), now=lambda: 1000.0)
    jobs._config, jobs._renew_at = SimpleNamespace(lease_s=30.0), 0.0
    jobs._worker.running = set()
    jobs._renew()
    jobs._worker.running = {("j", 1)}
    for now, count in ((109.9, 0), (110.0, 1), (119.9, 1), (120.1, 2)):
        clock.now = now
        jobs._renew()
        assert len(renewed) == count
    assert renewed[0] == ((("j", 1),), 1030.0)
