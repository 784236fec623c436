"""What a request and a live session may send, and when: bounds of middleware and messages, without a server."""

from __future__ import annotations

import asyncio
import logging
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from api_server import photo
from starlette.exceptions import HTTPException

from service.errors import InvalidPrior, InvalidRequest, QueueFull, RateLimited
from service.live.live_values import LiveFrame
from service.web.key_file import KeyLimits
from service.web.metrics import Metrics
from service.web.middleware.limits import Limits, _Body, _check_length, _readable, _without_body, client_of, most_queued
from service.web.middleware.proxy import Proxy, _request_id, _Response, _sub_path
from service.web.route_policy import BodyLimit, RoutePolicy
from service.web.routes.live import KEY_GONE, TIMEOUT, TOO_MANY, _End, _end_of, _Session
from service.web.schemas.frame_message import read_frame
from service.web.schemas.job_spec import prior_from, read_fields
from service.web.settings import Settings
from service.web.shared_state import LocalState, Rate


def scope_of(*headers: tuple[str, str], path: str = "/jobs", method: str = "GET", **fields: Any) -> dict[str, Any]:
    raw = [(name.lower().encode(), value.encode()) for name, value in headers]
    return {"type": "http", "path": path, "method": method, "headers": raw, "state": {}} | fields


def caller(**fields: Any) -> Any:
    limits = KeyLimits(**fields)
    return SimpleNamespace(client="key:a:1", limits=limits, name="a", id="1", by_viewer=False)


# ------------------------------------------------------------------ limits


def test_a_request_is_its_keys_or_its_addresss():
    assert client_of(scope_of(client=("10.0.0.1", 5))) == "address:10.0.0.1"
    assert client_of(scope_of(client=None)) == "address:"
    assert client_of(scope_of(client=("10.0.0.1", 5), state={"caller": caller()})) == "key:a:1"


@pytest.mark.parametrize(("share", "most"), [(None, None), (0.5, 16), (0.49, 15), (0.01, 1), (1.0, 32)])
def test_a_share_of_the_queue_is_rounded_down_but_one_job_may_wait(share, most):
    assert most_queued(caller(queue_share=share), 32) == most
    assert most_queued(None, 32) is None


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (999, "999 bytes"), (1000, "1 kB"), (1_234_567, "1.23 MB"), (999_999, "1000 kB"), (50_000_000, "50 MB"),
        (10**9, "1 GB"), (1_500_000_000, "1.5 GB"),
    ],
)  # fmt: skip
def test_sizes_are_told_in_decimal_units(count, text):
    assert _readable(count) == text


def test_a_body_is_refused_by_its_length_beyond_the_limit():
    for length in ("100", "", "x", "-5"):
        _check_length(scope_of(("Content-Length", length)), 100)
    with pytest.raises(HTTPException) as caught:
        _check_length(scope_of(("Content-Length", "101")), 100)
    assert caught.value.status_code == 413


def test_a_bodys_bytes_are_counted_and_its_place_given_back_once():
    async def run(sizes: list[int], limit: int) -> tuple[int, int]:
        left, released = list(sizes), []

        async def receive() -> Any:
            size = left.pop(0)
            return {"type": "http.request", "body": b"x" * size, "more_body": bool(left)}

        body = _Body(receive, limit, 60.0, lambda: released.append(1))
        for _ in sizes:
            assert released == []
            await body.receive()
        body.end()
        left.append(9)
        await body.receive()  # what follows the body isn't counted
        return len(released), len(left)

    assert asyncio.run(run([4, 6], 10)) == (1, 0)
    with pytest.raises(HTTPException) as caught:
        asyncio.run(run([4, 7], 10))
    assert caught.value.status_code == 413


def test_a_body_that_does_not_come_in_time_is_given_up():
    async def run() -> None:
        body = _Body(asyncio.Event().wait, 10, 0.01, lambda: None)  # type: ignore[arg-type]
        await body.receive()

    with pytest.raises(HTTPException) as caught:
        asyncio.run(run())
    assert caught.value.status_code == 408


