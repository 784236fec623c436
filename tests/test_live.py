"""Live sessions over real sockets: the protocol, its refusals and limits; and the tracker on rendered frames."""

from __future__ import annotations

import json
import logging
import re
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
import pytest
from api_server import ROOT, at_each_front, create_app, fake_estimators, photo, serving, settings, until, until_ready
from jsonschema import Draft202012Validator
from stand_ins import make_scene
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from service.live.live_values import LiveFrame
from service.live.mailbox import Mailbox
from service.live.pace import Pace
from service.live_client import Live, LiveClosed, LiveRefused
from service.web.key_file import add_key, remove_key
from service.web.routes import live as live_routes
from service.web.schemas.live import live_schema

SCHEMA = json.loads((ROOT / "docs" / "live.schema.json").read_text("utf-8"))
VALID = Draft202012Validator(SCHEMA)
HELLO = {"type": "hello", "version": 1}


def test_the_schema_is_that_of_the_messages():
    Draft202012Validator.check_schema(SCHEMA)
    assert live_schema() == (ROOT / "docs" / "live.schema.json").read_text("utf-8"), (
        "splatfix openapi --live > docs/live.schema.json"
    )
    assert not VALID.is_valid({"type": "hello"})


def test_the_document_lists_every_close_code():
    text = (ROOT / "docs" / "live.md").read_text("utf-8")
    told = set(re.findall(r"^\| (4\d{3}) \|", text, re.M))
    names = ("BAD_MESSAGE", "KEY_GONE", "NO_SCENE", "TIMEOUT", "TOO_LARGE", "TOO_MANY", "FAILED", "UNAVAILABLE")
    assert told == {str(getattr(live_routes, name)) for name in names}


@pytest.fixture(scope="module")
def service(stepping_module) -> Iterator[httpx.Client]:
    chosen = settings(live_sessions_of_client=2, live_fps=30, rate_limit="")
    with serving(create_app(chosen, {"room": make_scene()})) as client:
        until_ready(client)
        yield client


@pytest.fixture(scope="module")
def stepping_module() -> Iterator[object]:
    with fake_estimators() as stepping:
        yield stepping


def address(client: httpx.Client, scene: str = "room") -> str:
    return f"ws://127.0.0.1:{client.base_url.port}/scenes/{scene}/live"


def url(client: httpx.Client) -> str:
    return f"http://127.0.0.1:{client.base_url.port}"


def live(client: httpx.Client, scene: str = "room", **options) -> Live:
    return Live(url(client), scene, proxy=None, **options)


def frame(
    number: int, time_s: float, jpeg: bytes | None = None, *, flags: int = 0, length: int = 24, more: bytes = b""
) -> bytes:
    head = struct.pack("<4sBBHIId", b"SFLV", 1, flags, length, number, 0, time_s)
    return head + more + (photo() if jpeg is None else jpeg)


def odometry(scale: float = 1.0, x: float = 0.0) -> bytes:
    return frame(1, 1.0, flags=2, length=120, more=struct.pack("<12d", scale, 0, 0, x, 0, scale, 0, 0, 0, 0, scale, 0))


@contextmanager
def raw(client: httpx.Client, *messages: str | bytes, scene: str = "room") -> Iterator[ClientConnection]:
    with connect(address(client, scene), proxy=None, compression=None) as socket:
        for message in messages:
            socket.send(message)
        yield socket


def closed(socket: ClientConnection) -> tuple[int, str]:
    """Read until the service closes the socket; all that it says is valid by the schema."""
    with pytest.raises(ConnectionClosed) as ended:
        list(iter(lambda: VALID.validate(json.loads(socket.recv(10))), ""))
    received = ended.value.rcvd
    assert received
    return received.code, received.reason


def metrics(client: httpx.Client) -> str:
    return "".join(at_each_front(lambda: client.get("/metrics").text))


def sessions(client: httpx.Client) -> float:
    return sum(map(float, re.findall(r"^splatfix_live_sessions ([\d.]+)$", metrics(client), re.M)))


def jobs(client: httpx.Client) -> int:
    return sum(at_each_front(lambda: client.get("/scenes/room").json()["jobs"]))


def test_frames_are_answered_in_messages_of_the_schema(service):
    with raw(service, json.dumps(HELLO)) as socket:
        welcome = json.loads(socket.recv(10))
        VALID.validate(welcome)
        assert (welcome["type"], welcome["scene"], welcome["limits"]["frames_per_s"]) == ("welcome", "room", 30)
        assert jobs(service) == 1  # the scene is pinned
        seen = []
        for number in range(5):
            socket.send(frame(number, number / 30))
            answer = json.loads(socket.recv(10))
            VALID.validate(answer)
            seen.append(
                (answer["id"], answer["time_s"], answer["status"], answer["world_from_camera"], answer["dropped"])
            )
        assert seen == [(number, number / 30, "not_localized", None, []) for number in range(5)]
    until(lambda: sessions(service) == 0)
    assert jobs(service) == 0
    told = metrics(service)
    assert re.search(r'splatfix_live_frames_total\{outcome="not_localized"\} \d', told)
    assert 'splatfix_requests_total{method="GET",route="/scenes/{scene_id}/live",status="101"}' in told


