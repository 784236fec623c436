"""The pose of a photo with exact intrinsics by patches of training photos, from one that is off by a few pixels.

Patches that the photo should show are found in it at its full size by least-squares matching. The pose follows from the
places by robust Gauss-Newton; its covariance has the jackknife's scale over parts of the image, as that of photometric
refinement, with which the result is then combined: a mean of both, each weighed by its information.

With approximate intrinsics nothing is gained: what patches say of the lens is no more exact than what pixels say.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from service.geometry import moved, project, se3_log, transformed
from service.interfaces import SurfacePoints
from service.pose.features.rendered_views import RenderedView
from service.pose.refinement.covariance import inverse_spd, jackknife_variance_scale
from service.pose.refinement.refinement_config import REFINEMENT
from service.pose.training_photos.corners import cells_of, take_in_turns
from service.pose.training_photos.patch_kernels import linearize_places
from service.pose.training_photos.patch_matching import PredictedPatches, matched, pinhole_vector, predicted
from service.pose.training_photos.surface_points import selected
from service.types import Camera, Pose


@dataclass(frozen=True, slots=True)
class PatchPoseConfig:
    """Which patches are looked for in a photo, and which places of them count."""

    min_photo_px: int = 520
    """Long side of a photo: one hardly larger than renders has no more detail than refinement has used."""
    max_patches: int = 600
    """Of those that a photo may show; twice as many are no more exact."""
    cells_across: int = 8
    """They are taken in turns from square cells of the photo, so many across..."""
    magnification_deg: float = 8.0
    """...those first that were photographed from nearly the same side and distance: a distance that differs by a factor
    e counts as much as this angle."""
    max_angle_deg: float = 35.0
    """Between the rays to a point of the photo and of the training photo."""
    max_depth_error: float = 0.1
    """Between a point's depth and the rendered one, relative: beyond it something hides the point."""
    max_motion_px: float = 5.0
    """How far from the predicted place a patch is looked for."""
    noise_px: float = 0.3
    """Standard deviation of a patch's place, at first: the jackknife scales it."""
    steps: int = 8
    settled: float = 1e-7
    """Steps of Gauss-Newton, and the largest component (rad, shares of the distance) of the last one."""
    cauchy_scale: float = 1.0
    cutoff: float = 5.0
    """Residual, in robust standard deviations, at which Cauchy's weight is a half, and beyond which it is 0: places err
    together where a lens differs from its calibration, and a scale of 2 is less exact then."""
    min_agreeing: int = 40
    min_agreeing_share: float = 0.5
    """Patches that agree with the pose, and their share of those that were found."""
    damping: float = 1e-9
    """Of the scaled normal equations: keeps in place what patches don't determine."""
    min_variance_scale: float = 1.0
    """Lower bound of the jackknife's scale: quarters of one photo may agree by chance."""


PATCH_POSE = PatchPoseConfig()


@dataclass(frozen=True, slots=True)
class PatchPose:
    """The pose by patches and pixels together."""

    pose: Pose
    covariance: Float64[np.ndarray, "6 6"]
    """Of the right twist."""
    found: int
    """Patches that the photo shows."""
    agreeing: int
    """Of these, those that agree with the pose."""


