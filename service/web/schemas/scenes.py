"""Scenes as the API returns them."""

from __future__ import annotations

from service.scene_manager.status import SceneState
from service.web.api_model import Model
from service.web.problems import Problem
from service.web.schemas.poses import NamedCameraOut, SceneFrameOut


class SceneLinks(Model):
    """Paths on this service, with its sub-path if it has one."""

    self: str
    splats: str
    thumbnail: str


class IndexOut(Model):
    """How far a scene's view index is built. Photos are localized by what there is of it."""

    views: int
    """That photos are compared with now."""
    planned_views: int
    """That it will have."""


class SceneSummary(Model):
    """A scene as in the list of scenes."""

    id: str
    name: str
    state: SceneState
    gaussians: int | None
    """Number of Gaussians. Null until the scene is loaded, like `sh_degree`, `cameras` and `memory_bytes`."""
    sh_degree: int | None
    """Degree of the spherical harmonics of the colours."""
    cameras: int | None
    """Number of training cameras."""
    memory_bytes: int | None
    index: IndexOut | None
    """Null until there is a first part of it."""
    jobs: int
    """Number of queued and running jobs on the scene."""
    uploaded: bool
    """Whether it came over the API, and may be deleted."""
    error: Problem | None
    """Why loading failed."""
    links: SceneLinks


class SceneOut(SceneSummary):
    """A scene with its training cameras; the fields of its file are null until it is loaded."""

    sha256: str | None
    """Of the scene file."""
    format: str | None
    background_rgb: list[float] | None
    """Background colour of training, 0..1."""
    background_is_known: bool | None
    """Whether a file says so; if not, black is assumed, and white for photos with a white border."""
    up_in_world: list[float] | None
    """Unit vector that points up, in the scene's frame."""
    metres_per_unit: float | None
    render_mode: str | None
    bounds_in_world: list[list[float]] | None
    """Lower and upper corner of an axis-aligned box: the 1 % and 99 % quantiles of the Gaussians' centres."""
    frames: list[SceneFrameOut]
    """Other frames that results are given in, beside the world."""
    warnings: list[str]
    training_cameras: list[NamedCameraOut]


class SceneList(Model):
    """The scenes that the key may use."""

    scenes: list[SceneSummary]
