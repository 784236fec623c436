"""AbsolutePose with an approximate lens: the focal length is searched along one dimension, then all is refined.

A minimal solver for pose and focal length fails on the planes that rooms are made of, so the focal length is searched
in steps: a robust resection at each, the best of them refined together with focal length and principal point. What is
known of these beforehand enters as one more observation each, which decides where the matches can't (a wall seen
straight on looks the same from nearer with a wider lens).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float64

from service.geometry import reprojection_error_px, se3_exp, transformed
from service.pose.absolute_pose.pnp import AbsolutePose, estimate_absolute_pose
from service.types import Intrinsics, IntrinsicsCorrection, Pose

CENTRE_SIGMA = 0.007
"""Standard deviation of the principal point, in long sides: phones and calibrated test cameras have 0.001 to 0.03."""
STEP = 0.2
"""Between two logarithms of focal lengths: at most a tenth off, which leaves inliers enough to refine."""
REACH = 2.5
"""Standard deviations that are searched on either side."""
WIDER = 2.0
"""The error allowed while the focal length is off."""
SEARCH_TRIALS = 200
REFINED = 3
"""Of the steps, those that most of the matches agree with: each refinement costs as much as three resections."""
WORTH = 30
"""Inliers, with the wider error, with which a refinement is worth its time: most photos of other scenes have fewer."""
ROUNDS = 10
SETTLED = 1e-6


def absolute_pose_unknown_focal(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    focal_sigma: float,
    max_error_px: float,
) -> AbsolutePose | None:
    """Return the pose, with its lens, that most of the matches agree with."""
    steps = int(np.ceil(REACH * focal_sigma / STEP))
    found: list[AbsolutePose] = []
    for log_focal in STEP * np.arange(-steps, steps + 1):
        lens = IntrinsicsCorrection(float(np.exp(log_focal)))
        camera = intrinsics.corrected(lens)
        if one := estimate_absolute_pose(photo_px, points_in_world, camera, WIDER * max_error_px, SEARCH_TRIALS):
            found.append(replace(one, correction=lens))
    found.sort(key=lambda one: -one.num_inliers)
    if not found or found[0].num_inliers < WORTH:
        return found[0] if found else None
    refined = [refine(photo_px, points_in_world, intrinsics, one, focal_sigma, max_error_px) for one in found[:REFINED]]
    return max(refined, key=lambda one: one.num_inliers, default=None)


def refine(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    start: AbsolutePose,
    focal_sigma: float,
    max_error_px: float,
) -> AbsolutePose:
    """Refine pose and lens on all matches, with Cauchy's weights; count the inliers afresh."""
    pose, lens = start.pose, start.correction
    precision = correction_precision(focal_sigma)
    for _ in range(ROUNDS):
        jacobian, residual = linearized(photo_px, points_in_world, intrinsics.corrected(lens), pose)
        weight = 1.0 / (1.0 + (residual**2).sum(1) / (0.5 * max_error_px) ** 2)
        weighted = jacobian * weight[:, None, None]
        normal = np.einsum("nij,nik->jk", weighted, jacobian)
        right = np.einsum("nij,ni->j", weighted, residual)
        # One pixel is taken as the matches' standard deviation.
        normal[range(6, 9), range(6, 9)] += precision
        right[6:] -= precision * correction_vector(lens)
        step = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
        pose = Pose(pose.world_from_camera @ se3_exp(step[:6]))
        lens = stepped(lens, step[6:], focal_sigma)
        if np.abs(step).max() < SETTLED:
            break
    error = reprojection_error_px(photo_px, points_in_world, intrinsics.corrected(lens), pose)
    return AbsolutePose(pose, error < max_error_px, lens)


def correction_precision(focal_sigma: float) -> Float64[np.ndarray, "3"]:
    """Return the inverse variances of `correction_vector`."""
    return np.array([focal_sigma, CENTRE_SIGMA, CENTRE_SIGMA]) ** -2.0


def correction_vector(lens: IntrinsicsCorrection) -> Float64[np.ndarray, "3"]:
    """Return the lens as numbers that are 0 at the intrinsics assumed: logarithm of the focal length, shifts."""
    return np.array([np.log(lens.focal_factor), lens.shift_x, lens.shift_y])


def stepped(lens: IntrinsicsCorrection, step: Float64[np.ndarray, "3"], focal_sigma: float) -> IntrinsicsCorrection:
    """Return the lens after a step, kept within four standard deviations."""
    bounds = 4 * np.array([focal_sigma, CENTRE_SIGMA, CENTRE_SIGMA])
    log_focal, shift_x, shift_y = np.clip(correction_vector(lens) + step, -bounds, bounds)
    return IntrinsicsCorrection(float(np.exp(log_focal)), float(shift_x), float(shift_y))


def linearized(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    pose: Pose,
) -> tuple[Float64[np.ndarray, "m 2 9"], Float64[np.ndarray, "m 2"]]:
    """Return d pixel / d (twist, correction_vector) and what is left to explain; zeros behind the camera.

    The twist moves the camera: world_from_camera @ exp(twist).
    """
    x, y, z = transformed(pose.camera_from_world, np.asarray(points_in_world, np.float64)).T
    ahead = z > 1e-9
    z = np.where(ahead, z, 1.0)
    u, v, zero = x / z, y / z, np.zeros(len(z))
    fx, fy, side = intrinsics.fx, intrinsics.fy, np.full(len(z), float(intrinsics.long_side))
    across = np.stack([fx * u * v, -fx * (1 + u * u), fx * v, -fx / z, zero, fx * u / z, fx * u, side, zero], 1)
    down = np.stack([fy * (1 + v * v), -fy * u * v, -fy * u, zero, -fy / z, fy * v / z, fy * v, zero, side], 1)
    projected = np.stack([fx * u + intrinsics.cx, fy * v + intrinsics.cy], 1)
    shown = ahead[:, None].astype(np.float64)
    return np.stack([across, down], 1) * shown[:, None], (photo_px - projected) * shown
