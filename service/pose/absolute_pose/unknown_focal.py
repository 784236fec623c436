"""Absolute pose with an approximate focal length: a one-dimensional search, then joint nonlinear refinement.

Minimal solvers for pose and focal length (P3.5Pf, P4Pf) degenerate on the planes that rooms are made of. So the focal
length is sampled on a grid around the one given, with PnP-RANSAC at each sample; the best samples are refined together
with focal length and principal point. The prior on the intrinsics enters as one observation each, which decides where
the correspondences can't: a wall seen straight on gives the same image from nearer with a shorter focal length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64

from service.geometry import reprojection_error_px, se3_exp, transformed
from service.pose.absolute_pose.intrinsics_prior import IntrinsicsPrior, correction_vector
from service.pose.absolute_pose.pnp import AbsolutePose, estimate_absolute_pose
from service.types import Intrinsics, IntrinsicsCorrection, Pose


@dataclass(frozen=True, slots=True)
class FocalSearchConfig:
    log_step: float = 0.2
    """Between two samples of log focal: at most a tenth off, which leaves enough inliers to refine."""
    reach_sigmas: float = 2.5
    """Half width of the grid, in standard deviations of the prior."""
    error_factor: float = 2.0
    """Inlier threshold during the search, times that of the refined pose: the focal length is still off."""
    trials: int = 200
    """RANSAC trials a sample."""
    num_refined: int = 3
    """Samples that are refined, those with most inliers: a refinement costs as much as three PnP-RANSAC runs."""
    min_inliers: int = 30
    """Fewest inliers of the best sample, at the wider threshold, for any refinement: most photos of other scenes have
    fewer."""
    max_iterations: int = 10
    """Of a refinement."""
    cauchy_scale: float = 0.5
    """Scale of Cauchy's weights in a refinement, times the inlier threshold."""
    min_step: float = 1e-6
    """A refinement ends with a step whose components (rad, scene units, log focal, long sides) are all smaller."""


FOCAL_SEARCH = FocalSearchConfig()


def absolute_pose_unknown_focal(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    focal_sigma: float,
    max_error_px: float,
    config: FocalSearchConfig = FOCAL_SEARCH,
) -> AbsolutePose | None:
    """Estimate the pose, and the correction of the intrinsics, from correspondences as `estimate_absolute_pose` takes.

    `focal_sigma` is the prior standard deviation of the focal length's logarithm. The sample of the grid with the most
    inliers within `max_error_px` after its refinement is the answer; None if no sample has a pose.
    """
    steps = int(np.ceil(config.reach_sigmas * focal_sigma / config.log_step))
    wide_px = config.error_factor * max_error_px
    found: list[AbsolutePose] = []
    for log_focal in config.log_step * np.arange(-steps, steps + 1):
        correction = IntrinsicsCorrection(float(np.exp(log_focal)))
        camera = intrinsics.corrected(correction)
        if one := estimate_absolute_pose(photo_px, points_in_world, camera, wide_px, config.trials):
            found.append(replace(one, correction=correction))
    # Stable, so that of equal counts the shorter focal length is first, and results are reproducible.
    found.sort(key=lambda one: -one.num_inliers)
    if not found or found[0].num_inliers < config.min_inliers:
        return found[0] if found else None
    refined = [
        refine_with_intrinsics(photo_px, points_in_world, intrinsics, one, focal_sigma, max_error_px, config)
        for one in found[: config.num_refined]
    ]
    return max(refined, key=lambda one: one.num_inliers, default=None)


def refine_with_intrinsics(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    start: AbsolutePose,
    focal_sigma: float,
    max_error_px: float,
    config: FocalSearchConfig = FOCAL_SEARCH,
) -> AbsolutePose:
    """Refine pose, focal length and principal point on all correspondences, and count the inliers afresh.

    Gauss-Newton on reprojection errors in pixels, iteratively reweighted with Cauchy's weights, with the prior on the
    intrinsics as three more observations. `intrinsics` are those given, without the start's correction.
    """
    pose, correction = start.pose, start.correction
    prior = IntrinsicsPrior(focal_sigma)
    precision = prior.precision
    for _ in range(config.max_iterations):
        jacobian, residual = linearize_reprojection(photo_px, points_in_world, intrinsics.corrected(correction), pose)
        weight = 1.0 / (1.0 + (residual**2).sum(1) / (config.cauchy_scale * max_error_px) ** 2)
        weighted = jacobian * weight[:, None, None]
        hessian = np.einsum("nij,nik->jk", weighted, jacobian)
        rhs = np.einsum("nij,ni->j", weighted, residual)
        # The prior's precision is in units of a standard deviation of one pixel for the correspondences.
        hessian[range(6, 9), range(6, 9)] += precision
        rhs[6:] -= precision * correction_vector(correction)
        # The least-norm step where the matches leave a direction undetermined.
        step = np.linalg.lstsq(hessian, rhs, rcond=1e-12)[0]
        pose = Pose(pose.world_from_camera @ se3_exp(step[:6]))
        correction = prior.stepped(correction, step[6:])
        if np.abs(step).max() < config.min_step:
            break
    error = reprojection_error_px(photo_px, points_in_world, intrinsics.corrected(correction), pose)
    return AbsolutePose(pose, error < max_error_px, correction)


def linearize_reprojection(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    pose: Pose,
) -> tuple[Float64[np.ndarray, "m 2 9"], Float64[np.ndarray, "m 2"]]:
    """Return d projected pixel / d (twist, correction_vector), and the residuals photo - projected, in pixels.

    The twist (rotation vector in rad, translation in scene units) acts on the right: world_from_camera @ exp(twist)
    moves the camera in its own frame. Both are zeros for points behind the camera.
    """
    x, y, z = transformed(pose.camera_from_world, np.asarray(points_in_world, np.float64)).T
    # Points behind the camera would project as if they were ahead, and pull on the pose.
    ahead = z > 1e-9
    z = np.where(ahead, z, 1.0)
    u, v, zero = x / z, y / z, np.zeros(len(z))
    fx, fy, side = intrinsics.fx, intrinsics.fy, np.full(len(z), float(intrinsics.long_side))
    du = np.stack([fx * u * v, -fx * (1 + u * u), fx * v, -fx / z, zero, fx * u / z, fx * u, side, zero], 1)
    dv = np.stack([fy * (1 + v * v), -fy * u * v, -fy * u, zero, -fy / z, fy * v / z, fy * v, zero, side], 1)
    projected = np.stack([fx * u + intrinsics.cx, fy * v + intrinsics.cy], 1)
    visible = ahead[:, None].astype(np.float64)
    return np.stack([du, dv], 1) * visible[:, None], (photo_px - projected) * visible
