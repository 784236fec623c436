"""What is accepted is never lost and never done twice: restarts, full disks, stuck workers, repeated requests."""

from __future__ import annotations

import shutil
import socket
import sqlite3
import threading
import time
from pathlib import Path
from types import ModuleType

import httpx
import pytest
from api_server import (
    assert_as_shown,
    assert_problem,
    at_each_front,
    create_app,
    events,
    finished,
    photo,
    photo_files,
    post,
    serving,
    settings,
    until,
    until_ready,
)
from stand_ins import make_scene
from two_fronts import FRONTS

import service.jobs.photo_store
import service.web.app
from service.cli.server import http_server
from service.errors import StorageFailed
from service.jobs.embedded_engine import EmbeddedEngine
from service.jobs.sqlite_store import SqliteJobStore


def app(folder: Path, **changes):
    return create_app(settings(data_dir=folder, **changes), {"room": make_scene()})


def ready(client: httpx.Client) -> None:
    until_ready(client)


# ------------------------------------------------------------------ restarts


@pytest.fixture
def crashed(stepping: ModuleType, tmp_path: Path) -> tuple[Path, list[str]]:
    """The folder of a service that was killed with one job running and two waiting, one of these cancelled."""
    with serving(app(tmp_path / "first", photo_grace_s=0)) as client:
        ready(client)
        running = post(client, prefer="", options={"hold": True}, seed="1").json()["id"]
        until(lambda: client.get(f"/jobs/{running}").json()["records"] == 1)
        stopping = post(client, prefer="", options={"hold": True}, seed="2").json()["id"]
        waiting = post(client, prefer="", seed="3", keep_photo="true").json()["id"]
        # As a power loss finds it: nothing is closed or flushed.
        shutil.copytree(tmp_path / "first", tmp_path / "copy")
        client.delete(f"/jobs/{stopping}")
        stepping.GO_ON.set()
    return tmp_path / "copy", [running, stopping, waiting]


def test_after_a_crash_every_job_is_done_once(crashed):
    folder, ids = crashed
    with serving(app(folder)) as client:
        jobs = [finished(client, f"/jobs/{job_id}") for job_id in ids]
        assert [job["state"] for job in jobs] == ["succeeded"] * 3
        # The one that ran starts again; the ones that waited start for the first time.
        assert [job["attempt"] for job in jobs] == [2, 1, 1]
        assert [job["result"]["seed"] for job in jobs] == [1, 2, 3]
        assert [job["id"] for job in client.get("/jobs").json()["jobs"]] == ids[::-1]
        trace = client.get(f"/jobs/{ids[0]}/trace").json()
        assert [record["index"] for record in trace["records"]] == [0, 1, 2]


def test_a_stream_goes_on_after_a_restart(crashed):
    folder, (running, *_) = crashed
    with serving(app(folder)) as client:
        finished(client, f"/jobs/{running}")
        resumed = events(client.get(f"/jobs/{running}/events", headers={"Last-Event-ID": "1.0"}).text)
        assert [number for _, number, _ in resumed] == ["", "2.0", "2.1", "2.2", "end"]
        assert (resumed[0][0], resumed[0][2]) == ("restarted", {"attempt": 2})
        resumed = events(client.get(f"/jobs/{running}/events", headers={"Last-Event-ID": "2.1"}).text)
        assert [number for _, number, _ in resumed] == ["2.2", "end"]


def test_a_cancelled_job_stays_cancelled_over_a_crash(stepping, tmp_path):
    with serving(app(tmp_path / "first")) as client:
        ready(client)
        path = post(client, prefer="", options={"hold": True}).headers["location"]
        until(lambda: client.get(path).json()["records"] == 1)
        assert client.delete(path).json()["state"] == "running"
        shutil.copytree(tmp_path / "first", tmp_path / "copy")
        stepping.GO_ON.set()
    with serving(app(tmp_path / "copy")) as client:
        assert client.get(path).json()["state"] == "cancelled"


def test_a_job_that_was_there_in_every_crash_is_given_up(crashed):
    folder, (running, *_) = crashed
    with serving(app(folder, crashes=1)) as client:
        job = client.get(f"/jobs/{running}").json()
        assert (job["state"], job["error"]["code"]) == ("interrupted", "interrupted")
        assert job["error"]["instance"] == f"/jobs/{running}"
        assert_as_shown(job["error"])
        told = events(client.get(f"/jobs/{running}/events").text)
        # The record that was stored before the crash is not lost either.
        assert [(name, number) for name, number, _ in told] == [("record", "1.0"), ("error", "end")]


