"""How a camera is followed, decision by decision, with stand-ins for renders and refinement: `service/tracking.py`."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service import tracking
from service.geometry import se3_exp
from service.pose.refinement.uncertainty import PoseUncertainty
from service.results import Reason, Status, Verdict
from service.tracking import TRACKING, SharedIntrinsics, TrackedPose, Tracker, extrapolated, is_placed, refine_from
from service.types import Camera, Intrinsics, IntrinsicsCorrection, LensPrior, Pose

LENS = Intrinsics(1024, 768, 800.0, 800.0, 512.0, 384.0)
SMALL = Intrinsics(256, 192, 200.0, 200.0, 128.0, 96.0)
DEPTH = 5.0


def at(x: float = 0.0, *, turn_deg: float = 0.0) -> Pose:
    return Pose(se3_exp(np.array([0.0, np.radians(turn_deg), 0.0, 0.0, 0.0, 0.0])) + x * np.eye(4, k=3))


def verdict(status: Status, reason: Reason = Reason.VERIFIED, right_place: float = 0.5) -> Verdict:
    return Verdict(status, reason, right_place, 0, 0.5, 0.5, None, right_place=right_place)


def rendered(pose: Pose, size: Intrinsics = SMALL) -> Any:
    frame = SimpleNamespace(median_depth=np.full((size.height, size.width), DEPTH, np.float32))
    return SimpleNamespace(frame=frame, camera=Camera(size, pose))


# ------------------------------------------------------------------ where the camera is expected


@pytest.mark.parametrize(("time_s", "x"), [(2.5, 3.5), (3.0, 4.0), (4.0, 5.0), (5.0, 5.0), (1.5, 3.0)])
def test_a_velocity_is_continued_over_two_intervals_at_most(time_s, x):
    past = [(0.0, at(9.0)), (1.0, at(2.0)), (2.0, at(3.0))]
    found = extrapolated(past, time_s, 2.0)
    assert found is not None
    assert found.position_in_world == pytest.approx([x, 0, 0])
    assert TRACKING.max_intervals == 2.0


def test_without_a_velocity_the_camera_is_expected_where_it_was():
    assert extrapolated([], 1.0, 2.0) is None
    here = at(3.0)
    assert extrapolated([(0.0, here)], 1.0, 2.0) is here


@pytest.mark.parametrize(
    ("status", "reason", "placed"),
    [
        (Status.LOCALIZED, Reason.VERIFIED, True),
        (Status.UNCERTAIN, Reason.FOCAL_UNCERTAIN, True),
        (Status.UNCERTAIN, Reason.INTRINSICS_CONTRADICTED, True),
        (Status.UNCERTAIN, Reason.FEW_INLIERS, False),
        (Status.NOT_LOCALIZED, Reason.RENDER_MISMATCH, False),
    ],
)
def test_a_doubt_about_the_lens_is_no_reason_to_search(status, reason, placed):
    assert is_placed(verdict(status, reason)) is placed


# ------------------------------------------------------------------ refinement


class Steps:
    """Stands in for renders, refinement and uncertainty; each render's last step is one of those given."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, steps: list[np.ndarray | None], loss: float = 0.1) -> None:
        self.renders: list[Camera] = []
        self.left, self.started_on = list(steps), None
        monkeypatch.setattr(tracking, "ViewRenderer", lambda rasterizer: self)
        monkeypatch.setattr(tracking, "refine_photometric", self.refine)
        monkeypatch.setattr(tracking, "pose_uncertainty", self.uncertainty)
        self.loss = loss
        self.images: Any = SimpleNamespace(
            query=SimpleNamespace(intrinsics=LENS, lens_prior=None),
            resized=lambda size: None,
            valid_mask=lambda size: None,
        )

    def render(self, camera: Camera) -> Any:
        self.renders.append(camera)
        return rendered(camera.pose, camera.intrinsics)

    def refine(self, photo, frame, of, start, *rest, **named) -> Any:
        self.started_on = of.pose.position_in_world[0]
        return SimpleNamespace(loss=self.loss, pose=start.pose)

    def uncertainty(self, *_: object) -> PoseUncertainty | None:
        step = self.left.pop(0)
        return None if step is None else PoseUncertainty(step, np.eye(6))


