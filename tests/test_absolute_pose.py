"""The thresholds of absolute poses: counts and bounds by hand, on planted poses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from service.geometry import look_at, moved, pose_distance, project, se3_log, so3_log, transformed
from service.pose.absolute_pose import unknown_lens
from service.pose.absolute_pose.decoupled import (
    BEHIND_PX,
    DecoupledConfig,
    DecoupledSolution,
    MatchedPoints,
    _next_scale,
    geman_mcclure_weights,
    least_squares_solve,
    linearize_matches,
    solution_at,
)
from service.pose.absolute_pose.lens_prior import BOUNDS, correction_vector, prior_cost, prior_precision, stepped
from service.pose.absolute_pose.pnp import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from service.pose.absolute_pose.prior_region import PriorRegionConfig, distance_outside, inside_prior, widened_prior
from service.pose.absolute_pose.unknown_lens import (
    LensSearchConfig,
    absolute_pose_unknown_lens,
    linearize_reprojection,
)
from service.types import (
    NO_CORRECTION,
    BoxPrior,
    GaussianPosePrior,
    Intrinsics,
    IntrinsicsCorrection,
    LensPrior,
    Pose,
)

CAMERA = Intrinsics(512, 384, 500.0, 500.0, 256.0, 192.0)
CENTRE = np.array([0.2, -0.1, 0.3])
TRUTH = look_at(CENTRE + np.array([3.5, 1.5, 1.2]), CENTRE, np.array([0.0, 0.0, 1.0]))


def points_and_pixels(count: int = 50, camera: Intrinsics = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    points = CENTRE + np.random.default_rng(0).uniform(-0.8, 0.8, (count, 3))
    return points, project(transformed(TRUTH.camera_from_world, points), camera)


def matched_points(offset_px: float = 0.0) -> MatchedPoints:
    points, px = points_and_pixels()
    return MatchedPoints(px + offset_px, points, CAMERA, CENTRE)


def at(position: list[float]) -> Pose:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return Pose(matrix)


# --- PnP-RANSAC


@pytest.mark.parametrize(("least", "found"), [(50, True), (51, False)])
def test_a_pose_needs_the_least_number_of_points(least: int, found: bool) -> None:
    points, px = points_and_pixels()
    pose = estimate_absolute_pose(px, points, CAMERA, 2.0, 500, AbsolutePoseConfig(min_points=least))
    assert (pose is not None) == found


def test_a_pose_needs_the_least_number_of_inliers() -> None:
    points, px = points_and_pixels()
    px[:10] += 40  # ten wrong matches, which leave 40
    assert estimate_absolute_pose(px, points, CAMERA, 2.0, 500, AbsolutePoseConfig(min_points=40)) is not None
    assert estimate_absolute_pose(px, points, CAMERA, 2.0, 500, AbsolutePoseConfig(min_points=41)) is None


# --- unknown lens


def test_too_few_inliers_are_not_refined() -> None:
    """The answer then has one of the assumed focal lengths; refined, it is the one that was planted."""
    factor = 1.07  # between two steps, 1 and 1.49
    points, px = points_and_pixels(camera=CAMERA.corrected(IntrinsicsCorrection(factor)))
    prior = LensPrior(0.5)
    refined = absolute_pose_unknown_lens(px, points, CAMERA, prior, 8.0, LensSearchConfig(min_inliers=50))
    sample = absolute_pose_unknown_lens(px, points, CAMERA, prior, 8.0, LensSearchConfig(min_inliers=51))
    assert refined is not None
    assert sample is not None
    assert sample.num_inliers == refined.num_inliers == 50
    assert refined.correction.focal_factor == pytest.approx(factor, rel=1e-3)
    steps = np.log(sample.correction.focal_factor) / 0.4
    assert steps == pytest.approx(round(steps), abs=1e-9)


def test_assumed_focal_lengths_end_two_scales_below_and_four_above() -> None:
    """Unrefined answers on both sides; one step is tried in any case."""
    for factor in (0.2, 5.0):
        points, px = points_and_pixels(camera=CAMERA.corrected(IntrinsicsCorrection(factor)))
        config = LensSearchConfig(min_inliers=1000, error_factor=100)
        for scale, first, last in ((0.45, -2, 4), (0.06, -1, 1)):  # 2 and 4 * 0.45 / 0.4 = 2.25 and 4.5
            found = absolute_pose_unknown_lens(px, points, CAMERA, LensPrior(scale), 8.0, config)
            assert found is not None
            assert 0.4 * first - 1e-9 <= np.log(found.correction.focal_factor) <= 0.4 * last + 1e-9


def test_no_other_focal_length_is_tried_once_enough_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    points, px = points_and_pixels()
    tried = []

    def counted(*args: Any, **kwargs: Any) -> AbsolutePose | None:
        tried.append(args[2].fx)
        return estimate_absolute_pose(*args, **kwargs)

    monkeypatch.setattr(unknown_lens, "estimate_absolute_pose", counted)
    for sufficient, steps in ((50, 1), (51, 8)):
        tried.clear()
        config = LensSearchConfig(sufficient_inliers=sufficient)
        absolute_pose_unknown_lens(px, points, CAMERA, LensPrior(0.5), 8.0, config)
        assert len(tried) == steps
        assert tried[0] == CAMERA.fx


def test_a_crop_off_centre_is_told_by_its_matches() -> None:
    """The principal point is a fifth of the long side away: thirty times the prior's scale."""
    crop = IntrinsicsCorrection(1.0, 0.2, -0.12)
    points = CENTRE + np.random.default_rng(0).uniform(-2.0, 2.0, (100, 3))
    px = project(transformed(TRUTH.camera_from_world, points), CAMERA.corrected(crop))
    found = absolute_pose_unknown_lens(px, points, CAMERA, LensPrior(0.06), 4.0)
    assert found is not None
    assert np.allclose([found.correction.shift_x, found.correction.shift_y], [0.2, -0.12], atol=0.01)
    assert pose_distance(found.pose, TRUTH)[0] < 1.0


