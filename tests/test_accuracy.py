"""The accuracy that a caller asks for: its probability against simulations, and what it does to a verdict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_room import write_room
from test_estimators import photo_at, unseen_pose
from test_reasons import BEFORE_A_WALL, FAST, middle_of_a_wall, with_a_wrong_lens

from service.accuracy import Accuracy
from service.errors import InvalidAccuracy
from service.geometry import moved, pose_distance, se3_exp
from service.loaded_scene import LoadedScene
from service.localize import Request, localize, render_and_verify
from service.pose.features.query_images import QueryImages
from service.pose.verification.gate import VERIFICATION, doubted
from service.pose.verification.precision import probability_within
from service.results import Reason, Status, Verdict
from service.tracking import Tracker
from service.types import Pose, Query

TRUTH = unseen_pose()
DEGREES = 4
"""Of freedom of the t distribution of errors."""


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> LoadedScene:
    return LoadedScene.load(write_room(tmp_path_factory.mktemp("accuracy") / "room"), cache_dir=scene_cache)


def judged(room: LoadedScene, query: Query, pose: Pose, accuracy: Accuracy) -> Verdict:
    return render_and_verify(QueryImages(replace(query, accuracy=accuracy), room.matcher), pose, room.rasterizer)


def parts(verdict: Verdict) -> tuple[float, float]:
    assert verdict.right_place is not None
    assert verdict.precise is not None
    return verdict.right_place, verdict.precise


# ------------------------------------------------------------------ the probability


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_the_probability_is_that_of_a_simulation_of_poses(seed: int, scale: float) -> None:
    """Simulated errors move a pose, and are measured as poses are: rotation and position hang together."""
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((6, 6)) * rng.uniform(0.1, 1.0, 6) * 0.01
    errors = rng.standard_normal((40_000, 6)) @ factor.T / np.sqrt(rng.chisquare(DEGREES, (40_000, 1)) / DEGREES)
    bound_deg = scale * float(np.degrees(np.median(np.linalg.norm(errors[:, :3], axis=1))))
    bound_units = scale * float(np.median(np.linalg.norm(errors[:, 3:], axis=1)))
    turn, way = np.degrees(np.linalg.norm(errors[:, :3], axis=1)), np.linalg.norm(errors[:, 3:], axis=1)
    for i in range(20):
        assert pose_distance(Pose(np.eye(4)), moved(Pose(np.eye(4)), errors[i])) == pytest.approx(
            (turn[i], np.linalg.norm(se3_exp(errors[i])[:3, 3])), abs=1e-6
        )
    simulated = float(np.mean((turn < bound_deg) & (way < bound_units)))
    # 0.0065 was seen; three standard errors of the simulation are 0.0075.
    assert probability_within(factor @ factor.T, bound_deg, bound_units) == pytest.approx(simulated, abs=0.01)


@pytest.mark.parametrize("times_sigma", [0.5, 1.0, 2.0, 4.0])
def test_along_one_direction_it_is_students_distribution(times_sigma: float) -> None:
    """With four degrees of freedom P(|t| < x) = u (3 - u^2) / 2 with u = x / sqrt(x^2 + 4)."""
    direction = np.array([0.0, 0, 0, 0.6, 0, 0.8])
    u = times_sigma / np.sqrt(times_sigma**2 + 4)
    found = probability_within(0.01**2 * np.outer(direction, direction), 5.0, times_sigma * 0.01)
    assert found == pytest.approx(u * (3 - u**2) / 2, abs=0.008)  # 0.005 was seen


def test_what_is_certain_is_within_any_bounds_and_what_is_unknown_within_none() -> None:
    assert probability_within(np.zeros((6, 6)), 1e-3, 1e-3) == 1.0
    assert probability_within(1e12 * np.eye(6), 5.0, 0.1) < 1e-6


# ------------------------------------------------------------------ what is asked


def test_without_a_measure_two_percent_of_the_distance_are_asked_for() -> None:
    assert Accuracy().bound_units(3.0) == pytest.approx(0.06)
    assert Accuracy(units=0.5).bound_units(3.0) == 0.5
    assert Accuracy(metres=0.1).in_units("hall", 0.5).bound_units(3.0) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("given", "where"),
    [
        ({"deg": 0.0}, "deg"),
        ({"deg": 181.0}, "deg"),
        ({"units": -1.0}, "units"),
        ({"metres": float("nan")}, "metres"),
        ({"share": 1.5}, "share"),
        ({"units": 1.0, "share": 0.1}, "share"),
    ],
)
def test_bounds_that_are_none_are_refused(given: dict[str, float], where: str) -> None:
    with pytest.raises(InvalidAccuracy) as raised:
        Accuracy(**given)
    assert raised.value.where == f"accuracy.{where}"


def test_metres_need_a_scale(room: LoadedScene) -> None:
    in_metres, photo = Request(accuracy=Accuracy(metres=0.1)), photo_at(room, TRUTH)
    unscaled = replace(room, scene=replace(room.scene, info=replace(room.scene.info, metres_per_unit=None)))
    for run in (lambda: localize(photo, unscaled, in_metres), lambda: Tracker(unscaled, in_metres).track(photo)):
        with pytest.raises(InvalidAccuracy, match="no scale"):
            run()


# ------------------------------------------------------------------ what a verdict makes of it


def test_a_pose_too_uncertain_for_the_default_is_localized_within_what_it_is_certain_of(room: LoadedScene) -> None:
    photo = middle_of_a_wall(room)
    default = judged(room, photo, BEFORE_A_WALL, Accuracy())
    assert (default.status, default.reason) == (Status.UNCERTAIN, Reason.POSITION_UNCERTAIN)
    assert default.covariance is not None
    assert parts(default)[0] >= VERIFICATION.min_localized
    looser = judged(room, photo, BEFORE_A_WALL, Accuracy(deg=20.0, share=0.3))
    assert looser.status is Status.LOCALIZED
    assert parts(looser)[0] == parts(default)[0]
    assert parts(looser)[1] > VERIFICATION.min_precise > parts(default)[1]


def test_a_right_pose_is_uncertain_if_more_is_asked_than_it_is_certain_of(room: LoadedScene) -> None:
    strict = judged(room, photo_at(room, TRUTH), TRUTH, Accuracy(units=1e-5))
    assert (strict.status, strict.reason) == (Status.UNCERTAIN, Reason.POSITION_UNCERTAIN)
    assert strict.covariance is not None
    turned = judged(room, photo_at(room, TRUTH), TRUTH, Accuracy(deg=1e-4))
    assert turned.reason is Reason.POSITION_UNCERTAIN


def test_the_score_is_the_product_of_its_parts(room: LoadedScene) -> None:
    for accuracy in (Accuracy(), Accuracy(units=0.002), Accuracy(deg=0.05)):
        found = judged(room, photo_at(room, TRUTH), TRUTH, accuracy)
        place, precise = parts(found)
        assert found.score == pytest.approx(place * precise)
        assert found.asked is not None
        assert found.asked[0] == accuracy.deg
        assert found.covariance is not None
        assert precise == pytest.approx(probability_within(found.covariance, *found.asked), abs=0.01)


def test_no_accuracy_makes_a_wrong_place_or_a_wrong_lens_right(room: LoadedScene) -> None:
    loose = Accuracy(deg=90.0, share=1.0)
    elsewhere = judged(room, photo_at(room, TRUTH), unseen_pose(4), loose)
    assert elsewhere.status is Status.NOT_LOCALIZED
    assert judged(room, *with_a_wrong_lens(room), loose).reason is Reason.INTRINSICS_CONTRADICTED


def test_a_doubt_limits_the_part_that_it_is_about(room: LoadedScene) -> None:
    sure = judged(room, photo_at(room, TRUTH), TRUTH, Accuracy())
    about_place, about_lens = doubted(sure, Reason.AMBIGUOUS, 0.3), doubted(sure, Reason.FOCAL_UNCERTAIN)
    assert (about_place.right_place, about_place.precise) == (0.3, sure.precise)
    assert (about_lens.right_place, about_lens.precise) == (sure.right_place, 0.5)
    assert sure.rank > about_lens.rank > about_place.rank


@pytest.mark.ci
def test_the_request_decides_through_search_and_tracking(room: LoadedScene) -> None:
    photo, strict = photo_at(room, TRUTH), replace(FAST, accuracy=Accuracy(units=1e-5))
    assert localize(photo, room, FAST).verdict.status is Status.LOCALIZED
    found = localize(photo, room, strict)
    assert found.verdict.reason is Reason.POSITION_UNCERTAIN
    assert pose_distance(found.pose, TRUTH)[1] < 0.05
    tracker = Tracker(room, FAST)
    tracker.track(photo)
    followed = tracker.track(photo)
    assert followed.records[-1].stage == "track"
    assert parts(followed.verdict)[1] > VERIFICATION.min_precise