def test_a_route_without_a_body_is_given_none():
    async def run() -> list[str]:
        sent = [{"type": "http.request"}, {"type": "http.request"}, {"type": "http.disconnect"}]

        async def receive() -> Any:
            return sent.pop(0)

        nothing = _without_body(receive)
        first = await nothing()
        assert (first["body"], first["more_body"]) == (b"", False)
        return [first["type"], (await nothing())["type"]]

    assert asyncio.run(run()) == ["http.request", "http.disconnect"]


def limited(settings: Settings, policy: RoutePolicy, scope: dict[str, Any], queue: list[Any] | None = None) -> Limits:
    async def check_queue(*given: Any) -> None:
        (queue if queue is not None else []).append(given)

    shared = LocalState(Path("unused"))

    async def hit(client: str, rate: Rate) -> float | None:
        return shared.hit(client, rate)

    made = Limits(None, settings, check_queue, hit)  # type: ignore[arg-type]
    asyncio.run(made._check_head(scope, policy))
    return made


def test_uploads_at_once_and_places_in_the_queue_are_checked_before_the_body():
    settings = Settings(max_uploads=2, queue_size=10)
    policy = RoutePolicy(role="localize", body=BodyLimit(lambda _: 100), queues_job=True)
    scope = scope_of(("Idempotency-Key", "k"), client=("1.2.3.4", 5))
    queue: list[Any] = []
    made = limited(settings, policy, scope, queue)
    assert queue == [("address:1.2.3.4", None, "k")]
    scope["state"]["caller"] = caller(queue_share=0.3)
    for uploads, fits in ((1, True), (2, False)):
        made._uploads = uploads
        if fits:
            asyncio.run(made._check_head(scope, policy))
        else:
            with pytest.raises(QueueFull, match=r"too many uploads at once \(2\)"):
                asyncio.run(made._check_head(scope, policy))
    assert queue[1] == ("key:a:1", 3, "k")
    asyncio.run(made._check_head(scope, RoutePolicy(role="read")))  # no body
    assert len(queue) == 3


@pytest.mark.parametrize(
    ("own", "common", "allowed"), [(None, "2/minute", 2), ("1/minute", "2/minute", 1), (None, "", 5)]
)
def test_a_key_has_its_own_rate_or_the_common_one(own, common, allowed):
    settings = Settings(rate_limit=common)
    scope = scope_of(client=("1.2.3.4", 5), state={"caller": caller(rate=own)})
    made = limited(settings, RoutePolicy(role="read"), scope)
    for number in range(5):
        if number < allowed:
            asyncio.run(made._check_rate(scope))
            continue
        with pytest.raises(RateLimited) as caught:
            asyncio.run(made._check_rate(scope))
        assert caught.value.retry_after_s in range(1, 61)
    if allowed < 5:
        asyncio.run(made._check_rate(scope_of(client=("9.9.9.9", 5))))  # somebody else


@pytest.mark.parametrize(("left_s", "told_s"), [(0.2, 1), (10.1, 11), (-3.0, 1)])
def test_a_refused_request_is_told_whole_seconds_to_wait(left_s, told_s):
    async def hit(client: str, rate: Rate) -> float | None:
        return left_s

    made = limited(Settings(), RoutePolicy(role="read"), scope_of(client=("1.2.3.4", 5)))
    made._hit = hit
    with pytest.raises(RateLimited) as caught:
        asyncio.run(made._check_rate(scope_of(client=("1.2.3.4", 5))))
    assert caught.value.retry_after_s == told_s


# ------------------------------------------------------------------ the proxy


@pytest.mark.parametrize(
    ("prefix", "default", "path", "root", "seen"),
    [
        ("", "", "/jobs", "", "/jobs"), ("/app", "", "/jobs", "/app", "/app/jobs"),
        ("/app/", "", "/app/jobs", "/app", "/app/jobs"), ("/app", "", "/app", "/app", "/app"),
        ("/app", "", "/apples", "/app", "/app/apples"), ("", "/own", "/jobs", "/own", "/own/jobs"),
        ("//evil", "/own", "/jobs", "/own", "/own/jobs"), ("/a" * 8, "", "/", "/a" * 8, "/a" * 8 + "/"),
        ("/a" * 9, "", "/", "", "/"),
    ],
)  # fmt: skip
def test_a_sub_path_is_that_of_the_proxy_or_the_operators(prefix, default, path, root, seen):
    assert _sub_path(scope_of(("X-Forwarded-Prefix", prefix), path=path), default) == {"root_path": root, "path": seen}


