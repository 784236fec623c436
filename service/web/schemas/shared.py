"""Share links, and what they show."""

from __future__ import annotations

from pydantic import Field

from service.web.api_model import Model
from service.web.schemas.jobs import JobOut

DAY_S = 24 * 3600.0


class ShareIn(Model):
    """How long a link is valid."""

    expires_in_s: float = Field(default=7 * DAY_S, gt=0, le=90 * DAY_S, allow_inf_nan=False)
    """Seconds; at most 90 days."""


class ShareLink(Model):
    """A link that shows one job to whoever has it."""

    link: str
    """Path on this service, with its sub-path if it has one."""
    token: str
    expires_in_s: float


class SharedJob(Model):
    """What the page of a share link shows."""

    job: JobOut
    metres_per_unit: float | None
    """Of its scene; null: unknown, or the scene isn't in memory."""
