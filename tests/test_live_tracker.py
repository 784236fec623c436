"""A live session's decisions and their bounds, without a scene: what is searched, followed, kept, told and advised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.errors import InvalidImage
from service.geometry import se3_exp
from service.live import live_tracker
from service.live.live_tracker import LIVE, LiveTracker, _Followed, _Found, _resized
from service.live.live_values import FusedOdometry, LiveAnswer, LiveFrame, LiveTask
from service.live.odometry_scale import ScaleMemory
from service.live.pace import Pace
from service.live.recent_views import RecentViews
from service.photos.images import encode_image
from service.results import Reason, Status, Verdict
from service.types import Intrinsics, IntrinsicsCorrection, LensPrior, Pose, SceneInfo

LENS = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)
VERIFIED = Verdict(Status.LOCALIZED, Reason.VERIFIED, 0.9, 80, 0.9, 0.9, None)


def at(x: float = 0.0, *, turn_deg: float = 0.0) -> Pose:
    return Pose(se3_exp(np.array([0.0, np.radians(turn_deg), 0.0, 0.0, 0.0, 0.0])) + x * np.eye(4, k=3))


def frame(number: int, time_s: float = 0.0, data: bytes = b"") -> LiveFrame:
    return LiveFrame(number, time_s, data)


class Beside:
    """A background that notes what it is asked for and answers what it is told."""

    def __init__(self) -> None:
        self.calls: list[Callable[[Any], Any]] = []
        self.idle = True
        self.found: _Found | None = None

    def start(self, call: Callable[[Any], Any]) -> None:
        self.calls.append(call)

    def result(self) -> _Found | None:
        return self.found

    def close(self) -> None:
        pass


@pytest.fixture
def tracker(monkeypatch: pytest.MonkeyPatch) -> LiveTracker:
    info = SceneInfo("room", "room", "0" * 64, "ply")
    tracker = LiveTracker(
        LiveTask("room", "view_index", intrinsics=LENS), SimpleNamespace(scene=SimpleNamespace(info=info))
    )  # type: ignore[arg-type]
    tracker._background.close()
    tracker._background = Beside()  # type: ignore[assignment]
    return tracker


def bright(contrast: float = 50.0) -> Any:
    rgb = np.full((16, 16, 3), 100.0)
    rgb[::16, ::8] += contrast
    rgb[8::16, ::8] -= contrast
    return SimpleNamespace(rgb=rgb, lens_prior=None, prior=None)


# ------------------------------------------------------------------ frames


def test_a_frame_is_a_jpeg_of_at_most_so_many_pixels(tracker):
    picture = np.zeros((48, 64, 3), np.uint8)
    assert tracker._checked_size(frame(1, data=encode_image(picture, "jpeg"))) == (64, 48)
    with pytest.raises(InvalidImage, match="is a JPEG"):
        tracker._checked_size(frame(1, data=encode_image(picture, "png")))
    for most, fits in ((64 * 48, True), (64 * 48 - 1, False)):
        tracker._config = replace(LIVE, max_pixels=most)
        if fits:
            assert tracker._checked_size(frame(1, data=encode_image(picture, "jpeg"))) == (64, 48)
        else:
            with pytest.raises(InvalidImage, match="at most 3071 pixels, not 64 x 48"):
                tracker._checked_size(frame(1, data=encode_image(picture, "jpeg")))


@pytest.mark.parametrize(
    ("size", "fx"), [((128, 96), 100.0), ((1280, 951), 1000.0), ((1280, 940), 50.0), ((32, 24), 25.0)]
)
def test_intrinsics_are_for_frames_of_the_same_shape_within_a_hundredth(size, fx):
    assert _resized(LENS, size).fx == pytest.approx(fx)


@pytest.mark.parametrize(("contrast", "dark"), [(6.1, False), (5.9, True)])
def test_in_the_dark_nothing_is_searched(tracker, contrast, dark):
    query = bright(contrast)
    assert float(query.rgb[::8, ::8].std()) == pytest.approx(contrast)
    tracker._begin_in_background(query, 1.0, None)
    assert len(tracker._background.calls) == (not dark)


@pytest.mark.parametrize(
    ("past", "due", "idle", "dark", "expected"),
    [
        (False, False, True, False, ["move", "take over", "query", "begin None", "keep", "answer None"]),
        (False, False, False, False, ["move", "take over", "keep", "answer None"]),
        (True, True, False, False, ["move", "take over", "query", "follow", "begin seen", "keep", "answer seen"]),
        (True, True, True, True, ["move", "take over", "query", "begin None", "keep", "answer None"]),
        (True, False, True, False, ["move", "take over", "query", "begin None", "keep", "answer None"]),
        (True, False, False, False, ["move", "take over", "keep", "answer None"]),
    ],
)
def test_a_frame_is_followed_or_searched_for_then_kept_and_answered(
    tracker, monkeypatch, past, due, idle, dark, expected
):
    done: list[str] = []
    tracker._fusion = SimpleNamespace(move=lambda *given: done.append("move"), resets=4)
    tracker._background.idle = idle
    if past:
        tracker._past.append((0.0, at()))
    for name, step in {
        "_checked_size": lambda frame: (64, 48),
        "_take_over": lambda: done.append("take over"),
        "_is_due": lambda frame: due,
        "_query": lambda frame, size: done.append("query") or "query",
        "_is_dark": lambda query: dark,
        "_followed": lambda query, time_s: done.append("follow") or "seen",
        "_begin_in_background": lambda query, time_s, followed: done.append(f"begin {followed}"),
        "_keep": lambda frame: done.append("keep"),
    }.items():
        monkeypatch.setattr(tracker, name, step)
    told = LiveAnswer(7, 20.0, "lost", (64, 48))
    monkeypatch.setattr(tracker, "_answer", lambda frame, size, followed: done.append(f"answer {followed}") or told)
    answer = tracker.use(replace(frame(7, 20.0), odom_from_camera=at(2.0)))
    assert done == expected
    assert replace(answer, used_s=told.used_s) == told
    assert 0 < answer.used_s < 10
    # The odometry relates the frame to those before it.
    ((kept, odom),) = tracker._views._kept
    assert (kept.id, odom.position_in_world[0], tracker._views._segment) == (7, 2.0, 4)
    done.clear()
    tracker.use(frame(8, 21.0))
    assert done == expected[1:]
    assert len(tracker._views._kept) == 1


# ------------------------------------------------------------------ when to follow and when to search


@pytest.mark.parametrize(
    ("now_s", "verified_s", "tried_s", "due"),
    [
        (10.39, 10.0, 10.35, True),  # the last pose is 0.4 s old
        (10.41, 10.0, 10.35, False),
        (10.3, 9.3, 10.25, True),  # the last verified one 1 s
        (10.3, 9.29, 10.25, False),
        (12.0, 9.5, 11.8, True),  # lost: every tenth of a second, up to three seconds
        (12.0, 9.5, 11.95, False),
        (12.6, 9.5, 11.8, False),
        (19.0, 9.5, 9.4, True),  # not tried yet
        (19.0, 9.5, 9.5, True),
        (19.0, 9.5, 9.6, False),
    ],
)
def test_a_camera_is_looked_for_where_it_was(tracker, now_s, verified_s, tried_s, due):
    tracker._past.append((10.0, at()))
    tracker._verified_s, tracker._tried_s = verified_s, tried_s
    assert tracker._is_due(frame(1, now_s)) is due


@pytest.mark.parametrize("carried", [True, False])
def test_where_odometry_tells_the_place_it_is_looked_for_all_the_time(tracker, carried):
    tracker._past.append((10.0, at()))
    tracker._verified_s, tracker._tried_s = 10.0, 15.0
    tracker._fusion = SimpleNamespace(carried=lambda: (at(), np.eye(6)) if carried else None)
    assert tracker._is_due(frame(1, 20.0)) is carried


@pytest.mark.parametrize(
    ("followed", "unverified_s", "unchecked_s", "doubt", "begun"),
    [
        (False, 0.0, 0.0, None, "search"),
        (True, 0.14, 0.9, None, None),
        (True, 0.16, 0.9, None, "search"),
        (True, 0.14, 1.0, None, None),
        (True, 0.14, 1.1, None, "check"),
        (True, 0.14, 0.9, Reason.FEW_INLIERS, "search"),
    ],
)
def test_a_search_or_a_check_begins_in_time(tracker, monkeypatch, followed, unverified_s, unchecked_s, doubt, begun):
    begins: list[str] = []
    monkeypatch.setattr(tracker, "_searched", lambda *_: begins.append("search"))
    monkeypatch.setattr(tracker, "_checked", lambda *_: begins.append("check"))
    tracker._verified_s, tracker._checked_s, tracker._doubt = 10 - unverified_s, 10 - unchecked_s, doubt
    seen = _Followed(at(), VERIFIED, bright()) if followed else None
    tracker._begin_in_background(bright(), 10.0, seen)
    for call in tracker._background.calls:
        call(None)
    assert begins == ([begun] if begun else [])
    tracker._background.idle = False
    tracker._background.calls.clear()
    tracker._begin_in_background(bright(), 10.0, None)
    assert not tracker._background.calls


def test_every_third_search_is_for_frames_together(tracker, monkeypatch):
    begins: list[str] = []
    monkeypatch.setattr(tracker, "_searched", lambda *_: begins.append("one"))
    monkeypatch.setattr(tracker, "_searched_together", lambda *_: begins.append("rig"))
    monkeypatch.setattr(tracker, "_rig", lambda _: ["a photo"])
    for tracker._searches in range(6):
        tracker._begin_in_background(bright(), 10.0, None)
        tracker._background.calls[-1](None)
    assert begins == ["one", "one", "rig"] * 2


def test_searches_take_two_and_six_seconds_in_turn(tracker, monkeypatch):
    budgets: list[float] = []

    def search(query, loaded, request):
        budgets.append(request.budget_s)
        return SimpleNamespace()

    monkeypatch.setattr(live_tracker, "localize_in_scene", search)
    tracker._loaded = SimpleNamespace(as_seen_by=lambda _: None)
    for tracker._searches in range(3):
        tracker._searched(bright(), 1.0, SimpleNamespace())
    assert budgets == [2.0, 6.0, 2.0]


@pytest.mark.parametrize(("sigma", "count"), [(0.049, 2), (0.051, 0)])
def test_frames_go_together_where_lengths_are_known(tracker, monkeypatch, sigma, count):
    query = SimpleNamespace(lens_prior=None, prior=None)
    monkeypatch.setattr(tracker, "_alone", lambda query: query)
    monkeypatch.setattr(tracker, "_query", lambda *_: query)
    monkeypatch.setattr(tracker, "_checked_size", lambda _: (64, 48))
    monkeypatch.setattr(live_tracker, "RigPhoto", lambda query, pose: pose)
    tracker._fusion = SimpleNamespace(scale=(0.5, sigma))
    tracker._views.add(frame(1), at(0.0), 0)
    tracker._views.add(frame(2), at(4.0), 0)
    found = tracker._rig(query)
    assert [pose.position_in_world[0] for pose in found] == [0.0, -2.0][:count]
    tracker._fusion = SimpleNamespace(scale=None)
    assert tracker._rig(query) == []


DYADIC = replace(
    LIVE, stale_s=0.5, unverified_s=1.0, retry_s=3.0, retry_every_s=0.125, kept_every_s=0.0625, search_after_s=0.125,
    check_every_s=1.0, most_scale_sigma=0.25,
)  # fmt: skip
"""Times that are exact in binary: differences of frames' times are at the bounds themselves."""


