"""Where a caller says that the camera is: which poses that admits."""

from __future__ import annotations

import numpy as np

from service.geometry import se3_log
from service.types import BoxPrior, GaussianPosePrior, Pose, PriorRegion

LIMIT = 22.46
"""Chi-square with 6 degrees of freedom at 99.9 %: squared Mahalanobis distances beyond it are outside a Gaussian."""
LOOSE_DEG, LOOSE_SHARE = 3.0, 0.05
"""How far a pose may be off before it is aligned: per axis, and as a share of the distance to what is seen."""


def inside_prior(region: PriorRegion | None, pose: Pose) -> bool:
    """Tell whether the region holds the pose; no region holds all."""
    return region is None or distance_outside(region, pose) <= 0.0


def distance_outside(region: PriorRegion, pose: Pose) -> float:
    """Return how far the pose is outside, 0 inside: of a box in scene units, of a Gaussian in standard deviations."""
    if isinstance(region, BoxPrior):
        position = pose.position_in_world
        outside = np.maximum(region.lower_in_world - position, position - region.upper_in_world)
        return float(np.linalg.norm(np.maximum(outside, 0.0)))
    twist = se3_log(region.pose.camera_from_world @ pose.world_from_camera)
    squared = float(twist @ np.linalg.solve(region.covariance, twist))
    return max(float(np.sqrt(squared) - np.sqrt(LIMIT)), 0.0)


def widened_prior(region: PriorRegion | None, distance: float) -> PriorRegion | None:
    """Return the region for poses that are not aligned yet; `distance` (scene units) is that to what is seen."""
    slack = LOOSE_SHARE * distance
    if region is None:
        return None
    if isinstance(region, BoxPrior):
        return BoxPrior(region.lower_in_world - slack, region.upper_in_world + slack)
    spread = np.r_[np.full(3, np.radians(LOOSE_DEG)), np.full(3, slack)]
    return GaussianPosePrior(region.pose, region.covariance + np.diag(spread**2))
