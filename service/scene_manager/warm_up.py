"""A first localization, and the camera for it: one that shows what a scene is."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from service.errors import InvalidPrior
from service.geometry import look_at
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.types import Camera, Intrinsics, Query

ENOUGH_RENDERS = 10
"""Of a method that needs a prior: it begins at the answer, and more of the same would warm nothing."""
_log = logging.getLogger(__name__)


def warm_up(loaded: LoadedScene, estimator: str) -> None:
    """Localize a render of the scene, so that the first photo meets compiled code and loaded networks."""
    camera = overview(loaded, 512)
    frame = loaded.rasterizer.render([camera])[0]
    rgb = np.clip(np.rint(frame.rgb * 255), 0, 255).astype(np.uint8)
    # Estimated intrinsics have code of their own.
    for intrinsics in (camera.intrinsics, replace(camera.intrinsics, trust="approximate")):
        query = Query(rgb, intrinsics, "given", intrinsics)
        try:
            estimate = localize(query, loaded, Request(estimator))
        # Methods that only refine need a pose to start from.
        except InvalidPrior:
            begun = replace(query, prior=camera.pose)
            estimate = localize(begun, loaded, Request(estimator, budget_renders=ENOUGH_RENDERS))
        trust, status = intrinsics.trust, estimate.verdict.status
        _log.info("scene %s: warmed up, %s intrinsics: %s", loaded.scene.info.id, trust, status)


def overview(loaded: LoadedScene, long_side: int) -> Camera:
    """Return a camera that shows what the scene is: a training camera, else one outside."""
    cameras = loaded.scene.cameras
    camera = cameras[len(cameras) // 2].camera if cameras else _outside(loaded)
    return Camera(camera.intrinsics.with_long_side(long_side), camera.pose)


def _outside(loaded: LoadedScene) -> Camera:
    """A camera that looks at the middle of the Gaussians from outside."""
    means = loaded.scene.means
    centre = np.median(means, 0)
    # Medians: floaters far outside would put the camera far away.
    radius = float(np.median(np.linalg.norm(means - centre, axis=1))) or 1.0
    pose = look_at(centre + radius * np.array([0.0, 0.0, 3.0]), centre, np.array([0.0, 1.0, 0.0]))
    return Camera(Intrinsics(512, 384, 450.0, 450.0, 256.0, 192.0), pose)
