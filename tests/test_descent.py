"""The chains of gradients, against central differences of functions whose twist gradient is known by hand."""

from itertools import pairwise

import numpy as np
import pytest

from service.errors import InvalidOptions
from service.estimators.icomma import match_loss
from service.geometry import look_at, moved, pose_distance, project, transformed
from service.interfaces import Features, Frame
from service.pose.descent.adam import Adam
from service.pose.descent.contribution_pruning import PruningConfig, prune
from service.pose.descent.gradient_descent import DescentConfig, Se3, So3T3, descend, require_within
from service.pose.descent.hypotheses import NearViewConfig, around, poses_near_views
from service.pose.features.rendered_views import View
from service.pose.features.scene_focus import Focus
from service.pose.matching.correspondences import Correspondences
from service.pose.matching.render_and_match import epipolar_inliers
from service.types import Camera, GaussianScene, Intrinsics, Pose, SceneInfo

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
    # A gradient as small as the paper's epsilon moves half as far.
    assert np.allclose(Adam(2, 0.1).step(np.array([1e-8, -1e-8])), [0.05, -0.05], rtol=1e-5)


# --- the descent's schedule, and what is sampled


class Slope:
    """A renderer whose gradient is the same everywhere."""

    def __init__(self, gradient: np.ndarray) -> None:
        self.gradient, self.gradients = gradient, 0

    def render(self, cameras: list[Camera]) -> list[Frame]:
        blank = np.zeros((2, 2), np.float32)
        return [Frame(np.zeros((2, 2, 3), np.float32), blank, blank, blank) for _ in cameras]

    def pose_gradient(self, camera: Camera, d_rgb: np.ndarray) -> np.ndarray:
        self.gradients += 1
        return self.gradient


def test_the_rate_of_a_descent_falls_geometrically_from_the_first_to_the_last_step() -> None:
    """Adam's steps are the rate's size while the gradient stays the same; a translation alone moves no rotation."""
    focus = Focus(TRUTH.position_in_world, 2.0, False)  # no arm: turning about the camera itself
    slope = Slope(np.array([0, 0, 0.5, 0, 0, 3.0]))
    config = DescentConfig(rate=0.1, end_rate=0.001)
    steps = list(descend(slope, LENS, TRUTH, lambda rgb: (0.7, rgb), focus, 3, config))
    assert len(steps) == 4
    assert slope.gradients == 3
    assert steps[0].pose is TRUTH
    assert {step.loss for step in steps} == {0.7}
    # To a smaller precision: the focus stays behind after the first step, and Adam has an epsilon.
    turns = [pose_distance(a.pose, b.pose)[0] for a, b in pairwise(steps)]
    assert np.radians(turns[0]) == pytest.approx(0.1, rel=1e-3)
    ways = [a.pose.camera_from_world @ np.append(b.pose.position_in_world, 1) for a, b in pairwise(steps)]
    assert ways[0][2] == pytest.approx(-0.2, rel=1e-3)
    straight = Slope(np.array([0, 0, 0, 0, 0, 3.0]))
    steps = list(descend(straight, LENS, TRUTH, lambda rgb: (0.7, rgb), focus, 3, config))
    ways = [a.pose.camera_from_world @ np.append(b.pose.position_in_world, 1) for a, b in pairwise(steps)]
    assert [way[2] for way in ways] == pytest.approx([-0.2, -0.02, -0.002], rel=1e-4)


def test_options_may_be_at_their_limits() -> None:
    require_within(LENS, {"width": (512, 600), "height": (1, 384)})
    for limits in ({"width": (513, 600)}, {"height": (1, 383)}):
        with pytest.raises(InvalidOptions, match="must lie in") as caught:
            require_within(LENS, limits)
        assert caught.value.where == next(iter(limits))


def view_at(pose: Pose, points: np.ndarray) -> View:
    nothing = Features(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros((0, 4), np.float32))
    return View(Camera(LENS, pose), nothing, points.astype(np.float32))


