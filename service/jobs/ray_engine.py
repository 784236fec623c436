"""The engine whose scenes are in other processes, on this or other machines, by Ray, which only this file and
`ray_calls` know.

Actors, not Ray Serve: an attempt, its cancel, a live session's frames and the scenes that are held for it must reach
one certain replica, which Serve's handles choose themselves; where scenes go is decided by `placement`. One actor of
all fronts, the coordinator, has the table and starts the replicas; records come from the replicas directly.
"""

from __future__ import annotations

import logging
import os
import secrets
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

# A call while this process is in no cluster must fail, not start one.
os.environ["RAY_ENABLE_AUTO_CONNECT"] = "0"

import ray  # pyright: ignore[reportMissingImports]
from ray.exceptions import RayActorError, RayError, RayTaskError  # pyright: ignore[reportMissingImports]

from service import __version__
from service.errors import SceneNotFound, SceneNotReady, SplatfixError
from service.jobs.embedded_engine import EngineConfig, with_left_out
from service.jobs.engine import EngineAnswer, EngineLost, HeldScenes, LocalizeTask, NextFrame, OnAnswer, OnRecord
from service.jobs.placement import PlacementConfig
from service.jobs.ray_calls import call, join, leave, send, stream
from service.jobs.ray_config import RayConfig
from service.jobs.replica import Replica, SetUp
from service.jobs.scene_coordinator import SceneCoordinator
from service.jobs.scene_holds import HeldAt
from service.live.live_values import LiveTask
from service.scene_formats.size_estimate import estimated_bytes
from service.scene_manager.status import (
    CoverageStatus,
    PictureSpec,
    SceneContents,
    SceneReadiness,
    SceneStatus,
    StoredScene,
)
from service.types import SceneInfo

_log = logging.getLogger(__name__)

_HEARTBEAT_S = 5.0
_AGAIN_S = 0.5
"""Until who waits for scenes asks again, while the cluster doesn't answer."""
_AT_ONCE = 1000
"""Calls that a coordinator or a replica may have under way: most of them wait."""


