"""Where a photo fits several places, the result says so and lists them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_room import HALF_TURN, write_room
from test_estimators import LENS, assert_near, photo_at, unseen_pose

from service.geometry import pose_distance
from service.jobs.model import JobResult
from service.localize import LoadedScene, Request, localize
from service.pose.verification.ambiguity import rank_answers
from service.results import Reason, StageTiming, Status
from service.tracking import Tracker
from service.types import Pose
from service.web.schemas.conversion import result_out


@pytest.fixture(scope="module")
def repeated(tmp_path_factory: pytest.TempPathFactory) -> LoadedScene:
    folder = tmp_path_factory.mktemp("repeated")
    return LoadedScene.load(write_room(folder / "room", repeated=True), cache_dir=folder / "cache")


@pytest.mark.parametrize("seed", [0, 1])
def test_a_room_that_repeats_itself_has_two_answers(seed: int, repeated: LoadedScene) -> None:
    truth = unseen_pose(seed)
    found = localize(photo_at(repeated, truth), repeated)
    assert found.verdict.status is Status.UNCERTAIN
    assert found.verdict.reason is Reason.AMBIGUOUS
    ((other, probability),) = found.alternatives
    assert 0.3 < probability <= 0.5  # seen: 0.40 to 0.50
    assert found.verdict.score == pytest.approx(1 - probability, abs=0.05)
    both = sorted((found.pose, other), key=lambda pose: pose_distance(pose, truth)[1])
    assert_near(both[0], truth)
    assert_near(both[1], Pose(HALF_TURN @ truth.world_from_camera))
    (told,) = result_out(JobResult(found, StageTiming("decode", 0.0, 0.0), None, {})).alternatives
    assert told.probability == probability
    assert told.pose.position == other.position_in_world.tolist()


def test_with_an_approximate_lens_too(repeated: LoadedScene) -> None:
    query = photo_at(repeated, unseen_pose(), replace(LENS, trust="approximate"))
    found = localize(query, repeated)
    assert found.verdict.reason is Reason.AMBIGUOUS
    assert len(found.alternatives) == 1


def test_what_tells_the_places_apart_decides(repeated: LoadedScene) -> None:
    """A picture on one wall: the answer without it leaves a lot unexplained."""
    truth = unseen_pose()
    scene = repeated.scene
    ahead = truth.position_in_world + 2.0 * truth.axis_in_world
    sh = scene.sh.copy()
    sh[np.linalg.norm(scene.means - ahead, axis=1) < 0.9, 0] = 1.2
    marked = LoadedScene.of(replace(scene, sh=sh))
    found = localize(photo_at(marked, truth), marked)
    assert found.verdict.status is Status.LOCALIZED
    assert found.alternatives == ()
    assert_near(found.pose, truth)


def test_a_camera_is_not_followed_from_where_it_may_not_be(repeated: LoadedScene) -> None:
    tracker = Tracker(repeated, Request())
    for _ in range(2):
        assert tracker.track(photo_at(repeated, unseen_pose())).verdict.reason is Reason.AMBIGUOUS


def test_answers_are_ranked_by_what_they_leave_unexplained() -> None:
    # By hand: (0.021 / 0.02) ** -10 = 0.614, of 1.615 together with the others' 1 and 0.001.
    ranked = rank_answers([0.021, 0.02, 0.04])
    assert [number for number, _ in ranked] == [1, 0]
    assert [probability for _, probability in ranked] == pytest.approx([0.619, 0.380], abs=0.001)
    assert [number for number, _ in rank_answers([0.02, 0.04])] == [0]
