"""What is refused before its body is read: too often, too large, too many at once, or nobody has time for it.

A dependency of a route answers only after the whole upload; this layer answers with the head of the request.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Awaitable, Callable

from limits import RateLimitItem, parse
from limits.storage import MemoryStorage
from limits.strategies import SlidingWindowCounterRateLimiter
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import QueueFull, RateLimited, SplatfixError
from service.web.problems import problem_response, refuse
from service.web.settings import Settings

SMALL_BODY = 1_000_000
"""Of requests without a file; also what a body with one may have beyond the file."""
_WORK = ("/localize", "/geopose")


class Admission:
    """An ASGI layer. `room` is asked with (client, idempotency key) and raises QueueFull if a photo has no place."""

    def __init__(self, app: ASGIApp, settings: Settings, room: Callable[[str, str | None], Awaitable[None]]) -> None:
        self._app, self._settings, self._room = app, settings, room
        self._limit: RateLimitItem | None = parse(settings.rate_limit) if settings.rate_limit else None
        self._limiter = SlidingWindowCounterRateLimiter(MemoryStorage())
        self._uploads = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] in ("GET", "HEAD", "OPTIONS"):
            await self._app(scope, receive, send)
            return
        path = scope["path"].removeprefix(scope.get("root_path", ""))
        limit = self._size_limit(scope["method"], path)
        try:
            self._check_rate(scope)
            _check_length(scope, limit)
            if path in _WORK:
                await self._room(client_of(scope), Headers(scope=scope).get("idempotency-key"))
            if self._uploads >= self._settings.max_uploads:
                raise QueueFull(f"{self._uploads} uploads are under way.", hint="Try again later.")
        except (SplatfixError, HTTPException) as error:
            await refuse(problem_response(error, scope["path"]), scope, receive, send)
            return
        self._uploads += 1
        # A second for each megabyte that it may have: a slow line is no crime, a stalled one is.
        body = _Body(receive, limit, self._settings.upload_s + limit / 1e6, self._release)
        try:
            await self._app(scope, body.receive, send)
        finally:
            body.end()

    def _size_limit(self, method: str, path: str) -> int:
        if path in _WORK:
            return self._settings.max_upload_bytes * 4 // 3 + SMALL_BODY  # base64
        return self._settings.max_scene_bytes if method == "PUT" and path.startswith("/scenes/") else SMALL_BODY

    def _check_rate(self, scope: Scope) -> None:
        client = client_of(scope)
        if self._limit and not self._limiter.hit(self._limit, client):
            reset = self._limiter.get_window_stats(self._limit, client).reset_time
            raise RateLimited(
                f"more than {self._settings.rate_limit} requests of yours.",
                hint="Slow down.",
                retry_after_s=max(1, math.ceil(reset - time.time())),
            )

    def _release(self) -> None:
        self._uploads -= 1


class _Body:
    """A request's body as it comes in: counted and timed. It holds a place among the uploads until it is read."""

    def __init__(self, receive: Receive, limit: int, seconds: float, release: Callable[[], None]) -> None:
        self._receive, self._limit, self._release = receive, limit, release
        self._deadline = asyncio.get_running_loop().time() + seconds
        self._received, self._open = 0, True

    async def receive(self) -> Message:
        if not self._open:
            return await self._receive()
        try:
            async with asyncio.timeout_at(self._deadline):
                message = await self._receive()
        except TimeoutError:
            raise HTTPException(408, "The body took too long to arrive.") from None
        self._received += len(message.get("body", b""))
        if self._received > self._limit:
            raise too_large(self._limit)
        if not message.get("more_body"):
            self.end()
        return message

    def end(self) -> None:
        if self._open:
            self._open = False
            self._release()


def client_of(scope: Scope) -> str:
    """Return who asks, for limits and idempotency keys: the key's name, else the address."""
    caller = scope.get("state", {}).get("caller")
    address = scope.get("client")
    return f"key:{caller.name}" if caller else f"address:{address[0] if address else ''}"


def _check_length(scope: Scope, limit: int) -> None:
    length = Headers(scope=scope).get("content-length", "")
    if length.isdecimal() and int(length) > limit:
        raise too_large(limit)


def too_large(limit: int) -> HTTPException:
    """Return the error for a body of more bytes."""
    return HTTPException(413, f"The body may have {limit} bytes.")