class Heard(logging.Handler):
    """Keeps what some loggers are told."""

    def __init__(self, *names: str) -> None:
        super().__init__()
        self.told: list[tuple[int, str]] = []
        self._loggers = [logging.getLogger(name) for name in names]
        self._levels = [logger.level for logger in self._loggers]

    def emit(self, record: logging.LogRecord) -> None:
        self.told.append((record.levelno, record.getMessage()))

    def __enter__(self) -> Heard:
        for logger in self._loggers:
            logger.addHandler(self)
            logger.setLevel(logging.INFO)
        return self

    def __exit__(self, *_: object) -> None:
        for logger, level in zip(self._loggers, self._levels, strict=True):
            logger.removeHandler(self)
            logger.setLevel(level)


def test_a_client_that_leaves_is_no_error(service):
    with Heard("service.web.routes.live", "uvicorn.error") as heard:
        with live(service) as session:
            session.send(photo())
            assert session.answer(10)
        until(lambda: any(text.startswith("live session closed: 1000") for _, text in heard.told))
        time.sleep(0.1)
    assert not [text for level, text in heard.told if level >= logging.ERROR]


def test_only_the_newest_frame_waits_and_what_it_replaced_is_told():
    box = Mailbox()
    for number in range(4):
        box.put(LiveFrame(number, float(number), b""))
    taken = box.take()
    assert taken is not None
    assert (taken[0].id, taken[2]) == (3, (0, 1, 2))
    box.put(LiveFrame(4, 4.0, b""))
    assert box.take()[2] == ()  # type: ignore[index]
    box.put(LiveFrame(5, 5.0, b""))
    box.close()
    assert box.take() is None


def test_advice_follows_what_can_be_used():
    pace = Pace(60)
    # 30 frames a second come, 20 can be used; then 15 come, and still 20 could be.
    told = [pace.used(k / 20, 0.05, k % 2, 640) for k in range(90)]
    assert [(hint.max_fps, hint.long_side_px) for hint in told if hint] == [(20, None)]
    told = [pace.used(5 + k / 15, 0.02, 0, 2000) for k in range(60)]
    assert [(hint.max_fps, hint.long_side_px) for hint in told if hint] == [(30, 640), (45, 640)]