def test_a_requests_id_is_kept_where_it_forges_nothing():
    assert _request_id(scope_of(("X-Request-ID", "a" * 64))) == "a" * 64
    for forged in ("a" * 65, "a b", "a\nb", ""):
        made = _request_id(scope_of(("X-Request-ID", forged)))
        assert made != forged
        assert len(made) == 16


def sent(path: str, *headers: tuple[bytes, bytes]) -> dict[str, str]:
    async def run() -> list[Any]:
        messages: list[Any] = []

        async def send(message: Any) -> None:
            messages.append(message)

        response = _Response(scope_of(("X-Request-ID", "abc"), path=path), send, 1.0)
        assert (response.status, response.begun) == (499, False)
        await response.send({"type": "http.response.start", "status": 200, "headers": list(headers)})
        assert (response.status, response.begun) == (200, True)
        await response.send({"type": "http.response.body", "body": b""})
        return messages

    first, _ = asyncio.run(run())
    return {name.decode(): value.decode() for name, value in first["headers"]}


def test_responses_have_the_headers_that_browsers_ask_for():
    plain = sent("/jobs")
    assert plain["x-request-id"] == "abc"
    assert plain["x-content-type-options"] == "nosniff"
    assert plain["x-frame-options"] == "SAMEORIGIN"
    assert plain["cache-control"] == "private, no-cache"
    assert "content-security-policy" not in plain
    own = sent("/shared/x", (b"content-security-policy", b"frame-ancestors *"), (b"cache-control", b"max-age=9"))
    assert "x-frame-options" not in own
    assert own["cache-control"] == "max-age=9"
    for page in ("/", "/live", "/ui/app.js"):
        assert "default-src 'self'" in sent(page)["content-security-policy"]
    for other in ("/livez", "/ui"):
        assert "content-security-policy" not in sent(other)


@pytest.mark.parametrize(
    ("path", "by_viewer", "status", "logged"),
    [
        ("/jobs", False, 200, True), ("/livez", False, 200, False), ("/metrics", False, 200, False),
        ("/jobs", True, 200, False), ("/jobs", True, 400, True), ("/jobs", True, 399, False),
    ],
)  # fmt: skip
def test_what_asks_all_the_time_is_not_logged(caplog, path, by_viewer, status, logged):
    proxy, metrics = Proxy(None, Metrics(), "", 1.0), Metrics()  # type: ignore[arg-type]
    proxy._metrics = metrics
    who = caller()
    who.by_viewer = by_viewer
    with caplog.at_level(logging.INFO):
        proxy._report(scope_of(path=path, state={"caller": who}), status, 0.25)
    assert bool(caplog.records) is logged
    if logged:
        assert caplog.messages[-1] == f"GET {path} {status} 250 ms"
    assert b'splatfix_request_seconds_sum{route="other"} 0.25' in metrics.exposition()


@pytest.mark.parametrize(
    ("role", "method", "status", "told"),
    [
        ("admin", "POST", 200, True), ("admin", "GET", 200, False), ("read", "POST", 200, False),
        ("admin", "POST", 401, False), ("admin", "DELETE", 403, True),
    ],
)  # fmt: skip
def test_acts_of_administrators_are_told(caplog, role, method, status, told):
    proxy = Proxy(None, Metrics(), "", 1.0)  # type: ignore[arg-type]
    state = {"caller": caller(), "policy": RoutePolicy(role=role)}
    with caplog.at_level(logging.INFO, "service.audit"):
        proxy._report(scope_of(path="/scenes/a b", method=method, state=state, client=("1.2.3.4", 5)), status, 0.0)
    lines = [record.message for record in caplog.records if record.name == "service.audit"]
    assert lines == ([f"key 'a' (1) from 1.2.3.4: {method} /scenes/a%20b {status}"] if told else [])


# ------------------------------------------------------------------ frames


