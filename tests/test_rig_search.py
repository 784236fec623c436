"""How a rig is searched for, decision by decision, without a scene: `service/rig.py`."""

from __future__ import annotations

from dataclasses import replace
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service import rig
from service.accuracy import Accuracy
from service.errors import InvalidRequest
from service.geometry import adjoint, se3_exp
from service.localize import Cancelled, Request
from service.pose.absolute_pose.rig_pose import RigMatches
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.matching.correspondences import Correspondences
from service.pose.retrieval.scene_symmetries import NO_REPETITIONS
from service.results import Reason, Status, Verdict
from service.rig import RIG, RigPhoto, _Hypothesis, _nearness, _scaled, _Search, _units_per_metre
from service.types import Intrinsics, Pose

LENS = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
NONE = np.zeros((6, 6))


def at(x: float = 0.0, *, turn: float = 0.0) -> Pose:
    return Pose(se3_exp(np.array([0.0, turn, 0.0, 0.0, 0.0, 0.0])) + x * np.eye(4, k=3))


def photo(mount: Pose) -> RigPhoto:
    query: Any = SimpleNamespace(intrinsics=LENS, scene_priors=None)
    return RigPhoto(query, mount)


def matches(count: int, mount: Pose | None = None, off_px: float = 0.0, max_error_px: float = 2.0) -> RigMatches:
    """Points that the camera at its mount, with the rig at the origin, sees so many pixels off."""
    points = np.stack([np.linspace(-1, 1, count), np.linspace(-0.5, 0.5, count), np.full(count, 5.0)], 1)
    px = points[:, :2] / 5.0 * 500.0 + (320.0 + off_px, 240.0)
    mount = mount or at()
    in_world = points @ mount.world_from_camera[:3, :3].T + mount.position_in_world
    return RigMatches(px.astype(np.float32), in_world.astype(np.float32), LENS, mount, max_error_px)


def search(*photos: RigPhoto, **request: Any) -> Any:
    """A search without a scene."""
    found: Any = _Search.__new__(_Search)
    found._photos, found._config, found._request = photos, RIG, Request(**request)
    found._images = [SimpleNamespace(matcher=None, features=lambda: None) for _ in photos]
    found._clock, found._records, found._report = SimpleNamespace(wall_s=1.0, cpu_s=1.0), [], lambda record: None
    found._supported, found._reach = None, 1.0
    found._index = SimpleNamespace(repetitions=NO_REPETITIONS)
    return found


def test_a_rig_in_metres_is_scaled_by_the_scenes_unit():
    scene = SimpleNamespace(info=SimpleNamespace(metres_per_unit=4.0, name="room"))
    loaded: Any = SimpleNamespace(scene=scene)
    assert _units_per_metre(loaded) == 0.25
    assert _scaled(photo(at(8.0, turn=0.3)), 0.25).world_from_camera == pytest.approx(
        at(2.0, turn=0.3).world_from_camera
    )
    scene.info.metres_per_unit = None
    with pytest.raises(InvalidRequest):
        _units_per_metre(loaded)


def test_nearness_falls_over_half_a_radian_and_half_of_the_distance_to_what_is_seen():
    views = np.stack([at().world_from_camera, at(turn=0.5).world_from_camera, at(2.0).world_from_camera])
    found = _nearness(views[:1], views, 4.0)
    assert found == pytest.approx(np.array([[1.0, np.exp(-1), np.exp(-1)]]))
    assert _nearness(views[1:2], views[2:], 4.0) == pytest.approx(np.exp(-2))


def test_the_errors_of_matches_are_pixels_of_the_photo():
    found: Any = SimpleNamespace(photo_px=np.zeros((1, 2), np.float32), points_in_world=np.zeros((1, 3), np.float32))
    assert rig._matches(photo(at()), found, 3.0).max_error_px == pytest.approx(3.0 * 640 / PHOTO_PX)


@pytest.mark.parametrize(
    ("inliers", "count", "sure"), [(60, 400, True), (59, 100, False), (149, 1000, False), (150, 1000, True)]
)
def test_a_search_ends_with_sixty_matches_and_three_in_twenty(inliers, count, sure):
    assert search()._is_sure(_Hypothesis(at(), inliers, count, NONE)) is sure


