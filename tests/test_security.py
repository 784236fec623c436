"""Nobody comes in who doesn't belong, nothing leaks, and limits hold before a body is read. See docs/security.md."""

from __future__ import annotations

import asyncio
import io
import json
import logging
import os
import re
import socket
import stat
import threading
import time
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace

import httpx
import pytest
import uvicorn
from api_server import (
    assert_problem,
    at_each_front,
    create_app,
    finished,
    key_line,
    photo,
    post,
    serving,
    settings,
    until,
    until_ready,
    with_viewer_at,
)
from rich.console import Console
from stand_ins import make_scene
from two_fronts import FRONTS, THROUGH_A_GATEWAY
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.cli.graceful_server import GracefulServer
from service.cli.server import run
from service.errors import InvalidRequest, QueueFull, StorageFailed
from service.jobs.job_order import JobOrder
from service.jobs.model import JobSpec
from service.web.api_keys import Caller, KeyRing
from service.web.key_file import ROLES, UNLIMITED, KeyLimits, add_key, read_keys, remove_key
from service.web.metrics import Metrics
from service.web.middleware.limits import Limits
from service.web.middleware.proxy import Proxy
from service.web.route_policy import PHOTO_BODY, RoutePolicy
from service.web.shared_state import LocalState


@pytest.fixture
def ring(tmp_path) -> dict[str, str]:
    """A key of each role."""
    return {role: add_key(tmp_path / "keys.json", f"my {role}", role) for role in ROLES}


@pytest.fixture
def locked(stepping, ring, tmp_path):
    app = create_app(settings(keys_file=tmp_path / "keys.json"), {"room": make_scene()})
    with serving(with_viewer_at(9, app)) as client:  # where nothing listens
        until_ready(client)
        yield client
        stepping.GO_ON.set()


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


def send(client: httpx.Client, key: str = "", **headers: str) -> httpx.Response:
    headers = {**(bearer(key) if key else {}), **headers}
    return client.post("/localize", files={"photo": photo()}, headers=headers)


# ------------------------------------------------------------------ keys and roles


def test_without_a_key_only_the_outside_is_seen(locked):
    for path in ("/livez", "/readyz", "/", "/ui/style.css", "/client.js", "/docs", "/openapi.json"):
        assert locked.get(path).status_code == 200, path
    for path in ("/jobs", "/scenes", "/scenes/room", "/scenes/room/splats", "/capabilities", "/metrics", "/nowhere"):
        refused = locked.get(path)
        assert_problem(refused, 401, "unauthorized")
        assert refused.headers["www-authenticate"] == "Bearer"
    assert_problem(send(locked), 401, "unauthorized")


def test_a_wrong_key_is_not_taken_for_none(locked):
    assert_problem(locked.get("/jobs", headers=bearer("sfx_wrong")), 401, "unauthorized")
    assert_problem(locked.get("/jobs", headers={"Authorization": "Basic eDp5"}), 401, "unauthorized")


def test_a_key_does_what_its_role_may(locked, ring):
    assert locked.get("/jobs", headers=bearer(ring["read"])).status_code == 200
    assert_problem(send(locked, ring["read"]), 403, "forbidden")
    accepted = send(locked, ring["localize"])
    assert accepted.status_code == 202
    path = accepted.headers["location"]
    assert_problem(locked.delete(path, headers=bearer(ring["read"])), 403, "forbidden")
    assert locked.delete(path, headers=bearer(ring["localize"])).status_code == 200
    assert send(locked, ring["admin"]).status_code == 202
    assert_problem(locked.put("/anything", headers=bearer(ring["localize"])), 403, "forbidden")


@pytest.mark.parametrize("path", ["/jobs", "//jobs", "/jobs/", "/./jobs", "/ui/../jobs", "/JOBS", "/viewer/../jobs"])
def test_no_spelling_of_a_path_goes_round_the_gate(locked, path):
    """Sent as it is: a client would tidy it up."""
    with socket.create_connection((locked.base_url.host, locked.base_url.port)) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n".encode())
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    status = int(answer.split()[1])
    assert status in (401, 404), answer[:200]
    assert b'"jobs"' not in answer