@pytest.mark.parametrize(
    ("now_s", "verified_s", "tried_s", "due"),
    [
        (10.5, 9.5, 10.4, True), (10.51, 9.6, 10.45, False), (10.5, 9.49, 10.45, False),
        (12.5, 9.5, 12.375, True), (12.5, 9.5, 12.376, False), (12.5, 9.49, 12.0, False),
    ],
)  # fmt: skip
def test_times_at_their_bounds_are_in_time(tracker, now_s, verified_s, tried_s, due):
    tracker._config = DYADIC
    tracker._past.append((10.0, at()))
    tracker._verified_s, tracker._tried_s = verified_s, tried_s
    assert tracker._is_due(frame(1, now_s)) is due


def test_nothing_is_searched_or_checked_before_its_time(tracker, monkeypatch):
    tracker._config = DYADIC
    begins: list[str] = []
    monkeypatch.setattr(tracker, "_searched", lambda *_: begins.append("search"))
    monkeypatch.setattr(tracker, "_checked", lambda *_: begins.append("check"))
    for verified_s, checked_s, begun in ((9.875, 9.0, []), (9.874, 9.0, ["search"]), (9.875, 8.999, ["check"])):
        begins.clear()
        tracker._background.calls.clear()
        tracker._verified_s, tracker._checked_s = verified_s, checked_s
        tracker._begin_in_background(bright(), 10.0, _Followed(at(), VERIFIED, bright()))
        for call in tracker._background.calls:
            call(None)
        assert begins == begun
    contrast = float(bright().rgb[::8, ::8].std())
    for least, dark in ((contrast, False), (1.001 * contrast, True)):
        tracker._config = replace(DYADIC, min_contrast=least)
        assert tracker._is_dark(bright()) is dark


