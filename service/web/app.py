"""The HTTP service: `create_app` assembles scenes, jobs, routes, middleware and the viewer's relay.

One process, one port, paths without a version. Behind a proxy that serves it under a sub-path, links are right if the
proxy sends `X-Forwarded-Prefix` or `SPLATFIX_ROOT_PATH` is set, whether or not the proxy strips the sub-path from the
paths of requests.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import anyio
from anyio import to_thread
from fastapi import FastAPI
from starlette.middleware.cors import CORSMiddleware
from starlette.routing import Route

from service import __version__
from service.errors import BackendMissing, InvalidRequest, SceneNotFound, StorageFailed
from service.estimators import ESTIMATORS
from service.jobs.embedded_engine import EmbeddedEngine
from service.jobs.engine import Engine
from service.jobs.object_photo_store import ObjectPhotoStore
from service.jobs.photo_store import FolderPhotoStore, PhotoStore
from service.jobs.service import Jobs
from service.jobs.sqlite_lens_store import SqliteLensStore
from service.jobs.sqlite_store import SqliteJobStore
from service.jobs.store import JobStore
from service.lenses.lens_memory import LensMemory
from service.lenses.lens_store import LensStore
from service.matchers import MATCHERS
from service.object_store import open_objects
from service.operating_system import locked
from service.render import RASTERIZERS
from service.scene_formats import SCENE_FORMATS
from service.scene_manager.anchor_store import FileAnchorStore
from service.scene_manager.object_scene_store import ObjectSceneStore
from service.scene_manager.scene_store import FolderSceneStore, SceneStore, named_scenes
from service.scene_manager.status import StoredScene
from service.web.api_keys import KeyRing
from service.web.api_page import add_api_page
from service.web.catalogue_watch import CatalogueWatch
from service.web.gauges import add_gauges
from service.web.metrics import Metrics
from service.web.middleware.authentication import AccessRules, Authentication, allowed_hosts
from service.web.middleware.head_requests import HeadRequests
from service.web.middleware.limits import Limits
from service.web.middleware.proxy import Proxy
from service.web.middleware.route_lookup import RouteLookup
from service.web.openapi import description, description_as_yaml
from service.web.pages import add_pages
from service.web.problems import add_error_handlers
from service.web.route_policy import RoutePolicy, declare, require_policies
from service.web.routes import router
from service.web.routes.dependencies import AppState
from service.web.settings import Settings, is_loopback
from service.web.shared_state import LocalState, Rate, SharedState
from service.web.viewer_process import ViewerChild
from service.web.viewer_relay import Relay

_log = logging.getLogger(__name__)


def create_app(settings: Settings | None = None, engine: Engine | None = None, keys: KeyRing | None = None) -> FastAPI:
    """Make the app. Scenes are found now and loaded after start-up; `engine` defaults to threads of this process.

    `keys` defaults to those of the settings' key file. Raises SceneNotFound, BadInput or BackendMissing for scenes
    and plug-ins of the settings that can't be used, InvalidRequest if anybody could use the service without `open`.
    """
    settings = settings or Settings()
    _check_plugins(settings)
    engine = engine or _engine(settings)
    named = _named_scenes(settings)
    for scene in named:
        engine.add(scene, required=settings.preload is None or scene.id in settings.preload)
    keys, metrics = keys or KeyRing(settings.keys_file), Metrics()
    viewer = _viewer(settings) if settings.viewer else None
    relay = Relay(viewer, keys) if viewer else None

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with AsyncExitStack() as stack:
            app.state.app_state = await _start(stack, settings, engine, named, keys, metrics)
            if viewer and relay:
                stack.push_async_callback(relay.close)
                stack.push_async_callback(_cancelled, asyncio.create_task(viewer.supervise()))
            yield

    app = FastAPI(
        title="splatfix",
        version=__version__,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        # Generated clients name their functions by it: FastAPI's own holds the path and the method, too.
        generate_unique_id_function=lambda route: route.name,
    )
    add_error_handlers(app)
    app.include_router(router)
    add_pages(app)
    add_api_page(app)
    if relay:
        # After the API's routes, which no path of the viewer can hide then.
        app.include_router(relay.router)
    _add_middleware(app, settings, keys, metrics)
    # In place of FastAPI's: with problem documents, examples and links.
    app.openapi = lambda: description(app)
    _declare_description(app)
    # Last, when all routes are there: one without a policy stops the start.
    require_policies(app.routes)
    return app


def _viewer(settings: Settings) -> ViewerChild:
    certificate = settings.certificate if settings.https else None
    return ViewerChild(settings.loopback_url, certificate)


def _check_plugins(settings: Settings) -> None:
    """Load the plug-ins that the settings name, so that an unknown one stops the start and doesn't fail each job."""
    SCENE_FORMATS.names()  # raises if two plug-ins have the same name; here for all kinds
    RASTERIZERS.names()
    for kind, name in ((ESTIMATORS, settings.estimator), (MATCHERS, settings.matcher)):
        kind.load(name)
    if settings.rasterizer:
        RASTERIZERS.load(settings.rasterizer)


