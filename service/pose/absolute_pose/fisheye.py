"""Does a fisheye explain correspondences that a pinhole with one radial coefficient doesn't? Both fitted, compared.

Two models of one focal length and one coefficient, for a ray at the radius r = tan(theta) from the optical axis:

    SIMPLE_RADIAL          D = r (1 + k r^2)
    SIMPLE_RADIAL_FISHEYE  D = theta (1 + k theta^2)

The equidistant fisheye has k = 0, a stereographic one about 1/12, an equisolid one about -1/24; lenses of action
cameras are in between. Each is fitted with pose and principal point to all correspondences, by Levenberg and
Marquardt's method with Cauchy's weights. The first begins at the pose of the search; the second at poses by P3P in
RANSAC of the rays that the fisheye has at a few focal lengths, too. The costs are compared in units of a
correspondence's mean cost, and what the better model leaves is tested for being systematic: a smooth function of the
radius.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Float64

from service.geometry import se3_exp, transformed
from service.pose.absolute_pose.lens_prior import stepped
from service.pose.absolute_pose.normal_equations import normal_equations
from service.pose.absolute_pose.pnp import AbsolutePose, estimate_absolute_pose
from service.types import Intrinsics, IntrinsicsCorrection, LensPrior, Pose

Radii = Float64[np.ndarray, "m"]


@dataclass(frozen=True, slots=True)
class FisheyeConfig:
    focal_factors: tuple[float, ...] = (1.0, 0.67, 1.5)
    """Of the assumed focal length, at which poses are looked for."""
    max_angle: float = 1.35
    """Of a ray from the optical axis, in rad, for P3P: beyond it a pixel's error has no bound."""
    error_factor: float = 2.0
    """Inlier threshold of P3P, times that of the fit."""
    trials: int = 200
    """Of RANSAC at one focal length."""
    min_inliers: int = 40
    """Of the fitted model: with fewer, nothing is said about a lens of eleven unknowns."""
    noise: float = 0.3
    """Standard deviation of a right correspondence, times the inlier threshold."""
    cauchy_scales: tuple[float, ...] = (2.0, 0.5)
    """Of the weights, times the inlier threshold, one after the other."""
    max_iterations: int = 15
    """At one scale."""
    settled_decrement: float = 0.01
    """Newton's decrement, squared, of the last step."""
    radial: LensPrior = field(default_factory=lambda: LensPrior(0.5, 0.1, 0.01))
    fisheye: LensPrior = field(default_factory=lambda: LensPrior(0.5, 0.05, 0.01))
    """Of the two models: lenses that aren't fisheyes have |k1| of 0.1 and less; these are between stereographic and
    equisolid. (14 fits to photos of equidistant lenses: k1 from -0.32 to -0.23, k from -0.03 to 0.03, about the same
    residuals or smaller ones; 37 fits to photos with k1 of 0.1 and less: k of 0.2 and more, and larger residuals.)"""
    significant_drop: float = 16.0
    """From the first model's cost to the second's, in units of a correspondence's mean cost: a difference of
    chi-squares from which on the lens is a fisheye even if that leads to no answer."""
    misfit_drop: float = 40.0
    misfit_px: float = 2.0
    """Significance of a smooth function of the radius in what the better model leaves (a chi-square of three), and that
    function's largest value, in pixels at an inlier threshold of 3, from which on the lens is neither."""


FISHEYE = FisheyeConfig()


@dataclass(frozen=True, slots=True)
class RadialModel:
    """A radial distortion D(r, k)."""

    colmap_name: str
    """COLMAP's model with four coefficients, the first of which is k."""
    distort: Callable[[Radii, float], tuple[Radii, Radii, Radii]]
    """Returns D, dD/dr and dD/dk."""


def _radial(r: Radii, k: float) -> tuple[Radii, Radii, Radii]:
    return r * (1 + k * r**2), 1 + 3 * k * r**2, r**3