def test_only_hashes_are_stored_and_only_for_the_owner(tmp_path):
    path = tmp_path / "keys.json"
    key = add_key(path, "robot", "localize")
    assert key.removeprefix("sfx_") not in path.read_text()
    assert stat.S_IMODE(os.stat(path).st_mode) == 0o600
    assert len(key) >= 43  # 256 bits
    ring = KeyRing(path)
    robot = ring.caller(key)
    assert robot
    assert (robot.name, robot.role, robot.limits) == ("robot", "localize", UNLIMITED)
    assert ring.caller(key + "x") is None
    assert ring.caller("") is None
    with pytest.raises(InvalidRequest, match="already"):
        add_key(path, "robot", "read")


def test_a_removed_key_is_refused_at_once_with_its_tokens(locked, ring, tmp_path):
    entered = locked.get("/", params={"key": ring["localize"]})
    cookie = {"Cookie": entered.headers["set-cookie"].split(";")[0]}
    assert locked.get("/jobs", headers=cookie).status_code == 200
    remove_key(tmp_path / "keys.json", "my localize")
    until(lambda: locked.get("/jobs", headers=bearer(ring["localize"])).status_code == 401)
    assert locked.get("/jobs", headers=cookie).status_code == 401
    assert locked.get("/jobs", headers=bearer(ring["read"])).status_code == 200


@pytest.mark.parametrize("text", ["{", "[1]", '[{"name": "a", "role": "god", "sha256": "0"}]'])
def test_a_broken_file_of_keys_stops_the_start(tmp_path, text):
    (tmp_path / "keys.json").write_text(text)
    with pytest.raises(InvalidRequest, match=r"keys\.json"):
        KeyRing(tmp_path / "keys.json")


def test_listening_beyond_this_machine_needs_keys_or_a_word(stepping):
    with pytest.raises(InvalidRequest, match="everybody"):
        create_app(settings(host="0.0.0.0", keys_file=None))
    create_app(settings(host="0.0.0.0", keys_file=None, open=True))
    ring = KeyRing(None)
    ring.make_temporary("start", "admin")
    create_app(settings(host="0.0.0.0", keys_file=None), keys=ring)


def test_serve_beyond_this_machine_makes_a_key_and_prints_it_in_the_url(stepping, tmp_path, monkeypatch):
    """On loopback, which is taken for something else: a test opens no door."""
    servers, out = [], io.StringIO()

    class Server(GracefulServer):
        def __init__(self, config: uvicorn.Config, dismiss: Callable[[], None]) -> None:
            super().__init__(config, dismiss)
            servers.append(self)

    monkeypatch.setattr("service.cli.server.GracefulServer", Server)
    for place in ("service.cli.server", "service.web.app"):
        monkeypatch.setattr(f"{place}.is_loopback", lambda host: False)
    chosen = settings(port=0, keys_file=tmp_path / "none.json", data_dir=tmp_path / "data", log_json=False)
    consoles = Console(file=out, width=200), Console(file=io.StringIO())
    thread = threading.Thread(target=run, args=(chosen, *consoles))
    thread.start()
    try:
        until(lambda: "start page" in out.getvalue(), 120)
        found = re.search(r"(http://127\.0\.0\.1:\d+)/\?key=(sfx_\S+)", out.getvalue())
        assert found
        url, key = found.groups()
        with httpx.Client(base_url=url, trust_env=False) as client:
            assert_problem(client.get("/jobs"), 401, "unauthorized")
            assert client.get("/jobs", headers=bearer(key)).status_code == 200
            assert client.get(f"/?key={key}").headers["set-cookie"]
    finally:
        servers[0].should_exit = True
        thread.join()


# ------------------------------------------------------------------ browsers

PREFIX = "" if THROUGH_A_GATEWAY else "/fix"
"""A gateway says itself which sub-path it has."""