class RayEngine:
    """Implements `Engine`. `config.memory_bytes` is the budget of each replica."""

    def __init__(self, config: EngineConfig, ray_config: RayConfig, set_up: SetUp | None = None) -> None:
        self._config, self._ray, self._set_up = config, ray_config, set_up
        self._front = secrets.token_hex(8)
        self._scenes: dict[str, tuple[StoredScene, bool]] = {}
        self._held: dict[str, _Held] = {}
        self._handles: dict[str, Any] = {}
        """Replicas by their names."""
        self._running: dict[str, Any] = {}
        """The replica of each attempt."""
        self._coordinator: Any = None
        self._lock = threading.Lock()
        self._closed = threading.Event()

    # ------------------------------------------------------------------ the cluster

    def start(self) -> None:
        self._join()
        if self._coordinator is not None:
            return
        self._connect()
        threading.Thread(target=self._beat, name="heartbeat", daemon=True).start()

    def _join(self) -> None:
        """Become a part of the cluster, or start one."""
        if self._ray.address:
            where: dict[str, Any] = {"address": self._ray.address}
        else:
            where = {
                "address": "local",
                "num_cpus": max(1, round(self._ray.replicas * self._ray.cpus)),
                "include_dashboard": False,
                # Ray's default is a share of the machine's memory, which scenes need.
                "object_store_memory": 500_000_000,
            }
            if "RAY_AUTH_TOKEN_PATH" not in os.environ:
                # Ray listens on all addresses, and runs whatever it is sent: with a token of this process only.
                os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        # Ray's default, 15, lets replicas wait for all else on the machine.
        os.environ.setdefault("RAY_worker_niceness", "0")
        join(**where, namespace="splatfix", log_to_driver=False, configure_logging=False)

    def _connect(self) -> None:
        """Find the coordinator or start it, with its replicas, and add all scenes to it."""
        replica = ray.remote(Replica).options(
            num_cpus=self._ray.cpus, num_gpus=self._ray.gpus, max_concurrency=_AT_ONCE
        )
        spawn = partial(replica.remote, replace(self._config, memory_bytes=None), self._set_up)
        placed = PlacementConfig(budget_bytes=self._config.memory_bytes)
        # By version: fronts of two releases may run beside each other, each with its own code in the replicas.
        named = ray.remote(SceneCoordinator).options(
            name=f"scenes-{__version__}",
            get_if_exists=True,
            lifetime="detached" if self._ray.address else None,
            # It decides only, and must not take a replica's core.
            num_cpus=0,
            max_concurrency=_AT_ONCE,
        )
        coordinator = named.remote(spawn, (RayActorError,), placed, _expected_bytes)
        for scene, required in tuple(self._scenes.values()):
            call(coordinator, "add", scene, required)
        call(coordinator, "start", self._ray.replicas)
        # Last: jobs that asked it before would hear that their scenes are unknown.
        self._coordinator = coordinator

    def close(self) -> None:
        self._closed.set()
        for token in tuple(self._held):
            with suppress(Exception):
                self.release(token)
        if not self._ray.address:
            leave()

    def _beat(self) -> None:
        while not self._closed.wait(_HEARTBEAT_S):
            try:
                self._ask("heard", self._front)
            except Exception as error:
                _log.warning("Ray: %s", error)

    # ------------------------------------------------------------------ scenes

    def add(self, scene: StoredScene, *, required: bool = False) -> None:
        self._scenes[scene.id] = scene, required
        if self._coordinator is not None:
            self._ask("add", scene, required)

    def remove(self, scene_id: str) -> None:
        try:
            self._ask("remove", scene_id)
        except SceneNotFound:  # another front was first; a new coordinator must not be told of it
            self._scenes.pop(scene_id, None)
            raise
        self._scenes.pop(scene_id, None)

    def scenes(self) -> list[SceneStatus]:
        return self._ask("scenes")

    def scene(self, scene_id: str | None) -> SceneStatus:
        return self._ask("scene", scene_id)

    def contents(self, scene_id: str) -> SceneContents | None:
        return self._ask_replica(scene_id, "contents", scene_id) if self._is_there(scene_id) else None

    def require(self, scene_id: str) -> SceneInfo:
        return self._ask_replica(scene_id, "require", scene_id)

    def readiness(self) -> SceneReadiness:
        return self._ask("readiness")

    def load(self, scene_id: str) -> SceneStatus:
        return self._ask("load", scene_id)

    def unload(self, scene_id: str) -> SceneStatus:
        return self._ask("unload", scene_id)

    def hold(self, asked: str | Sequence[str] | None) -> HeldScenes:
        return self._keep(self._ask("hold", self._front, asked))

    def hold_later(
        self, asked: str | Sequence[str] | None, take: Callable[[HeldScenes | SplatfixError], object]
    ) -> None:
        def wait() -> None:
            while not self._closed.is_set():
                try:
                    take(self._keep(self._ask("hold_later", self._front, asked)))
                except _CoordinatorGone:
                    self._closed.wait(_AGAIN_S)
                    continue
                except SplatfixError as error:
                    take(error)
                except Exception as error:
                    _log.exception("scenes can't be held")
                    take(SceneNotReady(f"the scene can't be loaded: {error}", where="scene"))
                return

        threading.Thread(target=wait, name="hold", daemon=True).start()

    def _keep(self, found: HeldAt) -> HeldScenes:
        self._held[found.held.token] = _Held(found.held, self._handle(found.replica))
        return found.held

    def _handle(self, name: str) -> Any:
        handle = self._handles.get(name) or self._ask("handle", name)
        if handle:
            self._handles[name] = handle
        return handle

    def release(self, token: str) -> None:
        if self._held.pop(token, None):
            # Not waited for: who lets go needs no answer.
            with suppress(Exception):  # of a lost cluster nothing is held
                send(self._coordinator, "release", token)

    def _is_there(self, scene_id: str) -> bool:
        return self.scene(scene_id).memory_bytes is not None

    # ------------------------------------------------------------------ work

    def localize(self, task: LocalizeTask, on_record: OnRecord) -> EngineAnswer:
        held = self._held.get(task.held)
        if held is None:
            raise SceneNotReady("the job's scenes were unloaded.", where="scene")
        if held.replica is None:
            raise EngineLost
        self._running[task.id] = held.replica
        try:
            for records, answer in stream(held.replica.localize, task, held.held):
                for record in records:
                    on_record(*record)
                if answer:
                    return replace(answer, result=with_left_out(answer.result, held.held.left_out))
            raise EngineLost
        except BaseException:
            self.cancel(task.id)  # it may be `on_record` that failed
            raise
        finally:
            self._running.pop(task.id, None)

    def cancel(self, task_id: str) -> None:
        if replica := self._running.get(task_id):
            with suppress(RayError):
                # Waited for: the next record must not overtake it.
                call(replica, "cancel", task_id)

    def live(self, task: LiveTask, next_frame: NextFrame, on_answer: OnAnswer) -> None:
        held = self._held.get(task.held)
        if held is None:
            raise SceneNotReady("the session's scene was unloaded.", where="scene")
        if held.replica is None:
            raise EngineLost
        session = secrets.token_hex(8)
        try:
            for kind, value in stream(held.replica.live, session, task, held.held):
                if kind == "frame?":
                    send(held.replica, "frame", session, next_frame())
                elif kind == "record":
                    on_answer(value)
        except BaseException:
            if self._held.get(task.held) is held:  # it may be a callback that failed: the session ends
                with suppress(EngineLost):
                    send(held.replica, "frame", session, None)
            raise

    def render(self, scene_id: str, picture: PictureSpec) -> bytes:
        return self._ask_replica(scene_id, "render", scene_id, picture)

    def thumbnail(self, scene_id: str) -> bytes:
        return self._ask_replica(scene_id, "thumbnail", scene_id)

    def splats(self, scene_id: str, limit: int) -> bytes:
        return self._ask_replica(scene_id, "splats", scene_id, limit)

    def coverage(self, scene_id: str) -> CoverageStatus:
        if not self._is_there(scene_id):
            return CoverageStatus("none")
        return self._ask_replica(scene_id, "coverage", scene_id)

    def measure_coverage(self, scene_id: str) -> CoverageStatus:
        return self._ask_replica(scene_id, "measure_coverage", scene_id)

    def cancel_coverage(self, scene_id: str) -> CoverageStatus:
        if not self._is_there(scene_id):
            return CoverageStatus("none")
        return self._ask_replica(scene_id, "cancel_coverage", scene_id)

    # ------------------------------------------------------------------ calls

    def _ask(self, name: str, *arguments: Any) -> Any:
        """Call the coordinator. Raises what it raises; _CoordinatorGone where it, or the cluster, doesn't answer: then
        another one is found or started first, if that can be."""
        coordinator = self._coordinator
        try:
            if coordinator is None:
                raise RayError("this process is in no cluster.")
            return call(coordinator, name, *arguments)
        except (RayTaskError, SplatfixError):
            raise
        except RayError as error:
            self._connect_again(coordinator, error)
        raise _CoordinatorGone("the engine is started again.", where="scene", hint="Try again later.") from None

    def _connect_again(self, lost: Any, error: Exception) -> None:
        """Find or start another coordinator than the one that was lost, unless somebody has, or does."""
        if not self._lock.acquire(blocking=False):
            return
        try:
            if self._coordinator is not lost or self._closed.is_set():
                return
            _log.error("the coordinator of scenes ended: %s", error)
            try:
                if lost is not None:
                    self._connect()
                    return
            except RayError as again:
                _log.error("Ray's cluster does not know this process: %s", again)
            # Its head was started again, or is away: the replicas of the cluster before can't be called any more.
            self._coordinator = None
            self._forget_replicas()
            leave()
            self._join()
            self._connect()
        except Exception as again:  # of any kind, where the head is away
            _log.error("Ray's cluster does not answer: %s", again)
        finally:
            self._lock.release()

    def _forget_replicas(self) -> None:
        """Let nobody call the replicas of a cluster that was lost."""
        self._running.clear()
        self._handles.clear()
        self._held = {token: replace(found, replica=None) for token, found in self._held.items()}

    def _ask_replica(self, scene_id: str, name: str, *arguments: Any) -> Any:
        """Call the engine of a replica that has a scene: one that is held needs no way over the coordinator."""
        held = [found.replica for found in tuple(self._held.values()) if found.replica and scene_id in found.held.ids]
        for replica in held[-1:]:
            with suppress(_ReplicaGone):
                return self._call_replica(replica, name, *arguments)
        return self._call_replica(self._ask("where", scene_id), name, *arguments)

    def _call_replica(self, replica: Any, name: str, *arguments: Any) -> Any:
        """Call the engine of a replica. Raises what it raises, and _ReplicaGone."""
        try:
            return call(replica, "ask", name, *arguments)
        except RayTaskError:
            raise
        except RayError:
            raise _ReplicaGone("the scene's process ended.", where="scene", hint="Try again later.") from None


@dataclass(frozen=True, slots=True)
class _Held:
    held: HeldScenes
    replica: Any
    """Its handle; None once it can't be called any more."""


class _CoordinatorGone(SceneNotReady): ...


class _ReplicaGone(SceneNotReady): ...


def _expected_bytes(scene: StoredScene) -> int:
    return estimated_bytes(scene.path) or 0
