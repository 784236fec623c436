"""`/jobs`: state, records, photo, renders and exports of jobs."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import Annotated, Literal
from urllib.parse import urlencode

from anyio import to_thread
from fastapi import APIRouter, Header, Path, Query, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import Field

from service.jobs.model import JobFilter, JobRecord, JobState
from service.results import Status
from service.scene_manager.status import PictureSpec
from service.web.route_policy import SMALL_BODY, route_policy
from service.web.routes.dependencies import JPEG, AppStateOf, JobOf, RootOf, VisibleOf, job_document
from service.web.schemas import resources
from service.web.schemas.conversion import record_camera, record_out, result_out
from service.web.schemas.error_examples import SCENE_ERRORS, errors
from service.web.schemas.exports import EXPORT_TYPES, ExportFormat, exported
from service.web.schemas.jobs import JobList, JobOut, Restarted, Trace

router = APIRouter()


@router.get("/jobs", tags=["jobs"], responses=errors("invalid_request"))
@route_policy(role="read")
def list_jobs(
    app_state: AppStateOf,
    visible: VisibleOf,
    root: RootOf,
    scene: str | None = None,
    estimator: str | None = None,
    state: JobState | None = None,
    status: Annotated[Status | None, Query(description="Status of the result.")] = None,
    photo: Annotated[str | None, Query(description="sha256 of the photo's file.")] = None,
    before: Annotated[int | None, Query(ge=0, lt=2**63, description="Start of the page, as `next` has it.")] = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 100,
) -> JobList:
    """List the stored jobs that match all given filters, newest first, in pages: the own key's; an admin's are all."""
    wanted = JobFilter(scene, estimator, state, status, photo, before, visible.owner)
    # One more than the page has: whether there is a next page.
    page = app_state.jobs.page(wanted, limit + 1)
    given = {"scene": scene, "estimator": estimator, "state": state, "status": status, "photo": photo, "limit": limit}
    query = {name: value for name, value in given.items() if value is not None}
    # By the last job's number, not by an offset: jobs that come meanwhile shift no page.
    more = f"{root}/jobs?{urlencode(query | {'before': page[limit - 1].number})}" if len(page) > limit else None
    return JobList(
        jobs=[resources.job_summary_out(job, root) for job in page[:limit]],
        next=more,
        queued=app_state.jobs.waiting(visible.owner),
        running=app_state.jobs.running(visible.owner),
    )


@router.get("/jobs/{job_id}", tags=["jobs"], responses=errors("job_not_found"))
@route_policy(role="read")
def get_job(job: JobOf, app_state: AppStateOf, root: RootOf) -> JobOut:
    """Return a job; with its result or its error if it has ended."""
    return job_document(app_state, job.id, root)


@router.delete(
    "/jobs/{job_id}",
    tags=["jobs"],
    responses=errors("job_not_found", "job_not_ready", "invalid_request", "storage_failed", body=True),
)
@route_policy(role="localize", body=SMALL_BODY, rate_limited=True)
def cancel_job(
    job: JobOf,
    app_state: AppStateOf,
    root: RootOf,
    purge: Annotated[bool, Query(description="Delete an ended job with its records, result and photo.")] = False,
) -> JobOut:
    """Cancel a job: at once if it is queued, after its current step if it runs, without effect if it has ended.

    With `purge` an ended job is deleted instead, and returned as it was; one that has not ended is refused.
    """
    if purge:
        document = job_document(app_state, job.id, root)
        app_state.jobs.delete(job)
        return document
    app_state.jobs.cancel(job)
    return job_document(app_state, job.id, root)


@router.get(
    "/jobs/{job_id}/events",
    tags=["jobs"],
    response_class=EventSourceResponse,
    responses=errors("job_not_found"),
)
@route_policy(role="read")
async def job_events(
    job: JobOf, app_state: AppStateOf, root: RootOf, last_event_id: Annotated[str, Header()] = ""
) -> AsyncIterator[ServerSentEvent]:
    """Stream a job as server-sent events: `record` for each step from the first on, then `result` or `error`.

    A `record` has `attempt.index` as id and a `Record` as data. If an attempt is lost, e.g. by a crash, the job is
    started again: after an event `restarted`, without an id and with a `Restarted` as data, the records of the new
    attempt follow from index 0 on, and replace the earlier ones. The last event has the id `end` and a `JobOut` as
    data: `result` if the job succeeded, else `error`. `Last-Event-ID` resumes, also after a restart of the service.
    """
    stream = _EventStream.after(last_event_id)
    if live := await to_thread.run_sync(app_state.jobs.live, job):
        async for _ in live.changes():
            attempt, records = live.progress
            if attempt:  # 0: queued again after a restart of the service
                for event in await stream.events(attempt, records):
                    yield event
    job = await to_thread.run_sync(app_state.jobs.get, job.id)
    for event in await stream.events(job.attempt, await to_thread.run_sync(app_state.jobs.records, job)):
        yield event
    if job.ended:  # else the service is shutting down; the client reconnects with Last-Event-ID
        ended = await to_thread.run_sync(job_document, app_state, job.id, root)
        name = "result" if ended.result else "error"
        yield ServerSentEvent(event=name, id="end", raw_data=ended.model_dump_json())


@dataclass(slots=True)
class _EventStream:
    """What a client has received: the latest attempt, and how many of its records."""

    attempt: int = 0
    sent: int = 0

    @classmethod
    def after(cls, last_event_id: str) -> _EventStream:
        """Return the state of a client whose last event had that id; an unknown id starts from the beginning."""
        # The header is the client's: nine digits, so that no number of any length is parsed.
        found = re.fullmatch(r"(\d{1,9})\.(\d{1,9})", last_event_id)
        return cls(int(found[1]), int(found[2]) + 1) if found else cls()

    async def events(self, attempt: int, records: Sequence[JobRecord]) -> list[ServerSentEvent]:
        """Return the events that the client lacks of an attempt's records, and count them as sent."""
        events: list[ServerSentEvent] = []
        if attempt != self.attempt:
            if self.attempt:
                restarted = Restarted(attempt=attempt).model_dump_json()
                events.append(ServerSentEvent(event="restarted", raw_data=restarted))
            self.attempt, self.sent = attempt, 0
        # Records can be large: they are converted on a thread.
        fresh = records[self.sent :]
        for text in await to_thread.run_sync(_record_texts, fresh) if fresh else ():
            events.append(ServerSentEvent(event="record", id=f"{attempt}.{self.sent}", raw_data=text))
            self.sent += 1
        return events


