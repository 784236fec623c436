"""The outermost middleware: sub-path of a proxy, request id, security headers, slow readers, uncaught errors, log."""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
import time
from urllib.parse import quote

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.logs import bound
from service.web.api_keys import Caller
from service.web.metrics import Metrics
from service.web.problems import problem_response
from service.web.route_policy import SAFE_METHODS, RoutePolicy

_log = logging.getLogger(__name__)
_audit = logging.getLogger("service.audit")
"""One line for each act of an administrator, or attempt at one with a key."""

REQUEST_ID = "X-Request-ID"
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # an address may contain a key, until the redirect
    "X-Frame-Options": "SAMEORIGIN",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# Only for our own pages, which have no inline scripts; the viewer's page has.
_PAGES_POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; "
    "base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
)
_SENT_BY_PAGE = (b"sec-fetch-site", b"same-origin")
"""The header that a browser adds to what our own pages ask for, beyond their address."""
# Probes, scrapes and open pages ask every few seconds: the log would hold little else.
_NOT_LOGGED = ("/livez", "/readyz", "/metrics", "/viewer-run")


class Proxy:
    """ASGI middleware. Sets `root_path`, so that links are right behind a proxy that serves a sub-path."""

    def __init__(self, app: ASGIApp, metrics: Metrics, default_root: str, send_s: float) -> None:
        self._app, self._metrics, self._send_s = app, metrics, send_s
        self._default_root = default_root.rstrip("/")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        scope = {**scope, **_sub_path(scope, self._default_root), "state": dict(scope.get("state", {}))}
        if scope["type"] == "websocket":
            await self._handshake(scope, receive, send)
            return
        response = _Response(scope, send, self._send_s)
        began = time.perf_counter()
        with bound(request_id=response.request_id):
            try:
                await self._app(scope, receive, response.send)
            except Exception as error:
                if response.dropped:
                    _log.info("a client stopped reading its response, and was dropped: %s", scope["path"])
                elif response.begun:  # too late for a problem document: the connection is cut
                    raise
                else:
                    _log.exception("%s %s failed", scope["method"], scope["path"])
                    await problem_response(error, scope["path"])(scope, receive, response.send)
            finally:
                self._report(scope, response.status, time.perf_counter() - began)

    async def _handshake(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a WebSocket on; report its handshake like a request, when it is answered."""
        request_id, began, answered = _request_id(scope), time.perf_counter(), False

        async def send_and_report(message: Message) -> None:
            nonlocal answered
            # A close before the handshake is a refusal, which servers answer with 403.
            statuses = {"websocket.accept": 101, "websocket.close": 403}
            status = message.get("status", statuses.get(message["type"]))
            if not answered and status is not None:
                answered = True
                if message["type"] != "websocket.close":
                    headers = MutableHeaders(scope=message)
                    headers[REQUEST_ID] = request_id
                self._report({**scope, "method": "GET"}, status, time.perf_counter() - began)
            await send(message)

        with bound(request_id=request_id):
            await self._app(scope, receive, send_and_report)

    def _report(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "other")
        path = scope["path"].removeprefix(scope.get("root_path", ""))
        self._metrics.request(scope["method"], route, status, seconds)
        caller = scope["state"].get("caller")
        # The viewer asks twice a second whether there are new jobs, an open page each second how far its jobs are.
        by_us = (caller is not None and caller.by_viewer) or _SENT_BY_PAGE in scope["headers"]
        polls = by_us and scope["method"] == "GET" and status < 400
        _audit_act(scope, caller, status)
        if not polls and not path.startswith(_NOT_LOGGED):
            # Without the query, which may contain a key.
            _log.info("%s %s %d %.0f ms", scope["method"], scope["path"], status, 1000 * seconds)


def _audit_act(scope: Scope, caller: Caller | None, status: int) -> None:
    policy: RoutePolicy | None = scope["state"].get("policy")
    if policy is None or policy.role != "admin" or scope["method"] in SAFE_METHODS or status == 401:
        return
    address = (scope.get("client") or ("?",))[0]
    who = f"key '{caller.name}' ({caller.id})" if caller else "anybody"
    # The path names what it is done to. Quoted: no line can be forged.
    _audit.info("%s from %s: %s %s %d", who, address, scope["method"], quote(scope["path"]), status)


class _Response:
    """A response while it is sent: adds headers, and gives up if the client stops reading."""

    def __init__(self, scope: Scope, send: Send, send_s: float) -> None:
        self._send, self._send_s = send, send_s
        self.request_id = _request_id(scope)
        self.status = 499  # as in nginx: the client closed the connection before the response
        self.begun = self.dropped = False
        path = scope["path"].removeprefix(scope.get("root_path", ""))
        self._own_page = path in ("/", "/live", "/docs") or path.startswith("/ui/")

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status, self.begun = message["status"], True
            headers = MutableHeaders(scope=message)
            headers[REQUEST_ID] = self.request_id
            for name, value in _HEADERS.items():
                # A policy of its own says by whom the page may be framed.
                if name != "X-Frame-Options" or "content-security-policy" not in headers:
                    headers.setdefault(name, value)
            # Photos and poses are one user's: no shared cache may keep them.
            headers.setdefault("Cache-Control", "private, no-cache")
            if self._own_page:
                headers["Content-Security-Policy"] = _PAGES_POLICY
        # `send` blocks while the socket's buffer is full.
        try:
            async with asyncio.timeout(self._send_s):
                await self._send(message)
        except TimeoutError:
            self.dropped = True
            raise OSError("the client reads too slowly") from None


def _request_id(scope: Scope) -> str:
    given = Headers(scope=scope).get(REQUEST_ID, "")
    # A proxy's id is kept, so that its log and ours can be joined, but only if it can't forge log lines.
    return given if re.fullmatch(r"[\w.-]{1,64}", given) else secrets.token_hex(8)


def _sub_path(scope: Scope, default: str) -> dict[str, str]:
    """Return ASGI's `root_path`, the sub-path under which a proxy serves the app, and `path` with it."""
    given = Headers(scope=scope).get("x-forwarded-prefix", "").rstrip("/")
    # A client can send the header: only plain paths are accepted, since it ends up in links.
    root = given if re.fullmatch(r"(/[\w~-][\w.~-]*){1,8}", given) else default
    path = scope["path"]
    # Some proxies strip the sub-path from requests, others don't; ASGI wants it in `path`.
    if root and path != root and not path.startswith(f"{root}/"):
        path = root + path
    return {"root_path": root, "path": path}