def test_a_page_opened_with_a_key_gets_a_cookie_and_a_clean_address(locked, ring):
    entered = locked.get("/", params={"key": ring["read"]}, headers={"X-Forwarded-Prefix": PREFIX})
    assert (entered.status_code, entered.headers["location"]) == (303, f"{PREFIX}/")
    cookie = entered.headers["set-cookie"]
    assert {"HttpOnly", "SameSite=lax", f"Path={PREFIX}/"} <= set(cookie.split("; "))
    assert ring["read"] not in cookie
    session = {"Cookie": cookie.split(";")[0]}
    locked.cookies.clear()  # where there is no sub-path it would send the cookie with all that follows
    assert locked.get("/jobs", headers=session).status_code == 200
    assert_problem(send(locked, **session), 403, "forbidden")  # the cookie has the key's role
    assert_problem(locked.get("/jobs", params={"key": ring["read"]}), 401, "unauthorized")  # pages only
    assert_problem(locked.get("/", params={"key": "sfx_wrong"}), 401, "unauthorized")


@pytest.mark.parametrize(
    ("path", "form"),
    [
        ("/viewer/", "/#/key?then=viewer/"),
        ("/viewer/jobs/x/", "/#/key?then=viewer/jobs/x/"),
        ("/?key=sfx_wrong", "/#/key?then=&refused"),
        ("/viewer/?key=sfx_wrong", "/#/key?then=viewer/&refused"),
    ],
)
def test_who_opens_a_page_without_a_valid_key_is_asked_for_one(locked, path, form):
    asked = locked.get(path, headers={"Accept": "text/html,*/*", "X-Forwarded-Prefix": PREFIX})
    assert (asked.status_code, asked.headers["location"]) == (303, f"{PREFIX}{form}")
    assert "set-cookie" not in asked.headers
    assert_problem(locked.get(path), 401, "unauthorized")  # a program has the document


def test_a_token_opens_the_viewer_for_a_while(locked, ring):
    made = locked.post("/tokens", headers=bearer(ring["localize"])).json()
    entered = locked.get("/viewer/jobs/x/", params={"token": made["token"]})
    assert (entered.status_code, entered.headers["location"]) == (303, "/viewer/jobs/x/")
    assert locked.get("/jobs", headers=bearer(made["token"])).status_code == 200
    forged = made["token"][:-1] + ("0" if made["token"][-1] != "0" else "1")
    assert_problem(locked.get("/jobs", headers=bearer(forged)), 401, "unauthorized")


def test_tokens_end(tmp_path):
    key = add_key(tmp_path / "keys.json", "a", "admin")
    ring = KeyRing(tmp_path / "keys.json")
    ann = ring.caller(key)
    assert ann
    assert ring.bearer(ring.token(ann, 60)) == ann
    assert ring.bearer(ring.token(ann, -1)) is None
    assert ring.bearer(ring.token(Caller("b", "admin", "0" * 16), 60)) is None
    assert KeyRing(tmp_path / "keys.json").bearer(ring.token(ann, 60)) is None  # another process
    for garbage in ("", ".", "a.b", "é.ü"):
        assert ring.bearer(garbage) is None


def test_sessions_outlive_a_restart_and_end_with_their_key(tmp_path):
    keys, secret = tmp_path / "keys.json", tmp_path / "sessions.key"
    key = add_key(keys, "a", "read")
    before, after = KeyRing(keys), KeyRing(keys)
    for ring in (before, after):
        ring.keep_sessions(LocalState(secret).secret())
    ann = before.caller(key)
    assert ann
    token = before.token(ann, 60)
    assert stat.S_IMODE(os.stat(secret).st_mode) == 0o600
    assert after.bearer(token) == ann
    remove_key(keys, "a")
    key = add_key(keys, "a", "read")  # somebody else's, of the same name
    later = KeyRing(keys)
    later.keep_sessions(LocalState(secret).secret())
    assert later.bearer(token) is None
    secret.write_bytes(b"half")
    later.keep_sessions(LocalState(secret).secret())
    bob = later.caller(key)
    assert bob
    assert later.bearer(later.token(bob, 60)) == bob
    assert len(secret.read_bytes()) == 32
    with pytest.raises(StorageFailed, match="secret"):
        later.keep_sessions(LocalState(tmp_path).secret())


