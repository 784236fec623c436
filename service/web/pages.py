"""The pages for people: the start page at `/`, and the files that it is made of under `/ui`."""

from __future__ import annotations

from pathlib import Path

from fastapi import FastAPI
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles
from starlette.responses import Response

from service.web.route_policy import RoutePolicy, declare, route_policy

PAGES = Path(__file__).parent / "static"
_ASK_FIRST = {"Cache-Control": "no-cache"}
"""A browser keeps the file, but asks whether it is still the same: after an upgrade it isn't."""


def add_pages(app: FastAPI) -> None:
    """Serve the pages; the start page at the root."""
    app.add_api_route("/", _start_page, include_in_schema=False)
    app.mount("/ui", declare(_Files(directory=PAGES), RoutePolicy(role=None)), "ui")


@route_policy(role=None, key_in_address=True)
async def _start_page() -> FileResponse:
    return FileResponse(PAGES / "index.html", media_type="text/html", headers=_ASK_FIRST)


class _Files(StaticFiles):
    def file_response(self, *args, **kwargs) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers.update(_ASK_FIRST)
        return response
