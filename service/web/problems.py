"""Every error becomes a problem document (RFC 9457), whether our code, a validation or the router raises it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from typing import Any, get_args

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from pydantic import BaseModel
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match
from starlette.types import Message, Receive, Scope, Send

from service.errors import (
    AnchorNotFound,
    BackendMissing,
    BadInput,
    DeadlineExceeded,
    DeviceMemoryFull,
    Failure,
    Forbidden,
    IdempotencyConflict,
    Interrupted,
    InvalidRequest,
    JobNotFound,
    JobNotReady,
    KeyNotFound,
    LensNotFound,
    NoGeoAnchor,
    NoKeys,
    NoPose,
    PhotoGone,
    QueueFull,
    RateLimited,
    RecordNotFound,
    RegistrationNotFound,
    SceneError,
    SceneExists,
    SceneInUse,
    SceneNotFound,
    SceneNotReady,
    SceneTooLarge,
    SceneUnloaded,
    SplatfixError,
    StorageFailed,
    Unauthorized,
)
from service.web.api_model import Model
from service.web.hints import hint_for

_log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
RETRY_AFTER_S = 5
_DRAIN_S = 2.0
"""How long the rest of a refused body is read and dropped."""

# The first matching class decides, so subclasses come before their base. SplatfixError itself is a bug.
_STATUS: tuple[tuple[type[SplatfixError], int], ...] = (
    (InvalidRequest, 400),
    (BadInput, 422),
    (SceneNotFound, 404),
    (SceneNotReady, 503),
    (SceneTooLarge, 409),
    (SceneUnloaded, 409),
    (SceneExists, 409),
    (SceneInUse, 409),
    (SceneError, 422),
    (JobNotFound, 404),
    (RecordNotFound, 404),
    (LensNotFound, 404),
    (KeyNotFound, 404),
    (AnchorNotFound, 404),
    (RegistrationNotFound, 404),
    (JobNotReady, 409),
    (NoPose, 409),
    (NoGeoAnchor, 404),
    (PhotoGone, 404),
    (IdempotencyConflict, 422),
    (DeadlineExceeded, 504),
    (Interrupted, 503),
    (StorageFailed, 503),
    (QueueFull, 503),
    (RateLimited, 429),
    (Unauthorized, 401),
    (Forbidden, 403),
    (NoKeys, 409),
    (BackendMissing, 501),
    (DeviceMemoryFull, 503),
    (SplatfixError, 500),
)

# Errors of HTTP itself. Not derived from http.HTTPStatus, whose phrases differ between Python versions.
_HTTP_CODES = {
    400: "bad_request",
    404: "not_found",
    405: "method_not_allowed",
    408: "request_timeout",
    413: "content_too_large",
    415: "unsupported_media_type",
    503: "unavailable",
}


class Problem(Model):
    """An error as RFC 9457 defines it: the body of every error response, `application/problem+json`."""

    type: str
    """`urn:splatfix:error:<code>`."""
    title: str
    """The code in words."""
    status: int
    """The HTTP status."""
    detail: str
    """What is wrong."""
    instance: str
    """Path of the request."""
    code: str
    """Stable name of the error, for programs."""
    where: str = ""
    """Field, file or element that is concerned; empty if there is none."""
    hint: str = ""
    """What to do about it; for a field, what it may have, with an example."""


def problem_of(error: Exception, instance: str) -> Problem:
    """Describe an exception. Details of unexpected ones go to the log only."""
    if isinstance(error, SplatfixError):
        return _problem(_status(type(error)), error.code, error.message, instance, error.where, error.hint)
    if isinstance(error, ClientDisconnect):
        return _problem(400, "bad_request", "The client disconnected before it had sent everything.", instance)
    if isinstance(error, HTTPException):
        code = _HTTP_CODES.get(error.status_code, "http_error")
        return _problem(error.status_code, code, str(error.detail), instance)
    return problem_of_failure(Failure.of(error), instance)


def problem_of_failure(failure: Failure, instance: str) -> Problem:
    """Describe a stored error, as `problem_of` would have described the exception."""
    # 500: `internal_error` belongs to no SplatfixError.
    status = _status_by_code().get(failure.code, 500)
    return _problem(status, failure.code, failure.message, instance, failure.where, failure.hint)


def _status(kind: type[SplatfixError]) -> int:
    return next(status for listed, status in _STATUS if issubclass(kind, listed))


@cache
def _status_by_code() -> dict[str, int]:
    """Return the HTTP status of every SplatfixError, by its code."""
    # Found by their classes, so that a new error needs no second list here.
    kinds, found = [SplatfixError], {}
    while kinds:
        kind = kinds.pop()
        kinds += kind.__subclasses__()
        found[kind.code] = _status(kind)
    return found


def _problem(status: int, code: str, detail: str, instance: str, where: str = "", hint: str = "") -> Problem:
    return Problem(
        type=f"urn:splatfix:error:{code}",
        title=code.replace("_", " ").capitalize(),
        status=status,
        detail=_sendable(detail),
        instance=_sendable(instance),
        code=code,
        where=_sendable(where),
        hint=_sendable(hint or hint_for(code, where)),
    )


def _sendable(text: str) -> str:
    """Replace unpaired surrogates, which JSON can contain and UTF-8 can't."""
    return text.encode("utf-8", "replace").decode()


