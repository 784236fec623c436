"""The parts of photometric refinement by hand: pyramids, residuals, weights, normal equations, cells, limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_pose import LENS, PaintedWalls, photo_from, true_pose

from service.geometry import moved, pose_distance
from service.interfaces import Frame
from service.pose.refinement.covariance import scores_by_cell
from service.pose.refinement.gauss_newton import minimize
from service.pose.refinement.kernels import linearize, normal_equations
from service.pose.refinement.photometric import refine_photometric
from service.pose.refinement.pyramid import clip_like_photo, depth_pyramid, evened_light, intensity, occluder_depth
from service.pose.refinement.pyramid_level import NEUTRAL, PyramidLevel, RefinementState, _tukey_weights
from service.pose.refinement.refinement_config import REFINEMENT, LocalLightConfig, PyramidConfig, UncertaintyConfig
from service.pose.refinement.uncertainty import pose_uncertainty
from service.types import NO_CORRECTION, Camera, Intrinsics

SMALL = Intrinsics(40, 30, 50.0, 50.0, 20.0, 15.0)
CONFIG = PyramidConfig()


def frame_of(depth: np.ndarray, alpha: np.ndarray | None = None) -> Frame:
    depth = depth.astype(np.float32)
    alpha = np.ones_like(depth) if alpha is None else alpha.astype(np.float32)
    return Frame(np.full((*depth.shape, 3), 0.5, np.float32), alpha, depth, depth)


def flat_level(value: float, shown: float, columns: int = 38, rows: int = 28) -> PyramidLevel:
    """A wall at depth 2 without gradients, shown with one value and rendered with another; the first pixels of it."""
    render = np.full((30, 40), shown, np.float32)
    pixels = (np.arange(rows)[:, None] * 38 + np.arange(columns)).ravel()
    k = np.array([SMALL.fx, SMALL.fy, SMALL.cx, SMALL.cy])
    points, jacobian = linearize(render, np.full((30, 40), 2.0, np.float32), pixels, k)
    return PyramidLevel(np.full((30, 40), value, np.float32), pixels, points, jacobian, SMALL)


def neutral_state() -> RefinementState:
    return RefinementState(np.eye(4), NO_CORRECTION, None, NEUTRAL.copy())


# --- pyramids


def test_an_occluding_edge_has_the_near_depth_two_pixels_to_either_side() -> None:
    depth = np.full((9, 20), 5.0)
    depth[:, :10] = 2.0
    found = occluder_depth(frame_of(depth), CONFIG)
    assert np.all(found[4, :12] == 2.0)
    assert np.all(found[4, 12:] == 5.0)
    assert np.array_equal(occluder_depth(frame_of(depth), PyramidConfig(edge_px=0)), depth.astype(np.float32))


@pytest.mark.parametrize(("jump", "is_edge"), [(1.05, False), (1.07, True)])
def test_a_step_of_more_than_six_percent_is_an_edge(jump: float, is_edge: bool) -> None:
    depth = np.full((9, 20), 2.0 * jump)
    depth[:, :10] = 2.0
    found = occluder_depth(frame_of(depth), CONFIG)
    assert (found[4, 11] == 2.0) == is_edge


def test_an_outline_grows_by_two_pixels_and_half_transparent_pixels_show_nothing() -> None:
    depth, alpha = np.full((9, 20), 3.0), np.zeros((9, 20))
    alpha[:, :10], alpha[:, 10] = 1.0, 0.5
    found = occluder_depth(frame_of(depth, alpha), CONFIG)
    assert np.all(found[4, :12] == 3.0)
    assert np.all(found[4, 12:] == 0.0)


def test_evened_light_hardly_depends_on_a_gain_and_a_bias_that_change_slowly() -> None:
    image = np.random.default_rng(0).uniform(0.1, 0.9, (120, 160)).astype(np.float32)
    across = np.linspace(0, 1, 160, dtype=np.float32)
    config = LocalLightConfig(min_contrast=1e-4)
    one, other = (evened_light(i, None, config) for i in (image, (0.3 + 0.7 * across) * image + 0.2 * across))
    assert np.abs(one - 0.5).mean() == pytest.approx(0.087, abs=0.01)  # uniform noise of standard deviation 0.1
    assert np.abs(one - other).mean() < 0.01  # seen: 0.004; of the images themselves 0.17


def test_evened_light_ignores_invalid_pixels() -> None:
    image = np.random.default_rng(0).uniform(0.1, 0.9, (60, 80)).astype(np.float32)
    valid = np.ones(image.shape, bool)
    valid[:, 50:] = False
    spoilt = np.where(valid, image, np.float32(7.0))
    one, other = (evened_light(i, valid, LocalLightConfig()) for i in (image, spoilt))
    assert np.allclose(one[valid], other[valid], atol=1e-6)


def test_depths_are_averaged_on_smooth_surface_alone() -> None:
    quads = np.array([[2.0, 2.1, 2.0, 2.25, 2.0, 0.0, 9], [2.0, 2.1, 2.0, 2.0, 2.0, 2.0, 9]], np.float32)
    fine, coarse = depth_pyramid(quads, 2, 1.1)
    assert fine is quads
    assert np.allclose(coarse, [[2.05, 0.0, 0.0]])  # an odd last column is dropped


@pytest.mark.parametrize(("clipped", "scaled"), [(4, False), (5, True)])
def test_a_photo_is_saturated_from_half_a_percent_on(clipped: int, scaled: bool) -> None:
    """Of a photo with twice the render's exposure 4 or 5 of a thousand values are clipped."""
    render = np.full((32, 64, 3), 0.3, np.float32)
    photo = np.full((32, 64, 3), 0.6 * 255, np.float32).round().astype(np.uint8)
    count = int(np.ceil(clipped * photo.size / 1000))
    render.reshape(-1)[:count], photo.reshape(-1)[:count] = 0.9, 255
    frame = Frame(render, np.ones((32, 64), np.float32), *(np.ones((32, 64), np.float32),) * 2)
    found = clip_like_photo(photo, frame, CONFIG)
    if scaled:
        assert np.allclose(found, photo / 255, atol=2e-3)
    else:
        assert found is frame.rgb