def test_a_velocity_as_old_as_the_bound_is_continued_and_a_scale_as_uncertain_relates_frames(tracker, monkeypatch):
    tracker._config = DYADIC
    for time_s in (1.0, 1.25):
        tracker._past.append((time_s, at(4 * (time_s - 1))))
    assert tracker._expected(1.75).position_in_world[0] == 3.0
    assert tracker._expected(1.751).position_in_world[0] == 1.0
    query = SimpleNamespace(lens_prior=None, prior=None)
    monkeypatch.setattr(tracker, "_alone", lambda query: query)
    monkeypatch.setattr(tracker, "_query", lambda *_: query)
    monkeypatch.setattr(tracker, "_checked_size", lambda _: (64, 48))
    monkeypatch.setattr(live_tracker, "RigPhoto", lambda query, pose: pose)
    tracker._views.add(frame(1), at(0.0), 0)
    tracker._views.add(frame(2), at(4.0), 0)
    for sigma, count in ((0.25, 2), (0.251, 0)):
        tracker._fusion = SimpleNamespace(scale=(0.5, sigma))
        assert len(tracker._rig(query)) == count


# ------------------------------------------------------------------ what a search leads to


def test_frames_are_kept_while_a_search_runs_and_thinned_out(tracker):
    tracker._background.idle = False
    for number in range(41):
        tracker._keep(frame(number, 0.07 * number))
    assert [kept.id for kept in tracker._kept] == list(range(0, 41, 2))
    tracker._keep(frame(50, 0.07 * 40 + 0.11))
    assert tracker._kept[-1].id == 40
    tracker._keep(frame(51, 0.07 * 40 + 0.13))
    assert tracker._kept[-1].id == 51
    tracker._background.idle = True
    tracker._keep(frame(52, 9.0))
    assert tracker._kept == []
    tracker._background.idle = False
    for number, time_s in ((60, 10.0), (61, 10.05), (62, 10.06)):
        tracker._keep(frame(number, time_s))
    assert [kept.id for kept in tracker._kept] == [60, 62]


