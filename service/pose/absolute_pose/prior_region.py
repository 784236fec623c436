"""Tests of camera poses against the prior region that a caller declared: a box, or a Gaussian over poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.geometry import se3_log
from service.types import BoxPrior, GaussianPosePrior, Pose, PriorRegion


@dataclass(frozen=True, slots=True)
class PriorRegionConfig:
    """When a pose is outside of a prior's region, and how much nearer poses from matches alone may be."""

    max_squared_mahalanobis: float = 22.46
    """Poses beyond it are outside a Gaussian: the 99.9 % quantile of chi-square with 6 degrees of freedom."""
    slack_deg: float = 3.0
    """Rotation error per axis (standard deviation) of a pose from matches alone, before photometric refinement."""
    slack_share: float = 0.05
    """Its position error, as a share of the distance to what the photo shows."""


PRIOR_REGION = PriorRegionConfig()


def inside_prior(region: PriorRegion | None, pose: Pose, config: PriorRegionConfig = PRIOR_REGION) -> bool:
    """Return whether the pose is inside the region, borders included; None is the region of all poses."""
    return region is None or distance_outside(region, pose, config) <= 0.0


def distance_outside(region: PriorRegion, pose: Pose, config: PriorRegionConfig = PRIOR_REGION) -> float:
    """Return the pose's distance from the region, 0 inside it.

    Of a box: Euclidean, of the camera's centre, in scene units. Of a Gaussian: the Mahalanobis distance of the right
    twist from its mean pose, beyond the limit, in standard deviations.
    """
    if isinstance(region, BoxPrior):
        position = pose.position_in_world
        # By axis; the norm of the positive parts is the distance to the box's nearest point.
        outside = np.maximum(region.lower_in_world - position, position - region.upper_in_world)
        return float(np.linalg.norm(np.maximum(outside, 0.0)))
    twist = se3_log(region.pose.camera_from_world @ pose.world_from_camera)
    squared = float(twist @ np.linalg.solve(region.covariance, twist))
    return max(float(np.sqrt(squared) - np.sqrt(config.max_squared_mahalanobis)), 0.0)


def widened_prior(
    region: PriorRegion | None, distance: float, config: PriorRegionConfig = PRIOR_REGION
) -> PriorRegion | None:
    """Return the region grown by the error of a pose that photometric refinement hasn't improved yet.

    `distance` (scene units) is that from the camera to what the photo shows. A box grows on every side, a Gaussian's
    covariance by independent errors of rotation and translation.
    """
    slack = config.slack_share * distance
    if region is None:
        return None
    if isinstance(region, BoxPrior):
        return BoxPrior(region.lower_in_world - slack, region.upper_in_world + slack)
    # Independent errors add their covariances.
    sigmas = np.r_[np.full(3, np.radians(config.slack_deg)), np.full(3, slack)]
    return GaussianPosePrior(region.pose, region.covariance + np.diag(sigmas**2))
