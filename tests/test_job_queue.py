"""The queue of jobs and its threads, with jobs that end when a test says so."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fake_service import until

from service.errors import QueueFull
from service.jobs import queue as job_queue
from service.jobs.queue import JobQueue


class Job:
    def __init__(self, name: str, memory_bytes: int = 0) -> None:
        self.id, self.memory_bytes = name, memory_bytes
        self.begun, self.go_on, self.done = threading.Event(), threading.Event(), threading.Event()
        self.silence = 0.0
        self.fails = False

    def mark_alive(self) -> None:
        self.silence = 0.0

    def silent_s(self) -> float:
        return self.silence


def run(job: Any) -> None:
    job.begun.set()
    assert job.go_on.wait(20)
    job.done.set()
    if job.fails:
        raise OSError("the disk is full")


@pytest.fixture
def given_up() -> list[Any]:
    return []


@pytest.fixture
def make(given_up: list[Any], monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., JobQueue]]:
    monkeypatch.setattr(job_queue, "_WATCH_S", 0.01)
    queues: list[JobQueue] = []
    jobs: list[Job] = []

    def made(**changes: Any) -> JobQueue:
        def watched(job: Any) -> None:
            jobs.append(job)
            run(job)

        limits = {"workers": 1, "queue_size": 2, "queue_bytes": 1000, "stuck_s": 60.0}
        queues.append(JobQueue(watched, given_up.append, **(limits | changes)))
        return queues[-1]

    yield made
    for job in jobs:
        job.go_on.set()
    for queue in queues:
        queue.close(10.0)


def submitted(queue: JobQueue, name: str, memory_bytes: int = 0) -> Job:
    job = Job(name, memory_bytes)
    queue.reserve()
    queue.submit(job)  # type: ignore[arg-type]
    return job


def test_there_is_a_place_for_each_idle_worker_and_those_that_wait(make: Callable[..., JobQueue]) -> None:
    queue = make(workers=2, queue_size=1)
    first, second = submitted(queue, "a"), submitted(queue, "b")
    assert first.begun.wait(20)
    assert second.begun.wait(20)
    assert not queue.full()
    submitted(queue, "c").go_on.set()
    assert queue.waiting() == 1
    assert queue.full()
    with pytest.raises(QueueFull, match="1 jobs"):
        queue.reserve()
    first.go_on.set()
    until(lambda: queue.waiting() == 0, "the third job")
    until(lambda: not queue.full(), "its place")


def test_a_place_that_was_reserved_is_taken_until_it_is_given_back(make: Callable[..., JobQueue]) -> None:
    queue = make(workers=1, queue_size=1)
    busy = submitted(queue, "a")
    assert busy.begun.wait(20)
    queue.reserve()
    assert queue.full()
    queue.release()
    assert not queue.full()
    again = Job("again")
    queue.submit(again, reserved=False)  # type: ignore[arg-type]  # after a restart: nobody could refuse it
    assert queue.full()
    queue.withdraw(again)  # type: ignore[arg-type]
    queue.withdraw(again)  # type: ignore[arg-type]  # whoever cancels it twice
    assert queue.waiting() == 0
    queue.reserve()
    queue.release()


@pytest.mark.parametrize(("memory_bytes", "full"), [(1000, False), (1001, True)])
def test_waiting_photos_are_limited_by_their_memory(
    memory_bytes: int, full: bool, make: Callable[..., JobQueue]
) -> None:
    queue = make(queue_size=50)
    assert submitted(queue, "a", 5000).begun.wait(20)  # what runs doesn't wait
    assert not queue.full()
    submitted(queue, "b", memory_bytes).go_on.set()
    assert queue.full() is full


def test_closing_does_not_wait_for_idle_workers_and_what_waits_is_not_begun(make: Callable[..., JobQueue]) -> None:
    idle = make(workers=3)
    began = time.monotonic()
    idle.close(30.0)
    assert time.monotonic() - began < 15
    assert idle.full()
    queue = make()
    running, waiting = submitted(queue, "a"), submitted(queue, "b")
    assert running.begun.wait(20)
    began = time.monotonic()
    queue.close(0.1)  # the job goes on
    assert time.monotonic() - began < 15
    assert queue.waiting() == 0
    running.go_on.set()
    assert running.done.wait(20)
    assert not waiting.begun.wait(0.05)


def test_closing_waits_for_a_job_within_the_grace_period(make: Callable[..., JobQueue]) -> None:
    queue = make()
    job = submitted(queue, "a")
    assert job.begun.wait(20)
    timer = threading.Timer(0.1, job.go_on.set)
    timer.start()
    queue.close(20.0)
    assert job.done.is_set()
    timer.join()


def test_a_job_that_fails_takes_no_worker_with_it(make: Callable[..., JobQueue]) -> None:
    queue = make()
    first = submitted(queue, "a")
    first.fails = True
    first.go_on.set()
    second = submitted(queue, "b")
    assert second.begun.wait(20)
    assert queue.stuck() == 0


@pytest.mark.parametrize("fails", [False, True])
def test_a_worker_whose_job_is_silent_is_replaced(
    fails: bool, make: Callable[..., JobQueue], given_up: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = make(stuck_s=60.0)
    if fails:  # its end can't be recorded: the next one is given up nevertheless

        def refuse(job: Any) -> None:
            given_up.append(job)
            raise OSError("the disk is full")

        monkeypatch.setattr(queue, "_give_up", refuse)
    jobs = []
    for number in range(2):
        job = submitted(queue, f"{number}")
        jobs.append(job)
        assert job.begun.wait(20)
        job.silence = 59.0
        time.sleep(0.05)
        assert queue.stuck() == number
        job.silence = 61.0
        until(lambda count=number: queue.stuck() == count + 1 and len(given_up) == count + 1, "giving up")
    assert given_up == jobs
    third = submitted(queue, "third")
    assert third.begun.wait(20)  # on another thread
    waiting = submitted(queue, "waiting")
    jobs[0].go_on.set()
    assert jobs[0].done.wait(20)
    # The thread that came to life again takes no job: there is one worker.
    assert not waiting.begun.wait(0.05)
    third.go_on.set()
    assert waiting.begun.wait(20)
