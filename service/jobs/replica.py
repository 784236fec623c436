"""One process of the Ray engine: an embedded engine, whose scenes `SceneCoordinator` decides.

Methods are coroutines, so that cancels and frames arrive while a job runs; the work is on threads. Knows no Ray.
"""

from __future__ import annotations

import asyncio
import copy
import os
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field, replace
from queue import SimpleQueue
from typing import Any

from service.errors import SceneInUse, SceneNotFound
from service.jobs.embedded_engine import EmbeddedEngine, EngineConfig
from service.jobs.engine import EngineAnswer, HeldScenes, LocalizeTask
from service.jobs.model import JobRecord
from service.live.live_values import LiveFrame, LiveTask
from service.scene_manager.status import SceneReadiness, SceneStatus, StoredScene
from service.types import Query

SetUp = Callable[[EmbeddedEngine], None]
"""Called in the replica before its engine starts; for scenes that are in no file."""

Record = tuple[JobRecord, Query | None]

_BETWEEN_RECORDS_S = 0.05
_JOBS = ThreadPoolExecutor(256, "job")
"""A thread is used again: one of its own for each job would have to get its memory from the system anew."""


@dataclass(slots=True)
class _Held:
    """Scenes that are held."""

    own: str
    """The engine's token."""
    attempts: set[str] = field(default_factory=set)
    """Under way with them."""


