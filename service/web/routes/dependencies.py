"""Dependencies of the routes: the app's state, the caller, the sub-path, the job of an id."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import anyio
from anyio import to_thread
from fastapi import Depends, Path, Request

from service.errors import CorruptScene
from service.jobs.engine import Engine
from service.jobs.model import StoredJob
from service.jobs.service import Jobs
from service.lenses.lens_store import LensStore
from service.scene_manager.anchor_store import Anchor, AnchorStore
from service.scene_manager.scene_store import SceneStore
from service.web.api_keys import Caller, KeyRing
from service.web.metrics import Metrics
from service.web.middleware.limits import client_of
from service.web.schemas import resources
from service.web.schemas.jobs import JobOut
from service.web.settings import Settings

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class AppState:
    """Everything that routes use; one per app."""

    settings: Settings
    engine: Engine
    scene_store: SceneStore
    anchors: AnchorStore
    jobs: Jobs
    lenses: LensStore
    keys: KeyRing
    metrics: Metrics
    decoding: anyio.CapacityLimiter
    """Limits the photos that are decoded at once: one may take 450 MB."""
    rendering: anyio.CapacityLimiter
    """Limits the images that are rendered at once for clients: each thread of a renderer keeps working memory."""
    live: Counter[str] = field(default_factory=Counter)
    """Live sessions under way, by client."""

    async def render_in_thread(self, scene_id: str, draw: Callable[[], bytes]) -> bytes:
        """Render an image for a client in a thread, and count it in the metrics."""
        began = time.perf_counter()
        picture = await to_thread.run_sync(draw, limiter=self.rendering)
        self.metrics.rendered(scene_id, time.perf_counter() - began)
        return picture


def _app_state(request: Request) -> AppState:
    return request.app.state.app_state


def _root(request: Request) -> str:
    return request.scope.get("root_path", "")


def _job(app_state: AppStateOf, job_id: Annotated[str, Path(description="The job's id.")]) -> StoredJob:
    return app_state.jobs.get(job_id)  # not async: reads the disk


def _caller(request: Request) -> Caller | None:
    return request.state.caller


def lens_owner(request: Request, app_state: AppState) -> str:
    """Return whose lenses the caller's photos are taken with: the API key's, by name and hash, else the address's."""
    caller, client = _caller(request), client_of(request.scope)
    # A name can be given to another key later, whose owner must not see what was learnt with the first one.
    return f"{client}:{app_state.keys.key_id(caller)}" if caller else client


def _visible_owner(request: Request, app_state: AppStateOf) -> str | None:
    caller = _caller(request)
    return None if caller is None or caller.has_role("admin") else lens_owner(request, app_state)


def job_document(app_state: AppState, job_id: str, root: str) -> JobOut:
    """Describe a job in full, as it stands. Not for the event loop: reads the disk. Raises JobNotFound."""
    job = app_state.jobs.get(job_id)
    result = app_state.jobs.result(job) if job.state == "succeeded" else None
    anchors = known_anchors(app_state, job.scene) if result else ()
    return resources.job_out(job, result, root, anchors)


def known_anchors(app_state: AppState, scene_id: str) -> Sequence[Anchor]:
    """Return a scene's anchors; none where their file is damaged, which is logged: a result is there without."""
    try:
        return app_state.anchors.anchors(scene_id)
    except CorruptScene as error:
        _log.warning("scene %s: %s", scene_id, error)
        return ()


AppStateOf = Annotated[AppState, Depends(_app_state)]
CallerOf = Annotated[Caller | None, Depends(_caller)]
RootOf = Annotated[str, Depends(_root)]
JobOf = Annotated[StoredJob, Depends(_job)]
VisibleOwnerOf = Annotated[str | None, Depends(_visible_owner)]
"""Whose lenses the caller may see and delete; None: anybody's, for an admin, and where there are no keys."""


JPEG = {200: {"description": "JPEG", "content": {"image/jpeg": {}}}}
