"""PoseLib, wrapped: the camera pose from pixels and the scene points seen in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib
from jaxtyping import Bool, Float

from service.types import NO_CORRECTION, Intrinsics, IntrinsicsCorrection, Pose

MIN_POINTS = 4


@dataclass(frozen=True, slots=True)
class AbsolutePose:
    pose: Pose
    inlier: Bool[np.ndarray, "m"]
    correction: IntrinsicsCorrection = NO_CORRECTION
    """Beside the intrinsics that were given."""

    @property
    def num_inliers(self) -> int:
        return int(self.inlier.sum())


def estimate_absolute_pose(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    max_error_px: float,
    max_trials: int,
) -> AbsolutePose | None:
    """Return the pose that most of the matches agree with, refined on them; None if there is none.

    Matches come surest first: the sampler begins with those (PROSAC, Chum and Matas, CVPR 2005). Without that, 500
    trials find the pose with 98 % certainty where one match in five is right, 2000 where one in eight is. PoseLib's
    sampler starts from a constant, so the answer is a function of the arguments.
    """
    if len(photo_px) < MIN_POINTS:
        return None
    camera = {
        "model": "PINHOLE",
        "width": intrinsics.width,
        "height": intrinsics.height,
        "params": [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy],
    }
    ransac = {
        "max_reproj_error": max_error_px,
        "min_iterations": 100,
        "max_iterations": max_trials,
        "progressive_sampling": True,
        "max_prosac_iterations": max_trials,
        "seed": 0,
    }
    found, info = poselib.estimate_absolute_pose(
        np.asarray(photo_px, np.float64), np.asarray(points_in_world, np.float64), camera, ransac, {}
    )
    if info["num_inliers"] < MIN_POINTS or not np.all(np.isfinite(found.Rt)):
        return None
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = found.R.T
    world_from_camera[:3, 3] = -found.R.T @ found.t
    return AbsolutePose(Pose(world_from_camera), np.array(info["inliers"], bool))
