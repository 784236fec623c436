"""A first localization, and the camera for it: one that shows what a scene is."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from service.errors import InvalidPrior
from service.geometry import look_at
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.localize import Request, localize
from service.pose.retrieval.index import ViewIndex
from service.types import Camera, Intrinsics, Query

WARM_UP_PX = 512
ENOUGH_RENDERS = 10
"""Of each localization: a photo that is found takes about as many. More would warm nothing, and a scene that repeats
itself would be searched for seconds in vain."""
_log = logging.getLogger(__name__)


def warm_up(loaded: LoadedScene, estimator: str) -> None:
    """Localize a render of the scene, so that the first photo meets compiled code and loaded networks."""
    camera = _camera(loaded, estimator)
    frame = loaded.rasterizer.render([camera])[0]
    rgb = np.clip(np.rint(frame.rgb * 255), 0, 255).astype(np.uint8)
    # Estimated intrinsics have code of their own.
    for intrinsics in (camera.intrinsics, replace(camera.intrinsics, trust="approximate")):
        query = Query(rgb, intrinsics, "given", intrinsics)
        try:
            estimate = localize(query, loaded, Request(estimator, budget_renders=ENOUGH_RENDERS))
        # Methods that only refine need a pose to start from.
        except InvalidPrior:
            begun = replace(query, prior=camera.pose)
            estimate = localize(begun, loaded, Request(estimator, budget_renders=ENOUGH_RENDERS))
        trust, status = intrinsics.trust, estimate.verdict.status
        _log.info("scene %s: warmed up, %s intrinsics: %s", loaded.scene.info.id, trust, status)


def _camera(loaded: LoadedScene, estimator: str) -> Camera:
    """Return the indexed view with the most features, from which a photo is found at once; else an overview."""
    camera = _richest_view(loaded.usable(estimator))
    return overview(loaded, WARM_UP_PX) if camera is None else _sized(camera, WARM_UP_PX)


def overview(loaded: LoadedScene, long_side: int) -> Camera:
    """Return a camera that shows what the scene is: a training camera, else the indexed view with the most features,
    which shows a room from inside; while there is no index yet, one outside."""
    cameras = loaded.scene.cameras
    if cameras:
        return _sized(cameras[len(cameras) // 2].camera, long_side)
    return _sized(_richest_view(loaded.prepared(DEFAULT_ESTIMATOR)) or _outside(loaded), long_side)


def _richest_view(prepared: object) -> Camera | None:
    """Return the camera of the indexed view with the most features; None if this is no index, or an empty one."""
    if not isinstance(prepared, ViewIndex) or not prepared.views:
        return None
    return max(prepared.views, key=lambda view: len(view.points_in_world)).camera


def _sized(camera: Camera, long_side: int) -> Camera:
    return Camera(camera.intrinsics.with_long_side(long_side), camera.pose)


def _outside(loaded: LoadedScene) -> Camera:
    """A camera that looks at the middle of the Gaussians from outside."""
    means = loaded.scene.means
    centre = np.median(means, 0)
    # Medians: floaters far outside would put the camera far away.
    radius = float(np.median(np.linalg.norm(means - centre, axis=1))) or 1.0
    pose = look_at(centre + radius * np.array([0.0, 0.0, 3.0]), centre, np.array([0.0, 1.0, 0.0]))
    return Camera(Intrinsics(512, 384, 450.0, 450.0, 256.0, 192.0), pose)
