"""Absolute pose of a rig: several photos whose poses relative to one another are known, as one query."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from service.pose.absolute_pose.pnp import ABSOLUTE_POSE, AbsolutePoseConfig
from service.pose.absolute_pose.rig_kernels import solve_rig
from service.types import Intrinsics, Pose


@dataclass(frozen=True, slots=True)
class RigMatches:
    """What one camera of a rig sees."""

    photo_px: Float[np.ndarray, "m 2"]
    """The most certain first."""
    points_in_world: Float[np.ndarray, "m 3"]
    intrinsics: Intrinsics
    rig_from_camera: Pose
    """Scene units."""
    max_error_px: float
    """Largest reprojection error of an inlier."""


@dataclass(frozen=True, slots=True)
class RigPose:
    """A rig's pose from 2D-3D correspondences."""

    world_from_rig: Pose
    inliers: tuple[Bool[np.ndarray, "_"], ...]
    """Of each camera's correspondences."""

    @property
    def num_inliers(self) -> int:
        """How many correspondences of all cameras agree with the pose."""
        return int(sum(inlier.sum() for inlier in self.inliers))


def estimate_rig_pose(
    cameras: Sequence[RigMatches],
    max_trials: int,
    starts: Sequence[Pose] = (),
    config: AbsolutePoseConfig = ABSOLUTE_POSE,
) -> RigPose | None:
    """Estimate a rig's pose from pixels of its photos and the scene points seen there.

    P3P in each camera in turn, scored in all of them, in locally optimized RANSAC with progressive sampling; then
    Levenberg-Marquardt on the inliers of all cameras with a Cauchy loss. `max_trials` are each camera's; `starts`,
    world_from_rig, are tried first. Deterministic. None if no pose has enough inliers.
    """
    most = max((len(camera.photo_px) for camera in cameras), default=0)
    if most < config.min_points:
        return None
    columns = np.full((len(cameras), 5, most), np.nan)
    for camera, own in zip(cameras, columns, strict=True):
        k, count = camera.intrinsics, len(camera.photo_px)
        own[0, :count] = (camera.photo_px[:, 0] - k.cx) / k.fx
        own[1, :count] = (camera.photo_px[:, 1] - k.cy) / k.fy
        own[2:, :count] = camera.points_in_world.T
    camera_from_rig = np.stack([camera.rig_from_camera.camera_from_world for camera in cameras])
    rig_from_world = np.zeros((len(starts), 4, 3))
    for start, pose in zip(rig_from_world, starts, strict=True):
        start[:3], start[3] = pose.camera_from_world[:3, :3], pose.camera_from_world[:3, 3]
    rotation, translation, inlier = solve_rig(
        columns,
        np.array([len(camera.photo_px) for camera in cameras]),
        np.ascontiguousarray(camera_from_rig[:, :3, :3]),
        np.ascontiguousarray(camera_from_rig[:, :3, 3]),
        np.array([[camera.intrinsics.fx, camera.intrinsics.fy] for camera in cameras]),
        np.array([float(camera.max_error_px) for camera in cameras]),
        rig_from_world,
        (config.min_trials, max_trials),
        (config.confidence, config.trials_factor),
        (config.search_steps, config.final_steps),
        config.seed,
        config.loss_scale,
        config.final_tolerance,
    )
    if np.count_nonzero(inlier) < config.min_points or not np.isfinite(translation).all():
        return None
    world_from_rig = np.eye(4)
    world_from_rig[:3, :3] = rotation.T
    world_from_rig[:3, 3] = -rotation.T @ translation
    inliers = tuple(own[: len(camera.photo_px)] for own, camera in zip(inlier, cameras, strict=True))
    return RigPose(Pose(world_from_rig), inliers)
