"""One attempt of a job, decision by decision, on a store in memory and an engine that does what it is told."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from memory_stores import MemoryJobStore, MemoryPhotoStore
from test_store_contracts import new_job, record, result

from service.errors import CorruptScene, StorageFailed
from service.jobs import worker as module
from service.jobs.config import JobsConfig
from service.jobs.engine import EngineAnswer, EngineLost
from service.jobs.live_job import LiveJob
from service.jobs.model import JobSpec, LensUse, StoredJob
from service.jobs.worker import Worker
from service.localize import Cancelled


class Clock:
    def __init__(self) -> None:
        self.now = 5000.0

    def monotonic(self) -> float:
        return self.now

    time = monotonic


class Of:
    """A worker with what it works on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **config: Any) -> None:
        self.clock, self.store, self.photos = Clock(), MemoryJobStore(), MemoryPhotoStore()
        monkeypatch.setattr(module, "time", self.clock)
        self.told: list[tuple[Any, ...]] = []
        self.work: Callable[..., Any] = lambda task, on_record: self.answer()
        self.engine: Any = SimpleNamespace(
            localize=lambda task, on_record: self.work(task, on_record),
            hold=lambda asked: self.note("hold", asked) or SimpleNamespace(token="held", background_rgb=(0, 0, 0)),
            release=lambda token: self.note("release", token),
            cancel=lambda task_id: self.note("cancel", task_id),
        )
        observer: Any = SimpleNamespace(
            started=lambda waited_s: self.note("started", waited_s),
            ended=lambda job, took_s: self.note("ended", job.state, took_s),
            stage=lambda estimator, stage, seconds: self.note("stage", estimator, stage, seconds),
            renders=lambda estimator, count: self.note("renders", estimator, count),
        )
        self.worker: Any = Worker(JobsConfig(**config), self.engine, self.store, self.photos, observer, None)
        self.worker.lost = lambda live: self.note("lost", live.id)

    def note(self, *what: Any) -> None:
        self.told.append(what)

    def kinds(self) -> list[str]:
        return [what[0] for what in self.told]

    def answer(self) -> EngineAnswer:
        return EngineAnswer(result(), "s")

    def job(self, **changes: Any) -> LiveJob:
        job = self.store.accept(new_job("j", created=4990.0, **changes))
        self.photos.accept("j", b"photo")
        live = self.worker.live["j"] = LiveJob("j", "s")
        rgb = np.zeros((4, 4, 3), np.uint8)
        live.photo = SimpleNamespace(task=lambda *given: SimpleNamespace(given=given))  # type: ignore[assignment]
        live.shown = SimpleNamespace(rgb=rgb)  # type: ignore[assignment]
        live.held = SimpleNamespace(token="first")  # type: ignore[assignment]
        assert job.state == "queued"
        return live

    @property
    def stored(self) -> StoredJob:
        return self.store.get("j")


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Any:
    return lambda **config: Of(monkeypatch, **config)


def test_a_job_that_succeeds_is_told_and_leaves_nothing(make):
    of = make(photo_grace_s=60.0)
    live = of.job()
    given: list[Any] = []
    busy: list[Any] = []

    def work(task, on_record):
        given.extend(task.given)
        busy.append((dict(of.worker.busy), set(of.worker.running)))
        on_record(record("match"), None)
        return of.answer()

    of.work = work
    of.worker.run(live)
    spec, task_id, token, budget_s = given
    assert (spec, task_id, token, budget_s) == (of.stored.spec, "j.1", "first", 300.0)
    assert busy == [({"j": 1}, {("j", 1)})]
    assert (of.worker.busy, of.worker.running, of.worker.live) == (Counter(), set(), {})
    assert of.stored.state == "succeeded"
    assert [each.step.stage for each in of.store.records("j")] == ["match"]
    assert live.ended.is_set()
    assert of.told[:3] == [("started", 10.0), ("stage", "e", "match", 0.1), ("renders", "e", 7)]
    assert of.told[3][:2] == ("ended", "succeeded")
    assert of.told[4:] == [("release", "first")]
    assert of.photos.kept("j")[:2] == b"\xff\xd8"
    assert of.photos.with_original() == set()


@pytest.mark.parametrize(("grace_s", "keep", "kept"), [(0.0, False, False), (0.0, True, True), (1.0, False, True)])
def test_a_photo_is_kept_for_a_while_or_where_that_was_asked_for(make, grace_s, keep, kept):
    of = make(photo_grace_s=grace_s)
    of.worker.run(of.job(keep_photo=keep))
    assert bool(of.photos.ids()) is kept
    assert of.worker.photo_until() == 5000.0 + grace_s


def test_without_a_photo_in_memory_it_is_read_again(make, monkeypatch):
    of = make(max_frames=7)
    live = of.job()
    live.photo = live.shown = live.held = None
    query = SimpleNamespace(rgb=np.zeros((4, 4, 3), np.uint8))
    read: list[Any] = []

    def read_photo(*given):
        read.append(given)
        return SimpleNamespace(query=query, task=lambda *given: None)

    monkeypatch.setattr(module, "read_photo", read_photo)
    of.worker.run(live)
    assert of.told[1] == ("hold", "s")
    assert read == [(b"photo", of.stored.spec, (0, 0, 0), 7)]
    assert of.stored.state == "succeeded"
    assert ("release", "held") in of.told


