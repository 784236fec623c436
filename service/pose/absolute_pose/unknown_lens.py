"""Absolute pose with an approximate lens: P3P at a few focal lengths, then joint refinement with the intrinsics.

Minimal solvers for pose and focal length (P3.5Pf, P4Pf) degenerate on the planes that rooms are made of, and so do 1D
radial cameras. P3P in RANSAC needs no exact focal length: a tenth off, it finds the pose within twice the inlier
threshold. So PnP-RANSAC at the assumed focal length comes first, and others, a factor of 1.5 apart, only where too few
correspondences agree. From there pose, focal length, radial distortion and principal point are refined together:
never the focal length alone, which would make up for a distortion by a wrong distance. The prior decides where the
correspondences can't: a wall seen straight on gives the same image from nearer with a shorter focal length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64

from service.geometry import se3_exp, se3_log
from service.photos.intrinsics import undistorted_points
from service.pose.absolute_pose.lens_kernels import linearize_projection
from service.pose.absolute_pose.lens_prior import stepped
from service.pose.absolute_pose.normal_equations import normal_equations
from service.pose.absolute_pose.pnp import AbsolutePose, estimate_absolute_pose
from service.types import Intrinsics, IntrinsicsCorrection, LensPrior, Pose


@dataclass(frozen=True, slots=True)
class LensSearchConfig:
    log_step: float = 0.4
    """Between two assumed values of log focal: refinement converges from half of it."""
    reach_scales: float = 2.0
    reach_scales_longer: float = 4.0
    """How far values are tried on either side, in scales of the prior; one step at least. Lenses of 200 mm and digital
    zoom are met, and wider ones than half of a usual one are not."""
    error_factor: float = 2.0
    """Inlier threshold of PnP-RANSAC, times that of the refined pose: focal length and distortion are still off."""
    trials: int = 200
    """RANSAC trials at one focal length."""
    min_inliers: int = 16
    """Fewest inliers, at the wider threshold, for a refinement: most photos of other scenes have fewer."""
    sufficient_inliers: int = 30
    """Inliers of a refined pose from which on no other focal length is tried..."""
    sufficient_share: float = 0.8
    """...if they are as many as this share of those at the wider threshold before: refinement at a focal length that is
    far off ends at a pose that fewer agree with."""
    crop_scale: float = 0.15
    """Scale of the principal point, in long sides, of a photo that was cropped off centre."""
    crop_gain: float = 1.2
    """Factor of the inliers' number by which that must explain the photo better."""
    max_iterations: int = 10
    """At one of these scales."""
    noise: float = 0.3
    """Standard deviation of a right correspondence, times the inlier threshold."""
    cauchy_scales: tuple[float, ...] = (2.0, 0.5)
    """Scales of Cauchy's weights in a refinement, times the inlier threshold, one after the other: with the wider one
    correspondences count that a wrong focal length or distortion keeps away."""
    settled_decrements: tuple[float, ...] = (1.0, 0.01)
    """At each scale, Newton's decrement of the last step: its square in standard deviations. The last scale ends with a
    tenth of one."""


LENS_SEARCH = LensSearchConfig()


def absolute_pose_unknown_lens(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    prior: LensPrior,
    max_error_px: float,
    config: LensSearchConfig = LENS_SEARCH,
) -> AbsolutePose | None:
    """Estimate the pose, and the correction of the intrinsics, from correspondences as `estimate_absolute_pose` takes.

    The answer is the pose with the most inliers within `max_error_px` after its refinement; None if PnP-RANSAC finds
    none at any focal length.
    """
    best: AbsolutePose | None = None
    for log_focal in _focal_ladder(prior, config):
        start = IntrinsicsCorrection(float(np.exp(log_focal)))
        camera = intrinsics.corrected(start)
        found = estimate_absolute_pose(
            photo_px, points_in_world, camera, config.error_factor * max_error_px, config.trials
        )
        if found is None:
            continue
        found = replace(found, correction=start)
        if found.num_inliers >= config.min_inliers:
            sufficient = max(config.sufficient_inliers, config.sufficient_share * found.num_inliers)
            found = refine_with_lens(photo_px, points_in_world, intrinsics, found, prior, max_error_px, config)
            if found.num_inliers >= sufficient:
                return _with_crop(found, photo_px, points_in_world, intrinsics, prior, max_error_px, config)
        # At none of the focal lengths did enough agree: the caller may have other matches to add.
        if best is None or found.num_inliers > best.num_inliers:
            best = found
    return best


