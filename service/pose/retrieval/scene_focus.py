"""The point that a scene's cameras look at: its centre for everything that turns about the scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.geometry import nearest_point_to_axes
from service.interfaces import Rasterizer
from service.types import Camera, GaussianScene, Pose

FORWARD_FACING_DEG = 15.0
"""Below this root-mean-square angle between the optical axes and their common direction, the point nearest to all
of them is not determined. LLFF's fern has 6 degrees; orbits and walks round an object had 33 or more."""
MIN_OPACITY = 0.3
BARE_DISTANCE = 2.0
"""Where no camera tells the distance: in units of the radius that holds half of the opaque Gaussians."""
CENTRE_PX = 256


@dataclass(frozen=True, slots=True)
class Focus:
    point_in_world: Float64[np.ndarray, "3"]
    distance: float
    """Median distance of the cameras from it, in scene units."""
    forward_facing: bool


def focus_of(cameras: Sequence[Camera], depth_of: Callable[[Camera], float]) -> Focus:
    """Return the point nearest to all optical axes.

    In a forward-facing scene it is the mean of the points that the cameras see in their image centre, at the median
    of their depths: `depth_of` gives a camera's, in scene units, 0 where there is nothing.
    """
    poses = [camera.pose for camera in cameras]
    positions = np.stack([pose.position_in_world for pose in poses])
    forward_facing = is_forward_facing(poses)
    if forward_facing:
        depths = np.array([depth_of(camera) for camera in cameras])
        depth = float(np.median(depths[depths > 0])) if np.any(depths > 0) else 1.0
        point = np.mean([p.position_in_world + depth * p.axis_in_world for p in poses], axis=0)
    else:
        point = nearest_point_to_axes(poses)
    distance = float(np.median(np.linalg.norm(positions - point, axis=1)))
    return Focus(point, max(distance, 1e-9), forward_facing)


def focus_of_scene(scene: GaussianScene, rasterizer: Rasterizer) -> Focus:
    """Return the focus of the training cameras; without any, the middle of the opaque Gaussians."""
    if scene.cameras:
        return focus_of([named.camera for named in scene.cameras], lambda camera: centre_depth(rasterizer, camera))
    opaque = scene.means[scene.opacities > MIN_OPACITY].astype(np.float64)
    opaque = opaque if len(opaque) else scene.means.astype(np.float64)
    middle = np.median(opaque, axis=0)
    radius = float(np.median(np.linalg.norm(opaque - middle, axis=1)))
    return Focus(middle, max(BARE_DISTANCE * radius, 1e-9), False)


def centre_depth(rasterizer: Rasterizer, camera: Camera) -> float:
    """Return the median depth rendered in the middle of the image, in scene units; 0 if nothing is there."""
    small = Camera(camera.intrinsics.with_long_side(CENTRE_PX), camera.pose)
    (frame,) = rasterizer.render([small])
    height, width = frame.median_depth.shape
    middle = frame.median_depth[height // 2 - 4 : height // 2 + 4, width // 2 - 4 : width // 2 + 4]
    return float(np.median(middle[middle > 0])) if np.any(middle > 0) else 0.0


def is_forward_facing(poses: Sequence[Pose]) -> bool:
    """Whether the optical axes are nearly parallel: see FORWARD_FACING_DEG.

    The common direction is the axes' first principal one; 1 - its eigenvalue is the mean squared sine to it.
    """
    axes = np.stack([pose.axis_in_world for pose in poses])
    along = float(np.linalg.eigvalsh(axes.T @ axes / len(axes))[-1])
    opposed = np.any(axes @ axes[0] < 0)  # a room seen both ways is not forward-facing
    return bool(not opposed and 1.0 - along < np.sin(np.radians(FORWARD_FACING_DEG)) ** 2)