def problem_response(error: Exception, path: str) -> Response:
    """Return the response for an exception."""
    headers = dict(getattr(error, "headers", None) or {})
    if isinstance(error, SplatfixError) and error.retry_after_s:
        headers["Retry-After"] = str(error.retry_after_s)
    return problem_answer(problem_of(error, path), path, headers)


def problem_answer(problem: Problem, path: str, headers: Mapping[str, str] | None = None) -> Response:
    """Return the response for a problem of the request to `path`."""
    retry = {"Retry-After": str(RETRY_AFTER_S)} if problem.status in (429, 503) else {}
    problem = problem.model_copy(update={"instance": path})
    # An error may have a Retry-After of its own, which replaces the default.
    return Response(problem.model_dump_json(), problem.status, {**retry, **(headers or {})}, MEDIA_TYPE)


async def refuse(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    """Send a response before the body is read; then drop what still arrives of the body for a moment.

    TCP resets a connection that is closed while data arrives, and the client would lose the response. A WebSocket is
    refused in its handshake, with the response where the server can send one.
    """
    if scope["type"] == "websocket":
        await receive()  # websocket.connect, which ASGI wants read before the answer
        if "websocket.http.response" in scope.get("extensions", {}):
            await response(scope, receive, send)
        else:
            await send({"type": "websocket.close", "code": 1008})
        return

    async def keep_open(message: Message) -> None:
        await send({**message, "more_body": True} if message["type"] == "http.response.body" else message)

    await response(scope, receive, keep_open)
    with suppress(TimeoutError):
        async with asyncio.timeout(_DRAIN_S):
            while (await receive()).get("more_body"):
                pass
    await send({"type": "http.response.body", "body": b""})


def add_error_handlers(app: FastAPI) -> None:
    """Make the app answer every error with a problem document."""

    async def answer(request: Request, error: Exception) -> Response:
        response = problem_response(error, request.url.path)
        if response.status_code == 405:
            response.headers["Allow"] = ", ".join(sorted(_allowed(request)))
        return response

    async def answer_validation(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        return problem_response(invalid_request(error.errors()), request.url.path)

    app.add_exception_handler(SplatfixError, answer)
    app.add_exception_handler(HTTPException, answer)
    app.add_exception_handler(ClientDisconnect, answer)  # nobody reads it; keeps it out of the log
    app.add_exception_handler(RequestValidationError, answer_validation)


def _allowed(request: Request) -> set[str]:
    """Return the methods of a path. The router's own answer has those of the first matching route only."""
    methods: set[str] = set()
    # Asked by matching each method, since several routes may share a path.
    for method in ("DELETE", "GET", "HEAD", "PATCH", "POST", "PUT"):
        scope = {**request.scope, "method": method}
        methods |= {method for route in request.app.routes if route.matches(scope)[0] is Match.FULL}
    return methods


def field_and_message(errors: Sequence[Any], model: type[BaseModel] | None = None) -> tuple[str, str]:
    """Return the field of pydantic's first error, and the messages of all, joined; `model` is what was validated."""
    places = [".".join(str(part) for part in e["loc"]) for e in errors]
    texts = [_message(e, model) for e in errors]
    messages = [text if p == places[0] else f"{p}: {text}" for p, text in zip(places, texts, strict=True)]
    return places[0], "; ".join(messages) + "."


def _message(error: Any, model: type[BaseModel] | None) -> str:
    if error["type"] != "extra_forbidden":
        return error["msg"]
    known = _fields_at(model, error["loc"][:-1])
    return f"unknown field; known: {', '.join(sorted(known))}" if known else "unknown field"


def _fields_at(model: type[BaseModel] | None, path: Sequence[int | str]) -> tuple[str, ...]:
    """Return the names of the fields of the model at a path within another."""
    for name in path:
        field = model.model_fields.get(str(name)) if model else None
        # A field may be a model or, mostly, a model or None.
        kinds = [] if field is None else [field.annotation, *get_args(field.annotation)]
        model = next((k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel)), None)
    return tuple(model.model_fields) if model else ()


def invalid_request(errors: Sequence[Any]) -> InvalidRequest:
    """Convert FastAPI's validation errors; their location begins with the part of the request (query, path, header)."""
    where, message = field_and_message(errors)
    return InvalidRequest(message, where=where)
