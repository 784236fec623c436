"""Decoupled optimization: rotation from the angles between match vectors, translation from their lengths.

A match vector v_i leads from where a scene point is rendered to where the photo shows it. The supplement (section A):
interwoven vectors tell of rotation about the scene's centre, parallel ones of translation. So the rotation must not
see the vectors' common part, nor the translation drive the rotation. Two solvers on one render's matches:

`gradient_solve`, after the supplement:

    L_R = mean over pairs (1 - cos(v_i, v_j)) -> rotation only,    L_t = mean |v_i|^2 -> translation only

by Adam. Weights |v| / (|v| + 3 px) keep short vectors, whose direction is noise, out of L_R.

`least_squares_solve`, ours: with flow and Jacobians less their weighted means, the rotation is one weighted
least-squares step; then the translation is one on what remains of the vectors. Robust weights with a falling scale;
no learning rate. From 36 degrees it needs some four renders.

What is inference: the supplement gives neither the pairing of the angles, nor rates and step counts.
Everywhere: a motion of the camera is (turn, shift): the turn, a rotation vector in the camera's axes, carries it about
the centre; the shift, in the camera's axes, follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.geometry import project, so3_exp, transformed
from service.pose.descent.adam import Adam
from service.types import Intrinsics, Pose

INNER_STEPS = 20
MIN_POINTS = 6
MAX_TURN_RAD = 0.5
"""In one inner step: beyond it the linearization is a guess."""
MIN_SCALE_PX = 1.5
"""Of the robust weights, at a long side of 512: matched features scatter by that much."""
ANNEALING = 0.9
"""The robust scale falls by it at each inner step: with 0.7, a fifth fewer hypotheses converge."""
AGREEMENT_PX = 5.0
"""Scale of the weights that say, at the end, which matches agree."""
SHORT_PX = 3.0
NEAREST = 0.02
"""Points nearer than this share of the centre's distance count as behind the camera."""
GRADIENT_STEPS, GRADIENT_RATE, GRADIENT_DECAY = 15, 0.05, 0.8
MAX_ANGLE_VECTORS = 200


@dataclass(frozen=True, slots=True)
class DecoupledSolution:
    pose: Pose
    weights: Float64[np.ndarray, "n"]
    """0..1, of the matches at the pose; a half or more is an inlier."""

    @property
    def num_inliers(self) -> int:
        return int((self.weights >= 0.5).sum())

    @property
    def support(self) -> float:
        """What hypotheses are compared by: the sum of the weights."""
        return float(self.weights.sum())


@dataclass(frozen=True, slots=True)
class MatchedPoints:
    """One render's matches, ready to be solved."""

    photo_px: Float64[np.ndarray, "n 2"]
    points_in_world: Float64[np.ndarray, "n 3"]
    intrinsics: Intrinsics
    """Of `photo_px`."""
    centre_in_world: Float64[np.ndarray, "3"]

    @property
    def px(self) -> float:
        """A pixel of a photo with a long side of 512."""
        return self.intrinsics.long_side / 512


def rotate_about(pose: Pose, centre_in_world: Float64[np.ndarray, "3"], turn: Float64[np.ndarray, "3"]) -> Pose:
    """Carry the camera about the centre by a rotation vector given in its own axes."""
    matrix = pose.world_from_camera.copy()
    rotation = matrix[:3, :3] @ so3_exp(turn)
    u, _, vt = np.linalg.svd(rotation)
    rotation = u @ vt
    matrix[:3, 3] = centre_in_world + rotation @ matrix[:3, :3].T @ (matrix[:3, 3] - centre_in_world)
    matrix[:3, :3] = rotation
    return Pose(matrix)


def translate_in_camera(pose: Pose, shift: Float64[np.ndarray, "3"]) -> Pose:
    """Move the camera along its own axes."""
    matrix = pose.world_from_camera.copy()
    matrix[:3, 3] += matrix[:3, :3] @ shift
    return Pose(matrix)


def least_squares_solve(matched: MatchedPoints, start: Pose, steps: int = INNER_STEPS) -> DecoupledSolution:
    """Alternate the rotation's and the translation's least-squares step; see the module."""
    pose, scale = start, np.inf
    for _ in range(steps):
        vectors, turning, _ = _linearized(matched, pose)
        weights, scale = _robust(vectors, scale, matched.px, about_median=True)
        turn = _centred_step(turning, vectors, weights)
        length = float(np.linalg.norm(turn))
        pose = rotate_about(pose, matched.centre_in_world, turn * min(1.0, MAX_TURN_RAD / max(length, 1e-9)))
        vectors, _, shifting = _linearized(matched, pose)
        weights, _ = _robust(vectors, scale, matched.px, about_median=False)
        pose = translate_in_camera(pose, _step(shifting, vectors, weights))
    vectors, _, _ = _linearized(matched, pose)
    return DecoupledSolution(pose, _weights(vectors, AGREEMENT_PX * matched.px))


