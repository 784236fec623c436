"""Odometry's equations and their bounds, by values worked out by hand: `service/live/odometry_fit.py`, `fusion.py`."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from service.geometry import se3_exp
from service.live import fusion as fusion_module
from service.live.fusion import FUSION, Fusion
from service.live.live_values import OdometryFacts
from service.live.odometry_fit import (
    FIT,
    Fix,
    Priors,
    _Stack,
    _State,
    _up_agrees,
    _within,
    differences,
    drift,
    fit_odometry,
)
from service.types import Pose, SceneInfo

INFO = SceneInfo("room", "room", "0" * 64, "ply")
EXACT = np.eye(6) * 1e-12
DEPTH = 2.0
PRIORS = Priors(0.0, 0.7)


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0, *, turn_deg: float = 0.0) -> Pose:
    """A camera there, turned about its y axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array([0.0, np.radians(turn_deg), 0.0]))[0]
    matrix[:3, 3] = x, y, z
    return Pose(matrix)


def fixed(
    pose: Pose, odom: Pose | None = None, *, way: float = 0.0, time_s: float = 0.0, run: int = 0,
    covariance: np.ndarray = EXACT, velocity: np.ndarray | None = None, velocity_on: np.ndarray | None = None,
) -> Fix:  # fmt: skip
    velocity = np.zeros(6) if velocity is None else velocity
    on = velocity if velocity_on is None else velocity_on
    return Fix(time_s, pose, covariance, odom or pose, velocity, on, way, DEPTH, run)


# ------------------------------------------------------------------ the model


@pytest.mark.parametrize("vector", [(0.3, -0.2, 0.9), (1.5, 0.0, 0.0), (0.0, -2.9, 0.1), (1e-7, 0.0, 2e-7), (0, 0, 0)])
def test_differences_are_rotation_vectors_and_ways_in_the_worlds_axes(vector):
    start = se3_exp(np.array([0.4, 0.1, -0.7, 1.0, 2.0, 3.0]))
    measured = start.copy()
    measured[:3, :3] = cv2.Rodrigues(np.array(vector, np.float64))[0] @ start[:3, :3]
    measured[:3, 3] += (0.1, -0.2, 0.3)
    assert differences(start, measured) == pytest.approx([*vector, 0.1, -0.2, 0.3], abs=1e-9)


def test_drift_grows_with_the_way_and_with_its_square():
    """Over three units: (3 + 9) times the variance of a share of the way; of the position in the scene's units."""
    assert np.diag(drift(3.0, 0.5)) == pytest.approx([12 * 0.002**2] * 3 + [12 * (0.01 * 0.5) ** 2] * 3)
    assert np.count_nonzero(drift(3.0, 0.5)) == 6


def stack(*fixes: Fix) -> _Stack:
    return _Stack.of(fixes, FIT)


def test_what_fixes_share_falls_with_distance_and_angle():
    way, turn = 0.1 * DEPTH, np.degrees(0.17)
    for pose, share in (
        (at(), 1.0),
        (at(way), np.exp(-0.5)),
        (at(turn_deg=turn), np.exp(-0.5)),
        (at(2 * way), np.exp(-2)),
    ):
        assert stack(fixed(at()), fixed(pose)).kernel == pytest.approx(
            np.array([[1.0, 0.9 * share], [0.9 * share, 1.0]]), abs=2e-3
        )  # an angle's chord is a little shorter than it


def test_a_fix_is_never_surer_than_scenes_are():
    spread = np.diag([4.0, 5.0, 6.0, 7.0, 8.0, 9.0]) * 1e-8
    (root,) = stack(fixed(at(turn_deg=90.0), covariance=spread)).root
    floor = np.array([0.0005**2] * 3 + [(0.0005 * DEPTH) ** 2] * 3)
    # Turned by a quarter about y, x is the world's -z and z its x.
    expected = np.array([6, 5, 4, 9, 8, 7]) * 1e-8 + floor
    assert root @ root.T == pytest.approx(np.diag(expected), abs=1e-12)