def test_a_job_of_several_scenes_looks_in_all_again_and_is_listed_where_it_was_found(make):
    for asked, held, scene in ((("s", "t"), ("s", "t"), "t"), ("s", "s", "s")):
        of = make()
        live = of.job(spec=replace(JobSpec("e"), scene=asked))
        live.held = None
        of.answer = lambda: EngineAnswer(result(), "t")
        of.worker.run(live)
        assert of.told[1] == ("hold", held)
        assert of.stored.scene == scene


def test_records_are_stored_in_batches_of_half_a_second(make):
    of = make()
    live = of.job()
    stored: list[int] = []

    def work(task, on_record):
        for pause_s in (0.0, 0.2, 0.29, 0.02, 0.1):
            of.clock.now += pause_s
            on_record(record("match", len(live.records)), None)
            stored.append(len(of.store.records("j")))
        return of.answer()

    of.work = work
    of.worker.run(live)
    # The first at once, then those of half a second together, and the rest with the end.
    assert stored == [1, 1, 1, 4, 4]
    assert [each.step.index for each in of.store.records("j")] == [0, 1, 2, 3, 4]


def test_the_photo_that_is_shown_is_that_of_the_latest_record(make):
    of = make()
    live = of.job()
    first, other = live.shown, SimpleNamespace(rgb=np.zeros((2, 2, 3), np.uint8))
    shown: list[Any] = []

    def work(task, on_record):
        for query in (None, other, None):
            on_record(record("match"), query)
            shown.append(live.shown)
        return of.answer()

    of.work = work
    of.worker.run(live)
    assert shown == [first, other, other]


def test_a_cancelled_job_ends_at_its_next_record(make):
    of = make()
    live = of.job()

    def work(task, on_record):
        on_record(record("match"), None)
        live.cancelled.set()
        on_record(record("match", 1), None)

    of.work = work
    of.worker.run(live)
    assert of.stored.state == "cancelled"
    assert len(of.store.records("j")) == 1


@pytest.mark.parametrize(("cancelled", "state"), [(False, "queued"), (True, "cancelled")])
def test_a_service_that_ends_leaves_its_jobs_for_the_next_unless_they_were_cancelled(make, cancelled, state):
    of = make()
    live = of.job()

    def work(task, on_record):
        of.worker.closing.set()
        if cancelled:
            of.store.request_cancel("j")
        raise Cancelled

    of.work = work
    of.worker.run(live)
    assert of.stored.state == state
    assert live.ended.is_set() is cancelled
    assert "lost" not in of.kinds()


@pytest.mark.parametrize(
    ("error", "state", "traced"),
    [(CorruptScene("torn.", where="s"), "interrupted", False), (ValueError("a bug"), "failed", True)],
)
def test_a_failure_ends_the_job_not_the_worker(make, caplog, error, state, traced):
    of = make()

    def work(task, on_record):
        raise error

    of.work = work
    with caplog.at_level(logging.ERROR):
        of.worker.run(of.job())
    assert of.stored.state == state
    assert of.stored.failure is not None
    assert bool(caplog.records[-1].exc_info) is traced


def test_scenes_that_were_refused_are_told(make):
    of = make()
    live = of.job()
    live.refused = CorruptScene("torn.", where="s")
    of.worker.run(live)
    assert of.stored.failure is not None
    assert of.stored.failure.code == "corrupt_scene"


@pytest.mark.parametrize(
    ("budget_s", "deadline_s", "expected"),
    [(None, None, 300.0), (20.0, None, 20.0), (20.0, 15.0, 15.0), (None, 400.0, 300.0), (None, 0.0, None)],
)
def test_the_budget_is_the_least_of_the_callers_and_the_operators(make, budget_s, deadline_s, expected):
    of = make()
    deadline = None if deadline_s is None else 5000.0 + deadline_s
    given: list[float] = []

    def work(task, on_record):
        given.append(task.given[3])
        return of.answer()

    of.work = work
    of.worker.run(of.job(spec=replace(JobSpec("e"), budget_s=budget_s), deadline=deadline))
    if expected is None:
        assert of.stored.failure is not None
        assert of.stored.failure.code == "deadline_exceeded"
    else:
        assert given == [expected]


def test_an_engine_that_ends_costs_the_attempt_its_lease(make):
    of = make()
    live = of.job()

    def work(task, on_record):
        raise EngineLost

    of.work = work
    of.worker.run(live)
    assert of.stored.state == "running"
    assert live.held is None
    assert of.store.reclaim(1.0, 9, of.stored.failure)  # its lease is over
    assert of.kinds()[-1] == "lost"
    assert not live.ended.is_set()