def _linearized(
    matched: MatchedPoints, pose: Pose
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2 3"], Float64[np.ndarray, "n 2 3"]]:
    """Return the match vectors in pixels and d rendered pixel / d (turn, shift); points behind get no Jacobian."""
    camera_from_world, k = pose.camera_from_world, matched.intrinsics
    points = transformed(camera_from_world, matched.points_in_world)
    centre = transformed(camera_from_world, matched.centre_in_world[None])[0]
    behind = points[:, 2] < NEAREST * np.linalg.norm(centre)
    points[behind] = [0.0, 0.0, 1.0]
    x, y, z = points.T
    projecting = np.zeros((len(points), 2, 3))
    projecting[:, 0, 0], projecting[:, 0, 2] = k.fx / z, -k.fx * x / z**2
    projecting[:, 1, 1], projecting[:, 1, 2] = k.fy / z, -k.fy * y / z**2
    projecting[behind] = 0.0
    arm = points - centre
    # The camera turns by w about the centre: its points move by -w x arm = arm x w.
    cross = np.zeros((len(points), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -arm[:, 2], arm[:, 1], -arm[:, 0]
    cross -= cross.transpose(0, 2, 1)
    vectors = matched.photo_px - project(points, k)
    vectors[behind] = 1e6
    return vectors, projecting @ cross, -projecting


def _robust(
    vectors: Float64[np.ndarray, "n 2"], scale: float, px: float, about_median: bool
) -> tuple[Float64[np.ndarray, "n"], float]:
    """Return weights and their scale: at first the spread of the vectors, then falling."""
    around = vectors - np.median(vectors, axis=0) if about_median else vectors
    if not np.isfinite(scale):
        scale = float(np.median(np.linalg.norm(around, axis=1)))
    elif about_median:
        scale *= ANNEALING
    scale = max(scale, MIN_SCALE_PX * px)
    return _weights(around, scale), scale


def _weights(vectors: Float64[np.ndarray, "n 2"], scale: float) -> Float64[np.ndarray, "n"]:
    """Geman and McClure's."""
    return 1.0 / (1.0 + np.sum(vectors**2, 1) / scale**2) ** 2


def _centred_step(
    jacobian: Float64[np.ndarray, "n 2 3"], vectors: Float64[np.ndarray, "n 2"], weights: Float64[np.ndarray, "n"]
) -> Float64[np.ndarray, "3"]:
    """Return the least-squares step on what differs between the vectors."""
    share = weights / max(float(weights.sum()), 1e-12)
    mean_jacobian = np.einsum("n,nij->ij", share, jacobian)
    return _step(jacobian - mean_jacobian, vectors - share @ vectors, weights)


def _step(
    jacobian: Float64[np.ndarray, "n 2 3"], vectors: Float64[np.ndarray, "n 2"], weights: Float64[np.ndarray, "n"]
) -> Float64[np.ndarray, "3"]:
    rows = jacobian.reshape(-1, 3)
    weighted = rows * np.repeat(weights, 2)[:, None]
    normal = weighted.T @ rows
    damping = 1e-6 * float(np.trace(normal)) + 1e-12
    return np.linalg.solve(normal + damping * np.eye(3), weighted.T @ vectors.reshape(-1))


def angle_loss(
    matched: MatchedPoints, pose: Pose, weights: Float64[np.ndarray, "n"]
) -> tuple[float, Float64[np.ndarray, "3"]]:
    """Return L_R and its gradient by the turn; by the shift it has none, by construction.

    With unit vectors u_i and weights w_i of sum 1: mean over pairs (1 - u_i . u_j) = 1 - |sum w_i u_i|^2.
    """
    vectors, turning, _ = _linearized(matched, pose)
    length = np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)
    unit = vectors / length[:, None]
    share = weights / max(float(weights.sum()), 1e-12)
    mean = share @ unit
    # d u = (I - u u^T) d v / |v|, and d v = -turning d turn
    toward = (mean - unit * (unit @ mean)[:, None]) * (share / length)[:, None]
    return float(1.0 - mean @ mean), 2.0 * np.einsum("ni,nij->j", toward, turning)


def length_loss(
    matched: MatchedPoints, pose: Pose, weights: Float64[np.ndarray, "n"]
) -> tuple[float, Float64[np.ndarray, "3"]]:
    """Return L_t, in squared half diagonals, and its gradient by the shift; by the turn it has none."""
    vectors, _, shifting = _linearized(matched, pose)
    share = weights / max(float(weights.sum()), 1e-12) / (matched.intrinsics.long_side / 2) ** 2
    return float(share @ np.sum(vectors**2, 1)), -2.0 * np.einsum("n,ni,nij->j", share, vectors, shifting)


def gradient_solve(matched: MatchedPoints, start: Pose, round_number: int = 0) -> DecoupledSolution:
    """Descend both losses, each by its own motion; the rate falls from one render to the next."""
    distance = float(np.linalg.norm(start.position_in_world - matched.centre_in_world))
    rate = GRADIENT_RATE * GRADIENT_DECAY**round_number
    turner, shifter = Adam(3, rate), Adam(3, rate * distance)
    pose = start
    for _ in range(GRADIENT_STEPS):
        vectors, _, _ = _linearized(matched, pose)
        sound = np.linalg.norm(vectors, axis=1) < 1e5
        length = np.linalg.norm(vectors, axis=1)
        _, by_turn = angle_loss(matched, pose, sound * length / (length + SHORT_PX * matched.px))
        _, by_shift = length_loss(matched, pose, sound.astype(float))
        pose = rotate_about(pose, matched.centre_in_world, -turner.step(by_turn))
        pose = translate_in_camera(pose, -shifter.step(by_shift))
    vectors, _, _ = _linearized(matched, pose)
    return DecoupledSolution(pose, _weights(vectors, AGREEMENT_PX * matched.px))
