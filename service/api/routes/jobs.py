"""What became of a photo: `/jobs`."""

from __future__ import annotations

from collections.abc import AsyncIterator
from functools import partial
from typing import Annotated, Literal
from urllib.parse import urlencode

from anyio import to_thread
from fastapi import APIRouter, Header, Path, Query, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import Field

from service.api import documents
from service.api.convert import record_out
from service.api.exports import EXPORT_TYPES, ExportFormat, exported
from service.api.jobs import Job, JobFilter
from service.api.routes.parts import JPEG, JobOf, PartsOf, RootOf, errors
from service.api.schemas import JobList, JobOut, JobState, Trace
from service.images import encode_image
from service.types import Camera, Status

router = APIRouter()


@router.get("/jobs", tags=["jobs"], responses=errors())
async def list_jobs(
    parts: PartsOf,
    root: RootOf,
    scene: str | None = None,
    estimator: str | None = None,
    state: JobState | None = None,
    status: Annotated[Status | None, Query(description="Of the result.")] = None,
    photo: Annotated[str | None, Query(description="sha256 of the photo's file.")] = None,
    before: Annotated[int | None, Query(description="Where the page starts: take it from `next`.")] = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 100,
) -> JobList:
    """List the jobs that are remembered, newest first; those that fit, where a filter is given."""
    wanted = JobFilter(scene, estimator, state, status, photo, before)
    page = parts.jobs.page(wanted, limit + 1)
    given = {"scene": scene, "estimator": estimator, "state": state, "status": status, "photo": photo, "limit": limit}
    query = {name: value for name, value in given.items() if value is not None}
    more = f"{root}/jobs?{urlencode(query | {'before': page[limit - 1].number})}" if len(page) > limit else None
    return JobList(
        jobs=[documents.job_summary(job, root) for job in page[:limit]],
        next=more,
        queued=parts.jobs.waiting(),
        running=parts.jobs.running(),
    )


@router.get("/jobs/{job_id}", tags=["jobs"], responses=errors(404))
async def get_job(job: JobOf, root: RootOf) -> JobOut:
    """Say how a job stands; with its result or its error when it has ended."""
    return documents.job_document(job, root)


@router.delete("/jobs/{job_id}", tags=["jobs"], responses=errors(404))
async def cancel_job(job: JobOf, parts: PartsOf, root: RootOf) -> JobOut:
    """Cancel: at once if the job waits, after its current step if it runs, without effect if it has ended."""
    parts.jobs.cancel(job)
    return documents.job_document(job, root)


@router.get(
    "/jobs/{job_id}/events",
    tags=["jobs"],
    response_class=EventSourceResponse,
    responses=errors(404),
)
async def job_events(
    job: JobOf, root: RootOf, last_event_id: Annotated[str, Header()] = ""
) -> AsyncIterator[ServerSentEvent]:
    """Follow a job: an event `record` for each step from the first on, then `result` or `error`.

    A `record` has the record's index as id and a `Record` as data. The last event has the id `end` and a
    `JobOut` as data: `result` if the job succeeded, `error` if it failed or was cancelled. `Last-Event-ID`
    resumes.
    """
    sent = int(last_event_id) + 1 if last_event_id.isdecimal() and len(last_event_id) < 10 else 0
    async for done in job.changes():
        for record in job.records[sent:]:
            data = record_out(record).model_dump_json()
            yield ServerSentEvent(event="record", id=str(record.index), raw_data=data)
            sent += 1
        if done:
            data = documents.job_document(job, root).model_dump_json()
            event = "result" if job.state == "succeeded" else "error"
            yield ServerSentEvent(event=event, id="end", raw_data=data)


@router.get("/jobs/{job_id}/photo", tags=["jobs"], response_class=Response, responses=JPEG | errors(404))
async def job_photo(job: JobOf, parts: PartsOf) -> Response:
    """Return the photo as the estimator sees it: upright, undistorted, perhaps reduced."""
    return Response(await to_thread.run_sync(job.jpeg, limiter=parts.rendering), media_type="image/jpeg")


@router.get("/jobs/{job_id}/trace", tags=["jobs"], responses=errors(404))
async def job_trace(job: JobOf) -> Trace:
    """Return all records so far."""
    return documents.job_trace(job)


@router.get(
    "/jobs/{job_id}/iterations/{index}/render.jpg",
    tags=["jobs"],
    response_class=Response,
    responses=JPEG | errors(404, 409),
)
async def job_render(
    job: JobOf,
    parts: PartsOf,
    index: Annotated[
        Literal["last"] | Annotated[int, Field(ge=0)], Path(description="Of the record; `last`: the latest.")
    ],
    camera: Annotated[
        Literal["pose", "matches"],
        Query(description="The record's pose in the photo's size, or the camera that its matches refer to."),
    ] = "pose",
) -> Response:
    """Render the scene as a record's camera sees it."""
    record = job.record(None if index == "last" else index)
    seen_by = Camera(job.intrinsics, record.pose)
    if camera == "matches" and record.matches is not None:
        seen_by = record.matches.render_camera
    render = partial(_rendered_jpeg, job, seen_by)
    return Response(await to_thread.run_sync(render, limiter=parts.rendering), media_type="image/jpeg")


def _rendered_jpeg(job: Job, camera: Camera) -> bytes:
    return encode_image(job.task.scene.rasterizer.render([camera])[0].rgb)


@router.get(
    "/jobs/{job_id}/export/{format}",
    tags=["jobs"],
    response_class=Response,
    responses={
        200: {
            "description": "Text or JSON, as the format has it",
            "content": {kind: {} for kind in EXPORT_TYPES.values()},
        }
    }
    | errors(404, 409),
)
async def export_pose(job: JobOf, format: Annotated[ExportFormat, Path()]) -> Response:
    """Return the pose as other programs read it; not of a job that found none.

    `colmap`: an entry of `images.txt`, its camera in a comment. `nerfstudio`: an entry of `frames` in
    `transforms.json`. `tum`: a line of a trajectory, stamped with the time of the job's acceptance. `geopose`: OGC
    GeoPose 1.0, if the scene's manifest has a `geo_anchor`.
    """
    name, created, result = documents.answer(job)
    return Response(exported(format, name, created, result), media_type=EXPORT_TYPES[format])
