"""Lens models, readings of a device and the search's verdict by hand: derivatives, thresholds and weights."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_search_thresholds import HERE, agreed, state, verdict

from service.device_readings import HeadingPrior, PositionPrior, ScenePriors, UpPrior
from service.estimators import ambiguity_check, search_state
from service.estimators.search_state import SearchState
from service.geometry import look_at, moved, se3_exp, transformed
from service.pose.absolute_pose import fisheye
from service.pose.absolute_pose.device_priors import agreement, prefers, residuals
from service.pose.absolute_pose.fisheye import FISHEYE, LensModels
from service.pose.absolute_pose.lens_prior import correction_vector
from service.pose.absolute_pose.normal_equations import normal_equations
from service.pose.refinement import lens_test
from service.pose.refinement.refine_stage import RefinedPose
from service.pose.refinement.refinement_config import REFINEMENT
from service.pose.retrieval.image_variant import Retrieval
from service.results import Reason, Status
from service.types import BoxPrior, Intrinsics, IntrinsicsCorrection, LensPrior, Pose, Query

LENS = Intrinsics(640, 480, 300.0, 280.0, 330.0, 225.0)
PRIOR = LensPrior(0.3, 0.1, 0.02)

# ------------------------------------------------------------------ fisheye or not


@pytest.mark.parametrize("model", [fisheye.SIMPLE_RADIAL, fisheye.SIMPLE_RADIAL_FISHEYE])
def test_both_lens_models_are_linearized_in_pose_and_lens(model: fisheye.RadialModel) -> None:
    pose = moved(HERE, np.array([0.2, -0.1, 0.3, 0.5, -0.2, 0.1]))
    local = np.random.default_rng(0).uniform([-2, -2, 1.5], [2, 2, 4], (6, 3))
    local[4, 2] = -1.0
    points = transformed(pose.world_from_camera, local)
    px = np.random.default_rng(1).uniform(0, 400, (6, 2))
    correction = IntrinsicsCorrection(1.15, 0.01, -0.02, 0.03)
    problem = fisheye._Problem(model, px, points, LENS, PRIOR, 0.9)
    found = problem.linearized(pose, correction, 2.2)
    assert found.ahead.tolist() == [True, True, True, True, False, True]
    # By COLMAP's formulas.
    x, y, z = local[0]
    radius = np.hypot(x / z, y / z)
    angle = radius if model is fisheye.SIMPLE_RADIAL else np.arctan(radius)
    ratio = angle * (1 + 0.03 * angle**2) / radius
    seen = [330 + 6.4 + 345 * ratio * x / z, 225 - 12.8 + 322 * ratio * y / z]
    assert found.residual[0] == pytest.approx(px[0] - seen)
    assert found.unit[0] == pytest.approx(np.array([x, y]) / np.hypot(x, y))
    assert found.radius[0] == pytest.approx(radius)
    ahead = found.ahead
    for k in range(10):
        ends = []
        for sign in (1, -1):
            step = sign * 1e-6 * np.eye(10)[k]
            vector = correction_vector(correction) + step[6:]
            there = IntrinsicsCorrection(float(np.exp(vector[0])), vector[2], vector[3], vector[1])
            at = Pose(pose.world_from_camera @ se3_exp(step[:6]))
            ends.append(problem.linearized(at, there, 2.2).residual)
        slope = (ends[1] - ends[0])[ahead] / 2e-6
        assert found.jacobian[ahead, :, k] == pytest.approx(slope, rel=1e-4, abs=1e-3)
    expected = normal_equations(found.jacobian, found.residual, ahead, 0.9, 2.2, PRIOR, correction)
    assert (found.cost, found.hessian.tolist()) == (expected.cost, expected.hessian.tolist())


def fit(cost: float, inliers: int = 40, of: int = 100, misfit: bool = False) -> Any:
    return SimpleNamespace(cost=cost, inlier=np.arange(of) < inliers, leaves_misfit=lambda config: misfit)


def test_a_fisheye_is_one_by_its_cost_and_surely_from_sixteen_matches_mean_on() -> None:
    def models(radial: Any, bent: Any) -> tuple[bool, bool, bool]:
        both = LensModels(radial, bent)
        return both.is_fisheye(), both.is_surely_fisheye(), both.is_unmodelled()

    assert models(fit(100.0), fit(99.0)) == (True, False, False)
    assert models(fit(100.0), fit(100.0)) == (False, False, False)
    assert models(fit(200.0), fit(99.0, 39)) == (False, False, False)
    # The mean cost of a match is 1 at least; of 300 in a hundred it is 3: 48 are significant.
    assert models(fit(115.9), fit(100.0)) == (True, False, False)
    assert models(fit(116.1), fit(100.0)) == (True, True, False)
    assert models(fit(347.9), fit(300.0)) == (True, False, False)
    assert models(fit(348.1), fit(300.0)) == (True, True, False)
    assert models(fit(66.1), fit(50.0)) == (True, True, False)
    # What the better of both leaves counts.
    assert models(fit(90.0, misfit=True), fit(100.0))[2]
    assert not models(fit(90.0), fit(100.0, misfit=True))[2]
    assert not models(fit(90.0, 39, misfit=True), fit(100.0))[2]


def test_a_misfit_is_significant_and_large() -> None:
    def leaves(drop: float, px: float) -> bool:
        whole = fisheye.LensModelFit(
            fisheye.SIMPLE_RADIAL, HERE, IntrinsicsCorrection(), 0.0, np.ones(3, bool), drop, px
        )
        return whole.leaves_misfit(FISHEYE)

    assert [leaves(*each) for each in ((40.1, 2.1), (40, 2.1), (40.1, 2.0))] == [True, False, False]


def test_a_misfit_is_what_powers_of_the_radius_explain() -> None:
    rng = np.random.default_rng(3)
    count = 30
    angle, radius = rng.uniform(0, 2 * np.pi, count), np.sort(rng.uniform(0.2, 1.5, count))
    unit = np.stack([np.cos(angle), np.sin(angle)], 1)
    weight = np.where(np.arange(count) % 3 == 0, 0.5, 2.0)
    rho = np.minimum(radius / np.quantile(radius, 0.98), 1)
    smooth = unit * (3.0 * rho**5 - 5.0 * rho**9)[:, None]
    # Noise that no power explains: without its part along them.
    rows = np.stack([(unit * rho[:, None] ** power).ravel() for power in (5, 7, 9)], 1)
    weights, noise = np.repeat(weight, 2), rng.standard_normal(2 * count)
    noise -= rows @ np.linalg.solve(rows.T @ (weights[:, None] * rows), rows.T @ (weights * noise))
    ahead = np.arange(count) != 7
    wide: Any = SimpleNamespace(
        radius=radius, unit=unit, weight=weight, ahead=ahead, jacobian=np.zeros((count, 2, 10)),
        residual=smooth + noise.reshape(count, 2),
    )  # fmt: skip
    drop, px = fisheye._misfit(wide, 0.7)
    # As many observations as weights of the largest one.
    expected = 2 * weight.sum() / 2.0 * (weights @ smooth.ravel() ** 2) / (weights @ noise**2)
    assert drop == pytest.approx(expected, rel=1e-6)
    assert px == pytest.approx(0.7 * np.quantile(np.linalg.norm(smooth[ahead], axis=1), 0.9), rel=1e-6)


def test_a_fisheyes_start_is_the_best_of_three_focal_lengths(monkeypatch: pytest.MonkeyPatch) -> None:
    counts, asked = iter([agreed(50), None, agreed(60)]), []
    monkeypatch.setattr(fisheye, "estimate_absolute_pose", lambda *given: asked.append(given) or next(counts))
    # At focal lengths of 300 x 1.2 and so on: one ray near the axis, one of 1.3 rad at the first.
    px = np.array([[330 + 36.0, 225.0], [330.0, 225 + 1.3 * 336]])
    found = fisheye._fisheye_starts(px, np.array([[0.0, 0, 1], [1, 1, 1]]), LENS, 1.2, 3.0, FISHEYE)
    assert [start.num_inliers for start in found] == [60]
    assert found[0].correction == IntrinsicsCorrection(pytest.approx(1.8))
    # Beyond 1.35 rad nothing is asked: at 0.67 of the focal length the second ray has 1.94.
    assert [len(given[0]) for given in asked] == [2, 1, 2]
    assert asked[0][0] == pytest.approx(np.array([[330 + 360 * np.tan(0.1), 225], [330, 225 + 336 * np.tan(1.3)]]))
    assert asked[2][0] == pytest.approx(
        np.array([[330 + 540 * np.tan(36 / 540), 225], [330, 225 + 504 * np.tan(1.3 * 336 / 504)]])
    )
    assert (asked[1][2].fx, asked[1][3], asked[1][4]) == (pytest.approx(300 * 1.2 * 0.67), 6.0, 200)
    monkeypatch.setattr(fisheye, "estimate_absolute_pose", lambda *_: None)
    assert fisheye._fisheye_starts(px, np.zeros((2, 3)), LENS, 1.0, 3.0, FISHEYE) == []


def test_a_lens_that_leaves_less_and_moves_the_pose_contradicts(monkeypatch: pytest.MonkeyPatch) -> None:
    config = REFINEMENT
    some: Any = SimpleNamespace(residuals=lambda state, config: (None, None, 0.05))
    counts = []
    level: Any = SimpleNamespace(
        points=np.float32([[0, 0, 0], [0, 0, 0], [3, 4, 9]]), thinned=lambda count: counts.append(count) or some
    )
    before = lens_test.RefinementState(np.eye(4), IntrinsicsCorrection(), None, np.ones(4))

    def fitted(loss: float, share: float) -> Any:
        def minimize(level, free, settled_px, config):
            assert level is some
            assert free.photometric is not before.photometric
            free.photo_from_render = se3_exp(np.array([0, 0, 0, 0, -4 * share, 0]))
            return loss

        monkeypatch.setattr(lens_test, "minimize", minimize)
        return lens_test.fit_lens(level, before, config)

    # By a share of 0.0025 of the depth of 4, with 0.96 of the residual of 0.05.
    found = fitted(0.0479, 0.0026)
    assert found.motion == pytest.approx([0, 0, 0, 0, 0.0104, 0])
    assert (found.loss_ratio, found.contradicts) == (pytest.approx(0.958), True)
    assert not fitted(0.0481, 0.0026).contradicts
    assert not fitted(0.0479, 0.0024).contradicts
    assert fitted(np.inf, 0.1) is None
    assert counts[0] == 2000


# ------------------------------------------------------------------ readings of a device

EAST, NORTH, UP = np.array([0.0, -1, 0]), np.array([1.0, 0, 0]), np.array([0.0, 0, 1])


def view(heading: float, pitch: float, place: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    level = np.cos(pitch) * (np.sin(heading) * EAST + np.cos(heading) * NORTH)
    position = np.array(place)
    return look_at(position, position + level + np.sin(pitch) * UP, UP).world_from_camera


def test_a_view_agrees_by_pitch_heading_and_place() -> None:
    up = UpPrior(np.array([0.0, -np.cos(0.2), np.sin(0.2)]), UP, 0.3)
    heading = HeadingPrior(EAST, NORTH, 3.0, 0.4)
    position = PositionPrior(np.array([1.0, 2, 0]), 3 * np.array([[0.0, -1, 0], [1, 0, 0]]), np.diag([4.0, 9.0]))
    poses = np.stack([view(2.5, 0.2), view(3.0, 0.9), view(-3.0, -0.3), view(3.0, 1.45)])
    poses[:, :3, 3] = [[1, 2, 0], [4, 2, 7], [1, 0, 0], [1, 2, 0]]
    reaches = np.array([1.0, 5.0, 2.0, 1.0])
    pitches = np.array([0.2, 0.9, -0.3, 1.45])
    by_up = (pitches - 0.2) ** 2 / (0.5**2 + 0.3**2)
    assert agreement(ScenePriors(up=up), poses, reaches) == pytest.approx(np.exp(-by_up / 2))
    # Across the back the short way round; a steep view has no heading.
    by_heading = np.array([0.5, 0.0, 2 * np.pi - 6, 0.0]) ** 2 / (0.6**2 + 0.4**2)
    assert agreement(ScenePriors(heading=heading), poses, reaches) == pytest.approx(np.exp(-by_heading / 2))
    # Three units north are nine metres; half of the reach, in metres, may lie between the views.
    by_place = np.array([0, 9**2 / (9 + 7.5**2), 6**2 / (4 + 3**2), 0])
    assert agreement(ScenePriors(position=position), poses, reaches) == pytest.approx(np.exp(-by_place / 2))
    together = ScenePriors(up, position, heading)
    assert agreement(together, poses, reaches) == pytest.approx(np.exp(-(by_up + by_heading + by_place) / 2))
    assert agreement(None, poses, reaches).tolist() == [1.0] * 4


def test_a_heading_counts_less_the_steeper_the_camera() -> None:
    for pitch, expected in ((0.3, True), (1.36, True), (1.38, False)):
        found = residuals(ScenePriors(heading=HeadingPrior(EAST, NORTH, -3.0, 0.4)), Pose(view(3.0, pitch)))
        assert bool(found) is expected  # a fifth of the axis is level at 1.369
        if found:
            assert found[0].value == pytest.approx([6 - 2 * np.pi])
            assert found[0].noise == pytest.approx(np.array([[0.4**2 / np.cos(pitch) ** 2]]))


def test_readings_decide_from_a_difference_of_squares_on() -> None:
    rows = np.array([[0.0, -1, 0], [1, 0, 0]])

    def decide(north: float, of_other: float, covariance: float | None = None) -> bool:
        priors = ScenePriors(position=PositionPrior(np.zeros(3), rows, np.eye(2)))
        here, there = (Pose(view(0.5, 0.1, (at, 0.0, 0.0))) for at in (north, of_other))
        spread = None if covariance is None else covariance * np.eye(6)
        return prefers(priors, here, spread, there, spread)

    # 10.83: 3.292 standard deviations.
    assert decide(0.0, 3.30)
    assert not decide(0.0, 3.28)
    assert decide(2.0, 3.86)  # 14.9 - 4
    assert not decide(2.0, 3.84)  # 14.75 - 4
    # From 13.82 on the pose itself is contradicted: 3.72.
    assert not decide(3.73, 3.0)
    assert not decide(3.73, 9.0)
    # A covariance of three doubles the standard deviation.
    assert decide(0.0, 6.6, 3.0)
    assert not decide(0.0, 6.56, 3.0)


def test_gravity_turns_the_photo_by_the_nearest_eighth_unless_it_looks_up_or_down() -> None:
    def rolled(degrees: float, level: float = 0.8) -> int | None:
        angle = np.radians(degrees)
        up = np.array([level * np.sin(angle), -level * np.cos(angle), np.sqrt(1 - level**2)])
        priors = ScenePriors(up=UpPrior(up, UP, 0.1))
        retrieval = Retrieval(SimpleNamespace(query=SimpleNamespace(scene_priors=priors)), SimpleNamespace(views=[]))  # type: ignore[arg-type]
        return retrieval.roll_by_gravity()

    assert [rolled(degrees) for degrees in (0, 22, 23, 90, 135, 181, -45, -100)] == [0, 0, 1, 2, 3, 4, 7, 6]
    assert [rolled(90, level) for level in (0.31, 0.29)] == [2, None]


def test_views_that_agree_with_the_readings_come_first() -> None:
    scores, weights = np.array([5.0, 4.0, 3.0, 2.0, 1.0]), np.array([0.009, 0.2, 0.9, 0.011, 0.001])
    planted: Any = SimpleNamespace(
        scores=lambda variant: scores, _agreement=lambda: weights, config=SimpleNamespace(least_agreement=0.01)
    )

    def ranked(count: int, **named: Any) -> list[int]:
        return Retrieval.ranked(planted, None, count, **named).tolist()  # type: ignore[arg-type]

    assert ranked(2) == [2, 1, 0]
    assert ranked(4) == [2, 1, 3, 0]
    assert ranked(4, only_agreeing=True) == [2, 1, 3]
    assert ranked(1, support=np.array([0, 20.0, 0, 0, 0])) == [1]
    planted._agreement = lambda: None
    assert ranked(3) == [0, 1, 2]


# ------------------------------------------------------------------ the search's verdict on a pose


@pytest.mark.parametrize(
    ("repeats", "is_unique", "other_colours", "settled", "free_lens", "reason"),
    [
        (False, False, True, True, False, Reason.VERIFIED),
        (True, False, False, True, False, Reason.VERIFIED),
        (True, False, True, True, False, Reason.RENDER_MISMATCH),
        (True, True, True, True, False, Reason.VERIFIED),
        (False, False, False, False, False, Reason.POSITION_UNCERTAIN),
        (False, False, False, False, True, Reason.FOCAL_UNCERTAIN),
    ],
)
def test_a_pose_is_doubted_by_its_colours_and_while_it_still_moves(
    monkeypatch, repeats, is_unique, other_colours, settled, free_lens, reason
) -> None:
    asked = []
    monkeypatch.setattr(
        search_state, "verify", lambda *given, **named: asked.append((given, named)) or verdict("localized", "verified")
    )
    monkeypatch.setattr(SearchState, "_shows_other_colours", lambda *_: other_colours)
    searching = state(repeats, free_lens)
    images: Any = SimpleNamespace(query=SimpleNamespace(lens_prior=object() if free_lens else None))
    images.corrected = lambda correction: images
    searching.images = images
    rendered: Any = SimpleNamespace(shows_the_same_as=lambda *_: True)
    monkeypatch.setattr(RefinedPose, "view_at_pose", lambda self, images, renderer: (rendered, None))
    for inliers in (None, 33):
        found = RefinedPose(HERE, IntrinsicsCorrection(), 0.02, inliers, None, None, settled)
        told = searching.verify(found, True, OTHER if settled else None, is_unique)
        assert told.reason is reason
        assert (told.status is Status.LOCALIZED) is (reason is Reason.VERIFIED)
        given, named = asked[-1]
        assert given[4] is True
        assert (named["supporting_matches"], named["light_may_differ"]) == (inliers or 0, is_unique or not repeats)
        assert (named["config"].refinement is OTHER) is settled


OTHER = replace(REFINEMENT, max_steps=7)


def test_a_mirror_image_is_searched_without_what_is_known_of_the_photo(monkeypatch: pytest.MonkeyPatch) -> None:
    rgb = np.zeros((48, 64, 3), np.uint8)
    rgb[:, 0] = 255
    lens = Intrinsics(64, 48, 50.0, 50.0, 30.0, 24.0)
    box = BoxPrior(np.zeros(3), np.ones(3))
    query = Query(rgb, lens, "given", lens, prior=HERE, region=box, scene_priors=ScenePriors())
    made = []
    monkeypatch.setattr(SearchState, "of", lambda query, tools, config: made.append(query) or "state")
    searching = state()
    searching.images = SimpleNamespace(query=query)  # type: ignore[assignment]
    answer: Any = SimpleNamespace(refined=SimpleNamespace(correction=IntrinsicsCorrection(1.2)))
    assert ambiguity_check.mirror_image_of(searching, answer) == "state"  # type: ignore[comparison-overlap]
    (mirrored,) = made
    assert (mirrored.prior, mirrored.region, mirrored.scene_priors) == (None, None, None)
    assert (mirrored.rgb[:, -1] == 255).all()
    assert (mirrored.intrinsics.fx, mirrored.intrinsics.cx) == pytest.approx((60.0, 34.0))
