"""Every route declares its policy, and the middleware enforces it before a byte of the body is read."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from api_server import create_app, settings
from fastapi import APIRouter, FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.staticfiles import StaticFiles
from stand_ins import make_scene
from starlette.routing import Mount, WebSocketRoute

from service.web import app as web_app
from service.web.api_keys import KeyRing
from service.web.key_file import ROLES, add_key
from service.web.middleware.limits import Limits
from service.web.route_policy import RoutePolicy, declare, declared_policy, require_policies
from service.web.viewer_relay import Relay

# What anybody may do without a key. Whatever is missing here must be refused.
PUBLIC = {
    ("GET", "/"), ("GET", "/livez"), ("GET", "/readyz"), ("GET", "/docs"), ("GET", "/openapi.json"), ("GET", "/ui/x"),
    *(("GET", f"/shared/token{rest}") for rest in ("", "/job", "/photo", "/trace", "/iterations/index/render.jpg")),
    ("GET", "/client.js"), ("GET", "/ui/labels.js"),
    ("GET", "/docs/swagger-ui-bundle.js"), ("GET", "/docs/swagger-ui.css"),
}  # fmt: skip
UNKNOWN = [
    *(("GET", path) for path in ("/nowhere", "/jobs/", "/JOBS", "//jobs", "/ui", "/livez/x", "/docs/", "/redoc")),
    *(("HEAD", path) for path in ("/jobs", "/scenes/x", "/nowhere")),
    *(("OPTIONS", path) for path in ("/localize", "/scenes/x", "/nowhere")),
    *(("POST", path) for path in ("/nowhere", "/", "/ui/x", "/livez", "/docs", "/viewer/x")),
    *(("PUT", "/localize"), ("PATCH", "/jobs/x"), ("DELETE", "/ui/x"), ("TRACE", "/jobs"), ("BREW", "/jobs")),
]
LIMIT = 10**13


@pytest.fixture(scope="module")
def keys(tmp_path_factory) -> dict[str, str]:
    path = tmp_path_factory.mktemp("keys") / "keys.json"
    return {"file": str(path), **{role: add_key(path, role, role) for role in ROLES}}


@pytest.fixture(scope="module")
def locked(keys) -> FastAPI:
    # Without a rate limit, which a fast machine would reach here.
    chosen = settings(estimator="view_index", keys_file=keys["file"], rate_limit="")
    app = create_app(chosen, {"room": make_scene()})
    app.include_router(Relay(SimpleNamespace(port=9), KeyRing(None)).router)
    return app


def requests(app: FastAPI) -> Iterator[tuple[str, str, RoutePolicy]]:
    """(method, path, policy) of each route, as the router has it; WEBSOCKET stands for a socket's method."""
    for found in iter_route_contexts(app.routes):
        policy = declared_policy(found.original_route)
        assert policy, f"{found.path} declares no policy"
        path = (found.path or "").replace("{path:path}", "x").replace("{", "").replace("}", "")
        if isinstance(found.original_route, Mount):
            yield "GET", f"{path}/x", policy
        elif isinstance(found.original_route, WebSocketRoute):
            yield "WEBSOCKET", path, policy
        else:
            yield from ((method, path, policy) for method in sorted(found.methods or ()) if method != "HEAD")


class BodyRead(AssertionError):
    pass


def status_of_head(app: FastAPI, method: str, path: str, key: str = "", root: str = "") -> int:
    """Send the head of a request to the app; return the status that it answers before it reads the body.

    Raises BodyRead if the body is read first.
    """
    answered: list[int] = []

    async def receive() -> dict[str, Any]:
        if method == "WEBSOCKET":
            return {"type": "websocket.connect"}
        if not answered:
            raise BodyRead(f"{method} {path}")
        return {"type": "http.disconnect"}

    async def send(message) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            answered.append(message["status"])

    headers = [(b"host", b"127.0.0.1"), (b"content-length", b"%d" % LIMIT)]
    headers += [(b"authorization", f"Bearer {key}".encode())] if key else []
    headers += [(b"x-forwarded-prefix", root.encode())] if root else []
    refusable = {"extensions": {"websocket.http.response": {}}}
    kind = {"type": "websocket", **refusable} if method == "WEBSOCKET" else {"type": "http", "method": method}
    scope = {**kind, "path": path, "query_string": b"", "headers": headers, "client": ("127.0.0.1", 1)}
    scope["asgi"] = {"version": "3.0", "spec_version": "2.4"}

    asyncio.run(app(scope, receive, send))  # type: ignore[arg-type]
    return answered[0]


def test_only_what_is_listed_is_public(locked):
    assert {(method, path) for method, path, policy in requests(locked) if policy.role is None} == PUBLIC
    assert len(list(requests(locked))) > 25