def test_a_job_whose_scene_is_gone_is_interrupted_with_the_reason(crashed):
    folder, ids = crashed
    with serving(create_app(settings(data_dir=folder), {"attic": make_scene("attic")})) as client:
        job = finished(client, f"/jobs/{ids[2]}")
        assert (job["state"], job["error"]["code"]) == ("interrupted", "scene_not_found")


def test_a_stopped_service_finishes_or_puts_back_what_runs(stepping, tmp_path, monkeypatch):
    def cancel(engine: EmbeddedEngine, task_id: str) -> None:
        stop(engine, task_id)
        stepping.GO_ON.set()  # only now: what ends within the grace period is finished

    stop = EmbeddedEngine.cancel
    monkeypatch.setattr(EmbeddedEngine, "cancel", cancel)
    with serving(app(tmp_path, shutdown_s=0.2)) as client:
        ready(client)
        held = post(client, prefer="", options={"hold": True}).headers["location"]
        until(lambda: client.get(held).json()["records"] == 1)
        waiting = post(client, prefer="").headers["location"]
    with serving(app(tmp_path)) as client:
        for path, attempt in ((held, 2), (waiting, 1)):
            job = finished(client, path)
            assert (job["state"], job["attempt"]) == ("succeeded", attempt)


def test_a_service_that_ends_answers_who_has_connected_and_ends_streams(stepping, tmp_path):
    """A gateway that has connected may not send its request to another front any more."""
    chosen, told = settings(data_dir=tmp_path, shutdown_s=0), []
    served = create_app(chosen, {"room": make_scene()})
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        address = listener.getsockname()
        with pytest.raises(ConnectionRefusedError):  # a gateway takes another front until this one has started
            socket.create_connection(address)
        server = http_server(served, chosen)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        with httpx.Client(base_url=f"http://127.0.0.1:{address[1]}", timeout=20, trust_env=False) as client:
            until(lambda: server.started)
            ready(client)
            job = post(client, prefer="", options={"steps": 100, "pause_s": 0.1}).headers["location"]
            with client.stream("GET", f"{job}/events") as stream:
                lines = stream.iter_lines()
                until(lambda: next(lines).startswith("id: "))
                early = socket.create_connection(address)
                server.should_exit = True
                told += [line for line in lines if line.startswith("id: ")]  # raises where the stream breaks
        with early:
            early.sendall(b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert early.recv(100).startswith(b"HTTP/1.1 200")
        thread.join()
    assert "id: end" not in told
    with serving(app(tmp_path)) as client:
        assert client.get(job).json()["state"] in ("queued", "running")
        client.delete(job)


def test_a_folder_has_one_service(stepping, tmp_path):
    used = pytest.raises(StorageFailed, match="another process uses it")
    with serving(app(tmp_path)), used, service.web.app.data_folder(tmp_path):
        pass


# ------------------------------------------------------------------ repeated requests


def keyed(client: httpx.Client, key: str, **fields) -> httpx.Response:
    headers = {"Idempotency-Key": key}
    return client.post("/localize", files={"photo": ("p.jpg", photo())}, data=fields, headers=headers)


def test_a_repeated_request_is_the_same_job(client, stepping):
    first, again = keyed(client, "a", seed="1"), keyed(client, "a", seed="1")
    assert first.json()["id"] == again.json()["id"]
    assert keyed(client, "b", seed="1").json()["id"] != first.json()["id"]
    assert_problem(keyed(client, "a", seed="2"), 422, "idempotency_conflict", "header.idempotency-key")
    finished(client, first.headers["location"])
    assert keyed(client, "a", seed="1").json()["state"] == "succeeded"
    assert len(client.get("/jobs").json()["jobs"]) == 2


def test_an_empty_key_is_no_key(client, stepping):
    for _ in range(2):  # the second one would have met the first one's
        assert_problem(keyed(client, "", seed="1"), 400, "invalid_request", "header.idempotency-key")


def test_a_repeated_request_is_answered_by_a_full_service_too(client, stepping):
    held = [post(client, prefer="", options={"hold": True}).headers["location"] for _ in range(FRONTS)]
    until(lambda: all(client.get(path).json()["state"] == "running" for path in held))
    kept, *others = [keyed(client, f"{number}") for number in range(2 * FRONTS)]
    assert {answer.status_code for answer in others} == {202}
    assert {answer.status_code for answer in at_each_front(lambda: keyed(client, "c"))} == {503}
    assert {answer.json()["id"] for answer in at_each_front(lambda: keyed(client, "0"))} == {kept.json()["id"]}


# ------------------------------------------------------------------ the disk


def test_a_photo_that_cannot_be_written_is_not_accepted(stepping, tmp_path, monkeypatch):
    def full(path, data):
        path.write_bytes(data[:10])
        raise OSError(28, "No space left on device")

    with serving(app(tmp_path)) as client:
        ready(client)
        with monkeypatch.context() as patch:
            patch.setattr(service.jobs.photo_store, "write_durably", full)
            refused = post(client)
            assert_problem(refused, 503, "storage_failed")
            assert int(refused.headers["retry-after"]) > 0
            told = client.get("/readyz")
            assert told.status_code == 503
            assert "No space left" in told.json()["failed"][0]
        assert client.get("/jobs").json()["jobs"] == []
        assert list((tmp_path / "photos").iterdir()) == []
        until_ready(client)
        assert post(client).json()["state"] == "succeeded"


def test_a_result_waits_until_the_disk_has_room(stepping, tmp_path):
    """SQLite's own limit of pages makes it say that the disk is full."""
    service_app = app(tmp_path)
    with serving(service_app) as client:
        ready(client)
        path = post(client, prefer="", options={"hold": True, "steps": 60}).headers["location"]
        until(lambda: client.get(path).json()["records"] == 1)
        writer = service_app.state.app_state.jobs._store._database._writer
        (pages,) = writer.execute("PRAGMA page_count").fetchone()
        writer.execute(f"PRAGMA max_page_count = {pages}")
        stepping.GO_ON.set()
        until(lambda: client.get("/readyz").status_code == 503)
        assert "full" in client.get("/readyz").json()["failed"][0]
        assert client.get(path).json()["state"] == "running"
        writer.execute("PRAGMA max_page_count = 100000")
        job = finished(client, path)
        assert (job["state"], job["records"]) == ("succeeded", 60)
        assert len(client.get(f"{path}/trace").json()["records"]) == 60


def test_photos_go_with_their_job_unless_kept(stepping, tmp_path):
    with serving(app(tmp_path, photo_grace_s=0)) as client:
        ready(client)
        gone, kept = post(client).json(), post(client, keep_photo="true").json()
        assert_problem(client.get(gone["links"]["photo"]), 404, "photo_gone")
        assert client.get(kept["links"]["photo"]).status_code == 200
        until(lambda: photo_files(tmp_path) == [f"{kept['id']}.jpg"])


def test_a_photo_can_be_looked_at_for_a_while(stepping, tmp_path):
    with serving(app(tmp_path, photo_grace_s=0.5)) as client:
        ready(client)
        link = post(client).json()["links"]["photo"]
        assert client.get(link).status_code == 200
        until(lambda: client.get(link).status_code == 404)
        assert not photo_files(tmp_path)


# ------------------------------------------------------------------ workers and deadlines


def test_a_stuck_worker_is_replaced_and_two_are_told(stepping, tmp_path):
    # Longer than a free worker takes for a step where other programs use the machine.
    with serving(app(tmp_path, stuck_s=1.0)) as client:
        ready(client)
        for _ in range(2):
            held = at_each_front(lambda: post(client, prefer="", options={"hold": True}).headers["location"])
            for job in (finished(client, path) for path in held):
                assert (job["state"], job["error"]["code"]) == ("interrupted", "interrupted")
            assert {answer.json()["state"] for answer in at_each_front(lambda: post(client))} == {"succeeded"}
        for told in at_each_front(lambda: client.get("/readyz")):
            assert (told.status_code, told.json()["failed"]) == (503, ["2 workers are stuck: restart the service."])
        stepping.GO_ON.set()
        time.sleep(0.2)  # the abandoned threads come back, too late
        assert {job["state"] for job in client.get("/jobs").json()["jobs"]} == {"interrupted", "succeeded"}


def test_a_job_past_its_deadline_does_not_start(client, stepping):
    at_each_front(lambda: post(client, prefer="", options={"hold": True}))
    late = post(client, prefer="", deadline_s=0.1).headers["location"]
    in_time = post(client, prefer="", deadline_s=60).headers["location"]
    time.sleep(0.2)
    stepping.GO_ON.set()
    job = finished(client, late)
    assert (job["state"], job["error"]["code"], job["error"]["status"]) == ("failed", "deadline_exceeded", 504)
    assert finished(client, in_time)["state"] == "succeeded"


# ------------------------------------------------------------------ the database


def test_a_file_of_a_newer_program_is_refused(tmp_path):
    with sqlite3.connect(tmp_path / "jobs.sqlite") as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(StorageFailed, match="version 99"):
        SqliteJobStore(tmp_path / "jobs.sqlite")


def test_a_file_that_is_no_database_is_told(tmp_path):
    (tmp_path / "jobs.sqlite").write_bytes(b"not a database" * 100)
    with pytest.raises(StorageFailed, match="not a database"):
        SqliteJobStore(tmp_path / "jobs.sqlite")
