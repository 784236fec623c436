"""The files of Swagger UI, which the page at `/docs` shows the API with: from a package, and from no other server."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from fastapi import FastAPI
from fastapi.responses import FileResponse

from service.web.route_policy import route_policy

_SCRIPT, _STYLE = "swagger-ui-bundle.js", "swagger-ui.css"


def add_api_page(app: FastAPI) -> None:
    """Add the routes of the files; FastAPI's own page would load a CDN's."""
    app.add_api_route(f"/docs/{_SCRIPT}", _script, include_in_schema=False)
    app.add_api_route(f"/docs/{_STYLE}", _style, include_in_schema=False)


@route_policy(role=None)
async def _script() -> FileResponse:
    return _packaged(_SCRIPT, "text/javascript")


@route_policy(role=None)
async def _style() -> FileResponse:
    return _packaged(_STYLE, "text/css")


def _packaged(name: str, media_type: str) -> FileResponse:
    file = Path(str(resources.files("fastapi_swagger") / "resources" / name))
    # Another version of the package has other files under the same names.
    return FileResponse(file, media_type=media_type, headers={"Cache-Control": "no-cache"})