def step(turn: float = 0.0, way: float = 0.0) -> np.ndarray:
    return np.array([0.0, turn, 0.0, way, 0.0, 0.0])


def test_refinement_ends_where_a_step_moves_the_image_by_less_than_half_a_pixel(monkeypatch):
    """With a focal length of 200 pixels and 5 units away, half a pixel is 2.5 mrad or 12.5 thousandths."""
    large = step(0.1)
    for last, count in (
        (step(0.00249), 2), (step(0.00251), 3), (step(0.0, 0.01249), 2), (step(0.0, 0.01251), 3),
        (step(0.0015, 0.006), 3),
    ):  # fmt: skip
        stand_in = Steps(monkeypatch, [large, last, large, large])
        found = refine_from(stand_in.images, at(), rendered(at(7.0)), None)  # type: ignore[arg-type]
        assert found is not None
        assert len(stand_in.renders) == count
        assert (stand_in.renders[0].intrinsics.width, stand_in.renders[0].intrinsics.height) == (256, 192)
        assert stand_in.started_on == 7.0
        assert found.loss == 0.1


def test_what_can_not_be_refined_is_told(monkeypatch):
    none: Any = None
    assert refine_from(Steps(monkeypatch, [None]).images, at(), rendered(at()), none) is None
    assert refine_from(Steps(monkeypatch, [step()], loss=np.inf).images, at(), rendered(at()), none) is None
    # Without a render of this size one is made at the expected pose first.
    for before in (None, rendered(at(7.0), SMALL.resized(192, 144)), rendered(at(7.0), SMALL.resized(256, 144))):
        stand_in = Steps(monkeypatch, [step()])
        refine_from(stand_in.images, at(1.0), before, none)
        assert stand_in.started_on == 1.0
        assert len(stand_in.renders) == 2


# ------------------------------------------------------------------ one photo after the other


@pytest.fixture
def tracker() -> Tracker:
    info = SimpleNamespace(origin_in_world=(0.0, 0.0, 0.0))
    loaded: Any = SimpleNamespace(scene=SimpleNamespace(info=info), matcher=None)
    loaded.as_seen_by = lambda query: loaded
    return Tracker(loaded)


def changed(value: Any, **changes: Any) -> Any:
    """`replace` of a stand-in."""
    return SimpleNamespace(**(vars(value) if isinstance(value, SimpleNamespace) else {}) | changes)


def estimate(found: Verdict, x: float = 0.0, renders: int = 1) -> Any:
    return SimpleNamespace(verdict=found, pose=at(x), renders=renders)


def test_a_photo_is_searched_for_unless_it_is_placed_near_where_it_is_expected(tracker, monkeypatch):
    searched: list[Pose | None] = []
    answers: dict[str, Any] = {}
    monkeypatch.setattr(tracking, "asked_of", lambda query, loaded, request: query)
    monkeypatch.setattr(tracking, "undistorted_query", lambda query, correction: query)
    monkeypatch.setattr(tracking, "replace", lambda query, **changes: query)
    monkeypatch.setattr(tracker, "_followed", lambda query, expected: answers["followed"])
    monkeypatch.setattr(
        tracker, "_localized", lambda query, expected, followed: searched.append(expected) or answers["found"]
    )
    query: Any = SimpleNamespace(lens_prior=None)
    good, bad = verdict(Status.LOCALIZED), verdict(Status.NOT_LOCALIZED, Reason.FEW_INLIERS)
    answers["found"] = estimate(good, 1.0, 5)
    tracker.track(query)
    answers["followed"] = estimate(good, 2.0)
    tracker.track(query)
    assert searched == [None]
    # Without times the interval is 1.
    assert [(time_s, pose.position_in_world[0]) for time_s, pose in tracker._past] == [(0.0, 1.0), (1.0, 2.0)]
    assert tracker._renders == 6
    answers |= {"followed": None, "found": estimate(verdict(Status.UNCERTAIN, Reason.FEW_INLIERS), 3.0)}
    tracker.track(query, 7.0)
    assert len(searched) == 2
    assert [time_s for time_s, _ in tracker._past] == [1.0, 7.0]
    for lost in (bad, verdict(Status.UNCERTAIN, Reason.AMBIGUOUS)):
        tracker._past.append((8.0, at()))
        answers["found"] = estimate(lost)
        tracker.track(query, 9.0)
        assert not tracker._past


