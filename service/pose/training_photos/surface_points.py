"""Surface points of one training photo: its corners, found in neighbouring photos and triangulated.

The splat's depth, which is biased on soft and shiny surfaces, only predicts where the neighbours show a corner, and
rules out points that are far off it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from service.geometry import transformed, unproject
from service.interfaces import SurfacePoints
from service.pose.training_photos.corners import SurfaceCorners
from service.pose.training_photos.patch_matching import matched, predicted
from service.types import Camera


@dataclass(frozen=True, slots=True)
class TriangulationConfig:
    neighbours: int = 6
    """Photos that a corner is looked for in: with 4 poses are less exact, with 9 as exact."""
    angles_deg: tuple[float, float] = (1.5, 35.0)
    """Between the rays of two photos to a point: with less its depth isn't determined, beyond it looks different."""
    large_angle_deg: float = 20.0
    """Typical angle at which a neighbour counts half: patches match better at small ones."""
    min_share: float = 0.08
    """Of the corners that a neighbour shows at such angles..."""
    every: int = 4
    """...of which every fourth is looked at."""
    max_motion_px: tuple[float, float] = (6.0, 2.0)
    """Search radius in a neighbour, by the splat's depth and by the triangulated one."""
    min_views: int = 3
    """Photos that show a point, its own included."""
    noise_px: float = 0.5
    """Residual at which Cauchy's weight is a fifth of the way down; poses of training photos err by this much."""
    max_error_px: float = 1.0
    max_rms_px: float = 0.7
    """Reprojection error of a photo that counts, and the root mean square of those."""
    max_depth_error: float = 0.1
    """Between triangulated and rendered depth, relative. 0.05 leaves out points of foliage that are right."""
    match_noise_px: float = 0.3
    """Standard deviation of a place, of which the points' covariances are made."""
    steps: int = 3


TRIANGULATION = TriangulationConfig()


@dataclass(frozen=True, slots=True)
class PosedPhoto:
    """A training photo with the pose that its points are triangulated with."""

    grey: UInt8[np.ndarray, "h w"]
    camera: Camera
    """Of `grey`."""


@dataclass(frozen=True, slots=True)
class TriangulatedCorners:
    points: SurfacePoints
    """All of one photo."""
    rms_px: Float64[np.ndarray, "n"]
    """Reprojection error of each point, over the photos that show it."""
    depth_ratio: Float64[np.ndarray, "n"]
    """Of triangulated and rendered depth."""


def triangulated_corners(
    number: int, corners: SurfaceCorners, photos: Sequence[PosedPhoto], config: TriangulationConfig = TRIANGULATION
) -> TriangulatedCorners:
    """Find the corners of photo `number` in its neighbours, and keep those whose points at least three photos agree on.

    Twice: predicted by the rendered depth, then by the triangulated one, which also warps the patches better.
    """
    own = photos[number].camera
    points = _on_surface(number, corners, corners.depth, own)
    near = _neighbours(number, points.points_in_world[:: config.every], photos, config)
    if not near:
        return TriangulatedCorners(selected(points, np.zeros(0, np.int64)), np.zeros(0), np.zeros(0))
    cameras = [own, *(photos[other].camera for other in near)]
    good, found = np.zeros(0, bool), None
    depth = corners.depth
    for motion_px in config.max_motion_px:
        places = [matched(photos[i].grey, points.patches, predicted(points, photos[i].camera), motion_px) for i in near]
        seen = np.stack([corners.px, *places])
        # What too few photos show isn't looked for again.
        kept = np.flatnonzero(np.isfinite(seen[:, :, 0]).sum(0) >= config.min_views)
        corners, points, depth, seen = corners.some(kept), selected(points, kept), depth[kept], seen[:, kept]
        found = _triangulate(points.points_in_world, seen, cameras, config)
        along = transformed(own.pose.camera_from_world, found.points)[:, 2]
        good = found.is_supported & (np.abs(along / corners.depth - 1) < config.max_depth_error)
        depth = np.where(good, along, depth)
        points = _on_surface(number, corners, depth, own)
        at = np.where(good[:, None], found.points, points.points_in_world)
        points = replace(points, points_in_world=at, covariances=found.covariances.astype(np.float32))
    assert found is not None
    ratio = depth / corners.depth
    return TriangulatedCorners(selected(points, np.flatnonzero(good)), found.rms_px[good], ratio[good])


def selected(points: SurfacePoints, index: Int64[np.ndarray, "m"]) -> SurfacePoints:
    """Return some of the points."""
    names = ("points_in_world", "covariances", "tangents", "patches", "photo")
    return replace(points, **{name: getattr(points, name)[index] for name in names})


def _on_surface(number: int, corners: SurfaceCorners, depth: Float64[np.ndarray, "n"], camera: Camera) -> SurfacePoints:
    """Return points at these depths, on planes whose slope is the rendered surface's."""
    k, pose = camera.intrinsics, camera.pose.world_from_camera
    points = unproject(corners.px, depth, k)
    rays = points / depth[:, None]
    # With 1 / z linear in the pixel, dz = -z^2 slope; the point is z times the ray.
    tangents = -((depth**2)[:, None, None] * rays[:, :, None] * corners.slope[:, None, :])
    tangents[:, 0, 0] += depth / k.fx
    tangents[:, 1, 1] += depth / k.fy
    return SurfacePoints(
        transformed(pose, points),
        np.zeros((len(points), 3, 3), np.float32),
        (pose[:3, :3] @ tangents).astype(np.float32),
        corners.patches,
        np.full(len(points), number, np.int32),
        camera.pose.position_in_world[None],
    )


