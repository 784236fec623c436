"""Where a photo fits several places, the result says so and lists them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rest_in_ci import rest_in_ci
from small_room import HALF_TURN, write_room
from test_estimators import LENS, assert_near, photo_at, unseen_pose

from service.estimators.search_config import SEARCH
from service.estimators.view_index import Options
from service.geometry import moved, pose_distance, project, transformed
from service.interfaces import Features, Matcher
from service.jobs.model import JobResult
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.matchers.mutual import mutual_nearest
from service.pose.features.mirrored_query import mirrored_query
from service.pose.features.rendered_views import View
from service.pose.retrieval.ambiguous_hypotheses import (
    AMBIGUITY,
    PoseAtDistance,
    ambiguous_hypotheses,
    shifted_hypotheses,
)
from service.pose.retrieval.scene_symmetries import Repetitions
from service.pose.verification.ambiguity import rank_answers
from service.results import PoseEstimate, Reason, StageTiming, Status, Verdict
from service.tracking import Tracker
from service.types import Camera, Intrinsics, Pose, Query
from service.web.schemas.conversion import result_out


@pytest.fixture(scope="module")
def repeated(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> LoadedScene:
    return LoadedScene.load(
        write_room(tmp_path_factory.mktemp("repeated") / "room", repeated=True), cache_dir=scene_cache
    )


@pytest.mark.parametrize("seed", rest_in_ci(1, 0))
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


@pytest.mark.ci
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


# ------------------------------------------------------------------ a pose that only colours speak against


@pytest.fixture(scope="module")
def symmetric(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> LoadedScene:
    """A room that is nearly its own mirror image, taken to repeat itself: colours decide."""
    room = write_room(tmp_path_factory.mktemp("symmetric") / "room", symmetric=True)
    loaded = LoadedScene.load(room, cache_dir=scene_cache)
    loaded._prepared["view_index"] = replace(loaded.prepare("view_index"), repeats_itself=True)
    return loaded


def recoloured(photo: Query, share: float = 0.45) -> Query:
    """Each channel has this share of the next one's light."""
    mixed = (1 - share) * photo.rgb + share * np.roll(photo.rgb, -1, axis=2)
    return replace(photo, rgb=np.clip(mixed, 0, 255).astype(np.uint8))


def stages(found: PoseEstimate) -> set[str]:
    return {record.stage for record in found.records}


@pytest.mark.ci
def test_other_colours_are_accepted_where_the_mirror_image_fits_less(symmetric: LoadedScene) -> None:
    truth = unseen_pose()
    photo = recoloured(photo_at(symmetric, truth))
    found = localize(photo, symmetric)
    assert found.verdict.signals["local_colour_correlation"] < 0.935  # the floor; seen: 0.927
    assert found.verdict.status is Status.LOCALIZED
    assert_near(found.pose, truth)
    assert "check_rivals" in stages(found)
    # Another search would find the same pose.
    assert not stages(found) & {"retrieve_full_size", "retrieve_more_views", "retrieve_free_views", "sample_poses"}

    other = localize(mirrored_query(photo), symmetric)
    assert (other.verdict.status, other.verdict.reason) == (Status.UNCERTAIN, Reason.MIRRORED)


def lit_by_lamps(photo: Query) -> Query:
    """Each channel is brighter on another side, by up to a factor of 2.7 across the photo."""
    height, width = photo.rgb.shape[:2]
    down, across = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    light = np.exp(0.5 * np.stack([across * down, -across, across - down], 2))
    return replace(photo, rgb=np.clip(light * photo.rgb, 0, 255).astype(np.uint8))


@pytest.mark.ci
def test_colours_whose_edges_agree_are_accepted_in_any_light(symmetric: LoadedScene) -> None:
    truth = unseen_pose()
    photo = photo_at(symmetric, truth)
    found = localize(lit_by_lamps(photo), symmetric)
    # Below what decides without the edges; seen: 0.83, and edges of 0.99.
    assert found.verdict.signals["local_colour_correlation"] < SEARCH.min_repeated_colour
    assert found.verdict.status is Status.LOCALIZED
    assert_near(found.pose, truth)
    assert "check_rivals" in stages(found)

    # The same place in other colours: red where it is green; edges of -0.48.
    fast = Request(options=Options(effort="fast"))
    painted = localize(recoloured(photo, 1.0), symmetric, fast)
    assert_near(painted.pose, truth)
    assert (painted.verdict.status, painted.verdict.reason) == (Status.UNCERTAIN, Reason.RENDER_MISMATCH)
    assert "check_rivals" not in stages(painted)


