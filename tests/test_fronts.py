"""Several fronts on one PostgreSQL database: any answers for any job; of one that is killed, another takes over."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from api_server import GO_ON, create_app, events, finished, photo, post, serving, settings, until, until_ready
from stand_ins import make_scene
from test_leases import CountingObserver, order
from test_store_contracts import FAILURE, NONE, new_job, record

from service.errors import PhotoGone, QueueFull, StorageFailed
from service.jobs.config import JobsConfig
from service.jobs.embedded_engine import EmbeddedEngine, EngineConfig
from service.jobs.model import Batch, StoredJob
from service.jobs.service import Jobs

pytestmark = pytest.mark.ci

ROOT = Path(__file__).parents[1]


@contextmanager
def front(database, **config) -> Iterator[Jobs]:
    """One front's jobs, with an engine of its own."""
    from service.jobs.postgres_database import PostgresDatabase
    from service.jobs.postgres_store import PostgresJobStore, PostgresPhotoStore

    own = PostgresDatabase(database)
    engine = EmbeddedEngine(EngineConfig("stepping"))
    engine.add_loaded("room", make_scene())
    engine.start()
    until(lambda: engine.readiness().ready)
    config = {"workers": 1, "lease_s": 2.0, "shutdown_s": 0, "photo_grace_s": 0} | config
    stores = PostgresJobStore(own), PostgresPhotoStore(own)
    jobs = Jobs(JobsConfig(**config), engine, *stores, CountingObserver())
    jobs.start()
    try:
        yield jobs
    finally:
        GO_ON.set()
        jobs.close()
        engine.close()


@pytest.fixture
def address(postgres) -> str:
    return postgres.database()


@pytest.fixture
def fronts(address, stepping) -> Iterator[tuple[Jobs, Jobs]]:
    with front(address) as first, front(address) as second:
        yield first, second


def ended(jobs: Jobs, job: StoredJob, seconds: float = 20) -> StoredJob:
    until(lambda: jobs.get(job.id).ended, seconds)
    return jobs.get(job.id)


def test_any_front_follows_and_cancels_any_job(fronts):
    first, second = fronts
    job = first.accept(order(hold=True))
    until(lambda: first.get(job.id).records >= 1)
    with pytest.raises(PhotoGone):
        second._photos.kept(job.id)
    assert second.photo(job)[:2] == b"\xff\xd8"  # it is read again
    live = second.live(second.get(job.id))
    assert live is not None
    until(lambda: len(live.records) == 1)
    second.cancel(second.get(job.id))
    until(lambda: first.live(job).cancelled.is_set())
    GO_ON.set()
    until(live.ended.is_set)
    assert second.get(job.id).state == "cancelled"
    assert [r.step.index for r in second.records(second.get(job.id))] == [0]


def test_a_job_that_waits_elsewhere_is_cancelled_at_once(fronts):
    first, second = fronts
    blocking = [jobs.accept(order(hold=True, steps=3)) for jobs in fronts]
    until(lambda: all(first.get(job.id).state == "running" for job in blocking))
    job = first.accept(order(steps=4))
    live = first.live(job)
    second.cancel(second.get(job.id))
    assert second.get(job.id).state == "cancelled"
    until(live.ended.is_set)
    assert first._queue.waiting() == 0
    GO_ON.set()
    for blocked in blocking:
        assert ended(second, blocked).state == "succeeded"


def test_an_idle_front_takes_what_waits_elsewhere(fronts):
    first, second = fronts
    blocking = first.accept(order(hold=True))
    until(lambda: first.get(blocking.id).records >= 1)
    job = first.accept(order(steps=4))
    live = first.live(job)
    assert ended(first, job).state == "succeeded"
    assert second._worker._observer.seen["started"] == 1
    until(live.ended.is_set)  # who listened at the first front has heard it all
    assert [r.step.index for r in live.records] == [0, 1, 2, 3]
    GO_ON.set()
    assert ended(second, blocking).state == "succeeded"


def test_a_front_that_slept_finds_its_job_made_by_another(fronts, monkeypatch):
    """Its leases aren't renewed; its thread comes back when the other front has the next attempt."""
    first, second = fronts
    monkeypatch.setattr(first, "_renew", lambda: None)
    monkeypatch.setattr(first, "_reclaim", lambda before: None)
    job = first.accept(order(hold=True, steps=3))
    live = first.live(job)
    until(lambda: second.get(job.id).attempt == 2)
    GO_ON.set()
    found = ended(second, job)
    until(live.ended.is_set)
    assert (found.state, found.attempt, found.lost, found.records) == ("succeeded", 2, 1, 3)
    assert (live.attempt, [r.step.index for r in live.records]) == (2, [0, 1, 2])