def estimate(status: Status, pose: Pose) -> Any:
    verdict = replace(VERIFIED, status=status)
    return SimpleNamespace(verdict=verdict, records=[SimpleNamespace(pose=pose, lens=None, correction=None)])


def test_a_searchs_answer_is_taken_unless_the_camera_was_found_meanwhile(tracker, monkeypatch):
    followed: list[float] = []
    monkeypatch.setattr(tracker, "_followed", lambda query, time_s: followed.append(time_s))
    monkeypatch.setattr(tracker, "_query", lambda *_: None)
    monkeypatch.setattr(tracker, "_checked_size", lambda _: (64, 48))
    background, loaded = tracker._background, tracker._loaded
    background.found = _Found(bright(), 5.0, estimate(Status.NOT_LOCALIZED, at(1.0)), None, loaded)
    tracker._take_over()
    assert (tracker._searches, list(tracker._past), tracker._run) == (1, [], 0)
    background.found = _Found(bright(), 5.0, estimate(Status.LOCALIZED, at(1.0)), None, loaded)
    tracker._verified_s = 5.1
    tracker._take_over()
    assert list(tracker._past) == []
    tracker._verified_s, tracker._past = 5.0, type(tracker._past)([(4.0, at(9.0)), (4.5, at(9.0))], maxlen=2)
    tracker._kept = [frame(1, 4.9), frame(2, 5.0), frame(3, 5.1), frame(4, 5.2)]
    tracker._take_over()
    assert [(time_s, pose.position_in_world[0]) for time_s, pose in tracker._past] == [(5.0, 1.0)]
    assert (tracker._searches, tracker._run, tracker._verified_s, tracker._checked_s) == (0, 1, 5.0, 5.0)
    assert followed == [5.1, 5.2]
    # What the whole gate doubts gives way to a search, however old.
    tracker._doubt, tracker._verified_s = Reason.FEW_INLIERS, 7.0
    tracker._take_over()
    assert (tracker._doubt, tracker._run) == (None, 2)


