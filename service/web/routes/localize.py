"""`POST /localize`: accept a photo, queue a job."""

from __future__ import annotations

import hashlib
import re
from dataclasses import replace
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Header, Request, Response

from service.jobs.job_order import JobOrder
from service.jobs.model import ENDED, StoredJob
from service.web.middleware.limits import client_of, most_queued, too_large
from service.web.route_policy import PHOTO_BODY, route_policy
from service.web.routes.dependencies import AppState, AppStateOf, RootOf, Visible, VisibleOf, job_document
from service.web.schemas.error_examples import AWAITED_SCENE_ERRORS, errors
from service.web.schemas.job_spec import job_spec, read_fields
from service.web.schemas.jobs import JobOut
from service.web.schemas.request_body import Body, read_body
from service.web.schemas.requests import FIELD_ERRORS, LocalizeFields, LocalizeIn

router = APIRouter()


def _form_schema() -> dict[str, Any]:
    """Return the schema of the multipart form: the JSON body's, with files, and nested fields as JSON text."""
    schema = LocalizeIn.model_json_schema(ref_template="#/components/schemas/{model}")
    # The definitions are among the document's components already.
    schema.pop("$defs", None)
    names = tuple(FIELD_ERRORS)
    listed = ", ".join(f"`{name}`" for name in names[:-1])
    schema["description"] = f"{listed} and `{names[-1]}` are JSON text, unless `gps` is `exif`."
    for name in names:
        described = LocalizeFields.model_fields[name].description or "See the JSON body."
        schema["properties"][name] = {
            "type": "string",
            "contentMediaType": "application/json",
            "description": described,
        }
    schema["properties"]["photo"] = {
        "type": "array",
        "items": {"type": "string", "format": "binary"},
        "minItems": 1,
        "description": "A photo (JPEG, PNG, WebP, HEIC); several of one camera, in the order in which they were taken, "
        "or of the cameras of a `rig`; or a video (MP4, MOV, WebM, Matroska, AVI).",
    }
    return schema


# Described by hand: FastAPI would have to parse the body, and would answer with its own errors.
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
    200: {"description": "With `Prefer: wait=N`: the job ended in time", "model": JobOut},
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
    responses=_ACCEPTED
    | errors(
        *("invalid_request", "bad_request", "unsupported_media_type", "request_timeout", *AWAITED_SCENE_ERRORS),
        *(
            "invalid_image",
            "invalid_intrinsics",
            "invalid_prior",
            "invalid_accuracy",
            "invalid_options",
            "unknown_name",
        ),
        *("backend_missing", "idempotency_conflict", "storage_failed"),
        body=True,
    ),
    openapi_extra=_BODY,
)
@route_policy(role="localize", body=PHOTO_BODY, rate_limited=True, queues_job=True)
async def localize_photo(
    request: Request,
    response: Response,
    app_state: AppStateOf,
    visible: VisibleOf,
    root: RootOf,
    prefer: Annotated[str, Header(description="`wait=N`: wait up to N s for the job to end before answering")] = "",
    idempotency_key: Annotated[
        str | None,
        Header(
            min_length=1,
            max_length=200,
            description="A request that is repeated with the same key returns the same job, and makes no second one",
        ),
    ] = None,
) -> JobOut:
    """Localize a photo: check the request, queue a job, and return it.

    Several photos of one camera, or a video, are one job: the camera is tracked from each frame to the next, an event
    `record` has each frame's answer, and `frames` of the result has all of them. With `rig` the photos are one query.
    """
    body = await read_body(request, app_state.settings.max_frames)
    job = await create_job(request, app_state, visible, body, read_fields(body.fields), idempotency_key)
    wait_s = min(wait_preference(prefer), app_state.settings.max_wait_s)
    if wait_s:
        if live := await to_thread.run_sync(app_state.jobs.live, job):
            await live.wait(wait_s)
        # So that a client can tell a job that took longer from a service that ignores the header (RFC 7240, 3).
        response.headers["Preference-Applied"] = f"wait={wait_s:g}"
    answer = await to_thread.run_sync(job_document, app_state, job.id, root)
    response.headers["Location"] = f"{root}/jobs/{job.id}"
    response.status_code = 200 if answer.state in ENDED else 202
    return answer


async def create_job(
    request: Request,
    app_state: AppState,
    visible: Visible,
    body: Body,
    fields: LocalizeFields,
    idempotency_key: str | None = None,
) -> StoredJob:
    """Validate a request, queue its job. Raises BadInput, SceneError, QueueFull, IdempotencyConflict, StorageFailed;
    HTTPException 413.
    """
    # The same as for the limits: idempotency keys of different clients are independent.
    client = client_of(request.scope)
    # The whole body was allowed a third more, for base64.
    if len(body.photo) > app_state.settings.upload_limit:
        raise too_large(app_state.settings.upload_limit)

    def accept() -> StoredJob:
        sha256 = hashlib.sha256(body.photo).hexdigest()
        # Of the validated fields: the same request as form and as JSON is the same job. Requests of before there were
        # these fields keep their digest.
        later = ("camera_id", "accuracy", "rig", "up_in_camera", "gps", "heading")
        absent = {name for name in later if getattr(fields, name) is None}
        digest = hashlib.sha256((fields.model_dump_json(exclude=absent) + sha256).encode()).hexdigest()
        spec = job_spec(fields, app_state.settings.estimator)
        named = (spec.scene,) if isinstance(spec.scene, str) else spec.scene or ()
        spec = replace(spec, scene=visible.asked(spec.scene, app_state.known_scenes(named)))
        most = most_queued(request.state.caller, app_state.settings.queue_size)
        order = JobOrder(body.photo, body.name, sha256, spec, client, idempotency_key, digest, client, most)
        return app_state.jobs.accept(order)

    # Decoding takes up to seconds: not on the event loop.
    return await to_thread.run_sync(accept, limiter=app_state.decoding)


def wait_preference(header: str) -> float:
    """Return the seconds of `wait=N` in a Prefer header (RFC 7240); 0 if it has none."""
    found = re.search(r'(?:^|[,;])\s*wait\s*=\s*"?(\d{1,6})\b', header, re.IGNORECASE)
    return float(found.group(1)) if found else 0.0