FRONT = """
import sys, time
from api_server import fake_estimators
from test_fronts import front
from test_leases import order
with fake_estimators(), front(sys.argv[1]) as jobs:
    ids = [jobs.accept(order(steps=8, pause_s=0.3)).id for _ in range(2)]
    while jobs.get(ids[0]).records < 2: time.sleep(0.01)
    print(*ids, flush=True)
    time.sleep(60)
"""


def test_a_killed_front_loses_no_job(address, stepping):
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    child = subprocess.Popen(
        [sys.executable, "-c", FRONT, address],
        stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": path}, cwd=ROOT,
    )  # fmt: skip
    try:
        running, waiting = child.stdout.readline().split()
        with front(address) as jobs:
            live = jobs.live(jobs.get(running))
            child.send_signal(signal.SIGKILL)
            for job_id in (running, waiting):
                assert ended(jobs, jobs.get(job_id), 40).state == "succeeded"
            until(live.ended.is_set)
            assert (jobs.get(running).attempt, jobs.get(running).lost, len(live.records)) == (2, 1, 8)
            assert (jobs.get(waiting).attempt, jobs.get(waiting).lost) == (1, 0)
    finally:
        child.kill()
        child.communicate()


def test_jobs_outlive_a_restart_of_the_database(postgres, address, stepping):
    with front(address) as jobs:
        job = jobs.accept(order(steps=20, pause_s=0.1))
        until(lambda: jobs.get(job.id).records >= 2)
        postgres.stop()
        with pytest.raises(StorageFailed):
            jobs._store.probe()
        postgres.start()
        until(lambda: _has_ended(jobs, job.id), 40)
        found = jobs.get(job.id)
        assert (found.state, found.records) == ("succeeded", 20)
        assert len(jobs._store.records(job.id)) == 20


def _has_ended(jobs: Jobs, job_id: str) -> bool:
    try:
        return jobs.get(job_id).ended
    except StorageFailed:  # it is still away
        return False


def test_a_missed_notification_costs_a_second(fronts, monkeypatch):
    first, second = fronts
    from service.jobs.postgres_database import PostgresListener

    monkeypatch.setattr(PostgresListener, "wait", lambda self, seconds: time.sleep(seconds) or set())
    job = first.accept(order(steps=6, pause_s=0.2))
    live = second.live(second.get(job.id))
    until(live.ended.is_set)
    assert [r.step.index for r in live.records] == [0, 1, 2, 3, 4, 5]


# ------------------------------------------------------------------ the store