@pytest.mark.ci
def test_accepted_colours_need_edges_in_colour_unless_they_are_sure(symmetric: LoadedScene) -> None:
    photo = recoloured(photo_at(symmetric, unseen_pose()), 0.4)

    def verdict(**changed: float) -> Verdict:
        config = replace(SEARCH, **changed)
        return localize(photo, symmetric, Request(options=Options(effort="fast"), config=config)).verdict

    # Seen: local colours of 0.943, edges of 0.73.
    assert verdict().status is Status.LOCALIZED
    other = verdict(least_colour_edges=0.8)
    assert (other.status, other.reason) == (Status.UNCERTAIN, Reason.RENDER_MISMATCH)
    assert other.covariance is not None
    assert verdict(least_colour_edges=0.8, sure_local_colour=0.93).status is Status.LOCALIZED


@pytest.mark.ci
def test_other_colours_are_refused_where_the_mirror_image_fits_nearly_as_well(symmetric: LoadedScene) -> None:
    config = replace(SEARCH, max_rival_ratio=0.5)
    photo = recoloured(photo_at(symmetric, unseen_pose()))
    verdict = localize(photo, symmetric, Request(config=config)).verdict
    assert (verdict.status, verdict.reason) == (Status.UNCERTAIN, Reason.RENDER_MISMATCH)


def test_other_colours_are_refused_where_another_place_fits_as_well(repeated: LoadedScene) -> None:
    photo = recoloured(photo_at(repeated, unseen_pose()), 0.5)
    verdict = localize(photo, repeated).verdict
    assert verdict.signals["local_colour_correlation"] < 0.935
    assert (verdict.status, verdict.reason) == (Status.UNCERTAIN, Reason.RENDER_MISMATCH)
    # Nothing but that place speaks against it.
    alone = localize(photo, repeated, Request(config=replace(SEARCH, min_rival_gradients=1.0))).verdict
    assert alone.status is Status.LOCALIZED


# ------------------------------------------------------------------ which hypotheses are looked for

CAMERA = Intrinsics(800, 600, 700.0, 700.0, 400.0, 300.0)
ANSWER = Pose(np.eye(4))


class ByNumber(Matcher):
    """Matches features whose descriptors are the same number."""

    name = "by number"

    def extract(self, rgb: np.ndarray, limit: int) -> Features:
        raise NotImplementedError

    def match(self, a: Features, b: Features) -> np.ndarray:
        pairs = np.nonzero(a.descriptors == b.descriptors.T)
        return np.stack(pairs, 1).astype(np.int32)


def shifted(by: float) -> Pose:
    return moved(ANSWER, np.array([0, 0, 0, by, 0, 0]))


def planted(sizes: Sequence[int], views: Sequence[Pose]) -> tuple[Features, list[View], list[Pose]]:
    """A photo of so many points for each of some poses, all seen by each of some views with strengths in their order.

    The points lie about 6 units ahead; pose k is k + 1 units beside the answer.
    """
    rng = np.random.default_rng(0)
    poses = [shifted(k + 1.0) for k in range(len(sizes))]
    in_camera = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (sum(sizes), 3))
    owner = np.repeat(np.arange(len(sizes)), sizes)
    points = np.stack(
        [transformed(poses[k].world_from_camera, p[None])[0] for k, p in zip(owner, in_camera, strict=True)]
    )
    px = project(in_camera, CAMERA).astype(np.float32)
    strengths = np.linspace(1, 0.5, len(px), dtype=np.float32)
    photo = Features(px, strengths, np.arange(len(px), dtype=np.float32)[:, None])
    return photo, [View(Camera(CAMERA, pose), photo, points.astype(np.float32)) for pose in views], poses