def test_residuals_share_the_drift_from_the_nearer_fix_on():
    """Over ways of 3 and 1: a random walk of min(3, 1), and a steady part of 3 * 1."""
    blocks = stack(fixed(at(), way=1.0), fixed(at(50.0), way=3.0), fixed(at(), way=4.0)).covariance(0.5, FIT)
    own = np.array([0.0005**2] * 3 + [(0.0005 * DEPTH) ** 2] * 3) + 1e-12
    walk = np.array([0.002**2] * 3 + [(0.01 * 0.5) ** 2] * 3)
    assert np.diag(blocks[0, 1]) == pytest.approx(walk * (1 + 3))
    assert np.diag(blocks[0, 0]) == pytest.approx(own + walk * (3 + 9))
    assert np.diag(blocks[0, 2]) == pytest.approx(0.9 * own)
    assert np.diag(blocks[2, 2]) == pytest.approx(own)


def test_late_odometry_is_carried_back_and_early_one_forward():
    velocity, on = np.array([0.3, -0.2, 0.5, 1.0, -2.0, 0.7]), np.array([-0.1, 0.4, 0.2, 0.5, 0.6, -0.9])
    one = stack(fixed(at(1, 2, 3, turn_deg=30), velocity=velocity, velocity_on=on))
    start = at(1, 2, 3, turn_deg=30).world_from_camera
    assert one.corrected(0.2)[0] == pytest.approx(start @ se3_exp(-0.2 * velocity), abs=1e-9)
    assert one.corrected(-0.2)[0] == pytest.approx(start @ se3_exp(0.2 * on), abs=1e-9)


@pytest.mark.parametrize(("square", "agrees"), [(0.97, True), (1.03, False)])
def test_a_fix_beyond_a_thousandth_of_right_ones_contradicts(square, agrees):
    """The 0.999 quantile of chi-square with six degrees of freedom is 22.46."""
    sigma = np.sqrt(0.0005**2 * DEPTH**2 + 1e-12)
    off = np.sqrt(22.46 * square) * sigma
    state = _State(np.eye(4), 0.0, 0.0)
    both = stack(fixed(at(off), at()), fixed(at()))
    assert list(_within(both, state, np.zeros((8, 8)), FIT)) == [agrees, True]
    # Of the first and a third: one must remain, the one that is off less.
    far = stack(fixed(at(10.0), at()), fixed(at(9.0), at()))
    assert list(_within(far, state, np.zeros((8, 8)), FIT)) == [False, True]


def test_what_is_unsure_contradicts_less():
    """At 2 units along x: a turn about y moves it along z, a wrong scale along x."""
    state = _State(np.eye(4), 0.0, 0.0)
    turn, scale = np.zeros((8, 8)), np.zeros((8, 8))
    turn[1, 1], scale[6, 6] = 0.01**2, 0.01**2

    def turned(angle: float) -> Pose:
        return at(2 * np.cos(angle), 0, -2 * np.sin(angle), turn_deg=np.degrees(angle))

    for off, spread, agrees in (
        (turned(0.04), turn, True),
        (turned(0.05), turn, False),
        (at(2, 0, -0.09), turn, False),
        (at(2.09, 0, 0), scale, True),
        (at(2.1, 0, 0), scale, False),
        (at(2, 0, -0.09), scale, False),
    ):
        both = stack(fixed(off, at(2)), fixed(at()))
        assert _within(both, state, spread, FIT)[0] == agrees


@pytest.mark.parametrize(("sigmas", "agrees"), [(3.9, True), (4.1, False)])
def test_gravity_counts_within_four_standard_deviations(sigmas, agrees):
    """Of up in the scene, and of the fixes' rotation: 3 and 4 degrees make 5."""
    turned = np.zeros((8, 8))
    turned[:3, :3] = np.eye(3) * np.radians(4.0) ** 2
    angle = np.radians(sigmas * 5.0)
    up = np.array([0.0, 0.0, 1.0])
    priors = Priors(0.0, 0.7, np.array([np.sin(angle), 0.0, np.cos(angle)]), up, np.radians(3.0))
    state = _State(np.eye(4), 0.0, 0.0)
    assert _up_agrees(state, stack(fixed(at())), priors, turned, FIT) is agrees
    assert not _up_agrees(state, stack(fixed(at())), replace(priors, up_in_world=None), turned, FIT)
    assert not _up_agrees(state, stack(fixed(at())), replace(priors, up_in_odom=None), turned, FIT)