def _neighbours(
    number: int, points: Float64[np.ndarray, "n 3"], photos: Sequence[PosedPhoto], config: TriangulationConfig
) -> list[int]:
    """Return which photos show most of the points at the angles that are of use, rather at small ones than at large."""
    low, high = config.angles_deg
    towards, scores = _directions(points, photos[number].camera), np.zeros(len(photos))
    for other, photo in enumerate(photos):
        angles = np.degrees(np.arccos(np.clip((towards * _directions(points, photo.camera)).sum(1), -1.0, 1.0)))
        with np.errstate(divide="ignore", invalid="ignore"):
            px, _ = _projected(points, photo.camera)
        height, width = photo.grey.shape
        ahead = transformed(photo.camera.pose.camera_from_world, points)[:, 2] > 0
        shown = ahead & (px > 0).all(1) & (px < [width, height]).all(1)
        share = float((shown & (angles > low) & (angles < high)).mean()) if len(points) else 0.0
        if other != number and share > config.min_share:
            scores[other] = share / (1 + np.median(angles[shown]) / config.large_angle_deg)
    order = np.argsort(-scores, kind="stable")[: config.neighbours]
    return [int(i) for i in order if scores[i] > 0]


def _directions(points: Float64[np.ndarray, "n 3"], camera: Camera) -> Float64[np.ndarray, "n 3"]:
    along = points - camera.pose.position_in_world
    return along / np.linalg.norm(along, axis=1, keepdims=True)


@dataclass(frozen=True, slots=True)
class _Triangulated:
    points: Float64[np.ndarray, "n 3"]
    covariances: Float64[np.ndarray, "n 3 3"]
    rms_px: Float64[np.ndarray, "n"]
    is_supported: Bool[np.ndarray, "n"]


def _triangulate(
    start: Float64[np.ndarray, "n 3"],
    seen: Float64[np.ndarray, "views n 2"],
    cameras: Sequence[Camera],
    config: TriangulationConfig,
) -> _Triangulated:
    """Minimize the reprojection errors of each point, weighed by Cauchy's function; NaN: a camera doesn't show it."""
    points = start.copy()
    for _ in range(config.steps):
        hessian, pull, _ = _reprojection(points, seen, cameras, config)
        points = points + np.linalg.solve(hessian, pull[..., None])[..., 0]
    hessian, _, errors = _reprojection(points, seen, cameras, config)
    agree = errors < config.max_error_px
    views = agree.sum(0)
    rms = np.sqrt((np.where(agree, errors, 0.0) ** 2).sum(0) / np.maximum(views, 1))
    supported = (views >= config.min_views) & agree[0] & (rms < config.max_rms_px)
    return _Triangulated(points, config.match_noise_px**2 * np.linalg.inv(hessian), rms, supported)


def _reprojection(
    points: Float64[np.ndarray, "n 3"],
    seen: Float64[np.ndarray, "views n 2"],
    cameras: Sequence[Camera],
    config: TriangulationConfig,
) -> tuple[Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "views n"]]:
    """Return each point's hessian and right-hand side, and its errors in pixels; infinite where it isn't seen."""
    hessian, pull = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    errors = np.full(seen.shape[:2], np.inf)
    for view, (camera, px) in enumerate(zip(cameras, seen, strict=True)):
        predicted_px, jacobian = _projected(points, camera)
        missing = np.isnan(px[:, 0])
        residual = np.where(missing[:, None], 0.0, px - predicted_px)
        squared = (residual**2).sum(1)
        weight = np.where(missing, 0.0, 1.0 / (1.0 + squared / (2 * config.noise_px) ** 2))
        hessian += np.einsum("n,nki,nkj->nij", weight, jacobian, jacobian)
        pull += np.einsum("n,nki,nk->ni", weight, jacobian, residual)
        errors[view] = np.where(missing, np.inf, np.sqrt(squared))
    # Where rays are nearly parallel, the point moves along them by what can be solved for.
    hessian += 1e-9 * np.eye(3) * np.trace(hessian, axis1=1, axis2=2)[:, None, None]
    return hessian, pull, errors


def _projected(
    points: Float64[np.ndarray, "n 3"], camera: Camera
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2 3"]]:
    """Return the points' pixels, and d pixel / d point in the world."""
    k, rotation = camera.intrinsics, camera.pose.camera_from_world[:3, :3]
    local = transformed(camera.pose.camera_from_world, points)
    place, focal = local[:, :2] / local[:, 2:], np.array([k.fx, k.fy])
    jacobian = (rotation[:2] - place[:, :, None] * rotation[2]) * (focal[:, None] / local[:, 2, None, None])
    return place * focal + [k.cx, k.cy], jacobian
