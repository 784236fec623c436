"""What is drawn in 3D, as arrays: frusta, trajectories, sizes and viewpoints. Pure numpy, no viser.

Poses are world_from_camera with OpenCV axes (+x right, +y down, +z forward); lengths are scene units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from service.types import Camera, Intrinsics, Pose

# The corners of the image in order, then the frustum's edges between apex (0) and corners (1 to 4).
_CORNERS = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64)
_EDGES = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """Where a browser's camera stands."""

    position: Float64[np.ndarray, "3"]
    look_at: Float64[np.ndarray, "3"]
    up: Float64[np.ndarray, "3"]
    fov_rad: float
    """Vertical."""


@dataclass(frozen=True, slots=True)
class Extent:
    """How large a scene is and which way is up in it: what sizes and viewpoints follow from."""

    centre: Float64[np.ndarray, "3"]
    radius: float
    """Half the scene's size, without its outliers."""
    up: Float64[np.ndarray, "3"]
    frustum: float
    """A good depth for a drawn frustum."""


def extent(
    means: Float32[np.ndarray, "n 3"],
    cameras: Sequence[Camera],
    up_in_world: tuple[float, float, float] | None,
) -> Extent:
    """Measure a scene by its training cameras where it has some, else by its Gaussians."""
    points = np.array([c.pose.position_in_world for c in cameras], np.float64).reshape(-1, 3)
    if len(points) < 2:
        points = np.asarray(means, np.float64).reshape(-1, 3) if len(means) else np.zeros((1, 3))
    centre = np.median(points, 0)
    # 90 %: floaters far outside of a scene must not make its frusta huge.
    radius = float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.9)) or 1.0
    return Extent(centre, radius, _up(cameras, up_in_world), frustum=0.08 * radius)


def _up(cameras: Sequence[Camera], up_in_world: tuple[float, float, float] | None) -> Float64[np.ndarray, "3"]:
    """Up as the scene says, else as most photographers held their camera, else z."""
    up = np.zeros(3)
    if up_in_world is not None:
        up = np.array(up_in_world, np.float64)
    elif cameras:
        up = -np.sum([c.pose.world_from_camera[:3, 1] for c in cameras], 0)
    length = float(np.linalg.norm(up))
    return up / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])


def first_view(scene: Extent, cameras: Sequence[Camera]) -> Viewpoint:
    """Where a visitor starts: at the first training camera (inside an interior), else outside, above."""
    if cameras:
        return through(cameras[0], scene, aspect=1.0)
    across = np.eye(3)[np.argmin(np.abs(scene.up))]
    away = across - scene.up * (across @ scene.up) + 0.5 * scene.up
    position = scene.centre + 2.5 * scene.radius * away / np.linalg.norm(away)
    return Viewpoint(position, scene.centre, scene.up, float(np.radians(60)))


def through(camera: Camera, scene: Extent, aspect: float) -> Viewpoint:
    """Look through a camera, roll included; its image fits a viewport of this aspect (width / height)."""
    k, pose = camera.intrinsics, camera.pose
    half_height = max(0.5 * k.height / k.fy, 0.5 * k.width / k.fx / aspect)
    right, down = pose.world_from_camera[:3, 0], pose.world_from_camera[:3, 1]
    # Orbiting goes round this axis, so it stays as near to the scene's up as the camera's roll allows.
    up = scene.up - (scene.up @ right) * right
    if up @ -down < 0.05:
        up = -down
    position = pose.position_in_world
    look_at = position + scene.radius * pose.axis_in_world
    return Viewpoint(position, look_at, up / np.linalg.norm(up), float(2 * np.arctan(half_height)))


def behind(pose: Pose, scene: Extent, centres: Float32[np.ndarray, "n 3"]) -> Viewpoint:
    """Look over a camera's shoulder: its frustum before the scene that it sees, and no wall between.

    `centres` are the Gaussians': where they are dense on the way back from the camera, the viewpoint stays closer.
    """
    position, axis = pose.position_in_world, pose.axis_in_world
    eye = position
    for back in (4.0, 3.0, 2.2):  # frustum depths; any closer, and the frustum does not fit the view
        eye = position + back * scene.frustum * (0.4 * scene.up - axis)
        if _crowd(position, eye, centres, 0.5 * scene.frustum) < _WALL:
            break
    return Viewpoint(eye, position + 8.0 * scene.frustum * axis, scene.up, float(np.radians(60)))