def test_of_two_requests_with_one_key_at_two_fronts_one_is_stored(postgres, address):
    from service.jobs.postgres_database import PostgresDatabase
    from service.jobs.postgres_store import PostgresJobStore

    stores = [PostgresJobStore(PostgresDatabase(address)) for _ in range(2)]
    for number in range(20):
        accepted: list[str] = []
        barrier = threading.Barrier(2)

        def send(store, name, number=number, accepted=accepted, barrier=barrier) -> None:
            barrier.wait()
            accepted.append(store.accept(new_job(name, idempotency_key=f"k{number}")).id)

        threads = [threading.Thread(target=send, args=(s, f"{number}.{k}")) for k, s in enumerate(stores)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(accepted) == 2
        assert len(set(accepted)) == 1
    assert len(stores[0].ids()) == 20
    for store in stores:
        store.close()


def test_a_clients_share_holds_at_two_fronts_at_once(postgres, address):
    from service.jobs.postgres_database import PostgresDatabase
    from service.jobs.postgres_store import PostgresJobStore

    stores = [PostgresJobStore(PostgresDatabase(address)) for _ in range(2)]
    for number in range(20):
        client, barrier, refused = f"client {number}", threading.Barrier(2), []

        def send(store, name, client=client, barrier=barrier, refused=refused) -> None:
            barrier.wait()
            try:
                store.accept(new_job(name, client=client), 1)
            except QueueFull:
                refused.append(name)

        threads = [threading.Thread(target=send, args=(s, f"{number}.{k}")) for k, s in enumerate(stores)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(refused) == 1
        assert stores[0].count("queued", client) == 1
    for store in stores:
        store.close()


def test_a_lost_attempt_is_given_to_one_front(postgres, address):
    from service.jobs.postgres_database import PostgresDatabase
    from service.jobs.postgres_store import PostgresJobStore

    stores = [PostgresJobStore(PostgresDatabase(address)) for _ in range(2)]
    for number in range(20):
        stores[0].claim(stores[0].accept(new_job(f"{number}")), 1.0)
    taken: list[str] = []
    barrier = threading.Barrier(2)

    def reclaim(store) -> None:
        barrier.wait()
        taken.extend(job.id for job in store.reclaim(2.0, 3, FAILURE))

    threads = [threading.Thread(target=reclaim, args=(store,)) for store in stores]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == sorted(f"{k}" for k in range(20))
    assert {stores[1].get(name).lost for name in taken} == {1}
    for store in stores:
        store.close()


def test_a_program_of_the_last_release_goes_on_after_a_migration(database):
    from service.jobs.postgres_database import Migration
    from service.jobs.postgres_store import PostgresJobStore

    old = PostgresJobStore(database)
    old.accept(new_job("before"))

    def add_column(writer) -> None:
        writer.execute("ALTER TABLE jobs ADD COLUMN note TEXT NOT NULL DEFAULT ''")

    first = Migration(lambda writer: None, 1)
    database.migrate("jobs", (first, Migration(add_column, readable_from=1)))
    old.claim(old.accept(new_job("after")), 1e12)
    assert old.finish("after", 1, Batch(0, [record("x")]), NONE and _failed(), None)
    assert PostgresJobStore(database).ids() == {"before", "after"}  # one that is started now, too
    database.migrate("jobs", (first, first, Migration(lambda writer: None, readable_from=3)))
    with pytest.raises(StorageFailed, match="version 3 of its jobs"):
        PostgresJobStore(database)


def _failed():
    from service.jobs.model import Ending

    return Ending("failed", failure=FAILURE)


@pytest.mark.parametrize(
    ("address", "warned"),
    [
        ("postgresql://u@127.0.0.1/x", False),
        ("postgresql://u@localhost/x", False),
        ("postgresql://u@[::1]/x", False),
        ("postgresql:///x?host=/run/postgresql", False),
        ("postgresql://u@db/x", True),
        ("postgresql://u@db/x?sslmode=prefer", True),
        ("postgresql://u@localhost,10.0.0.1/x", True),
        ("postgresql://u@db/x?sslmode=verify-full", False),
        ("host=db sslmode=require", False),
        ("mysql://db", True),
    ],
)
def test_who_can_read_along_is_told(address, warned):
    pytest.importorskip("psycopg")
    from service.jobs.postgres_database import unprotected

    assert bool(unprotected(address)) == warned


def test_doctor_examines_the_database_and_shows_no_password(address, monkeypatch):
    from service.cli.doctor import settings_lines
    from service.cli.fleet_findings import fleet_findings

    (found,) = fleet_findings(settings(database=address))
    assert (found.subject, found.ok) == ("database", True)
    assert list(fleet_findings(settings())) == []
    monkeypatch.setenv("SPLATFIX_DATABASE", "postgresql://splatfix:secret@192.0.2.1/splatfix")
    assert "secret" not in "".join(settings_lines())


# ------------------------------------------------------------------ over HTTP


@pytest.fixture
def addresses(address, stepping) -> Iterator[list[httpx.Client]]:
    """Two services on one database."""

    def app():
        return create_app(settings(database=address), {"room": make_scene()})

    with serving(app()) as first, serving(app()) as second:
        for client in (first, second):
            until_ready(client)
        yield [first, second]
        stepping.GO_ON.set()


def test_events_are_streamed_by_any_front_and_resumed_by_another(addresses):
    first, second = addresses
    job = post(first, prefer="", options={"steps": 12, "pause_s": 0.15}).json()
    until(lambda: second.get(job["links"]["self"]).json()["records"] >= 2)
    seen = []
    with second.stream("GET", job["links"]["events"]) as stream:
        for line in stream.iter_lines():
            if line.startswith("id: "):
                seen.append(line.removeprefix("id: "))
            if len(seen) == 5:
                break
    with first.stream("GET", job["links"]["events"], headers={"Last-Event-ID": seen[-1]}) as stream:
        told = events("".join(stream.iter_text()))
    assert [*seen, *(number for _, number, _ in told)] == [*(f"1.{k}" for k in range(12)), "end"]
    assert finished(second, job["links"]["self"])["state"] == "succeeded"


def test_a_request_is_the_same_job_at_every_front(addresses):
    first, second = addresses
    files = {"photo": ("p.jpg", photo(), "image/jpeg")}
    headers = {"Idempotency-Key": "k", "Prefer": "wait=20"}
    answers = [
        c.post("/localize", files=files, data={"options": json.dumps({"steps": 3})}, headers=headers) for c in addresses
    ]
    assert len({answer.json()["id"] for answer in answers}) == 1
    assert {answer.json()["state"] for answer in answers} == {"succeeded"}
    listed = [[job["id"] for job in client.get("/jobs").json()["jobs"]] for client in addresses]
    assert listed[0] == listed[1] == [answers[0].json()["id"]]
    done = second.delete(f"{answers[0].json()['links']['self']}?purge=true")
    assert done.status_code == 200
    assert first.get(answers[0].json()["links"]["self"]).status_code == 404