def test_a_session_goes_on_after_a_restart_of_the_service(stepping, ring, tmp_path):
    kept = settings(keys_file=tmp_path / "keys.json", data_dir=tmp_path / "data")
    with serving(create_app(kept, {"room": make_scene()})) as client:
        entered = client.get("/", params={"key": ring["read"]})
        cookie = {"Cookie": entered.headers["set-cookie"].split(";")[0]}
    with serving(create_app(kept, {"room": make_scene()})) as client:
        assert client.get("/jobs", headers=cookie).status_code == 200


def test_other_sites_pages_may_not_act(shared):
    foreign = {"Origin": "https://evil.example"}
    refused = shared.post("/localize", files={"photo": photo()}, headers=foreign)
    assert_problem(refused, 403, "forbidden", "header.origin")
    own = {"Origin": f"http://127.0.0.1:{shared.base_url.port}"}
    # 200: a job is sometimes done before its answer is written.
    assert shared.post("/localize", files={"photo": photo()}, headers=own).status_code in (200, 202)
    plain = shared.get("/jobs", headers=foreign)
    assert "access-control-allow-origin" not in plain.headers


def test_other_sites_can_be_allowed(stepping):
    friend = {"Origin": "https://friend.example"}
    with serving(create_app(settings(cors_origins=[friend["Origin"]]), {"room": make_scene()})) as client:
        answer = client.post("/localize", files={"photo": photo()}, headers=friend)
        assert answer.status_code == 202
        assert answer.headers["access-control-allow-origin"] == friend["Origin"]
        asked = client.options("/localize", headers=friend | {"Access-Control-Request-Method": "POST"})
        assert asked.status_code == 200


def test_a_name_that_points_here_by_trick_is_refused(shared):
    """DNS rebinding: a page of evil.example, whose name now has the address 127.0.0.1."""
    assert_problem(shared.get("/jobs", headers={"Host": "evil.example"}), 403, "forbidden", "header.host")
    for name in ("localhost:8000", "127.0.0.1", "[::1]:9"):
        assert shared.get("/jobs", headers={"Host": name}).status_code == 200


@pytest.mark.parametrize("origin", ["https://evil.example", "null"])
def test_other_sites_cannot_open_a_socket(stepping, origin):
    with serving(create_app(settings(viewer=True), {"room": make_scene()})) as client:
        address = f"ws://127.0.0.1:{client.base_url.port}/viewer/"
        with pytest.raises(InvalidStatus) as refused, connect(address, origin=origin, proxy=None):
            pass
        assert refused.value.response.status_code == 403


def test_the_viewers_socket_needs_a_key(stepping, ring, tmp_path):
    app = create_app(settings(viewer=True, keys_file=tmp_path / "keys.json"), {"room": make_scene()})
    with serving(app) as client:
        address = f"ws://127.0.0.1:{client.base_url.port}/viewer/"
        with pytest.raises(InvalidStatus) as refused, connect(address, proxy=None):
            pass
        assert refused.value.response.status_code == 401
        assert_problem(client.get("/viewer/"), 401, "unauthorized")


def test_answers_carry_the_headers_that_browsers_ask_for(shared):
    for path in ("/", "/jobs", "/nowhere", "/ui/style.css"):
        headers = shared.get(path).headers
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["x-frame-options"] == "SAMEORIGIN"
    assert "script-src" not in (policy := shared.get("/").headers["content-security-policy"])
    assert "default-src 'self'" in policy


# ------------------------------------------------------------------ limits before the body


def head(client: httpx.Client, lines: str, body: bytes = b"") -> bytes:
    """Send the head of a request, and never its body; return the answer."""
    with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
        connection.settimeout(10)
        lines = key_line(client) + lines
        connection.sendall(f"POST /localize HTTP/1.1\r\nHost: 127.0.0.1\r\n{lines}\r\n\r\n".encode() + body)
        answer = b""
        while b"\r\n\r\n" not in answer or not answer.endswith(b"}"):  # problem documents are JSON
            answer += connection.recv(65536)
        return answer


BOUND = "Content-Type: multipart/form-data; boundary=x\r\nContent-Length: "


