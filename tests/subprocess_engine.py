"""A second implementation of `Engine`: a child process that has the scenes, and a pipe of pickled values.

A child that dies takes its scenes and attempts with it; another one is started in its place.
"""

from __future__ import annotations

import multiprocessing
import pickle
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from service.errors import SceneNotReady, SplatfixError
from service.jobs.embedded_engine import EmbeddedEngine, EngineConfig
from service.jobs.engine import EngineAnswer, EngineLost, HeldScenes, LocalizeTask, NextFrame, OnAnswer, OnRecord
from service.live.live_values import LiveTask
from service.scene_manager.status import (
    CoverageStatus,
    PictureSpec,
    SceneContents,
    SceneReadiness,
    SceneStatus,
    StoredScene,
)
from service.types import SceneInfo

SetUp = Callable[[EmbeddedEngine], None]
"""Is pickled, and called in the child before its engine starts."""
_SPAWN = multiprocessing.get_context("spawn")


def no_set_up(engine: EmbeddedEngine) -> None: ...


@dataclass
class _Call:
    name: str
    arguments: tuple
    number: int = 0
    messages: SimpleQueue = field(default_factory=SimpleQueue)
    """("record", ...), ("frame?", None) or ("answer", ...), any number; then ("value", ...) or ("error", ...)."""


class SubprocessEngine:
    """Implements `Engine`."""

    def __init__(self, config: EngineConfig, set_up: SetUp = no_set_up) -> None:
        self._config, self._set_up = config, set_up
        self._scenes: dict[str, tuple[StoredScene, bool]] = {}
        self._calls: dict[int, _Call] = {}
        self._count = 0
        self._lock = threading.RLock()
        self._closed = False
        self._pipe: Connection | None = None

    def start(self) -> None:
        with self._lock:
            self._pipe, theirs = _SPAWN.Pipe()
            self.child = _SPAWN.Process(target=_run, args=(theirs, self._config, self._set_up), daemon=True)
            self.child.start()
            theirs.close()
            threading.Thread(target=self._receive, args=(self._pipe,), daemon=True).start()
            for scene, required in self._scenes.values():
                self._send(_Call("add", (scene, required)))
            self._send(_Call("start", ()))

    def close(self) -> None:
        with self._lock:
            self._closed = True
            if self._pipe is None:
                return
            self._pipe.send(None)  # to close it would not wake the thread that reads it, nor the child
        self.child.join(5)
        self.child.terminate()

    # ------------------------------------------------------------------ scenes

    def add(self, scene: StoredScene, *, required: bool = False) -> None:
        with self._lock:
            self._scenes[scene.id] = scene, required
            if self._pipe is not None:
                self._ask("add", scene, required)

    def remove(self, scene_id: str) -> None:
        self._ask("remove", scene_id)
        self._scenes.pop(scene_id, None)

    def scenes(self) -> list[SceneStatus]:
        return self._ask("scenes")

    def scene(self, scene_id: str | None) -> SceneStatus:
        return self._ask("scene", scene_id)

    def contents(self, scene_id: str) -> SceneContents | None:
        return self._ask("contents", scene_id)

    def require(self, scene_id: str) -> SceneInfo:
        return self._ask("require", scene_id)

    def readiness(self) -> SceneReadiness:
        return self._ask("readiness")

    def load(self, scene_id: str) -> SceneStatus:
        return self._ask("load", scene_id)

    def unload(self, scene_id: str) -> SceneStatus:
        return self._ask("unload", scene_id)

    def hold(self, asked: str | Sequence[str] | None) -> HeldScenes:
        return self._ask("hold", asked)

    def hold_later(
        self, asked: str | Sequence[str] | None, take: Callable[[HeldScenes | SplatfixError], object]
    ) -> None:
        def wait() -> None:
            while not self._closed:
                try:
                    take(self._ask("hold_later", asked))
                except _ChildGone:
                    continue
                return

        threading.Thread(target=wait, daemon=True).start()

    def release(self, token: str) -> None:
        self._ask("release", token)

    # ------------------------------------------------------------------ work

    def localize(self, task: LocalizeTask, on_record: OnRecord) -> EngineAnswer:
        try:
            return self._ask("localize", task, on_record=on_record)
        except _ChildGone as error:
            raise EngineLost from error
        except BaseException:
            self.cancel(task.id)  # it may be `on_record` that failed
            raise

    def cancel(self, task_id: str) -> None:
        self._ask("cancel", task_id)

    def live(self, task: LiveTask, next_frame: NextFrame, on_answer: OnAnswer) -> None:
        call = self._send(_Call("live", (task,)))
        try:
            while True:
                kind, value = call.messages.get()
                if kind == "frame?":
                    self._give(call.number, next_frame())
                elif kind == "answer":
                    on_answer(value)
                elif kind == "error":
                    raise value
                else:
                    return
        except _ChildGone as error:
            raise EngineLost from error
        except BaseException:
            self._give(call.number, None)  # it may be a callback that failed: the session ends
            raise

    def render(self, scene_id: str, picture: PictureSpec) -> bytes:
        return self._ask("render", scene_id, picture)

    def thumbnail(self, scene_id: str) -> bytes:
        return self._ask("thumbnail", scene_id)

    def splats(self, scene_id: str, limit: int) -> bytes:
        return self._ask("splats", scene_id, limit)

    def coverage(self, scene_id: str) -> CoverageStatus:
        return self._ask("coverage", scene_id)

    def measure_coverage(self, scene_id: str) -> CoverageStatus:
        return self._ask("measure_coverage", scene_id)

    def cancel_coverage(self, scene_id: str) -> CoverageStatus:
        return self._ask("cancel_coverage", scene_id)

    # ------------------------------------------------------------------ the pipe

    def _ask(self, name: str, *arguments: Any, on_record: OnRecord | None = None) -> Any:
        call = self._send(_Call(name, arguments))
        while True:
            kind, value = call.messages.get()
            if kind == "error":
                raise value
            if kind == "value":
                return value
            assert on_record
            on_record(*value)

    def _send(self, call: _Call) -> _Call:
        with self._lock:
            self._count += 1
            call.number = self._count
            self._calls[call.number] = call
            try:
                assert self._pipe is not None
                self._pipe.send((call.number, call.name, call.arguments))
            except OSError:  # the child is gone; `_receive` ends all its calls
                if self._closed:
                    call.messages.put(("error", _gone()))
        return call

    def _give(self, number: int, frame: Any) -> None:
        with self._lock, suppress(OSError):  # a child that is gone needs no frame
            assert self._pipe is not None
            self._pipe.send((number, "frame", (frame,)))

    def _receive(self, pipe: Connection) -> None:
        while True:
            try:
                number, kind, value = pipe.recv()
            except (EOFError, OSError):
                break
            if kind in ("record", "frame?", "answer"):
                self._calls[number].messages.put((kind, value))
            else:
                self._calls.pop(number).messages.put((kind, value))
        with self._lock:
            calls, self._calls = self._calls, {}
            if not self._closed:
                self.start()
        for call in calls.values():
            call.messages.put(("error", _gone()))


