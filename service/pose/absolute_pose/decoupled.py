"""Decoupled optimization: rotation and translation from the match vectors of one render, solved in alternation.

A match vector v_i leads from the pixel where a scene point is rendered to the pixel where the photo shows it. After
the supplement (section A): vectors that cross come from a rotation about the scene's centre, parallel ones from a
translation. So the rotation is solved without the vectors' common part, and the translation from what remains.

`least_squares_solve` is second order, and ours: with vectors and Jacobians less their weighted means, the rotation is
one weighted least-squares step; then the translation is one. The weights are Geman and McClure's with a scale that
falls from step to step; there is no learning rate. From 36 degrees off it needs some four renders. The supplement's
first-order form, by gradients of losses on angles and lengths, is `service.pose.descent.decoupled_gradient`.

A motion of the camera is a rotation vector (rad, in the camera's axes), applied about the scene's centre, followed by
a translation (scene units, in the camera's axes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from service.geometry import project, so3_exp, transformed
from service.types import Intrinsics, Pose

BEHIND_PX = 1e6
"""Length of both components of a match vector whose point is behind the camera: robust weights vanish there."""


@dataclass(frozen=True, slots=True)
class DecoupledConfig:
    """How rotation and translation are solved for in turn."""

    steps: int = 20
    """Alternations on one render's matches."""
    min_points: int = 6
    """Fewest matches that are solved: six unknowns with twice as many equations."""
    max_rotation_rad: float = 0.5
    """Of one step: beyond it the linearization doesn't hold."""
    min_scale_px: float = 1.5
    """Lower bound of the weights' scale, at a long side of 512: matched features scatter by that much."""
    scale_decay: float = 0.9
    """Factor of the scale from one step to the next: with 0.7, a fifth fewer hypotheses converge."""
    agreement_px: float = 5.0
    """Scale, at a long side of 512, of the weights at the solution, which decide on inliers."""
    min_depth_share: float = 0.02
    """Points at a smaller depth, as a share of the centre's distance, count as behind the camera."""


DECOUPLED = DecoupledConfig()


@dataclass(frozen=True, slots=True)
class DecoupledSolution:
    """A pose, and how far each match agrees with it."""

    pose: Pose
    weights: Float64[np.ndarray, "n"]
    """0..1, of the matches at the pose."""

    @property
    def inlier(self) -> Bool[np.ndarray, "n"]:
        """Whose weight is at least a half."""
        return self.weights >= 0.5

    @property
    def num_inliers(self) -> int:
        """How many matches are inliers."""
        return int(self.inlier.sum())

    @property
    def support(self) -> float:
        """The sum of the weights, by which hypotheses are compared."""
        return float(self.weights.sum())


@dataclass(frozen=True, slots=True)
class MatchedPoints:
    """The matches of one render with the photo, as the decoupled solvers take them."""

    photo_px: Float64[np.ndarray, "n 2"]
    points_in_world: Float64[np.ndarray, "n 3"]
    intrinsics: Intrinsics
    """Of `photo_px`."""
    centre_in_world: Float64[np.ndarray, "3"]
    """The point that rotations leave where it is seen."""

    @property
    def px(self) -> float:
        """A pixel of a photo with a long side of 512, in the photo's pixels."""
        return self.intrinsics.long_side / 512


def rotate_about(pose: Pose, centre_in_world: Float64[np.ndarray, "3"], rotation: Float64[np.ndarray, "3"]) -> Pose:
    """Carry the camera about the centre by a rotation vector (rad) in the camera's own axes."""
    matrix = pose.world_from_camera.copy()
    turned = matrix[:3, :3] @ so3_exp(rotation)
    u, _, vt = np.linalg.svd(turned)
    # The nearest rotation: rounding errors would add up over the steps.
    turned = u @ vt
    matrix[:3, 3] = centre_in_world + turned @ matrix[:3, :3].T @ (matrix[:3, 3] - centre_in_world)
    matrix[:3, :3] = turned
    return Pose(matrix)


def translate_in_camera(pose: Pose, translation: Float64[np.ndarray, "3"]) -> Pose:
    """Move the camera by a translation (scene units) in its own axes."""
    matrix = pose.world_from_camera.copy()
    matrix[:3, 3] += matrix[:3, :3] @ translation
    return Pose(matrix)


