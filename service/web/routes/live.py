"""`WS /scenes/{id}/live`: frames of a moving camera go in, poses come out; docs/live.md has the protocol."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from functools import partial

import anyio
from anyio import to_thread
from fastapi import APIRouter, WebSocket
from starlette.websockets import WebSocketDisconnect

from service.errors import BadInput, InvalidRequest, RateLimited, SceneError, SceneNotFound, StorageFailed
from service.jobs.engine import EngineLost
from service.live.live_values import LiveAnswer, LiveFrame, LiveTask
from service.live.mailbox import Mailbox
from service.live.pace import Pace
from service.logs import bound
from service.web.api_keys import Caller
from service.web.api_model import Model
from service.web.middleware.limits import client_of
from service.web.route_policy import route_policy
from service.web.routes.dependencies import AppState
from service.web.schemas.frame_message import read_frame
from service.web.schemas.live import (
    LiveHello,
    LiveLimits,
    LiveWelcome,
    live_answer_out,
    live_hint_out,
    live_task,
    read_hello,
)
from service.web.shared_state import RENEW_S, SessionLimits

_log = logging.getLogger(__name__)

# Codes from 4000 on are an application's own (RFC 6455, 7.4.2): 4000 and the HTTP status of the same error.
BAD_MESSAGE, KEY_GONE, NO_SCENE, TIMEOUT, TOO_LARGE, TOO_MANY, FAILED, UNAVAILABLE = (
    *(4400, 4401, 4404, 4408, 4413, 4429, 4500, 4503),
)
_HELLO_S = 10.0
"""Time for the first message."""
_BURST_S = 2.0
"""Over which the rate of frames is averaged: networks deliver in bursts."""
_REASON_BYTES = 123
"""Most that a close frame holds."""

router = APIRouter()


@router.websocket("/scenes/{scene_id}/live")
@route_policy(role="localize", rate_limited=True, key_in_address=True)
async def live_session(socket: WebSocket, scene_id: str) -> None:
    """Follow a camera in a scene until either side closes the socket."""
    await _Session(socket, scene_id).run()


class _End(Exception):
    """The session ends with this close code, for this reason."""

    def __init__(self, code: int, reason: str = "") -> None:
        super().__init__(reason)
        self.code, self.reason = code, reason


class _Session:
    """One socket. The engine follows the camera on a thread; frames reach it through the mailbox."""

    def __init__(self, socket: WebSocket, scene_id: str) -> None:
        self._socket, self._scene = socket, scene_id
        self._state: AppState = socket.app.state.app_state
        self._settings = self._state.settings
        self._caller: Caller | None = socket.state.caller
        self._client, self._session = client_of(socket.scope), ""
        self._mailbox, self._pace = Mailbox(), Pace(self._settings.live_fps)
        self._answers: asyncio.Queue[tuple[LiveAnswer, float, tuple[int, ...]]] = asyncio.Queue()
        self._taken: tuple[float, tuple[int, ...]] = (0.0, ())
        """Of the frame that is being used: how long it waited, and what was dropped before it."""
        self._loop = asyncio.get_running_loop()
        self._heard_at = self._loop.time()
        self._used = self._dropped = 0

    async def run(self) -> None:
        """Serve the socket; whatever happens, close it with a code, and count and log that."""
        await self._socket.accept()
        began = self._loop.time()
        with bound(scene=self._scene):
            try:
                async with self._place():
                    await self._serve()
                end = _End(1000)
            except Exception as error:
                end = _end_of(error)
            self._state.metrics.live_closed(end.code)
            _log.info(
                "live session closed: %d %s; %.0f s, %d frames used, %d dropped",
                *(end.code, end.reason, self._loop.time() - began, self._used, self._dropped),
            )
            # The client may have closed it already, or read nothing, for which nobody waits.
            with suppress(RuntimeError, WebSocketDisconnect, TimeoutError):
                async with asyncio.timeout(1.0):
                    await self._socket.close(end.code, end.reason)

    @asynccontextmanager
    async def _place(self) -> AsyncIterator[None]:
        """Take a place among the sessions of all fronts. Raises RateLimited if there is none."""
        live, shared = self._state.live, self._state.shared
        limits = SessionLimits(self._settings.live_sessions, self._settings.live_sessions_of_client)
        session = self._session = await to_thread.run_sync(shared.begin_session, self._client, limits)
        live.add(session)
        try:
            yield
        finally:
            live.discard(session)
            with anyio.CancelScope(shield=True), suppress(StorageFailed):  # then its lease ends
                await to_thread.run_sync(shared.end_session, session)

    async def _serve(self) -> None:
        """Exchange hello and welcome, then frames and answers, with the scene held meanwhile."""
        hello = await self._hello()
        engine = self._state.engine
        await to_thread.run_sync(engine.require, self._scene)  # raises SceneError, and has it loaded
        held = await to_thread.run_sync(engine.hold, self._scene)
        try:
            task = live_task(hello, held.token, self._settings.estimator)
            await self._send(LiveWelcome(scene=self._scene, limits=self._limits()))
            await self._exchange(task)
        finally:
            # Cancelled, too: a scene that stays held is never evicted.
            with anyio.CancelScope(shield=True):
                await to_thread.run_sync(engine.release, held.token)

    async def _hello(self) -> LiveHello:
        try:
            async with asyncio.timeout(_HELLO_S):
                message = await self._receive()
        except TimeoutError:
            raise _End(TIMEOUT, f"no hello within {_HELLO_S:g} s.") from None
        if isinstance(message, bytes):
            raise InvalidRequest("the first message is JSON, as text.", where="hello")
        return read_hello(message)

    def _limits(self) -> LiveLimits:
        chosen = self._settings
        return LiveLimits(frame_bytes=chosen.live_frame_bytes, frames_per_s=chosen.live_fps, idle_s=chosen.live_idle_s)

    # ------------------------------------------------------------------ both ways

    async def _exchange(self, task: LiveTask) -> None:
        """Let frames in and answers out until one of the parts ends. Raises what that raised."""
        follow = partial(self._state.engine.live, task, self._next_frame, self._on_answer)
        # A thread of its own for each session, beside those of other requests.
        followed = to_thread.run_sync(follow, limiter=anyio.CapacityLimiter(1))
        duties = (followed, self._frames(), self._send_answers(), self._watch(), self._keep_place())
        parts = [asyncio.ensure_future(duty) for duty in duties]
        try:
            ended, _ = await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._mailbox.close()
            for part in parts[1:]:
                part.cancel()
            await asyncio.wait(parts)  # the engine may still use the scene
        # Of several that ended at once, the first in this order says why.
        for part in parts:
            if part in ended:
                part.result()

    def _next_frame(self) -> LiveFrame | None:
        """Return the newest frame. On the engine's thread."""
        taken = self._mailbox.take()
        if taken is None:
            return None
        frame, came_at, dropped = taken
        self._taken = time.perf_counter() - came_at, dropped
        return frame

    def _on_answer(self, answer: LiveAnswer) -> None:
        """Hand an answer to the event loop. On the engine's thread."""
        # asyncio's queues are not safe from other threads.
        self._loop.call_soon_threadsafe(self._answers.put_nowait, (answer, *self._taken))

    async def _frames(self) -> None:
        """Put each frame that comes into the mailbox. Raises _End, BadInput, WebSocketDisconnect."""
        last: LiveFrame | None = None
        rate = float(self._settings.live_fps)
        allowed, before = _BURST_S * rate, self._loop.time()
        while True:
            message = await self._receive()
            self._heard_at = self._loop.time()
            allowed = min(_BURST_S * rate, allowed + (self._heard_at - before) * rate) - 1
            before = self._heard_at
            if allowed < 0:
                raise _End(TOO_MANY, f"more than {rate:g} frames a second.")
            if isinstance(message, str):
                raise InvalidRequest("messages after the hello must be binary.", where="frame")
            last = read_frame(message, last)
            self._mailbox.put(last)

    async def _send_answers(self) -> None:
        """Send each answer, and advice where that changes."""
        while True:
            answer, waited_s, dropped = await self._answers.get()
            out = live_answer_out(answer, waited_s, dropped)
            await self._send(out)
            self._used, self._dropped = self._used + 1, self._dropped + len(dropped)
            self._state.metrics.live_frame(out.mode, str(out.status), waited_s + answer.used_s, len(dropped))
            if hint := self._pace.used(self._loop.time(), answer.used_s, len(dropped), max(answer.size)):
                await self._send(live_hint_out(hint))

    async def _watch(self) -> None:
        """End the session when nothing comes any more, or its key is gone. Raises _End."""
        while True:
            await asyncio.sleep(min(1.0, self._settings.live_idle_s / 4))
            if self._loop.time() - self._heard_at > self._settings.live_idle_s:
                raise _End(TIMEOUT, f"no frame for {self._settings.live_idle_s:g} s.")
            if self._caller and not self._state.keys.still_valid(self._caller):
                raise _End(KEY_GONE, "the session's key is not valid any more.")

    async def _keep_place(self) -> None:
        """Keep the session counted."""
        while True:
            await asyncio.sleep(RENEW_S)
            # Without the database it goes on, and counts again as soon as that is back.
            with suppress(StorageFailed):
                await to_thread.run_sync(self._state.shared.renew_session, self._client, self._session)

    async def _receive(self) -> str | bytes:
        """Return the next message. Raises _End if it is too large, WebSocketDisconnect."""
        message = await self._socket.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message.get("code", 1005))
        data = message.get("bytes")
        found = message["text"] if data is None else data
        if len(found) > self._settings.live_frame_bytes:
            raise _End(TOO_LARGE, f"a message has at most {self._settings.live_frame_bytes} bytes, not {len(found)}.")
        return found

    async def _send(self, message: Model) -> None:
        try:
            async with asyncio.timeout(self._settings.send_s):
                await self._socket.send_text(message.model_dump_json())
        except TimeoutError:
            raise _End(TIMEOUT, "the client does not read the answers.") from None


def _end_of(error: Exception) -> _End:
    """Return the close code and reason for what ended a session."""
    match error:
        case _End():
            end = error
        case WebSocketDisconnect():
            return _End(error.code)
        case RateLimited():
            end = _End(TOO_MANY, str(error))
        case BadInput():
            end = _End(BAD_MESSAGE, str(error))
        case SceneNotFound():
            end = _End(NO_SCENE, str(error))
        case SceneError() | StorageFailed():
            end = _End(UNAVAILABLE, str(error))
        case EngineLost():
            end = _End(UNAVAILABLE, "the engine ended and is started again; connect again.")
        case _:
            _log.exception("a live session failed", exc_info=error)
            end = _End(FAILED, "The service failed; the reason is in its log.")
    # A longer reason would make the whole close frame invalid.
    return _End(end.code, end.reason.encode()[:_REASON_BYTES].decode(errors="ignore"))
