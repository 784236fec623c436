"""What the routes share: the app's parts as dependencies, and how errors are documented."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import anyio
from fastapi import Depends, Path, Request

from service.api.jobs import Jobs
from service.api.keys import Caller, KeyRing
from service.api.metrics import Metrics
from service.api.problems import MEDIA_TYPE
from service.api.scenes import Scenes
from service.api.settings import Settings
from service.api.store import StoredJob
from service.api.uploads import Uploads


@dataclass(frozen=True, slots=True)
class Parts:
    """What the routes work with; one per app."""

    settings: Settings
    scenes: Scenes
    jobs: Jobs
    uploads: Uploads
    keys: KeyRing
    metrics: Metrics
    decoding: anyio.CapacityLimiter
    """Photos decoded at once: each may take 200 MB for a moment."""
    rendering: anyio.CapacityLimiter
    """Pictures rendered at once for looking at: a renderer's thread keeps working memory."""


def _parts(request: Request) -> Parts:
    return request.app.state.parts


def _root(request: Request) -> str:
    return request.scope.get("root_path", "")


def _job(parts: PartsOf, job_id: Annotated[str, Path(description="The job's id.")]) -> StoredJob:
    return parts.jobs.get(job_id)  # not async: reads the disk


def _caller(request: Request) -> Caller | None:
    return request.state.caller


PartsOf = Annotated[Parts, Depends(_parts)]
CallerOf = Annotated[Caller | None, Depends(_caller)]
RootOf = Annotated[str, Depends(_root)]
JobOf = Annotated[StoredJob, Depends(_job)]


def errors(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Document the problem documents that a route may answer with."""
    return {status: {"description": MEANINGS[status], "content": _PROBLEM} for status in statuses} | {
        "default": {"description": "Any other error", "content": _PROBLEM}
    }


_PROBLEM = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
MEANINGS = {
    401: "An API key is needed, or it is not valid",
    403: "The key's role doesn't allow it, or another site's page asks",
    400: "The request can't be understood",
    404: "There is no such thing",
    409: "Not yet, not any more, or there is nothing to give",
    408: "The body took too long",
    429: "Too many requests of yours; see Retry-After",
    413: "The body is too large",
    415: "Neither a multipart form nor JSON",
    422: "A value is wrong: the photo, intrinsics, prior, options, or the scene's own file",
    504: "There was no answer in time",
    501: "What was asked for can't run on this machine",
    503: "Too much work is waiting, or the scene is still loading; see Retry-After",
}
JPEG = {200: {"description": "JPEG", "content": {"image/jpeg": {}}}}