def test_a_full_queue_answers_to_the_head(client, stepping):
    for _ in range(3 * FRONTS):
        post(client, prefer="", options={"hold": True})
    assert b"503" in head(client, f"{BOUND}1000000").split(b"\r\n")[0]


def test_a_body_too_large_is_refused_by_its_head(shared):
    assert b"413" in head(shared, f"{BOUND}999999999999").split(b"\r\n")[0]


def test_no_key_no_reading(locked):
    assert b"401" in head(locked, f"{BOUND}1000000").split(b"\r\n")[0]


def test_a_body_that_trickles_is_given_up(stepping):
    with serving(create_app(settings(upload_s=0.01, max_upload_bytes=1), {"room": make_scene()})) as client:
        answer = head(client, f"{BOUND}1000", b"--x\r\n")
        assert b"408" in answer.split(b"\r\n")[0]
        assert b"request_timeout" in answer


def test_a_client_that_asks_too_often_is_slowed_down(stepping, ring, tmp_path):
    changes = {"rate_limit": "3/minute", "queue_size": 20, "keys_file": tmp_path / "keys.json"}
    with serving(create_app(settings(**changes), {"room": make_scene()})) as client:
        codes = [send(client, ring["localize"]).status_code for _ in range(5)]
        assert codes == [202, 202, 202, 429, 429]
        refused = send(client, ring["localize"])
        assert_problem(refused, 429, "rate_limited")
        assert 1 <= int(refused.headers["retry-after"]) <= 60
        assert send(client, ring["admin"]).status_code == 202  # another client
        assert client.get("/jobs", headers=bearer(ring["localize"])).status_code == 200  # reading is free


def test_a_key_may_have_a_rate_of_its_own(stepping, tmp_path):
    file = tmp_path / "keys.json"
    slow, usual = add_key(file, "slow", "localize", KeyLimits(rate="2/hour")), add_key(file, "usual", "localize")
    with serving(
        create_app(settings(rate_limit="4/minute", keys_file=file, queue_size=20), {"room": make_scene()})
    ) as client:
        assert [send(client, slow).status_code for _ in range(3)] == [202, 202, 429]
        assert "2/hour" in send(client, slow).json()["detail"]
        assert [send(client, usual).status_code for _ in range(5)] == [202, 202, 202, 202, 429]
        stepping.GO_ON.set()


def test_a_key_may_have_a_share_of_the_queue(stepping, tmp_path):
    """Half of a queue of four: two of its jobs wait, whatever else the queue has."""
    file = tmp_path / "keys.json"
    half, whole = add_key(file, "half", "localize", KeyLimits(queue_share=0.5)), add_key(file, "whole", "localize")
    changes = {"rate_limit": "", "keys_file": file, "queue_size": 4}
    app = create_app(settings(**changes), {"room": make_scene()})
    with serving(app) as client:
        until_ready(client)
        held = {"files": {"photo": photo()}, "data": {"options": '{"hold": true}'}, "headers": bearer(whole)}
        running = at_each_front(lambda: client.post("/localize", **held).headers["location"])
        until(lambda: all(client.get(p, headers=bearer(whole)).json()["state"] == "running" for p in running))
        mine = [send(client, half, **{"Idempotency-Key": str(n)}) for n in range(3)]
        assert [answer.status_code for answer in mine] == [202, 202, 503]
        assert_problem(mine[2], 503, "queue_full")
        assert "2 jobs of this key" in mine[2].json()["detail"]
        # The same request again is no new job.
        assert send(client, half, **{"Idempotency-Key": "1"}).json()["id"] == mine[1].json()["id"]
        # Many may pass the check of the head at once: the last word is when the job is stored.
        mine_client = KeyRing(file).caller(half).client  # type: ignore[union-attr]
        order = JobOrder(photo(), "p.jpg", "0", JobSpec("stepping"), mine_client, None, "0", most_queued=2)
        if not THROUGH_A_GATEWAY:
            with pytest.raises(QueueFull, match="its share"):
                app.state.app_state.jobs.accept(order)
        # The key's two are counted at all fronts, and took a place at one or at two of them.
        left = 4 * FRONTS - 2
        assert [send(client, whole).status_code for _ in range(left + 1)] == [202] * left + [503]
        stepping.GO_ON.set()


