"""Joint refinement of a rig: each photo's photometric refinement, summed in the rig's twist, beside the matches'.

A photo alone would be moved by a twist t_i with the covariance C_i; the matches would move the rig by m, with the
information M. The rig's step x, which A_i takes to the twist of camera i, minimizes

    sum_i w_i (A_i x - t_i)' C_i^-1 (A_i x - t_i) + (x - m)' M (x - m)

where w_i falls if a photo's pixels contradict the matches, as those of what hides the scene do. Then the photos are
rendered again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.geometry import adjoint, moved, se3_log, transformed
from service.pose.absolute_pose.rig_pose import RigMatches, RigPose
from service.pose.features.image_sizes import PHOTO_PX, RENDER_PX, sized
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import ViewRenderer
from service.pose.refinement.photometric import refine_photometric
from service.pose.refinement.uncertainty import pose_uncertainty
from service.types import Camera, Pose


@dataclass(frozen=True, slots=True)
class RigRefinementConfig:
    """How a rig is refined."""

    match_sigma_px: float = 4.0
    most_matches: int = 60
    """Standard deviation of a match, at PHOTO_PX, and how many count at most: neighbours err alike."""
    sizes_px: tuple[int, ...] = (256, RENDER_PX, RENDER_PX)
    """Long sides of the renders, one after the other."""


RIG_REFINEMENT = RigRefinementConfig()


def refine_rig(
    cameras: Sequence[tuple[QueryImages, Pose]],
    matched: Pose,
    of_matches: Float64[np.ndarray, "6 6"],
    renderer: ViewRenderer,
    config: RigRefinementConfig = RIG_REFINEMENT,
) -> tuple[Pose, Float64[np.ndarray, "6 6"] | None]:
    """Return world_from_rig after refinement, and the covariance of its twist; None where nothing determines it.

    `cameras`: each photo, with exact intrinsics, and its rig_from_camera. `matched` is the pose by the matches, which
    have the information `of_matches`.
    """
    covariance, world_from_rig = None, matched
    for number, size_px in enumerate(config.sizes_px):
        back = se3_log(world_from_rig.camera_from_world @ matched.world_from_camera)
        information, pull = of_matches.copy(), of_matches @ back
        for images, rig_from_camera in cameras:
            pose = moved(Pose(world_from_rig.world_from_camera @ rig_from_camera.world_from_camera), np.zeros(6))
            asked = _asked_by(images, pose, renderer, size_px, 1 if number else 2)
            if asked is None:
                continue
            to_camera = adjoint(rig_from_camera.camera_from_world)
            weight = _agreement(to_camera @ back - asked[0], to_camera, asked[1], of_matches)
            weighed = weight * to_camera.T @ np.linalg.inv(asked[1])
            information += weighed @ to_camera
            pull += weighed @ asked[0]
        if np.linalg.matrix_rank(information) < len(information):
            return world_from_rig, covariance
        covariance = np.linalg.inv(information)
        world_from_rig = moved(world_from_rig, covariance @ pull)
    return world_from_rig, covariance


def _asked_by(
    images: QueryImages, pose: Pose, renderer: ViewRenderer, size_px: int, levels: int
) -> tuple[Float64[np.ndarray, "6"], Float64[np.ndarray, "6 6"]] | None:
    """Return the twist by which a photo would be moved, and its covariance; None: it doesn't determine its pose."""
    size = sized(images.query.intrinsics, size_px)
    rgb, valid = images.resized(size), images.valid_mask(size)
    rendered = renderer.render(Camera(size, pose))
    frame, camera = rendered.frame, rendered.camera
    result = refine_photometric(rgb, frame, camera, camera, levels, valid_mask=valid)
    if not np.isfinite(result.loss):
        return None
    found = pose_uncertainty(rgb, frame, camera, Camera(size, result.pose), None, valid, result)
    if found is None:
        return None
    goal = moved(result.pose, found.last_step)
    return se3_log(pose.camera_from_world @ goal.world_from_camera), found.covariance[:6, :6]


def match_information(
    cameras: Sequence[RigMatches], found: RigPose, config: RigRefinementConfig = RIG_REFINEMENT
) -> Float64[np.ndarray, "6 6"]:
    """Return the information of the rig's twist by the matches that agree with its pose."""
    total = np.zeros((6, 6))
    for camera, agree in zip(cameras, found.inliers, strict=True):
        pose = found.world_from_rig.world_from_camera @ camera.rig_from_camera.world_from_camera
        points = transformed(np.linalg.inv(pose), camera.points_in_world[agree].astype(np.float64))
        x, y, z = points.T
        zero, lens = np.zeros_like(x), camera.intrinsics
        of_point = np.stack(
            [lens.fx / z, zero, -lens.fx * x / z**2, zero, lens.fy / z, -lens.fy * y / z**2], 1
        ).reshape(-1, 2, 3)
        # A camera that turns by w and moves by v sees a point X move by X x w - v.
        turned = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
        jacobian = np.concatenate([of_point @ turned, -of_point], 2).reshape(-1, 6)
        sigma = config.match_sigma_px * lens.long_side / PHOTO_PX
        to_camera = adjoint(camera.rig_from_camera.camera_from_world)
        total += to_camera.T @ (jacobian.T @ jacobian / sigma**2) @ to_camera
    return total * min(1.0, config.most_matches / max(found.num_inliers, 1))


def _agreement(
    gap: Float64[np.ndarray, "6"],
    to_camera: Float64[np.ndarray, "6 6"],
    covariance: Float64[np.ndarray, "6 6"],
    information: Float64[np.ndarray, "6 6"],
) -> float:
    """Return the weight, 1 to 0, of what a photo's pixels ask for, by how far that is from what the matches say."""
    if np.linalg.matrix_rank(information) < len(information):
        return 1.0
    spread = covariance + to_camera @ np.linalg.inv(information) @ to_camera.T
    # Cauchy's weight of the Mahalanobis distance in six dimensions.
    return 1.0 / (1.0 + float(gap @ np.linalg.solve(spread, gap)) / 6)