def test_an_attempt_that_was_given_up_stores_nothing_more(make):
    of = make()
    live = of.job()

    def work(task, on_record):
        live.begin(2)
        on_record(record("late"), None)

    of.work = work
    of.worker.run(live)
    assert of.store.records("j") == []
    assert of.kinds()[-1] == "lost"


def test_an_attempt_whose_lease_is_gone_ends_at_its_next_batch(make):
    of = make()
    live = of.job()

    def work(task, on_record):
        of.store.requeue("j", 1)
        on_record(record("late"), None)
        raise AssertionError("goes on")

    of.work = work
    of.worker.run(live)
    assert (of.stored.state, of.kinds()[-1]) == ("queued", "lost")
    # Nor does its result count.
    of.work = lambda task, on_record: of.store.requeue("j", 2) and of.answer()
    of.told.clear()
    of.worker.run(live)
    assert of.stored.state == "queued"
    assert of.kinds()[-1] == "lost"


def test_a_job_that_can_not_be_claimed_is_somebody_elses_unless_it_was_cancelled(make):
    of = make()
    live = of.job()
    of.store.request_cancel("j")
    of.worker.run(live)
    assert of.stored.state == "cancelled"
    assert live.ended.is_set()
    assert "lost" not in of.kinds()
    other = make()
    live = other.job()
    other.store.claim(other.stored, 9e9)
    other.worker.run(live)
    assert other.kinds() == ["lost"]
    assert other.worker.busy == Counter()
    # While another thread is at it nothing is lost.
    other.told.clear()
    other.worker.busy["j"] = 1
    other.worker.run(live)
    assert other.told == []
    assert other.worker.busy == {"j": 1}


def test_a_full_disk_is_waited_for(make, monkeypatch):
    of = make()
    live = of.job()
    finish, failures, waits = of.store.finish, [1, 2], []

    def full(*given):
        if failures:
            failures.pop()
            raise StorageFailed("The disk is full.")
        return finish(*given)

    monkeypatch.setattr(of.store, "finish", full)
    monkeypatch.setattr(of.worker.closing, "wait", lambda seconds: waits.append((seconds, of.worker.storage_error)))
    of.worker.run(live)
    assert of.stored.state == "succeeded"
    assert waits == [(0.5, "The disk is full.")] * 2
    assert of.worker.storage_error == ""


def test_where_the_service_ends_before_there_is_room_the_job_is_left(make, monkeypatch):
    of = make()
    live = of.job()

    def full(*given):
        raise StorageFailed("The disk is full.")

    monkeypatch.setattr(of.store, "get", full)
    monkeypatch.setattr(of.worker.closing, "wait", lambda seconds: True)
    of.worker.run(live)
    assert of.told == []


def test_records_that_can_not_be_stored_go_with_the_next_batch(make, monkeypatch):
    of = make()
    live = of.job()
    append, failures = of.store.append, [1]

    def full(*given):
        if failures:
            failures.pop()
            raise StorageFailed("The disk is full.")
        return append(*given)

    monkeypatch.setattr(of.store, "append", full)
    stored: list[int] = []

    def work(task, on_record):
        for _ in range(3):
            on_record(record("match", len(live.records)), None)
            stored.append(len(of.store.records("j")))
            of.clock.now += 0.5
        return of.answer()

    of.work = work
    of.worker.run(live)
    assert stored == [0, 2, 3]


def test_a_stuck_job_is_given_up_with_what_is_stored(make):
    of = make()
    live = of.job()
    of.store.claim(of.stored, 9e9)
    live.begin(1)
    live.add(record("match"))
    of.worker.give_up(live)
    assert of.stored.state == "interrupted"
    assert of.stored.failure is not None
    assert "no new record for 120 s" in of.stored.failure.message
    assert of.store.records("j") == []
    assert live.cancelled.is_set()
    assert of.told[0] == ("cancel", "j.1")
    of.told.clear()
    of.worker.give_up(live)  # it has ended
    assert of.told == []


def test_lenses_are_learnt_of_jobs_that_say_so(make):
    learnt: list[Any] = []
    lenses = SimpleNamespace(learn=lambda *given: learnt.append(given))
    for lens, memory in ((LensUse("me", None), lenses), (None, lenses), (LensUse("me", None), None)):
        of = make()
        of.worker._lenses = memory
        live = of.job(spec=replace(JobSpec("e"), lens=lens, camera_id="c"))
        live.photo.camera = "camera"  # type: ignore[union-attr]
        of.worker.run(live)
        assert of.stored.state == "succeeded"
    ((owner, camera_id, camera, recalled, _),) = learnt
    assert (owner, camera_id, camera, recalled) == ("me", "c", "camera", None)
    of = make()

    def full(*given):
        raise StorageFailed("The disk is full.")

    of.worker._lenses = SimpleNamespace(learn=full)
    live = of.job(spec=replace(JobSpec("e"), lens=LensUse("me", None)))
    live.photo.camera = "camera"  # type: ignore[union-attr]
    of.worker.run(live)
    assert of.stored.state == "succeeded"  # the answer is as good without