def hypotheses(photo: Features, views: list[View], min_inliers: int = 15, **changed: float) -> list[int]:
    """Return the numbers of inliers of what is found; the views are alike the photo in their order."""
    scores = np.linspace(1, 0, len(views))
    answer = PoseAtDistance(ANSWER, 6.0)
    config = replace(AMBIGUITY, **changed)
    found = ambiguous_hypotheses(photo, CAMERA, answer, views, scores, ByNumber(), 4.0, min_inliers, config)
    return [each.num_inliers for each in found]


def test_at_most_three_hypotheses_are_looked_for_the_largest_first() -> None:
    photo, views, _ = planted([60, 50, 40, 30, 20], [shifted(5.0)])
    assert hypotheses(photo, views) == [60, 50, 40]
    assert hypotheses(photo, views, max_hypotheses=9) == [60, 50, 40, 30, 20]


class ByDescriptor(ByNumber):
    def match(self, a: Features, b: Features) -> np.ndarray:
        return mutual_nearest(a.descriptors, b.descriptors, 0.5)


def test_one_thing_further_is_found_from_a_view_that_shows_both() -> None:
    """Three like things in a row, 2 units apart. The photo is of the right one, the answer has the middle one there.

    The middle one looks exactly as in the photo, the others less so: from another side.
    """
    rng = np.random.default_rng(0)
    thing, looks = rng.uniform((-0.8, -1.0, 5.0), (0.8, 1.0, 7.0), (40, 3)), np.eye(40, dtype=np.float32)
    row = np.concatenate([thing + np.array([x, 0, 0]) for x in (-2, 0, 2)])
    descriptors = np.concatenate([0.8 * looks, looks, 0.9 * looks])
    strengths = np.ones(120, np.float32)
    seen = Features(project(row, CAMERA).astype(np.float32), strengths, descriptors)
    view = View(Camera(CAMERA, ANSWER), seen, row.astype(np.float32))
    photo = Features(project(thing, CAMERA).astype(np.float32), strengths[:40], looks)

    given = (photo, CAMERA, PoseAtDistance(ANSWER, 6.0), [view], np.ones(1), ByDescriptor(), 4.0)
    assert not list(ambiguous_hypotheses(*given, 15))
    (found,) = shifted_hypotheses(*given)
    assert found.num_inliers >= 30
    assert pose_distance(found.pose, shifted(2.0))[1] < 0.01  # seen: 1e-7


@pytest.mark.parametrize(("agree", "found"), [(15, [15]), (14, [])])
def test_a_hypothesis_needs_as_many_matches_as_are_asked_for(agree: int, found: list[int]) -> None:
    photo, views, _ = planted([agree], [shifted(5.0)])
    assert hypotheses(photo, views) == found


@pytest.mark.parametrize(("place", "found"), [(5, [40]), (6, [])])
def test_six_views_from_elsewhere_are_matched(place: int, found: list[int]) -> None:
    photo, (full,), _ = planted([40], [shifted(5.0)])
    empty = View(full.camera, Features(*(part[:0] for part in (photo.points_px, photo.scores, photo.descriptors))),
                 full.points_in_world[:0])  # fmt: skip
    assert hypotheses(photo, [full if k == place else empty for k in range(8)]) == found


def test_views_that_show_what_the_answer_shows_are_none_from_elsewhere() -> None:
    """Within 25 degrees, and within 0.35 of the distance to what they see, 6 units or so."""

    def turned(degrees: float, by: float) -> Pose:
        return moved(ANSWER, np.array([0, np.radians(degrees), 0, by, 0, 0]))

    for pose, elsewhere in ((turned(24, 0), False), (turned(26, 0), True)):
        photo, views, _ = planted([40], [pose])
        assert bool(hypotheses(photo, views)) is elsewhere
    photo, (view,), _ = planted([40], [ANSWER])
    distances = np.linalg.norm(view.points_in_world[::8] - view.camera.pose.position_in_world, axis=1)
    for share, elsewhere in ((0.30, False), (0.42, True)):
        # The distance is measured from the view, which moves across what it sees.
        views = [replace(view, camera=Camera(CAMERA, shifted(-share * float(np.median(distances)))))]
        assert bool(hypotheses(photo, views)) is elsewhere