def test_intensity_is_the_mean_of_the_channels() -> None:
    assert intensity(np.array([[[255, 255, 255], [30, 60, 90]]], np.uint8)) == pytest.approx(
        np.array([[1.0, 60 / 255]])
    )
    assert intensity(np.array([[[0.3, 0.6, 0.9]]], np.float32)) == pytest.approx(np.array([[0.6]]))


# --- residuals and weights


def test_residuals_of_a_flat_wall_are_the_difference_of_values() -> None:
    residuals, weights, loss = flat_level(0.6, 0.5).residuals(neutral_state(), REFINEMENT)
    assert np.allclose(residuals, 0.1, atol=1e-6)
    assert loss == pytest.approx(0.1)
    # 1 / |r| of L1, times Tukey's at a ninth of the cut-off
    assert np.allclose(weights, (1 - 1 / 81) ** 2 / 0.1, rtol=1e-4)
    even = flat_level(0.6, 0.5).residuals(neutral_state(), replace(REFINEMENT, weighting="least_squares"))[1]
    assert np.allclose(even, 1 / 0.02)


def test_small_residuals_weigh_like_least_squares() -> None:
    level = flat_level(0.505, 0.5)
    weights = level.residuals(neutral_state(), replace(REFINEMENT, cutoff_medians=np.inf))[1]
    assert np.allclose(weights, 1 / 0.02)


def test_photometric_parameters_explain_gain_bias_and_gamma() -> None:
    state = neutral_state()
    state.photometric[:] = [0.8, 0.1, 0.2, 0.7]
    residuals = flat_level(0.6, 0.5).residuals(state, REFINEMENT)[0]
    assert np.allclose(residuals, 0.6 - (0.8 * 0.5 + 0.1 + 0.2 * 0.25), atol=1e-6)  # flat: a blur changes nothing


@pytest.mark.parametrize(("columns", "enough"), [(9, False), (10, True)])
def test_fewer_than_the_least_number_of_pixels_are_no_overlap(columns: int, enough: bool) -> None:
    level = flat_level(0.6, 0.5, columns, rows=20)
    state = neutral_state()
    assert np.isfinite(level.residuals(state, REFINEMENT)[2]) == enough
    assert np.isfinite(minimize(level, state, 0.005, REFINEMENT)) == enough


