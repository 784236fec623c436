"""The size of a scene, and where a browser's camera is placed in it. Pure numpy, no viser.

Poses are world_from_camera with OpenCV axes (+x right, +y down, +z forward); lengths are scene units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from service.types import Camera, Pose

_FOV_RAD = float(np.radians(60))
"""Vertical field of view of views that no photo prescribes."""
_PLAN_FOV_RAD = float(np.radians(15))
_OCCLUDING_SPLATS = 12
"""Splats near the line of sight that occlude it; floaters are fewer, surfaces have dozens."""


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """Position and orientation of a browser's camera, in the world frame."""

    position: Float64[np.ndarray, "3"]
    look_at: Float64[np.ndarray, "3"]
    up: Float64[np.ndarray, "3"]
    fov_rad: float
    """Vertical."""


@dataclass(frozen=True, slots=True)
class SceneExtent:
    """Size and upright direction of a scene, in the world frame."""

    centre: Float64[np.ndarray, "3"]
    radius: float
    """Half the scene's size, without its outliers."""
    up: Float64[np.ndarray, "3"]
    frustum_depth: float
    """Depth at which camera frusta are drawn: large enough to see, small enough not to cover the scene."""


def scene_extent(
    centres: Float32[np.ndarray, "n 3"],
    cameras: Sequence[Camera],
    up_in_world: tuple[float, float, float] | None,
) -> SceneExtent:
    """Return a scene's extent: median and 90 % quantile of its training cameras' positions.

    Without training cameras, those of its splats' `centres`. Up is `up_in_world`, else the mean of the cameras' up
    directions, else +z.
    """
    points = np.array([c.pose.position_in_world for c in cameras], np.float64).reshape(-1, 3)
    # A single camera has no extent.
    if len(points) < 2:
        points = np.asarray(centres, np.float64).reshape(-1, 3) if len(centres) else np.zeros((1, 3))
    centre = np.median(points, 0)
    # The quantile excludes floaters far outside of the scene, which would make its frusta huge.
    radius = float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.9)) or 1.0
    return SceneExtent(centre, radius, _up(cameras, up_in_world), frustum_depth=0.08 * radius)


def _up(cameras: Sequence[Camera], up_in_world: tuple[float, float, float] | None) -> Float64[np.ndarray, "3"]:
    up = np.zeros(3)
    if up_in_world is not None:
        up = np.array(up_in_world, np.float64)
    elif cameras:
        up = -np.sum([c.pose.world_from_camera[:3, 1] for c in cameras], 0)
    length = float(np.linalg.norm(up))
    return up / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])


def initial_view(scene: SceneExtent, cameras: Sequence[Camera]) -> Viewpoint:
    """Return the view of a scene before any job: its first training camera's, else one from outside and above."""
    if cameras:
        return view_through(cameras[0], scene, aspect=1.0)  # inside, where the scene is an interior
    # Any direction across up does; the world axis farthest from it is never parallel.
    across = np.eye(3)[np.argmin(np.abs(scene.up))]
    away = across - scene.up * (across @ scene.up) + 0.5 * scene.up
    position = scene.centre + 2.5 * scene.radius * away / np.linalg.norm(away)
    return Viewpoint(position, scene.centre, scene.up, _FOV_RAD)


def view_from_above(
    scene: SceneExtent, cameras: Sequence[Camera], points: Float32[np.ndarray, "n 3"], aspect: float
) -> Viewpoint:
    """Return the view straight down on the training cameras and on nine tenths of `points`, nearly without perspective.

    What is right in the picture is the world axis nearest to a horizontal one, like the first axis of coverage maps.
    """
    right = np.eye(3)[np.argmin(np.abs(scene.up))]
    right = right - (right @ scene.up) * scene.up
    right /= np.linalg.norm(right)
    top = np.cross(scene.up, right)
    at = np.array([camera.pose.position_in_world for camera in cameras], np.float64).reshape(-1, 3)
    low, high = (np.quantile(points @ np.stack([right, top], 1), q, axis=0) for q in (0.05, 0.95))
    if len(at):
        flat = at @ np.stack([right, top], 1)
        low, high = np.minimum(low, flat.min(0)), np.maximum(high, flat.max(0))
    half = 0.5 * (high - low)
    reach = 1.15 * max(half[1], half[0] / max(aspect, 1e-6), 1e-6)
    middle = 0.5 * (low + high) @ np.stack([right, top]) + scene.up * (scene.up @ scene.centre)
    height = reach / np.tan(0.5 * _PLAN_FOV_RAD)
    # The browser can't look exactly along the axis that it turns about: that axis lies in the plan.
    return Viewpoint(middle + height * scene.up, middle, top, _PLAN_FOV_RAD)


def view_through(camera: Camera, scene: SceneExtent, aspect: float) -> Viewpoint:
    """Return the view through a camera, roll included, with its image fitted to a viewport of this width / height."""
    k, pose = camera.intrinsics, camera.pose
    # In units of the focal length; the wider of both fits determines the field of view.
    half_height = max(0.5 * k.height / k.fy, 0.5 * k.width / k.fx / aspect)
    right, down = pose.world_from_camera[:3, 0], pose.world_from_camera[:3, 1]
    # The browser orbits about this axis: the scene's up, projected so that the image keeps the camera's roll.
    up = scene.up - (scene.up @ right) * right
    if up @ -down < 0.05:
        up = -down
    position = pose.position_in_world
    look_at = position + scene.radius * pose.axis_in_world
    return Viewpoint(position, look_at, up / np.linalg.norm(up), float(2 * np.arctan(half_height)))


def view_from_behind(pose: Pose, scene: SceneExtent, centres: Float32[np.ndarray, "n 3"]) -> Viewpoint:
    """Return a view from behind and above a camera that shows its frustum and what it looks at.

    The longest of three distances is taken from which no surface occludes the camera: `centres` are the scene's
    splats, counted near the line of sight.
    """
    position, axis = pose.position_in_world, pose.axis_in_world
    eye = position
    for back in (4.0, 3.0, 2.2):  # frustum depths; from any closer, the frustum does not fit the view
        eye = position + back * scene.frustum_depth * (0.4 * scene.up - axis)
        if _count_near_segment(position, eye, centres, 0.5 * scene.frustum_depth) < _OCCLUDING_SPLATS:
            break
    return Viewpoint(eye, position + 8.0 * scene.frustum_depth * axis, scene.up, _FOV_RAD)


def _count_near_segment(
    start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"], points: Float32[np.ndarray, "n 3"], distance: float
) -> int:
    along = (end - start).astype(np.float32)
    offset = points - start.astype(np.float32)
    share = np.clip(offset @ along / (along @ along), 0, 1)
    return int((np.linalg.norm(offset - share[:, None] * along, axis=1) < distance).sum())


def interpolate_views(a: Viewpoint, b: Viewpoint, share: float) -> Viewpoint:
    """Return the viewpoint at `share` (0..1) of the way from `a` to `b`, smoothly accelerated and braked."""
    s = share * share * (3 - 2 * share)
    return Viewpoint(
        a.position + s * (b.position - a.position),
        a.look_at + s * (b.look_at - a.look_at),
        a.up + s * (b.up - a.up),
        a.fov_rad + s * (b.fov_rad - a.fov_rad),
    )