@pytest.mark.parametrize(("off_px", "same"), [(5.9, True), (6.1, False)])
def test_poses_that_explain_half_of_one_anothers_matches_are_the_same(off_px, same):
    mounts = at(), at(1.0)
    one = search(photo(mounts[0]), photo(mounts[1]))
    best = _Hypothesis(at(), 90, 100, NONE)
    # Of ten and ten, half are exact; the others within three times the largest error of an inlier.
    other = (matches(6, mounts[0]), matches(6, mounts[1], off_px))
    assert one._is_same(_Hypothesis(at(9.0), 24, 30, NONE, other), best) is same
    assert one._is_same(_Hypothesis(at(9.0), 25, 30, NONE, other), best) is False
    assert not one._is_same(_Hypothesis(at(9.0), 0, 30, NONE), best)


def rematched(monkeypatch: pytest.MonkeyPatch, counts: list[int | None]) -> tuple[_Hypothesis, list[Pose]]:
    """Match again and again, with so many inliers each time."""
    one, rendered = search(photo(at()), photo(at(1.0))), []
    left = iter(enumerate(counts))
    view = SimpleNamespace(view=lambda matcher: None)
    one._renderer = SimpleNamespace(at=lambda query, pose: rendered.append(pose) or view)
    fresh = SimpleNamespace(photo_px=np.zeros((50, 2), np.float32), points_in_world=np.zeros((50, 3), np.float32))

    def estimate(all_matches, trials, starts):
        assert (len(all_matches), trials, len(starts)) == (2, 1000, 1)
        number, count = next(left)
        agree = [np.arange(50) < 3, np.arange(50) < 4]
        return count and SimpleNamespace(world_from_rig=at(0.1 * (number + 1)), num_inliers=count, inliers=agree)

    monkeypatch.setattr(rig, "correspondences", lambda *_: fresh)
    monkeypatch.setattr(rig, "estimate_rig_pose", estimate)
    monkeypatch.setattr(rig, "match_information", lambda *_: np.eye(6))
    return one._rematched(at(5.0)), rendered


@pytest.mark.parametrize(
    ("counts", "rounds"),
    [
        ([100, 106, 107, 200], 3),  # less than a twentieth more
        ([100, 104, 200], 2),
        ([20, 40, 80, 160, 320, 640], 5),
        ([11, 100], 1),  # chance
        ([12, 11, 100], 2),
        ([12, 13, 12, 100], 3),
    ],
)
def test_a_pose_is_rendered_and_matched_until_it_settles(monkeypatch, counts, rounds):
    found, rendered = rematched(monkeypatch, counts)
    assert len(rendered) == 2 * rounds
    assert found.inliers == counts[rounds - 1]
    assert found.matches == 100
    assert [len(agreeing.photo_px) for agreeing in found.agreeing] == [3, 4]
    assert found.world_from_rig.position_in_world[0] == pytest.approx(0.1 * rounds)
    # Each photo at its own place in the rig, which moves from render to render.
    assert [pose.position_in_world[0] for pose in rendered[:2]] == [5.0, 6.0]
    if rounds > 1:
        assert [pose.position_in_world[0] for pose in rendered[2:4]] == pytest.approx([0.1, 1.1])


def test_where_nothing_agrees_the_pose_stays(monkeypatch):
    found, _ = rematched(monkeypatch, [30, None])
    assert (found.inliers, found.matches, found.agreeing) == (0, 100, ())


def searched(monkeypatch: pytest.MonkeyPatch, inliers: list[int], budget_s: float | None = None) -> tuple[Any, Any]:
    """Search, one hypothesis a round with so many inliers."""
    one = search(photo(at()), budget_s=budget_s)
    left, rounds = iter(inliers), []

    def hypotheses(views, factor):
        rounds.append(views)
        yield at(float(len(rounds))), 5

    one._hypotheses, one._likeliest = hypotheses, lambda: at(42.0)
    one._rematched = lambda pose: _Hypothesis(pose, next(left), 100, NONE)
    return one._searched(), rounds