# ------------------------------------------------------------------ the fit


def test_one_fix_tells_as_much_as_itself_and_the_priors():
    spread = np.diag([4.0, 5.0, 6.0, 7.0, 8.0, 9.0]) * 1e-4
    fit = fit_odometry([fixed(at(1, 2, 3, turn_deg=40), at(), covariance=spread)], Priors(0.3, 0.2))
    assert fit.pose.world_from_camera == pytest.approx(at(1, 2, 3, turn_deg=40).world_from_camera, abs=1e-9)
    floor = [0.0005**2] * 3 + [(0.0005 * DEPTH) ** 2] * 3
    known = np.diag([*(np.diag(spread) + floor), 0.2**2, 0.03**2])
    assert fit.covariance == pytest.approx(known, rel=1e-3, abs=1e-9)
    assert (fit.log_scale, fit.offset_s) == pytest.approx((0.3, 0.0))
    assert not fit.up_used


def planted(scale: float, late_s: float) -> list[Fix]:
    """Fixes along a bent way whose odometry is exact, in axes of its own."""
    odom_from_world = np.linalg.inv(se3_exp(np.array([0.2, -0.5, 1.1, 4.0, 5.0, 6.0])))
    fixes = []
    for i in range(8):
        velocity = np.array([0.2 * (-1) ** i, 0.3, -0.1, 0.5, 0.2 * i, -0.4])
        seen = at(0.3 * i, 0.1 * i**2, 0.05 * i, turn_deg=9 * i).world_from_camera
        metric = seen.copy()
        metric[:3, 3] /= scale
        odom = odom_from_world @ metric @ se3_exp(late_s * velocity)
        fixes.append(fixed(Pose(seen), Pose(odom), way=0.4 * i, velocity=velocity))
    return fixes


@pytest.mark.parametrize("late_s", [0.0, 0.04, -0.04])
def test_scale_and_delay_are_found_where_nothing_drifts(late_s):
    sure = replace(FIT, drift_share=1e-6, turn_drift=1e-6, offset_sigma_s=1.0)
    fit = fit_odometry(planted(0.5, late_s), Priors(np.log(0.6), 0.7), sure)
    assert fit.agree.all()
    assert np.exp(fit.log_scale) == pytest.approx(0.5, rel=1e-3)
    assert fit.offset_s == pytest.approx(late_s, abs=1e-3)
    assert fit.pose.world_from_camera == pytest.approx(planted(0.5, late_s)[-1].pose.world_from_camera, abs=1e-3)


def test_the_last_fix_need_not_agree():
    fixes = planted(1.0, 0.0)
    fixes[-1] = replace(fixes[-1], pose=at(9, 9, 9))
    fit = fit_odometry(fixes, PRIORS)
    assert list(fit.agree) == [True] * 7 + [False]
    assert fit.pose.position_in_world == pytest.approx(planted(1.0, 0.0)[-1].pose.position_in_world, abs=0.02)


# ------------------------------------------------------------------ the bounds of what comes in


@pytest.mark.parametrize(
    ("dt", "turn_deg", "shift", "jump"),
    [
        (3.0, 0, 0, False), (3.1, 0, 0, True),  # after a longer silence nobody knows
        (0.1, 0, 0.59, False), (0.1, 0, 0.61, True),  # 6 m/s
        (0.04, 0, 0.29, False), (0.04, 0, 0.31, True),  # at least 0.3 m
        (0.1, 69.0, 0, False), (0.1, 71.0, 0, True),  # 700 degrees a second
        (0.03, 24.0, 0, False), (0.03, 26.0, 0, True),  # at least 25 degrees
        (0.001, 0, 0.31, True), (0.001, 11.0, 0.09, False),  # times jitter
        (1.0, 170.0, 2.0, False),
    ],
)  # fmt: skip
def test_what_moves_faster_than_anybody_carries_a_camera_began_anew(dt, turn_deg, shift, jump):
    fusion = Fusion(OdometryFacts(), INFO)
    fusion.move(10.0, at())
    fusion.move(10.0 + dt, at(shift, turn_deg=turn_deg))
    assert fusion.resets == jump