async def _start(
    stack: AsyncExitStack,
    settings: Settings,
    engine: Engine,
    named: list[StoredScene],
    keys: KeyRing,
    metrics: Metrics,
) -> AppState:
    """Open the stores, start engine and jobs; `stack` stops and closes them in reverse order."""
    folder = stack.enter_context(data_folder(settings.data_dir))
    scene_store = await to_thread.run_sync(_scene_store, settings, folder, named)
    for scene in scene_store.scenes():
        if scene.uploaded:
            engine.add(scene)
    store, photos, lenses, shared = await to_thread.run_sync(_stores, settings, folder)
    # Kept, so that browsers stay signed in after a restart.
    keys.keep_sessions(await to_thread.run_sync(shared.secret))
    # Before jobs are listed: those of an earlier release belong to the name of a key alone.
    for by_name, client in keys.unnamed_clients():
        await to_thread.run_sync(store.reassign, by_name, client)
    stack.callback(lenses.close)
    # The store is opened in any case: with none to keep it deletes what it had.
    memory = LensMemory(lenses) if settings.keep_lenses else None
    jobs = Jobs(settings.jobs, engine, store, photos, metrics, memory)
    stack.push_async_callback(to_thread.run_sync, engine.close)
    await to_thread.run_sync(engine.start)
    # Registered after the engine's, hence called before: running jobs need it until they end.
    stack.push_async_callback(to_thread.run_sync, jobs.close)
    await to_thread.run_sync(jobs.start)
    catalogue = CatalogueWatch(scene_store, engine) if isinstance(scene_store, ObjectSceneStore) else None
    if catalogue:
        catalogue.start()
        stack.push_async_callback(to_thread.run_sync, catalogue.close)
    limits = anyio.CapacityLimiter(settings.jobs_at_once), anyio.CapacityLimiter(2)
    add_gauges(metrics, settings, engine, jobs, folder)
    anchors = FileAnchorStore(scene_store.find, settings.data_dir)
    state = AppState(settings, engine, scene_store, anchors, jobs, lenses, keys, shared, metrics, *limits, catalogue)
    metrics.gauge("live_sessions", "Open live sessions", (), lambda: {(): len(state.live)})
    return state


def _engine(settings: Settings) -> Engine:
    """Make the engine that the settings name. Raises BackendMissing."""
    if settings.engine == "embedded":
        return EmbeddedEngine(settings.engine_config)
    # Not above: Ray is there only where the extra is installed.
    try:
        from service.jobs.ray_engine import RayEngine
    except ImportError as error:
        raise BackendMissing(f"Ray: {error}.", where="engine", hint="pip install 'splatfix[ray]'") from error
    return RayEngine(settings.engine_config, settings.ray)


def _scene_store(settings: Settings, folder: Path, named: list[StoredScene]) -> SceneStore:
    """Open the catalogue of scenes. Raises StorageFailed, BackendMissing, BadInput."""
    limits = {"max_bytes": settings.max_scene_bytes, "allow_checkpoints": settings.upload_checkpoints}
    if settings.object_store is None:
        return FolderSceneStore(named, folder / "scenes", **limits)
    cache = settings.cache_dir or folder
    return ObjectSceneStore(named, settings.object_store, cache, folder / "incoming", **limits)


