"""The outer planes of a large scene: its ground, and the facades of a street, behind which nobody photographed it.

A plane that holds many of the opaque Gaussians, with next to all others on one side, is an outer one. An object has
such planes, too, and is photographed from outside of them; but it is small compared with the distance that it is
photographed from, while along a ground or a row of houses photos were taken one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64


@dataclass(frozen=True, slots=True)
class PlaneConfig:
    """Which planes are looked for, by random sampling (RANSAC)."""

    points: int = 8000
    """That take part."""
    trials: int = 400
    near: tuple[float, ...] = (0.015, 0.03, 0.06, 0.12)
    """Distances of a plane's points from it, as shares of the typical distance, which is known within a factor of 3:
    that with which the most outer planes are found, the least of these."""
    min_share: float = 0.08
    """Of all points, from which on they are a plane..."""
    max_beyond: float = 0.03
    """...and an outer one, if at most this share lies beyond it, and more than `min_share` before it."""
    min_extent: float = 1.0
    """Standard deviation of its points along their longest axis, in typical distances: a street of twelve times the
    distance has 3.5, a cube 0.3, a room 0.4."""
    most: int = 6
    """Planes that are looked at."""
    parallel: float = 0.9
    perpendicular: float = 0.3
    """Cosines of normals from which on, and up to which, two planes are so."""


PLANES = PlaneConfig()


def outer_planes(
    points: Float64[np.ndarray, "n 3"], distance: float, config: PlaneConfig = PLANES
) -> Float64[np.ndarray, "k 4"]:
    """Return the outer planes (unit normal n, offset d): n x + d is positive on the side of the scene.

    `distance`: from which the scene was photographed, typically. The same planes each time.
    """
    points = points[:: -(-len(points) // config.points) or 1]
    found = [_outer_planes(points, near * distance, config.min_extent * distance, config) for near in config.near]
    return max(found, key=len)


def _outer_planes(
    points: Float64[np.ndarray, "n 3"], near: float, min_extent: float, config: PlaneConfig
) -> Float64[np.ndarray, "k 4"]:
    rng, left = np.random.default_rng(0), points
    least = max(4.0, config.min_share * len(points))
    found: list[Float64[np.ndarray, "4"]] = []
    for _ in range(config.most):
        if len(left) < least:
            break
        plane = _largest_plane(left, near, rng, config.trials)
        is_own = np.abs(left @ plane[:3] + plane[3]) < near
        own, left = left[is_own], left[~is_own]
        if len(own) < least:
            break
        extent = np.sqrt(np.linalg.eigvalsh(np.cov(own.T))[-1])
        before, beyond = (float((side * (points @ plane[:3] + plane[3]) >= near).mean()) for side in (1, -1))
        if extent < min_extent or min(before, beyond) > config.max_beyond:
            continue
        if max(before, beyond) > config.min_share:
            found.append(plane if before > beyond else -plane)
    return np.array(found).reshape(-1, 4)


def before_planes(positions: Float64[np.ndarray, "n 3"], planes: Float64[np.ndarray, "k 4"]) -> Bool[np.ndarray, "n"]:
    """Return which positions are on the scene's side of all planes."""
    return np.asarray((positions @ planes[:, :3].T + planes[:, 3] > 0).all(1))


def ground_normal(planes: Float64[np.ndarray, "k 4"], config: PlaneConfig = PLANES) -> Float64[np.ndarray, "3"] | None:
    """Return the normal of the outer plane that alone has none opposite, between two walls; None: there is none.

    It points up from the ground of a street. A ceiling, of which it points down, has a floor opposite.
    """
    cosines = planes[:, :3] @ planes[:, :3].T
    has_opposite = (cosines < -config.parallel).any(1)
    walls = np.flatnonzero(has_opposite)
    alone = [i for i in np.flatnonzero(~has_opposite) if (np.abs(cosines[i, walls]) < config.perpendicular).any()]
    return planes[alone[0], :3] if len(alone) == 1 else None


def _largest_plane(
    points: Float64[np.ndarray, "n 3"], near: float, rng: np.random.Generator, trials: int
) -> Float64[np.ndarray, "4"]:
    """Return the plane through three of the points that most others are near to, refined by least squares."""
    corners = points[rng.integers(len(points), size=(trials, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(areas, 1e-30)[:, None]
    offsets = -(normals * corners[:, 0]).sum(1)
    # The same point twice makes no plane.
    counts = np.where(areas > 0, (np.abs(points @ normals.T + offsets) < near).sum(0), 0)
    best = int(np.argmax(counts))
    own = points[np.abs(points @ normals[best] + offsets[best]) < near]
    if len(own) == 0:  # all points at one place
        return np.array([0.0, 0.0, 1.0, np.inf])
    middle = own.mean(0)
    normal = np.linalg.eigh((own - middle).T @ (own - middle))[1][:, 0]
    return np.append(normal, -normal @ middle)