class _ChildGone(SceneNotReady): ...


def _gone() -> _ChildGone:
    return _ChildGone("the engine's process ended; another one is started.", where="scene")


def _run(pipe: Connection, config: EngineConfig, set_up: SetUp) -> None:
    """Answer calls until the other end of the pipe is closed."""
    engine, lock = EmbeddedEngine(config), threading.Lock()
    set_up(engine)

    def send(*message: Any) -> None:
        with lock:
            pipe.send(message)

    frames: dict[int, SimpleQueue] = {}

    def next_frame(number: int) -> Any:
        send(number, "frame?", None)
        return frames[number].get()

    def answer(number: int, name: str, arguments: tuple) -> None:
        try:
            if name == "localize":
                value = engine.localize(*arguments, lambda *record: send(number, "record", record))
            elif name == "live":
                on_answer = partial(send, number, "answer")
                value = engine.live(*arguments, partial(next_frame, number), on_answer)
            elif name == "hold_later":
                engine.hold_later(*arguments, lambda found: send(number, "value", found))
                return
            elif name == "add":
                value = engine.add(arguments[0], required=arguments[1])
            else:
                value = getattr(engine, name)(*arguments)
            send(number, "value", value)
        except Exception as error:
            send(number, "error", _portable(error))

    while True:
        try:
            call = pipe.recv()
        except (EOFError, OSError):
            break
        if call is None:
            break
        if call[1] == "frame":
            frames[call[0]].put(*call[2])
        elif call[1] in ("add", "start", "cancel"):
            answer(*call)  # in their order
        else:
            if call[1] == "live":
                frames[call[0]] = SimpleQueue()
            threading.Thread(target=answer, args=call, daemon=True).start()
    engine.close()


def _portable(error: Exception) -> Exception:
    """Return what survives pickling: the error, or one of the same text."""
    try:
        return pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")


def main() -> None:
    """Serve scenes with this engine: python tests/subprocess_engine.py PORT SCENE..."""
    import sys

    import uvicorn

    from service.web.app import create_app
    from service.web.settings import Settings

    served = Settings(port=int(sys.argv[1]), scenes=[Path(path) for path in sys.argv[2:]])
    uvicorn.run(create_app(served, SubprocessEngine(served.engine_config)), port=served.port, ws="websockets-sansio")


if __name__ == "__main__":
    main()
