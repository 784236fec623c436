"""The smoother of trajectories: against a dense least-squares solution, and on planted motions with planted jitter."""

from __future__ import annotations

import numpy as np
import pytest

from service.geometry import moved, pose_distance, se3_exp, se3_log
from service.smoothing import SMOOTHING, MotionNoise, TimedPose, _filtered, _stretches, smoothed, smoothed_states
from service.types import Pose

SIGMA = np.array([0.004] * 3 + [0.03, 0.01, 0.02])


def walk(count: int, dt: float = 0.1) -> list[Pose]:
    """A camera that walks a curve and looks around, turning by up to 30 degrees a second."""
    times = np.arange(count) * dt
    turns = np.stack([0.1 * np.sin(times), 0.5 * np.sin(0.7 * times), 0.2 * np.cos(times)], 1)
    steps = np.stack([0.8 * times, np.sin(times), 0.3 * times], 1)
    twists = np.concatenate([turns, steps], 1)
    turn = Pose(se3_exp(np.array([0.4, -1.0, 0.3, 2.0, 1.0, 0.5]))).world_from_camera
    return [Pose(turn @ se3_exp(np.r_[np.zeros(3), t[3:]]) @ se3_exp(np.r_[t[:3], np.zeros(3)])) for t in twists]


def jittered(poses: list[Pose], seed: int = 0, scale: float = 1.0) -> list[Pose]:
    rng = np.random.default_rng(seed)
    return [moved(pose, scale * SIGMA * rng.normal(size=6)) for pose in poses]


def errors(found, truth: list[Pose]) -> np.ndarray:
    pairs = zip(found, truth, strict=True)
    return np.array([se3_log(a.pose.camera_from_world @ b.world_from_camera) for a, b in pairs])


def test_jitter_is_filtered_and_the_motion_is_kept():
    truth = walk(80)
    seen = jittered(truth)
    found = smoothed([TimedPose(0.1 * i, pose, np.diag(SIGMA**2)) for i, pose in enumerate(seen)])
    assert all(f is not None and not f.interpolated for f in found)
    before = np.array([se3_log(a.camera_from_world @ b.world_from_camera) for a, b in zip(seen, truth, strict=True)])
    after = errors(found, truth)
    # 0.51 and 0.44 of the jitter remain here.
    for part in (slice(0, 3), slice(3, 6)):
        assert np.sqrt((after[:, part] ** 2).mean()) < 0.65 * np.sqrt((before[:, part] ** 2).mean())
    # The covariance says how wrong they are still: 6 is the mean of a chi-square with 6 degrees of freedom.
    squares = [e @ np.linalg.solve(f.covariance, e) for e, f in zip(after, found, strict=True)]
    assert 3 < np.mean(squares) < 12


def test_covariances_that_are_too_small_by_a_factor_are_noticed():
    truth = walk(80)
    seen = jittered(truth, scale=3.0)
    told = [TimedPose(0.1 * i, pose, np.diag(SIGMA**2)) for i, pose in enumerate(seen)]
    found = smoothed(told)
    squares = [e @ np.linalg.solve(f.covariance, e) for e, f in zip(errors(found, truth), found, strict=True)]
    assert 3 < np.mean(squares) < 14


def test_a_pose_counts_by_its_covariance():
    truth = walk(40)
    seen = jittered(truth)
    told = [TimedPose(0.1 * i, pose, np.diag(SIGMA**2)) for i, pose in enumerate(seen)]
    bad = moved(truth[20], 10 * SIGMA)
    told[20] = TimedPose(2.0, bad, np.diag((10 * SIGMA) ** 2))
    found = smoothed(told)
    assert found[20] is not None
    # 0.04 seen.
    assert pose_distance(found[20].pose, truth[20])[1] < 0.3 * pose_distance(bad, truth[20])[1]


def test_short_gaps_are_interpolated_and_long_ones_are_left():
    truth = walk(60)
    seen: list[Pose | None] = list(jittered(truth))
    lost = {0, 1, 20, 21, 22, *range(35, 50), 59}
    told = [TimedPose(0.1 * i, None if i in lost else p, np.diag(SIGMA**2)) for i, p in enumerate(seen)]
    found = smoothed(told)
    assert {i for i, f in enumerate(found) if f is None} == {0, 1, *range(35, 50), 59}
    assert {i for i, f in enumerate(found) if f and f.interpolated} == {20, 21, 22}
    for i in (20, 21, 22):
        turned, moved_by = pose_distance(found[i].pose, truth[i])
        # The camera turns by 4 degrees and moves by 0.4 meanwhile; 0.28 degrees and 0.02 seen.
        assert turned < 0.6
        assert moved_by < 0.06
        # Less is known where nothing was seen.
        assert np.trace(found[i].covariance) > np.trace(found[25].covariance)


