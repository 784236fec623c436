"""`/scenes/{id}/anchors`: named points of a scene, which results return as their photos' cameras see them."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Path

from service.scene_manager.anchor_store import Anchor
from service.web.route_policy import SMALL_BODY, route_policy
from service.web.routes.dependencies import AppStateOf
from service.web.schemas.anchors import AnchorIn, AnchorList, AnchorOut, anchor_out
from service.web.schemas.error_examples import errors

router = APIRouter()
Name = Annotated[
    str,
    Path(min_length=1, max_length=64, pattern=r"^[^/\\\x00-\x1f\x7f]+$", description="The anchor's name."),
]


@router.get("/scenes/{scene_id}/anchors", tags=["scenes"], responses=errors("scene_not_found", "corrupt_scene"))
@route_policy(role="read")
def list_anchors(scene_id: str, app_state: AppStateOf) -> AnchorList:
    """List the scene's anchors by name."""
    app_state.engine.scene(scene_id)  # raises SceneNotFound: the store has no list of scenes
    return AnchorList(anchors=[anchor_out(anchor) for anchor in app_state.anchors.anchors(scene_id)])


@router.put(
    "/scenes/{scene_id}/anchors/{name}",
    tags=["scenes"],
    responses=errors(
        *("invalid_request", "bad_request", "request_timeout", "scene_not_found", "bad_input", "corrupt_scene"),
        "storage_failed",
        body=True,
    ),
)
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def put_anchor(scene_id: str, name: Name, anchor: AnchorIn, app_state: AppStateOf) -> AnchorOut:
    """Add an anchor to the scene, or move the one of that name."""
    app_state.engine.scene(scene_id)  # raises SceneNotFound
    added = Anchor(name, np.array(anchor.position, np.float64))
    app_state.anchors.put(scene_id, added)
    return anchor_out(added)


@router.delete(
    "/scenes/{scene_id}/anchors/{name}",
    status_code=204,
    tags=["scenes"],
    responses=errors(
        *("invalid_request", "scene_not_found", "anchor_not_found", "corrupt_scene", "storage_failed"), body=True
    ),
)
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def delete_anchor(scene_id: str, name: Name, app_state: AppStateOf) -> None:
    """Delete an anchor of the scene."""
    app_state.engine.scene(scene_id)  # raises SceneNotFound
    app_state.anchors.delete(scene_id, name)