def test_few_uploads_at_once():
    """Against the layer itself: three bodies that don't end, of which two have a place."""

    async def scenario() -> list[int]:
        release = asyncio.Event()

        async def app(scope, receive, send):
            await receive()
            await send({"type": "http.response.start", "status": 200, "headers": []})
            await send({"type": "http.response.body", "body": b""})

        async def room(client, most, key):
            if key == "full":
                raise QueueFull("full")

        async def hit(client, rate):
            return None

        layer = Limits(app, settings(max_uploads=2), room, hit)
        statuses: list[int] = []

        async def request() -> None:
            async def receive():
                await release.wait()
                return {"type": "http.request", "body": b"", "more_body": False}

            async def send(message):
                if message["type"] == "http.response.start":
                    statuses.append(message["status"])

            state = {"policy": RoutePolicy("localize", PHOTO_BODY, rate_limited=True, queues_job=True)}
            scope = {"type": "http", "method": "POST", "path": "/localize", "headers": [], "state": state}
            await layer(scope, receive, send)

        waiting = [asyncio.create_task(request()) for _ in range(2)]
        await asyncio.sleep(0.01)
        await request()
        release.set()
        await asyncio.gather(*waiting)
        await request()
        return statuses

    assert asyncio.run(scenario()) == [503, 200, 200, 200]


def test_a_slow_reader_is_dropped(caplog):
    async def scenario() -> None:
        async def app(scope, receive, send):
            await send({"type": "http.response.start", "status": 200, "headers": []})
            await send({"type": "http.response.body", "body": b"x", "more_body": True})

        async def stalled(message):
            if message["type"] == "http.response.body":
                await asyncio.sleep(60)

        proxy = Proxy(app, Metrics(), "", send_s=0.05)
        await proxy({"type": "http", "method": "GET", "path": "/jobs", "headers": []}, None, stalled)  # type: ignore[arg-type]

    began = time.monotonic()
    with caplog.at_level(logging.INFO, "service"):
        asyncio.run(scenario())
    assert time.monotonic() - began < 5
    assert "dropped" in caplog.text


# ------------------------------------------------------------------ what could leak


def test_logs_have_ids_and_no_secrets(stepping, ring, tmp_path, caplog):
    from service.logs import json_handler

    changes = settings(keys_file=tmp_path / "keys.json")
    lines: list[str] = []
    handler = json_handler()
    handler.emit = lambda record: lines.append(handler.format(record))  # type: ignore[method-assign]
    logger = logging.getLogger("service")
    logger.addHandler(handler)
    try:
        with caplog.at_level(logging.DEBUG), serving(create_app(changes, {"room": make_scene()})) as client:
            until_ready(client)
            client.get("/", params={"key": ring["admin"]})
            answer = send(client, ring["localize"], **{"X-Request-ID": "my-request.1"})
            assert answer.headers["x-request-id"] == "my-request.1"
            job = finished_with(client, answer.headers["location"], ring["localize"])
            odd = client.get("/livez", headers={"X-Request-ID": "a b\tc"}).headers["x-request-id"]
            assert odd.isalnum()
    finally:
        logger.removeHandler(handler)
    told = [json.loads(line) for line in lines]
    assert any(line.get("request_id") == "my-request.1" and "POST /localize 202" in line["event"] for line in told)
    assert any(line.get("job_id") == job["id"] for line in told)
    ours = [r.getMessage() for r in caplog.records if not r.name.startswith("http")]  # the test's own client is chatty
    for key in ring.values():
        assert not any(key in line for line in [*ours, *lines])


def finished_with(client: httpx.Client, path: str, key: str) -> dict:
    until(lambda: client.get(path, headers=bearer(key)).json()["finished"])
    return client.get(path, headers=bearer(key)).json()