class Replica:
    """What its methods return and raise can be pickled."""

    def __init__(self, config: EngineConfig, set_up: SetUp | None = None) -> None:
        # The budget is the coordinator's, who says what to drop.
        self._engine = EmbeddedEngine(config)
        self._held: dict[str, _Held] = {}
        """By the coordinator's token."""
        self._frames: dict[str, SimpleQueue[LiveFrame | None]] = {}
        if set_up:
            set_up(self._engine)
        self._engine.start()

    async def ping(self) -> int:
        """Return the process' number."""
        return os.getpid()

    async def built_in(self) -> list[SceneStatus]:
        """Return the scenes that were set up here, as soon as they are prepared."""
        while self._engine.readiness().pending:
            await asyncio.sleep(0.02)
        return self._engine.scenes()

    async def prepared(self, scene_id: str) -> None:
        """Return when a scene is loaded and prepared, or won't be."""
        while self._engine.scene(scene_id).state in ("loading", "preparing"):
            await asyncio.sleep(0.02)

    async def drop(self, ids: Sequence[str]) -> None:
        """Take scenes that nothing uses out of memory, and forget them."""
        self._drop(ids)

    def _drop(self, ids: Sequence[str]) -> None:
        for scene_id in ids:
            # In use: by a front that was taken to have ended. Then it goes once that lets go.
            with suppress(SceneNotFound, SceneInUse):
                self._engine.unload(scene_id)
                self._engine.remove(scene_id)

    async def readiness(self) -> SceneReadiness:
        """Return what scenes here are rendered with."""
        return self._engine.readiness()

    async def ask(self, name: str, *arguments: Any) -> Any:
        """Call a method of the engine that answers once."""
        return await self._in_thread(getattr(self._engine, name), *arguments)

    # ------------------------------------------------------------------ jobs

    async def hold(
        self, token: str, drop: Sequence[str], stored: Sequence[StoredScene], ids: Sequence[str]
    ) -> tuple[HeldScenes | Exception, list[SceneStatus]]:
        """Drop scenes, load others, and hold those that are asked for as soon as all are in memory, as `token`.

        Return them, or why they can't be, and what each is then.
        """
        self._drop(drop)
        known = {scene.id for scene in self._engine.scenes()}
        for scene in stored:
            if scene.id not in known:
                self._engine.add(scene)
            self._engine.load(scene.id)
        found = await self._held_here(ids)
        if isinstance(found, Exception):
            return _portable(found), self._statuses(ids)
        self._held[token] = _Held(found.token)
        return replace(found, token=token), self._statuses(ids)

    def _statuses(self, ids: Sequence[str]) -> list[SceneStatus]:
        return [status for status in self._engine.scenes() if status.id in ids]

    async def _held_here(self, ids: Sequence[str]) -> HeldScenes | Exception:
        """Return scenes as soon as all are in memory, by the engine's token; or why they won't be."""
        loop, answer = asyncio.get_running_loop(), asyncio.Future()
        asked = ids[0] if len(ids) == 1 else tuple(ids)
        self._engine.hold_later(asked, lambda found: loop.call_soon_threadsafe(answer.set_result, found))
        return await answer

    @asynccontextmanager
    async def _using(self, scenes: HeldScenes, task_id: str) -> AsyncIterator[str]:
        """Hold scenes until an attempt ends; give the engine's token. Raises SceneError.

        Of scenes that are in memory the coordinator tells only the front, which saves a job the way. They are waited
        for nevertheless: the engine loads a scene again whose files have changed.
        """
        is_told = scenes.token in self._held
        if not is_told:
            found = await self._held_here(scenes.ids)
            if isinstance(found, Exception):
                raise _portable(found)
            self._held[scenes.token] = _Held(found.token)
        held = self._held[scenes.token]
        held.attempts.add(task_id)
        try:
            yield held.own
        finally:
            held.attempts.discard(task_id)
            if not is_told:  # here, too: the release may have come before the attempt
                self._let_go(scenes.token)

    async def release(self, token: str, ids: Sequence[str]) -> list[SceneStatus]:
        """Let go of scenes, and end what still runs with them; return what each is."""
        self._let_go(token)
        return self._statuses(ids)

    def _let_go(self, token: str) -> None:
        if held := self._held.pop(token, None):
            for task_id in held.attempts:
                self._engine.cancel(task_id)
            self._engine.release(held.own)

    async def cancel(self, task_id: str) -> None:
        """End an attempt at its next record."""
        self._engine.cancel(task_id)

    async def localize(
        self, task: LocalizeTask, scenes: HeldScenes
    ) -> AsyncIterator[tuple[list[Record], EngineAnswer | None]]:
        """Yield the records since the last time, 20 times a second at most, at last with the answer.

        The job's thread doesn't wake this one at each record, which would take 1 ms of the job.
        """
        records: list[Record] = []
        async with self._using(scenes, task.id) as token:
            own = replace(task, held=token)
            job = _on_thread(lambda: self._engine.localize(own, lambda *record: records.append(record)))
            ended = False
            while not ended:
                await asyncio.wait([job], timeout=_BETWEEN_RECORDS_S)
                ended, count = job.done(), len(records)  # the job may end while they are sent
                if count or ended:
                    yield records[:count], job.result() if ended else None
                    del records[:count]

    async def live(self, session: str, task: LiveTask, scenes: HeldScenes) -> AsyncIterator[tuple[str, Any]]:
        """Yield `("frame?", None)` where a frame is wanted, `("record", LiveAnswer)`, at last `("answer", None)`."""
        frames = self._frames[session] = SimpleQueue()

        def work(put: Callable[[tuple[str, Any]], None]) -> None:
            def next_frame() -> LiveFrame | None:
                put(("frame?", None))
                return frames.get()

            self._engine.live(own, next_frame, lambda answer: put(("record", answer)))

        try:
            async with self._using(scenes, session) as token:
                own = replace(task, held=token)
                async for message in _streamed(work):
                    yield message
        finally:
            frames.put(None)
            self._frames.pop(session, None)

    async def frame(self, session: str, frame: LiveFrame | None) -> None:
        """Give a live session the frame that it wants; None ends it."""
        if frames := self._frames.get(session):
            frames.put(frame)

    async def _in_thread(self, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return await asyncio.to_thread(function, *arguments)
        except Exception as error:
            raise _portable(error) from None


async def _streamed(work: Callable[[Callable[[tuple[str, Any]], None]], Any]) -> AsyncIterator[tuple[str, Any]]:
    """Yield what work on a thread of its own puts, then `("answer", what it returns)`; raise what it raises."""
    loop, messages = asyncio.get_running_loop(), asyncio.Queue()

    def put(message: tuple[str, Any]) -> None:
        loop.call_soon_threadsafe(messages.put_nowait, message)

    def run() -> None:
        try:
            put(("answer", work(put)))
        except Exception as error:
            put(("error", error))

    threading.Thread(target=run, name="job", daemon=True).start()
    while True:
        kind, value = await messages.get()
        if kind == "error":
            raise _portable(value)
        yield kind, value
        if kind == "answer":
            return


def _on_thread(work: Callable[[], Any]) -> asyncio.Future[Any]:
    """Begin work on a thread; return its future result, or its error, which can be sent."""

    def run() -> Any:
        try:
            return work()
        except Exception as error:
            raise _portable(error) from None

    return asyncio.get_running_loop().run_in_executor(_JOBS, run)


def _portable(error: Exception) -> Exception:
    """Return what survives being sent: the error, or one of the same text."""
    try:
        # Errors are made again in the same way on the other side.
        return copy.deepcopy(error)
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
