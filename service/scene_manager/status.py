"""What the scene manager is given and what it reports: plain values, which may come from other processes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

from service.coverage.coverage_map import CoverageMap
from service.errors import Failure
from service.scene_formats.remote_scene import RemoteScene
from service.types import Intrinsics, NamedCamera, Pose, SceneInfo

AUTO = "auto"
"""Requests name all scenes that are ready by it, so no scene is called that."""
RETRY_S = 5.0
"""A scene that failed to load is tried again by the next request after this time, doubled with each failure."""
MAX_RETRY_S = 300.0
PictureFormat = Literal["png", "jpeg", "depth"]
SceneState = Literal["unloaded", "loading", "preparing", "ready", "unloading", "failed"]


@dataclass(frozen=True, slots=True)
class StoredScene:
    """A scene that can be loaded."""

    id: str
    path: Path
    """A scene folder or a scene file."""
    uploaded: bool = False
    """It came over HTTP, and may be deleted."""
    remote: RemoteScene | None = None
    """From where its files are fetched to `path` before it is loaded; None: they are there."""


@dataclass(frozen=True, slots=True)
class IndexStatus:
    """How far a scene's view index is built."""

    views: int
    """That photos are compared with now."""
    planned_views: int
    """That it will have; then photos of every part of the scene are found."""


@dataclass(frozen=True, slots=True)
class SceneStatus:
    """One scene and how far loading it has come."""

    id: str
    state: SceneState
    jobs: int = 0
    """That use it, waiting or running."""
    uploaded: bool = False
    """It came over HTTP, and may be deleted."""
    failure: Failure | None = None
    """Why it could not be loaded."""
    info: SceneInfo | None = None
    """None until it is in memory, like everything below."""
    gaussians: int | None = None
    sh_degree: int | None = None
    cameras: int | None = None
    """Number of training cameras."""
    memory_bytes: int | None = None
    index: IndexStatus | None = None
    """None until there is a first part of it."""
    warnings: tuple[str, ...] = ()
    """Of how it is rendered and searched, beside those of its files."""


@dataclass(frozen=True, slots=True)
class SceneContents:
    """What a scene in memory holds, summarized."""

    cameras: tuple[NamedCamera, ...]
    """Of the training photos."""
    bounds_in_world: Float64[np.ndarray, "2 3"] | None
    """1 % and 99 % quantiles of the Gaussians' means along each axis; None without Gaussians."""


@dataclass(frozen=True, slots=True)
class SceneNote:
    """What is to be said of a scene."""

    scene: str
    text: str

    def __str__(self) -> str:
        """As people read it."""
        return f"scene {self.scene}: {self.text}"


@dataclass(frozen=True, slots=True)
class SceneReadiness:
    """Whether photos can be localized at full speed, and what is missing."""

    ready: bool
    pending: tuple[SceneNote, ...]
    """Scenes that are still being loaded or prepared, with their state."""
    failed: tuple[SceneNote, ...]
    """Scenes that could not be loaded, with the reason."""
    rasterizers: tuple[str, ...]
    """What the scenes in memory are rendered with."""
    skipped_rasterizers: tuple[str, ...]
    """Why no GPU is used, where the operator left the choice."""


@dataclass(frozen=True, slots=True)
class PictureSpec:
    """What to render of a scene, and how to encode it."""

    pose: Pose
    intrinsics: Intrinsics | None = None
    """Pinhole; None: those of the first training camera, or 640 x 480."""
    format: PictureFormat = "jpeg"
    """`depth` is a NumPy file (.npy): float32 of height x width, z-depth in scene units, 0 where nothing is."""
    quality: int = 90
    """JPEG's, 1..100."""


@dataclass(frozen=True, slots=True)
class CoverageStatus:
    """A scene's coverage map, or how far it is measured."""

    state: Literal["none", "running", "ready", "failed"]
    done: int = 0
    """Renders and held-out photos that were tried."""
    total: int = 0
    """Of so many; 0 while the measurement waits or begins."""
    remaining_s: float | None = None
    """Estimated wall time until it ends; None: not known."""
    found: CoverageMap | None = None
    partial: CoverageMap | None = None
    """While it is measured: the map's plan with the renders tried so far."""
    failure: Failure | None = None
    """Why there is none."""
