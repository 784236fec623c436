"""Figures of refinement and of placed views by hand: steps, their motion, quarters, and what views show."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from test_search_thresholds import HERE, QUERY, agreed, matches

from service.geometry import look_at, moved
from service.interfaces import Frame
from service.pose.absolute_pose.lens_prior import correction_vector, prior_precision
from service.pose.matching import match_stages
from service.pose.matching.match_stages import MATCHING
from service.pose.refinement import covariance, gauss_newton
from service.pose.refinement.pyramid import clip_like_photo, evened_light
from service.pose.refinement.pyramid_level import RefinementState
from service.pose.refinement.refinement_config import REFINEMENT, LocalLightConfig, PyramidConfig, UncertaintyConfig
from service.pose.retrieval import free_views, view_placement
from service.pose.retrieval.free_views import FREE_VIEWS
from service.pose.retrieval.view_placement import PLACEMENT, cell_ids
from service.types import Intrinsics, IntrinsicsCorrection, LensPrior

LENS = Intrinsics(640, 480, 500.0, 450.0, 310.0, 250.0)
PRIOR = LensPrior(0.1, 0.05, 0.03)
OFF = IntrinsicsCorrection(1.3, 0.02, -0.05, 0.07)

# ------------------------------------------------------------------ Gauss-Newton steps


def test_a_steps_motion_is_that_of_twist_focal_length_distortion_and_shift() -> None:
    step = np.zeros(14)
    step[:3], step[3:6], step[10:] = [0.03, 0.0, 0.04], [0.6, -0.8, 0.0], [-0.01, 0.02, 0.003, -0.005]
    # At the end of the longer side: 320 px of a focal length of 500.
    radius = 0.64
    expected = 500 * (0.05 + 1.0 / 4 + radius * 0.01 + radius**3 * 0.02) + 640 * 0.005
    assert gauss_newton._motion_px(step, LENS, 4.0) == pytest.approx(expected)


@pytest.mark.parametrize("estimates_lens", [False, True])
def test_a_step_solves_the_normal_equations_with_the_priors_share(estimates_lens: bool) -> None:
    rng = np.random.default_rng(7)
    jacobian = rng.standard_normal((14, 200)).astype(np.float32)
    residuals, weights = rng.standard_normal(200).astype(np.float32), rng.uniform(0.5, 2, 200).astype(np.float32)
    state = RefinementState(np.eye(4), OFF, PRIOR if estimates_lens else None, np.array([0.8, 0.1, 0.2, 0.3]))
    found = gauss_newton._step(jacobian, residuals, weights, state, 0.07, REFINEMENT)
    size = 14 if estimates_lens else 10
    rows = jacobian.astype(float)
    # Geometry moves the render, which the photo shows times the gain.
    rows[[*range(6), *range(10, 14)]] *= 0.8
    rows = rows[:size]
    hessian, pull = rows * weights @ rows.T, rows @ (weights * residuals)
    if estimates_lens:
        precision = 50 * 0.07 * prior_precision(PRIOR, OFF)
        hessian[range(10, 14), range(10, 14)] += precision
        pull[10:] -= precision * correction_vector(OFF)
    assert found[:size] == pytest.approx(np.linalg.solve(hessian, pull), rel=1e-3, abs=1e-5)
    assert (found[size:] == 0).all()
    fixed = gauss_newton._step(
        jacobian, residuals, weights, state, 0.07, replace(REFINEMENT, estimate_photometric=False)
    )
    kept = [i for i in range(size) if not 6 <= i < 10]
    assert fixed[kept] == pytest.approx(np.linalg.solve(hessian[np.ix_(kept, kept)], pull[kept]), rel=1e-3, abs=1e-5)
    assert (fixed[6:10] == 0).all()


# ------------------------------------------------------------------ the jackknife


def test_a_weighted_median_holds_half_of_the_weight() -> None:
    values = np.array([5.0, 1.0, 9.0, 3.0])
    assert covariance._weighted_median(values, np.array([1.0, 1, 1, 2.1])) == 3.0
    assert covariance._weighted_median(values, np.array([1.0, 1, 1, 0.5])) == 5.0
    assert covariance._weighted_median(values, np.array([0.1, 0.2, 7, 3.0])) == 9.0


def test_the_variance_scale_is_how_far_leaving_out_quarters_moves_the_unknowns() -> None:
    rng = np.random.default_rng(8)
    halves = rng.standard_normal((40, 3, 6))
    hessians, scores = halves @ halves.transpose(0, 2, 1), rng.standard_normal((40, 3)) * [3, 1, 2]
    places = rng.uniform(0, 10, (40, 2))
    config = UncertaintyConfig(cuts=2, ridge=0.05)
    found = covariance.jackknife_variance_scale(scores, hessians, places, config)
    total = hessians.sum(0)
    information = np.einsum("cij,ji->c", hessians, np.linalg.inv(total))

    def halves_of(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
        order = np.argsort(values)
        below = np.cumsum(weights[order])
        return values > values[order][np.argmax(below >= 0.5 * below[-1])]

    moves = []
    for angle in np.radians([0, 45, 90, 135]):
        along = np.cos(angle) * places[:, 0] + np.sin(angle) * places[:, 1]
        across = np.cos(angle) * places[:, 1] - np.sin(angle) * places[:, 0]
        upper = halves_of(along, information)
        for half in (upper, ~upper):
            beyond = halves_of(across, np.where(half, information, 0))
            for quarter in (half & beyond, half & ~beyond):
                step = np.linalg.solve(1.05 * total - hessians[quarter].sum(0), scores[quarter].sum(0))
                moves.append(step @ total @ step)
    # Four cuts of four quarters, for three unknowns.
    assert found == pytest.approx(sum(moves) / 3 / 4, rel=0.02)
    assert covariance.jackknife_variance_scale(0 * scores, 0 * hessians, places, config) == np.inf


# ------------------------------------------------------------------ light


def test_evened_light_is_the_offset_over_the_spread_of_its_surroundings() -> None:
    rng = np.random.default_rng(9)
    image = rng.uniform(0.1, 0.9, (40, 60)).astype(np.float32)
    valid = rng.uniform(0, 1, (40, 60)) > 0.2
    config = LocalLightConfig(window_share=0.05, contrast=0.13, min_contrast=0.07)
    # The window has a sigma of 3 pixels.
    weight = cv2.GaussianBlur(valid.astype(np.float64), (0, 0), 3.0)
    mean = cv2.GaussianBlur(image * valid.astype(np.float64), (0, 0), 3.0) / weight
    spread = np.sqrt(cv2.GaussianBlur((image - mean) ** 2 * valid, (0, 0), 3.0) / weight)
    expected = 0.5 + 0.13 * (image - mean) / (spread + 0.07)
    assert evened_light(image, valid, config) == pytest.approx(expected, abs=1e-4)


def test_a_saturated_photos_exposure_is_that_of_each_channels_blocks() -> None:
    config = PyramidConfig()
    render = np.full((32, 64, 3), 0.2, np.float32)
    render[..., 2] = 0.9 * config.min_exposed
    photo = np.full((32, 64, 3), 51, np.uint8)  # 0.2
    photo[..., 0], photo[..., 1] = 102, 25  # twice, and half: a gain is 1 at least
    photo[..., 2] = 200  # where the render is dark nothing is told
    block = config.exposure_block_px
    photo[:, :block], render[:, :block] = 255, 0.7
    ones = np.ones((32, 64), np.float32)
    found = clip_like_photo(photo, Frame(render, ones, ones, ones), config)
    assert found[20, 40] == pytest.approx([0.4, 0.2, render[20, 40, 2]], abs=2e-3)
    assert found[20, 2] == pytest.approx([1.0, 0.7, 0.7], abs=2e-3)


# ------------------------------------------------------------------ matches with a render and an estimated lens


def test_with_an_estimated_lens_matches_are_solved_without_its_distortion(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple] = []
    straight = np.ones((9, 2), np.float32)
    monkeypatch.setattr(match_stages, "without_distortion", lambda px, lens, correction: straight)
    monkeypatch.setattr(match_stages, "estimate_absolute_pose", lambda *given: asked.append(given) or agreed(5))
    monkeypatch.setattr(match_stages, "refine_with_lens", lambda *given: asked.append(given) or agreed(7))
    query: Any = replace(QUERY, lens_prior=PRIOR)
    near = replace(agreed(3), correction=OFF)
    found = match_stages.solve_matches_near(near, matches(9), query)
    assert found is not None
    assert found.num_inliers == 7
    (px, _, camera, error_px, trials), refined = asked
    assert (px is straight, camera, trials) == (True, QUERY.intrinsics.corrected(OFF), MATCHING.view_trials)
    # Three pixels at that size, times what P3P without all of the lens allows.
    assert error_px == pytest.approx(3 * match_stages.LENS_SEARCH.error_factor)
    assert (refined[3].correction, refined[4], refined[5]) == (OFF, PRIOR, 3.0)
    monkeypatch.setattr(match_stages, "estimate_absolute_pose", lambda *_: None)
    assert match_stages.solve_matches_near(near, matches(9), query) is None


# ------------------------------------------------------------------ placed views


def placed(points: np.ndarray, distance: float = 2.0) -> view_placement._Views:
    space: Any = SimpleNamespace(points=points, distance=distance, middle=np.zeros(3), radius=1.0)
    rasterizer: Any = SimpleNamespace()
    return view_placement._Views(space, rasterizer, replace(PLACEMENT, voxel_share=0.25))


def test_a_point_is_seen_by_the_views_that_see_its_voxel() -> None:
    # Voxels of a half: the first two points share one.
    views = placed(np.array([[0.1, 0.1, 0.1], [0.4, 0.2, 0.3], [0.6, 0.1, 0.1], [-0.1, 0.1, 0.1]]))
    near, beside, other = (cell_ids(np.array([row], np.int64)) for row in ([0, 0, 0], [1, 0, 0], [9, 9, 9]))
    views._surface_ids = [near, np.concatenate([near, other]), np.concatenate([beside, near]), other]
    assert views.seen(np.array([0, 1, 2])).tolist() == [3, 3, 1, 0]
    assert views.seen(np.array([3])).tolist() == [0, 0, 0, 0]
    assert views.seen(np.array([], int)).tolist() == [0, 0, 0, 0]


def test_what_a_placed_view_sees_is_told_by_voxel_direction_and_octave() -> None:
    views = placed(np.zeros((1, 3)))
    views.poses = [moved(HERE, np.array([0, 0, 0, 1.0, 1, 1]))]
    # 3 ahead, and 5 away aslant: octaves 1 and 2.
    views._surfaces = [np.array([[1.0, 1, 4], [5.0, 1, 4], [5.1, 1, 4]])]
    rows = [[2, 2, 8, 0, 0, 1, 1], [10, 2, 8, 1, 0, 1, 2]]
    assert views.cells(0).tolist() == np.unique(cell_ids(np.array(rows, np.int64))).tolist()


def test_a_rendered_views_surface_is_where_its_pixels_are_solid() -> None:
    lens = Intrinsics(16, 12, 20.0, 25.0, 8.0, 6.0)
    pose = moved(HERE, np.array([0, 0, 0, 0.5, 0, -1.0]))
    depth = np.full((12, 16), 3.0, np.float32)
    alpha = np.ones((12, 16), np.float32)
    alpha[:, :4] = 0.0
    views = placed(np.zeros((1, 3)))
    views._rasterizer = SimpleNamespace(  # type: ignore[assignment]
        render=lambda cameras, approximate: [Frame(np.zeros((12, 16, 3), np.float32), alpha, depth, depth)]
    )
    views.add([view_placement.Camera(lens, pose)])
    assert views.scores == [0.75]
    expected = [[3 * (x + 0.5 - 8) / 20 + 0.5, 3 * (y + 0.5 - 6) / 25, 2.0] for y in (2, 6, 10) for x in (6, 10, 14)]
    assert views._surfaces[0] == pytest.approx(np.array(expected))
    voxels = np.floor(np.array(expected) / 0.5).astype(np.int64)
    assert views._surface_ids[0].tolist() == np.unique(cell_ids(voxels)).tolist()


def test_views_from_afar_are_added_where_there_is_room() -> None:
    def chosen(most: int, afar: list[int]) -> list[int]:
        cells = [np.arange(k, k + 3) for k in (0, 10, 20, 30)]
        views: Any = SimpleNamespace(
            cells=lambda i: cells[i], good=lambda or_best_from_afar: np.array([0, 1, *afar], int)
        )
        config = replace(PLACEMENT, min_views=2, max_views=most)
        return view_placement._chosen(views, np.array([0, 1]), config).tolist()

    assert sorted(chosen(9, [2, 3])) == [0, 1, 2, 3]
    assert sorted(chosen(3, [2, 3])[:2]) == [0, 1]
    assert len(chosen(3, [2, 3])) == 3
    assert sorted(chosen(2, [2, 3])) == [0, 1]
    assert sorted(chosen(9, [])) == [0, 1]


def test_shells_look_at_the_middle_and_others_at_gaussians() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [3, 2, 1] + [10.0, 20, 30]
    space: Any = SimpleNamespace(middle=np.array([10.0, 20, 30]), radius=3.0, up=np.array([0.0, 0, 1]), points=points)
    config = replace(PLACEMENT, shell_candidates=5, shell_radii=(1.5, 4.0), volume_candidates=300)
    shells = view_placement._shells(space, config)
    ways = np.array([space.middle - pose.position_in_world for pose in shells])
    assert np.linalg.norm(ways, axis=1) == pytest.approx([4.5] * 5 + [12.0] * 5)
    assert all(pose.axis_in_world @ way > 0.999 * np.linalg.norm(way) for pose, way in zip(shells, ways, strict=True))
    volume = view_placement._in_volume(space, np.random.default_rng(1), config)
    positions = np.array([pose.position_in_world for pose in volume])
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    assert (positions >= low).all()
    assert (positions <= high).all()
    assert (np.ptp(positions, axis=0) > 0.95 * (high - low)).all()
    for pose in volume[:20]:
        rays = points - pose.position_in_world
        assert (rays @ pose.axis_in_world / np.linalg.norm(rays, axis=1)).max() == pytest.approx(1.0)


def test_cameras_beside_the_index_are_the_chosen_solid_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}
    scene: Any = SimpleNamespace()
    rasterizer: Any = SimpleNamespace(cameras_at_once=3)
    poses = [moved(HERE, np.array([0, 0, 0, float(k), 0, 0])) for k in range(8)]
    cells: list[Any] = [None, np.array([1]), None, np.array([2]), np.array([3]), None, np.array([4]), None]
    monkeypatch.setattr(free_views, "lod_proxy", lambda *_: rasterizer)
    # The first two candidates are behind an outer plane.
    space = SimpleNamespace(planes=np.array([[1.0, 0, 0, -1.5]]))
    monkeypatch.setattr(free_views, "free_space_of", lambda scene: space)

    def candidates(views, rng, count, config):
        asked["count"], asked["views"] = count, len(views)
        return poses

    def solid(cameras, search, nearest, config):
        asked["nearest"] = nearest
        return [cells[int(camera.pose.position_in_world[0])] for camera in cameras]

    def choice(found, known, limit, config):
        asked["limit"], asked["found"] = limit, [own.tolist() for own in found]
        return [2, 0]

    for name, step in (("_candidates", candidates), ("_solid_cells", solid), ("_choice", choice)):
        monkeypatch.setattr(free_views, name, step)
    point = np.float32([[0, 0, 5.0]])

    def view(points: np.ndarray, distance: float) -> Any:
        return SimpleNamespace(
            points_in_world=points,
            distance=distance,
            camera=SimpleNamespace(pose=look_at(np.zeros(3), np.ones(3), np.eye(3)[2])),
        )

    index = [view(point, 2.0), view(point[:0], 99.0), view(point, 5.0), view(point, 9.0)]
    found = free_views.free_view_cameras(scene, rasterizer, index, config=replace(FREE_VIEWS, max_views=20))
    # Six for each of the four views, but 20 at most; seven candidates for each.
    assert (asked["limit"], asked["count"], asked["views"]) == (20, 140, 3)
    assert asked["nearest"] == pytest.approx(0.06 * 5)
    assert asked["found"] == [[2], [3], [4]]
    assert [camera.pose for camera in found] == [poses[6], poses[3]]
    assert {camera.intrinsics.width for camera in found} == {384}
    free_views.free_view_cameras(scene, rasterizer, index)
    assert asked["limit"] == 24
    assert free_views.free_view_cameras(scene, rasterizer, index[1:2]) == []
