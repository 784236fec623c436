"""All errors of the API by code, each with an example, for `openapi.yaml`.

Status and fields are those of real responses, since examples are converted as exceptions are. Their texts are copies:
`test_errors.py` compares each with what a request is answered, but for names and numbers.
"""

from __future__ import annotations

from typing import Any

from starlette.exceptions import HTTPException

from service import errors as e
from service.web.problems import MEDIA_TYPE, RETRY_AFTER_S, Problem, problem_of

_JOB, _SCENE = "/jobs/3f9c2a7be1d04c58", "/scenes/studio"
_AGAIN = "Try again later."

_EXAMPLES: tuple[tuple[Exception, str], ...] = (
    (
        e.InvalidRequest("Input should be a valid integer, unable to parse string as an integer.", where="seed"),
        "/localize",
    ),
    (e.InvalidImage("not a JPEG, PNG, WebP or HEIC photo.", where="photo"), "/localize"),
    (e.InvalidIntrinsics("must be a positive focal length in pixels, is 0.0.", where="intrinsics.fx"), "/localize"),
    (e.InvalidPrior("the last row must be 0 0 0 1.", where="prior.world_from_camera"), "/localize"),
    (
        e.InvalidAccuracy(
            "scene 'studio' has no scale, so metres mean nothing in it.",
            where="accuracy.metres",
            hint='Ask for units or share, or put "metres_per_unit" into a scene.json beside the scene file.',
        ),
        "/localize",
    ),
    (
        e.InvalidOptions("'view_index' has no such option; it has: candidates, effort.", where="options.topk"),
        "/localize",
    ),
    (
        e.UnknownName(
            "unknown value 'magic'; known: icomma, inerf, inerf_dagger, mc_do, pnerf, view_index.", where="estimators"
        ),
        "/localize",
    ),
    (e.BackendMissing("'my_method' can't run here: it needs a CUDA device.", where="estimators"), "/localize"),
    (e.DeviceMemoryFull("the GPU has too little memory left.", where="render"), f"{_SCENE}/render"),
    (
        e.IdempotencyConflict(
            "the key was used for job 3f9c2a7be1d04c58, which was another request.",
            where="header.idempotency-key",
            hint="Use a new key for a new request.",
        ),
        "/localize",
    ),
    (e.QueueFull("the queue is full: 32 jobs.", hint=_AGAIN), "/localize"),
    (e.RateLimited("rate limit exceeded: 30/second.", hint="Slow down.", retry_after_s=1), "/localize"),
    (e.StorageFailed("the service can't write the photo to disk: No space left on device."), "/localize"),
    (e.BadInput("the scene has no file to reload it from.", where="scene"), f"{_SCENE}/unload"),
    (e.SceneNotFound("unknown scene 'attic'.", where="scene"), "/scenes/attic"),
    (
        e.SceneNotReady("scene 'studio' is loading.", where="scene", hint=_AGAIN),
        f"{_SCENE}/render",
    ),
    (
        e.SceneUnloaded("scene 'studio' was unloaded.", where="scene", hint="Load it: POST /scenes/studio/load."),
        "/localize",
    ),
    (
        e.SceneTooLarge(
            "scene 'studio' takes 2812.0 MB, and all scenes together may take 2000.0 MB.",
            where="scene",
            hint="Raise SPLATFIX_SCENE_MEMORY_BYTES, or serve a smaller scene.",
        ),
        "/localize",
    ),
    (e.SceneExists("scene 'studio' already exists.", where="scene", hint="Delete it first."), _SCENE),
    (e.SceneInUse("2 jobs use the scene.", where="scene", hint="Unload it, and wait for them."), _SCENE),
    (
        e.CorruptScene(
            "truncated: the header has 9 of 'vertex', the file ends after 4.",
            where="scene.ply, byte 1011",
            hint="Copy or export it again.",
        ),
        "/localize",
    ),
    (
        e.UnsupportedFormat("no element 'vertex' of plain properties: not a 3DGS scene.", where="scene.ply"),
        "/localize",
    ),
    (e.JobNotFound("job '3f9c2a7be1d04c58' not found or expired.", where="job"), _JOB),
    (
        e.RecordNotFound("the job has 12 records and is succeeded.", where="iterations"),
        f"{_JOB}/iterations/12/render.jpg",
    ),
    (e.AnchorNotFound("anchor 'door' not found.", where="name"), f"{_SCENE}/anchors/door"),
    (e.KeyNotFound("key 'robot' not found.", where="name"), "/keys/robot"),
    (e.LensNotFound("lens '0123456789abcdef' not found.", where="lens"), "/lenses/0123456789abcdef"),
    (
        e.RegistrationFailed(
            "scale, up, heading, position can't be determined: all 4 places coincide within their noise.",
            where="registration",
            hint="Add places elsewhere, photos with poses, a length, or what is up.",
        ),
        f"{_SCENE}/registration",
    ),
    (e.RegistrationNotFound("the scene is not registered.", where="scene"), f"{_SCENE}/registration"),
    (e.JobNotReady("the job is running.", where="job"), f"{_JOB}/export/colmap"),
    (
        e.NoPose("the job found no pose that could be used.", where="job", hint="See its reason: GET /jobs/ID."),
        f"{_JOB}/export/colmap",
    ),
    (
        e.NoGeoAnchor(
            "scene 'studio' has no geo_anchor.",
            where="format",
            hint="Give its scene.json a geo_anchor, and localize again.",
        ),
        f"{_JOB}/export/geopose",
    ),
    (
        e.PhotoGone(
            "the photo was deleted after the job.",
            where="photo",
            hint="Send keep_photo=true to have it kept as long as the job.",
        ),
        f"{_JOB}/photo",
    ),
    (e.DeadlineExceeded("there was no answer within 60 s."), "/geopose"),
    (e.Interrupted("the service ended 3 times while this job ran."), "/geopose"),
    (e.EstimatorFault("'view_index' ended without a record."), "/geopose"),
    (
        e.Unauthorized("an API key is needed here.", hint="Send it: Authorization: Bearer KEY."),
        "/jobs",
    ),
    (e.Forbidden("the key's role is read, needed is localize."), "/localize"),
    (e.NoKeys("the service has no keys: its pages need none.", where="header.authorization"), "/tokens"),
    (HTTPException(400, "Missing boundary in multipart."), "/localize"),
    (HTTPException(404, "Not Found"), "/nowhere"),
    (HTTPException(405, "Method Not Allowed"), "/localize"),
    (HTTPException(408, "The body took too long to arrive."), "/localize"),
    (HTTPException(413, "Upload too large (limit 50 MB)."), "/localize"),
    (HTTPException(415, "Send multipart/form-data or application/json, not 'image/jpeg'."), "/localize"),
    (HTTPException(503, "The viewer does not answer; it may be starting."), "/viewer/"),
    (RuntimeError(), f"{_JOB}/photo"),
)

