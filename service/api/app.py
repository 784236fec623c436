"""The HTTP service: `create_app` puts scenes, jobs, routes and the viewer's relay together.

One process, one port, paths without a version. Behind a proxy that shows the service under a sub-path,
links are right if the proxy sends `X-Forwarded-Prefix` or `SPLATFIX_ROOT_PATH` is set, whether or not the
proxy strips the sub-path from what it hands on.
"""

from __future__ import annotations

import asyncio
import fcntl
import re
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import anyio
import yaml
from anyio import to_thread
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic.json_schema import models_json_schema
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import __version__
from service.api.jobs import Jobs
from service.api.problems import install, problem_response
from service.api.relay import Relay
from service.api.requests import LocalizeIn
from service.api.routes import router
from service.api.routes.parts import Parts
from service.api.scenes import Scenes
from service.api.schemas import Problem, Record
from service.api.settings import Settings
from service.api.ui import add_pages
from service.api.viewer_child import ViewerChild
from service.errors import StorageFailed
from service.estimators import ESTIMATORS
from service.localize import LoadedScene

_BODY_OVERHEAD = 1_000_000
"""Bytes that a body may have beyond the photo's limit: the other fields and the form's own lines."""


def create_app(settings: Settings | None = None, scenes: Mapping[str, LoadedScene] | None = None) -> FastAPI:
    """Make the app. Scenes are found here and loaded after start-up; `scenes` are in memory already.

    Raises SceneNotFound, BadInput or BackendMissing if the settings name what is not there.
    """
    settings = settings or Settings()
    ESTIMATORS.load(settings.estimator)  # an unknown name shall be told now, not in each job
    if scenes is None:
        known = Scenes(settings.scenes, settings.estimator, settings.cache_dir)
    else:
        known = Scenes.of(scenes, settings.estimator)
    viewer = ViewerChild(settings.loopback_url) if settings.viewer else None
    relay = Relay(viewer) if viewer else None

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with AsyncExitStack() as stack:
            folder = stack.enter_context(data_folder(settings.data_dir))
            jobs = Jobs(settings, known, folder)
            stack.push_async_callback(to_thread.run_sync, jobs.close)
            await to_thread.run_sync(jobs.start)
            known.start()
            stack.push_async_callback(to_thread.run_sync, known.close)
            limits = anyio.CapacityLimiter(settings.workers), anyio.CapacityLimiter(2)
            app.state.parts = Parts(settings, known, jobs, *limits)
            if viewer and relay:
                stack.push_async_callback(relay.close)
                stack.push_async_callback(_cancelled, asyncio.create_task(viewer.supervise()))
            yield

    app = FastAPI(
        title="splatfix",
        version=__version__,
        lifespan=lifespan,
        generate_unique_id_function=lambda route: route.name,
    )
    install(app)
    app.include_router(router)
    add_pages(app)
    if relay:
        app.include_router(relay.router)
    app.add_middleware(SizeLimit, limit=settings.max_upload_bytes + _BODY_OVERHEAD)
    app.add_middleware(SubPath, default=settings.root_path)
    app.openapi = lambda: openapi(app)
    return app


@contextmanager
def data_folder(path: Path | None) -> Iterator[Path]:
    """Hold a folder for this process alone; None: a temporary one. Raises StorageFailed."""
    with ExitStack() as stack:
        folder = path or Path(stack.enter_context(TemporaryDirectory(prefix="splatfix-")))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = stack.enter_context((folder / "lock").open("w"))
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            told = "another process uses it" if isinstance(error, BlockingIOError) else error.strerror
            raise StorageFailed(
                f"{folder} can't be used: {told}.", where="data_dir", hint="Name another one: SPLATFIX_DATA_DIR."
            ) from error
        yield folder


async def _cancelled(task: asyncio.Task[None]) -> None:
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task


def openapi(app: FastAPI) -> dict[str, Any]:
    """Return the API's description; with the models that no route names by itself."""
    if not app.openapi_schema:
        schema = get_openapi(
            title=app.title,
            version=app.version,
            summary=_SUMMARY,
            description=_DESCRIPTION,
            routes=app.routes,
        )
        _, extra = models_json_schema(
            [(LocalizeIn, "validation"), (Problem, "serialization"), (Record, "serialization")],
            ref_template="#/components/schemas/{model}",
        )
        components = schema.setdefault("components", {}).setdefault("schemas", {})
        app.openapi_schema = schema
        components |= {name: model for name, model in extra["$defs"].items() if name not in components}
    return app.openapi_schema


def openapi_yaml() -> str:
    """Return the text of openapi.yaml; it doesn't depend on any setting."""
    return yaml.safe_dump(
        create_app(Settings(scenes=[], viewer=False)).openapi(),
        sort_keys=False,
        width=100,
        allow_unicode=True,
    )


_SUMMARY = "Tell where a photo was taken inside a 3D Gaussian Splatting scene."
_DESCRIPTION = """
Post a photo to `/localize`, follow the job, read the pose. Poses are in the scene's own frame and units,
camera axes as OpenCV has them (+x right, +y down, +z forward) unless a field says otherwise; quaternions
are wxyz. A photo that can't be localized is an answer (`not_localized`, with a reason), not an error.
Every error is a problem document (RFC 9457).
"""


class SubPath:
    """Tells the app the sub-path under which a proxy shows it (ASGI: `path` includes `root_path`)."""

    def __init__(self, app: ASGIApp, default: str) -> None:
        self._app, self._default = app, default.rstrip("/")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            given = Headers(scope=scope).get("x-forwarded-prefix", "").rstrip("/")
            # Only what is a plain path: it ends up in links.
            root = given if re.fullmatch(r"(/[\w~-][\w.~-]*){1,8}", given) else self._default
            path = scope["path"]
            if root and path != root and not path.startswith(f"{root}/"):
                path = root + path
            scope = {**scope, "root_path": root, "path": path}
        await self._app(scope, receive, send)


class SizeLimit:
    """Refuses a large body: by its announced length before a byte of it is read, else as soon as it is too long.

    Starlette's own limit answers in plain text, whatever the app would say.
    """

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app, self._limit = app, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        error = HTTPException(413, f"The body may have {self._limit} bytes.")
        length = Headers(scope=scope).get("content-length", "")
        if length.isdecimal() and int(length) > self._limit:
            await problem_response(error, scope["path"])(scope, receive, send)
            return
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._limit:
                raise error
            return message

        await self._app(scope, counted, send)
