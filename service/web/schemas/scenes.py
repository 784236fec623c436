"""Scenes as the API returns them."""

from __future__ import annotations

from typing import Literal

from service.web.api_model import Model
from service.web.problems import Problem
from service.web.schemas.poses import NamedCameraOut

SceneState = Literal["unloaded", "loading", "preparing", "ready", "unloading", "failed"]


class SceneLinks(Model):
    self: str
    splats: str
    thumbnail: str


class SceneSummary(Model):
    id: str
    name: str
    state: SceneState
    gaussians: int | None
    """None until it is loaded; so are the other counts."""
    sh_degree: int | None
    cameras: int | None
    memory_bytes: int | None
    jobs: int
    """That use it, waiting or running."""
    error: Problem | None
    """Why it failed to load."""
    links: SceneLinks


class SceneOut(SceneSummary):
    sha256: str | None
    format: str | None
    background_rgb: list[float] | None
    up_in_world: list[float] | None
    metres_per_unit: float | None
    render_mode: str | None
    bounds_in_world: list[list[float]] | None
    """Lower and upper corner of the box that holds the middle 98 % of the Gaussians along each axis."""
    warnings: list[str]
    training_cameras: list[NamedCameraOut]


class SceneList(Model):
    scenes: list[SceneSummary]
