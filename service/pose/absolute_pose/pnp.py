"""Absolute pose by PnP-RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from service.pose.absolute_pose.ransac import solve_pnp
from service.types import NO_CORRECTION, Intrinsics, IntrinsicsCorrection, Pose


@dataclass(frozen=True, slots=True)
class AbsolutePoseConfig:
    min_points: int = 4
    """Fewest correspondences, and fewest inliers of a solution: three fix a pose (P3P), the fourth confirms it."""
    min_trials: int = 100
    """RANSAC trials before the inlier ratio may end the search: one sample with many inliers by chance is no proof."""
    confidence: float = 0.9999
    """That a sample of inliers was among the trials, where the search ends early."""
    trials_factor: float = 3.0
    """Times as many trials as that takes without noise. This and the above are PoseLib's defaults."""
    seed: int = 1
    """Of the sampler."""
    search_steps: int = 10
    """Of Levenberg-Marquardt, for each pose that is better than those before; most converge in 4."""
    final_steps: int = 50
    """The same, for the answer."""
    final_tolerance: float = 1e-8
    """Shortest step, rad and share of the distance."""
    loss_scale: float = 0.5
    """Of the answer's robust loss, in largest errors of an inlier; PoseLib's."""


ABSOLUTE_POSE = AbsolutePoseConfig()


@dataclass(frozen=True, slots=True)
class AbsolutePose:
    """A pose from 2D-3D correspondences."""

    pose: Pose
    inlier: Bool[np.ndarray, "m"]
    """Of the correspondences that the pose was estimated from."""
    correction: IntrinsicsCorrection = NO_CORRECTION
    """Of the intrinsics that were given; estimated only where they are approximate."""

    @property
    def num_inliers(self) -> int:
        """How many correspondences agree with the pose."""
        return int(self.inlier.sum())


def estimate_absolute_pose(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    max_error_px: float,
    max_trials: int,
    config: AbsolutePoseConfig = ABSOLUTE_POSE,
) -> AbsolutePose | None:
    """Estimate the pose from pixels of a photo and the scene points (world frame, scene units) seen there.

    P3P in locally optimized RANSAC with progressive sampling (LO-RANSAC, PROSAC), then Levenberg-Marquardt on the
    inliers with a Cauchy loss. The correspondences are ordered by confidence, highest first. Without that order 500
    trials find the pose with 98 % certainty where one match in five is right, 2000 where one in eight is.
    Deterministic: the sampler has a fixed seed. `max_error_px` is the largest reprojection error of an inlier. None if
    no pose has enough inliers.
    """
    if len(photo_px) < config.min_points:
        return None
    rotation, translation, inlier = solve_pnp(
        # Copies: for read-only or strided arrays the kernel would be compiled once more.
        np.array(photo_px, np.float64, order="C"),
        np.array(points_in_world, np.float64, order="C"),
        np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]),
        float(max_error_px),
        (config.min_trials, max_trials),
        (config.confidence, config.trials_factor),
        (config.search_steps, config.final_steps),
        config.seed,
        config.loss_scale * max_error_px,
        config.final_tolerance,
    )
    if np.count_nonzero(inlier) < config.min_points or not np.isfinite(translation).all():
        return None
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = rotation.T
    world_from_camera[:3, 3] = -rotation.T @ translation
    return AbsolutePose(Pose(world_from_camera), inlier)
