"""The viewer under /viewer on the service's own port: HTTP and WebSocket handed on to a server on loopback.

The viewer's page finds its WebSocket by its own address: the page /viewer/jobs/ID/ connects to
/viewer/jobs/ID. What follows /viewer is handed on, so the viewer knows from the path which job a browser
asks for. All pages are one and the same file, so a path that the viewer has no file for gets that page.
A browser without a GPU says so in a cookie (`static/viewer.js`); the viewer hears it as a query.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any, Protocol, runtime_checkable

import httpx
from fastapi import APIRouter, Request, Response, WebSocket
from starlette.exceptions import HTTPException
from starlette.websockets import WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.typing import Subprotocol

from service.web.route_policy import route_policy

_log = logging.getLogger(__name__)

_TRY_AGAIN_LATER = 1013


@runtime_checkable
class Upstream(Protocol):
    port: int
    """On loopback; whether anybody listens there is found out by trying."""


class Relay:
    """Hands everything under /viewer on; `router` has the routes."""

    def __init__(self, upstream: Upstream) -> None:
        self._upstream = upstream
        # Loopback: a proxy from the environment must not stand between.
        self._http = httpx.AsyncClient(trust_env=False, timeout=30.0)
        self.router = APIRouter(include_in_schema=False)
        for path in ("/viewer", "/viewer/{path:path}"):
            self.router.add_api_route(path, self._page)
            self.router.add_api_websocket_route(path, self._socket)

    async def close(self) -> None:
        await self._http.aclose()

    @route_policy(role="read", key_in_address=True)
    async def _page(self, request: Request, path: str = "") -> Response:
        answer = await self._ask(path)
        if answer.status_code == 404:
            answer = await self._ask("")
        content, kind = answer.content, answer.headers.get("content-type", "")
        if kind.startswith("text/html"):  # with our own script, which must run before viser's opens the socket
            script = f'<head><script src="{request.scope.get("root_path", "")}/ui/viewer.js"></script>'
            content = content.replace(b"<head>", script.encode(), 1)
        return Response(content, answer.status_code, media_type=kind)

    async def _ask(self, path: str) -> httpx.Response:
        try:
            return await self._http.get(f"http://127.0.0.1:{self._upstream.port}/{path}")
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise HTTPException(503, "The viewer does not answer; it may just be starting.") from error

    @route_policy(role="read", key_in_address=True)
    async def _socket(self, browser: WebSocket, path: str = "") -> None:
        offered = [Subprotocol(name) for name in browser.scope.get("subprotocols", [])]
        query = "?gl=software" if browser.cookies.get("splatfix_gl") == "software" else ""
        uri = f"ws://127.0.0.1:{self._upstream.port}/{path}{query}"
        try:
            # No size limit and no compression: whole scenes pass here, on loopback.
            async with connect(
                uri, subprotocols=offered or None, max_size=None, compression=None, proxy=None
            ) as viewer:
                await browser.accept(viewer.subprotocol)
                await _first_of(_to_viewer(browser, viewer), _to_browser(viewer, browser))
        except (OSError, WebSocketException) as error:
            _log.warning("the viewer's socket can't be reached: %s", error)
            with suppress(RuntimeError, WebSocketDisconnect):  # closed by now
                await browser.close(_TRY_AGAIN_LATER)


async def _to_viewer(browser: WebSocket, viewer: ClientConnection) -> None:
    while (message := await browser.receive())["type"] != "websocket.disconnect":
        data = message.get("bytes")
        await viewer.send(message["text"] if data is None else data)


async def _to_browser(viewer: ClientConnection, browser: WebSocket) -> None:
    with suppress(ConnectionClosed):  # told by an exception unless it was closed with code 1000
        async for message in viewer:
            if isinstance(message, str):
                await browser.send_text(message)
            else:
                await browser.send_bytes(message)
    await browser.close(viewer.close_code or 1000, viewer.close_reason or "")


async def _first_of(*directions: Coroutine[Any, Any, None]) -> None:
    """Run both directions until one ends, since then the connection is over."""
    tasks = [asyncio.ensure_future(direction) for direction in directions]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        for task in tasks:
            # RuntimeError is starlette's word for a socket that was closed meanwhile.
            with suppress(asyncio.CancelledError, ConnectionClosed, WebSocketDisconnect, RuntimeError):
                await task