_WALL = 12
"""Gaussians around a way that bar the view; floaters are fewer, surfaces have dozens."""


def _crowd(
    start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"], points: Float32[np.ndarray, "n 3"], reach: float
) -> int:
    """Count the points within `reach` of a segment."""
    along = (end - start).astype(np.float32)
    offset = points - start.astype(np.float32)
    share = np.clip(offset @ along / (along @ along), 0, 1)
    return int((np.linalg.norm(offset - share[:, None] * along, axis=1) < reach).sum())


def between(a: Viewpoint, b: Viewpoint, share: float) -> Viewpoint:
    """A viewpoint on the way, eased in and out; `share` is 0..1."""
    s = share * share * (3 - 2 * share)
    return Viewpoint(
        a.position + s * (b.position - a.position),
        a.look_at + s * (b.look_at - a.look_at),
        a.up + s * (b.up - a.up),
        a.fov_rad + s * (b.fov_rad - a.fov_rad),
    )


def frusta(
    poses: Float64[np.ndarray, "k 4 4"], intrinsics: Sequence[Intrinsics], depth: float
) -> Float32[np.ndarray, "e 2 3"]:
    """Return the eight edges of every frustum as line segments in the world."""
    if not len(poses):
        return np.zeros((0, 2, 3), np.float32)
    corners = np.zeros((len(poses), 5, 3))
    for row, k in zip(corners, intrinsics, strict=True):
        px = _CORNERS * [k.width, k.height]
        row[1:, :2] = (px - [k.cx, k.cy]) / [k.fx, k.fy]
        row[1:, 2] = 1.0
    in_world = np.einsum("kij,kcj->kci", poses[:, :3, :3], depth * corners) + poses[:, None, :3, 3]
    return in_world[:, _EDGES].reshape(-1, 2, 3).astype(np.float32)


def frustum_form(photo: Intrinsics, depth: float) -> tuple[float, float, float]:
    """Return what viser calls field of view, aspect and scale of a frustum of this depth."""
    half_width, half_height = 0.5 * photo.width / photo.fx, 0.5 * photo.height / photo.fy
    # Its scale is the cube root of the pyramid's volume (times 3/4), not its depth.
    scale = depth * float(np.cbrt(half_width * half_height / 3))
    return float(2 * np.arctan(half_height)), half_width / half_height, scale


def frustum_colours(colours: UInt8[np.ndarray, "k 3"]) -> UInt8[np.ndarray, "e 2 3"]:
    """Return a colour for both ends of every edge of `frusta`."""
    return np.repeat(colours, 2 * len(_EDGES), 0).reshape(-1, 2, 3)


def nearest_to_ray(
    origin: Float64[np.ndarray, "3"],
    direction: Float64[np.ndarray, "3"],
    poses: Float64[np.ndarray, "k 4 4"],
    depth: float,
) -> int | None:
    """Return the frustum that a click's ray hits, the nearest one first; None: it passes all of them."""
    if not len(poses):
        return None
    direction = direction / np.linalg.norm(direction)
    middles = poses[:, :3, 3] + 0.6 * depth * poses[:, :3, 2]
    along = (middles - origin) @ direction
    beside = np.linalg.norm(middles - origin - along[:, None] * direction, axis=1)
    hit = np.flatnonzero((beside < 0.6 * depth) & (along > 0))
    return int(hit[np.argmin(along[hit])]) if len(hit) else None


def stacked(poses: Sequence[Pose]) -> Float64[np.ndarray, "k 4 4"]:
    """Return the world_from_camera matrices as one array, also of no poses."""
    return np.array([p.world_from_camera for p in poses], np.float64).reshape(-1, 4, 4)


def full_covariances(upper: Float32[np.ndarray, "n 6"]) -> Float32[np.ndarray, "n 3 3"]:
    """Return symmetric matrices from xx, xy, xz, yy, yz, zz."""
    return upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