@pytest.mark.parametrize(("placed", "tells"), [(0.6, "search"), (0.4, "follow"), (0.5, "follow")])
def test_of_two_answers_the_surer_one_is_given_and_both_are_counted(tracker, monkeypatch, placed, tells):
    unsure = verdict(Status.UNCERTAIN, Reason.FEW_INLIERS, 0.5)
    fields = {"timings": ("t",), "renders": 2, "budget_exhausted": False, "records": ()}
    followed = SimpleNamespace(verdict=unsure, name="follow", **fields)
    found = SimpleNamespace(
        verdict=verdict(Status.UNCERTAIN, Reason.FEW_INLIERS, placed),
        name="search",
        **{**fields, "renders": 5, "timings": ("s",)},
    )
    monkeypatch.setattr(tracking, "replace", changed)
    monkeypatch.setattr(tracking, "localize_in_scene", lambda *_: found)
    query: Any = SimpleNamespace(prior=None, lens_prior=None)
    answer = tracker._localized(query, at(), followed)
    assert (answer.name, answer.timings, answer.renders) == (tells, ("t", "s"), 7)


# ------------------------------------------------------------------ the lens


@pytest.mark.parametrize(
    ("seen_from", "focal_sigma", "updates"),
    [
        (at(turn_deg=2.9), 0.01, False),
        (at(turn_deg=3.1), 0.01, True),
        (at(0.03 * DEPTH - 0.001), 0.01, False),
        (at(0.03 * DEPTH + 0.001), 0.01, True),
        (at(9.0), 0.002, False),
        (at(9.0), 0.0021, True),
        (None, 0.01, False),
    ],
)
def test_a_lens_is_learnt_from_another_place_until_it_is_known(monkeypatch, seen_from, focal_sigma, updates):
    """By 3 degrees or three hundredths of the distance, until the focal length is known to two thousandths."""
    correction = IntrinsicsCorrection(1.1, 8.0, 4.0, 0.2)
    answer = SimpleNamespace(loss=0.1, pose=at(0.5), correction=correction)
    monkeypatch.setattr(tracking, "refine_photometric", lambda *_: answer)
    shared = SharedIntrinsics(TRACKING, photos=3, seen_from=seen_from)
    images: Any = SimpleNamespace(
        query=SimpleNamespace(lens_prior=LensPrior(focal_sigma)),
        resized=lambda size: None,
        valid_mask=lambda size: None,
    )
    found = TrackedPose(at(), rendered(at()), 0.1, PoseUncertainty(np.zeros(6), np.diag([1.0] * 6 + [0.0004, 0.0009])))
    shared.update(images, found)
    assert (shared.photos == 4) is updates
    if updates:
        # The fourth photo counts a quarter for what is a mean.
        assert shared.correction == IntrinsicsCorrection(1.1, 2.0, 1.0, 0.05)
        assert shared.prior == LensPrior(pytest.approx(0.02), pytest.approx(0.03))
        assert shared.seen_from is answer.pose
    answer.loss = np.inf
    before = shared.photos
    shared.update(images, found)
    assert shared.photos == before