def _focal_ladder(prior: LensPrior, config: LensSearchConfig) -> Float64[np.ndarray, "n"]:
    """Return the values of log focal that are tried, nearest to the prior's centre first, the longer of two first."""
    shorter, longer = (
        max(1, int(reach * prior.log_focal_scale / config.log_step))
        for reach in (config.reach_scales, config.reach_scales_longer)
    )
    # A stable sort by distance: the longer of two comes first.
    steps = sorted([*range(longer + 1), *range(-1, -shorter - 1, -1)], key=abs)
    return config.log_step * np.array(steps)


def _with_crop(
    found: AbsolutePose,
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    prior: LensPrior,
    max_error_px: float,
    config: LensSearchConfig,
) -> AbsolutePose:
    """Return the pose of a photo cropped off centre if many more correspondences agree with that, else `found`."""
    # From the centre: the tails of the usual prior would let the principal point go, but its slope there holds it.
    cropped = replace(prior, principal_point_scale=max(prior.principal_point_scale, config.crop_scale))
    other = refine_with_lens(photo_px, points_in_world, intrinsics, found, cropped, max_error_px, config)
    return other if other.num_inliers > config.crop_gain * found.num_inliers else found


def refine_with_lens(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    start: AbsolutePose,
    prior: LensPrior,
    max_error_px: float,
    config: LensSearchConfig = LENS_SEARCH,
) -> AbsolutePose:
    """Refine pose, focal length, distortion and principal point on all correspondences, and count the inliers afresh.

    Levenberg-Marquardt on reprojection errors in standard deviations, iteratively reweighted with Cauchy's weights,
    with the prior as four more observations. `intrinsics` are those given, without the start's correction.
    """
    problem = _Problem(photo_px, points_in_world, intrinsics, prior, config.noise * max_error_px)
    scales = [scale / config.noise for scale in config.cauchy_scales]
    now = problem.linearized(start.pose, start.correction, scales[0])
    for scale, settled_decrement in zip(scales, config.settled_decrements, strict=True):
        now = problem.linearized(now.pose, now.correction, scale)
        damping = 1e-4
        for _ in range(config.max_iterations):
            step = now.step(damping)
            after = problem.linearized(
                Pose(now.pose.world_from_camera @ se3_exp(step[:6])), stepped(now.correction, step[6:]), now.scale
            )
            if after.cost > now.cost:
                # The linearization doesn't reach that far: a shorter step, nearer to the gradient's direction.
                damping *= 10.0
                continue
            settled = float(step @ now.rhs) < settled_decrement
            now, damping = after, 0.1 * damping
            if settled:
                break
    return AbsolutePose(now.pose, now.error_px < max_error_px, now.correction)


@dataclass(frozen=True, slots=True)
class LensEvidence:
    """What correspondences say against intrinsics that were given as exact."""

    cost_drop: float
    """By how much free intrinsics lower the robust cost: the difference of two chi-squares, in units of a
    correspondence's mean cost where that is more than 1, as in scenes whose model is poor."""
    correction: IntrinsicsCorrection
    """That lowers it most."""
    motion: Float64[np.ndarray, "6"]
    """Right twist (rad, scene units) from the best pose with the given intrinsics to that with the corrected ones."""


EXACT = LensPrior(1e-5, 1e-5, 1e-5)
"""A prior that leaves nothing to estimate."""