@pytest.mark.parametrize(
    ("inliers", "budget_s", "rounds", "best"),
    [
        ([60], None, [5], 1),
        ([20, 60], None, [5, 16], 2),
        ([30, 20, 10], None, [5, 16, 48], 1),
        ([30, 20, 10], 2.0, [5, 16, 48], 1),
        ([30, 20, 10], 0.5, [5], 1),
    ],
)
def test_more_views_are_matched_until_one_pose_is_sure_or_time_is_up(monkeypatch, inliers, budget_s, rounds, best):
    (found, rivals), asked = searched(monkeypatch, inliers, budget_s)
    assert asked == rounds
    assert found.world_from_rig.position_in_world[0] == best
    assert len(rivals) == len(rounds) - 1


def test_where_nothing_matches_the_likeliest_view_is_told():
    one = search(photo(at()))
    one._hypotheses, one._likeliest = lambda views, factor: iter(()), lambda: at(42.0)
    found, rivals = one._searched()
    assert (found.world_from_rig.position_in_world[0], found.inliers, rivals) == (42.0, 0, [])


@pytest.mark.parametrize(("inliers", "starts"), [(9, 0), (10, 1)])
def test_a_pose_by_one_view_is_tried_from_ten_matches_on(monkeypatch, inliers, starts):
    alone = SimpleNamespace(pose=at(3.0), num_inliers=inliers)
    monkeypatch.setattr(rig, "estimate_absolute_pose", lambda *arguments: alone if arguments[-1] == 300 else None)
    part: Any = SimpleNamespace(photo_px=np.zeros((20, 2), np.float32), points_in_world=np.zeros((20, 3), np.float32))
    found = search()._starts(photo(at(1.0)), [part], 2.0)
    assert [(pose.position_in_world[0], count) for pose, count in found] == [(2.0, 10)][:starts]


def run_with(monkeypatch: pytest.MonkeyPatch, best: int, rivals: list[int], covariance: Any) -> tuple[Any, dict]:
    """Run a search that has found a pose 5 beside the origin, and that ends 6 beside it."""
    one, asked = search(photo(at()), photo(at(1.0))), {}
    one._photos[0].query.accuracy = Accuracy()
    one._loaded, one._tally = None, SimpleNamespace(count=7)
    elsewhere = [_Hypothesis(at(9.0), inliers, 100, NONE) for inliers in rivals]
    one._searched = lambda: (_Hypothesis(at(5.0), best, 100, np.eye(6)), elsewhere)
    one._renderer = SimpleNamespace(at=lambda query, pose: SimpleNamespace(frame=pose.position_in_world[0]))
    one._with_readings = lambda verdict, pose, found: ("query", verdict, pose, found)
    bare = Verdict(Status.UNCERTAIN, Reason.FEW_INLIERS, 0.1, 30, 0.5, 1.0, None)

    def refined(cameras, pose, information, renderer):
        asked["refined"] = [mount.position_in_world[0] for _, mount in cameras], pose.position_in_world[0]
        return at(6.0), covariance

    def judged(verdicts, covariance, bounds, rival):
        asked.update(verdicts=verdicts, covariance=covariance, bounds=bounds, rival=rival)
        return replace(bare, inliers=99)

    monkeypatch.setattr(rig, "refine_rig", refined)
    monkeypatch.setattr(rig, "verify", lambda images, pose, rendered: replace(bare, coverage=rendered.frame))
    # The first photo's depth alone counts.
    monkeypatch.setattr(rig, "typical_depth", lambda frame: asked.setdefault("depths", []).append(frame) or 10.0)
    monkeypatch.setattr(rig, "rig_verdict", judged)
    monkeypatch.setattr(rig, "estimate_of", lambda *given, **more: asked.update(told=given, **more))
    return one.run(), asked


