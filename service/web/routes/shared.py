"""`POST /jobs/{id}/share`, and what a share link shows: one job, read-only, to whoever has the link, until it expires.

The token in the link is signed with the secret of the sessions, so it outlives a restart; it ends with the key that
made it, and with its job. `service/web/pages.py` has the page.
"""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Path, Query, Response
from pydantic import Field

from service.errors import JobNotFound
from service.jobs.model import StoredJob
from service.web.route_policy import SMALL_BODY, route_policy
from service.web.routes.dependencies import AppState, AppStateOf, CallerOf, JobOf, RootOf, job_document
from service.web.routes.jobs import job_photo, job_render
from service.web.schemas import resources
from service.web.schemas.error_examples import errors
from service.web.schemas.jobs import JobLinks, JobOut, Trace
from service.web.schemas.shared import SharedJob, ShareIn, ShareLink

router = APIRouter()


@router.post(
    "/jobs/{job_id}/share",
    status_code=201,
    tags=["jobs"],
    responses=errors("invalid_request", "bad_request", "request_timeout", "job_not_found", body=True),
)
@route_policy(role="localize", body=SMALL_BODY, rate_limited=True)
def share_job(job: JobOf, wanted: ShareIn, app_state: AppStateOf, caller: CallerOf, root: RootOf) -> ShareLink:
    """Make a link that shows this job to whoever has it, without a key, for a while."""
    token = app_state.keys.share_token(job.id, wanted.expires_in_s, caller)
    return ShareLink(link=f"{root}/shared/{token}", token=token, expires_in_s=wanted.expires_in_s)


def _shared(app_state: AppStateOf, token: Annotated[str, Path(max_length=1000)]) -> StoredJob:
    job_id = app_state.keys.shared_job(token)
    if job_id is None:
        raise JobNotFound("the link is not valid or has expired.", where="link", hint="Ask for a new one.")
    return app_state.jobs.get(job_id)


SharedOf = Annotated[StoredJob, Depends(_shared)]


@router.get("/shared/{token}/job", include_in_schema=False)
@route_policy(role=None)
def shared_job(token: str, job: SharedOf, app_state: AppStateOf, root: RootOf) -> SharedJob:
    """Return the job of a link, with links that need no key."""
    document = _with_shared_links(job_document(app_state, job.id, root), f"{root}/shared/{token}")
    return SharedJob(job=document, metres_per_unit=_metres_per_unit(app_state, job.scene))


@router.get("/shared/{token}/photo", include_in_schema=False)
@route_policy(role=None, rate_limited=True)
async def shared_photo(job: SharedOf, app_state: AppStateOf, undistorted: Annotated[bool, Query()] = False) -> Response:
    """Return the photo of a link's job."""
    return await job_photo(job, app_state, undistorted)


@router.get("/shared/{token}/trace", include_in_schema=False)
@route_policy(role=None, rate_limited=True)
def shared_trace(job: SharedOf, app_state: AppStateOf) -> Trace:
    """Return the steps of a link's job."""
    return resources.trace_out(job, app_state.jobs.records(job))


@router.get("/shared/{token}/iterations/{index}/render.jpg", include_in_schema=False)
@route_policy(role=None, rate_limited=True)
async def shared_render(
    job: SharedOf, app_state: AppStateOf, index: Literal["last"] | Annotated[int, Field(ge=0)]
) -> Response:
    """Render the scene at a step of a link's job."""
    return await job_render(job, app_state, index)


def _with_shared_links(document: JobOut, base: str) -> JobOut:
    """Return the document with the links that a share link opens; the others are empty."""
    # The others need a key, which whoever has the link lacks.
    links = JobLinks(
        self=f"{base}/job",
        events="",
        photo=f"{base}/photo",
        trace=f"{base}/trace",
        render=f"{base}/iterations/last/render.jpg",
        export="",
        viewer="",
    )
    return document.model_copy(update={"links": links})


def _metres_per_unit(app_state: AppState, scene_id: str) -> float | None:
    info = next((scene.info for scene in app_state.engine.scenes() if scene.id == scene_id), None)
    return info.metres_per_unit if info else None
