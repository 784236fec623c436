"""P3P and the search for a pose beside PoseLib's, on planted cameras."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from service.geometry import pose_distance, project, rotation_from_quat, transformed
from service.jit import kernel
from service.pose.absolute_pose.p3p import WORK, solve_p3p
from service.pose.absolute_pose.pnp import ABSOLUTE_POSE, AbsolutePose, estimate_absolute_pose
from service.pose.absolute_pose.ransac import solve_pnp
from service.types import Intrinsics, Pose

CAMERA = Intrinsics(640, 480, 500.0, 520.0, 310.0, 250.0)
ERROR_PX = 8.0


def peer() -> ModuleType:
    return pytest.importorskip("poselib", reason="it has no wheel for this machine")


def random_pose(rng: np.random.Generator) -> Pose:
    quat = rng.normal(size=4)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_from_quat(quat / np.linalg.norm(quat)), rng.normal(size=3)
    return Pose(matrix)


def seen(rng: np.random.Generator, truth: Pose, count: int, depth: tuple[float, float] = (2.0, 8.0)):
    """Points in front of a camera, and their pixels."""
    px = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (count, 2))
    rays = np.c_[(px - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(count)]
    return transformed(truth.world_from_camera, rays * rng.uniform(*depth, (count, 1))), px


@kernel
def solve_all(rays, points, rotations, translations, counts):
    work = np.zeros(WORK)
    for i in range(len(rays)):
        counts[i] = solve_p3p(rays[i], points[i], work, rotations[i], translations[i])


def p3p(rays: np.ndarray, points: np.ndarray) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """All solutions of each problem: rotation and translation of camera_from_world."""
    count = len(rays)
    rotations, translations = np.zeros((count, 4, 3, 3)), np.zeros((count, 4, 3))
    counts = np.zeros(count, np.int64)
    solve_all(rays, points, rotations, translations, counts)
    return [list(zip(rotations[i, :n], translations[i, :n], strict=True)) for i, n in enumerate(counts)]


def problems(count: int, flatness: float = 1.0):
    """Rays, points and true poses; `flatness` scales how far the third point is from the line of the others."""
    rng = np.random.default_rng(4)
    truths = [random_pose(rng) for _ in range(count)]
    points = np.stack([seen(rng, truth, 3, (0.5, 10.0))[0] for truth in truths])
    foot = points[:, 0] + 0.4 * (points[:, 1] - points[:, 0])
    points[:, 2] = foot + flatness * (points[:, 2] - foot)
    in_camera = np.stack([transformed(truth.camera_from_world, p) for truth, p in zip(truths, points, strict=True)])
    return in_camera / np.linalg.norm(in_camera, axis=2, keepdims=True), points, truths


def difference(one, other) -> float:
    return max(np.abs(one[0] - other[0]).max(), np.abs(one[1] - other[1]).max())


# Seen: at most 2e-8 and 4e-5.
@pytest.mark.parametrize(("flatness", "bound"), [(1.0, 1e-6), (1e-3, 1e-3)])
def test_p3p_finds_the_true_pose(flatness: float, bound: float) -> None:
    rays, points, truths = problems(500, flatness)
    for found, truth in zip(p3p(rays, points), truths, strict=True):
        matrix = truth.camera_from_world
        assert min(difference(pose, (matrix[:3, :3], matrix[:3, 3])) for pose in found) < bound


def test_p3p_finds_the_solutions_that_poselib_finds() -> None:
    poselib = peer()
    rays, points, _ = problems(500)
    several = 0
    for found, ray, point in zip(p3p(rays, points), rays, points, strict=True):
        others = [(pose.R, pose.t) for pose in poselib.p3p(list(ray), list(point))]
        assert len(found) == len(others)
        assert all(min(difference(pose, other) for pose in found) < 1e-4 for other in others)
        several += len(found) > 1
    assert several > 200


def test_p3p_has_no_solution_for_points_on_a_line_or_behind() -> None:
    rays, points, _ = problems(20, 0.0)
    points[:10, 2] = points[:10, 1]
    assert all(not found or np.isfinite(found[0][0]).all() for found in p3p(rays, points))
    assert p3p(rays[:10], points[:10]) == [[]] * 10
    assert p3p(np.zeros((1, 3, 3)), np.zeros((1, 3, 3))) == [[]]


def matched(rng: np.random.Generator, count: int, share: float, noise_px: float):
    """Correspondences with wrong ones among them, likely ones first; the true pose."""
    truth = random_pose(rng)
    points, px = seen(rng, truth, count)
    right = rng.random(count) < share
    px = px + rng.normal(0, noise_px, px.shape)
    px[~right] = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], ((~right).sum(), 2))
    order = np.argsort(-(rng.random(count) + 0.3 * right))
    return px[order], points[order], truth


def by_poselib(px: np.ndarray, points: np.ndarray, trials: int) -> tuple[Pose, np.ndarray]:
    poselib = peer()
    camera = {"model": "PINHOLE", "width": CAMERA.width, "height": CAMERA.height}
    camera["params"] = [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]
    options = {"max_reproj_error": ERROR_PX, "min_iterations": ABSOLUTE_POSE.min_trials, "max_iterations": trials}
    options |= {"progressive_sampling": True, "max_prosac_iterations": trials, "seed": 0}
    found, facts = poselib.estimate_absolute_pose(px, points, camera, options, {})
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = found.R.T, -found.R.T @ found.t
    return Pose(matrix), np.array(facts["inliers"], bool)


@pytest.mark.parametrize(
    ("count", "share", "trials"), [(300, 0.8, 500), (300, 0.2, 500), (300, 0.12, 2000), (40, 0.4, 200), (12, 0.7, 500)]
)
def test_poses_are_as_good_as_poselibs(count: int, share: float, trials: int) -> None:
    rng = np.random.default_rng(5)
    ours, theirs, same = [], [], 0
    for _ in range(25):
        px, points, truth = matched(rng, count, share, 1.0)
        found = estimate_absolute_pose(px, points, CAMERA, ERROR_PX, trials)
        other, inlier = by_poselib(px, points, trials)
        ours.append(pose_distance(found.pose, truth) if found else (180.0, 9.0))
        theirs.append(pose_distance(other, truth))
        if found and np.array_equal(found.inlier, inlier):
            # The same inliers have the same best pose: 0.0008 degrees were seen.
            assert pose_distance(found.pose, other)[0] < 0.005
            same += 1
    assert same >= 15
    missed = [sum(error[0] > 2.0 for error in errors) for errors in (ours, theirs)]
    assert missed[0] <= missed[1] + 1
    for ours_one, theirs_one in zip(np.median(ours, 0), np.median(theirs, 0), strict=True):
        assert ours_one < 1.05 * theirs_one


def test_the_answer_is_the_same_each_time_and_counts_points_ahead_only() -> None:
    rng = np.random.default_rng(6)
    px, points, truth = matched(rng, 200, 0.5, 0.5)
    # Behind the camera, where the projection would be the pixel.
    mirrored = transformed(truth.camera_from_world, points[:40]) * -1.0
    points[:40] = transformed(truth.world_from_camera, mirrored)
    found, again = (estimate_absolute_pose(px, points, CAMERA, ERROR_PX, 500) for _ in range(2))
    assert found is not None
    assert again is not None
    assert np.array_equal(found.pose.world_from_camera, again.pose.world_from_camera)
    assert np.array_equal(found.inlier, again.inlier)
    assert not found.inlier[:40].any()
    assert pose_distance(found.pose, truth)[0] < 0.2
    rotation = found.pose.world_from_camera[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_three_points_or_random_ones_have_no_pose() -> None:
    rng = np.random.default_rng(7)
    points, px = seen(rng, random_pose(rng), 3)
    assert estimate_absolute_pose(px, points, CAMERA, ERROR_PX, 100) is None
    found: AbsolutePose | None = estimate_absolute_pose(np.zeros((9, 2)), np.zeros((9, 3)), CAMERA, ERROR_PX, 100)
    assert found is None


def test_noise_free_pixels_give_the_pose_exactly() -> None:
    rng = np.random.default_rng(8)
    truth = random_pose(rng)
    points, _ = seen(rng, truth, 30)
    px = project(transformed(truth.camera_from_world, points), CAMERA)
    found = estimate_absolute_pose(px, points, CAMERA, 1.0, 100)
    assert found is not None
    assert found.num_inliers == 30
    np.testing.assert_allclose(found.pose.world_from_camera, truth.world_from_camera, atol=1e-9)


def test_arrays_of_any_type_and_layout_use_one_compiled_kernel() -> None:
    """That `doctor --warm` compiles, so that no job waits for a compiler."""
    rng = np.random.default_rng(9)
    px, points, _ = matched(rng, 60, 0.7, 0.5)
    estimate_absolute_pose(px, points, CAMERA, ERROR_PX, 100)
    strided = np.repeat(px, 2, axis=0).astype(np.float32)[::2]
    strided.flags.writeable = False
    estimate_absolute_pose(strided, np.asfortranarray(points), CAMERA, np.float64(ERROR_PX), 100)
    assert len(solve_pnp.signatures) == 1
