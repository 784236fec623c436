"""The routes: thin. Each takes validated values, asks the jobs or the scenes, and returns a model.

POST   /localize                              202 + Location (200 with `Prefer: wait=N` when done in time)
GET    /jobs                                  newest first
GET    /jobs/{id}                             state, result or error
DELETE /jobs/{id}                             cancel; takes effect between two records
GET    /jobs/{id}/events                      server-sent events: `record`..., then `result` or `error`
GET    /jobs/{id}/photo                       JPEG: upright, as decoded
GET    /jobs/{id}/trace                       all records
GET    /jobs/{id}/iterations/{k}/render.jpg   record k's pose (or `last`), photo's size
GET    /scenes                                GET /scenes/{id}
GET    /scenes/{id}/splats?max=N              binary, see `service/api/splats.py`
GET    /capabilities, /version, /livez, /readyz
"""

from __future__ import annotations

import re
from collections.abc import AsyncIterator
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import anyio
from anyio import to_thread
from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import Field

from service.api import documents, splats
from service.api.convert import record_out
from service.api.intake import make_task, read_body, read_fields
from service.api.jobs import Job, Jobs
from service.api.problems import MEDIA_TYPE
from service.api.scenes import Scenes
from service.api.schemas import (
    Capabilities,
    JobList,
    JobOut,
    Liveness,
    LocalizeFields,
    LocalizeIn,
    Readiness,
    SceneList,
    SceneOut,
    Trace,
)
from service.api.settings import Settings
from service.images import encode_image
from service.types import Camera

MAX_SPLATS = 2_000_000


@dataclass(frozen=True, slots=True)
class Parts:
    """What the routes work with; one per app."""

    settings: Settings
    scenes: Scenes
    jobs: Jobs
    decoding: anyio.CapacityLimiter
    """Photos decoded at once: each may take 200 MB for a moment."""
    rendering: anyio.CapacityLimiter
    """Pictures rendered at once for looking at: a renderer's thread keeps working memory."""


def _parts(request: Request) -> Parts:
    return request.app.state.parts


def _root(request: Request) -> str:
    return request.scope.get("root_path", "")


def _job(parts: PartsOf, job_id: Annotated[str, Path(description="The job's id.")]) -> Job:
    return parts.jobs.get(job_id)


PartsOf = Annotated[Parts, Depends(_parts)]
RootOf = Annotated[str, Depends(_root)]
JobOf = Annotated[Job, Depends(_job)]