def test_refined_inliers_are_those_within_the_bound() -> None:
    points, px = points_and_pixels()
    px[0, 0] += 4.0
    for bound, count in ((3.5, 49), (5.0, 50)):
        found = absolute_pose_unknown_lens(px, points, CAMERA, LensPrior(0.05), bound)
        assert found is not None
        assert found.num_inliers == count


def test_points_behind_the_camera_have_no_part_in_a_refinement() -> None:
    points, px = points_and_pixels(3)
    points[1] = TRUTH.position_in_world - TRUTH.axis_in_world
    jacobian, residual, ahead = linearize_reprojection(px + 1.0, points, CAMERA, TRUTH, NO_CORRECTION)
    assert ahead.tolist() == [True, False, True]
    assert np.all(jacobian[1] == 0)
    assert np.all(residual[1] == 0)
    assert np.allclose(residual[[0, 2]], 1.0)


def test_the_priors_weights_are_the_slopes_of_its_cost() -> None:
    """Of a component d: half the cost's derivative is its weight times d; heavy tails but for the distortion."""
    prior = LensPrior(0.1, k1_sigma=0.05, principal_point_scale=0.02)
    assert np.allclose(prior_precision(prior, NO_CORRECTION), [100, 400, 2500, 2500])
    at_correction = stepped(NO_CORRECTION, np.array([0.2, 0.1, 0.01, -0.1]))
    weights, vector = prior_precision(prior, at_correction), correction_vector(at_correction)
    assert weights[0] < 100
    assert weights[1] == pytest.approx(400)
    for i in range(4):
        step = np.eye(4)[i] * 1e-6
        rise = prior_cost(prior, stepped(at_correction, step)) - prior_cost(prior, stepped(at_correction, -step))
        assert rise / 4e-6 == pytest.approx(weights[i] * vector[i], rel=1e-4)


def test_a_correction_ends_at_its_bounds() -> None:
    far = stepped(NO_CORRECTION, np.array([9.0, -9.0, 9.0, -9.0]))
    assert np.allclose(correction_vector(far), BOUNDS.vector * [1, -1, 1, -1])


# --- prior regions


def test_a_box_holds_its_borders() -> None:
    box = BoxPrior(np.zeros(3), np.array([1.0, 2.0, 3.0]))
    assert inside_prior(box, at([1.0, 0.0, 3.0]))
    assert not inside_prior(box, at([1.0 + 1e-9, 0.0, 3.0]))
    assert not inside_prior(box, at([1.0, -1e-9, 3.0]))
    assert distance_outside(box, at([-0.3, 1.0, 3.4])) == pytest.approx(0.5)
    assert distance_outside(box, at([0.5, 0.5, 0.5])) == 0


@pytest.mark.parametrize("axis", [1, 4])
def test_a_gaussian_ends_at_its_limit_in_standard_deviations(axis: int) -> None:
    sigmas = np.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1])
    region = GaussianPosePrior(TRUTH, np.diag(sigmas**2))
    config = PriorRegionConfig(max_squared_mahalanobis=9.0)
    for count, beyond in ((2.99, 0.0), (3.01, 0.01), (5.0, 2.0)):
        pose = moved(TRUTH, count * sigmas[axis] * np.eye(6)[axis])
        assert distance_outside(region, pose, config) == pytest.approx(beyond, abs=1e-9)
        assert inside_prior(region, pose, config) == (beyond == 0)
    assert inside_prior(region, moved(TRUTH, 4.73 * sigmas[axis] * np.eye(6)[axis]))  # the root of 22.46 is 4.739
    assert not inside_prior(region, moved(TRUTH, 4.75 * sigmas[axis] * np.eye(6)[axis]))