def test_poses_near_views_are_the_views_own_without_spread() -> None:
    """Views that show nothing, or score less than half of the best, are not drawn from."""
    target = np.array([[0.2, 0.1, -0.1]])
    other = look_at(np.array([-3.0, 1.0, 0.5]), target[0], np.array([0.0, 0.0, 1.0]))
    here = look_at(TRUTH.position_in_world, target[0], np.array([0.0, 0.0, 1.0]))
    views = [view_at(other, np.zeros((0, 3))), view_at(here, target), view_at(other, target)]
    exact = NearViewConfig(approach=(0.0, 0.0), lateral_share=0.0, roll_rad=0.0)
    for roll in (0.0, 0.3):
        poses = poses_near_views(views, np.array([9.0, 1.0, 0.49]), roll, 20, np.random.default_rng(0), exact)
        assert len(poses) == 20
        expected = moved(here, np.array([0, 0, roll, 0, 0, 0]))
        assert all(np.allclose(p.world_from_camera, expected.world_from_camera, atol=1e-6) for p in poses)
    both = poses_near_views(views, np.array([9.0, 1.0, 0.99]), 0.0, 20, np.random.default_rng(0), exact)
    assert {bool(np.allclose(p.position_in_world, here.position_in_world, atol=1e-6)) for p in both} == {True, False}


def test_poses_near_views_approach_their_target_by_a_share_of_the_way() -> None:
    target = np.array([[0.0, 0.0, 0.0]])
    here = look_at(np.array([4.0, 0.0, 0.0]), target[0], np.array([0.0, 0.0, 1.0]))
    config = NearViewConfig(approach=(-0.5, 0.25), lateral_share=0.0)
    poses = poses_near_views([view_at(here, target)], np.ones(1), 0.0, 200, np.random.default_rng(0), config)
    distances = [float(pose.position_in_world[0]) for pose in poses]
    assert 3.0 <= min(distances) < 3.1
    assert 5.9 < max(distances) <= 6.0


@pytest.mark.parametrize("distance", [0.5, 4.0])
def test_poses_near_views_stand_aside_in_proportion_to_the_distance(distance: float) -> None:
    here = look_at(np.array([distance, 0.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    config = NearViewConfig(approach=(0.0, 0.0), lateral_share=0.1)
    view = view_at(here, np.zeros((1, 3)))
    poses = poses_near_views([view], np.ones(1), 0.0, 400, np.random.default_rng(0), config)
    aside = np.array([pose.position_in_world for pose in poses]) - here.position_in_world
    # Of 400 samples a standard deviation is known to 4 %.
    assert aside.std(axis=0) == pytest.approx(3 * [0.1 * distance], rel=0.15)
    # They look at the target still.
    off_axis = [np.cross(pose.axis_in_world, pose.position_in_world) for pose in poses]
    assert np.abs(off_axis).max() < 1e-9


def test_hypotheses_without_range_are_their_parents_in_turn() -> None:
    other = moved(TRUTH, np.array([0.1, 0, 0, 0, 0.2, 0]))
    poses = around([TRUTH, other], FOCUS, 0.0, 0.0, 5, np.random.default_rng(0))
    for pose, parent in zip(poses, [TRUTH, other, TRUTH, other, TRUTH], strict=True):
        assert np.allclose(pose.world_from_camera, parent.world_from_camera, atol=1e-12)


@pytest.mark.parametrize(("share", "kept"), [(0.45, [1]), (0.55, [1, 3]), (0.85, [1, 2, 3]), (1.0, [0, 1, 2, 3])])
def test_pruning_keeps_the_fewest_gaussians_with_the_share(share: float, kept: list[int]) -> None:
    means = np.arange(12, dtype=np.float32).reshape(4, 3)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (4, 1))
    scene = GaussianScene(
        means, quats, np.ones((4, 3)), np.ones(4), np.zeros((4, 1, 3)), SceneInfo("four", "four", "0", "ply")
    )
    found = prune(scene, np.array([1.0, 5.0, 1.5, 2.5]), PruningConfig(kept_share=share))
    assert np.array_equal(found.means, means[kept])


def test_a_match_loss_has_no_part_for_points_behind() -> None:
    found = matches()
    behind = Correspondences(
        np.concatenate([found.photo_px, found.photo_px[:1]]),
        np.concatenate([found.view_px, found.view_px[:1]]),
        np.concatenate([found.points_in_world, 2 * TRUTH.position_in_world[None].astype(np.float32)]),
    )
    pose = moved(TRUTH, np.array([0.05, 0, 0, 0, 0.1, 0]))
    assert match_loss(behind, LENS, pose)[0] == match_loss(found, LENS, pose)[0]
    away = moved(TRUTH, np.array([0, np.pi, 0, 0, 0, 0]))
    assert match_loss(found, LENS, away)[0] == 0
    assert np.all(match_loss(found, LENS, away)[1] == 0)