@pytest.mark.parametrize(
    ("status", "reason", "doubt", "fixes", "verified"),
    [
        (Status.LOCALIZED, Reason.VERIFIED, None, 1, True),
        (Status.LOCALIZED, Reason.VERIFIED, Reason.FEW_INLIERS, 0, True),
        (Status.UNCERTAIN, Reason.LOW_COVERAGE, None, 0, False),
        (Status.NOT_LOCALIZED, Reason.LOW_COVERAGE, None, 0, None),
    ],
)
def test_a_followed_frame_counts_by_its_verdict(tracker, monkeypatch, status, reason, doubt, fixes, verified):
    fixed: list[Any] = []
    told = replace(VERIFIED, status=status, reason=reason, covariance=np.eye(6))
    frame_seen = SimpleNamespace(median_depth=np.full((8, 8), 3.0, np.float32))
    found = SimpleNamespace(pose=at(2.0), rendered=SimpleNamespace(frame=frame_seen))
    learnt: list[Any] = []
    monkeypatch.setattr(live_tracker, "photometric_verdict", lambda *_: told)
    monkeypatch.setattr(live_tracker, "QueryImages", lambda query, matcher: "images")
    monkeypatch.setattr(tracker, "_refined", lambda images, expected: found)
    tracker._loaded = SimpleNamespace(matcher=None)
    tracker._lens = SimpleNamespace(update=lambda *given: learnt.append(given))
    tracker._fusion = SimpleNamespace(fix=lambda *given: fixed.append(given), predicted=lambda *given: given[-1])
    tracker._past.append((9.0, at()))
    tracker._doubt, tracker._searches, tracker._run = doubt, 2, 4
    answer = tracker._followed(bright(), 9.1)
    assert tracker._tried_s == 9.1
    assert len(fixed) == fixes
    if fixes:
        time_s, pose, covariance, depth, run = fixed[0]
        assert (time_s, pose, depth, run) == (9.1, found.pose, 3.0, 4)
        assert np.array_equal(covariance, np.eye(6))
    assert (tracker._verified_s == 9.1) is (verified is True)
    assert (learnt == [("images", found)]) is (verified is True)
    assert tracker._searches == (0 if fixes else 2)
    assert (answer is None) is (verified is None)
    assert len(tracker._past) == (1 if verified is None else 2)


def test_a_lens_that_a_search_estimated_is_that_of_the_next_frames(tracker):
    learnt: list[Any] = []
    tracker._lens = SimpleNamespace(set=lambda *given: learnt.append(given), correction=IntrinsicsCorrection(2.0))
    approximate, exact = replace_of(bright(), lens_prior=LensPrior(0.5)), bright()
    verdict = replace(VERIFIED, correction_sigma=(0.02, 0.0, 0.0, 0.0))
    for query, lens, focal_sigma in (
        (exact, None, verdict), (approximate, LENS, verdict), (approximate, None, VERIFIED),
        (approximate, None, verdict),
    ):  # fmt: skip
        found = estimate(Status.LOCALIZED, at(1.0))
        found.verdict = focal_sigma
        found.records[-1].lens, found.records[-1].correction = lens, IntrinsicsCorrection(1.5)
        tracker._background.found = _Found(query, 5.0, found, None, tracker._loaded)
        tracker._take_over()
    ((pose, correction, prior),) = learnt
    assert (pose.position_in_world[0], correction.focal_factor, prior) == (1.0, 3.0, LensPrior(0.02))