BAD = {
    "no JSON": (["{"], 4400, "hello: the first message is not JSON"),
    "no hello": (['{"type": "hi", "version": 1}'], 4400, "type: Input should be 'hello'"),
    "another version": (['{"type": "hello", "version": 2}'], 4400, "version: Input should be 1"),
    "an unknown field": (['{"type": "hello", "version": 1, "rig": true}'], 4400, "rig: unknown field"),
    "up that is nothing": ([json.dumps(HELLO | {"odometry": {"up_in_odom": [0, 0, 0]}})], 4400, "odometry.up_in_odom:"),
    "bytes first": ([b"x"], 4400, "hello: the first message is JSON"),
    "bad intrinsics": ([json.dumps(HELLO | {"intrinsics": {"width": 3}})], 4400, "intrinsics."),
    "text later": ([json.dumps(HELLO), "{}"], 4400, "frame: messages after the hello"),
    "a truncated header": ([json.dumps(HELLO), b"SFLV\1"], 4400, "frame: the header has 24 bytes or more"),
    "garbage": ([json.dumps(HELLO), b"x" * 999], 4400, "frame: a message begins with SFLV and version 1"),
    "an unknown flag": ([json.dumps(HELLO), frame(1, 1.0, flags=8)], 4400, "frame.flags: unknown flags"),
    "odometry with a scale": ([json.dumps(HELLO), odometry(2.0)], 4400, "frame.odom_from_camera: the upper left 3x3"),
    "odometry far away": ([json.dumps(HELLO), odometry(x=1e7)], 4400, "frame.odom_from_camera: is farther than 1e+06"),
    "no gravity": (
        [json.dumps(HELLO), frame(1, 1.0, flags=4, length=48, more=struct.pack("<3d", 0, 0, float("nan")))],
        4400, "frame.up_in_camera: is no direction",
    ),
    "a wrong length": ([json.dumps(HELLO), frame(1, 1.0, length=99)], 4400, "frame.length: the header has 24 bytes"),
    "an id again": ([json.dumps(HELLO), *2 * [frame(1, 1.0)]], 4400, "frame.id: must ascend: 1 after 1"),
    "time goes back": ([json.dumps(HELLO), frame(1, 1.0), frame(2, 0.5)], 4400, "frame.time: must be finite"),
    "no time": ([json.dumps(HELLO), frame(1, float("nan"))], 4400, "frame.time: must be finite"),
    "a PNG": ([json.dumps(HELLO), frame(1, 1.0, photo("png"))], 4400, "frame: a frame is a JPEG."),
    "half a JPEG": ([json.dumps(HELLO), frame(1, 1.0, photo()[:200])], 4400, ""),
    "too large": ([json.dumps(HELLO), b"x" * 2_000_001], 4413, "a message has at most 2000000 bytes, not 2000001."),
    "too many": ([json.dumps(HELLO), *(frame(k, k / 99) for k in range(80))], 4429, "more than 30 frames a second."),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_ends_the_session_with_a_code_and_a_reason(service, case):
    messages, code, reason = BAD[case]
    with raw(service) as socket:
        for message in messages:
            try:
                socket.send(message)
            except ConnectionClosed:
                break  # it was ended by an earlier one
        found = closed(socket)
    assert found[0] == code, found
    assert found[1].startswith(reason), found


def test_scenes_and_places_that_are_not_there_are_told(service):
    with raw(service, json.dumps(HELLO), scene="attic") as socket:
        assert closed(socket)[0] == 4404
    with live(service), live(service), raw(service) as third:
        assert closed(third) == (4429, "limit of live sessions for this key reached: 2.")
    until(lambda: sessions(service) == 0)
    with live(service) as again:
        assert again.welcome["scene"] == "room"


def test_an_idle_session_ends(stepping_module):
    app = create_app(settings(live_idle_s=1.0, live_sessions=1, viewer=False), {"room": make_scene()})
    with serving(app) as client:
        until_ready(client)
        with live(client) as idle, pytest.raises(LiveClosed) as ended:
            idle.answer()
        assert (ended.value.code, ended.value.reason) == (4408, "no frame for 1 s.")
        with live(client), pytest.raises(LiveClosed, match="4429 limit of live sessions of the service reached: 1"):
            live(client)
        until(lambda: sessions(client) == 0)
        # A shutdown closes sessions with a code that says: connect again.
        last = live(client)
    with pytest.raises(LiveClosed) as ended:
        last.answer(10)
    assert ended.value.code == 1012


def test_the_handshake_is_refused_by_http_status(stepping_module, tmp_path):
    file = tmp_path / "keys.json"
    keys = {role: add_key(file, role, role) for role in ("read", "localize")}
    app = create_app(settings(keys_file=file, rate_limit="5/hour"), {"room": make_scene()})
    with serving(app) as client:
        until(lambda: client.get("/readyz").status_code == 200)
        for key, status, code in (
            ("", 401, "unauthorized"),
            ("sfx_x", 401, "unauthorized"),
            (keys["read"], 403, "forbidden"),
        ):
            with pytest.raises(LiveRefused) as refused:
                live(client, key=key)
            assert (refused.value.status, refused.value.problem["code"]) == (status, code)
        with (
            pytest.raises(InvalidStatus) as foreign,
            connect(address(client), origin=Origin("https://evil.example"), proxy=None),
        ):
            pass
        assert foreign.value.response.status_code == 403
        # A person at the page is asked for a key, and has a cookie afterwards, which the socket takes.
        asked = client.get("/live", headers={"Accept": "text/html"})
        assert (asked.status_code, asked.headers["location"]) == (303, "/#/key?then=live")
        signed_in = client.get("/live", params={"key": keys["localize"]})
        assert (signed_in.status_code, signed_in.headers["location"]) == (303, "/live")
        cookie = signed_in.headers["set-cookie"].partition(";")[0]
        client.cookies.clear()
        page = client.get("/live", headers={"Cookie": cookie})
        assert "default-src 'self'" in page.headers["content-security-policy"]
        with connect(address(client), additional_headers={"Cookie": cookie}, proxy=None) as by_cookie:
            by_cookie.send(json.dumps(HELLO))
            assert json.loads(by_cookie.recv(10))["type"] == "welcome"
        token = client.post("/tokens", headers={"Authorization": f"Bearer {keys['localize']}"}).json()["token"]
        with connect(f"{address(client)}?token={token}", proxy=None) as by_token:
            by_token.send(json.dumps(HELLO))
            assert json.loads(by_token.recv(10))["type"] == "welcome"
            session = live(client, key=keys["localize"])
            with live(client, key=keys["localize"]), pytest.raises(LiveRefused) as refused:
                live(client, key=keys["localize"])
            assert (refused.value.status, refused.value.problem["code"]) == (429, "rate_limited")
            remove_key(file, "localize")
            with pytest.raises(LiveClosed) as ended:
                session.answer(10)
            assert (ended.value.code, ended.value.reason) == (4401, "the session's key is not valid any more.")
            assert closed(by_token)[0] == 4401
