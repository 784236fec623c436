"""Decoupled optimization by gradients, as the supplement's section A has it.

    L_R = mean over pairs (1 - cos(v_i, v_j)) -> rotation only,    L_t = mean |v_i|^2 -> translation only

by Adam, on the match vectors v_i of one render (see `service.pose.absolute_pose.decoupled`). Weights |v| / (|v| + 3 px)
keep short vectors, whose direction is noise, out of L_R. Inferred, because the supplement gives neither: the pairing
of the angles (all pairs), rates and step counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.pose.absolute_pose.decoupled import (
    BEHIND_PX,
    DecoupledSolution,
    MatchedPoints,
    linearize_matches,
    rotate_about,
    solution_at,
    translate_in_camera,
)
from service.pose.descent.adam import Adam
from service.types import Pose


@dataclass(frozen=True, slots=True)
class DecoupledGradientConfig:
    """Steps of Adam on the match vectors' angles and lengths."""

    steps: int = 15
    """Of Adam, on one render's matches."""
    rate: float = 0.05
    """Adam's with the first render: rad, and shares of the distance to the centre."""
    rate_decay: float = 0.8
    """Factor of the rate from one render to the next."""
    short_px: float = 3.0
    """Length, at a long side of 512, at which a vector's angle has half its weight."""


DECOUPLED_GRADIENT = DecoupledGradientConfig()


def gradient_solve(
    matched: MatchedPoints,
    start: Pose,
    round_number: int = 0,
    config: DecoupledGradientConfig = DECOUPLED_GRADIENT,
) -> DecoupledSolution:
    """Descend both losses in alternation from `start`, each by its own motion.

    `round_number` counts the renders before this one, over which the rate has fallen.
    """
    distance = float(np.linalg.norm(start.position_in_world - matched.centre_in_world))
    rate = config.rate * config.rate_decay**round_number
    rotation_adam, translation_adam = Adam(3, rate), Adam(3, rate * distance)
    pose = start
    for _ in range(config.steps):
        vectors, _, _ = linearize_matches(matched, pose)
        length = np.linalg.norm(vectors, axis=1)
        # Points behind the camera have vectors without meaning.
        ahead = length < BEHIND_PX / 10
        weights = ahead * length / (length + config.short_px * matched.px)
        _, by_rotation = angle_loss(matched, pose, weights)
        _, by_translation = length_loss(matched, pose, ahead.astype(float))
        pose = rotate_about(pose, matched.centre_in_world, -rotation_adam.step(by_rotation))
        pose = translate_in_camera(pose, -translation_adam.step(by_translation))
    return solution_at(matched, pose)


def angle_loss(
    matched: MatchedPoints, pose: Pose, weights: Float64[np.ndarray, "n"]
) -> tuple[float, Float64[np.ndarray, "3"]]:
    """Return L_R and its gradient by the rotation vector; by the translation it has none, by construction.

    With unit vectors u_i and weights w_i of sum 1: mean over pairs (1 - u_i . u_j) = 1 - |sum w_i u_i|^2.
    """
    vectors, by_rotation, _ = linearize_matches(matched, pose)
    length = np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)
    unit = vectors / length[:, None]
    share = weights / max(float(weights.sum()), 1e-12)
    mean = share @ unit
    # d u = (I - u u^T) d v / |v|, and d v = -by_rotation d rotation
    by_vector = (mean - unit * (unit @ mean)[:, None]) * (share / length)[:, None]
    return float(1.0 - mean @ mean), 2.0 * np.einsum("ni,nij->j", by_vector, by_rotation)


def length_loss(
    matched: MatchedPoints, pose: Pose, weights: Float64[np.ndarray, "n"]
) -> tuple[float, Float64[np.ndarray, "3"]]:
    """Return L_t, in squared halves of the long side, and its gradient by the translation; by the rotation none."""
    vectors, _, by_translation = linearize_matches(matched, pose)
    share = weights / max(float(weights.sum()), 1e-12) / (matched.intrinsics.long_side / 2) ** 2
    return float(share @ np.sum(vectors**2, 1)), -2.0 * np.einsum("n,ni,nij->j", share, vectors, by_translation)
