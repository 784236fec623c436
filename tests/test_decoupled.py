"""The parts of the supplement's method against planted poses and finite differences."""

import numpy as np
import pytest

from service.errors import UnknownName
from service.geometry import look_at, pose_distance, project, so3_exp, transformed
from service.pose.absolute_pose import decoupled
from service.pose.absolute_pose.decoupled import MatchedPoints, least_squares_solve
from service.pose.descent.contribution_pruning import contributions, prune
from service.pose.descent.decoupled_gradient import angle_loss, gradient_solve, length_loss
from service.pose.descent.hypotheses import around, even_points
from service.pose.descent.losses import LOSSES, LossConfig, loss_against
from service.pose.features.scene_focus import Focus, focus_of_scene
from service.render import RASTERIZERS
from service.types import Camera, GaussianScene, Intrinsics, Pose, SceneInfo

LENS = Intrinsics(512, 384, 500.0, 500.0, 256.0, 192.0)
CENTRE = np.array([0.3, -0.2, 0.5])
TRUTH = look_at(CENTRE + np.array([3.5, 1.5, 1.2]), CENTRE, np.array([0.0, 0.0, 1.0]))
FOCUS = Focus(CENTRE, 4.0, False)


def planted(outliers: float = 0.0, seed: int = 0) -> MatchedPoints:
    """Points about the centre, seen from TRUTH with half a pixel of noise."""
    rng = np.random.default_rng(seed)
    points = CENTRE + rng.uniform(-0.8, 0.8, (150, 3))
    px = project(transformed(TRUTH.camera_from_world, points), LENS) + rng.normal(0, 0.5, (150, 2))
    wrong = rng.uniform(size=150) < outliers
    px[wrong] = rng.uniform([0, 0], [512, 384], (int(wrong.sum()), 2))
    return MatchedPoints(px, points, LENS, CENTRE)


def started(degrees: float, seed: int) -> Pose:
    axis = np.random.default_rng(seed).normal(size=3)
    turn = so3_exp(np.radians(degrees) * axis / np.linalg.norm(axis))
    matrix = TRUTH.world_from_camera.copy()
    matrix[:3, :3] = turn @ matrix[:3, :3]
    matrix[:3, 3] = CENTRE + turn @ (matrix[:3, 3] - CENTRE) + 0.2 * axis / np.linalg.norm(axis)
    return Pose(matrix)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("outliers", [0.0, 0.4])
def test_least_squares_returns_from_30_degrees(seed: int, outliers: float) -> None:
    matched, pose = planted(outliers, seed), started(30, seed)
    for _ in range(3):
        solved = least_squares_solve(matched, pose)
        pose = solved.pose
    angle, distance = pose_distance(pose, TRUTH)
    assert angle < 0.25  # seen: up to 0.12 degrees, 0.008; PnP has 0.09, 0.006 on the matches without outliers
    assert distance < 0.015
    assert solved.num_inliers > 0.9 * (1 - outliers) * 150
    assert solved.num_inliers <= 1.1 * (1 - outliers) * 150


def test_gradient_solver_returns_from_a_few_degrees() -> None:
    """On clean matches; it is the fragile one."""
    matched, pose = planted(), started(6, 1)
    for number in range(20):
        pose = gradient_solve(matched, pose, number).pose
    angle, distance = pose_distance(pose, TRUTH)
    begun, _ = pose_distance(started(6, 1), TRUTH)
    assert begun == pytest.approx(6)
    assert angle < 2
    assert distance < 0.15


def test_the_two_gradients_are_decoupled_and_right() -> None:
    """Against central differences. The angles drive the turn alone, the lengths the shift alone."""
    matched, pose = planted(0.2), started(8, 2)
    weights = np.random.default_rng(1).uniform(0.5, 1, 150)
    by_turn, by_shift = np.empty(3), np.empty(3)
    for i in range(3):
        step = 1e-6 * np.eye(3)[i]
        ahead, back = (decoupled.rotate_about(pose, CENTRE, sign * step) for sign in (1, -1))
        by_turn[i] = (angle_loss(matched, ahead, weights)[0] - angle_loss(matched, back, weights)[0]) / 2e-6
        ahead, back = (decoupled.translate_in_camera(pose, sign * step) for sign in (1, -1))
        by_shift[i] = (length_loss(matched, ahead, weights)[0] - length_loss(matched, back, weights)[0]) / 2e-6
    assert np.allclose(angle_loss(matched, pose, weights)[1], by_turn, rtol=1e-4, atol=1e-7)
    assert np.allclose(length_loss(matched, pose, weights)[1], by_shift, rtol=1e-4, atol=1e-7)
    # What a solver does with a gradient: turning leaves the centre where it is seen, shifting leaves the axes.
    turned, moved = decoupled.rotate_about(pose, CENTRE, by_turn), decoupled.translate_in_camera(pose, by_shift)
    seen = [transformed(p.camera_from_world, CENTRE[None]) for p in (pose, turned)]
    assert np.allclose(*seen, atol=1e-9)
    assert np.allclose(moved.world_from_camera[:3, :3], pose.world_from_camera[:3, :3])