@pytest.mark.parametrize("root", ["", "/behind/a-proxy"])
def test_every_route_refuses_before_it_reads(locked, keys, root):
    """Without a key, with a key of a lower role, with a body larger than the route allows."""
    for method, path, policy in requests(locked):
        if policy.role is None:
            continue
        assert status_of_head(locked, method, path, root=root) == 401, (method, path)
        for role in ROLES[: ROLES.index(policy.role)]:
            assert status_of_head(locked, method, path, keys[role], root) == 403, (method, path, role)
        if policy.body:
            assert status_of_head(locked, method, path, keys[policy.role], root) == 413, (method, path)


@pytest.mark.parametrize(("method", "path"), UNKNOWN)
def test_what_no_route_serves_is_denied(locked, keys, method, path):
    assert status_of_head(locked, method, path) == 401
    if method not in ("GET", "HEAD", "OPTIONS"):
        assert status_of_head(locked, method, path, keys["localize"]) == 403
        assert status_of_head(locked, method, path, keys["admin"]) == 413


@pytest.mark.parametrize("method", ["HEAD", "OPTIONS"])
def test_head_and_options_have_the_policy_of_get(keys, method):
    app = create_app(settings(estimator="view_index", keys_file=keys["file"]))
    app.add_api_route("/more", declare(lambda: None, RoutePolicy(role="localize")))
    served = 200 if method == "HEAD" else 405
    assert status_of_head(app, method, "/livez") == served
    assert status_of_head(app, method, "/more") == 401
    assert status_of_head(app, method, "/more", keys["read"]) == 403
    assert status_of_head(app, method, "/more", keys["localize"]) == served


def test_a_socket_where_no_route_is_is_denied(locked):
    assert status_of_head(locked, "WEBSOCKET", "/jobs") == 401


def test_the_start_page_is_public_under_a_sub_path_without_its_slash(locked):
    assert status_of_head(locked, "GET", "/fix", root="/fix") == 307
    assert status_of_head(locked, "GET", "/fixed", root="/fix") == 401


async def _nothing() -> None:
    raise AssertionError("it was served")


@pytest.mark.parametrize("kind", ["route", "websocket", "mount", "router"])
def test_a_route_without_a_policy_stops_the_start(locked, keys, monkeypatch, kind, tmp_path):
    def add(app: FastAPI) -> None:
        if kind == "mount":
            app.mount("/more", StaticFiles(directory=tmp_path))
        elif kind == "router":
            more = APIRouter()
            more.add_api_route("/more", _nothing)
            app.include_router(more)
        else:
            (app.add_api_route if kind == "route" else app.add_api_websocket_route)("/more", _nothing)

    monkeypatch.setattr(web_app, "add_pages", add)
    with pytest.raises(TypeError, match="/more declares no policy"):
        create_app(settings(estimator="view_index", keys_file=keys["file"]), {"room": make_scene()})


def test_a_route_that_is_added_later_is_denied(keys):
    app = create_app(settings(estimator="view_index", keys_file=keys["file"]), {"room": make_scene()})
    app.add_api_route("/more", _nothing, methods=["GET", "POST"])
    assert status_of_head(app, "GET", "/more") == 401
    assert status_of_head(app, "POST", "/more", keys["localize"]) == 403
    with pytest.raises(TypeError, match="/more"):
        require_policies(app.routes)


def test_a_mount_serves_what_it_declares_and_nothing_else(keys, tmp_path):
    (tmp_path / "x").write_text("a file")
    app = create_app(settings(estimator="view_index", keys_file=keys["file"]), {"room": make_scene()})
    app.mount("/files", declare(StaticFiles(directory=tmp_path), RoutePolicy(role="localize")))
    assert status_of_head(app, "GET", "/files/x") == 401
    assert status_of_head(app, "GET", "/files/x", keys["read"]) == 403
    assert status_of_head(app, "GET", "/files/x", keys["localize"]) == 200
    assert status_of_head(app, "POST", "/files/x", keys["localize"]) == 403


def test_a_route_without_a_body_gets_none(stepping):
    """Whatever is sent: the function sees an empty body, and the answer comes all the same."""
    seen: list[bytes] = []

    async def curious(scope, receive, send) -> None:
        seen.append((await receive())["body"])
        seen.append((await receive())["type"].encode())

    async def receive() -> dict[str, Any]:
        return sent.pop(0)

    sent = [{"type": "http.request", "body": b"x", "more_body": more} for more in (True, False)]
    sent += [{"type": "http.disconnect"}]
    scope = {"type": "http", "method": "GET", "path": "/", "headers": [], "state": {"policy": RoutePolicy("read")}}

    async def no_room(client, most, key) -> None:
        raise AssertionError("a job is queued")

    async def in_time(key, rate) -> None:
        return None

    asyncio.run(Limits(curious, settings(), no_room, in_time)(scope, receive, None))  # type: ignore[arg-type]
    assert seen == [b"", b"http.disconnect"]


def test_a_body_sent_to_a_reading_route_changes_nothing(shared):
    assert shared.request("GET", "/jobs", content=b"x" * 10_000).status_code == 200
    assert shared.get("/jobs").status_code == 200