def test_regions_grow_by_the_slack() -> None:
    box = widened_prior(BoxPrior(np.zeros(3), np.ones(3)), 4.0)
    assert isinstance(box, BoxPrior)
    assert np.allclose([box.lower_in_world, box.upper_in_world], [[-0.2] * 3, [1.2] * 3])
    gaussian = widened_prior(GaussianPosePrior(TRUTH, np.eye(6)), 4.0)
    assert isinstance(gaussian, GaussianPosePrior)
    assert np.allclose(gaussian.covariance, np.diag([1 + np.radians(3) ** 2] * 3 + [1.04] * 3))
    assert widened_prior(None, 4.0) is None


# --- decoupled solver


def test_an_inlier_weighs_at_least_a_half() -> None:
    solution = DecoupledSolution(TRUTH, np.array([1.0, 0.5, 0.4999, 0.0]))
    assert solution.inlier.tolist() == [True, True, False, False]
    assert solution.num_inliers == 2
    assert solution.support == pytest.approx(1.9999)


def test_weights_at_a_solution_are_those_at_the_agreement() -> None:
    assert geman_mcclure_weights(np.array([[0.0, 0.0], [3.0, 4.0], [30.0, 40.0]]), 5.0) == pytest.approx(
        [1, 0.25, 1 / 101**2]
    )
    solution = solution_at(matched_points(3.0), TRUTH)
    assert solution.weights == pytest.approx(np.full(50, (1 + 18 / 25) ** -2))


def test_the_scale_starts_at_the_median_and_falls_to_its_bound() -> None:
    around = np.array([[3.0, 4.0], [0.0, 1.0], [60.0, 80.0]])
    config = DecoupledConfig()
    assert _next_scale(around, np.inf, 1.0, config) == 5.0
    assert _next_scale(around, 5.0, 1.0, config) == 4.5
    assert _next_scale(around, 1.6, 1.0, config) == 1.5
    assert _next_scale(around, 1.6, 2.0, config) == 3.0


@pytest.mark.parametrize("limit", [0.05, 0.5])
def test_a_step_rotates_no_further_than_the_limit(limit: float) -> None:
    start = moved(TRUTH, np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0]))
    found = least_squares_solve(matched_points(), start, DecoupledConfig(steps=1, max_rotation_rad=limit)).pose
    rotated = np.linalg.norm(so3_log(start.world_from_camera[:3, :3].T @ found.world_from_camera[:3, :3]))
    if limit == 0.05:
        assert rotated == pytest.approx(0.05, abs=1e-9)
    else:
        assert rotated == pytest.approx(0.3, abs=0.05)


def test_more_steps_come_nearer() -> None:
    start = moved(TRUTH, np.array([0.1, -0.05, 0.3, 0.3, -0.2, 0.2]))
    errors = [
        pose_distance(least_squares_solve(matched_points(), start, DecoupledConfig(steps=steps)).pose, TRUTH)[0]
        for steps in (1, 3, 20)
    ]
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    assert errors[2] < 1e-4


def test_points_nearer_than_a_share_of_the_centres_distance_count_as_behind() -> None:
    distance = np.linalg.norm(CENTRE - TRUTH.position_in_world)
    near, nearer, behind = (
        TRUTH.position_in_world + depth * distance * TRUTH.axis_in_world for depth in (0.021, 0.019, -1)
    )
    points = np.stack([CENTRE, near, nearer, behind])
    vectors, by_rotation, by_translation = linearize_matches(
        MatchedPoints(np.full((4, 2), 100.0), points, CAMERA, CENTRE), TRUTH
    )
    assert np.all(vectors[2:] == BEHIND_PX)
    assert np.all(by_rotation[2:] == 0)
    assert np.all(by_translation[2:] == 0)
    assert np.all(np.abs(vectors[:2]) < 1000)
    assert np.all(np.abs(by_translation[:2]).sum((1, 2)) > 0)
    assert np.allclose(by_rotation[0], 0, atol=1e-9)  # a rotation about the centre leaves it where it is


def test_twists_act_on_the_right() -> None:
    """The convention of the priors, and of the covariances."""
    twist = np.array([0.01, -0.02, 0.03, 0.1, 0.2, -0.1])
    assert np.allclose(se3_log(TRUTH.camera_from_world @ moved(TRUTH, twist).world_from_camera), twist)