def test_of_an_older_frame_nothing_is_taken():
    fusion = Fusion(OdometryFacts(), INFO)
    fusion.move(10.0, at())
    fusion.move(10.0, at(5.0))
    fusion.move(9.0, at(5.0))
    assert fusion.resets == 0
    fusion.fix(9.0, at(), EXACT, DEPTH)
    assert fusion.scale is None


def walked(positions: np.ndarray, fps: float = 30.0, facts: OdometryFacts | None = None) -> Fusion:
    """Exact fixes of a camera at positions along x."""
    fusion = Fusion(facts or OdometryFacts(), INFO)
    for number, x in enumerate(positions):
        fusion.move(number / fps, at(x))
        fusion.fix(number / fps, at(x), EXACT, DEPTH)
    return fusion


def test_the_window_keeps_twenty_viewpoints_of_the_last_ten_metres():
    assert len(walked(np.arange(25) * 0.15)._fixes) == 20
    # Eleven steps of 0.9 m are less than ten metres, and nine of 1.1 m; time counts a little, too.
    assert len(walked(np.arange(25) * 0.9, fps=5.0)._fixes) == 12
    assert len(walked(np.arange(25) * 1.1, fps=5.0)._fixes) == 10


def test_turning_and_waiting_count_as_a_little_way():
    for move, time_s, least, most in ((at(turn_deg=1.0), 1e-6, 1e-3, 0.1), (at(), 0.01, 1e-6, 1e-2)):
        fusion = Fusion(OdometryFacts(), INFO)
        fusion.move(0.0, at())
        fusion.move(time_s, move)
        assert least < fusion._samples[-1].way < most


@pytest.mark.parametrize(("share", "near"), [(0.98, True), (1.02, False)])
def test_a_viewpoint_is_as_wide_as_documented(share, near):
    """Four hundredths of the distance to what is seen, and 4 degrees."""
    fusion = Fusion(OdometryFacts(), INFO)
    for other in (at(0.04 * DEPTH * share), at(turn_deg=4.0 * share)):
        assert fusion._is_near(fixed(other), [fixed(at(9)), fixed(at())]) is near
        assert not fusion._is_near(fixed(other), [])


def test_one_viewpoints_fix_is_replaced_once_it_is_old():
    fusion = Fusion(OdometryFacts(), INFO)
    for time_s in (0.0, 2.9):
        fusion.move(time_s, at())
        fusion.fix(time_s, at(), EXACT, DEPTH)
    assert [fix.time_s for fix in fusion._fixes] == [0.0, 2.9]
    fusion.move(3.1, at())
    fusion.fix(3.1, at(), EXACT, DEPTH)
    assert [fix.time_s for fix in fusion._fixes] == [3.1]


def test_while_the_viewpoint_stays_it_is_fitted_now_and_then(monkeypatch):
    fits: list[float] = []
    whole = fusion_module.fit_odometry
    monkeypatch.setattr(
        fusion_module, "fit_odometry", lambda fixes, *rest: fits.append(fixes[-1].time_s) or whole(fixes, *rest)
    )
    walked(np.zeros(10), fps=20.0)
    assert fits == pytest.approx([0.0, 0.15, 0.3, 0.45])


def test_odometry_is_remembered_for_six_seconds():
    fusion = Fusion(OdometryFacts(), INFO)
    for number in range(40):
        fusion.move(number * 0.25, at())
    assert [fusion._samples[0].time_s, fusion._samples[-1].time_s] == [3.75, 9.75]


# ------------------------------------------------------------------ the scale


def test_the_scale_is_what_is_known_before_any_way():
    fusion = Fusion(OdometryFacts(), INFO)
    assert fusion.scale is None
    fusion.move(0.0, at())
    fusion.fix(0.0, at(), EXACT, 5.0)
    # What is 5 units away is usually 2.5 m away, within a factor of two.
    assert fusion.scale == pytest.approx((2.0, 0.7))
    metric = replace(INFO, metres_per_unit=4.0)
    told = Fusion(OdometryFacts(), metric)
    assert told.scale == pytest.approx((0.25, 0.03))
    told.move(0.0, at())
    told.fix(0.0, at(), EXACT, 5.0)
    assert told.scale == pytest.approx((0.25, 0.03))
    assert Fusion(OdometryFacts(metric=False), metric).scale is None


