"""Who has which scenes among replicas, and who uses them: one for all fronts of a fleet. Knows no Ray.

Everything happens on one event loop, so that no lock is needed: whatever is looked at holds until the next `await`.
Each load is one task that all who need the scene wait for; it goes on if they leave, and nothing of it is left if it
fails.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from service.errors import Failure, SplatfixError
from service.jobs.engine import HeldScenes
from service.jobs.fleet_scenes import FleetScene, FleetScenes
from service.jobs.placement import Choice, Placement, PlacementConfig
from service.jobs.scene_holds import HeldAt, Hold, SceneHolds
from service.scene_manager.scene_errors import scene_in_use, scene_not_ready, scene_without_file
from service.scene_manager.status import AUTO, SceneNote, SceneReadiness, SceneStatus, StoredScene

_log = logging.getLogger(__name__)

_WATCH_S = 1.0


class ReplicaLost(Exception):
    """A replica ended while it was asked."""


class SceneCoordinator:
    """`spawn` starts a replica and returns its handle; `expected_bytes` estimates what a stored scene will take."""

    def __init__(
        self,
        spawn: Callable[[], Any],
        lost: tuple[type[Exception], ...],
        config: PlacementConfig,
        expected_bytes: Callable[[StoredScene], int],
    ) -> None:
        """`lost` are the errors of a call to a replica that is gone."""
        self._spawn, self._lost, self._expected_bytes = spawn, lost, expected_bytes
        self._placement = Placement(config)
        self._replicas: dict[str, Any] = {}
        self._starting: set[asyncio.Task[None]] = set()
        self._scenes = FleetScenes(self._placement, config.budget_bytes)
        self._holds = SceneHolds()
        self._changed = asyncio.Event()
        self._tasks: set[asyncio.Task[Any]] = set()

    # ------------------------------------------------------------------ replicas

    async def start(self, count: int) -> None:
        """Start replicas, up to so many, and load the scenes that are required; return when the replicas answer."""
        if not self._tasks:
            self._in_background(self._watch())
        # Those that start count, too: another front may have asked, and more than there are cores for never start.
        for _ in range(count - len(self._replicas) - len(self._starting)):
            self._start_in_background(self._start_replica())
        await asyncio.gather(*map(asyncio.shield, self._starting))
        for scene_id, scene in self._scenes.items():
            if scene.required and scene.awaited:
                self._in_background(self._preload(scene_id))

    def _start_in_background(self, start: Coroutine[Any, Any, None]) -> None:
        task = self._in_background(start)
        self._starting.add(task)
        task.add_done_callback(self._starting.discard)

    async def _start_replica(self) -> None:
        # Fronts keep handles by these names, also of a coordinator before this one.
        name, handle = secrets.token_hex(4), self._spawn()
        built_in = await handle.built_in.remote()
        self._replicas[name] = handle
        self._placement.add_replica(name)
        for status in built_in:
            self._scenes.setdefault(status.id, FleetScene(None))
            self._placement.loaded(name, status.id, status.memory_bytes or 0, pinned=True)
        self._notify()

    async def _watch(self) -> None:
        """Find out which replicas and fronts are gone."""
        while True:
            await asyncio.sleep(_WATCH_S)
            for name, handle in list(self._replicas.items()):
                with suppress(ReplicaLost):
                    await self._asked(name, handle.ping.remote())
            for front, tokens in self._holds.ended_fronts().items():
                _log.warning("front %s has ended: the scenes that it used are released", front)
                for token in tokens:
                    await self.release(token)

    async def _asked(self, name: str, answer: Awaitable[Any]) -> Any:
        """Wait for a replica's answer. Raises ReplicaLost, after another was started in its place."""
        try:
            return await answer
        except self._lost as error:
            self._replica_lost(name)
            raise ReplicaLost from error

    def _replica_lost(self, name: str) -> None:
        if self._replicas.pop(name, None) is None:
            return
        _log.error("replica %s ended", name)
        self._placement.remove_replica(name)
        self._holds.forget_replica(name)
        self._start_in_background(self._start_again())
        self._notify()

    async def _start_again(self) -> None:
        while True:
            try:
                await self._start_replica()
                return
            except self._lost as error:
                _log.error("a replica can't be started: %s", error)
                await asyncio.sleep(_WATCH_S)

    async def heard(self, front: str) -> dict[str, int]:
        """Note that a front is alive; return each replica's jobs."""
        self._holds.heard(front)
        return {name: self._placement.jobs(name) for name in self._placement.replicas()}

    # ------------------------------------------------------------------ the list of scenes

    async def add(self, stored: StoredScene, required: bool) -> None:
        """Make a scene known; one that is known already, from the same place, stays as it is."""
        known = self._scenes.get(stored.id)
        if known and known.stored == stored:
            return
        if known:
            await self._drop_copies(stored.id)
        self._placement.forget(stored.id)
        self._placement.expect(stored.id, self._expected_bytes(stored))
        self._scenes[stored.id] = FleetScene(stored, required, awaited=required)

    async def remove(self, scene_id: str) -> None:
        """Forget a scene. Raises SceneNotFound, SceneInUse."""
        self._scenes.named(scene_id)
        if jobs := self._holds.jobs(scene_id):
            raise scene_in_use(jobs)
        del self._scenes[scene_id]
        await self._drop_copies(scene_id)
        self._notify()

    async def unload(self, scene_id: str) -> SceneStatus:
        """Drop a scene as soon as no job uses it. Raises SceneNotFound, BadInput."""
        scene = self._scenes.named(scene_id)
        if scene.stored is None:
            raise scene_without_file()
        scene.wanted = scene.awaited = False
        await self._drop_copies(scene_id)
        self._notify()
        return await self.scene(scene_id)

    async def load(self, scene_id: str) -> SceneStatus:
        """Begin to load a scene. Raises SceneNotFound."""
        scene = self._scenes.named(scene_id)
        scene.wanted, scene.error = True, None
        self._in_background(self._preload(scene_id))
        # Lets the load begin, so that the state that is returned shows it.
        await asyncio.sleep(0)
        return await self.scene(scene_id)

    async def scenes(self) -> list[SceneStatus]:
        """Return all scenes with their states, as they are now: one may be deleted while the others are asked."""
        return list(await asyncio.gather(*(self._status(*known) for known in list(self._scenes.items()))))

    async def scene(self, scene_id: str | None) -> SceneStatus:
        """Return a scene; None: the only one. Raises SceneNotFound."""
        scene = self._scenes.named(scene_id)
        return await self._status(next(name for name, other in self._scenes.items() if other is scene), scene)

    async def _status(self, scene_id: str, scene: FleetScene) -> SceneStatus:
        copies, jobs = self._placement.copies(scene_id), self._holds.jobs(scene_id)
        uploaded = scene.stored is not None and scene.stored.uploaded
        ready = [name for name, copy in copies.items() if copy.ready]
        if ready:
            # A copy may go while it is asked: then the scene is described without one.
            with suppress(ReplicaLost, SplatfixError):
                status = await self._asked(ready[0], self._replicas[ready[0]].ask.remote("scene", scene_id))
                total = sum(copy.bytes for copy in copies.values())
                state = status.state if scene.wanted else "unloading"
                return replace(status, state=state, jobs=jobs, uploaded=uploaded, memory_bytes=total)
        failure = Failure.of(scene.error) if scene.error else None
        state = "loading" if copies or scene.awaited else "failed" if scene.error else "unloaded"
        return SceneStatus(scene_id, state, jobs, uploaded, failure)

    async def readiness(self) -> SceneReadiness:
        """Return whether the scenes that are required are in memory, and what failed."""
        found = []
        for name, handle in list(self._replicas.items()):
            with suppress(ReplicaLost):
                found.append(await self._asked(name, handle.readiness.remote()))
        pending = tuple(SceneNote(i, "loading") for i, s in self._scenes.items() if s.required and s.awaited)
        failed = [SceneNote(i, str(s.error)) for i, s in self._scenes.items() if s.error]
        usable = any(scene.wanted and scene.error is None for scene in self._scenes.values())
        return SceneReadiness(
            ready=usable and not pending and bool(self._placement.replicas()),
            pending=pending,
            failed=tuple(dict.fromkeys([*failed, *(note for each in found for note in each.failed)])),
            rasterizers=tuple(sorted({name for each in found for name in each.rasterizers})),
            skipped_rasterizers=tuple(sorted({name for each in found for name in each.skipped_rasterizers})),
        )

    # ------------------------------------------------------------------ use

    async def where(self, scene_id: str) -> Any:
        """Return the handle of a replica with the scene. Raises SceneError, and has it loaded if it may be."""
        self._scenes.require_usable(scene_id)
        copies = self._placement.copies(scene_id)
        ready = [name for name, copy in copies.items() if copy.ready]
        if ready:
            return self._replicas[min(ready, key=self._placement.jobs)]
        if not copies:
            self._in_background(self._preload(scene_id))
        raise scene_not_ready(scene_id, "loading")

    async def handle(self, name: str) -> Any:
        """Return the handle of a replica; None if it has ended."""
        return self._replicas.get(name)

    async def hold(self, front: str, asked: str | Sequence[str] | None) -> HeldAt:
        """Hold scenes that are in memory together. Raises SceneError; SceneNotReady where one has to be loaded.

        Their replica isn't told: it holds them as soon as it is asked to work with them.
        """
        ids, left_out = self._scenes.chosen(asked)
        for scene_id in ids:
            self._scenes.require_usable(scene_id)
        choice = self._placement.choose(ids)
        if choice is not None and self._all_ready(choice, ids):
            if background_rgb := self._scenes[ids[0]].background_rgb:
                token = self._take(choice, ids)
                self._holds.record(token, Hold(front, choice.replica, ids))
                return HeldAt(HeldScenes(token, ids, background_rgb, left_out), choice.replica)
            with suppress(ReplicaLost):  # it was never held
                return await self._hold_at(front, choice, ids, left_out)
        for scene_id in ids:
            if not self._placement.copies(scene_id):
                self._in_background(self._preload(scene_id))
        raise scene_not_ready(ids[0], "loading")

    async def hold_later(self, front: str, asked: str | Sequence[str] | None) -> HeldAt:
        """Hold scenes as soon as all are in memory together. Raises SceneError if they won't be."""
        while True:
            # Anew after each change: `auto` names other scenes then.
            ids, left_out = self._scenes.chosen(asked)
            if asked != AUTO:
                for scene_id in ids:
                    self._scenes.require_usable(scene_id)
            choice = self._placement.choose(ids)
            if choice is None:  # all is in use, or a replica has to start first
                await self._changed.wait()
                continue
            try:
                return await self._hold_at(front, choice, ids, left_out)
            except ReplicaLost:
                continue
            except SplatfixError:
                if asked != AUTO:
                    raise  # `auto` goes on without the scene that failed

    async def release(self, token: str) -> None:
        """Let go of scenes; without effect on a token that isn't known."""
        hold = self._holds.pop(token, None)
        if hold is None:
            return
        self._placement.release(hold.replica, hold.ids)
        if handle := self._replicas.get(hold.replica):
            with suppress(ReplicaLost):
                for status in await self._asked(hold.replica, handle.release.remote(token, hold.ids)):
                    self._note_size(hold.replica, status)
        for scene_id in hold.ids:
            scene = self._scenes.get(scene_id)
            if scene is None or not scene.wanted:
                await self._drop_copies(scene_id)
        self._notify()

    async def _hold_at(self, front: str, choice: Choice, ids: tuple[str, ...], left_out: tuple[str, ...]) -> HeldAt:
        """Carry out a choice: drop, load, hold."""
        # Taken and sent here, not in the task: nobody else may choose in between.
        token = self._take(choice, ids)
        stored = [scene.stored for scene in map(self._scenes.__getitem__, ids) if scene.stored]
        call = self._replicas[choice.replica].hold.remote(token, choice.drop, stored, ids)
        task = self._in_background(self._finish_hold(token, Hold(front, choice.replica, ids), call))
        try:
            # Shielded: who leaves must not cancel a load that others wait for.
            held = await asyncio.shield(task)
        except asyncio.CancelledError:
            task.add_done_callback(self._release_unwanted)
            raise
        return HeldAt(replace(held, left_out=left_out), choice.replica)

    def _take(self, choice: Choice, ids: tuple[str, ...]) -> str:
        """Note that scenes are used as was chosen, and have crowded ones copied; return a new token."""
        self._placement.take(choice, ids)
        for scene_id in ids:
            if extra := self._placement.extra_copy(scene_id):
                self._in_background(self._copy(extra, scene_id))
        return secrets.token_hex(8)

    async def _copy(self, extra: Choice, scene_id: str) -> None:
        """Load another copy of a scene, beside the jobs."""
        with suppress(ReplicaLost, SplatfixError):
            held = await self._hold_at("", extra, (scene_id,), ())
            await self.release(held.held.token)

    async def _finish_hold(self, token: str, hold: Hold, call: Awaitable[Any]) -> HeldScenes:
        """Put on record what became of a call to hold scenes. Raises why they can't be held, and ReplicaLost."""
        try:
            found, statuses = await self._asked(hold.replica, call)
            for status in statuses:
                self._note_loaded(hold.replica, status, found)
            if isinstance(found, Exception):
                self._placement.release(hold.replica, hold.ids)
                raise found
            if scene := self._scenes.get(hold.ids[0]):
                scene.background_rgb = found.background_rgb
            self._holds.record(token, hold)
            return found
        finally:
            self._notify()

    def _note_size(self, name: str, status: SceneStatus) -> None:
        """Note what a scene in memory takes, which grows while it is prepared."""
        copy = self._placement.copies(status.id).get(name)
        if copy and copy.ready:  # it may have been dropped since the replica answered
            self._note_loaded(name, status, None)

    def _note_loaded(self, name: str, status: SceneStatus, found: HeldScenes | Exception | None) -> None:
        scene = self._scenes.get(status.id)
        if status.memory_bytes is not None and status.state in ("preparing", "ready"):
            over = self._placement.loaded(name, status.id, status.memory_bytes, pinned=not (scene and scene.stored))
            if over:
                self._replicas[name].drop.remote(over)
            if scene:
                scene.loaded()
        elif isinstance(found, Exception):
            self._placement.dropped(name, status.id)
            if scene:
                scene.failed(found)

    def _release_unwanted(self, task: asyncio.Task[HeldScenes]) -> None:
        if not task.cancelled() and task.exception() is None:
            self._in_background(self.release(task.result().token))

    # ------------------------------------------------------------------ loads

    def _all_ready(self, choice: Choice, ids: Sequence[str]) -> bool:
        copies = self._placement.scenes(choice.replica)
        return all(scene_id in copies and copies[scene_id].ready for scene_id in ids)

    async def _preload(self, scene_id: str) -> None:
        """Load and prepare a scene that no job waits for; without effect if that isn't possible."""
        try:
            held = await self.hold_later("", scene_id)
            if handle := self._replicas.get(held.replica):
                with suppress(ReplicaLost):
                    await self._asked(held.replica, handle.prepared.remote(scene_id))
            await self.release(held.held.token)
        finally:
            if scene := self._scenes.get(scene_id):
                scene.awaited = False

    async def _drop_copies(self, scene_id: str) -> None:
        """Drop a scene wherever no job uses it; the other copies go when they are released."""
        for name, copy in self._placement.copies(scene_id).items():
            if copy.ready and not copy.uses:
                self._placement.dropped(name, scene_id)
                with suppress(ReplicaLost):
                    await self._asked(name, self._replicas[name].drop.remote((scene_id,)))

    # ------------------------------------------------------------------ tasks

    def _in_background(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # the loop itself keeps no reference

        def ended(task: asyncio.Task[Any]) -> None:
            self._tasks.discard(task)
            if not task.cancelled():
                task.exception()  # whoever waits has it

        task.add_done_callback(ended)
        return task

    def _notify(self) -> None:
        self._changed.set()
        # Another one: who waits for the next change must not be woken by this.
        self._changed = asyncio.Event()