def replace_of(query: Any, **changes: Any) -> Any:
    return SimpleNamespace(**vars(query) | changes)


def test_a_check_says_what_there_is_to_doubt(tracker):
    wrong = replace(VERIFIED, status=Status.NOT_LOCALIZED, reason=Reason.RENDER_MISMATCH)
    for checked, doubt in ((wrong, Reason.RENDER_MISMATCH), (VERIFIED, None)):
        tracker._background.found = _Found(bright(), 5.0, None, checked, tracker._loaded)
        tracker._take_over()
        assert (tracker._doubt, tracker._checked_s) == (doubt, 5.0)


def test_the_velocity_is_not_continued_over_a_gap(tracker):
    for time_s in (1.0, 1.1):
        tracker._past.append((time_s, at(10 * (time_s - 1))))
    for time_s, x in ((1.2, 2.0), (1.5, 3.0), (1.51, 1.0)):
        # Two intervals ahead at most.
        assert tracker._expected(time_s).position_in_world[0] == pytest.approx(x), time_s


# ------------------------------------------------------------------ what is told


def told(tracker: LiveTracker, followed: _Followed | None, *, verified_s: float, odometry: bool = False) -> Any:
    tracker._verified_s = verified_s
    one = replace(frame(7, 20.0), odom_from_camera=at() if odometry else None)
    return tracker._answer(one, (64, 48), followed)


def test_an_answer_says_how_the_pose_is_known(tracker):
    seen = _Followed(at(1.0), VERIFIED, SimpleNamespace(photo_intrinsics=LENS))  # type: ignore[arg-type]
    answer = told(tracker, seen, verified_s=19.0)
    assert (answer.id, answer.mode, answer.intrinsics, answer.verdict) == (7, "tracking", LENS, VERIFIED)
    assert told(tracker, seen, verified_s=18.9).mode == "relocalizing"  # astray for more than a second
    assert told(tracker, None, verified_s=20.0).mode == "relocalizing"
    tracker._searches = 1
    assert told(tracker, None, verified_s=20.0).mode == "lost"
    tracker._doubt = Reason.FEW_INLIERS
    doubted = told(tracker, seen, verified_s=20.0).verdict
    assert (doubted.status, doubted.reason) == (Status.UNCERTAIN, Reason.FEW_INLIERS)


def test_positions_are_told_in_the_scenes_own_world(tracker):
    similarity = FusedOdometry(np.eye(4), 1.0, np.eye(7), 0.0, 0)
    tracker._fusion = SimpleNamespace(reported=lambda: similarity, carried=lambda: (at(3.0), np.eye(6)))
    tracker._origin = (100.0, 0.0, 0.0)
    answer = told(tracker, None, verified_s=20.0, odometry=True)
    assert (answer.mode, answer.pose.position_in_world[0]) == ("carried", 103.0)
    assert answer.odometry.world_from_odom[0, 3] == 100.0
    assert similarity.world_from_odom[0, 3] == 0.0
    without = told(tracker, None, verified_s=20.0)
    assert (without.mode, without.odometry) == ("relocalizing", None)
    seen = _Followed(at(1.0), VERIFIED, SimpleNamespace(photo_intrinsics=LENS))  # type: ignore[arg-type]
    assert told(tracker, seen, verified_s=20.0).pose.position_in_world[0] == 101.0


# ------------------------------------------------------------------ views, scale, advice


def test_frames_show_different_things_from_15_degrees_or_30_centimetres_on():
    for other, differs in ((at(turn_deg=14.9), False), (at(turn_deg=15.1), True), (at(0.3), False), (at(0.31), True)):
        views = RecentViews()
        views.add(frame(1), at(), 0)
        views.add(frame(2), other, 0)
        assert [kept.id for kept, _ in views.before_newest()] == [1] * differs
        assert views.newest is other


