"""The outermost layer: sub-path, request id, security headers, slow readers, bugs, log and metrics."""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
import time

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.logs import bound
from service.web.metrics import Metrics
from service.web.problems import problem_response

_log = logging.getLogger(__name__)

REQUEST_ID = "X-Request-ID"
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # an address may hold a key for a moment
    "X-Frame-Options": "SAMEORIGIN",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# Ours have no inline script; the viewer's page and /docs are made by others.
_PAGES_POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; "
    "base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
)
_QUIET = ("/livez", "/readyz", "/metrics")


class Edge:
    def __init__(self, app: ASGIApp, metrics: Metrics, default_root: str, send_s: float) -> None:
        self._app, self._metrics, self._send_s = app, metrics, send_s
        self._default_root = default_root.rstrip("/")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        scope = {**scope, **_sub_path(scope, self._default_root), "state": dict(scope.get("state", {}))}
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return
        answer = _Answer(scope, send, self._send_s)
        began = time.perf_counter()
        with bound(request_id=answer.request_id):
            try:
                await self._app(scope, receive, answer.send)
            except Exception as error:
                if answer.dropped:
                    _log.info("a client took no more of its answer, and was dropped: %s", scope["path"])
                elif answer.begun:  # it can only be broken off
                    raise
                else:
                    _log.exception("%s %s failed", scope["method"], scope["path"])
                    await problem_response(error, scope["path"])(scope, receive, answer.send)
            finally:
                self._tell(scope, answer.status, time.perf_counter() - began)

    def _tell(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "other")
        self._metrics.request(scope["method"], route, status, seconds)
        if scope["path"] not in _QUIET:
            # The path without its query, which may hold a key.
            _log.info("%s %s %d %.0f ms", scope["method"], scope["path"], status, 1000 * seconds)


class _Answer:
    """A response on its way: gets our headers; one that a client doesn't take is given up."""

    def __init__(self, scope: Scope, send: Send, send_s: float) -> None:
        self._send, self._send_s = send, send_s
        given = Headers(scope=scope).get(REQUEST_ID, "")
        self.request_id = given if re.fullmatch(r"[\w.-]{1,64}", given) else secrets.token_hex(8)
        self.status = 499  # nginx's word for a client that left before the answer
        self.begun = self.dropped = False
        path = scope["path"].removeprefix(scope.get("root_path", ""))
        self._own_page = path == "/" or path.startswith("/ui/")

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status, self.begun = message["status"], True
            headers = MutableHeaders(scope=message)
            headers[REQUEST_ID] = self.request_id
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
            headers.setdefault("Cache-Control", "private, no-cache")
            if self._own_page:
                headers["Content-Security-Policy"] = _PAGES_POLICY
        try:
            async with asyncio.timeout(self._send_s):
                await self._send(message)
        except TimeoutError:
            self.dropped = True
            raise OSError("the client reads too slowly") from None


def _sub_path(scope: Scope, default: str) -> dict[str, str]:
    """Return the sub-path under which a proxy shows the app, and the path with it (as ASGI has it)."""
    given = Headers(scope=scope).get("x-forwarded-prefix", "").rstrip("/")
    # Only what is a plain path: it ends up in links.
    root = given if re.fullmatch(r"(/[\w~-][\w.~-]*){1,8}", given) else default
    path = scope["path"]
    if root and path != root and not path.startswith(f"{root}/"):
        path = root + path
    return {"root_path": root, "path": path}
