"""The pages: start, live, API (`/docs`) and share link; their files under `/ui`, and `/client.js`."""

from __future__ import annotations

import json
from pathlib import Path

from fastapi import FastAPI, Request
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles
from starlette.responses import Response

from service.labels import TABLES
from service.web.route_policy import RoutePolicy, declare, route_policy

PAGES = Path(__file__).parent / "static"
_SHARED_POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors {}"
)
_REVALIDATE = {"Cache-Control": "no-cache"}
"""Browsers may cache the file, but must ask each time whether it changed: after an upgrade it has."""


def add_pages(app: FastAPI) -> None:
    """Add the routes of the pages."""
    app.add_api_route("/", _start_page, include_in_schema=False)
    app.add_api_route("/live", _live_page, include_in_schema=False)
    app.add_api_route("/docs", _api_page, include_in_schema=False)
    app.add_api_route("/shared/{token}", _shared_page, include_in_schema=False)
    app.add_api_route("/client.js", _client, include_in_schema=False)
    app.add_api_route("/ui/labels.js", _labels, include_in_schema=False)
    # Public: without a key, too, the start page must be able to ask for one.
    app.mount("/ui", declare(_Files(directory=PAGES), RoutePolicy(role=None)), "ui")


@route_policy(role=None, key_in_address=True)
async def _start_page() -> FileResponse:
    return FileResponse(PAGES / "index.html", media_type="text/html", headers=_REVALIDATE)


@route_policy(role="localize", key_in_address=True)
async def _live_page() -> FileResponse:
    return FileResponse(PAGES / "live.html", media_type="text/html", headers=_REVALIDATE)


@route_policy(role=None)
async def _api_page() -> FileResponse:
    return FileResponse(PAGES / "api.html", media_type="text/html", headers=_REVALIDATE)


@route_policy(role=None)
async def _shared_page(token: str, request: Request) -> FileResponse:
    """Return the page of a share link, which says so itself if the link isn't valid; framed by who may do so only."""
    framing = " ".join(request.app.state.app_state.settings.embed_origins) or "'none'"
    headers = _REVALIDATE | {"Content-Security-Policy": _SHARED_POLICY.format(framing)}
    return FileResponse(PAGES / "shared.html", media_type="text/html", headers=headers)


@route_policy(role=None)
async def _client() -> FileResponse:
    return FileResponse(PAGES / "client.js", media_type="text/javascript", headers=_REVALIDATE)


@route_policy(role=None)
async def _labels() -> Response:
    """Return the words for names of the API, as a module that the pages import: the table is Python's."""
    module = f"export const LABELS = {json.dumps(TABLES)};\n"
    return Response(module, media_type="text/javascript", headers=_REVALIDATE)


class _Files(StaticFiles):
    # Starlette sends an ETag, so that an unchanged file costs a 304.
    def file_response(self, *args, **kwargs) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers.update(_REVALIDATE)
        return response