def evidence_against_lens(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    start: AbsolutePose,
    prior: LensPrior,
    max_error_px: float,
    config: LensSearchConfig = LENS_SEARCH,
) -> LensEvidence:
    """Refine the pose with the given intrinsics and with free ones, and compare.

    `prior` is that of the free intrinsics.
    """
    given = (photo_px, points_in_world, intrinsics)
    # The answer is the best pose of the pixels, not of these matches: both are fitted, so that like is compared.
    exact = refine_with_lens(*given, start, EXACT, max_error_px, config)
    free = refine_with_lens(*given, exact, prior, max_error_px, config)
    problem = _Problem(*given, prior, config.noise * max_error_px)
    scale = config.cauchy_scales[-1] / config.noise
    before, after = (problem.linearized(one.pose, one.correction, scale).cost for one in (exact, free))
    motion = se3_log(exact.pose.camera_from_world @ free.pose.world_from_camera)
    drop = (before - after) / max(1.0, before / len(photo_px))
    return LensEvidence(drop, free.correction, motion)


@dataclass(frozen=True, slots=True)
class _Problem:
    """Correspondences and prior, whose robust cost is minimized."""

    photo_px: Float[np.ndarray, "m 2"]
    points_in_world: Float[np.ndarray, "m 3"]
    intrinsics: Intrinsics
    prior: LensPrior
    noise_px: float
    """Standard deviation of a right correspondence."""

    def linearized(self, pose: Pose, correction: IntrinsicsCorrection, scale: float) -> _Linearized:
        """Return cost and normal equations; `scale` is that of Cauchy's weights, in standard deviations."""
        jacobian, residual, ahead = linearize_reprojection(
            self.photo_px, self.points_in_world, self.intrinsics, pose, correction
        )
        found = normal_equations(jacobian, residual, ahead, self.noise_px, scale, self.prior, correction)
        error_px = found.error * self.noise_px
        return _Linearized(pose, correction, scale, error_px, found.cost, found.hessian, found.rhs)


@dataclass(frozen=True, slots=True)
class _Linearized:
    """The robust cost of a pose and a correction, and its normal equations there."""

    pose: Pose
    correction: IntrinsicsCorrection
    scale: float
    error_px: Float64[np.ndarray, "m"]
    """Infinite behind the camera."""
    cost: float
    hessian: Float64[np.ndarray, "10 10"]
    rhs: Float64[np.ndarray, "10"]

    def step(self, damping: float) -> Float64[np.ndarray, "10"]:
        """Return the step of Levenberg and Marquardt."""
        diagonal = self.hessian.diagonal()
        # What neither correspondences nor prior determine stays.
        return np.linalg.solve(self.hessian + np.diag(damping * diagonal + 1e-9 * diagonal.max()), self.rhs)


def linearize_reprojection(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    pose: Pose,
    correction: IntrinsicsCorrection,
) -> tuple[Float64[np.ndarray, "m 2 10"], Float64[np.ndarray, "m 2"], np.ndarray]:
    """Return d projected pixel / d (twist, correction_vector), the residuals photo - projected in pixels, and which
    points are ahead of the camera; the others have zeros.

    The twist (rotation vector in rad, translation in scene units) acts on the right: world_from_camera @ exp(twist)
    moves the camera in its own frame.
    """
    camera, inverse = intrinsics.corrected(correction), pose.camera_from_world
    values = (camera.fx, camera.fy, camera.cx, camera.cy, correction.k1, float(intrinsics.long_side))
    # One memory layout and type: one compilation.
    points = np.ascontiguousarray(points_in_world, np.float64)
    px = np.ascontiguousarray(photo_px, np.float64)
    return linearize_projection(px, inverse[:3, :3].copy(), inverse[:3, 3].copy(), points, np.array(values))


def without_distortion(
    photo_px: Float[np.ndarray, "m 2"], intrinsics: Intrinsics, correction: IntrinsicsCorrection
) -> Float[np.ndarray, "m 2"]:
    """Return the pixels as a pinhole with the corrected intrinsics sees them."""
    if not correction.k1:
        return photo_px
    camera = replace(intrinsics.corrected(correction), model="OPENCV", distortion=(correction.k1, 0.0, 0.0, 0.0))
    return undistorted_points(np.asarray(photo_px, np.float32), camera)
