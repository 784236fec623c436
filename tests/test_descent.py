"""The chains of gradients, against central differences of functions whose twist gradient is known by hand."""

import numpy as np
import pytest

from service.estimators.icomma import match_loss
from service.geometry import look_at, moved, pose_distance, project, transformed
from service.pose.descent.adam import Adam
from service.pose.descent.gradient_descent import Se3, So3T3
from service.pose.matching.correspondences import Correspondences
from service.pose.matching.render_and_match import epipolar_inliers
from service.pose.retrieval.scene_focus import Focus
from service.types import Intrinsics, Pose

LENS = Intrinsics(512, 384, 500.0, 510.0, 256.0, 192.0)
TRUTH = look_at(np.array([3.0, 1.5, 1.2]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
FOCUS = Focus(np.array([0.2, 0.1, -0.1]), 3.0, False)


def smooth(pose: Pose) -> float:
    matrix = pose.world_from_camera
    return float(np.sin(matrix[:3, :] @ [0.3, -0.7, 0.4, 0.9]).sum() + matrix[0, 3] * matrix[1, 2])


def by_twist(function, pose: Pose) -> np.ndarray:
    steps = 1e-6 * np.eye(6)
    return np.array([(function(moved(pose, s)) - function(moved(pose, -s))) / 2e-6 for s in steps])


@pytest.mark.parametrize("kind", [Se3, So3T3])
@pytest.mark.parametrize("size", [0.0, 0.05, 1.2])
def test_gradient_by_the_numbers(kind, size: float) -> None:
    of = kind(TRUTH, FOCUS)
    numbers = size * np.random.default_rng(0).normal(size=6)
    steps = 1e-5 * np.eye(6)
    expected = [(smooth(of.pose(numbers + s)) - smooth(of.pose(numbers - s))) / 2e-5 for s in steps]
    assert np.allclose(of.gradient(numbers, by_twist(smooth, of.pose(numbers))), expected, rtol=1e-5, atol=1e-6)
    assert np.allclose(of.pose(np.zeros(6)).world_from_camera, TRUTH.world_from_camera, atol=1e-12)


def test_se3_turns_about_the_focus_and_so3_in_place() -> None:
    numbers = np.array([0.0, 0.0, 0.4, 0.0, 0.0, 0.0])
    orbit, turn = Se3(TRUTH, FOCUS).pose(numbers), So3T3(TRUTH, FOCUS).pose(numbers)
    for pose in (orbit, turn):
        assert pose_distance(pose, TRUTH)[0] == pytest.approx(np.degrees(0.4))
    assert np.allclose(turn.position_in_world, TRUTH.position_in_world)
    reach = [np.linalg.norm(p.position_in_world - FOCUS.point_in_world) for p in (orbit, TRUTH)]
    assert reach[0] == pytest.approx(reach[1])
    # One normalized unit is a quarter of the focus' distance.
    shift = So3T3(TRUTH, FOCUS).pose(np.array([0, 0, 0, 0, 0, 1.0]))
    assert np.allclose(shift.position_in_world - TRUTH.position_in_world, [0, 0, 0.75])


def matches(wrong: int = 0) -> Correspondences:
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.8, 0.8, (60, 3))
    other = moved(TRUTH, np.array([0.1, 0.2, 0.05, 0.4, -0.3, 0.2]))
    photo, view = (project(transformed(pose.camera_from_world, points), LENS) for pose in (TRUTH, other))
    photo[:wrong] = rng.uniform([0, 0], [512, 384], (wrong, 2))
    return Correspondences(*(np.asarray(a, np.float32) for a in (photo, view, points)))


def test_match_loss_gradient() -> None:
    pose = moved(TRUTH, np.array([0.05, -0.1, 0.02, 0.1, 0.2, -0.1]))
    expected = by_twist(lambda p: match_loss(matches(), LENS, p)[0], pose)
    assert np.allclose(match_loss(matches(), LENS, pose)[1], expected, rtol=1e-4, atol=1e-8)
    assert match_loss(matches(), LENS, TRUTH)[0] < 1e-10


def test_epipolar_inliers_drop_wrong_matches() -> None:
    kept = epipolar_inliers(matches(wrong=20), LENS)
    assert kept[20:].mean() > 0.95
    assert kept[:20].mean() < 0.35  # a wrong one may lie near its epipolar line
    few = matches()
    few = Correspondences(few.photo_px[:7], few.view_px[:7], few.points_in_world[:7])
    assert not epipolar_inliers(few, LENS).any()


def test_adam_by_hand() -> None:
    """The first step is the rate times the sign; with a constant gradient all of them are."""
    adam = Adam(2, 0.1)
    for _ in range(3):
        assert np.allclose(adam.step(np.array([3.0, -0.02])), [0.1, -0.1], rtol=1e-5)