EXAMPLES: dict[str, Problem] = {p.code: p for p in (problem_of(error, path) for error, path in _EXAMPLES)}
"""By code."""

ALWAYS = ("unauthorized", "forbidden", "internal_error")
"""Errors of every operation."""
WITH_BODY = ("content_too_large", "rate_limited", "queue_full")
"""Errors of operations other than GET, sent before the body is read."""
AWAITED_SCENE_ERRORS = (
    "scene_not_found",
    "scene_unloaded",
    "corrupt_scene",
    "unsupported_format",
    "scene_too_large",
)
"""Errors of operations that wait for their scene."""
SCENE_ERRORS = (*AWAITED_SCENE_ERRORS, "scene_not_ready")
"""Errors of operations that need a loaded scene."""

_MEANINGS = {
    400: "The request is malformed",
    401: "An API key is needed, or it is not valid",
    403: "The key's role is too low, or another site's page sent the request",
    404: "Not found",
    408: "The body took too long to arrive",
    409: "The state of the job or scene does not allow it",
    413: "The body is too large",
    415: "Neither a multipart form nor JSON",
    422: "A value is invalid: the photo, intrinsics, prior, options, or the scene's file",
    429: "Too many requests of this client; see Retry-After",
    500: "The service failed",
    501: "The requested plug-in can't run on this machine",
    503: "The queue is full, storage failed, or the scene is still loading; see Retry-After",
    504: "Not finished in time",
}
_RETRY = {"Retry-After": {"description": "Seconds", "schema": {"type": "integer"}, "example": RETRY_AFTER_S}}
_CHALLENGE = {"WWW-Authenticate": {"schema": {"type": "string"}, "example": "Bearer"}}


def errors(*codes: str, body: bool = False, always: tuple[str, ...] = ALWAYS) -> dict[int | str, dict[str, Any]]:
    """Return the `responses` of an operation for its error codes; `body`: it is no GET."""
    found: dict[int, dict[str, Any]] = {}
    # Several codes share a status: each is an example of the same response.
    for code in dict.fromkeys((*codes, *(WITH_BODY if body else ()), *always)):
        status = EXAMPLES[code].status
        response = found.setdefault(status, _response(status))
        response["content"][MEDIA_TYPE]["examples"][code] = {"$ref": f"#/components/examples/{code}"}
    return dict(sorted(found.items()))


def _response(status: int) -> dict[str, Any]:
    headers = _RETRY if status in (429, 503) else _CHALLENGE if status == 401 else None
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}, "examples": {}}}
    return {"description": _MEANINGS[status], **({"headers": headers} if headers else {}), "content": content}


def example_components() -> dict[str, Any]:
    """Return `components.examples`."""
    return {code: {"summary": p.title, "value": p.model_dump()} for code, p in sorted(EXAMPLES.items())}
