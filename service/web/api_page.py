"""The API's description as a page at `/docs`: Swagger UI, whose files come with a package and from no other server."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from fastapi import FastAPI, Request
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.responses import FileResponse, HTMLResponse

from service.web.route_policy import route_policy

_SCRIPT, _STYLE = "swagger-ui-bundle.js", "swagger-ui.css"


def add_api_page(app: FastAPI) -> None:
    """Add the routes of the page; FastAPI's own would load a CDN's files."""
    for path, endpoint in (("/docs", _page), (f"/docs/{_SCRIPT}", _script), (f"/docs/{_STYLE}", _style)):
        app.add_api_route(path, endpoint, include_in_schema=False)


@route_policy(role=None)
async def _page(request: Request) -> HTMLResponse:
    root = request.scope.get("root_path", "")
    return get_swagger_ui_html(
        openapi_url=f"{root}/openapi.json",
        title="splatfix API",
        swagger_js_url=f"{root}/docs/{_SCRIPT}",
        swagger_css_url=f"{root}/docs/{_STYLE}",
        swagger_favicon_url=f"{root}/ui/icon.svg",
    )


@route_policy(role=None)
async def _script() -> FileResponse:
    return _packaged(_SCRIPT, "text/javascript")


@route_policy(role=None)
async def _style() -> FileResponse:
    return _packaged(_STYLE, "text/css")


def _packaged(name: str, media_type: str) -> FileResponse:
    file = Path(str(resources.files("fastapi_swagger") / "resources" / name))
    return FileResponse(file, media_type=media_type, headers={"Cache-Control": "no-cache"})