def least_squares_solve(matched: MatchedPoints, start: Pose, config: DecoupledConfig = DECOUPLED) -> DecoupledSolution:
    """Solve for the pose from a nearby one: `config.steps` alternating, robustly weighted least-squares steps.

    There must be at least `config.min_points` matches. The weights of the solution are those at `agreement_px`.
    """
    pose, scale = start, np.inf
    for _ in range(config.steps):
        vectors, by_rotation, _ = linearize_matches(matched, pose, config)
        # For the rotation, outliers are vectors that differ from the others; a common part is translation.
        around = vectors - np.median(vectors, axis=0)
        scale = _next_scale(around, scale, matched.px, config)
        rotation = _centred_step(by_rotation, vectors, geman_mcclure_weights(around, scale))
        length = float(np.linalg.norm(rotation))
        # Shortened, not refused: the direction is still right.
        rotation = rotation * min(1.0, config.max_rotation_rad / max(length, 1e-9))
        pose = rotate_about(pose, matched.centre_in_world, rotation)
        vectors, _, by_translation = linearize_matches(matched, pose, config)
        pose = translate_in_camera(pose, _step(by_translation, vectors, geman_mcclure_weights(vectors, scale)))
    return solution_at(matched, pose, config)


def solution_at(matched: MatchedPoints, pose: Pose, config: DecoupledConfig = DECOUPLED) -> DecoupledSolution:
    """Return the pose with the matches' weights there."""
    vectors, _, _ = linearize_matches(matched, pose, config)
    return DecoupledSolution(pose, geman_mcclure_weights(vectors, config.agreement_px * matched.px))


def linearize_matches(
    matched: MatchedPoints, pose: Pose, config: DecoupledConfig = DECOUPLED
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2 3"], Float64[np.ndarray, "n 2 3"]]:
    """Return the match vectors, photo - rendered, in pixels, and d rendered pixel / d rotation and / d translation.

    Points behind the camera have vectors of BEHIND_PX and Jacobians of zeros.
    """
    camera_from_world, k = pose.camera_from_world, matched.intrinsics
    points = transformed(camera_from_world, matched.points_in_world)
    centre = transformed(camera_from_world, matched.centre_in_world[None])[0]
    behind = points[:, 2] < config.min_depth_share * np.linalg.norm(centre)
    # Any finite place: vectors and Jacobians of these are overwritten below.
    points[behind] = [0.0, 0.0, 1.0]
    x, y, z = points.T
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = k.fx / z, -k.fx * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = k.fy / z, -k.fy * y / z**2
    by_point[behind] = 0.0
    arm = points - centre
    # The camera turns by w about the centre: its points move by -w x arm = arm x w.
    cross = np.zeros((len(points), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -arm[:, 2], arm[:, 1], -arm[:, 0]
    cross -= cross.transpose(0, 2, 1)
    vectors = matched.photo_px - project(points, k)
    vectors[behind] = BEHIND_PX
    return vectors, by_point @ cross, -by_point


def geman_mcclure_weights(vectors: Float64[np.ndarray, "n 2"], scale: float) -> Float64[np.ndarray, "n"]:
    """Return the IRLS weights of Geman and McClure's loss: 1 at length 0, a quarter at `scale`, falling to 0."""
    return 1.0 / (1.0 + np.sum(vectors**2, 1) / scale**2) ** 2


def _next_scale(around: Float64[np.ndarray, "n 2"], scale: float, px: float, config: DecoupledConfig) -> float:
    """Return the weights' scale in pixels: the vectors' median length about their median at first, then falling."""
    if np.isfinite(scale):
        scale *= config.scale_decay
    else:
        scale = float(np.median(np.linalg.norm(around, axis=1)))
    return max(scale, config.min_scale_px * px)


def _centred_step(
    jacobian: Float64[np.ndarray, "n 2 3"], vectors: Float64[np.ndarray, "n 2"], weights: Float64[np.ndarray, "n"]
) -> Float64[np.ndarray, "3"]:
    """Return the weighted least-squares step on vectors and Jacobians less their weighted means."""
    share = weights / max(float(weights.sum()), 1e-12)
    mean_jacobian = np.einsum("n,nij->ij", share, jacobian)
    return _step(jacobian - mean_jacobian, vectors - share @ vectors, weights)


def _step(
    jacobian: Float64[np.ndarray, "n 2 3"], vectors: Float64[np.ndarray, "n 2"], weights: Float64[np.ndarray, "n"]
) -> Float64[np.ndarray, "3"]:
    """Return the weighted least-squares step, damped just enough for the normal equations to be regular."""
    rows = jacobian.reshape(-1, 3)
    weighted = rows * np.repeat(weights, 2)[:, None]
    hessian = weighted.T @ rows
    damping = 1e-6 * float(np.trace(hessian)) + 1e-12
    return np.linalg.solve(hessian + damping * np.eye(3), weighted.T @ vectors.reshape(-1))
