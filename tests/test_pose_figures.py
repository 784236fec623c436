"""Figures of the steps of pose estimation that whole searches leave open, beside sums by hand and numpy's inverses."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.geometry import look_at, moved, project, transformed
from service.interfaces import Frame
from service.pose.absolute_pose.lens_prior import prior_precision
from service.pose.absolute_pose.normal_equations import normal_equations
from service.pose.features.scene_focus import centre_depth, focus_of
from service.pose.refinement import uncertainty
from service.pose.refinement.refinement_config import LensErrorConfig, LensTestConfig
from service.pose.refinement.uncertainty import PoseUncertainty
from service.pose.retrieval import floaters, free_views
from service.pose.retrieval.free_views import FREE_VIEWS
from service.pose.retrieval.view_placement import cell_ids
from service.types import UNKNOWN_PRINCIPAL_POINT, Camera, Intrinsics, IntrinsicsCorrection, LensPrior, Pose

HERE = Pose(np.eye(4))
LENS = Intrinsics(640, 480, 500.0, 450.0, 310.0, 250.0)
PRIOR = LensPrior(0.1, 0.05, 0.03)
OFF = IntrinsicsCorrection(1.3, 0.02, -0.05, 0.07)


# ------------------------------------------------------------------ normal equations of a pose and a lens


def test_normal_equations_are_the_weighed_sums_over_matches() -> None:
    rng = np.random.default_rng(4)
    jacobian, residual = rng.standard_normal((5, 2, 10)), 3 * rng.standard_normal((5, 2))
    ahead = np.array([True, True, False, True, True])
    noise, scale = 1.7, 2.3
    found = normal_equations(jacobian, residual, ahead, noise, scale, PRIOR, OFF)
    vector = np.array([np.log(1.3), 0.07, 0.02, -0.05])
    scales = np.array([0.1, 0.05, 0.03, 0.03])
    precision = 1 / (scales**2 + np.array([vector[0], 0, vector[2], vector[3]]) ** 2)
    hessian, rhs = np.diag(np.r_[np.zeros(6), precision]), -np.r_[np.zeros(6), precision * vector]
    cost = np.log1p((vector[[0, 2, 3]] / scales[[0, 2, 3]]) ** 2).sum() + (0.07 / 0.05) ** 2
    for i in range(5):
        deviations = np.hypot(*residual[i]) / noise if ahead[i] else 100 * scale
        cost += scale**2 * np.log(1 + (deviations / scale) ** 2)
        weight = 1 / (1 + (deviations / scale) ** 2) / noise**2 if ahead[i] else 0.0
        hessian += weight * jacobian[i].T @ jacobian[i]
        rhs += weight * jacobian[i].T @ residual[i]
        assert found.weight[i] == pytest.approx(weight)
        assert found.error[i] == pytest.approx(deviations if ahead[i] else np.inf)
    assert found.cost == pytest.approx(cost)
    assert found.hessian == pytest.approx(hessian)
    assert found.rhs == pytest.approx(rhs)


# ------------------------------------------------------------------ uncertainty with an estimated lens


def information(size: int = 16) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    half = rng.standard_normal((size, 50))
    return 40 * half @ half.T, 30 * rng.standard_normal(size)


def test_a_cropped_photos_pose_has_a_wide_prior_on_the_principal_point() -> None:
    hessian, score = information()
    wide = LensPrior(0.1, 0.05, 0.5)
    error, scale = LensErrorConfig(crop_scale=0.2), 0.6
    found = uncertainty._pose_if_cropped(hessian, score, scale, wide, OFF, error)
    assert found is not None
    vector = np.array([np.log(1.3), 0.07, 0.02, -0.05])
    precision = np.array([1 / (0.1**2 + vector[0] ** 2), 1 / 0.05**2, 25, 25])
    total, pull = hessian[:14, :14].copy(), score[:14].copy()
    total[10:, 10:] += scale * np.diag(precision)
    pull[10:] -= scale * precision * vector
    inverse = np.linalg.inv(total)
    assert found.covariance == pytest.approx(scale * inverse[:6, :6])
    assert found.step == pytest.approx((inverse @ pull)[:6])
    assert found.significance == pytest.approx(pull @ inverse @ pull / scale)
    # From a good source, or where nothing determines it, there is none.
    known = replace(wide, principal_point_scale=0.999 * UNKNOWN_PRINCIPAL_POINT)
    assert uncertainty._pose_if_cropped(hessian, score, scale, known, OFF, error) is None
    just = replace(wide, principal_point_scale=UNKNOWN_PRINCIPAL_POINT)
    assert uncertainty._pose_if_cropped(hessian, score, scale, just, OFF, error) is not None
    hessian[2] = hessian[:, 2] = 0.0
    assert uncertainty._pose_if_cropped(hessian, score, scale, wide, OFF, error) is None


def test_the_focal_step_has_distortion_and_pose_free() -> None:
    hessian, score = information()
    assert uncertainty._focal_step(hessian, score) == pytest.approx(np.linalg.solve(hessian[:12, :12], score[:12])[10])
    hessian[11] = hessian[:, 11] = 0.0
    assert uncertainty._focal_step(hessian, score) == 0.0


def test_the_lens_priors_information_is_in_units_of_the_pixels_variance() -> None:
    hessian, _ = information()
    added = uncertainty._with_prior(hessian, 0.6, PRIOR, OFF) - hessian
    expected = np.zeros((16, 16))
    expected[range(10, 14), range(10, 14)] = 0.6 * prior_precision(PRIOR, OFF)
    assert added == pytest.approx(expected, abs=1e-9)


def test_errors_of_the_lens_move_the_pose_along_up_to_the_prior() -> None:
    half = np.random.default_rng(6).standard_normal((10, 30))
    covariance = 0.01 * half @ half.T
    errors = np.array([0.3, 0.2, 0.9, 0.1])
    prior_variance = covariance.diagonal()[6:] + np.array([0.5, 0.01, 0.4, -0.3])
    found = uncertainty._with_lens_error(covariance, errors, prior_variance)
    added = np.diag([0.09, 0.01, 0.4, 0.0])  # the second and third are limited, the last has no room
    follows = covariance[:, 6:] @ np.linalg.inv(covariance[6:, 6:])
    assert found == pytest.approx(covariance + follows @ added @ follows.T)
    # The intrinsics themselves become as uncertain as that.
    assert found[6:, 6:] - covariance[6:, 6:] == pytest.approx(added, abs=1e-9)


def test_an_untested_lens_adds_to_the_pose_unless_the_photo_tells_it() -> None:
    hessian, _ = information()
    level: Any = SimpleNamespace(points=np.float32([[0, 0, 0], [0, 0, 0], [3.0, 4.0, 9.0]]))
    config, scale = LensTestConfig(untestable_share=0.05), 0.6
    expected = np.linalg.inv(uncertainty._with_prior(hessian, scale, config.untested, IntrinsicsCorrection())[:14, :14])

    def found(sigma: float | None):
        free = None if sigma is None else np.diag(np.r_[np.full(3, 9.0), np.full(3, sigma**2 / 3 / scale), np.ones(8)])
        return uncertainty._covariance_of_untested_lens(level, hessian, scale, free, config)

    # A twentieth of the median depth of 4.
    assert found(0.199) is None
    for undetermined in (0.201, None):
        assert found(undetermined) == pytest.approx(scale * expected[:6, :6])


def test_a_turning_cameras_covariance_is_added_to_all_others() -> None:
    added = np.arange(36.0).reshape(6, 6)
    found = uncertainty._with_shutter(
        PoseUncertainty(np.zeros(6), 2 * np.ones((10, 10)), untested_lens=np.eye(6)), added
    )
    assert found.covariance[:6, :6] == pytest.approx(2 + added)
    assert (found.covariance[6:] == 2).all()
    assert found.given_lens is None
    assert found.untested_lens == pytest.approx(np.eye(6) + added)
    found = uncertainty._with_shutter(PoseUncertainty(np.zeros(6), np.ones((6, 6)), 3 * np.eye(6)), added)
    assert found.given_lens == pytest.approx(3 * np.eye(6) + added)
    assert found.untested_lens is None


# ------------------------------------------------------------------ views beside the index


def test_a_cell_is_a_voxel_of_the_octave_of_its_distance_a_direction_and_that_octave() -> None:
    # Seen from (1, 1, 1): at 3 (octave 2, voxels of 1.6) straight ahead, and at 5 (voxels of 1.6, too) aslant.
    points = np.array([[1.0, 1, 4], [5.0, 1, 4], [5.1, 1, 4]])
    pose = moved(HERE, np.array([0, 0, 0, 1.0, 1, 1]))
    rows = [[0, 0, 2, 0, 0, 1, 2], [3, 0, 2, 1, 0, 1, 2]]
    expected = np.unique(cell_ids(np.array(rows, np.int64)))
    assert free_views._cells(points, pose, FREE_VIEWS).tolist() == expected.tolist()
    # 1.4 and 1.42 lie on two sides of the octave's middle; voxels have sides of 0.4 and 0.8.
    near, far = (free_views._cells(np.array([[1.0, 1, 1 + z]]), pose, FREE_VIEWS) for z in (1.4, 1.42))
    assert near.tolist() == cell_ids(np.array([[2, 2, 5, 0, 0, 1, 0]], np.int64)).tolist()
    assert far.tolist() == cell_ids(np.array([[1, 1, 3, 0, 0, 1, 1]], np.int64)).tolist()


def test_a_candidate_needs_half_of_its_image_on_one_surface() -> None:
    camera = Camera(Intrinsics(16, 12, 20.0, 20.0, 8.0, 6.0), moved(HERE, np.array([0, 0, 0, 0.0, 0, -1])))
    depth = np.full((12, 16), 3.0, np.float32)
    for hidden, seen in ((6, True), (7, False)):
        alpha = np.ones((12, 16), np.float32)
        row, column = np.mgrid[2:12:4, 2:16:4].reshape(2, -1)[:, :hidden]  # of the twelve that are looked at
        alpha[row, column] = 0.0
        frame = Frame(np.zeros((12, 16, 3), np.float32), alpha, depth, depth)
        found = free_views._cells_seen(frame, camera, 0.5, FREE_VIEWS)
        assert (found is not None) is seen
        if found is not None:
            row, column = np.mgrid[2:12:4, 2:16:4].reshape(2, -1)[:, hidden:]
            points = np.stack([3 * (column + 0.5 - 8) / 20, 3 * (row + 0.5 - 6) / 20, np.full(len(row), 2.0)], 1)
            assert found.tolist() == free_views._cells(points, camera.pose, FREE_VIEWS).tolist()


def test_candidates_stand_between_a_quarter_and_six_fifths_of_the_distance_and_turn() -> None:
    point = np.float32([[3.0, 4.0, 12.0]])
    view: Any = SimpleNamespace(points_in_world=point, camera=Camera(LENS, moved(HERE, np.array([0, 0, 0, 3.0, 0, 0]))))
    poses = free_views._candidates([view], np.random.default_rng(0), 400, FREE_VIEWS)
    rays = point[0] - np.array([pose.position_in_world for pose in poses])
    away = np.linalg.norm(rays, axis=1)
    whole = np.hypot(4, 12)
    assert 0.25 <= away.min() / whole < 0.26
    assert 1.17 < away.max() / whole <= 1.2
    # Even in the logarithm.
    assert np.median(away) / whole == pytest.approx(np.sqrt(0.25 * 1.2), rel=0.08)
    # The direction, once changed, deviates sideways from the view's by a normal variate of 0.6 over 1 + 0.6 of one.
    before = np.array([0, 4, 12]) / whole
    directions = rays / away[:, None]
    rng = np.random.default_rng(1)
    drawn = before + 0.6 * rng.standard_normal((4000, 3))
    expected = drawn @ before / np.linalg.norm(drawn, axis=1)
    assert np.median(directions @ before) == pytest.approx(np.median(expected), abs=0.03)
    # The axis deviates by a fifth from that direction; in two dimensions the median is sqrt(2 ln 2) of them.
    axes = np.array([pose.axis_in_world for pose in poses])
    tangents = np.linalg.norm(axes - (axes * directions).sum(1)[:, None] * directions, axis=1)
    assert np.median(tangents / (axes * directions).sum(1)) == pytest.approx(0.2 * np.sqrt(2 * np.log(2)), rel=0.12)
    # Upright as the view: its y axis points down.
    assert np.mean([pose.world_from_camera[1, 1] for pose in poses]) > 0.5


def test_free_views_are_chosen_until_93_hundredths_are_shown() -> None:
    def choice(cells: list[list[int]], known: list[int], limit: int = 9) -> list[int]:
        return free_views._choice(
            [np.array(row, np.int64) for row in cells], np.array(known, np.int64), limit, FREE_VIEWS
        )

    many = list(range(100))
    assert choice([], []) == []
    # 92 of 100 aren't enough, 94 are.
    assert choice([many[:92], many[92:]], []) == [0, 1]
    assert choice([many[:94], many[94:]], []) == [0]
    # What is known counts for nothing.
    assert choice([many[:94], many[94:]], many[:90]) == [1]
    assert choice([many[:90], many[80:]], many[:94]) == []
    # A cell counts as often as candidates see it: 3 cells that three see are worth 9, eight others 8.
    assert choice([[*range(8)], [50, 51, 52], [50, 51, 52], [50, 51, 52]], [], 1) == [1]
    # The second's gain falls from 6 to 3 once the first is chosen: the third is better then.
    assert choice([[0, 1, 2, 3, 4, 5, 6], [5, 6, 7, 8], [20, 21, 22]], []) == [0, 2, 1]
    assert choice([[0, 1, 2, 3, 4, 5, 6], [5, 6, 7, 8], [20, 21, 22]], [], 2) == [0, 2]


# ------------------------------------------------------------------ floaters


def test_depths_are_those_of_points_within_the_image() -> None:
    camera = Camera(LENS, moved(HERE, np.array([0.1, -0.2, 0.05, 1.0, -0.5, 0.3])))
    local = np.random.default_rng(2).uniform([-4, -4, -2], [4, 4, 5], (200, 3))
    points = transformed(camera.pose.world_from_camera, local)
    px = project(local, LENS)
    inside = (local[:, 2] > 0) & (px > 0).all(1) & (px[:, 0] < 640) & (px[:, 1] < 480)
    found = floaters._depths_in_view(points, camera)
    assert 20 < inside.sum() < 120
    assert np.isfinite(found).tolist() == inside.tolist()
    assert found[inside] == pytest.approx(local[inside, 2])
    edge = np.array([[-310 / 500, 0, 1], [330 / 500, 0, 1], [0, -250 / 450, 1], [0, 230 / 450, 1], [0, 0, 0.0]])
    assert (
        np.isfinite(floaters._depths_in_view(1.001 * edge + [0, 0, 0.002], Camera(LENS, HERE))).tolist() == [True] * 5
    )
    assert not np.isfinite(floaters._depths_in_view(edge * [1.001, 1.001, 1], Camera(LENS, HERE))).any()


def test_a_veil_is_the_optical_depth_in_front_of_the_content() -> None:
    # Content at 8 to 12 (its lower quartile is 9); floaters at 2, 6, 7 and 0.1, of which the middle ones are in front.
    content = [[0, 0, z] for z in (8.0, 9.0, 10.0, 11.0, 12.0)]
    means = np.array([*content, [0, 0, 2.0], [0, 0, 6.0], [0, 0, 7.0], [0, 0, 0.1], [9.0, 0, 6.0]], np.float32)
    scales = np.tile(np.float32([0.5, 0.2, 0.3]), (len(means), 1))
    scales[5] = [0.01, 0.02, 0.03]
    opacities = np.array([0.9] * 5 + [0.5, 0.25, 0.4, 0.4, 0.4], np.float32)
    scene: Any = SimpleNamespace(means=means, scales=scales, opacities=opacities)
    found = np.arange(len(means)) >= 5
    # The areas of Gaussians: 2 pi times the larger two scales; of the image: fx fy / (w h) over the squared depth.
    pixels = 500 * 450 / (640 * 480)
    small = 0.5 * 2 * np.pi * 0.02 * 0.03 / 2**2 * pixels
    large = 0.25 * 2 * np.pi * 0.3 * 0.5 / 6**2 * pixels
    expected = small + large
    ahead, aside = Camera(LENS, HERE), Camera(LENS, look_at(np.zeros(3), np.array([0.0, 0, -1]), np.array([0.0, 1, 0])))
    assert floaters.veil(scene, found, [ahead]) == pytest.approx(expected, rel=1e-5)
    # A camera without content counts for nothing; without any there is no veil.
    assert floaters.veil(scene, found, [ahead, aside, aside]) == pytest.approx(expected, rel=1e-5)
    assert floaters.veil(scene, found, [aside]) == 0.0
    # Each hides at most as its opacity says.
    scales[5] = 9.0
    assert floaters.veil(scene, found, [ahead]) == pytest.approx(0.5 + large, rel=1e-5)


# ------------------------------------------------------------------ the focus of a scene


def test_a_forward_facing_scene_has_its_focus_at_the_median_depth() -> None:
    cameras = [
        Camera(LENS, moved(HERE, np.array([0, turn, 0, x, 2.0, 0]))) for turn, x in ((0.1, 0.0), (0, 1), (-0.2, 5))
    ]
    depths = iter([3.0, 0.0, 5.0])
    found = focus_of(cameras, lambda camera: next(depths))
    assert found.forward_facing
    # Cameras turn where they stand, once moved: the twist's translation is along the turned way.
    places = [camera.pose.position_in_world for camera in cameras]
    ends = [
        place + 4 * np.array([np.sin(turn), 0, np.cos(turn)])
        for place, turn in zip(places, (0.1, 0, -0.2), strict=True)
    ]
    assert found.point_in_world == pytest.approx(np.mean(ends, axis=0))
    assert found.distance == pytest.approx(np.median([np.linalg.norm(p - np.mean(ends, axis=0)) for p in places]))
    nothing = focus_of(cameras, lambda camera: 0.0)
    assert nothing.point_in_world == pytest.approx(
        np.mean([camera.pose.position_in_world + camera.pose.axis_in_world for camera in cameras], axis=0)
    )


def test_the_depth_in_the_middle_is_the_median_of_eight_by_eight_pixels() -> None:
    depth = np.full((192, 256), 50.0, np.float32)
    depth[92:100, 124:132] = 0.0
    depth[92:100, 124:127] = 3.0
    depth[92:100, 127:129] = 2.0
    asked = []
    frame = SimpleNamespace(median_depth=depth)
    rasterizer: Any = SimpleNamespace(render=lambda cameras: asked.extend(cameras) or [frame])
    assert centre_depth(rasterizer, Camera(LENS, HERE)) == 3.0
    assert (asked[0].intrinsics.width, asked[0].intrinsics.height) == (256, 192)
    depth[92:100, 124:132] = 0.0
    assert centre_depth(rasterizer, Camera(LENS, HERE)) == 0.0
