"""Monte Carlo poses: around a prior by motions about the scene's centre, or over the whole scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from service.geometry import look_at, so3_exp
from service.pose.features.rendered_views import View
from service.pose.retrieval.scene_focus import Focus
from service.types import Pose

NEARER, ROLL_RAD = (-0.4, 0.6), 0.2
"""How far a sampled pose goes from a view towards what it looks at (share of the way), and how it is turned."""


def even_points(count: int, dimensions: int, rng: np.random.Generator) -> Float64[np.ndarray, "count dimensions"]:
    """Return points in [-1, 1]^d that fill it more evenly than chance.

    The additive recurrence of the generalized golden ratio (Roberts 2018) with a random offset.
    """
    ratio = 2.0
    for _ in range(40):  # the positive root of x^(d+1) = x + 1
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    step = ratio ** -np.arange(1, dimensions + 1)
    return 2.0 * np.mod(rng.uniform(size=dimensions) + np.arange(count)[:, None] * step, 1.0) - 1.0


def around(
    poses: Sequence[Pose], focus: Focus, degrees: float, share: float, count: int, rng: np.random.Generator
) -> list[Pose]:
    """Return `count` poses, shared out among the given ones.

    Each undoes a motion of the protocol's kind, T Rz Ry Rx in the world frame with its origin in the focus: angles
    per axis within +-degrees, shifts per axis within +-share of the focus' distance. A pose that was moved from the
    truth by such a motion has the truth in its box.
    """
    points = even_points(count, 6, rng)
    return [
        _undone(poses[i % len(poses)], focus, np.radians(degrees) * p[:3], share * focus.distance * p[3:])
        for i, p in enumerate(points)
    ]


def _undone(pose: Pose, focus: Focus, angles: Float64[np.ndarray, "3"], shift: Float64[np.ndarray, "3"]) -> Pose:
    """Return (T Rz Ry Rx)^-1 pose; angles in rad."""
    rotation = np.eye(3)
    for axis in range(3):
        rotation = rotation @ so3_exp(-angles[axis] * np.eye(3)[axis])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation @ pose.world_from_camera[:3, :3]
    matrix[:3, 3] = rotation @ (pose.position_in_world - focus.point_in_world - shift) + focus.point_in_world
    return Pose(matrix)


def poses_near_views(
    views: Sequence[View],
    scores: Float64[np.ndarray, "views"],
    roll_rad: float,
    count: int,
    rng: np.random.Generator,
) -> list[Pose]:
    """Return poses that look at things the views see, from near the views; those with higher scores are likelier.

    `roll_rad` turns the poses about their axes.
    """
    weights = np.array([score if len(view.points_in_world) else 0.0 for view, score in zip(views, scores, strict=True)])
    weights = np.maximum(weights - 0.5 * weights.max(), 1e-9) ** 2
    poses = []
    for i in rng.choice(len(views), count, p=weights / weights.sum()):
        view = views[i]
        target = view.points_in_world[rng.integers(len(view.points_in_world))].astype(np.float64)
        from_target = view.camera.pose.position_in_world - target
        distance = float(np.linalg.norm(from_target))
        aside = 0.15 * distance * rng.standard_normal(3)
        position = target + (1 - rng.uniform(*NEARER)) * from_target + aside
        upright = look_at(position, target, -view.camera.pose.world_from_camera[:3, 1])
        turn = np.eye(4)
        turn[:3, :3] = so3_exp(np.array([0.0, 0.0, roll_rad + ROLL_RAD * rng.standard_normal()]))
        poses.append(Pose(upright.world_from_camera @ turn))
    return poses
