"""The scenes of a running process: loaded in the background, shared by all jobs, and dropped when memory is short.

    unloaded -> loading -> preparing -> ready -> (unloading ->) unloaded
                   `-----------`-> failed

A scene that was dropped for want of memory, or isn't in the preload list, is loaded when it is asked for; one that
was unloaded by request stays unloaded until a request loads it.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from service.errors import (
    BadInput,
    Failure,
    SceneInUse,
    SceneMemoryFull,
    SceneNotFound,
    SceneNotReady,
    SceneUnloaded,
    SplatfixError,
)
from service.localize import DEFAULT_MATCHER, LoadedScene
from service.scene_manager.status import AUTO, SceneContents, SceneReadiness, SceneState, SceneStatus
from service.scene_manager.warm_up import warm_up
from service.scene_origin import shifted_camera

_log = logging.getLogger(__name__)

_GRACE_S = 5.0


@dataclass(slots=True)
class Entry:
    """One scene, the state of loading it, and who uses it."""

    id: str
    path: Path | None
    """None: it was given in memory, and can't be loaded again."""
    state: SceneState = "unloaded"
    loaded: LoadedScene | None = None
    error: Exception | None = None
    wanted: bool = True
    """Load it when it is asked for."""
    required: bool = False
    """The service isn't ready without it."""
    uploaded: bool = False
    """It came over HTTP, and may be deleted."""
    jobs: int = 0
    """That use it, waiting or running: while there are any it stays."""
    used: float = 0.0
    """When it was last asked for, on the monotonic clock."""
    waiting: list[Callable[[], object]] = field(default_factory=list)
    """To call when it is loaded, or failed to."""

    def status(self) -> SceneStatus:
        """Return the scene's state, and its contents if it is loaded."""
        failure = Failure.of(self.error) if self.error else None
        loaded = self.loaded
        if loaded is None:
            return SceneStatus(self.id, self.state, self.jobs, self.uploaded, failure)
        scene = loaded.scene
        return SceneStatus(
            self.id,
            self.state,
            self.jobs,
            self.uploaded,
            failure,
            info=scene.info,
            gaussians=scene.count,
            sh_degree=scene.sh_degree,
            cameras=len(scene.cameras),
            memory_bytes=loaded.nbytes,
        )