def _record_texts(records: Sequence[JobRecord]) -> list[str]:
    return [record_out(record.step, record.frame).model_dump_json() for record in records]


@router.get(
    "/jobs/{job_id}/photo",
    tags=["jobs"],
    response_class=Response,
    responses=JPEG | errors("invalid_request", "job_not_found", "photo_gone", "job_not_ready"),
)
@route_policy(role="read")
async def job_photo(
    job: JobOf,
    app_state: AppStateOf,
    undistorted: Annotated[
        bool, Query(description="Remove the distortion that the latest record estimates, too: it then fits its render.")
    ] = False,
) -> Response:
    """Return the photo as the estimator gets it: upright, without the distortion of its intrinsics, reduced if large.

    It is deleted some time after the job, unless the request has `keep_photo`.
    """
    read = app_state.jobs.undistorted_photo if undistorted else app_state.jobs.photo
    photo = await to_thread.run_sync(read, job, limiter=app_state.rendering)
    return Response(photo, media_type="image/jpeg")


@router.get("/jobs/{job_id}/trace", tags=["jobs"], responses=errors("job_not_found"))
@route_policy(role="read")
def job_trace(job: JobOf, app_state: AppStateOf) -> Trace:
    """Return all records of the latest attempt so far."""
    return resources.trace_out(job, app_state.jobs.records(job))


@router.get(
    "/jobs/{job_id}/iterations/{index}/render.jpg",
    tags=["jobs"],
    response_class=Response,
    responses=JPEG | errors("invalid_request", "job_not_found", "record_not_found", "job_not_ready", *SCENE_ERRORS),
)
@route_policy(role="read")
async def job_render(
    job: JobOf,
    app_state: AppStateOf,
    index: Annotated[
        Literal["last"] | Annotated[int, Field(ge=0)], Path(description="Index of the record; `last`: the latest.")
    ],
    camera: Annotated[
        Literal["pose", "matches"],
        Query(description="`pose`: the record's pose, photo's size; `matches`: the camera that its matches refer to."),
    ] = "pose",
) -> Response:
    """Render the scene from the camera of a record."""
    record = await to_thread.run_sync(app_state.jobs.record, job, None if index == "last" else index)
    seen_by = record_camera(record.step, job.photo.intrinsics, of_matches=camera == "matches")
    # Rendered when it is asked for: few of a job's records are ever looked at.
    wanted = PictureSpec(seen_by.pose, seen_by.intrinsics)
    render = partial(app_state.engine.render, job.scene, wanted)
    return Response(await app_state.render_in_thread(job.scene, render), media_type="image/jpeg")


@router.get(
    "/jobs/{job_id}/export/{format}",
    tags=["jobs"],
    response_class=Response,
    responses={
        200: {
            "description": "Text or JSON, by format",
            "content": {kind: {} for kind in EXPORT_TYPES.values()},
        }
    }
    | errors("invalid_request", "job_not_found", "no_geo_anchor", "job_not_ready", "no_pose"),
)
@route_policy(role="read")
def export_pose(
    job: JobOf,
    app_state: AppStateOf,
    format: Annotated[ExportFormat, Path()],
    smooth: Annotated[
        bool,
        Query(description="Of a sequence: filter the jitter, each pose by its covariance, and join gaps of up to 1 s."),
    ] = False,
) -> Response:
    """Return the pose in the format of another program, unless the job is `not_localized`.

    `colmap`: an entry of `images.txt`, with its camera in a comment. `nerfstudio`: an entry of `frames` in
    `transforms.json`. `tum`: a line of a trajectory, with the time at which the job was created. `geopose`: OGC
    GeoPose 1.0, if the scene's manifest has a `geo_anchor`. Of a job with several photos: all that were localized, as
    an `images.txt`, a `transforms.json`, or a trajectory with the photos' times; `geopose` has the last one only.
    Interpolated poses of a smoothed sequence are marked: by a comment line before them, or in nerfstudio's entry.
    """
    resources.require_pose(job)
    created, result = datetime.fromtimestamp(job.created, UTC), result_out(app_state.jobs.result(job))
    return Response(exported(format, job.photo.name, created, result, smooth=smooth), media_type=EXPORT_TYPES[format])