def test_points_seen_outside_the_photo_or_behind_have_no_weight() -> None:
    level = flat_level(0.6, 0.5)
    state = neutral_state()
    state.photo_from_render[0, 3] = 0.04 * 10  # ten pixels to the right
    residuals, weights, _ = level.residuals(state, REFINEMENT)
    column = level.pixels % 38
    assert np.array_equal(weights > 0, column + 1 + 10 < 39)
    assert np.all(residuals[weights == 0] == 0)
    state.photo_from_render[:3] = np.diag([-1, 1, -1, 1])[:3]  # the camera looks away
    assert level.residuals(state, REFINEMENT)[2] == np.inf


def test_tukeys_weight_ends_at_nine_medians() -> None:
    residuals = np.full(100, 0.1, np.float32)
    residuals[1:4] = [0.45, 0.899, 0.9]
    weights = _tukey_weights(residuals, np.ones(100, np.float32), REFINEMENT)
    assert weights[1] == pytest.approx((1 - 0.25) ** 2, rel=1e-4)
    assert 0 < weights[2] < 1e-4
    assert weights[3] == pytest.approx(0, abs=1e-9)
    # Medians below 0.01 count as 0.01; unweighted pixels have no part in them.
    residuals[:] = 0.001
    residuals[1:3] = [0.045, 0.0901]
    weights = _tukey_weights(residuals, np.ones(100, np.float32), REFINEMENT)
    assert weights[1] == pytest.approx((1 - 0.25) ** 2, rel=1e-4)
    assert weights[2] == 0
    residuals[:60], chosen = 0.5, np.ones(100, np.float32)
    chosen[:60] = 0
    assert _tukey_weights(residuals, chosen, REFINEMENT)[0] == 0
    assert np.all(_tukey_weights(residuals, chosen, replace(REFINEMENT, cutoff_medians=np.inf)) == 1)


# --- normal equations and cells