class Scenes:
    """All scenes of the process. Safe to use from several threads."""

    def __init__(
        self,
        estimator: str,
        cache_dir: Path | None,
        *,
        matcher: str = DEFAULT_MATCHER,
        rasterizer: str | None = None,
        memory_bytes: int | None = None,
    ) -> None:
        """`estimator` is the one that scenes are prepared for; `memory_bytes` limits them all together."""
        self._estimator, self._matcher, self._rasterizer = estimator, matcher, rasterizer
        self._cache_dir, self._memory_bytes = cache_dir, memory_bytes
        self._entries: dict[str, Entry] = {}
        # Reentrant: methods that hold it call others that take it.
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._tasks: queue.SimpleQueue[Entry | None] = queue.SimpleQueue()
        # One thread: scenes that were loaded at once would need their peak memory at once.
        self._thread = threading.Thread(target=self._work, name="scenes", daemon=True)

    def start(self) -> None:
        """Start the loading thread, and load the scenes that the service needs."""
        self._thread.start()
        for entry in self.entries():
            if entry.required:
                self._request(entry)

    def close(self) -> None:
        """Stop loading, between two scenes; return then, or soon anyway."""
        self._stop.set()
        self._tasks.put(None)
        if self._thread.is_alive():
            self._thread.join(_GRACE_S)

    # ------------------------------------------------------------------ the list

    def entries(self) -> list[Entry]:
        """Return all scenes, in memory or not."""
        with self._lock:
            return list(self._entries.values())

    def entry(self, scene_id: str | None) -> Entry:
        """Return a scene; None: the only one. Raises SceneNotFound, which names the scenes that are there."""
        with self._lock:
            known = ", ".join(self._entries) or "none"
            if scene_id is None and len(self._entries) == 1:
                return next(iter(self._entries.values()))
            if scene_id is None:
                raise SceneNotFound(f"name a scene; known: {known}.", where="scene")
            if scene_id not in self._entries:
                raise SceneNotFound(f"unknown scene '{scene_id}'; known: {known}.", where="scene")
            return self._entries[scene_id]

    def add(self, entry: Entry) -> None:
        """Add a scene without loading it; in the place of another of that name."""
        with self._lock:
            self._entries[entry.id] = entry

    def remove(self, scene_id: str) -> None:
        """Take a scene out of the list. Raises SceneNotFound, SceneInUse."""
        with self._lock:
            entry = self.entry(scene_id)
            if entry.jobs:
                raise SceneInUse(
                    f"{entry.jobs} jobs use the scene.", where="scene", hint="Unload it, and wait for them."
                )
            del self._entries[scene_id]
            entry.wanted = False

    def contents(self, scene_id: str) -> SceneContents | None:
        """Summarize a scene; None while it isn't in memory. Raises SceneNotFound."""
        loaded = self.entry(scene_id).loaded
        if loaded is None:
            return None
        scene = loaded.scene
        origin = scene.info.origin_in_world
        bounds = np.quantile(scene.means, [0.01, 0.99], axis=0) + origin if scene.count else None
        return SceneContents(tuple(shifted_camera(named, origin) for named in scene.cameras), bounds)

    # ------------------------------------------------------------------ use

    def get(self, scene_id: str | None) -> LoadedScene:
        """Return a scene in memory. Raises SceneError: also why it failed to load."""
        entry = self.entry(scene_id)
        with self._lock:
            # Also while it is loading: who is waited for is not the next to be dropped.
            entry.used = time.monotonic()
            # Not loaded again by each request: a broken file would be read again and again.
            if entry.error:
                raise entry.error
            if entry.loaded is not None and entry.state != "unloading":
                return entry.loaded
            if not entry.wanted:
                raise SceneUnloaded(
                    f"scene '{entry.id}' was unloaded.", where="scene", hint=f"Load it: POST /scenes/{entry.id}/load."
                )
            if entry.state == "unloaded":
                self._request(entry)
        raise SceneNotReady(f"scene '{entry.id}' is {entry.state}.", where="scene", hint="Try again later.")

    def chosen(self, asked: str | Sequence[str] | None) -> list[str]:
        """Return the ids of the scenes that a request names: one, several, or all that are ready (`auto`).

        Raises SceneNotFound, SceneNotReady.
        """
        if asked == AUTO:
            ready = [entry.id for entry in self.entries() if entry.state == "ready"]
            if not ready:
                raise SceneNotReady("no scene is ready.", where="scene", hint="Try again later.")
            return ready
        if asked is None or isinstance(asked, str):
            return [self.entry(asked).id]
        # A scene that is named twice is searched once.
        return list(dict.fromkeys(self.entry(scene_id).id for scene_id in asked))

    def acquire(self, ids: Sequence[str]) -> tuple[LoadedScene, ...]:
        """Return scenes that stay in memory until they are released as often. Raises SceneError."""
        with self._lock:
            # All or none: if one is missing, nothing is counted as used.
            loaded = tuple(self.get(scene_id) for scene_id in ids)
            for scene_id in ids:
                self.entry(scene_id).jobs += 1
            return loaded

    def id_of(self, loaded: LoadedScene) -> str | None:
        """Return the name under which a scene is served; None if it was removed meanwhile."""
        return next((entry.id for entry in self.entries() if entry.loaded is loaded), None)

    def release(self, held: Collection[LoadedScene]) -> None:
        """Give back scenes that a job held; one that is to be unloaded goes with its last job."""
        with self._lock:
            for entry in self._entries.values():
                # By identity: the scene of that name may have been replaced meanwhile.
                if any(entry.loaded is loaded for loaded in held):
                    entry.jobs -= 1
                    if entry.state == "unloading" and not entry.jobs:
                        _drop(entry)

    def load(self, entry: Entry) -> None:
        """Load a scene, if it isn't there; also one that failed to load."""
        with self._lock:
            entry.wanted = True
            if entry.state in ("unloaded", "failed"):
                self._request(entry)
            elif entry.state == "unloading":
                entry.state = "ready"

    def unload(self, entry: Entry) -> None:
        """Drop a scene from memory as soon as no job uses it; none may start to. Raises BadInput."""
        if entry.path is None:
            raise BadInput("the scene has no file to reload it from.", where="scene")
        with self._lock:
            entry.wanted = False
            if entry.state == "ready":
                entry.state = "unloading"
            if entry.state == "unloading" and not entry.jobs:
                _drop(entry)

    def when_settled(self, scene_id: str, do: Callable[[], object]) -> None:
        """Call `do` as soon as the scene is in memory, or certain not to come there."""
        with self._lock:
            entry = self._entries.get(scene_id)
            if entry is not None and entry.loaded is None and entry.error is None:
                entry.waiting.append(do)
                if entry.state == "unloaded":
                    self._request(entry)
                return
        do()

    def readiness(self) -> SceneReadiness:
        """Return whether photos can be localized, what is still loading, and what failed."""
        entries = self.entries()
        pending = [f"scene {e.id}: {e.state}" for e in entries if e.required and e.state in _UNDER_WAY]
        failed = [f"scene {e.id}: {e.error}" for e in entries if e.state == "failed"]
        usable = any(e.state == "ready" or (e.state == "unloaded" and e.wanted) for e in entries)
        loaded = [e.loaded for e in entries if e.loaded]
        return SceneReadiness(
            ready=usable and not pending,
            pending=tuple(pending),
            failed=tuple(failed),
            rasterizers=tuple(sorted({scene.rasterizer.name for scene in loaded})),
            skipped_rasterizers=tuple(sorted({scene.skipped_rasterizers for scene in loaded} - {""})),
        )

    # ------------------------------------------------------------------ on the loading thread

    def _request(self, entry: Entry) -> None:
        entry.error, entry.state = None, "loading" if entry.loaded is None else "preparing"
        self._tasks.put(entry)

    def _work(self) -> None:
        while (entry := self._tasks.get()) is not None:
            try:
                self._load(entry)
            except Exception as error:  # one bad scene must not take the others with it
                if self._stop.is_set():
                    return
                unexpected = not isinstance(error, SplatfixError)
                _log.error("scene %s can't be used: %s", entry.id, error, exc_info=unexpected)
                if isinstance(error, SplatfixError) and entry.path:  # clients must not learn the operator's folders
                    error.where = error.where.replace(str(entry.path), entry.id)
                entry.error, entry.state = error, "failed"
            self._settle(entry)

    def _load(self, entry: Entry) -> None:
        if entry.loaded is None and entry.path is not None:
            tools = {"matcher": self._matcher, "rasterizer": self._rasterizer}
            loaded = LoadedScene.load(entry.path, cache_dir=self._cache_dir, **tools)
            # Only now is its size known; for a moment it is in memory beyond the limit.
            self._make_room(entry, loaded.nbytes)
            entry.loaded, entry.state = loaded, "preparing"
            self._settle(entry)
        if entry.loaded is not None and not self._stop.is_set():
            entry.loaded.prepare(self._estimator)
            # Compiles and loads what the first photo would wait for.
            warm_up(entry.loaded, self._estimator)
        with self._lock:
            entry.state = "ready"
            if not entry.wanted:  # unloaded in the meantime
                self.unload(entry)

    def _make_room(self, entry: Entry, needed: int) -> None:
        """Drop the least recently used scenes until another one fits. Raises SceneMemoryFull."""
        if self._memory_bytes is None:
            return
        with self._lock:
            there = [e for e in self._entries.values() if e.loaded and e is not entry]
            total = sum(e.loaded.nbytes for e in there if e.loaded)
            # A scene without a file could not be loaded again.
            idle = [e for e in there if e.state == "ready" and not e.jobs and e.path]
            for other in sorted(idle, key=lambda e: e.used):
                if total + needed <= self._memory_bytes:
                    return
                total -= other.loaded.nbytes if other.loaded else 0
                _log.info("scene %s: dropped to make room for %s", other.id, entry.id)
                _drop(other)
            if total + needed > self._memory_bytes:
                raise SceneMemoryFull(
                    f"scene '{entry.id}' takes {needed / 1e6:.0f} MB, {total / 1e6:.0f} of "
                    f"{self._memory_bytes / 1e6:.0f} MB are in use.",
                    where="scene",
                    hint="Unload another scene, or raise SPLATFIX_SCENE_MEMORY_BYTES.",
                )

    def _settle(self, entry: Entry) -> None:
        with self._lock:
            waiting, entry.waiting = entry.waiting, []
        # Outside of the lock: they submit jobs, which take locks of their own.
        for do in waiting:
            do()


_UNDER_WAY = ("unloaded", "loading", "preparing")


def _drop(entry: Entry) -> None:
    entry.loaded, entry.state = None, "unloaded"
