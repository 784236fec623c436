"""The point that a scene's cameras look at: its centre for everything that turns about the scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.geometry import nearest_point_to_axes
from service.interfaces import Rasterizer
from service.types import Camera, GaussianScene, Pose


@dataclass(frozen=True, slots=True)
class FocusConfig:
    """How the focus of a scene is determined."""

    forward_facing_deg: float = 15.0
    """Below this root-mean-square angle between the optical axes and their common direction, the point nearest to all
    of them is not determined. LLFF's fern has 6 degrees; orbits of an object, by tripod or on foot, had 33 or more."""
    min_opacity: float = 0.3
    """Of the Gaussians that count as surface where there are no cameras."""
    distance_without_cameras: float = 2.0
    """In units of the radius that holds half of the opaque Gaussians."""
    depth_render_px: int = 256
    """Long side of the renders from which depths are taken."""


FOCUS = FocusConfig()


@dataclass(frozen=True, slots=True)
class Focus:
    """The centre of a scene."""

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
    # With nearly parallel axes the nearest point lies anywhere along them.
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
    opaque = scene.means[scene.opacities > FOCUS.min_opacity].astype(np.float64)
    opaque = opaque if len(opaque) else scene.means.astype(np.float64)
    # The median ignores floaters far away.
    middle = np.median(opaque, axis=0)
    radius = float(np.median(np.linalg.norm(opaque - middle, axis=1)))
    return Focus(middle, max(FOCUS.distance_without_cameras * radius, 1e-9), False)


def centre_depth(rasterizer: Rasterizer, camera: Camera) -> float:
    """Return the median depth rendered in the middle of the image, in scene units; 0 if nothing is there."""
    small = Camera(camera.intrinsics.with_long_side(FOCUS.depth_render_px), camera.pose)
    (frame,) = rasterizer.render([small])
    height, width = frame.median_depth.shape
    # A few pixels: a single one may look through a gap.
    middle = frame.median_depth[height // 2 - 4 : height // 2 + 4, width // 2 - 4 : width // 2 + 4]
    return float(np.median(middle[middle > 0])) if np.any(middle > 0) else 0.0


def is_forward_facing(poses: Sequence[Pose]) -> bool:
    """Return whether the optical axes are nearly parallel: see `FocusConfig.forward_facing_deg`.

    The common direction is the axes' first principal one; 1 - its eigenvalue is the mean squared sine to it.
    """
    axes = np.stack([pose.axis_in_world for pose in poses])
    along = float(np.linalg.eigvalsh(axes.T @ axes / len(axes))[-1])
    opposed = np.any(axes @ axes[0] < 0)  # a room seen both ways is not forward-facing
    return bool(not opposed and 1.0 - along < np.sin(np.radians(FOCUS.forward_facing_deg)) ** 2)