def test_what_viewer_and_pages_poll_is_not_logged(stepping, ring, tmp_path, caplog):
    caplog.set_level(logging.INFO, "service")
    keys = KeyRing(tmp_path / "keys.json")
    reader = keys.caller(ring["read"])
    assert reader
    with serving(create_app(settings(), {"room": make_scene()}, keys)) as client:
        viewer = keys.viewer_token(reader)
        for path, status in (("/jobs", 200), ("/scenes", 200), ("/jobs/none", 404)):
            assert client.get(path, headers=bearer(viewer)).status_code == status
        by_page = bearer(ring["read"]) | {"Sec-Fetch-Site": "same-origin"}
        for path in ("/jobs", "/ui/icon.svg", "/jobs/gone"):
            client.get(path, headers=by_page)
        client.get("/scenes", headers=bearer(ring["read"]) | {"Sec-Fetch-Site": "cross-site"})
    lines = [r.getMessage() for r in caplog.records if r.getMessage().startswith("GET")]
    told = [line.rpartition(" ")[0].rpartition(" ")[0] for line in lines]
    assert told == ["GET /jobs/none 404", "GET /jobs/gone 404", "GET /scenes 200"]


def test_the_photos_own_name_reaches_no_path(client, tmp_path, monkeypatch):
    here = tmp_path / "somewhere" / "deep"
    here.mkdir(parents=True)
    monkeypatch.chdir(here)
    before = set(tmp_path.rglob("*"))
    for name in ("../../escaped.jpg", str(tmp_path / "escaped.jpg")):
        job = client.post("/localize", files={"photo": (name, photo())}, data={"keep_photo": "true"}).json()
        finished(client, job["links"]["self"])
        assert set(tmp_path.rglob("*")) == before
    assert read_keys(tmp_path / "none.json") == []


def test_a_label_has_a_bounded_number_of_values():
    """Each is a time series for ever: a thousand keys and scenes become a hundred of each, and the others."""
    metrics = Metrics()

    def ended(client: str, scene: str) -> None:
        job = SimpleNamespace(estimator="e", state="succeeded", status=None, client=client, scene=scene)
        metrics.ended(job, 2.0)  # type: ignore[arg-type]

    for number in range(1000):
        ended(f"key:k{number}:0", f"s{number}")
        metrics.rendered(f"s{number}", 0.1)
    ended("address:1.2.3.4", "s1")
    lines = metrics.exposition().decode().splitlines()
    jobs = [line for line in lines if line.startswith("splatfix_jobs_by_key_total")]
    assert len(jobs) == 102  # with that of the address
    assert 'splatfix_jobs_by_key_total{key="(others)",scene="(others)",state="succeeded"} 900.0' in jobs
    assert 'splatfix_job_seconds_by_key_total{key="k7",scene="s7"} 2.0' in lines
    assert len([line for line in lines if line.startswith("splatfix_render_seconds_count")]) == 101
    assert not any("1.2.3.4" in line for line in lines)


def test_metrics_tell_what_happened(client, stepping):
    job = finished(client, post(client, prefer="").headers["location"])
    client.get(job["links"]["render"])
    samples: Counter[str] = Counter()  # of all fronts, each of which tells of itself
    for text in at_each_front(lambda: client.get("/metrics").text):
        lines = [line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#")]
        samples.update({name: float(value) for name, value in lines})
    assert samples['splatfix_jobs_total{estimator="stepping",state="succeeded",status="not_localized"}'] == 1
    assert samples['splatfix_requests_total{method="POST",route="/localize",status="202"}'] == 1
    assert samples['splatfix_stage_seconds_count{estimator="stepping",stage="step"}'] == 1
    assert samples["splatfix_job_wait_seconds_count"] == 1
    assert {"splatfix_jobs_queued", 'splatfix_renders_total{estimator="stepping"}'} <= samples.keys()
    assert samples["splatfix_jobs_queued"] == 0
    assert samples["splatfix_workers"] == FRONTS
    assert samples['splatfix_render_seconds_count{scene="room"}'] == 1
    assert samples['splatfix_renders_total{estimator="stepping"}'] == 0  # the stand-in makes none
    assert samples['splatfix_scene_bytes{scene="room"}'] == FRONTS * make_scene().nbytes
    assert "process_resident_memory_bytes" in samples