@pytest.mark.parametrize(("place", "found"), [(0, [20]), (380, [20]), (400, [])])
def test_the_four_hundred_strongest_features_are_matched(place: int, found: list[int]) -> None:
    photo, (view,), _ = planted([20], [shifted(5.0)])
    rng = np.random.default_rng(1)
    # Others, which agree with nothing, as strong as their place.
    count = 600
    px = rng.uniform(0, 600, (count, 2)).astype(np.float32)
    numbers = np.arange(1000, 1000 + count, dtype=np.float32)[:, None]
    points = rng.uniform(-9, 9, (count, 3)).astype(np.float32)

    def joined(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.concatenate([b[:place], a, b[place:]])

    strengths = np.linspace(1, 0.1, count + 20, dtype=np.float32)
    photo = Features(joined(photo.points_px, px), strengths, joined(photo.descriptors, numbers))
    seen = Features(photo.points_px, strengths, joined(view.features.descriptors, -numbers))
    view = View(view.camera, seen, joined(view.points_in_world, points))
    assert hypotheses(photo, [view]) == found


def test_what_the_answer_nearly_explains_is_no_evidence() -> None:
    """Within three times an inlier's error, 4 px."""
    photo, views, _ = planted([40], [shifted(5.0)])
    for error_px, found in ((11.0, []), (13.0, [40])):
        in_photo = project(views[0].points_in_world.astype(float), CAMERA)
        near = replace(photo, points_px=(in_photo + np.array([error_px, 0])).astype(np.float32))
        # All are off by as much to the same side: another pose explains them exactly.
        assert hypotheses(near, views, distinct_deg=0.0, distinct_share=0.0) == found


@pytest.mark.parametrize(
    ("degrees", "units", "differs"),
    [(4.9, 0, False), (5.1, 0, True), (0, 0.019 * 6, False), (0, 0.021 * 6, True)],
)
def test_poses_are_different_answers_beyond_five_degrees_or_a_fiftieth_of_the_distance(
    degrees: float, units: float, differs: bool
) -> None:
    other = moved(ANSWER, np.array([0, np.radians(degrees), 0, units, 0, 0]))
    assert PoseAtDistance(ANSWER, 6.0).differs_from(other) is differs


# ------------------------------------------------------------------ where the scene's repetitions lead to


def planted_repetition(ahead: float = 6.0) -> tuple[np.ndarray, Repetitions]:
    """A motion, 2 units up and a quarter about the vertical, of points around the middle of what the answer sees."""
    motion = np.eye(4)
    motion[:3] = [[0, 0, 1, 0], [0, 1, 0, 2], [-1, 0, 0, 0]]
    points = np.random.default_rng(0).uniform((-1, -1, ahead - 1), (1, 1, ahead + 1), (32, 3))
    return motion, Repetitions.of([motion], [points])


def test_an_answer_has_a_twin_where_a_motion_carries_what_it_sees() -> None:
    motion, repetitions = planted_repetition()
    (twin,) = repetitions.twins(Camera(CAMERA, ANSWER), 6.0)
    assert np.allclose(twin.world_from_camera, motion)
    # The twin sees the part that the motion leads to, and is led back.
    (back,) = repetitions.twins(Camera(CAMERA, twin), 6.0)
    assert np.allclose(back.world_from_camera, ANSWER.world_from_camera)
    # Behind the camera is none of it.
    assert not planted_repetition(ahead=-6.0)[1].twins(Camera(CAMERA, ANSWER), 6.0)


def test_several_views_that_find_the_same_motion_lead_to_one_twin() -> None:
    motion, once = planted_repetition()
    points = once.points_in_world[0]
    nearly = moved(Pose(motion), np.array([0, 0.05, 0, 0.2, 0, 0])).world_from_camera
    assert len(Repetitions.of([motion, nearly], [points, points]).twins(Camera(CAMERA, ANSWER), 6.0)) == 1
    # One that leads back to where the camera is leads to none.
    hardly = moved(ANSWER, np.array([0, 0.05, 0, 0.2, 0, 0])).world_from_camera
    assert not Repetitions.of([hardly], [points]).twins(Camera(CAMERA, ANSWER), 6.0)