@pytest.mark.parametrize(
    ("best", "rivals", "share"), [(60, [12, 30], 0.5), (60, [], 0.0), (0, [3], 3.0), (1, [2], 2.0), (60, [60], 1.0)]
)
def test_a_rig_is_judged_by_its_photos_and_its_best_rival(monkeypatch, best, rivals, share):
    spread = np.diag([1.0, 2, 3, 4, 5, 6])
    found, asked = run_with(monkeypatch, best, rivals, spread)
    assert asked["refined"] == ([0.0, 1.0], 5.0)
    assert found.world_from_rig.position_in_world[0] == 6.0
    assert [pose.position_in_world[0] for pose, _ in found.photos] == [6.0, 7.0]
    assert asked["rival"] == share
    assert (asked["bounds"].deg, asked["bounds"].units, asked["depths"]) == (5.0, pytest.approx(0.2), [6.0])
    assert [verdict.coverage for verdict in asked["verdicts"]] == [6.0, 7.0]
    # Of the first photo, which is the rig's own frame; the second's is turned by what lies between.
    assert np.array_equal(asked["covariance"], spread)
    between = adjoint(at(-1.0).world_from_camera)
    assert [verdict.covariance for _, verdict in found.photos] == [
        pytest.approx(spread),
        pytest.approx(between @ spread @ between.T),
    ]
    assert asked["told"][0] == "query"
    assert (asked["told"][3].inliers, asked["renders"]) == (99, 7)
    assert [record.stage for record in asked["told"][4]] == ["refine_rig", "verify_rig"]
    unknown, asked = run_with(monkeypatch, best, rivals, None)
    assert asked["covariance"] is None
    assert [verdict.covariance for _, verdict in unknown.photos] == [None, None]


def test_readings_move_the_whole_rig_if_they_move_its_first_photo(monkeypatch):
    one = search(photo(at(1.0)), photo(at(3.0)))
    one._photos[0].query.warnings = ("before",)
    one._request, one._loaded = Request(), SimpleNamespace(scene=SimpleNamespace(info=SimpleNamespace(sha256="a")))
    monkeypatch.setattr(rig, "contradictions", lambda *_: ("against",))
    monkeypatch.setattr(rig, "replace", lambda value, **changes: SimpleNamespace(**vars(value) | changes))
    found = [(at(6.0), SimpleNamespace(covariance=None)), (at(8.0), SimpleNamespace(covariance=None))]
    told = SimpleNamespace(covariance=np.diag([1.0, 2, 3, 4, 5, 6]))
    moved_to = at(6.5)
    for own, verdict, moves in (
        (found[0][0], told, False),
        (moved_to, SimpleNamespace(covariance=None), False),
        (moved_to, told, True),
    ):
        monkeypatch.setattr(rig, "fused", lambda *_, own=own, verdict=verdict: (own, verdict))
        query, final, pose, photos = one._with_readings("verdict", at(5.0), found)
        assert query.warnings == ("before", "against")
        if not moves:
            assert (final, photos) == ("verdict", found)
            assert pose.position_in_world[0] == 5.0
            continue
        assert final is told
        assert pose.position_in_world[0] == 5.5
        assert [each.position_in_world[0] for each, _ in photos] == [6.5, 8.5]
        # Two units lie between the two.
        between = adjoint(at(-2.0).world_from_camera)
        assert photos[0][1].covariance == pytest.approx(told.covariance)
        assert photos[1][1].covariance == pytest.approx(between @ told.covariance @ between.T)


@pytest.mark.parametrize(
    ("inliers", "preferred", "best", "left_over"),
    [(80, True, 80, [20]), (79, True, 100, [20, 79]), (80, False, 100, [20, 80])],
)
def test_readings_decide_between_poses_with_four_fifths_of_the_matches(inliers, preferred, best, left_over):
    one, left = search(photo(at())), iter([100, inliers, 20])
    one._hypotheses = lambda views, factor: iter([(at(float(views)), 5)])
    one._rematched = lambda pose: _Hypothesis(pose, next(left), 1000, NONE)
    one._twins = lambda found: 1 / 0  # none is sure
    one._readings_prefer = lambda a, b: preferred and (a.inliers, b.inliers) in ((80, 100), (79, 100))
    found, rivals = one._searched()
    assert found.inliers == best
    # What the readings speak against is no rival.
    assert sorted(rival.inliers for rival in rivals) == left_over


def test_twins_of_a_sure_pose_are_tried_and_what_explains_its_matches_is_none():
    one, left = search(photo(at())), iter([70, 65, 64])
    one._hypotheses = lambda views, factor: iter([(at(1.0), 5)])
    one._twins = lambda found: [at(found.world_from_rig.position_in_world[0] + k) for k in (10, 20)]
    one._rematched = lambda pose: _Hypothesis(pose, next(left), 100, NONE)
    one._is_same = lambda other, best: other.inliers == 64
    found, rivals = one._searched()
    assert found.inliers == 70
    assert [(rival.inliers, rival.world_from_rig.position_in_world[0]) for rival in rivals] == [(65, 11.0)]


