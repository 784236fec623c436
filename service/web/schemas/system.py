"""Capabilities, readiness and tokens of the service as the API returns them."""

from __future__ import annotations

from typing import Any, Literal

from service.web.api_model import Model


class Capability(Model):
    """A plug-in, and whether it can run on this machine."""

    name: str
    available: bool
    reason: str | None
    """Why it can't run here; null if it can."""
    default: bool = False
    source: str
    """Origin of the plug-in: `built-in`, `plug-in folder`, or an installed package with its version."""


class EstimatorCapability(Capability):
    """An estimator with its options."""

    options_schema: dict[str, Any] | None
    """JSON Schema of the request's `options`; null if the estimator can't run here."""
    needs_prior: bool = False
    """It refines an approximate pose: a request without `prior` is refused."""


class Capabilities(Model):
    """What a request can choose, and the limits of requests."""

    estimators: list[EstimatorCapability]
    matchers: list[Capability]
    rasterizers: list[Capability]
    scene_formats: list[Capability]
    max_upload_bytes: int
    """Of a photo, a video, or several photos together."""
    max_wait_s: float
    """The longest `Prefer: wait=N` that is honoured."""


class Readiness(Model):
    """Whether photos can be localized without waiting for a scene."""

    ready: bool
    pending: list[str]
    """What is not done yet; empty when ready."""
    failed: list[str]
    """Scenes that could not be loaded, storage that can't be written to, stuck workers; each with reason and remedy."""
    rasterizers: list[str]
    """Renderers of the scenes in memory: `cpu`, `gsplat_cuda`."""
    skipped_rasterizers: list[str]
    """Why no GPU renderer is used, if the settings left the choice."""


class Token(Model):
    """A short-lived credential with the role of the key that it was made with."""

    token: str
    """For `?token=` of a page, or as Bearer token."""
    expires_in_s: float


class Liveness(Model):
    """The answer of a process that runs."""

    alive: Literal[True] = True