def test_normal_equations_and_cells_are_the_sums_that_they_stand_for() -> None:
    rng = np.random.default_rng(0)
    jacobian, factors = rng.normal(size=(14, 300)).astype(np.float32), rng.uniform(0.5, 2, 14)
    weights, residuals = rng.uniform(0, 1, 300).astype(np.float32), rng.normal(0, 0.03, 300).astype(np.float32)
    scaled = jacobian * factors[:, None]
    hessian, rhs = normal_equations(jacobian, weights, residuals, factors)
    assert np.allclose(hessian, scaled * weights @ scaled.T, rtol=1e-4, atol=1e-3)
    assert np.allclose(rhs, scaled @ (weights * residuals), rtol=1e-4, atol=1e-4)
    # 20 x 50 pixels in cells of 16: two rows of four, the last of each cut off by the border.
    pixels = np.sort(rng.choice(1000, 300, replace=False))
    pixels = pixels[(pixels // 50 < 16) | (pixels % 50 >= 16)]  # none in the first cell of the second row
    n = len(pixels)
    scores, hessians, places = scores_by_cell(jacobian[:, :n], weights[:n], residuals[:n], pixels, (20, 50), 0.02, 16)
    assert places.tolist() == [[0, 0], [0, 1], [0, 2], [0, 3], [1, 1], [1, 2], [1, 3]]
    for score, part, (row, column) in zip(scores, hessians, places, strict=True):
        mine = (pixels // 50 // 16 == row) & (pixels % 50 // 16 == column)
        own, weight, residual = jacobian[:, :n][:, mine], weights[:n][mine], residuals[:n][mine]
        assert np.allclose(score, own @ (weight * residual), atol=1e-5)
        curved = np.abs(residual) < 0.02
        assert np.allclose(part, (own * weight)[:, curved] @ own[:, curved].T, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("unknown", range(6))
def test_the_twist_columns_are_derivatives_by_moving_the_render(unknown: int) -> None:
    """Of a render whose value is linear in its normalized coordinates, so that differences are exact."""
    k = np.array([SMALL.fx, SMALL.fy, SMALL.cx, SMALL.cy])
    row, column = np.mgrid[:30, :40] + 0.5
    x, y = (column - SMALL.cx) / SMALL.fx, (row - SMALL.cy) / SMALL.fy
    depth = np.full((30, 40), 2.0, np.float32)
    pixels = np.arange(28 * 38)
    points, jacobian = linearize((0.5 + 0.3 * x - 0.2 * y).astype(np.float32), depth, pixels, k)
    step = 1e-4
    twist = step * np.eye(6)[unknown]
    far = points + np.cross(twist[:3], points.T).T + twist[3:, None]
    change = 0.3 * (far[0] / far[2] - points[0] / points[2]) - 0.2 * (far[1] / far[2] - points[1] / points[2])
    assert np.allclose(jacobian[unknown], change / step, atol=1e-3)


def test_residuals_from_the_floor_on_have_no_curvature() -> None:
    residuals = np.array([0.4999, 0.5, -0.4999, -0.5], np.float32)
    one = np.ones((1, 4), np.float32)
    scores, hessians, _ = scores_by_cell(one, one[0], residuals, np.arange(4), (1, 4), 0.5, 16)
    assert hessians[0, 0, 0] == 2
    assert scores[0, 0] == pytest.approx(0, abs=1e-6)


# --- the whole


def test_a_refinement_is_steps_that_end_where_they_hardly_move_the_image() -> None:
    truth = true_pose()
    camera = Camera(LENS, moved(truth, np.array([0.02, -0.01, 0.01, 0.03, 0.02, -0.04])))
    photo, frame = photo_from(truth).rgb, PaintedWalls().render([camera])[0]

    def off(**changed: object) -> float:
        config = replace(REFINEMENT, **changed)  # type: ignore[arg-type]
        return pose_distance(refine_photometric(photo, frame, camera, camera, 1, config=config).pose, truth)[0]

    one, two, all_of_them = off(max_steps=1), off(max_steps=2), off()
    assert one > 1.5 * two > 1.5 * all_of_them
    assert off(settled_px=1e9) == one
    coarse = refine_photometric(photo, frame, camera, camera, 1, coarse=True)
    assert (
        coarse.pose.world_from_camera.tolist()
        == refine_photometric(
            photo, frame, camera, camera, 1, config=replace(REFINEMENT, settled_px=0.05)
        ).pose.world_from_camera.tolist()
    )


def test_without_photometric_parameters_another_exposure_moves_the_pose() -> None:
    truth = true_pose()
    camera = Camera(LENS, moved(truth, np.array([0.005, -0.005, 0.0, 0.01, 0.0, 0.0])))
    photo, frame = photo_from(truth, gain=0.8, bias=0.1).rgb, PaintedWalls().render([camera])[0]
    fixed = replace(REFINEMENT, estimate_photometric=False)
    with_them, without = (refine_photometric(photo, frame, camera, camera, 1, config=c) for c in (REFINEMENT, fixed))
    assert with_them.final_level is not None
    assert without.final_level is not None
    assert with_them.final_level.photometric[:2] == pytest.approx([0.8, 0.1], abs=0.02)
    assert without.final_level.photometric.tolist() == [1, 0, 0, 0]
    assert with_them.loss < 0.3 * without.loss


def test_the_scale_of_the_covariance_has_a_lower_bound() -> None:
    truth = true_pose()
    camera = Camera(LENS, truth)
    frame, photo = PaintedWalls().render([camera])[0], photo_from(truth).rgb

    def of(**changed: float):
        config = replace(REFINEMENT, uncertainty=UncertaintyConfig(**changed))
        found = pose_uncertainty(photo, frame, camera, camera, None, config=config)
        assert found is not None
        return found

    low, high = of(min_variance_scale=0.1), of(min_variance_scale=0.9)
    assert np.allclose(high.covariance, 9 * low.covariance)  # a photo of the frame itself is at the bound


def test_the_result_of_a_refinement_saves_linearizing_anew() -> None:
    """The uncertainty is the same but for the photometric start, and the photo isn't read."""
    truth = true_pose()
    camera = Camera(LENS, moved(truth, np.array([0.004, 0.0, 0.0, 0.0, 0.01, 0.0])))
    photo, frame = photo_from(truth).rgb, PaintedWalls().render([camera])[0]
    result = refine_photometric(photo, frame, camera, camera, 2)
    answer = Camera(LENS, result.pose)
    reused = pose_uncertainty(np.zeros_like(photo), frame, camera, answer, None, result=result)
    fresh = pose_uncertainty(photo, frame, camera, answer, None)
    assert reused is not None
    assert fresh is not None
    assert np.allclose(reused.covariance, fresh.covariance, rtol=0.05)
    assert np.abs(reused.last_step - fresh.last_step).max() < 1e-5
    black = pose_uncertainty(np.zeros_like(photo), frame, camera, answer, None)
    assert black is None or np.trace(black.covariance) > 1e3 * np.trace(reused.covariance)
