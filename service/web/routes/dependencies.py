"""Dependencies of the routes: the app's state, the caller, the sub-path, the job of an id."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import anyio
from anyio import to_thread
from fastapi import Depends, Path, Request
from fastapi.requests import HTTPConnection

from service.errors import CorruptScene, JobNotFound, SceneNotFound, StorageFailed
from service.jobs.engine import Engine
from service.jobs.model import StoredJob
from service.jobs.service import Jobs
from service.lenses.lens_store import LensStore
from service.scene_manager.anchor_store import Anchor, AnchorStore
from service.scene_manager.scene_errors import nothing_to_search
from service.scene_manager.scene_store import SceneStore
from service.scene_manager.status import AUTO, SceneStatus
from service.web.api_keys import Caller, KeyRing
from service.web.catalogue_watch import CatalogueWatch
from service.web.key_file import UNLIMITED, KeyLimits
from service.web.metrics import Metrics
from service.web.schemas import resources
from service.web.schemas.jobs import JobOut
from service.web.settings import Settings
from service.web.shared_state import SharedState

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
    shared: SharedState
    metrics: Metrics
    decoding: anyio.CapacityLimiter
    """Limits the photos that are decoded at once: one may take 450 MB."""
    rendering: anyio.CapacityLimiter
    """Limits the images that are rendered at once for clients: each thread of a renderer keeps working memory."""
    catalogue: CatalogueWatch | None = None
    """Knows of scenes that other fronts add and delete; None: there are no others."""
    live: set[str] = field(default_factory=set)
    """Live sessions under way at this front."""

    def known_scenes(self, asked: Collection[str] = ()) -> list[SceneStatus]:
        """Return all scenes, after a look at what other fronts have added if one that is asked for isn't known."""
        known = self.engine.scenes()
        if self.catalogue is None or set(asked) <= {AUTO, *(scene.id for scene in known)}:
            return known
        self.look_at_catalogue()
        return self.engine.scenes()

    def look_at_catalogue(self) -> None:
        """See what other fronts have added and deleted; without the object store what is known stays."""
        try:
            if self.catalogue:
                self.catalogue.look()
        except StorageFailed as error:
            _log.warning("the catalogue of scenes can't be looked at: %s", error)

    async def render_in_thread(self, scene_id: str, draw: Callable[[], bytes]) -> bytes:
        """Render an image for a client in a thread, and count it in the metrics."""
        began = time.perf_counter()
        picture = await to_thread.run_sync(draw, limiter=self.rendering)
        self.metrics.rendered(scene_id, time.perf_counter() - began)
        return picture


@dataclass(frozen=True, slots=True)
class Visible:
    """What a caller may see. Of the rest everything answers as if it weren't there."""

    owner: str | None
    """Whose jobs and lenses; None: everybody's, for an admin, and where there are no keys."""
    limits: KeyLimits | None = UNLIMITED
    """Those of the caller's key, which name its scenes; None: it sees none."""

    @property
    def all_scenes(self) -> bool:
        """Whether no scene is hidden."""
        return self.limits is not None and self.limits.scenes is None

    def scene(self, scene_id: str) -> bool:
        """Return whether a scene of that name may be seen, be it there or not."""
        return self.limits is not None and self.limits.cover(scene_id)

    def job(self, job: StoredJob) -> bool:
        """Return whether a job may be seen: its own key's, or any by an admin."""
        return self.owner is None or job.client == self.owner

    def scenes(self, known: Sequence[SceneStatus]) -> list[SceneStatus]:
        """Return those of the scenes that may be seen."""
        return [scene for scene in known if self.scene(scene.id)]

    def asked(self, asked: str | tuple[str, ...] | None, known: Sequence[SceneStatus]) -> str | tuple[str, ...] | None:
        """Return the scenes to look in for those that a request asks for.

        Raises SceneNotFound, which names those that may be seen.
        """
        usable = [scene.id for scene in self.scenes(known)]
        names = ", ".join(usable) or "none"
        if asked is None:
            if len(usable) != 1:
                raise SceneNotFound(f"name a scene; known: {names}.", where="scene")
            # The engine would choose among all scenes, this key's or not.
            return None if self.all_scenes else usable[0]
        if asked == AUTO:
            return asked if self.all_scenes else self._auto(known)
        for name in (asked,) if isinstance(asked, str) else asked:
            if name not in usable:
                raise SceneNotFound(f"unknown scene '{name}'; known: {names}.", where="scene")
        return asked

    def _auto(self, known: Sequence[SceneStatus]) -> tuple[str, ...]:
        """Return the scenes that `auto` stands for: as the engine means it, it would look in all."""
        found = tuple(scene.id for scene in self.scenes(known) if scene.state not in ("failed", "unloaded"))
        if not found:
            raise nothing_to_search()
        return found


def _app_state(connection: HTTPConnection) -> AppState:
    return connection.app.state.app_state


async def see_other_fronts_scenes(connection: HTTPConnection, app_state: AppStateOf) -> None:
    """See what other fronts have added and deleted, before a request that lists or describes scenes, or names one that
    isn't known here: the front that was asked before may have answered with it."""
    if app_state.catalogue is None:
        return
    # Not before each request: a look takes one to the object store.
    if connection.scope["route"].path in ("/scenes", "/scenes/{scene_id}"):
        await to_thread.run_sync(app_state.look_at_catalogue)
    elif scene_id := connection.path_params.get("scene_id"):
        await to_thread.run_sync(app_state.known_scenes, (scene_id,))


def _root(request: Request) -> str:
    return request.scope.get("root_path", "")


def _caller(request: Request) -> Caller | None:
    return request.state.caller


def _visible(request: Request) -> Visible:
    caller: Caller | None = request.state.caller
    if caller is not None:
        return Visible(None if caller.has_role("admin") else caller.client, caller.limits)
    # Without a key on a service that has keys, on what is public: denied by default.
    return Visible(None) if request.state.open else Visible("", None)


def _job(
    app_state: AppStateOf, visible: VisibleOf, job_id: Annotated[str, Path(description="The job's id.")]
) -> StoredJob:
    job = app_state.jobs.get(job_id)  # not async: reads the disk
    if not visible.job(job):
        # As the store says it of a job that isn't there.
        raise JobNotFound(f"job '{job_id}' not found or expired.", where="job")
    return job


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
VisibleOf = Annotated[Visible, Depends(_visible)]
JobOf = Annotated[StoredJob, Depends(_job)]
"""The job of the path, if the caller may see it."""


JPEG = {200: {"description": "JPEG", "content": {"image/jpeg": {}}}}
