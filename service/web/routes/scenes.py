"""`/scenes`: list, upload, load, render and delete scenes."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Query, Request, Response

from service.errors import SceneExists, SceneInUse
from service.scene_manager import splat_sample as splats
from service.scene_manager.scene_errors import scene_in_use
from service.scene_manager.scene_images import PICTURE_TYPES
from service.scene_manager.status import PictureSpec
from service.web.route_policy import SCENE_BODY, SMALL_BODY, route_policy
from service.web.routes.dependencies import JPEG, AppStateOf, RootOf, VisibleOf
from service.web.schemas import resources
from service.web.schemas.error_examples import SCENE_ERRORS, errors
from service.web.schemas.job_spec import checked_intrinsics, pose_from
from service.web.schemas.requests import RenderIn
from service.web.schemas.scenes import SceneList, SceneOut, SceneSummary

MAX_SPLATS = 2_000_000

router = APIRouter()


@router.get("/scenes", tags=["scenes"], responses=errors())
@route_policy(role="read")
def list_scenes(app_state: AppStateOf, visible: VisibleOf, root: RootOf) -> SceneList:
    """List the scenes that the key may use, with their states."""
    known = visible.scenes(app_state.engine.scenes())
    return SceneList(scenes=[resources.scene_summary_out(scene, root) for scene in known])


@router.get("/scenes/{scene_id}", tags=["scenes"], responses=errors("scene_not_found"))
@route_policy(role="read")
def get_scene(scene_id: str, app_state: AppStateOf, root: RootOf) -> SceneOut:
    """Return a scene with its training cameras."""
    return resources.scene_out(app_state.engine.scene(scene_id), app_state.engine.contents(scene_id), root)


@router.put(
    "/scenes/{scene_id}",
    status_code=201,
    tags=["scenes"],
    responses=errors(
        *("invalid_request", "request_timeout", "scene_exists", "corrupt_scene", "unsupported_format"),
        "storage_failed",
        body=True,
    ),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
@route_policy(role="admin", body=SCENE_BODY, rate_limited=True)
async def upload_scene(
    scene_id: str,
    request: Request,
    app_state: AppStateOf,
    root: RootOf,
    file: Annotated[str, Query(description="Name of the file; its suffix decides the format.")] = "scene.ply",
) -> SceneOut:
    """Upload a scene: the body is a scene file, or a ZIP of a scene folder. It is checked, stored and loaded."""
    # Before the upload of perhaps gigabytes.
    known = await to_thread.run_sync(app_state.engine.scenes)
    if any(scene.id == scene_id for scene in known):
        raise SceneExists(f"scene '{scene_id}' already exists.", where="scene", hint="Delete it first.")
    with await to_thread.run_sync(app_state.scene_store.draft, scene_id) as draft:
        # Chunk by chunk to the disk: a scene may be larger than the memory.
        async for chunk in request.stream():
            await to_thread.run_sync(draft.write, chunk)
        stored = await to_thread.run_sync(draft.commit, file)
    await to_thread.run_sync(app_state.engine.add, stored)
    return resources.scene_out(await to_thread.run_sync(app_state.engine.load, scene_id), None, root)


@router.post(
    "/scenes/{scene_id}/load", status_code=202, tags=["scenes"], responses=errors("scene_not_found", body=True)
)
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def load_scene(scene_id: str, app_state: AppStateOf, root: RootOf) -> SceneSummary:
    """Load a scene into memory and prepare it; also a scene whose loading failed."""
    return resources.scene_summary_out(app_state.engine.load(scene_id), root)


@router.post(
    "/scenes/{scene_id}/unload",
    status_code=202,
    tags=["scenes"],
    responses=errors("scene_not_found", "bad_input", body=True),
)
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def unload_scene(scene_id: str, app_state: AppStateOf, root: RootOf) -> SceneSummary:
    """Remove a scene from memory once the last job on it has ended. It accepts no new jobs until it is loaded again."""
    return resources.scene_summary_out(app_state.engine.unload(scene_id), root)


@router.delete(
    "/scenes/{scene_id}",
    status_code=204,
    tags=["scenes"],
    responses=errors("scene_not_found", "scene_in_use", "storage_failed", body=True),
)
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def delete_scene(scene_id: str, app_state: AppStateOf) -> None:
    """Delete an uploaded scene and its files; not a scene of the settings, nor one that jobs use."""
    app_state.engine.scene(scene_id)  # raises SceneNotFound
    stored = app_state.scene_store.find(scene_id)
    if stored is None or not stored.uploaded:
        raise SceneInUse("this scene is in the service's settings; it can only be unloaded.", where="scene")
    # The engine refuses while jobs of its own use it; those of other fronts are in the store.
    if used := app_state.jobs.unfinished(scene_id):
        raise scene_in_use(used)
    app_state.engine.remove(scene_id)
    app_state.scene_store.delete(scene_id)


@router.get(
    "/scenes/{scene_id}/thumbnail.jpg",
    tags=["scenes"],
    response_class=Response,
    responses=JPEG | errors(*SCENE_ERRORS),
)
@route_policy(role="read")
async def scene_thumbnail(scene_id: str, app_state: AppStateOf) -> Response:
    """Return a small image of the scene from its middle training camera; without cameras, once it is prepared, from the
    view with the most features, before that from outside."""
    draw = partial(app_state.engine.thumbnail, scene_id)
    return Response(await app_state.render_in_thread(scene_id, draw), media_type="image/jpeg")


@router.get(
    "/scenes/{scene_id}/splats",
    tags=["scenes"],
    response_class=Response,
    responses={
        200: {
            "description": (splats.__doc__ or "").split("\n", 1)[1].strip(),
            "content": {splats.BINARY: {"schema": {"type": "string", "format": "binary"}}},
        }
    }
    | errors("invalid_request", *SCENE_ERRORS),
)
@route_policy(role="read")
async def scene_splats(
    scene_id: str,
    app_state: AppStateOf,
    limit: Annotated[int, Query(alias="max", ge=1, le=MAX_SPLATS, description="Most Gaussians to return.")] = 200_000,
) -> Response:
    """Return the most important Gaussians of the scene for drawing, as little-endian binary."""
    pack = partial(app_state.engine.splats, scene_id, limit)
    return Response(await to_thread.run_sync(pack, limiter=app_state.rendering), media_type=splats.BINARY)


@router.post(
    "/scenes/{scene_id}/render",
    tags=["scenes"],
    response_class=Response,
    responses={
        200: {"description": "The image", "content": {kind: {} for kind in PICTURE_TYPES.values()}},
    }
    | errors(
        *("invalid_request", "bad_request", "request_timeout", *SCENE_ERRORS, "invalid_intrinsics", "invalid_prior"),
        "device_memory_full",
        body=True,
    ),
)
@route_policy(role="read", body=SMALL_BODY, rate_limited=True)
async def render_scene(scene_id: str, wanted: RenderIn, app_state: AppStateOf) -> Response:
    """Render a colour image or a depth map of a scene from any pose."""
    intrinsics = None if wanted.intrinsics is None else checked_intrinsics(wanted.intrinsics)
    spec = PictureSpec(pose_from(wanted.pose, "pose"), intrinsics, wanted.format, wanted.quality)
    draw = partial(app_state.engine.render, scene_id, spec)
    return Response(await app_state.render_in_thread(scene_id, draw), media_type=PICTURE_TYPES[wanted.format])
