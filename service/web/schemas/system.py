"""The service itself as the API returns it: what it can do, whether it is ready, and tokens."""

from __future__ import annotations

from typing import Any, Literal

from service.web.api_model import Model


class Capability(Model):
    name: str
    available: bool
    reason: str | None
    """Why it can't run here."""
    default: bool = False
    source: str
    """Where it comes from: `built-in`, `plug-in folder`, or an installed package with its version."""


class EstimatorCapability(Capability):
    options_schema: dict[str, Any] | None
    """JSON Schema of the form field `options`."""


class Capabilities(Model):
    estimators: list[EstimatorCapability]
    matchers: list[Capability]
    rasterizers: list[Capability]
    scene_formats: list[Capability]
    max_upload_bytes: int
    max_wait_s: float


class Readiness(Model):
    ready: bool
    awaited: list[str]
    """What is not done yet; empty when ready."""
    failed: list[str]
    """Scenes that could not be loaded, a disk that can't be written to, workers that are stuck; with the reason."""
    rasterizers: list[str]
    """What the scenes in memory are rendered with: `cpu`, `gsplat_cuda`."""
    passed_over: list[str]
    """Why no GPU is used, where the operator left the choice."""


class Token(Model):
    token: str
    """Stands for the key that it was made with: in `?token=` of a page, or as Bearer."""
    seconds: float
    """How long it is valid."""


class Liveness(Model):
    alive: Literal[True] = True