def test_hypotheses_are_those_of_all_matches_then_of_single_views_then_of_the_rest(monkeypatch):
    one = search(photo(at()), photo(at(1.0)))
    one._images = [None, None]
    asked: list[Any] = []
    variant = SimpleNamespace(scaled=lambda factor: SimpleNamespace(max_error_px=4.0, factor=factor))

    def ranked(of, count, support):
        asked.append((of.factor, count, support.tolist()))
        return [0, 1]

    one._retrievals = [
        SimpleNamespace(
            upright_variant=lambda: variant,
            rotated_variant=lambda upright: upright,
            features=lambda v: v,
            ranked=ranked,
        )
    ] * 2
    one._support = lambda: np.array([[0.25, 0.5], [1.0, 0.0]])
    one._index, one._loaded = SimpleNamespace(views=["first", "second"]), SimpleNamespace(matcher=None)
    one._starts = lambda of, parts, error_px: [
        (at(100 * of.rig_from_camera.position_in_world[0] + len(parts)), error_px)
    ]
    two = Correspondences(*(np.zeros((3, size), np.float32) for size in (2, 2, 3)))
    monkeypatch.setattr(rig, "correspondences", lambda *_: two)
    solved: list[Any] = []

    def estimate(matches, trials, starts):
        solved.append(([len(each.photo_px) for each in matches], trials, len(starts)))
        if len(solved) > 2:
            return None
        agree = [np.arange(len(each.photo_px)) < 2 for each in matches]
        return SimpleNamespace(world_from_rig=at(float(len(solved))), num_inliers=4, inliers=agree)

    monkeypatch.setattr(rig, "estimate_rig_pose", estimate)
    found = list(one._hypotheses(7, 0.5))
    # What the other photos say of a view counts twice.
    assert asked == [(0.5, 7, [0.5, 1.0]), (0.5, 7, [2.0, 0.0])]
    assert [pose.position_in_world[0] for pose, _ in found] == [1.0, 2.0, 102.0, 2.0]
    # The matches that agreed are left out in turn; starts are tried once.
    assert solved == [([6, 6], 1000, 2), ([4, 4], 1000, 0), ([2, 2], 1000, 0)]


def test_the_likeliest_pose_has_the_first_photo_at_the_view_most_like_it():
    one = search(photo(at(1.0)), photo(at(2.0)))
    one._index = SimpleNamespace(views=[SimpleNamespace(camera=SimpleNamespace(pose=at(x))) for x in (3.0, 5.0, 7.0)])
    one._retrievals = [SimpleNamespace(upright_variant=lambda: None, scores=lambda _: np.array([0.1, 0.9, 0.3]))]
    assert one._likeliest().position_in_world[0] == 4.0


def test_other_photos_speak_for_views_that_put_this_one_near_them():
    """The second photo is 2 beside the first: where it scores at a view, the view 2 before that gains."""
    one = search(photo(at()), photo(at(2.0)))
    views = [SimpleNamespace(camera=SimpleNamespace(pose=at(x))) for x in (0.0, 2.0, 50.0)]
    one._index, one._reach = SimpleNamespace(views=views), 1.0
    scores = [np.array([0.1, 0.2, 0.9]), np.array([0.0, 0.8, 0.0])]
    one._retrievals = [
        SimpleNamespace(upright_variant=lambda: None, scores=lambda _, given=given: given) for given in scores
    ]
    assert one._support() == pytest.approx(np.array([[0.8, 0.0, 0.0], [0.0, 0.1, 0.0]]), abs=1e-6)


def test_a_cancelled_search_ends():
    cancel = Event()
    one = search(cancel=cancel)
    one._check()
    cancel.set()
    with pytest.raises(Cancelled):
        one._check()
    search()._check()


def test_records_are_of_the_first_photo_and_numbered():
    told: list[Any] = []
    one = search(photo(at(1.0)), photo(at(2.0)))
    one._report = told.append
    one._add("match_rig", at(5.0), 7)
    one._add("refine_rig", at(6.0), None)
    assert [(r.stage, r.index, r.num_inliers, r.pose.position_in_world[0]) for r in told] == [
        ("match_rig", 0, 7, 6.0),
        ("refine_rig", 1, None, 7.0),
    ]
