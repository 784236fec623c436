"""The scenes of a running process: loaded in the background, shared by all jobs, and dropped when memory is short.

    unloaded -> loading -> preparing -> ready -> (unloading ->) unloaded
                   `-----------`-> failed -> (a later request) -> loading

A scene that was dropped for want of memory, or isn't in the preload list, is loaded when it is asked for; one that
was unloaded by request stays unloaded until a request loads it. Who needs several scenes at once gets them together:
those that the first one in line waits for are loaded first, and stay.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from service.disk_cache import evict
from service.errors import SceneNotReady, SplatfixError
from service.loaded_scene import DEFAULT_MATCHER, LoadedScene
from service.scene_manager.camera_frame_search import CameraFrameSearch
from service.scene_manager.entry import Entry
from service.scene_manager.memory_limit import MemoryLimit
from service.scene_manager.scene_errors import (
    nothing_to_search,
    scene_in_use,
    scene_not_ready,
    scene_unloaded,
    scene_without_file,
    unknown_scene,
    unnamed_scene,
)
from service.scene_manager.status import AUTO, SceneContents, SceneNote, SceneReadiness
from service.scene_manager.warm_up import warm_up

_log = logging.getLogger(__name__)

_GRACE_S = 5.0


@dataclass(frozen=True, slots=True)
class Acquired:
    """Scenes that stay in memory until they are released."""

    ids: tuple[str, ...]
    scenes: tuple[LoadedScene, ...]
    left_out: tuple[str, ...] = ()
    """Scenes that `auto` doesn't look in, because they are not in memory and don't fit, or failed to load."""


@dataclass(slots=True)
class _Waiting:
    """Who is given scenes as soon as all are in memory."""

    ids: list[str]
    every: bool
    """Each of the scenes is needed; otherwise those that fail are left out."""
    left_out: list[str]
    take: Callable[[Acquired | SplatfixError], object]


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
        cache_bytes: int | None = None,
    ) -> None:
        """`estimator` is the one that scenes are prepared for.

        `memory_bytes` limits all scenes together, `cache_bytes` the folder `cache_dir`.
        """
        self._estimator, self._matcher, self._rasterizer = estimator, matcher, rasterizer
        self._cache_dir, self._cache_bytes = cache_dir, cache_bytes
        self._limit = MemoryLimit(memory_bytes)
        self._entries: dict[str, Entry] = {}
        # Reentrant: methods that hold it call others that take it. Notified when a scene may fit now, or is asked for.
        self._lock = threading.Condition(threading.RLock())
        self._stop = threading.Event()
        self._requested: list[Entry] = []
        self._waiting: list[_Waiting] = []
        # One thread: scenes that were loaded at once would need their peak memory at once.
        self._thread = threading.Thread(target=self._work, name="scenes", daemon=True)
        self._camera_frames = CameraFrameSearch(self._reload)

    def start(self) -> None:
        """Start the loading thread, and load the scenes that the service needs."""
        self._thread.start()
        for entry in self.entries():
            if entry.required:
                self._request(entry)

    def close(self) -> None:
        """Stop loading, between two scenes; return then, or soon anyway."""
        self._stop.set()
        self._camera_frames.close()
        with self._lock:
            self._lock.notify_all()
        if self._thread.is_alive():
            self._thread.join(_GRACE_S)

    # ------------------------------------------------------------------ the list

    def entries(self) -> list[Entry]:
        """Return all scenes, in memory or not."""
        with self._lock:
            return list(self._entries.values())

    def entry(self, scene_id: str | None) -> Entry:
        """Return a scene; None: the only one. Raises SceneNotFound."""
        with self._lock:
            if scene_id is None and len(self._entries) == 1:
                return next(iter(self._entries.values()))
            if scene_id is None:
                raise unnamed_scene()
            if scene_id not in self._entries:
                raise unknown_scene(scene_id)
            return self._entries[scene_id]

    def add(self, entry: Entry) -> None:
        """Add a scene without loading it; in the place of another of that name."""
        with self._lock:
            if replaced := self._entries.get(entry.id):
                self._withdraw(replaced)
            self._entries[entry.id] = entry

    def remove(self, scene_id: str) -> None:
        """Take a scene out of the list. Raises SceneNotFound, SceneInUse."""
        with self._lock:
            entry = self.entry(scene_id)
            if entry.jobs:
                raise scene_in_use(entry.jobs)
            del self._entries[scene_id]
            entry.wanted = False
            self._withdraw(entry)
        self._settle()

    def contents(self, scene_id: str) -> SceneContents | None:
        """Summarize a scene; None while it isn't in memory. Raises SceneNotFound."""
        return self.entry(scene_id).contents()

    # ------------------------------------------------------------------ use

    def get(self, scene_id: str | None) -> LoadedScene:
        """Return a scene in memory. Raises SceneError: also why it failed to load."""
        entry = self.entry(scene_id)
        with self._lock:
            # Also while it is loading: who is waited for is not the next to be dropped.
            entry.used = time.monotonic()
            # Not loaded again by each request: a broken file would be read again and again.
            if entry.error and entry.used < entry.retry_at:
                raise entry.error
            if entry.loaded is not None and entry.state not in ("unloading", "failed"):
                return entry.loaded
            if not entry.wanted:
                raise scene_unloaded(entry.id)
            if entry.state in ("unloaded", "failed"):
                self._request(entry)
        raise scene_not_ready(entry.id, entry.state)

    def acquire(self, asked: str | Sequence[str] | None) -> Acquired:
        """Return scenes that stay in memory until they are released as often: one, several, the only one (None), or
        all that there is memory for (`auto`).

        Raises SceneError; SceneNotReady where one isn't in memory (yet), which has it loaded.
        """
        with self._lock:
            ids, left_out = self._chosen(asked)
            # All or none: if one is missing, nothing is counted as used.
            loaded = [self._or_error(scene_id) for scene_id in ids]
            for found in loaded:
                if isinstance(found, SplatfixError):
                    raise found
            return self._held(ids, left_out)

    def acquire_later(
        self, asked: str | Sequence[str] | None, take: Callable[[Acquired | SplatfixError], object]
    ) -> None:
        """Call `take` once: with the scenes, as soon as all are in memory, or with the reason why they won't be.

        Of `auto` scenes that fail to load are left out.
        """
        try:
            with self._lock:
                ids, left_out = self._chosen(asked)
                self._waiting.append(_Waiting(ids, asked != AUTO, left_out, take))
        except SplatfixError as error:
            take(error)
        self._settle()

    def _chosen(self, asked: str | Sequence[str] | None) -> tuple[list[str], list[str]]:
        """Return the ids of the scenes that a request names, and of those that `auto` leaves out.

        Raises SceneNotFound, SceneTooLarge.
        """
        if asked == AUTO:
            entries = [entry for entry in self.entries() if entry.wanted]
            chosen = [entry.id for entry in self._limit.that_fit(entries)]
            if not chosen:
                raise nothing_to_search()
            return chosen, [entry.id for entry in entries if entry.id not in chosen]
        names = [asked] if asked is None or isinstance(asked, str) else asked
        # A scene that is named twice is searched once.
        found = {entry.id: entry for entry in map(self.entry, names)}
        self._limit.require_together(list(found.values()))
        return list(found), []

    def _or_error(self, scene_id: str) -> LoadedScene | SplatfixError:
        try:
            return self.get(scene_id)
        except SplatfixError as error:
            return error

    def _held(self, ids: Sequence[str], left_out: Sequence[str]) -> Acquired:
        scenes = tuple(self.get(scene_id) for scene_id in ids)
        for scene_id in ids:
            self.entry(scene_id).jobs += 1
        return Acquired(tuple(ids), scenes, tuple(left_out))

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
                    self._drop_or_reload(entry)
            self._lock.notify_all()

    def _drop_or_reload(self, entry: Entry) -> None:
        """Do with a scene that is no longer used what was asked for meanwhile."""
        if entry.state == "unloading":
            self._unload(entry)
        self._reload_outdated(entry)

    def _reload(self, entry: Entry) -> None:
        """Load a scene again whose files have changed, once no job uses it."""
        with self._lock:
            entry.is_outdated = entry.loaded is not None
            self._reload_outdated(entry)

    def _reload_outdated(self, entry: Entry) -> None:
        if entry.is_outdated and entry.is_idle and entry.wanted:
            entry.drop()
            self._request(entry)

    def load(self, entry: Entry) -> None:
        """Load a scene, if it isn't there; also one that failed to load."""
        with self._lock:
            entry.wanted, entry.used = True, time.monotonic()
            if entry.state in ("unloaded", "failed"):
                self._request(entry)
            elif entry.state == "unloading":
                entry.state = "ready"

    def unload(self, entry: Entry) -> None:
        """Drop a scene from memory as soon as no job uses it; none may start to. Raises BadInput."""
        if entry.path is None:
            raise scene_without_file()
        with self._lock:
            entry.wanted = False
            self._withdraw(entry)
            self._unload(entry)
            self._lock.notify_all()
        self._settle()

    def _unload(self, entry: Entry) -> None:
        if entry.state == "ready":
            entry.state = "unloading"
        if entry.state == "unloading" and not entry.jobs and not entry.is_growing:
            entry.drop()

    def readiness(self) -> SceneReadiness:
        """Return whether photos can be localized, what is still loading, and what failed."""
        entries = self.entries()
        pending = [SceneNote(e.id, e.state) for e in entries if e.required and e.awaited]
        failed = [SceneNote(e.id, str(e.error)) for e in entries if e.state == "failed"]
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
        with self._lock:
            entry.error, entry.state = None, "loading" if entry.loaded is None else "preparing"
            self._requested.append(entry)
            self._lock.notify_all()

    def _work(self) -> None:
        while (entry := self._next()) is not None:
            try:
                self._load(entry)
            except Exception as error:  # one bad scene must not take the others with it
                if self._stop.is_set():
                    return
                unexpected = not isinstance(error, SplatfixError)
                _log.error("scene %s can't be used: %s", entry.id, error, exc_info=unexpected)
                if isinstance(error, SplatfixError) and entry.path:  # clients must not learn the operator's folders
                    error.where = error.where.replace(str(entry.path), entry.id)
                with self._lock:
                    entry.failed(error)
            entry.awaited = False
            self._settle()

    def _next(self) -> Entry | None:
        """Wait for a requested scene that fits into memory beside those in use; None once the process ends."""
        with self._lock:
            while not self._stop.is_set():
                for entry in self.entries():
                    if entry.is_due:
                        self._request(entry)
                for entry in list(self._in_order()):
                    if self._makes_room(entry):
                        self._requested.remove(entry)
                        return entry
                self._lock.wait(_GRACE_S)
        return None

    def _in_order(self) -> Iterator[Entry]:
        """Yield the requested scenes: first those that the first one in line waits for."""
        first = self._first_in_line
        yield from (entry for entry in self._requested if entry.id in first)
        yield from (entry for entry in self._requested if entry.id not in first)

    @property
    def _first_in_line(self) -> Collection[str]:
        return self._waiting[0].ids if self._waiting else ()

    def _makes_room(self, entry: Entry) -> bool:
        """Drop scenes until another one fits, and return whether it does."""
        needed = 0 if entry.loaded is not None else entry.expected_bytes()
        if not self._limit.could_hold(needed):
            return True  # loading refuses it, and drops none for it
        dropped = self._limit.to_drop(entry, needed, self.entries(), self._first_in_line)
        if entry.required and entry.awaited and not entry.used and dropped != []:
            # Of a preload list that is larger than the memory the first ones stay.
            _log.warning("scene %s is not preloaded: the others reach the memory limit of scenes", entry.id)
            self._withdraw(entry)
            return False
        for other in dropped or ():
            _log.info("scene %s: unloaded to free memory for %s", other.id, entry.id)
            other.drop()
        return dropped is not None

    def _withdraw(self, entry: Entry) -> None:
        """Take back the request to load a scene, unless it is under way."""
        entry.awaited = False
        if entry in self._requested:
            self._requested.remove(entry)
            entry.state = "unloaded" if entry.loaded is None else "ready"

    def _load(self, entry: Entry) -> None:
        if entry.loaded is None and entry.path is not None:
            if entry.remote is not None:
                entry.remote.fetch(entry.path)
            self._limit.require(entry, entry.expected_bytes())
            tools = {"matcher": self._matcher, "rasterizer": self._rasterizer}
            loaded = LoadedScene.load(entry.path, cache_dir=self._cache_dir, **tools)
            # Only now is its size certain.
            entry.measured_bytes = loaded.nbytes
            self._limit.require(entry, loaded.nbytes)
            with self._lock:
                # Where the header promised too little the scenes in use stay, and all together are over the limit.
                for other in self._limit.to_drop(entry, loaded.nbytes, self.entries()) or ():
                    other.drop()
                entry.loaded, entry.state = loaded, "preparing"
            self._settle()
        if entry.loaded is not None and not self._stop.is_set():
            entry.loaded.usable(self._estimator)
            # Compiles and loads what the first photo would wait for.
            warm_up(entry.loaded, self._estimator)
        with self._lock:
            entry.state, entry.failures = "ready", 0
            entry.awaited, entry.is_growing = False, entry.wanted
            if not entry.wanted:
                self._unload(entry)  # as was asked for in the meantime
            self._lock.notify_all()
        if entry.is_growing:
            self._grow(entry)
        self._camera_frames.consider(entry)

    def _grow(self, entry: Entry) -> None:
        """Build the rest of a scene's view index while jobs use its first part."""
        try:
            if entry.loaded is not None and not self._stop.is_set():
                entry.loaded.prepare(self._estimator)
        finally:
            with self._lock:
                entry.is_growing = False
                self._drop_or_reload(entry)
                self._lock.notify_all()
        if self._cache_dir and self._cache_bytes is not None:
            evict(self._cache_dir, self._cache_bytes)

    def _settle(self) -> None:
        """Give scenes to those who have waited for them, in their order."""
        settled: list[tuple[_Waiting, Acquired | SplatfixError]] = []
        with self._lock:
            for waiting in list(self._waiting):
                if (answer := self._answer(waiting)) is not None:
                    self._waiting.remove(waiting)
                    settled.append((waiting, answer))
        # Outside of the lock: they submit jobs, which take locks of their own.
        for waiting, answer in settled:
            waiting.take(answer)

    def _answer(self, waiting: _Waiting) -> Acquired | SplatfixError | None:
        """Return what somebody waits for, if it is certain by now; ask for what is missing."""
        found = {scene_id: self._or_error(scene_id) for scene_id in waiting.ids}
        errors = {i: e for i, e in found.items() if isinstance(e, SplatfixError) and not isinstance(e, SceneNotReady)}
        if errors and (waiting.every or len(errors) == len(found)):
            return next(iter(errors.values()))
        waiting.ids = [scene_id for scene_id in waiting.ids if scene_id not in errors]
        waiting.left_out += errors
        if any(isinstance(one, SceneNotReady) for one in found.values()):
            return None
        return self._held(waiting.ids, waiting.left_out)
