"""The pose of a rig from matches: planted poses, outliers, and PoseLib's generalized absolute pose as a peer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.geometry import moved, pose_distance, reprojection_error_px, transformed
from service.pose.absolute_pose.pnp import estimate_absolute_pose
from service.pose.absolute_pose.rig_pose import RigMatches, estimate_rig_pose
from service.types import Intrinsics, Pose

LENSES = (Intrinsics(640, 480, 500, 500, 320, 240), Intrinsics(800, 600, 700, 690, 410, 290))
TRUTH = moved(Pose(np.eye(4)), np.array([0.3, -0.4, 0.2, 1.0, -2.0, 0.5]))


def rig(seed: int, right: int, wrong: int, cameras: int = 4, noise_px: float = 0.5) -> list[RigMatches]:
    """Cameras that look in different directions; each has some right matches, in no order, among wrong ones."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(cameras):
        lens = LENSES[number % 2]
        mount = moved(Pose(np.eye(4)), np.append([0.0, 1.2 * number, 0.1], rng.normal(size=3) * 0.3))
        world_from_camera = TRUTH.world_from_camera @ mount.world_from_camera
        depth = rng.uniform(2, 6, (right + wrong, 1))
        px = rng.uniform([0, 0], [lens.width, lens.height], (right + wrong, 2))
        points = np.column_stack([(px - [lens.cx, lens.cy]) / [lens.fx, lens.fy], np.ones(len(px))]) * depth
        world = transformed(world_from_camera, points)
        px += rng.normal(size=px.shape) * noise_px
        world[right:] = world[rng.permutation(right + wrong)[:wrong]] + rng.normal(size=(wrong, 3))
        order = rng.permutation(right + wrong)
        found.append(RigMatches(px[order], world[order], lens, mount, 3.0))
    return found


def test_exact_matches_of_two_cameras_give_the_exact_pose():
    """Their principal points are not in the middle, and no wrong match is among them."""
    cameras = rig(3, 20, 0, cameras=2, noise_px=0.0)
    found = estimate_rig_pose(cameras, 200)
    assert found is not None
    turned, way = pose_distance(found.world_from_rig, TRUTH)
    assert turned < 1e-4
    assert way < 1e-6
    assert found.num_inliers == 40
    assert [inlier.tolist() for inlier in found.inliers] == [[True] * 20] * 2
    for camera in cameras:
        world_from_camera = found.world_from_rig.world_from_camera @ camera.rig_from_camera.world_from_camera
        error_px = reprojection_error_px(
            camera.photo_px, camera.points_in_world, camera.intrinsics, Pose(world_from_camera)
        )
        assert error_px.max() < 1e-3
    few = [
        replace(camera, photo_px=camera.photo_px[:3], points_in_world=camera.points_in_world[:3]) for camera in cameras
    ]
    assert estimate_rig_pose(few, 200) is None
    assert estimate_rig_pose([], 200) is None


@pytest.mark.ci
def test_cameras_that_fail_alone_find_the_pose_together():
    """Six right matches among 90 in each of four cameras: one in fifteen."""
    right, alone = 0, 0
    for seed in range(6):
        cameras = rig(seed, 6, 84)
        found = estimate_rig_pose(cameras, 6000)
        if found is not None:
            turned, way = pose_distance(found.world_from_rig, TRUTH)
            right += turned < 0.3 and way < 0.02
        for camera in cameras:
            single = estimate_absolute_pose(camera.photo_px, camera.points_in_world, camera.intrinsics, 3.0, 2000)
            truth = Pose(TRUTH.world_from_camera @ camera.rig_from_camera.world_from_camera)
            alone += single is not None and pose_distance(single.pose, truth)[0] < 0.3
    assert right == 6
    assert alone < 12  # of 24; seen: 4
