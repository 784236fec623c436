"""Relays HTTP and WebSocket under /viewer to the viewer's server on loopback, so that the service has one port.

The viewer's page derives the address of its WebSocket from its own: the page /viewer/jobs/ID/ connects to
/viewer/jobs/ID. The path after /viewer is passed on, and names the job to show. All pages are the same file, so the
relay returns it for every path that the viewer has no file for. A header has the token with which the viewer asks the
service: in the name of the browser's user, so that it shows what that one may see. A script (`static/viewer.js`) sets
cookies with its time zone and whether it has a GPU; the relay passes them on as query parameters. The
same script asks `/viewer-run` whether the viewer was started after the page was opened.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any, Protocol, runtime_checkable
from urllib.parse import unquote, urlencode

import httpx
from fastapi import APIRouter, Request, Response, WebSocket
from starlette.exceptions import HTTPException
from starlette.websockets import WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.typing import Subprotocol

from service.web.api_keys import Caller, KeyRing
from service.web.route_policy import route_policy

_log = logging.getLogger(__name__)

_TRY_AGAIN_LATER = 1013


@runtime_checkable
class Upstream(Protocol):
    """The viewer's server."""

    port: int
    """On loopback. Nothing may listen there, while the viewer starts."""

    started: float
    """When the process that listens there was started, by `time.monotonic`."""


class Relay:
    """Passes requests and messages on; `router` has the routes to include in an app."""

    def __init__(self, upstream: Upstream, keys: KeyRing) -> None:
        """`keys` sign in whose name the viewer asks for what a browser sees."""
        self._upstream, self._keys = upstream, keys
        # trust_env: HTTP_PROXY must not apply to loopback.
        self._http = httpx.AsyncClient(trust_env=False, timeout=30.0)
        self.router = APIRouter(include_in_schema=False)
        self.router.add_api_route("/viewer-run", self._run)
        for path in ("/viewer", "/viewer/{path:path}"):
            self.router.add_api_route(path, self._page)
            self.router.add_api_websocket_route(path, self._socket)

    async def close(self) -> None:
        """Close the connections to the viewer."""
        await self._http.aclose()

    @route_policy(role="read", key_in_address=True)
    async def _page(self, request: Request, path: str = "") -> Response:
        answer = await self._ask(path)
        # A page of a job: the viewer has one page for all paths.
        if answer.status_code == 404:
            answer = await self._ask("")
        content, kind = answer.content, answer.headers.get("content-type", "")
        if kind.startswith("text/html"):  # our script must run before viser's, which opens the WebSocket
            script = f'<head><script src="{request.scope.get("root_path", "")}/ui/viewer.js"></script>'
            content = content.replace(b"<head>", script.encode(), 1)
        return Response(content, answer.status_code, media_type=kind)

    @route_policy(role="read")
    async def _run(self) -> float:
        """Return for how many seconds the viewer has run: a page that was opened before is loaded anew.

        Behind a gateway any front answers, of whose viewer the page knows nothing; but one that has run for longer than
        the page is open has not come after the page's own.
        """
        await self._ask("")
        return time.monotonic() - self._upstream.started

    async def _ask(self, path: str) -> httpx.Response:
        try:
            return await self._http.get(f"http://127.0.0.1:{self._upstream.port}/{path}")
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise HTTPException(503, "The viewer does not answer; it may be starting.") from error

    @route_policy(role="read", key_in_address=True)
    async def _socket(self, browser: WebSocket, path: str = "") -> None:
        offered = [Subprotocol(name) for name in browser.scope.get("subprotocols", [])]
        facts = {"gl": browser.cookies.get("splatfix_gl"), "zone": unquote(browser.cookies.get("splatfix_zone", ""))}
        query = urlencode({name: value for name, value in facts.items() if value})
        uri = f"ws://127.0.0.1:{self._upstream.port}/{path}{'?' if query else ''}{query}"
        caller: Caller | None = getattr(browser.state, "caller", None)
        headers = {"Authorization": f"Bearer {self._keys.viewer_token(caller)}"} if caller else None
        try:
            # No size limit and no compression: messages contain whole scenes, on loopback.
            async with connect(
                uri,
                subprotocols=offered or None,
                additional_headers=headers,
                max_size=None,
                compression=None,
                proxy=None,
            ) as viewer:
                # After the viewer's own: a socket that opens has a viewer behind it.
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
    with suppress(ConnectionClosed):  # raised unless the connection was closed with code 1000
        async for message in viewer:
            if isinstance(message, str):
                await browser.send_text(message)
            else:
                await browser.send_bytes(message)
    await browser.close(viewer.close_code or 1000, viewer.close_reason or "")


async def _first_of(*directions: Coroutine[Any, Any, None]) -> None:
    """Run both directions until one of them ends, and with it the connection."""
    tasks = [asyncio.ensure_future(direction) for direction in directions]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        for task in tasks:
            # RuntimeError: starlette's error for a WebSocket that was closed meanwhile.
            with suppress(asyncio.CancelledError, ConnectionClosed, WebSocketDisconnect, RuntimeError):
                await task