@pytest.mark.parametrize(("sigma", "x"), [(0.19, 3.0), (0.21, 7.0)])
def test_a_way_is_predicted_once_the_scale_is_known(sigma, x):
    fusion = walked(np.zeros(1))
    fusion.move(0.1, at(0.5, turn_deg=10))
    assert fusion._scale is not None
    fusion._scale.log_scale, fusion._scale.sigma = float(np.log(4.0)), sigma
    found = fusion.predicted(0.0, at(1.0), 0.1, at(7.0))
    assert found.world_from_camera == pytest.approx(at(x, turn_deg=10).world_from_camera)
    assert fusion.predicted(0.05, at(1.0), 0.1, at(7.0)).position_in_world[0] == 7.0


# ------------------------------------------------------------------ what contradicts


def broken(*, times=(0.0, 0.3, 0.6, 0.9), runs=(0, 0, 0, 0), off=0.0, off_deg=0.0, sigma=0.0, at_step=2) -> bool:
    """Whether an odometry that differs from that step on has been found to have begun anew."""
    fusion = Fusion(OdometryFacts(), replace(INFO, metres_per_unit=1.0))
    for number, (time_s, run) in enumerate(zip(times, runs, strict=True)):
        pose = at(0.001 * number)
        fusion.move(time_s, at(0.001 * number + off, turn_deg=off_deg) if number >= at_step else pose)
        fusion.fix(time_s, pose, np.eye(6) * max(sigma, 1e-6) ** 2, DEPTH, run)
    return fusion.resets > 0


def test_the_odometry_is_broken_where_one_step_of_four_fixes_contradicts_it():
    jump = {"off": 0.25, "off_deg": 0.0}
    assert broken(**jump)
    assert not broken(**jump, at_step=3)  # perhaps the last fix is wrong
    assert not broken(**jump, at_step=1)
    assert not broken(**jump, runs=(0, 0, 1, 1))
    assert not broken(**jump, times=(0.0, 0.3, 0.6, 1.1))
    assert not broken()


def test_odometry_goes_on_from_the_first_fix_after_the_break():
    fusion = Fusion(OdometryFacts(), replace(INFO, metres_per_unit=1.0))
    for number in range(4):
        fusion.move(0.3 * number, at(0.25 * (number >= 2)))
        fusion.fix(0.3 * number, at(), EXACT, DEPTH)
    assert fusion.resets == 1
    fusion.move(1.2, at(0.35))
    for since_s, x in ((0.6, 5.1), (0.3, 9.0)):
        assert fusion.predicted(since_s, at(5.0), 1.2, at(9.0)).position_in_world[0] == pytest.approx(x)


def step_fixes(off: float, off_deg: float, sigma: float, late: float = 0.0) -> tuple[Fix, Fix]:
    moving = np.array([0.0, 0.0, 0.0, late, 0.0, 0.0])
    covariance = np.eye(6) * sigma**2
    return fixed(at(), covariance=covariance), fixed(
        at(), at(off, turn_deg=off_deg), covariance=covariance, velocity=moving
    )


@pytest.mark.parametrize(("share", "breaks"), [(0.97, False), (1.03, True)])
def test_an_odometry_contradicts_beyond_what_is_documented(share, breaks):
    """2 cm and a degree, and six standard deviations of both fixes, of the delay, and of the scale's."""
    fusion = Fusion(OdometryFacts(), replace(INFO, metres_per_unit=0.5))  # 2 units a metre
    fusion.move(0.0, at())
    fusion.fix(0.0, at(), EXACT, DEPTH)
    assert fusion._scale is not None
    fusion._scale.sigma = 1e-9
    sigma = 0.01
    both = 6 * np.sqrt(2 * 3) * sigma  # three axes of two fixes
    cases = [
        ((0.02 * share, 0.0, 1e-6), 0.0),
        ((0.0, 1.0 * share, 1e-6), 0.0),
        ((both / 2 * share, 0.0, sigma), 0.0),
        ((0.0, np.degrees(both) * share, sigma), 0.0),
        ((6 * 0.03 * 1.5 * share, 0.0, 1e-6), 1.5),  # m/s, over 30 ms
    ]
    for arguments, late in cases:
        assert fusion._breaks(*step_fixes(*arguments, late)) is breaks, arguments
    # Of a step of 1 m a scale that is off by 5 % explains 6 x 0.1 units.
    fusion._scale.sigma = 0.05
    ahead = fixed(at(2 + 0.6 * share), at(1.0))
    assert fusion._breaks(fixed(at()), ahead) is breaks


