"""Where to render the index from: a spread choice of the training cameras, or places found in the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from service.interfaces import Rasterizer
from service.pose.features.image_sizes import sized
from service.pose.retrieval.scene_focus import centre_depth
from service.pose.retrieval.view_placement import find_views
from service.types import Camera, GaussianScene, Pose

INDEX_PX = 384
INDEX_VIEWS = 64
MAX_INDEX_VIEWS = 512
SPREAD = 0.35
"""A wide scene gets more views, until each training camera has one within this distance (see `spread`)."""
DEPTH_CAMERAS = 24


def index_cameras(scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator) -> list[Camera]:
    """Return the cameras that the view index is rendered with."""
    if not scene.cameras:
        found = find_views(scene, rasterizer, rng)
        return [Camera(sized(camera.intrinsics, INDEX_PX), camera.pose) for camera in found.cameras]
    cameras = [named.camera for named in scene.cameras]
    depths = [centre_depth(rasterizer, camera) for camera in cameras[:: -(-len(cameras) // DEPTH_CAMERAS)]]
    seen = [depth for depth in depths if depth > 0]
    chosen = spread([camera.pose for camera in cameras], float(np.median(seen)) if seen else 1.0)
    return [Camera(sized(cameras[i].intrinsics, INDEX_PX), cameras[i].pose) for i in chosen]


def spread(poses: Sequence[Pose], depth: float) -> Int64[np.ndarray, "k"]:
    """Choose poses by farthest point over position and viewing direction.

    Distances are |difference of positions| / `depth` (the typical one of what is seen) and the chord between the axes,
    added as squares: 0.35 is some 14 degrees on an orbit.
    """
    positions = np.stack([pose.position_in_world for pose in poses])
    axes = np.stack([pose.axis_in_world for pose in poses])
    places = np.concatenate([positions / max(depth, 1e-9), axes], 1)
    return farthest_points(places, INDEX_VIEWS, MAX_INDEX_VIEWS, SPREAD)


def farthest_points(
    places: Float64[np.ndarray, "n d"], at_least: int, at_most: int, spacing: float
) -> Int64[np.ndarray, "k"]:
    """Take the place farthest from those taken, until `at_least` are and none is farther than `spacing`."""
    chosen = [int(np.argmin(np.linalg.norm(places - np.median(places, axis=0), axis=1)))]
    distance = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < min(at_most, len(places)):
        farthest = int(np.argmax(distance))
        if distance[farthest] == 0 or (len(chosen) >= at_least and distance[farthest] < spacing):
            break
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(places - places[farthest], axis=1))
    return np.array(chosen)
