"""Camera frusta: their edges as line segments, viser's parameters for one, and which one a click hits. Pure numpy.

Poses are world_from_camera with OpenCV axes (+x right, +y down, +z forward); lengths are scene units.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from service.types import Intrinsics, Pose

# The image's corners in order, then the frustum's edges between apex (0) and corners (1 to 4).
_CORNERS = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64)
_EDGES = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])


def frustum_edges(
    poses: Float64[np.ndarray, "k 4 4"], intrinsics: Sequence[Intrinsics], depth: float
) -> Float32[np.ndarray, "e 2 3"]:
    """Return the eight edges of each frustum of this depth, as segments in the world."""
    if not len(poses):
        return np.zeros((0, 2, 3), np.float32)
    corners = np.zeros((len(poses), 5, 3))
    for row, k in zip(corners, intrinsics, strict=True):
        px = _CORNERS * [k.width, k.height]
        row[1:, :2] = (px - [k.cx, k.cy]) / [k.fx, k.fy]
        row[1:, 2] = 1.0
    in_world = np.einsum("kij,kcj->kci", poses[:, :3, :3], depth * corners) + poses[:, None, :3, 3]
    return in_world[:, _EDGES].reshape(-1, 2, 3).astype(np.float32)


def edge_colours(colours: UInt8[np.ndarray, "k 3"]) -> UInt8[np.ndarray, "e 2 3"]:
    """Return the colours of frusta as colours of both ends of each of their edges, as `frustum_edges` orders them."""
    return np.repeat(colours, 2 * len(_EDGES), 0).reshape(-1, 2, 3)


def viser_frustum(photo: Intrinsics, depth: float) -> tuple[float, float, float]:
    """Return viser's parameters of a frustum of this depth: vertical field of view (rad), aspect, scale."""
    half_width, half_height = 0.5 * photo.width / photo.fx, 0.5 * photo.height / photo.fy
    # viser's scale is the cube root of the pyramid's volume (times 3/4), not its depth.
    scale = depth * float(np.cbrt(half_width * half_height / 3))
    return float(2 * np.arctan(half_height)), half_width / half_height, scale


def hit_frustum(
    origin: Float64[np.ndarray, "3"],
    direction: Float64[np.ndarray, "3"],
    poses: Float64[np.ndarray, "k 4 4"],
    depth: float,
) -> int | None:
    """Return the index of the nearest frustum that a ray hits, each taken as a ball about its middle; None: none."""
    if not len(poses):
        return None
    direction = direction / np.linalg.norm(direction)
    # The middle of the drawn pyramid, not its apex, which is hard to click.
    middles = poses[:, :3, 3] + 0.6 * depth * poses[:, :3, 2]
    along = (middles - origin) @ direction
    beside = np.linalg.norm(middles - origin - along[:, None] * direction, axis=1)
    hit = np.flatnonzero((beside < 0.6 * depth) & (along > 0))
    return int(hit[np.argmin(along[hit])]) if len(hit) else None


def stack_poses(poses: Sequence[Pose]) -> Float64[np.ndarray, "k 4 4"]:
    """Return the world_from_camera matrices as one array, which may be empty."""
    return np.array([p.world_from_camera for p in poses], np.float64).reshape(-1, 4, 4)