def _stores(settings: Settings, folder: Path) -> tuple[JobStore, PhotoStore, LensStore, SharedState]:
    """Open the stores of jobs, photos and lenses, and what fronts share. Raises StorageFailed, BackendMissing."""
    local = LocalState(folder / "sessions.key")
    objects = settings.object_store and ObjectPhotoStore(open_objects(settings.object_store))
    if settings.database is None:
        lenses = SqliteLensStore(folder / "lenses.sqlite", settings.keep_lenses)
        return SqliteJobStore(folder / "jobs.sqlite"), objects or FolderPhotoStore(folder / "photos"), lenses, local
    # Not above: the driver is there only where the extra is installed.
    try:
        from service.jobs.postgres_database import PostgresDatabase, unprotected
        from service.jobs.postgres_store import PostgresJobStore, PostgresLensStore, PostgresPhotoStore
        from service.web.postgres_state import PostgresState
    except ImportError as error:
        raise BackendMissing(
            f"PostgreSQL: {error}.", where="database", hint="pip install 'splatfix[postgres]'"
        ) from error
    address = settings.database.get_secret_value()
    if warning := unprotected(address):
        _log.warning("%s", warning)
    database = PostgresDatabase(address)
    lenses = PostgresLensStore(database, settings.keep_lenses)
    photos = objects or PostgresPhotoStore(database)
    return PostgresJobStore(database), photos, lenses, PostgresState(database, local)


def _add_middleware(app: FastAPI, settings: Settings, keys: KeyRing, metrics: Metrics) -> None:
    """Add the layers from the innermost to the outermost, which a request passes first."""

    async def check_queue(client: str, most: int | None, idempotency_key: str | None) -> None:
        await to_thread.run_sync(app.state.app_state.jobs.require_queue_capacity, client, most, idempotency_key)

    async def hit(client: str, rate: Rate) -> float | None:
        return await to_thread.run_sync(app.state.app_state.shared.hit, client, rate)

    app.add_middleware(Limits, settings=settings, check_queue=check_queue, hit=hit)
    app.add_middleware(Authentication, rules=access_rules(settings, keys))
    app.add_middleware(RouteLookup, routes=app.routes)
    if settings.cors_origins:
        # Outside of authentication: a browser sends preflight requests without a key.
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["*"],
            allow_headers=["*"],
            # Other headers a browser hides from another site's script.
            expose_headers=["Location", "Retry-After"],
        )
    app.add_middleware(HeadRequests)
    app.add_middleware(Proxy, metrics=metrics, default_root=settings.root_path, send_s=settings.send_s)


def _declare_description(app: FastAPI) -> None:
    """Declare FastAPI's own route public: the API's description, which the page at `/docs` shows."""
    for route in app.routes:
        if isinstance(route, Route) and route.name == "openapi":
            declare(route.endpoint, RoutePolicy(role=None))


@contextmanager
def data_folder(path: Path | None) -> Iterator[Path]:
    """Lock a folder for this process; None: a temporary one. Raises StorageFailed, also if it is locked."""
    with ExitStack() as stack:
        folder = path or Path(stack.enter_context(TemporaryDirectory(prefix="splatfix-")))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            stack.callback(locked(folder / "lock").release)
        except OSError as error:
            reason = "another process uses it" if isinstance(error, BlockingIOError) else error.strerror
            raise StorageFailed(
                f"{folder} can't be used: {reason}.", where="data_dir", hint="Name another one: SPLATFIX_DATA_DIR."
            ) from error
        yield folder


def access_rules(settings: Settings, keys: KeyRing) -> AccessRules:
    """Return who may use the service. Raises InvalidRequest if anybody could, unless `open` is set."""
    is_open = not keys
    if is_open and not is_loopback(settings.host) and not settings.open:
        raise InvalidRequest(
            f"everybody who reaches {settings.host} could use the service.",
            where="host",
            hint="Make a key (splatfix keys add NAME), or set SPLATFIX_OPEN=true.",
        )
    hosts = allowed_hosts(settings.host, settings.allowed_hosts, open_to_all=is_open)
    return AccessRules(keys, is_open, hosts, settings.cors_origins)


def _named_scenes(settings: Settings) -> list[StoredScene]:
    """Return the scenes that the settings name. Raises SceneNotFound, BadInput."""
    named = named_scenes(settings.scenes)
    for scene_id in settings.preload or ():
        if scene_id not in {scene.id for scene in named}:
            raise SceneNotFound(f"unknown scene '{scene_id}'.", where="preload")
    return named


async def _cancelled(task: asyncio.Task[None]) -> None:
    """Cancel a task and wait until it has ended."""
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task


def openapi_yaml() -> str:
    """Return the text of openapi.yaml; it doesn't depend on any setting."""
    return description_as_yaml(create_app(Settings(scenes=[], viewer=False)))