def patch_pose(
    photo: UInt8[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"] | None,
    camera: Camera,
    covariance: Float64[np.ndarray, "6 6"],
    rendered: RenderedView,
    points: SurfacePoints,
    config: PatchPoseConfig = PATCH_POSE,
) -> PatchPose | None:
    """Return a more exact pose than that of `camera`, the photo's own; None where too few patches agree.

    `covariance` is that of photometric refinement, which led to that pose, of its right twist; `rendered` is a render
    within a pixel of it.
    """
    where = predicted(points, camera)
    chosen = _chosen(points, where, camera, valid, rendered, config)
    points = selected(points, chosen)
    places = matched(photo, points.patches, _taken(where, chosen), config.max_motion_px)
    found = np.flatnonzero(~np.isnan(places[:, 0]))
    information = inverse_spd(covariance)
    if len(found) < config.min_agreeing or information is None:
        return None
    return _combined(selected(points, found), places[found], camera, information, config)


def _combined(
    points: SurfacePoints,
    places: Float64[np.ndarray, "n 2"],
    camera: Camera,
    information: Float64[np.ndarray, "6 6"],
    config: PatchPoseConfig,
) -> PatchPose | None:
    """Solve for the places alone, then take the mean with what was known before, each weighed by its information."""
    solved = _solved(points, places, camera, config)
    agreeing = int((solved.weight > 0).sum())
    if agreeing < max(config.min_agreeing, config.min_agreeing_share * len(places)):
        return None
    cells = cells_of(places, camera.intrinsics.width, config.cells_across)
    scale = max(_jackknife(solved, cells, config), config.min_variance_scale)
    by_patches = solved.hessian / scale
    joint = inverse_spd(information + by_patches) if np.isfinite(scale) else None
    if joint is None:
        return None
    # The squared difference of both solutions in standard deviations, 6 by chance: where it is more, both err by more.
    difference = float(solved.step @ information @ joint @ by_patches @ solved.step)
    covariance = max(1.0, difference / 6) * joint
    return PatchPose(moved(camera.pose, joint @ (by_patches @ solved.step)), covariance, len(places), agreeing)


@dataclass(frozen=True, slots=True)
class _Solved:
    step: Float64[np.ndarray, "6"]
    """Right twist from the start."""
    hessian: Float64[np.ndarray, "6 6"]
    rows: Float64[np.ndarray, "n 2 6"]
    residuals: Float64[np.ndarray, "n 2"]
    """Whitened, at the solution."""
    weight: Float64[np.ndarray, "n"]


def _solved(
    points: SurfacePoints, places: Float64[np.ndarray, "n 2"], camera: Camera, config: PatchPoseConfig
) -> _Solved:
    """Minimize the reprojection errors of the places, with Cauchy's weights and a cut-off, by Gauss-Newton."""
    rows, residuals = np.empty((len(places), 2, 6)), np.empty((len(places), 2))
    start, pose, weight, hessian = camera.pose, camera.pose, np.ones(len(places)), np.eye(6)
    distance = float(np.median(np.linalg.norm(points.points_in_world - start.position_in_world, axis=1)))
    k = pinhole_vector(camera.intrinsics)
    for _ in range(config.steps):
        linearize_places(
            points.points_in_world, points.covariances, places, pose.camera_from_world, k, config.noise_px,
            rows, residuals,
        )  # fmt: skip
        weight = _weights(residuals, config)
        weighted = rows.reshape(-1, 6) * np.repeat(weight, 2)[:, None]
        hessian = weighted.T @ rows.reshape(-1, 6)
        # The units of a rotation and a translation differ: the scene's unit may be anything.
        scale = 1.0 / np.sqrt(np.maximum(hessian.diagonal(), 1e-12))
        damped = hessian * np.outer(scale, scale) + config.damping * np.eye(6)
        step = scale * np.linalg.solve(damped, scale * (weighted.T @ residuals.reshape(-1)))
        pose = moved(pose, step)
        if max(np.abs(step[:3]).max(), np.abs(step[3:]).max() / distance) < config.settled:
            break
    return _Solved(se3_log(start.camera_from_world @ pose.world_from_camera), hessian, rows, residuals, weight)


def _weights(residuals: Float64[np.ndarray, "n 2"], config: PatchPoseConfig) -> Float64[np.ndarray, "n"]:
    squared = (residuals**2).sum(1)
    # The median of a chi-square variable with two degrees of freedom is 1.386.
    variance = max(float(np.median(squared)) / 1.386, 1e-6)
    weight = 1.0 / (1.0 + squared / (variance * config.cauchy_scale**2))
    weight[squared > variance * config.cutoff**2] = 0.0
    return weight


def _jackknife(solved: _Solved, cells: Int64[np.ndarray, "n"], config: PatchPoseConfig) -> float:
    """Return the factor from the inverse hessian to the covariance: patches of a part of the photo err together."""
    score = np.einsum("n,nki,nk->ni", solved.weight, solved.rows, solved.residuals)
    hessian = np.einsum("n,nki,nkj->nij", solved.weight, solved.rows, solved.rows)
    order = np.argsort(cells, kind="stable")
    numbers, first = np.unique(cells[order], return_index=True)
    by_cell = np.add.reduceat(score[order], first), np.add.reduceat(hessian[order], first)
    places = np.stack(np.divmod(numbers, config.cells_across), 1).astype(np.float64)
    return jackknife_variance_scale(*by_cell, places, REFINEMENT.uncertainty)


def _chosen(
    points: SurfacePoints,
    where: PredictedPatches,
    camera: Camera,
    valid: Bool[np.ndarray, "h w"] | None,
    rendered: RenderedView,
    config: PatchPoseConfig,
) -> Int64[np.ndarray, "m"]:
    """Return the points to look for: visible ones, seen nearly as in their photos, spread over the photo."""
    index = np.flatnonzero(where.can_match)
    if valid is not None:
        column, row = where.px[index].astype(int).T
        index = index[valid[row, column]]
    position = points.points_in_world[index]
    index = index[_is_visible(position, rendered, config)]
    position = points.points_in_world[index]
    towards = [position - camera.pose.position_in_world, position - points.photo_positions[points.photo[index]]]
    here, there = (along / np.linalg.norm(along, axis=1, keepdims=True) for along in towards)
    angle = np.degrees(np.arccos(np.clip((here * there).sum(1), -1.0, 1.0)))
    cost = angle + config.magnification_deg * np.abs(np.log(where.magnification[index]))
    order = np.argsort(cost, kind="stable")
    order = order[angle[order] < config.max_angle_deg]
    cells = cells_of(where.px[index[order]], camera.intrinsics.width, config.cells_across)
    return index[order[take_in_turns(cells, config.max_patches)]]


def _is_visible(
    position: Float64[np.ndarray, "n 3"], rendered: RenderedView, config: PatchPoseConfig
) -> Bool[np.ndarray, "n"]:
    """Return which points lie where the render has the scene's surface."""
    local = transformed(rendered.camera.pose.camera_from_world, position)
    height, width = rendered.frame.median_depth.shape
    px = project(local, rendered.camera.intrinsics)
    column, row = np.clip(np.nan_to_num(px), 0, [width - 1, height - 1]).astype(int).T
    surface = rendered.frame.median_depth[row, column]
    return (surface > 0) & (np.abs(local[:, 2] - surface) < config.max_depth_error * surface)


def _taken(where: PredictedPatches, index: Int64[np.ndarray, "m"]) -> PredictedPatches:
    return PredictedPatches(*(getattr(where, field.name)[index] for field in fields(where)))