def message(
    frame_id: int = 1, time_s: float = 1.0, flags: int = 0, numbers: tuple[float, ...] = (), zero: int = 0
) -> bytes:
    more = struct.pack(f"<{len(numbers)}d", *numbers)
    return struct.pack("<4sBBHIId", b"SFLV", 1, flags, 24 + len(more), frame_id, zero, time_s) + more + photo()


@pytest.mark.parametrize(
    ("up", "good"),
    [((0, 0, 1), True), ((1.1e-6, 0, 0), True), ((1e-6, 0, 0), False), ((0, 9.9e5, 0), True), ((0, 1e6, 0), False),
     ((np.nan, 0, 1), False)],
)  # fmt: skip
def test_up_is_a_direction(up, good):
    if good:
        assert read_frame(message(flags=4, numbers=up), None).up_in_camera == up
    else:
        with pytest.raises(InvalidRequest, match="is no direction"):
            read_frame(message(flags=4, numbers=up), None)


@pytest.mark.parametrize(("x", "good"), [(1e6, True), (-1e6, True), (1.1e6, False), (-1.1e6, False)])
def test_odometry_is_not_farther_than_a_thousand_kilometres(x, good):
    pose = (1.0, 0, 0, x, 0, 1.0, 0, 0, 0, 0, 1.0, 0)
    if good:
        found = read_frame(message(flags=2, numbers=pose), None).odom_from_camera
        assert found is not None
        assert found.position_in_world.tolist() == [x, 0, 0]
    else:
        with pytest.raises(InvalidRequest, match="farther than"):
            read_frame(message(flags=2, numbers=pose), None)


def test_parts_of_a_frames_header_follow_in_order():
    pose = (1.0, 0, 0, 7.0, 0, 1.0, 0, 8.0, 0, 0, 1.0, 9.0)
    found = read_frame(message(flags=7, numbers=(50.0, 51.0, 48.0, 32.0, *pose, 0.0, -1.0, 0.0)), None)
    assert found.intrinsics is not None
    assert (found.intrinsics.fx, found.intrinsics.fy, found.intrinsics.cx, found.intrinsics.cy) == (50, 51, 48, 32)
    assert (found.intrinsics.width, found.intrinsics.height) == (96, 64)
    assert found.odom_from_camera is not None
    assert found.odom_from_camera.position_in_world.tolist() == [7, 8, 9]
    assert found.up_in_camera == (0, -1, 0)
    assert found.data == photo()


def test_frames_ascend_and_times_do_not_descend():
    before = LiveFrame(5, 2.0, b"")
    assert read_frame(message(6, 2.0), before).id == 6
    for frame_id, time_s in ((5, 3.0), (6, 1.999), (6, float("inf"))):
        with pytest.raises(InvalidRequest):
            read_frame(message(frame_id, time_s), before)
    for broken, says in (
        (message(zero=1), "reserved bytes"), (message(flags=8), "unknown flags"),
        (message()[:23], "has 24 bytes or more"),
        (message()[:24], "then comes the JPEG"), (b"SFLW" + message()[4:], "begins with SFLV"),
        (message()[:4] + b"\2" + message()[5:], "version 1"), (message(flags=4), "the header has 48 bytes"),
    ):  # fmt: skip
        with pytest.raises(InvalidRequest, match=says):
            read_frame(broken, None)


# ------------------------------------------------------------------ a live session


class Clock:
    now = 100.0

    def time(self) -> float:
        return self.now


def session(**settings: Any) -> Any:
    made: Any = _Session.__new__(_Session)
    made._settings, made._loop = Settings(**settings), Clock()
    made._heard_at, made._used, made._dropped = 100.0, 0, 0
    made._state = SimpleNamespace(live=set(), metrics=Metrics(), shared=LocalState(Path("unused")))
    made._client = "address:1.2.3.4"
    return made


def test_a_client_has_so_many_sessions_and_the_service_has():
    one = session(live_sessions=3, live_sessions_of_client=2)
    live = one._state.live

    async def run() -> None:
        async with one._place(), one._place():
            assert len(live) == 2
            with pytest.raises(RateLimited, match="for this key reached: 2") as caught:
                await one._place().__aenter__()
            assert _end_of(caught.value).code == TOO_MANY
            one._client = "address:9.9.9.9"
            async with one._place():
                one._client = "address:5.5.5.5"
                with pytest.raises(RateLimited, match="of the service reached: 3"):
                    await one._place().__aenter__()
        assert live == set()
        with pytest.raises(ValueError, match="torn"):
            async with one._place():
                raise ValueError("torn")
        async with one._place(), one._place():
            assert len(live) == 2

    asyncio.run(run())