def test_a_common_shift_of_all_matches_turns_nothing() -> None:
    """Parallel vectors are translation: neither solver's rotation may see them."""
    matched = planted()
    vectors, turning, _ = decoupled.linearize_matches(matched, TRUTH)
    parallel = np.tile([9.0, -4.0], (150, 1))
    turn = decoupled._centred_step(turning, parallel, np.ones(150))
    assert np.abs(turn).max() < 1e-9
    assert np.abs(vectors).max() < 3


def test_hypotheses_reach_the_truth_of_every_start_in_their_box() -> None:
    """Undoing the start's own motion is one of the motions in the box."""
    rng = np.random.default_rng(0)
    angles, shift = np.radians(rng.uniform(30, 60, 3)), rng.uniform(0.5, 1.0, 3)
    rotation = np.eye(3)
    for axis in range(3):
        rotation = so3_exp(angles[axis] * np.eye(3)[axis]) @ rotation
    matrix = np.eye(4)
    matrix[:3, :3] = rotation @ TRUTH.world_from_camera[:3, :3]
    matrix[:3, 3] = rotation @ (TRUTH.position_in_world - CENTRE) + CENTRE + shift
    near = around([Pose(matrix)], FOCUS, 60, 0.25, 4000, rng)
    assert min(pose_distance(pose, TRUTH)[0] for pose in near) < 12
    assert pose_distance(Pose(matrix), TRUTH)[0] > 60


def test_even_points_fill_the_box_better_than_chance() -> None:
    points = even_points(64, 2, np.random.default_rng(0))
    counts, _, _ = np.histogram2d(*points.T, bins=4, range=[[-1, 1], [-1, 1]])
    assert counts.min() >= 2  # chance leaves a cell with none or one in two of three draws
    assert np.abs(points).max() <= 1


