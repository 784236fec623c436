"""Where to render the index from: a spread choice of the training cameras, or places found in the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from service.geometry import nearest_point_to_axes
from service.interfaces import Rasterizer
from service.pose.views import sized
from service.types import Camera, GaussianScene, Pose

INDEX_PX = 384
INDEX_VIEWS = 64
MAX_INDEX_VIEWS = 256
SPREAD = 0.35
"""A wide scene gets more views, until each training camera has one within this distance (see `spread`)."""


def index_cameras(scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator) -> list[Camera]:
    cameras = [named.camera for named in scene.cameras]
    chosen = spread([camera.pose for camera in cameras])
    return [Camera(sized(cameras[i].intrinsics, INDEX_PX), cameras[i].pose) for i in chosen]


def spread(poses: Sequence[Pose]) -> Int64[np.ndarray, "k"]:
    """Choose poses by farthest point over position and viewing direction.

    Distances are |difference of positions| / (median distance from the focus) and the chord between the axes,
    added as squares: 0.35 is some 14 degrees on an orbit.
    """
    focus = nearest_point_to_axes(poses)
    positions = np.stack([pose.position_in_world for pose in poses])
    reach = float(np.median(np.linalg.norm(positions - focus, axis=1)))
    places = np.concatenate([positions / max(reach, 1e-9), np.stack([p.axis_in_world for p in poses])], 1)
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
