"""Limits of requests: how frequent, how large, how many at once, and whether the queue has capacity.

What is known from the head is checked before the body is read (429, 413, 503). While the body arrives, one that is
longer than allowed without having announced it, as chunked ones don't, is refused (413), and so is one that takes too
long (408). Each route's policy declares which of these limits count for it, and how large its body may be.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import QueueFull, RateLimited, SplatfixError
from service.web.api_keys import Caller
from service.web.problems import problem_response, refuse
from service.web.route_policy import RoutePolicy
from service.web.settings import Settings
from service.web.shared_state import Rate, parse_rate


class Limits:
    """ASGI middleware. Needs the route's policy in the request's state, and the caller if there is one.

    `check_queue(client, most queued, idempotency key)` raises QueueFull if one more job can't be queued; `hit` counts
    a request, as `SharedState.hit`.
    """

    def __init__(
        self,
        app: ASGIApp,
        settings: Settings,
        check_queue: Callable[[str, int | None, str | None], Awaitable[None]],
        hit: Callable[[str, Rate], Awaitable[float | None]],
    ) -> None:
        self._app, self._settings, self._check_queue, self._hit = app, settings, check_queue, hit
        parse_rate(settings.rate_limit or "1/second")  # raises for what is no rate
        self._uploads = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        policy: RoutePolicy = scope["state"]["policy"]
        try:
            await self._check_head(scope, policy)
        except (SplatfixError, HTTPException) as error:
            await refuse(problem_response(error, scope["path"]), scope, receive, send)
            return
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return
        if policy.body is None:
            await self._app(scope, _without_body(receive), send)
            return
        # No await since the check of `max_uploads`, so no other request can take the place meanwhile.
        self._uploads += 1
        limits = policy.body.max_bytes(self._settings), policy.body.seconds(self._settings)
        body = _Body(receive, *limits, self._release)
        try:
            await self._app(scope, body.receive, send)
        finally:
            # Also a body that the route did not read to its end gives its place back.
            body.end()

    async def _check_head(self, scope: Scope, policy: RoutePolicy) -> None:
        """Check all that is known before the body arrives. Raises RateLimited, QueueFull, HTTPException 413."""
        # The cheapest check first. The queue's is last but one, since it may read the store.
        if policy.rate_limited:
            await self._check_rate(scope)
        if policy.body:
            _check_length(scope, policy.body.max_bytes(self._settings))
        if policy.queues_job:
            caller: Caller | None = scope["state"].get("caller")
            most = most_queued(caller, self._settings.queue_size)
            await self._check_queue(client_of(scope), most, Headers(scope=scope).get("idempotency-key"))
        if policy.body and self._uploads >= self._settings.max_uploads:
            raise QueueFull(f"too many uploads at once ({self._uploads}).", hint="Try again later.")

    async def _check_rate(self, scope: Scope) -> None:
        caller: Caller | None = scope["state"].get("caller")
        client, rate = client_of(scope), (caller and caller.limits.rate) or self._settings.rate_limit
        if not rate:
            return
        # Some microseconds each time; keys come and go, with their rates.
        wait_s = await self._hit(client, parse_rate(rate))
        if wait_s is not None:
            raise RateLimited(
                f"rate limit exceeded: {rate}.", hint="Slow down.", retry_after_s=max(1, math.ceil(wait_s))
            )

    def _release(self) -> None:
        self._uploads -= 1


def _without_body(receive: Receive) -> Receive:
    """Return a `receive` for a route that reads no body: an empty one, then what follows the body that was sent."""
    given = False

    async def receive_nothing() -> Message:
        nonlocal given
        if not given:
            given = True
            return {"type": "http.request", "body": b"", "more_body": False}
        # A streaming answer waits here for the client to disconnect.
        while (message := await receive())["type"] == "http.request":
            pass
        return message

    return receive_nothing


class _Body:
    """A request's body as it arrives: counted and timed. It counts as an upload under way until it is read."""

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
        # Counted as well as announced: chunked bodies have no Content-Length.
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
    """Return whose a request is, its jobs, lenses and limits: the key's, by name and id, else the IP address's."""
    caller: Caller | None = scope.get("state", {}).get("caller")
    address = scope.get("client")
    return caller.client if caller else f"address:{address[0] if address else ''}"


def most_queued(caller: Caller | None, queue_size: int) -> int | None:
    """Return how many jobs a caller may have waiting at once, at least one; None: as many as the queue takes."""
    share = caller and caller.limits.queue_share
    return None if share is None else max(1, math.floor(share * queue_size))


def _check_length(scope: Scope, limit: int) -> None:
    # Malformed lengths are refused by the HTTP server already.
    length = Headers(scope=scope).get("content-length", "")
    if length.isdecimal() and int(length) > limit:
        raise too_large(limit)


def too_large(limit: int) -> HTTPException:
    """Return the error for a body of more bytes."""
    return HTTPException(413, f"Upload too large (limit {_readable(limit)}).")


def _readable(count: int) -> str:
    """Return a number of bytes in the largest decimal unit of which there is one, with at most two digits behind."""
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= size:
            return f"{count / size:.2f}".rstrip("0").rstrip(".") + f" {unit}"
    return f"{count} bytes"