def ball(count: int = 3000) -> GaussianScene:
    """Opaque coloured Gaussians on a sphere about CENTRE, and as many hidden inside it."""
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(2 * count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = np.where(np.arange(2 * count) < count, 0.8, 0.4)[:, None]
    quats = np.tile([1.0, 0, 0, 0], (2 * count, 1))
    colours = rng.normal(size=(2 * count, 1, 3))
    info = SceneInfo("ball", "ball", "0", "ply", training_focal_px=250.0)
    return GaussianScene(
        CENTRE + radius * directions, quats, np.full((2 * count, 3), 0.04), np.full(2 * count, 0.99), colours, info
    )


def test_pruning_keeps_what_is_seen() -> None:
    scene = ball()
    rasterizer = RASTERIZERS.load("cpu").create(scene)
    small = LENS.resized(128, 96)
    poses = around([TRUTH], FOCUS, 180, 0, 12, np.random.default_rng(0))
    found = contributions(scene, rasterizer, [Camera(small, pose) for pose in poses])
    level = prune(scene, found)
    hidden = np.linalg.norm(level.means - CENTRE, axis=1) < 0.6
    assert hidden.mean() < 0.05
    assert level.count < 0.55 * scene.count
    camera = Camera(small, TRUTH)
    before, after = (r.render([camera])[0].rgb for r in (rasterizer, RASTERIZERS.load("cpu").create(level)))
    assert np.sqrt(np.mean((before - after) ** 2)) < 0.03
    middle = focus_of_scene(scene, rasterizer).point_in_world  # no cameras: the middle of the Gaussians
    assert np.linalg.norm(middle - CENTRE) < 0.05


class TestLosses:
    PHOTO = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)

    @pytest.mark.parametrize("name", LOSSES)
    def test_gradient_is_the_difference_quotient(self, name: str) -> None:
        rng = np.random.default_rng(1)
        render = rng.uniform(0.05, 0.95, self.PHOTO.shape).astype(np.float32)
        loss = loss_against(name, self.PHOTO)
        _, gradient = loss(render)
        assert gradient.dtype == np.float32
        held = (render.astype(np.float64) ** 2 + 0.01) if name == "relative" else None
        along = rng.normal(size=render.shape)
        step = 1e-3
        if held is None:
            values = [loss((render + sign * step * along).astype(np.float32))[0] for sign in (1, -1)]
        else:  # its denominator is held constant
            target = self.PHOTO / 255.0
            values = [float(np.mean((render + sign * step * along - target) ** 2 / held)) for sign in (1, -1)]
        expected = (values[0] - values[1]) / (2 * step)
        # l1 has kinks: some of 9216 values cross zero within the step. The others: 2e-4 seen, of float32.
        assert float(np.sum(gradient * along)) == pytest.approx(expected, rel=0.05 if name == "l1" else 5e-3)

    @pytest.mark.parametrize("name", LOSSES)
    def test_nothing_is_lost_on_the_photo_itself(self, name: str) -> None:
        value, gradient = loss_against(name, self.PHOTO)(self.PHOTO.astype(np.float32) / np.float32(255))
        assert value == 0
        assert np.all(gradient == 0)

    @pytest.mark.parametrize("name", LOSSES)
    def test_what_is_unknown_has_no_part(self, name: str) -> None:
        rng = np.random.default_rng(2)
        known = np.zeros(self.PHOTO.shape[:2], bool)
        known[:30] = True
        loss = loss_against(name, self.PHOTO, known)
        render = rng.uniform(0, 1, self.PHOTO.shape).astype(np.float32)
        other = render.copy()
        other[30:] = rng.uniform(0, 1, other[30:].shape)
        (a, by_a), (b, by_b) = loss(render), loss(other)
        assert a == b > 0
        assert np.array_equal(by_a, by_b)
        assert np.all(by_a[30:] == 0)
        assert np.any(by_a[:30] != 0)

    def test_weights_by_hand(self) -> None:
        """A difference of 0.1 everywhere on a photo with one bright square: its features and corners are known."""
        photo = np.zeros((200, 200, 3), np.uint8)
        photo[80:120, 80:120] = 255
        render = photo.astype(np.float32) / 255 + np.float32(0.1)
        values = {name: loss_against(name, photo)(render)[0] for name in LOSSES}
        assert values["l1"] == pytest.approx(0.1, rel=1e-5)
        assert values["l2"] == pytest.approx(0.01, rel=1e-5)
        assert values["feature"] == pytest.approx(0.01 * 1.7, rel=1e-4)
        # Four corners, each 13 x 13 (51 px at 800 are 12.75 at 200): 7.5e-5 times the sum over three channels.
        assert values["corner"] == pytest.approx(0.01 + 7.5e-5 * 0.01 * 4 * 13 * 13 * 3, rel=1e-3)
        # Blurred with sigma 1.25; only the border, which sees zeros outside, lies below 0.1.
        assert 0.01 * 1.8 * 0.97 < values["blur"] < 0.01 * 1.8

    @pytest.mark.parametrize(("contrast", "squares"), [(0.08, 1), (0.12, 2)])
    def test_corners_of_a_hundredth_of_the_best_ones_response_count(self, contrast: float, squares: int) -> None:
        """The response is quadratic in contrast: 0.0064 and 0.0144 of the best corner's."""
        photo = np.zeros((200, 200, 3), np.uint8)
        photo[20:80, 20:80], photo[120:180, 120:180] = 255, round(contrast * 255)
        value, _ = loss_against("corner", photo)(photo.astype(np.float32) / 255 + np.float32(0.1))
        assert value == pytest.approx(0.01 + 7.5e-5 * 0.01 * 4 * squares * 13 * 13 * 3, rel=1e-3)

    @pytest.mark.parametrize(("side", "corners"), [(16, 4), (8, 1)])
    def test_corners_nearer_than_10_px_to_another_do_not_count(self, side: int, corners: int) -> None:
        photo = np.zeros((200, 200, 3), np.uint8)
        photo[90 : 90 + side, 90 : 90 + side] = 255
        value, _ = loss_against("corner", photo)(photo.astype(np.float32) / 255 + np.float32(0.1))
        assert value == pytest.approx(0.01 + 7.5e-5 * 0.01 * corners * 13 * 13 * 3, rel=1e-3)

    @pytest.mark.parametrize(("columns", "counted"), [(12, 4 * 48), (13, 200)])
    def test_of_more_than_200_corners_the_best_count(self, columns: int, counted: int) -> None:
        """Squares of 30 px, in rows 60 px apart; no two corners share a pixel of their kernels (13 px at 200)."""
        photo = np.zeros((4 * 60, columns * 60, 3), np.uint8)
        for x, y in np.ndindex(columns, 4):
            photo[60 * y + 15 : 60 * y + 45, 60 * x + 15 : 60 * x + 45] = 255
        config = LossConfig(reference_px=4 * columns * 60)
        value, _ = loss_against("corner", photo, config=config)(photo.astype(np.float32) / 255 + np.float32(0.1))
        assert value == pytest.approx(0.01 + 7.5e-5 * 0.01 * counted * 13 * 13 * 3, rel=1e-3)

    def test_an_unknown_one_is_refused(self) -> None:
        with pytest.raises(UnknownName, match="l1, l2, relative, feature, corner, blur"):
            loss_against("l3", self.PHOTO)
