"""Random pose hypotheses: around poses by motions about the scene's focus, or near views of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.geometry import look_at, so3_exp
from service.pose.features.rendered_views import View
from service.pose.features.scene_focus import Focus
from service.types import Pose


@dataclass(frozen=True, slots=True)
class NearViewConfig:
    """How a pose near a view is sampled."""

    approach: tuple[float, float] = (-0.4, 0.6)
    """Range of the way from the view to what it shows, as a share of the distance; negative: farther away."""
    lateral_share: float = 0.15
    """Standard deviation of the position per axis, as a share of the same distance."""
    roll_rad: float = 0.2
    """Standard deviation of the rotation about the optical axis."""
    min_score_share: float = 0.5
    """Views whose score is a smaller share of the best one's are hardly ever chosen."""


NEAR_VIEW = NearViewConfig()


def even_points(count: int, dimensions: int, rng: np.random.Generator) -> Float64[np.ndarray, "count dimensions"]:
    """Return a low-discrepancy sequence in [-1, 1]^d.

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
    """Return `count` poses around the given ones, in turn.

    Each is the inverse of a motion T Rz Ry Rx of the supplement's protocol, in the world frame with its origin at the
    focus: angles per axis within +-degrees, translations per axis within +-share of the focus' distance. So a pose
    that such a motion has carried away from the truth has the truth in the sampled box.
    """
    points = even_points(count, 6, rng)
    return [
        _undone(poses[i % len(poses)], focus, np.radians(degrees) * p[:3], share * focus.distance * p[3:])
        for i, p in enumerate(points)
    ]


def _undone(pose: Pose, focus: Focus, angles: Float64[np.ndarray, "3"], translation: Float64[np.ndarray, "3"]) -> Pose:
    """Return (T Rz Ry Rx)^-1 pose; angles in rad."""
    rotation = np.eye(3)
    for axis in range(3):
        # (Rz Ry Rx)^-1 = Rx^-1 Ry^-1 Rz^-1: the order of the axes is reversed.
        rotation = rotation @ so3_exp(-angles[axis] * np.eye(3)[axis])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation @ pose.world_from_camera[:3, :3]
    matrix[:3, 3] = rotation @ (pose.position_in_world - focus.point_in_world - translation) + focus.point_in_world
    return Pose(matrix)


def poses_near_views(
    views: Sequence[View],
    scores: Float64[np.ndarray, "views"],
    roll_rad: float,
    count: int,
    rng: np.random.Generator,
    config: NearViewConfig = NEAR_VIEW,
) -> list[Pose]:
    """Sample `count` poses, each near a view and looking at a point that the view shows.

    Views are drawn with probabilities that grow with their scores, one a view; `roll_rad` is the mean rotation of the
    poses about their optical axes, against the view's upright.
    """
    weights = np.array([score if len(view.points_in_world) else 0.0 for view, score in zip(views, scores, strict=True)])
    # Squared margins favour the best views; the floor keeps the sum positive where all scores are equal.
    weights = np.maximum(weights - config.min_score_share * weights.max(), 1e-9) ** 2
    poses = []
    for i in rng.choice(len(views), count, p=weights / weights.sum()):
        view = views[i]
        target = view.points_in_world[rng.integers(len(view.points_in_world))].astype(np.float64)
        from_target = view.camera.pose.position_in_world - target
        distance = float(np.linalg.norm(from_target))
        # A target off the view's own axis, and a position off the line to it: sampled views differ from the index.
        aside = config.lateral_share * distance * rng.standard_normal(3)
        position = target + (1 - rng.uniform(*config.approach)) * from_target + aside
        upright = look_at(position, target, -view.camera.pose.world_from_camera[:3, 1])
        roll = np.eye(4)
        roll[:3, :3] = so3_exp(np.array([0.0, 0.0, roll_rad + config.roll_rad * rng.standard_normal()]))
        poses.append(Pose(upright.world_from_camera @ roll))
    return poses