def _fisheye(r: Radii, k: float) -> tuple[Radii, Radii, Radii]:
    theta = np.arctan(r)
    return theta * (1 + k * theta**2), (1 + 3 * k * theta**2) / (1 + r**2), theta**3


SIMPLE_RADIAL = RadialModel("OPENCV", _radial)
SIMPLE_RADIAL_FISHEYE = RadialModel("OPENCV_FISHEYE", _fisheye)


@dataclass(frozen=True, slots=True)
class LensModelFit:
    """A model fitted with the pose."""

    model: RadialModel
    pose: Pose
    correction: IntrinsicsCorrection
    """Of the assumed focal length and principal point; its k1 is the model's k."""
    cost: float
    """Robust, in variances of a right correspondence, prior included."""
    inlier: Bool[np.ndarray, "m"]
    misfit_drop: float
    misfit_px: float
    """As in `FisheyeConfig`: what is systematic in the residuals."""

    def lens(self, intrinsics: Intrinsics) -> Intrinsics:
        """Return the lens with the fitted focal length and coefficient; `intrinsics` are the assumed ones.

        The principal point is still that of these: matches determine it less than its prior.
        """
        return replace(
            intrinsics.corrected(IntrinsicsCorrection(self.correction.focal_factor)),
            trust="approximate",
            model=self.model.colmap_name,
            distortion=(self.correction.k1, 0.0, 0.0, 0.0),
        )

    def leaves_misfit(self, config: FisheyeConfig = FISHEYE) -> bool:
        """Return whether what the model leaves is a function of the radius: the lens is another one."""
        return self.misfit_drop > config.misfit_drop and self.misfit_px > config.misfit_px


@dataclass(frozen=True, slots=True)
class LensModels:
    """Both models, fitted to the same correspondences."""

    radial: LensModelFit
    fisheye: LensModelFit

    def is_fisheye(self, config: FisheyeConfig = FISHEYE) -> bool:
        """Return whether the fisheye explains them better: it has the higher posterior probability."""
        return self.fisheye.cost < self.radial.cost and bool(self.fisheye.inlier.sum() >= config.min_inliers)

    def is_surely_fisheye(self, config: FisheyeConfig = FISHEYE) -> bool:
        """Return whether the first model is significantly worse."""
        mean = max(1.0, self.fisheye.cost / len(self.fisheye.inlier))
        return self.is_fisheye(config) and (self.radial.cost - self.fisheye.cost) / mean > config.significant_drop

    def is_unmodelled(self, config: FisheyeConfig = FISHEYE) -> bool:
        """Return whether neither explains them."""
        better = min(self.radial, self.fisheye, key=lambda fit: fit.cost)
        return bool(better.inlier.sum() >= config.min_inliers) and better.leaves_misfit(config)


def fit_lens_models(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    start: AbsolutePose,
    max_error_px: float,
    config: FisheyeConfig = FISHEYE,
) -> LensModels:
    """Fit both models to correspondences in the photo as it was taken, ordered by confidence, wrong ones among them.

    `intrinsics` are the assumed pinhole; `start` is the pose that the search found with its correction of them.
    """
    given = (np.asarray(photo_px, np.float64), np.asarray(points_in_world, np.float64), intrinsics)
    radial = _fit(SIMPLE_RADIAL, *given, [start], config.radial, max_error_px, config)
    # Both models have the same focal length and pose near the image's centre.
    starts = [AbsolutePose(fit.pose, fit.inlier, replace(fit.correction, k1=0.0)) for fit in (radial,)]
    starts += _fisheye_starts(*given, start.correction.focal_factor, max_error_px, config)
    return LensModels(radial, _fit(SIMPLE_RADIAL_FISHEYE, *given, starts, config.fisheye, max_error_px, config))