def test_three_frames_beside_the_newest_are_kept_until_the_odometry_begins_anew():
    views = RecentViews()
    for number in range(6):
        views.add(frame(number), at(number), 0)
    assert [kept.id for kept, _ in views.before_newest()] == [4, 3, 2]
    # The newest one need not differ from the last kept one: then that doesn't count, and one more does.
    views.add(frame(6), at(5.1), 0)
    assert [kept.id for kept, _ in views.before_newest()] == [4, 3, 2]
    views.add(frame(7), at(9.0), 1)
    assert views.before_newest() == []


def test_what_is_remembered_of_a_scale_counts_a_quarter_but_not_less_than_before():
    memory = ScaleMemory(0.5, 0.7)
    assert memory.prior() == (0.5, 0.7)
    # Together 0.1, the prior 0.7: the fixes alone are a little less sure than 0.1.
    assert memory.learn(0.6, 0.1)
    alone = (100 - 0.7**-2) ** -0.5
    assert memory.sigma == pytest.approx(alone)
    assert memory.prior() == pytest.approx((0.6, 2 * alone))
    memory.sigma = 0.001
    assert memory.prior() == pytest.approx((0.6, 0.01))
    memory.begin_anew()
    assert memory.prior() == pytest.approx((0.6, 0.01))


@pytest.mark.parametrize(("sigmas", "believed"), [(3.9, True), (4.1, False)])
def test_a_known_scale_is_given_up_at_four_standard_deviations(sigmas, believed):
    """Known within 0.06, twice 0.03; the fixes alone say it within 0.08, hence 0.1 together."""
    memory = ScaleMemory(0.0, 0.06)
    alone, known = 0.08, 0.06
    by_fixes = sigmas * 0.1
    both = (alone**-2 + known**-2) ** -0.5
    fitted = by_fixes / alone**2 * both**2
    assert memory.learn(fitted, both) is believed
    if believed:
        assert (memory.log_scale, memory.sigma) == pytest.approx(
            (fitted, known)
        )  # not surer than the fixes, nor less than before
    else:
        assert (memory.log_scale, memory.sigma) == pytest.approx((by_fixes, 2 * alone))
        assert memory.prior() == pytest.approx((by_fixes, 2 * 2 * alone))


@pytest.mark.parametrize(("long_side", "advice"), [(319, 640), (320, None), (832, None), (833, 640)])
def test_frames_are_of_use_from_320_to_832_pixels(long_side, advice):
    pace = Pace(60)
    told = [pace.used(k / 20, 0.01, 0, long_side) for k in range(40)]
    assert [(k, hint.long_side_px) for k, hint in enumerate(told) if hint] == ([(29, 640)] if advice else [])


@pytest.mark.parametrize(("busy_s", "fps"), [(0.061, None), (0.064, 16)])
def test_a_rate_up_to_a_quarter_too_high_is_left(busy_s, fps):
    """20 frames a second come in the long run: 30 in 29 intervals of them."""
    pace = Pace(60)
    told = [hint for k in range(30) if (hint := pace.used(k * 30 / 29 / 20, busy_s, 0, 640))]
    assert [hint.max_fps for hint in told] == ([fps] if fps else [])


def test_a_rate_exactly_a_quarter_too_high_is_left():
    pace = Pace(60)
    # 30 frames in 1.5 s, each of which takes a sixteenth.
    assert not [pace.used(at_s, 0.0625, 0, 640) for at_s in [0.0] * 29 + [1.5]][-1]
    assert pace.used(2.0, 0.0625, 0, 640) is None


def test_advice_rises_by_half_at_once_where_clearly_more_could_be_used():
    for busy_s, rates in ((1 / 24.8, []), (1 / 25.2, [25]), (1 / 90, [30])):
        pace = Pace(60)
        first = [pace.used(k / 40, 0.05, 0, 640) for k in range(30)]
        assert [hint.max_fps for hint in first if hint] == [20]
        later = [pace.used(9 + k / 20, busy_s, 0, 640) for k in range(30)]
        assert [hint.max_fps for hint in later if hint] == rates
    bounded = Pace(22)
    for k in range(30):
        bounded.used(k / 40, 0.05, 0, 640)
    assert [hint.max_fps for k in range(30) if (hint := bounded.used(9 + k / 20, 0.01, 0, 640))] == [22]