@pytest.mark.parametrize(("gap_s", "count"), [(0.0, 16), (0.125, None), (0.0625, 31)])
def test_a_burst_of_two_seconds_frames_is_allowed(gap_s, count):
    """At eight frames a second: sixteen at once, or as many more as the time allows."""
    one = session(live_fps=8)
    taken: list[int] = []
    one._mailbox = SimpleNamespace(put=lambda frame: taken.append(frame.id))

    async def receive() -> bytes:
        if len(taken) == 60:
            raise InvalidRequest("enough.", where="test")
        one._loop.now += gap_s
        return message(len(taken) + 1)

    one._receive = receive
    with pytest.raises((_End, InvalidRequest)) as caught:
        asyncio.run(one._frames())
    assert len(taken) == (60 if count is None else count)
    if count is not None:
        assert str(caught.value) == "more than 8 frames a second."
    assert one._heard_at == one._loop.now


@pytest.mark.parametrize(
    ("silent_s", "key_lives", "code"), [(59.9, True, None), (60.1, True, TIMEOUT), (1.0, False, KEY_GONE)]
)
def test_a_session_ends_without_frames_for_a_minute_or_with_its_key(monkeypatch, silent_s, key_lives, code):
    one = session(live_idle_s=60.0)
    one._caller, slept = caller(), []

    async def sleep(seconds: float) -> None:
        slept.append(seconds)
        one._loop.now = 100.0 + silent_s
        if len(slept) > 1:
            raise _End(0)

    one._state.keys = SimpleNamespace(still_valid=lambda caller: key_lives)
    watching = one._watch()
    monkeypatch.setattr("service.web.routes.live.asyncio", SimpleNamespace(sleep=sleep))
    with pytest.raises(_End) as caught:
        asyncio.run(watching)
    assert caught.value.code == (code or 0)
    assert slept == [1.0] * (1 if code else 2)


# ------------------------------------------------------------------ priors

POSE = {"position": [0, 0, 1.5], "quaternion_wxyz": [1, 0, 0, 0]}
BOX = {"box": [[-1, -1, 1], [1, 1, 2]]}


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (POSE | BOX | {"sigma_deg": 3, "sigma_units": 1}, "Gaussian or a box"),
        (BOX | {"covariance": np.eye(6).tolist()}, "Gaussian or a box"), (POSE | {"sigma_deg": 3}, "sigma_units"),
        (POSE | {"box": [[-1, -1, 2], [1, 1, 3]]}, "outside the box"),
    ],
)  # fmt: skip
def test_a_prior_is_one_of_its_kinds(given, says):
    prior = read_fields({"prior": given}).prior
    assert prior is not None
    with pytest.raises(InvalidPrior, match=says) as caught:
        prior_from(prior)
    assert caught.value.where.startswith("prior.")


def test_a_prior_has_a_pose_a_region_or_both():
    def read(given: dict[str, Any]) -> tuple[Any, Any]:
        prior = read_fields({"prior": given}).prior
        assert prior is not None
        return prior_from(prior)

    pose, region = read(POSE)
    assert (pose.position_in_world.tolist(), region) == ([0, 0, 1.5], None)
    pose, region = read(BOX)
    assert (pose, region.lower_in_world.tolist()) == (None, [-1, -1, 1])
    pose, region = read(POSE | BOX)
    assert pose is not None
    assert region.upper_in_world.tolist() == [1, 1, 2]
    _, region = read(POSE | {"sigma_deg": 3, "sigma_units": 0.5})
    assert np.diag(region.covariance) == pytest.approx([np.radians(3) ** 2] * 3 + [0.25] * 3)
    _, region = read(POSE | {"covariance": (2 * np.eye(6)).tolist()})
    assert region.covariance.tolist() == (2 * np.eye(6)).tolist()
