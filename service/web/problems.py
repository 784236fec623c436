"""Every error as a problem document (RFC 9457), whoever raised it: our code, a validation, the router."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match
from starlette.types import Message, Receive, Scope, Send

from service.errors import (
    BackendMissing,
    BadInput,
    DeadlineExceeded,
    Forbidden,
    IdempotencyConflict,
    Interrupted,
    InvalidRequest,
    JobNotFound,
    JobNotReady,
    NoGeoAnchor,
    NoKeys,
    NoPose,
    NoRoom,
    PhotoGone,
    QueueFull,
    RateLimited,
    RecordNotFound,
    SceneError,
    SceneExists,
    SceneInUse,
    SceneNotFound,
    SceneNotReady,
    SceneUnloaded,
    SplatfixError,
    StorageFailed,
    Unauthorized,
)
from service.web.api_model import Model

_log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
RETRY_AFTER_S = 5
_LINGER_S = 2.0

# The first class that fits decides; SplatfixError itself, hence EstimatorFault, is our mistake.
_STATUS: tuple[tuple[type[SplatfixError], int], ...] = (
    (InvalidRequest, 400),
    (BadInput, 422),
    (SceneNotFound, 404),
    (SceneNotReady, 503),
    (NoRoom, 503),
    (SceneUnloaded, 409),
    (SceneExists, 409),
    (SceneInUse, 409),
    (SceneError, 422),
    (JobNotFound, 404),
    (RecordNotFound, 404),
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
    (SplatfixError, 500),
)

# Of HTTP itself; spelled out because Python's own phrases differ between versions.
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
    """What went wrong, as RFC 9457 has it: the body of every error, `application/problem+json`."""

    type: str
    """`urn:splatfix:error:<code>`, or `about:blank` where the status says it all."""
    title: str
    status: int
    detail: str
    instance: str
    """The path that was asked for."""
    code: str
    """Stable, for programs."""
    where: str = ""
    """The field, file or element concerned; empty if there is none."""
    hint: str = ""
    """What to do about it."""


def problem_of(error: Exception, instance: str) -> Problem:
    """Describe an exception; what is not ours is told to the log, not to the caller."""
    if isinstance(error, SplatfixError):
        status = next(status for kind, status in _STATUS if isinstance(error, kind))
        return _problem(status, error.code, error.message, instance, error.where, error.hint)
    if isinstance(error, ClientDisconnect):
        return _problem(400, "bad_request", "The client left before it had sent everything.", instance)
    if isinstance(error, HTTPException):
        code = _HTTP_CODES.get(error.status_code, "http_error")
        return _problem(error.status_code, code, str(error.detail), instance)
    return _problem(500, "internal_error", "The service failed; its log says why.", instance)


def _problem(status: int, code: str, detail: str, instance: str, where: str = "", hint: str = "") -> Problem:
    return Problem(
        type=f"urn:splatfix:error:{code}",
        title=code.replace("_", " ").capitalize(),
        status=status,
        detail=_sendable(detail),
        instance=_sendable(instance),
        code=code,
        where=_sendable(where),
        hint=_sendable(hint),
    )


def _sendable(text: str) -> str:
    """Replace what isn't Unicode text: halves of surrogate pairs, which JSON lets callers send."""
    return text.encode("utf-8", "replace").decode()


def problem_response(error: Exception, path: str) -> Response:
    """Answer with the error's problem document."""
    headers = dict(getattr(error, "headers", None) or {})
    if isinstance(error, SplatfixError) and error.retry_after_s:
        headers["Retry-After"] = str(error.retry_after_s)
    return problem_answer(problem_of(error, path), path, headers)


def problem_answer(problem: Problem, path: str, headers: Mapping[str, str] | None = None) -> Response:
    """Answer with a problem document, as concerns `path`."""
    told = {"Retry-After": str(RETRY_AFTER_S)} if problem.status in (429, 503) else {}
    problem = problem.model_copy(update={"instance": path})
    return Response(problem.model_dump_json(), problem.status, {**told, **(headers or {})}, MEDIA_TYPE)


async def refuse(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer before the body was read, and wait a moment for what of it is on its way.

    A connection that is closed while data comes in is reset, and a client that still sends then loses the answer.
    """

    async def held_open(message: Message) -> None:
        await send({**message, "more_body": True} if message["type"] == "http.response.body" else message)

    await response(scope, receive, held_open)
    with suppress(TimeoutError):
        async with asyncio.timeout(_LINGER_S):
            while (await receive()).get("more_body"):
                pass
    await send({"type": "http.response.body", "body": b""})


def install(app: FastAPI) -> None:
    """Make every error of the app a problem document."""

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
    app.add_exception_handler(ClientDisconnect, answer)  # nobody hears it, but it is no failure of ours
    app.add_exception_handler(RequestValidationError, answer_validation)


def _allowed(request: Request) -> set[str]:
    """Return the methods of an address; the router tells those of the first route that fits only."""
    methods: set[str] = set()
    for method in ("DELETE", "GET", "HEAD", "PATCH", "POST", "PUT"):
        scope = {**request.scope, "method": method}
        methods |= {method for route in request.app.routes if route.matches(scope)[0] is Match.FULL}
    return methods


def described(errors: Sequence[Any]) -> tuple[str, str]:
    """Return where and what of pydantic's errors: the first one's place, all their messages."""
    places = [".".join(str(part) for part in e["loc"]) for e in errors]
    told = [e["msg"] if p == places[0] else f"{p}: {e['msg']}" for p, e in zip(places, errors, strict=True)]
    return places[0], "; ".join(told) + "."


def invalid_request(errors: Sequence[Any]) -> InvalidRequest:
    """Make our error of FastAPI's, which names the part of the request (query, path, header) first."""
    where, message = described(errors)
    return InvalidRequest(message, where=where)
