"""The scenes of a running service: loaded and made ready in the background, then shared by all jobs."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from service.api.schemas import Readiness, SceneState
from service.errors import BadInput, SceneNotFound, SceneNotReady, SplatfixError
from service.geometry import look_at
from service.localize import LoadedScene, Request, localize
from service.scene_formats.discovery import find_scenes
from service.types import Camera, Intrinsics, Query

_log = logging.getLogger(__name__)

_GRACE_S = 5.0


@dataclass(slots=True)
class Entry:
    """One scene and how far it has come."""

    id: str
    path: Path | None
    state: SceneState = "loading"
    loaded: LoadedScene | None = None
    error: Exception | None = None
    waiting: list[Callable[[], object]] = field(default_factory=list)
    """To call when it is loaded, or failed to."""


class Scenes:
    """All scenes of the service. Changed by the loading thread, read by any."""

    def __init__(self, paths: Iterable[Path], estimator: str, cache_dir: Path | None) -> None:
        """Find the scenes, without reading them. Raises SceneNotFound, BadInput.

        `estimator` is the one that they are made ready for.
        """
        self._estimator, self._cache_dir = estimator, cache_dir
        self._entries: dict[str, Entry] = {}
        self._stop = threading.Event()
        self._settling = threading.Lock()
        self._thread = threading.Thread(target=self._load_all, name="scenes", daemon=True)
        for path in (scene for given in paths for scene in find_scenes(given)):
            scene_id = path.resolve().stem if path.is_file() else path.resolve().name
            if scene_id in self._entries:
                raise BadInput(f"two scenes are called '{scene_id}'.", where=str(path))
            self._entries[scene_id] = Entry(scene_id, path)

    @classmethod
    def of(cls, loaded: Mapping[str, LoadedScene], estimator: str) -> Scenes:
        """Take scenes that are in memory already."""
        scenes = cls((), estimator, None)
        scenes._entries = {k: Entry(k, None, "preparing", v) for k, v in loaded.items()}
        return scenes

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Stop loading, between two scenes; return then, or soon anyway."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(_GRACE_S)

    def entries(self) -> list[Entry]:
        return list(self._entries.values())

    def entry(self, scene_id: str) -> Entry:
        """Raises SceneNotFound, which names the scenes that are there."""
        if scene_id not in self._entries:
            known = ", ".join(self._entries) or "none"
            raise SceneNotFound(f"there is no scene '{scene_id}'; known: {known}.", where="scene")
        return self._entries[scene_id]

    def get(self, scene_id: str | None) -> LoadedScene:
        """Return a scene in memory; None: the only one. Raises SceneError: also why it failed to load."""
        if scene_id is None and len(self._entries) != 1:
            known = ", ".join(self._entries) or "none"
            raise SceneNotFound(f"say which scene; known: {known}.", where="scene")
        entry = self.entry(scene_id if scene_id is not None else next(iter(self._entries)))
        if entry.error:
            raise entry.error
        if entry.loaded is None:
            raise SceneNotReady(f"scene '{entry.id}' is still loading.", where="scene", hint="Try again later.")
        return entry.loaded

    def when_settled(self, scene_id: str, do: Callable[[], object]) -> None:
        """Call `do` as soon as the scene is in memory, or certain not to come there."""
        entry = self._entries.get(scene_id)
        with self._settling:
            if entry is not None and entry.loaded is None and entry.error is None:
                entry.waiting.append(do)
                return
        do()

    def memory(self) -> dict[tuple[str, ...], float]:
        """Return the bytes of each scene in memory, by (id,)."""
        return {(e.id,): float(e.loaded.scene.nbytes) for e in self.entries() if e.loaded}

    def readiness(self) -> Readiness:
        entries = self.entries()
        awaited = [f"scene {e.id}: {e.state}" for e in entries if e.state in ("loading", "preparing")]
        failed = [f"scene {e.id}: {e.error}" for e in entries if e.state == "failed"]
        usable = any(e.state == "ready" for e in entries)
        return Readiness(ready=usable and not awaited, awaited=awaited, failed=failed)

    def _load_all(self) -> None:
        for entry in self.entries():
            try:
                self._load(entry)
            except Exception as error:  # one bad scene must not take the others with it
                if self._stop.is_set():
                    return
                _log.error(
                    "scene %s can't be used: %s",
                    entry.id,
                    error,
                    exc_info=not isinstance(error, SplatfixError),
                )
                entry.error, entry.state = error, "failed"
                self._settled(entry)

    def _settled(self, entry: Entry) -> None:
        with self._settling:
            waiting, entry.waiting = entry.waiting, []
        for do in waiting:
            do()

    def _load(self, entry: Entry) -> None:
        if entry.loaded is None and entry.path is not None:
            entry.loaded = LoadedScene.load(entry.path, cache_dir=self._cache_dir)
            self._settled(entry)
        entry.state = "preparing"
        if entry.loaded is not None and not self._stop.is_set():
            entry.loaded.prepare(self._estimator)
            warm_up(entry.loaded, self._estimator)
        entry.state = "ready"


def warm_up(loaded: LoadedScene, estimator: str) -> None:
    """Localize a render of the scene, so that the first photo meets compiled code and loaded networks."""
    camera = overview(loaded, 512)
    frame = loaded.rasterizer.render([camera])[0]
    rgb = np.clip(np.rint(frame.rgb * 255), 0, 255).astype(np.uint8)
    estimate = localize(Query(rgb, camera.intrinsics, "given", camera.intrinsics), loaded, Request(estimator))
    _log.info("scene %s: warmed up, %s", loaded.scene.info.id, estimate.verdict.status)


def overview(loaded: LoadedScene, long_side: int) -> Camera:
    """Return a camera that shows what the scene is: a training camera, else one outside."""
    cameras = loaded.scene.cameras
    camera = cameras[len(cameras) // 2].camera if cameras else _outside(loaded)
    return Camera(camera.intrinsics.with_long_side(long_side), camera.pose)


def _outside(loaded: LoadedScene) -> Camera:
    """A camera that looks at the middle of the Gaussians from outside."""
    means = loaded.scene.means
    centre = np.median(means, 0)
    radius = float(np.median(np.linalg.norm(means - centre, axis=1))) or 1.0
    pose = look_at(centre + radius * np.array([0.0, 0.0, 3.0]), centre, np.array([0.0, 1.0, 0.0]))
    return Camera(Intrinsics(512, 384, 450.0, 450.0, 256.0, 192.0), pose)