def errors(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Document the problem documents that a route may answer with."""
    return {status: {"description": _MEANINGS[status], "content": _PROBLEM} for status in statuses} | {
        "default": {"description": "Any other error", "content": _PROBLEM}
    }


_PROBLEM = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
_MEANINGS = {
    400: "The request can't be understood",
    404: "There is no such thing",
    409: "Not yet",
    413: "The body is too large",
    415: "Neither a multipart form nor JSON",
    422: "A value is wrong: the photo, intrinsics, prior, options, or the scene's own file",
    501: "What was asked for can't run on this machine",
    503: "Too much work is waiting, or the scene is still loading; see Retry-After",
}
_JPEG = {200: {"description": "JPEG", "content": {"image/jpeg": {}}}}

router = APIRouter()


def _form_schema() -> dict[str, Any]:
    """The multipart form: as the JSON body, but the photo is a file and the nested fields are JSON text."""
    schema = LocalizeIn.model_json_schema(ref_template="#/components/schemas/{model}")
    schema.pop("$defs", None)
    schema["description"] = "`options`, `intrinsics` and `prior` are JSON text."
    for name in ("options", "intrinsics", "prior"):
        described = LocalizeFields.model_fields[name].description or "See the JSON body."
        schema["properties"][name] = {
            "type": "string",
            "contentMediaType": "application/json",
            "description": described,
        }
    schema["properties"]["photo"] = {
        "type": "string",
        "format": "binary",
        "description": "JPEG, PNG, WebP or HEIC.",
    }
    return schema


_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {"schema": _form_schema()},
            "application/json": {"schema": {"$ref": "#/components/schemas/LocalizeIn"}},
        },
    }
}
_ACCEPTED = {
    200: {"description": "`Prefer: wait=N`, and the job ended in time", "model": JobOut},
    202: {
        "description": "Accepted",
        "headers": {"Location": {"description": "The job", "schema": {"type": "string"}}},
    },
}


@router.post(
    "/localize",
    status_code=202,
    tags=["localize"],
    response_model=JobOut,
    responses=_ACCEPTED | errors(400, 404, 413, 415, 422, 501, 503),
    openapi_extra=_BODY,
)
async def localize_photo(
    request: Request,
    response: Response,
    parts: PartsOf,
    root: RootOf,
    prefer: Annotated[str, Header(description="`wait=N`: answer with the ended job if it takes at most N s")] = "",
) -> JobOut:
    """Find where a photo was taken. What is wrong with the request is told at once; the search is a job."""
    body = await read_body(request)
    fields = read_fields(body.fields)
    scene = parts.scenes.get(fields.scene)
    prepare = partial(make_task, body, fields, scene, parts.settings.estimator)
    job = parts.jobs.submit(*await to_thread.run_sync(prepare, limiter=parts.decoding))
    wait_s = min(wait_preference(prefer), parts.settings.max_wait_s)
    if wait_s:
        await job.wait(wait_s)
        response.headers["Preference-Applied"] = f"wait={wait_s:g}"
    response.headers["Location"] = f"{root}/jobs/{job.id}"
    response.status_code = 200 if job.done else 202
    return documents.job_document(job, root)


def wait_preference(header: str) -> float:
    """Return the seconds of `wait=N` in a Prefer header (RFC 7240); 0 if it has none."""
    found = re.search(r'(?:^|[,;])\s*wait\s*=\s*"?(\d{1,6})\b', header, re.IGNORECASE)
    return float(found.group(1)) if found else 0.0


@router.get("/jobs", tags=["jobs"], responses=errors())
async def list_jobs(parts: PartsOf, root: RootOf) -> JobList:
    """List the jobs that are remembered, newest first."""
    jobs = [documents.job_summary(job, root) for job in parts.jobs.newest_first()]
    running = sum(job.state == "running" for job in jobs)
    return JobList(jobs=jobs, queued=parts.jobs.waiting(), running=running)


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


@router.get("/jobs/{job_id}/photo", tags=["jobs"], response_class=Response, responses=_JPEG | errors(404))
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
    responses=_JPEG | errors(404, 409),
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


@router.get("/scenes", tags=["scenes"], responses=errors())
async def list_scenes(parts: PartsOf, root: RootOf) -> SceneList:
    """List the scenes and how far they have come."""
    return SceneList(scenes=[documents.scene_summary(entry, root) for entry in parts.scenes.entries()])


@router.get("/scenes/{scene_id}", tags=["scenes"], responses=errors(404))
def get_scene(scene_id: str, parts: PartsOf, root: RootOf) -> SceneOut:
    """Describe a scene, with its training cameras."""
    return documents.scene_document(parts.scenes.entry(scene_id), root)


@router.get(
    "/scenes/{scene_id}/splats",
    tags=["scenes"],
    response_class=Response,
    responses={
        200: {
            "description": (splats.__doc__ or "").split("\n", 1)[1].strip(),
            "content": {splats.BINARY: {"schema": {"type": "string", "format": "binary"}}},
        }
    }
    | errors(404, 422, 503),
)
async def scene_splats(
    scene_id: str,
    parts: PartsOf,
    limit: Annotated[int, Query(alias="max", ge=1, le=MAX_SPLATS, description="At most so many.")] = 200_000,
) -> Response:
    """Return the scene's most important Gaussians for drawing, as little-endian binary."""
    pack = partial(splats.packed_splats, parts.scenes.get(scene_id).scene, limit)
    return Response(await to_thread.run_sync(pack, limiter=parts.rendering), media_type=splats.BINARY)


@router.get("/capabilities", tags=["service"], responses=errors())
def get_capabilities(parts: PartsOf) -> Capabilities:
    """Say which estimators, matchers, renderers and formats there are, and the estimators' options."""
    return documents.capabilities(parts.settings)


@router.get("/version", tags=["service"], responses=errors())
def get_version() -> dict[str, str]:
    """Return the versions of this service and of what its results depend on."""
    return documents.versions()


@router.get("/livez", tags=["service"], responses=errors())
async def live() -> Liveness:
    """Answer, as long as the process can."""
    return Liveness()


@router.get("/readyz", tags=["service"], responses={503: {"model": Readiness, "description": "Not yet"}} | errors())
async def ready(parts: PartsOf, response: Response) -> Readiness:
    """Say whether photos can be localized at full speed: scenes loaded, kernels compiled, indexes made."""
    readiness = parts.scenes.readiness()
    response.status_code = 200 if readiness.ready else 503
    return readiness