def test_the_newest_fixes_win_where_they_contradict_the_others_for_a_second():
    fusion = Fusion(OdometryFacts(), replace(INFO, metres_per_unit=1.0))
    for number in range(30):
        time_s, x = number / 10, 0.15 * min(number, 9)
        fusion.move(time_s, at(x))
        # From a second on the camera is found elsewhere; a run of its own each, as of searches.
        fusion.fix(time_s, at(x, float(number >= 10)), np.eye(6) * 1e-4, DEPTH, number)
        assert fusion.resets == (time_s >= 2.0), time_s
    told = fusion.reported()
    assert told is not None
    assert told.world_from_odom[:3, 3] == pytest.approx([0, 1.0, 0], abs=0.05)


# ------------------------------------------------------------------ what is told


@pytest.mark.parametrize(
    ("sigma_deg", "share", "known"), [(3.9, 0.0, True), (4.1, 0.0, False), (0.0, 0.039, True), (0.0, 0.041, False)]
)
def test_a_pose_that_is_less_sure_than_documented_is_not_carried(sigma_deg, share, known):
    fusion = Fusion(OdometryFacts(), replace(INFO, metres_per_unit=1.0))
    fusion.move(0.0, at())
    covariance = np.diag([np.radians(sigma_deg) ** 2 + 1e-12] * 3 + [(share * DEPTH) ** 2 + 1e-12] * 3)
    fusion.fix(0.0, at(1.0), covariance, DEPTH)
    found = fusion.carried()
    assert (found is not None) is known
    if found is not None:
        floor = [0.0005**2] * 3 + [(0.0005 * DEPTH) ** 2] * 3
        assert np.diag(found[1]) == pytest.approx(np.diag(covariance) + floor, rel=1e-3)


def test_what_is_told_moves_by_a_centimetre_and_a_fifth_of_a_degree_a_frame():
    """Two units a metre; the estimate has moved by more than that."""
    fusion = Fusion(OdometryFacts(), replace(INFO, metres_per_unit=0.5))
    fusion.move(0.0, at())
    fusion.fix(0.0, at(), EXACT, DEPTH)
    assert fusion._fit is not None
    start = fusion._fit
    for off, off_deg, x, turned in ((1.0, 0.0, 0.02, 0.0), (0.0, 20.0, 0.0, 0.2), (0.01, 0.1, 0.01, 0.1)):
        fusion._fit = replace(start, pose=at())
        fusion._reported = None
        fusion.move(fusion._samples[-1].time_s + 0.01, at())
        fusion._fit = replace(start, pose=at(off, turn_deg=off_deg))
        fusion.move(fusion._samples[-1].time_s + 0.01, at())
        told = fusion._reported
        assert told is not None
        assert told.pose.world_from_camera == pytest.approx(at(x, turn_deg=turned).world_from_camera, abs=2e-4)


def test_the_told_similarity_says_what_is_left_to_the_estimate():
    fusion = Fusion(OdometryFacts(), replace(INFO, metres_per_unit=0.5))
    fusion.move(0.0, at(3.0))
    fusion.fix(0.0, at(), EXACT, DEPTH)
    told = fusion.reported()
    assert told is not None
    # x_world = 2 x_odom - 6.
    assert told.world_from_odom == pytest.approx(np.array([[2, 0, 0, -6], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1.0]]))
    assert fusion._fit is not None
    sure = told.covariance
    fusion._fit = replace(fusion._fit, pose=at(0.5))
    left = fusion.reported()
    assert left is not None
    assert left.covariance[3, 3] - sure[3, 3] == pytest.approx(0.25, rel=1e-3)
    assert left.world_from_odom == pytest.approx(told.world_from_odom)
    assert FUSION.fit is FIT
