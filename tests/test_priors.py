"""What is known beforehand of a photo's pose decides where the scene repeats itself, and holds for the answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_room import HALF_TURN, write_room
from test_estimators import assert_near, photo_at, unseen_pose

from service.accuracy import Accuracy
from service.errors import InvalidPrior
from service.estimators.view_index import Options
from service.geometry import moved, pose_distance
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.pose.absolute_pose.prior_region import distance_outside, inside_prior, widened_prior
from service.results import PoseEstimate, Reason, Status
from service.types import BoxPrior, GaussianPosePrior, Pose, PriorRegion

TRUTH = unseen_pose()
FAST = Request(options=Options(effort="fast"))
TWIN = Pose(HALF_TURN @ TRUTH.world_from_camera)


@pytest.fixture(scope="module")
def repeated(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> LoadedScene:
    return LoadedScene.load(
        write_room(tmp_path_factory.mktemp("repeated") / "room", repeated=True), cache_dir=scene_cache
    )


def box_around(pose: Pose, size: float) -> BoxPrior:
    return BoxPrior(pose.position_in_world - size, pose.position_in_world + size)


def gaussian_at(pose: Pose, degrees: float, units: float) -> GaussianPosePrior:
    return GaussianPosePrior(pose, np.diag(np.repeat([np.radians(degrees), units], 3) ** 2))


@pytest.mark.parametrize("place", [TRUTH, TWIN])
@pytest.mark.parametrize("kind", ["box", "gaussian"])
def test_a_region_decides_between_places_that_look_alike(kind: str, place: Pose, repeated: LoadedScene) -> None:
    region: PriorRegion = (
        box_around(place, 0.3) if kind == "box" else gaussian_at(moved(place, np.full(6, 0.05)), 5, 0.1)
    )
    found = localize(replace(photo_at(repeated, TRUTH), region=region), repeated)
    assert found.verdict.status is Status.LOCALIZED
    assert_near(found.pose, place)


@pytest.mark.parametrize("region", [box_around(Pose(np.diag([1.0, -1, -1, 1])), 0.1), gaussian_at(TWIN, 2, 0.05)])
def test_where_the_photo_was_not_taken_nothing_is_localized(region: PriorRegion, repeated: LoadedScene) -> None:
    elsewhere = moved(TRUTH, np.array([0.0, 1.5, 0, 0, 0, 0]))
    found = localize(replace(photo_at(repeated, elsewhere), region=region), repeated, FAST)
    assert found.verdict.status is not Status.LOCALIZED


def test_an_answer_that_the_prior_excludes_is_no_answer(repeated: LoadedScene) -> None:
    """Near enough for a pose before alignment, 17 standard deviations off after it."""
    region = gaussian_at(moved(TRUTH, np.array([0, 0, 0, 0.05, 0, 0])), 0.5, 0.003)
    found = localize(replace(photo_at(repeated, TRUTH), region=region), repeated, FAST)
    assert found.verdict.status is Status.UNCERTAIN
    assert found.verdict.reason is Reason.OUTSIDE_PRIOR


def stages(found: PoseEstimate) -> set[str]:
    return {record.stage for record in found.records}


def test_from_a_prior_nothing_is_looked_for_elsewhere(repeated: LoadedScene) -> None:
    """The photo is aligned with what is seen from there; no view of the index is asked."""
    prior = moved(TRUTH, np.array([0.04, -0.03, 0.02, 0.03, 0.02, -0.03]))
    known = gaussian_at(prior, 3, 0.1)
    found = localize(replace(photo_at(repeated, TRUTH), prior=prior, region=known), repeated, FAST)
    assert found.verdict.status is Status.LOCALIZED
    assert stages(found) == {"refine", "verify"}
    assert_near(found.pose, TRUTH)


def test_a_guess_does_not_decide_between_places_that_look_alike(repeated: LoadedScene) -> None:
    found = localize(replace(photo_at(repeated, TRUTH), prior=moved(TRUTH, np.full(6, 0.02))), repeated, FAST)
    assert "retrieve" not in stages(found)
    assert found.verdict.reason is Reason.AMBIGUOUS
    assert len(found.alternatives) == 1


def test_a_wrong_guess_costs_nothing_but_time(repeated: LoadedScene) -> None:
    wrong = moved(TRUTH, np.array([0.0, 1.6, 0, 0, 0, 0]))
    found = localize(replace(photo_at(repeated, TRUTH), prior=wrong), repeated, FAST)
    assert "retrieve" in stages(found)
    assert min(pose_distance(found.pose, place)[0] for place in (TRUTH, TWIN)) < 0.2


def test_where_only_the_place_is_in_doubt_no_further_view_is_tried(repeated: LoadedScene) -> None:
    found = localize(photo_at(repeated, TRUTH), repeated, replace(FAST, accuracy=Accuracy(units=1e-6)))
    assert found.verdict.reason is Reason.POSITION_UNCERTAIN
    assert not stages(found) & {"retrieve_more_views", "retrieve_rotated", "sample_poses"}


def test_regions_end_where_they_say() -> None:
    box = BoxPrior(np.zeros(3), np.array([1.0, 2.0, 3.0]))
    inside, outside = np.eye(4), np.eye(4)
    inside[:3, 3], outside[:3, 3] = [0.5, 2.0, 0.0], [1.3, 2.4, 1.0]
    assert inside_prior(box, Pose(inside))
    assert distance_outside(box, Pose(outside)) == pytest.approx(0.5)
    assert inside_prior(None, Pose(outside))
    # 99.9 % of a chi-square with 6 degrees of freedom, by drawn twists.
    covariance = np.diag(np.repeat([0.01, 0.2], 3) ** 2)
    covariance[0, 4] = covariance[4, 0] = 0.0015
    region = GaussianPosePrior(TRUTH, covariance)
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(6), covariance, 4_000)
    kept = np.mean([inside_prior(region, moved(TRUTH, twist)) for twist in draws])
    assert kept == pytest.approx(0.999, abs=0.0015)  # three standard deviations
    assert not inside_prior(gaussian_at(TRUTH, 1, 1), moved(TRUTH, np.array([0.1, 0, 0, 0, 0, 0])))
    assert inside_prior(widened_prior(gaussian_at(TRUTH, 1, 1), 1.0), moved(TRUTH, np.array([0.1, 0, 0, 0, 0, 0])))


@pytest.mark.parametrize("corners", [([0, 0, 0], [1, 1, 0]), ([0, 0, np.nan], [1, 1, 1])])
def test_an_empty_box_is_refused(corners: tuple[list, list]) -> None:
    with pytest.raises(InvalidPrior, match="corners"):
        BoxPrior(*map(np.array, corners))


@pytest.mark.parametrize("matrix", [np.zeros((6, 6)), -np.eye(6), np.eye(5), np.full((6, 6), np.nan), np.ones((6, 6))])
def test_what_is_no_covariance_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(InvalidPrior, match="positive definite"):
        GaussianPosePrior(TRUTH, matrix)