def test_without_rotation_it_is_the_least_squares_solution():
    """The same model as one dense linear system: measurements, and the integral of white noise between the times."""
    rng = np.random.default_rng(4)
    times = np.cumsum(rng.uniform(0.05, 0.3, 12))
    position = np.cumsum(rng.normal(size=12)) * 0.3
    sigma = rng.uniform(0.05, 0.2, 12)
    told = []
    for t, x, s in zip(times, position, sigma, strict=True):
        pose = np.eye(4)
        pose[0, 3] = x
        told.append(TimedPose(t, Pose(pose), np.diag([1e-6] * 3 + [s * s] * 3)))
    states = smoothed_states(told, MotionNoise(1e-6, 0.7))
    n = len(times)
    system, right = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    for i in range(n):
        system[2 * i, 2 * i] += 1 / sigma[i] ** 2
        right[2 * i] += position[i] / sigma[i] ** 2
    # The smoother's vague prior of the first velocity.
    system[1, 1] += 1 / states_prior(told) ** 2
    for i, dt in enumerate(np.diff(times)):
        weight = np.linalg.inv(0.7 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
        rows = np.zeros((2, 2 * n))
        rows[:, 2 * i : 2 * i + 2] = [[-1, -dt], [0, -1]]
        rows[:, 2 * i + 2 : 2 * i + 4] = np.eye(2)
        system += rows.T @ weight @ rows
    solution = np.linalg.solve(system, right)
    assert np.allclose([s.pose.position_in_world[0] for s in states], solution[0::2], atol=1e-9)
    assert np.allclose([s.velocity[3] for s in states], solution[1::2], atol=1e-8)
    assert np.allclose([s.covariance[3, 3] for s in states], np.diag(np.linalg.inv(system))[0::2], rtol=1e-8)


def states_prior(told: list[TimedPose]) -> float:
    span = told[-1].time_s - told[0].time_s
    reach = max(abs(p.pose.position_in_world[0] - told[0].pose.position_in_world[0]) for p in told if p.pose)
    return max(1.0, reach) * len(told) / span


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_poses_stay_as_they_are(count):
    poses = walk(count)
    found = smoothed([TimedPose(0.1 * i, pose) for i, pose in enumerate(poses)])
    assert [f and f.pose for f in found] == poses
    assert smoothed([TimedPose(0.0, None), TimedPose(0.1, None)]) == [None, None]


def test_two_poses_around_a_gap_are_joined():
    a, b = walk(3)[0], walk(3)[2]
    found = smoothed([TimedPose(0.0, a), TimedPose(0.1, None), TimedPose(0.2, b)])
    halfway = se3_log(a.camera_from_world @ b.world_from_camera) / 2
    assert found[1] is not None
    assert found[1].interpolated
    assert np.allclose(found[1].pose.world_from_camera, moved(a, halfway).world_from_camera)


@pytest.mark.parametrize(("gap_s", "stretches"), [(1.0, [(0, 4)]), (1.125, [(0, 2), (3, 4)])])
def test_a_second_without_a_pose_divides_a_trajectory(gap_s, stretches):
    pose = walk(1)[0]
    photos = [TimedPose(0.0, pose), TimedPose(0.5, pose), TimedPose(0.75, None), TimedPose(0.5 + gap_s, pose)]
    assert _stretches(photos, SMOOTHING.max_gap_s) == stretches


def test_without_covariances_those_of_others_are_taken():
    poses = walk(3)
    told = [np.eye(6) * 4e-4, None, np.eye(6) * 2e-4]
    found = smoothed([TimedPose(10.0 * i, pose, c) for i, (pose, c) in enumerate(zip(poses, told, strict=True))])
    assert [f is not None and float(f.covariance[0, 0]) for f in found] == pytest.approx([4e-4, 3e-4, 2e-4])


def test_without_any_covariance_a_thousandth_of_a_radian_and_of_a_unit_are_taken():
    """Only how they compare with the motion matters to the poses."""
    poses = jittered(walk(3))
    unknown = smoothed([TimedPose(0.1 * i, pose) for i, pose in enumerate(poses)])
    told = smoothed([TimedPose(0.1 * i, pose, np.eye(6) * 1e-6) for i, pose in enumerate(poses)])
    for a, b in zip(unknown, told, strict=True):
        assert a is not None
        assert b is not None
        assert np.array_equal(a.pose.world_from_camera, b.pose.world_from_camera)
        assert np.array_equal(a.covariance, b.covariance)


def test_the_third_pose_is_the_first_evidence_of_the_covariances():
    """The first two tell the velocity. A third one off by d has d^2 / its prediction's variance, of 6 components."""
    rest, off = walk(1)[0], np.array([0, 0, 0, 0.3, 0, 0])
    photos = [TimedPose(float(i), moved(rest, off * (i == 2)), np.eye(6) * 1e-4) for i in range(3)]
    # Of poses at 0 and 1 with the variance v, the one at 2 is predicted with 5 v: 2 x2 - x1.
    factor = _filtered(photos, MotionNoise(1e-18, 1e-18))[3]
    assert factor == pytest.approx(0.3**2 / (6e-4 * 6), rel=0.01)


def test_photos_of_one_time_have_no_infinite_speed():
    poses = walk(4)
    found = smoothed([TimedPose(0.0, pose, np.eye(6) * 1e-4) for pose in poses])
    assert all(f is not None and np.isfinite(f.pose.world_from_camera).all() for f in found)
    two = smoothed([TimedPose(1.0, poses[0]), TimedPose(1.0, None), TimedPose(1.0, poses[1])])
    assert two[1] is not None
    assert np.allclose(two[1].pose.world_from_camera, poses[0].world_from_camera)
