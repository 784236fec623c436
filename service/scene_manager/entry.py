"""One scene of the process: the state of loading it, and who uses it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.errors import Failure
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.pose.retrieval.index import ViewIndex
from service.scene_formats.remote_scene import RemoteScene
from service.scene_formats.size_estimate import estimated_bytes
from service.scene_manager.status import MAX_RETRY_S, RETRY_S, IndexStatus, SceneContents, SceneState, SceneStatus
from service.scene_origin import shifted_camera


@dataclass(slots=True)
class Entry:
    """Changed by the scene manager only, under its lock."""

    id: str
    path: Path | None
    """None: it was given in memory, and can't be loaded again."""
    state: SceneState = "unloaded"
    loaded: LoadedScene | None = None
    error: Exception | None = None
    wanted: bool = True
    """Load it when it is asked for."""
    required: bool = False
    """The service isn't ready before it has been loaded once, or failed to; then it is tried again unasked."""
    remote: RemoteScene | None = None
    """From where its files are fetched before it is loaded."""
    uploaded: bool = False
    """It came over HTTP, and may be deleted."""
    is_outdated: bool = False
    """Its files have changed: it is loaded again as soon as no job uses it."""
    awaited: bool = True
    """Of a required scene: whether it has neither been loaded nor failed to yet."""
    is_growing: bool = False
    """It is ready, and its view index is still being built: until it is whole it stays in memory."""
    jobs: int = 0
    """That use it, waiting or running: while there are any it stays."""
    used: float = 0.0
    """When it was last asked for, on the monotonic clock."""
    measured_bytes: int | None = None
    """What it took of memory when it was loaded last."""
    failures: int = 0
    """Since it was loaded last."""
    retry_at: float = 0.0
    """When a request has it loaded again after it failed, on the monotonic clock."""

    @property
    def is_idle(self) -> bool:
        """Whether it is in memory and may be dropped; a scene without a file could not be loaded again."""
        return self.state == "ready" and not self.jobs and not self.is_growing and self.path is not None

    @property
    def is_due(self) -> bool:
        """Whether it failed and is to be tried again without being asked for: nobody may ask an unready service."""
        return self.state == "failed" and self.required and self.wanted and time.monotonic() >= self.retry_at

    @property
    def memory_bytes(self) -> int:
        """What it takes of memory; 0 while it isn't there."""
        return self.loaded.nbytes if self.loaded else 0

    def expected_bytes(self) -> int:
        """Return what it will take once it is loaded; 0 where that isn't known before."""
        if self.measured_bytes is not None:
            return self.measured_bytes
        return (estimated_bytes(self.path) or 0) if self.path else 0

    def failed(self, error: Exception) -> None:
        """Note that loading failed, and from when on it is tried again."""
        self.error, self.state = error, "failed"
        self.retry_at = time.monotonic() + min(RETRY_S * 2**self.failures, MAX_RETRY_S)
        self.failures += 1

    def drop(self) -> None:
        """Take it out of memory."""
        self.loaded, self.state, self.is_outdated = None, "unloaded", False

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
            index=_index_status(loaded.prepared(DEFAULT_ESTIMATOR)),
            warnings=loaded.warnings,
        )

    def contents(self) -> SceneContents | None:
        """Return the scene's training cameras and its bounds, in the world; None while it isn't in memory."""
        if self.loaded is None:
            return None
        scene = self.loaded.scene
        origin = scene.info.origin_in_world
        # Quantiles: floaters far outside would make the box useless.
        bounds = np.quantile(scene.means, [0.01, 0.99], axis=0) + origin if scene.count else None
        return SceneContents(tuple(shifted_camera(named, origin) for named in scene.cameras), bounds)


def _index_status(index: ViewIndex | None) -> IndexStatus | None:
    if index is None:
        return None
    views = len(index.views)
    return IndexStatus(views, index.whole.planned_views if index.whole else views)