def _fisheye_starts(
    photo_px: Float64[np.ndarray, "m 2"],
    points_in_world: Float64[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    focal_factor: float,
    max_error_px: float,
    config: FisheyeConfig,
) -> list[AbsolutePose]:
    """Return the pose with the most inliers among those by P3P with equidistant fisheyes; none if none has any."""
    best: AbsolutePose | None = None
    for factor in config.focal_factors:
        correction = IntrinsicsCorrection(factor * focal_factor)
        camera = intrinsics.corrected(correction)
        centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
        offset = (photo_px - centre) / focal
        theta = np.linalg.norm(offset, axis=1)
        seen = np.flatnonzero(theta < config.max_angle)
        scale = np.tan(theta[seen]) / np.maximum(theta[seen], 1e-9)
        straight = centre + focal * offset[seen] * scale[:, None]
        found = estimate_absolute_pose(
            straight, points_in_world[seen], camera, config.error_factor * max_error_px, config.trials
        )
        if found and (best is None or found.num_inliers > best.num_inliers):
            best = replace(found, correction=correction)
    return [] if best is None else [best]


def _fit(
    model: RadialModel,
    photo_px: Float64[np.ndarray, "m 2"],
    points_in_world: Float64[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    starts: list[AbsolutePose],
    prior: LensPrior,
    max_error_px: float,
    config: FisheyeConfig,
) -> LensModelFit:
    """Return the fit of least cost among those from several starts."""
    problem = _Problem(model, photo_px, points_in_world, intrinsics, prior, config.noise * max_error_px)
    ends = [_minimized(problem, start, config) for start in starts]
    end = min(ends, key=lambda one: one.cost)
    wide = problem.linearized(end.pose, end.correction, config.cauchy_scales[0] / config.noise)
    drop, misfit_px = _misfit(wide, 3.0 / max_error_px)
    error = np.linalg.norm(end.residual, axis=1)
    return LensModelFit(model, end.pose, end.correction, end.cost, end.ahead & (error < max_error_px), drop, misfit_px)


@dataclass(frozen=True, slots=True)
class _Problem:
    """Correspondences, model and prior, whose robust cost is minimized."""

    model: RadialModel
    photo_px: Float64[np.ndarray, "m 2"]
    points_in_world: Float64[np.ndarray, "m 3"]
    intrinsics: Intrinsics
    prior: LensPrior
    noise_px: float

    def linearized(self, pose: Pose, correction: IntrinsicsCorrection, scale: float) -> _Linearized:
        """Return cost and normal equations; `scale` is that of Cauchy's weights, in standard deviations."""
        camera = self.intrinsics.corrected(correction)
        points = transformed(pose.camera_from_world, self.points_in_world)
        ahead = points[:, 2] > 1e-6
        points[~ahead] = [0.0, 0.0, 1.0]
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        radius = np.maximum(np.hypot(x, y), 1e-9)
        distorted, slope, by_k = self.model.distort(radius, correction.k1)
        seen = np.stack([x, y], 1) * (distorted / radius)[:, None]
        focal = np.array([camera.fx, camera.fy])
        residual = self.photo_px - focal * seen - [camera.cx, camera.cy]
        unit = np.stack([x, y], 1) / radius[:, None]
        by_ray = (distorted / radius)[:, None, None] * np.eye(2)
        by_ray = by_ray + (slope - distorted / radius)[:, None, None] * unit[:, :, None] * unit[:, None, :]
        jacobian = np.zeros((len(points), 2, 10))
        jacobian[:, :, :6] = focal[:, None] * (by_ray @ _ray_by_twist(x, y, points[:, 2]))
        jacobian[:, :, 6] = focal * seen
        jacobian[:, :, 7] = focal * unit * by_k[:, None]
        jacobian[:, 0, 8] = jacobian[:, 1, 9] = self.intrinsics.long_side
        found = normal_equations(jacobian, residual, ahead, self.noise_px, scale, self.prior, correction)
        equations = found.cost, found.hessian, found.rhs
        return _Linearized(pose, correction, *equations, jacobian, residual, found.weight, ahead, unit, radius)


def _ray_by_twist(x: Radii, y: Radii, depth: Radii) -> Float64[np.ndarray, "m 2 6"]:
    """Return d (x, y) / d right twist (rotation, translation) of the camera's pose."""
    zero = np.zeros_like(x)
    first = np.stack([x * y, -(1 + x * x), y, -1 / depth, zero, x / depth], 1)
    return np.stack([first, np.stack([1 + y * y, -x * y, -x, zero, -1 / depth, y / depth], 1)], 1)


@dataclass(frozen=True, slots=True)
class _Linearized:
    """The robust cost of a pose and a lens, and its normal equations there."""

    pose: Pose
    correction: IntrinsicsCorrection
    cost: float
    hessian: Float64[np.ndarray, "10 10"]
    rhs: Float64[np.ndarray, "10"]
    jacobian: Float64[np.ndarray, "m 2 10"]
    residual: Float64[np.ndarray, "m 2"]
    weight: Radii
    ahead: Bool[np.ndarray, "m"]
    unit: Float64[np.ndarray, "m 2"]
    """Direction from the principal point."""
    radius: Radii
    """Of the ray, undistorted."""


def _minimized(problem: _Problem, start: AbsolutePose, config: FisheyeConfig) -> _Linearized:
    """Return where Levenberg and Marquardt's method leads to from a pose and a lens."""
    pose, correction = start.pose, start.correction
    now: _Linearized | None = None
    for cauchy_scale in config.cauchy_scales:
        scale = cauchy_scale / config.noise
        now, damping = problem.linearized(pose, correction, scale), 1e-4
        for _ in range(config.max_iterations):
            diagonal = now.hessian.diagonal()
            step = np.linalg.solve(now.hessian + np.diag(damping * diagonal + 1e-9 * diagonal.max()), now.rhs)
            moved = Pose(now.pose.world_from_camera @ se3_exp(step[:6]))
            after = problem.linearized(moved, stepped(now.correction, step[6:]), scale)
            if after.cost > now.cost:
                damping *= 10.0
                continue
            settled = float(step @ now.rhs) < config.settled_decrement
            now, damping = after, 0.1 * damping
            if settled:
                break
        pose, correction = now.pose, now.correction
    assert now is not None
    return now


def _misfit(wide: _Linearized, px: float) -> tuple[float, float]:
    """Return how significantly a step of the fit with r^5, r^7 and r^9 beside its unknowns is better than one without,
    and by how much that moves most of the points.

    By the share of the weighted variance that it explains. `wide` has weights of the wider scale, so that what lies
    beyond the fit's reach counts; `px` turns pixels into those of `misfit_px`.
    """
    count = len(wide.radius)
    rho = np.minimum(wide.radius / max(float(np.quantile(wide.radius, 0.98)), 1e-9), 1.0)
    smooth = wide.unit[:, :, None] * (rho[:, None] ** [5, 7, 9])[:, None, :]
    both = np.concatenate([wide.jacobian, smooth], 2).reshape(2 * count, -1)
    weight, residual = np.repeat(wide.weight, 2), wide.residual.reshape(-1)
    root = np.sqrt(weight)
    changes = []
    for columns in (both[:, : wide.jacobian.shape[2]], both):
        solution = np.linalg.lstsq(columns * root[:, None], residual * root, rcond=1e-9)[0]
        changes.append(columns @ solution)
    without, with_smooth = (float(weight @ (residual - change) ** 2) for change in changes)
    effective = 2 * float(wide.weight.sum() / max(wide.weight.max(), 1e-12))
    moved = np.linalg.norm((changes[1] - changes[0]).reshape(count, 2), axis=1)[wide.ahead]
    drop = effective * (without - with_smooth) / max(with_smooth, 1e-12)
    return drop, float(np.quantile(moved, 0.9)) * px
