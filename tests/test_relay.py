"""The viewer's relay and its supervisor, against a small websockets server and small child processes."""

from __future__ import annotations

import asyncio
import gzip
import http
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
import uvicorn
import websockets.sync.client
from fastapi import FastAPI
from websockets.asyncio.server import serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Response

from service.web import problems, viewer_process
from service.web.api_keys import KeyRing
from service.web.viewer_process import ViewerChild
from service.web.viewer_relay import Relay

PAGE = b"<html><head></head>the one page</html>"


@dataclass
class Upstream:
    port: int
    started: float = 0.0


class Viewer:
    """As viser is seen from outside: one page, 404 for other paths, and a socket that tells what it was asked."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self.started = threading.Event()
        self.port = 0
        self.thread = threading.Thread(target=self.loop.run_until_complete, args=(self.run(),))

    async def run(self) -> None:
        self.stop = asyncio.Event()
        async with serve(
            self.answer,
            "127.0.0.1",
            0,
            process_request=self.page,
            compression=None,
            max_size=2**26,
            select_subprotocol=lambda _, offered: offered[0] if offered else None,
        ) as server:
            self.port = server.sockets[0].getsockname()[1]
            self.started.set()
            await self.stop.wait()

    def page(self, connection, request):
        if request.headers.get("Upgrade") == "websocket":
            return None
        if request.path != "/":
            return Response(http.HTTPStatus.NOT_FOUND, "NOT FOUND", Headers())
        packed = "gzip" in request.headers.get("Accept-Encoding", "")
        body = gzip.compress(PAGE) if packed else PAGE
        headers = {"Content-Type": "text/html", "Content-Length": str(len(body))}
        headers |= {"Content-Encoding": "gzip"} if packed else {}
        return Response(http.HTTPStatus.OK, "OK", Headers(**headers), body)

    async def answer(self, connection) -> None:
        await connection.send(f"{connection.request.path} {connection.subprotocol}")
        async for message in connection:
            if message == b"leave":
                await connection.close(4001, "told to")
                return
            await connection.send(message)


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    viewer = Viewer()
    viewer.thread.start()
    assert viewer.started.wait(10)
    yield viewer
    viewer.loop.call_soon_threadsafe(viewer.stop.set)
    viewer.thread.join()
    viewer.loop.close()


@contextmanager
def relaying(port: int) -> Iterator[str]:
    """host:port of a service that has nothing but the relay."""
    relay = Relay(Upstream(port), KeyRing(None))
    app = FastAPI()
    problems.add_error_handlers(app)
    app.include_router(relay.router)
    app.router.add_event_handler("shutdown", relay.close)
    config = uvicorn.Config(app, port=0, log_level="critical", ws="websockets-sansio", ws_max_size=2**26)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.005)
    yield f"127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join()


def connect(address: str, path: str, **options):
    return websockets.sync.client.connect(f"ws://{address}{path}", proxy=None, compression=None, **options)


@pytest.mark.parametrize("path", ["/viewer", "/viewer/", "/viewer/jobs/abc/", "/viewer/jobs/abc"])
def test_every_path_gets_the_page_with_our_script(viewer, path):
    with relaying(viewer.port) as address:
        page = httpx.get(f"http://{address}{path}", trust_env=False)
    script = b'<script src="/ui/viewer.js"></script>'
    assert (page.status_code, page.content) == (200, PAGE.replace(b"<head>", b"<head>" + script))
    assert page.headers["content-type"].startswith("text/html")


@pytest.mark.parametrize(
    ("cookie", "seen"),
    [
        ("software", "/jobs/abc?gl=software"),
        ("gpu; splatfix_zone=Europe%2FBerlin", "/jobs/abc?gl=gpu&zone=Europe%2FBerlin"),
    ],
)
def test_the_viewer_hears_of_the_browsers_gpu_and_time_zone(viewer, cookie, seen):
    headers = {"Cookie": f"splatfix_gl={cookie}"}
    with (
        relaying(viewer.port) as address,
        connect(address, "/viewer/jobs/abc", subprotocols=["viser-v1.1.1"], additional_headers=headers) as socket,
    ):
        assert socket.recv() == f"{seen} viser-v1.1.1"


@pytest.mark.parametrize(("path", "seen"), [("/viewer", "/"), ("/viewer/", "/"), ("/viewer/jobs/abc", "/jobs/abc")])
def test_the_socket_hands_on_path_and_subprotocol(viewer, path, seen):
    with (
        relaying(viewer.port) as address,
        connect(address, path, subprotocols=["viser-v1.1.1"]) as socket,
    ):
        assert socket.subprotocol == "viser-v1.1.1"
        assert socket.recv() == f"{seen} viser-v1.1.1"


def test_large_binary_messages_pass_both_ways(viewer):
    large = os.urandom(20_000_000)  # a scene of 600,000 splats; more than the libraries' default limits
    with relaying(viewer.port) as address, connect(address, "/viewer", max_size=None) as socket:
        assert socket.recv() == "/ None"
        socket.send(large)
        assert socket.recv() == large
        socket.send("text")
        assert socket.recv() == "text"


def test_when_the_viewer_closes_the_browser_is_told(viewer):
    with relaying(viewer.port) as address, connect(address, "/viewer") as socket:
        socket.recv()
        socket.send(b"leave")
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=10)
    assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (4001, "told to")


def test_without_a_viewer_the_page_is_a_problem_and_the_socket_refused():
    with relaying(1) as address:  # nobody listens on port 1
        page = httpx.get(f"http://{address}/viewer/", trust_env=False)
        assert (page.status_code, page.json()["code"]) == (503, "unavailable")
        assert "retry-after" in page.headers
        with pytest.raises((InvalidStatus, ConnectionClosed)), connect(address, "/viewer") as socket:
            socket.recv(timeout=10)


def test_a_viewer_that_dies_is_started_again_and_ends_with_its_supervisor(tmp_path):
    log = tmp_path / "started"
    dies_twice = (
        f"import os, time; open({str(log)!r}, 'a').write(f'{{os.getpid()}}\\n');"
        f"count = len(open({str(log)!r}).readlines()); time.sleep(60) if count > 2 else None"
    )

    async def scenario() -> list[int]:
        child = ViewerChild("http://127.0.0.1:1")
        child.command = [sys.executable, "-c", dies_twice]
        task = asyncio.create_task(child.supervise())
        while not log.exists() or log.read_text().count("\n") < 3:
            await asyncio.sleep(0.02)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        return [int(line) for line in log.read_text().split()]

    pids = asyncio.run(asyncio.wait_for(scenario(), 30))
    assert len(set(pids)) == 3
    assert not Path(f"/proc/{pids[-1]}").exists()


def test_a_viewer_that_crashes_at_once_is_started_ever_more_slowly(monkeypatch):
    """Up to once in half a minute; after a run of more than a minute soon again."""
    runs, pauses = iter([0.0] * 7 + [60.0, 61.0, 0.0]), []
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)

    async def run_once(self) -> None:
        if (seconds := next(runs, None)) is None:
            raise asyncio.CancelledError
        clock.now += seconds

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    monkeypatch.setattr(viewer_process, "time", clock)
    monkeypatch.setattr(viewer_process.asyncio, "sleep", sleep)
    monkeypatch.setattr(ViewerChild, "_run_once", run_once)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(ViewerChild("http://127.0.0.1:1").supervise())
    assert pauses == [1, 2, 4, 8, 16, 30, 30, 30, 0.5, 1]


@pytest.mark.parametrize(("ends_after_s", "killed"), [(2.9, False), (3.1, True)])
def test_a_viewer_has_three_seconds_to_end(ends_after_s, killed):
    class Child:
        def __init__(self) -> None:
            self.told: list[str] = []

        def terminate(self) -> None:
            self.told.append("terminate")

        def kill(self) -> None:
            self.told.append("kill")

        async def wait(self) -> None:
            if "kill" not in self.told:
                await asyncio.sleep(ends_after_s)

    child, loop = Child(), TimelessLoop()
    try:
        loop.run_until_complete(viewer_process._end(child))
    finally:
        loop.close()
    assert child.told == ["terminate", "kill"][: 1 + killed]


class TimelessLoop(asyncio.SelectorEventLoop):
    """Its clock goes on to what is due next instead of waiting."""

    def __init__(self) -> None:
        super().__init__()
        self.now, select = 0.0, self._selector.select

        def selected(seconds: float | None) -> list[Any]:
            self.now += seconds or 0.0
            return select(0)

        self._selector.select = selected

    def time(self) -> float:
        return self.now


def test_the_viewer_ends_when_its_parent_is_killed(tmp_path):
    """However the service goes, no viewer stays behind."""
    parent = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import asyncio; from service.web.viewer_process import ViewerChild\n"
            "asyncio.run(ViewerChild('http://127.0.0.1:1').supervise())",
        ],
        cwd=Path(__file__).parents[1],
    )
    try:
        child = _child_of(parent.pid)
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    deadline = time.monotonic() + 20
    while Path(f"/proc/{child}").exists():
        assert time.monotonic() < deadline, "the viewer outlived its parent"
        time.sleep(0.05)


def _child_of(pid: int) -> int:
    children = Path(f"/proc/{pid}/task/{pid}/children")
    deadline = time.monotonic() + 20
    while not (found := children.read_text().split()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return int(found[0])
