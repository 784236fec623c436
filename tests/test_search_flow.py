"""Which step of the default estimator's search follows which: planted outcomes of its steps, and what is done then."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_bench import estimate
from test_search_thresholds import HERE, LENS, QUERY, agreed, drained, state, verdict

from service import localize as localizing
from service.estimators import ambiguity_check, lens_check, view_index
from service.estimators.search_config import SEARCH
from service.estimators.search_state import SearchState, StageOutcome, VerifiedPose
from service.estimators.view_index import Options
from service.geometry import moved
from service.localize import Request
from service.pose.matching.correspondences import Correspondences
from service.pose.matching.match_stages import Rematch
from service.pose.refinement.refine_stage import RefinedPose, RefineOutcome, RematchedPose
from service.pose.retrieval.ambiguous_hypotheses import PoseAtDistance
from service.pose.retrieval.image_variant import ImageVariant
from service.results import Candidates, IterationRecord, Reason, Status
from service.types import Intrinsics, IntrinsicsCorrection, Query

SOMEWHERE = IterationRecord("some", HERE)


def returns(value: Any, asked: list | None = None) -> Callable[..., Any]:
    """A step that yields nothing and returns this, or what a function of its arguments returns."""

    def step(*given, **named):
        if asked is not None:
            asked.append((given, named))
        yield from ()
        return value

    return step


def refined(loss: float | None = 0.02, inliers: int = 90) -> RefinedPose:
    return RefinedPose(HERE, IntrinsicsCorrection(), loss, inliers, None, None)


# ------------------------------------------------------------------ from views to a refined pose


def match_and_refine(
    monkeypatch: pytest.MonkeyPatch, found: Any, rematch: Any = None, restart: Any = None, again: int = 0, **named: Any
) -> tuple[StageOutcome, list[str]]:
    """Return the outcome for matches that lead to these, and which steps were made."""
    made: list[str] = []

    def step(name: str, value: Any) -> Callable[..., Any]:
        def run(*_: Any, **__: Any) -> Any:
            made.append(name)
            yield from ()
            return value

        return run

    first, second = refined(), refined(0.01)
    monkeypatch.setattr(view_index, "match_candidates", step("match", found))
    monkeypatch.setattr(view_index, "render_and_rematch", step("rematch", rematch))
    monkeypatch.setattr(view_index, "refine_stage", step("refine", RefineOutcome(first, restart)))
    monkeypatch.setattr(view_index, "rematch_and_refine", step("restart", RematchedPose(second, again)))
    searching = state()
    searching.retrieval = SimpleNamespace(features=lambda variant: None)  # type: ignore[assignment]
    outcome = drained(view_index._match_and_refine([], ImageVariant(416), searching, **named))[1]
    if outcome.refined is not None:
        assert outcome.refined is (second if restart else first)
    return outcome, made


def test_chance_matches_are_not_refined_but_those_of_the_last_views_may_be_few_of_many(monkeypatch) -> None:
    for found in (None, agreed(11), agreed(54, 1000)):
        outcome, made = match_and_refine(monkeypatch, found)
        assert (outcome, made) == (StageOutcome(None), ["match"])
    assert match_and_refine(monkeypatch, agreed(54, 1000), min_share=0.0)[1] == ["match", "refine"]


def test_with_fewer_than_thirty_inliers_a_pose_is_matched_before_it_is_refined(monkeypatch) -> None:
    for count, steps in ((30, ["match", "refine"]), (29, ["match", "rematch", "refine"])):
        outcome, made = match_and_refine(monkeypatch, agreed(count), Rematch(agreed(70), 1))
        assert made == steps
        assert outcome.recognised is (count == 29)
    for rounds in (0, 1):
        outcome, made = match_and_refine(monkeypatch, agreed(20), Rematch(None, rounds))
        assert (outcome, made) == (StageOutcome(None, rounds == 1), ["match", "rematch"])


def test_fewer_than_eighty_inliers_without_a_rematch_are_matched_if_the_gate_refuses(monkeypatch) -> None:
    for count in (79, 80):
        outcome, _ = match_and_refine(monkeypatch, agreed(count))
        assert (outcome.unmatched is not None) is (count == 79)
    assert match_and_refine(monkeypatch, agreed(20), Rematch(agreed(70), 1))[0].unmatched is None


def test_a_refinement_that_does_not_settle_starts_again_from_matches(monkeypatch) -> None:
    for found, rematch, again, recognised in (
        (agreed(60), None, 0, False),
        (agreed(60), None, 1, True),
        (agreed(20), Rematch(agreed(70), 1), 0, True),
    ):
        outcome, made = match_and_refine(monkeypatch, found, rematch, restart=agreed(60), again=again)
        assert made[-1] == "restart"
        assert (outcome.recognised, outcome.unmatched) == (recognised, None)
    monkeypatch.setattr(view_index, "rematch_and_refine", returns(RematchedPose(None, 0)))
    assert not drained(view_index._rematch(agreed(9), state()))[1].recognised
    monkeypatch.setattr(view_index, "rematch_and_refine", returns(RematchedPose(None, 1)))
    assert drained(view_index._rematch(agreed(9), state()))[1].recognised


@pytest.mark.parametrize(("counts", "chosen"), [((5, 12, 12, 11), 1), ((11, 3, None, 0), None), ((None, 40, 41, 7), 2)])
def test_of_sampled_poses_the_one_with_most_inliers_and_twelve_at_least_is_refined(monkeypatch, counts, chosen) -> None:
    drawn, errors, refinements = [], [], []
    found = [None if count is None else agreed(count) for count in counts]
    left = iter(found)
    none = Correspondences(np.zeros((9, 2), np.float32), np.zeros((9, 2), np.float32), np.zeros((9, 3), np.float32))

    def solve(matches, query, error_px, trials):
        errors.append(error_px)
        return next(left)

    monkeypatch.setattr(view_index, "poses_near_views", lambda *given: drawn.append(given) or [HERE] * len(counts))
    monkeypatch.setattr(
        view_index, "render_and_match", lambda cameras, *_: [(none, SimpleNamespace(camera=c)) for c in cameras]
    )
    monkeypatch.setattr(view_index, "solve_matches", solve)
    monkeypatch.setattr(view_index, "record_of", lambda *_: SOMEWHERE)
    monkeypatch.setattr(view_index, "rematch_and_refine", returns(RematchedPose(refined(), 1), refinements))
    searching = state()
    searching.tools = SimpleNamespace(prepared=SimpleNamespace(views=()), rng=None, rasterizer=None)  # type: ignore[assignment]
    searching.images = SimpleNamespace(query=QUERY)  # type: ignore[assignment]
    searching.retrieval = SimpleNamespace(scores=lambda variant: None)  # type: ignore[assignment]
    records, outcome = drained(view_index._sample_poses(ImageVariant(416, 3), searching))
    assert len(records) == len(counts)
    # Three steps of 45 degrees, to the other side; four pixels of 416 are 6.5 of 256 at that size.
    assert drawn[0][2] == pytest.approx(-3 * np.pi / 4)
    assert errors == [6.5] * len(counts)
    assert outcome.recognised is (chosen is not None)
    assert [given[0] for given, _ in refinements] == ([] if chosen is None else [found[chosen]])


# ------------------------------------------------------------------ the stages of a search


class FakeRetrieval:
    """A hundred views, the first ones likeliest, and rotations by the size of the photo."""

    def __init__(self, rotations: dict[int, int] | None = None, upright: bool = True) -> None:
        self.rotations, self.upright = rotations or {}, upright
        self.index = SimpleNamespace(whole=None)

    def upright_variant(self) -> ImageVariant:
        return ImageVariant(400)

    def is_upright(self, variant: ImageVariant) -> bool:
        return self.upright

    def rotated_variant(self, variant: ImageVariant, *, likeliest_only: bool = False) -> ImageVariant:
        return replace(variant, roll_steps_45deg=self.rotations.get(variant.long_side, 0))

    def ranked(self, variant: ImageVariant, count: int) -> np.ndarray:
        return np.arange(count)

    def scores(self, variant: ImageVariant) -> np.ndarray:
        return np.linspace(1, 0, 100)


def stages(
    monkeypatch: pytest.MonkeyPatch,
    retrieval: FakeRetrieval,
    options: Options,
    cameras: tuple = (1,),
    recognised: bool = False,
) -> list[tuple]:
    """Return the name, size, rotation and views of each stage, and whether a render at the prior is tried."""
    made: list[tuple] = []

    def search(name, variant, untried, state, *, try_prior_view=False):
        made.append((name, variant.long_side, variant.roll_steps_45deg, list(untried), try_prior_view))
        for _ in range(min(4, len(untried))):
            untried.popleft()

    monkeypatch.setattr(view_index, "_search_views", search)
    monkeypatch.setattr(view_index, "_free_view_stages", lambda *_: iter([made.append(("free",))]))
    monkeypatch.setattr(view_index, "_sample_poses", lambda *_: made.append(("sample",)))
    searching = state()
    searching.tools = SimpleNamespace(scene=SimpleNamespace(cameras=cameras))  # type: ignore[assignment]
    searching.retrieval = retrieval  # type: ignore[assignment]
    searching.recognised = recognised
    list(view_index._search_stages(searching, options))
    return made


def test_a_search_goes_from_a_small_photo_to_a_large_one_with_further_views(monkeypatch) -> None:
    first = [("retrieve", 308, 0, [0, 1], True), ("retrieve_full_size", 400, 0, [0, 1, 2, 3, 4], False)]
    # One in sixteen of the views, after the five that were matched: six, of which each stage takes four here.
    further = [
        ("retrieve_more_views", 500, 0, [5, 6, 7, 8, 9, 10], False),
        ("retrieve_more_views", 500, 0, [9, 10], False),
    ]
    found = stages(monkeypatch, FakeRetrieval(), Options(candidates=5, effort="fast"))
    assert found == first + further
    found = stages(monkeypatch, FakeRetrieval(), Options(candidates=5, effort="normal"))
    assert found == [*first, *further, ("free",)]
    found = stages(monkeypatch, FakeRetrieval(), Options(candidates=5, effort="normal"), recognised=True)
    assert found == [*first, *further, ("free",), *[("sample",)] * 4]
    found = stages(monkeypatch, FakeRetrieval(), Options(candidates=5, effort="exhaustive"))
    assert found == [*first, *further, ("free",), *[("sample",)] * 100]
    # As many as candidates, if these are more; a single candidate is one for the small photo, too.
    found = stages(monkeypatch, FakeRetrieval(), Options(candidates=8, effort="fast"))
    assert found[2][3] == list(range(8, 16))
    assert stages(monkeypatch, FakeRetrieval(), Options(candidates=1, effort="fast"))[0][3] == [0]
    # Views that the scene placed itself have its own scale.
    assert stages(monkeypatch, FakeRetrieval(), Options(effort="fast"), cameras=())[0][1] == 320


def test_a_rotation_is_tried_on_the_small_photo_unless_that_is_upright(monkeypatch) -> None:
    fast = Options(candidates=5, effort="fast")
    found = stages(monkeypatch, FakeRetrieval({308: 3, 400: 2}, upright=False), fast)
    assert [stage[:3] for stage in found[:3]] == [
        ("retrieve_rotated", 308, 3), ("retrieve_rotated", 400, 2), ("retrieve_more_views", 500, 2),
    ]  # fmt: skip
    # A render at the prior is not rotated.
    assert not found[0][4]
    assert stages(monkeypatch, FakeRetrieval({308: 3}), fast)[0][:3] == ("retrieve", 308, 0)


def test_free_views_are_matched_eight_at_most_if_the_photo_has_features(monkeypatch) -> None:
    views = tuple(SimpleNamespace(camera=number) for number in range(20))
    asked: list[list[int]] = []

    def search(cameras, scores, untried, variant, state):
        assert scores.tolist() == [100 - camera for camera in cameras]
        asked.append(cameras)
        for _ in range(min(5, len(untried))):
            untried.popleft()

    monkeypatch.setattr(view_index, "_search_free_views", search)
    monkeypatch.setattr(
        view_index, "Retrieval",
        lambda *_: SimpleNamespace(rotated_variant=lambda v: v, scores=lambda v: 100.0 - np.arange(20)),
    )  # fmt: skip

    def searched(features: int, found: tuple = views, most: int = 8) -> list[list[int]]:
        asked.clear()
        searching = state()
        searching.config = replace(searching.config, free_views=most)
        photo = SimpleNamespace(scores=np.zeros(30 + features))
        index = SimpleNamespace(views=(), free_views=SimpleNamespace(of=lambda *_: found))
        searching.images = SimpleNamespace(features=lambda: photo)  # type: ignore[assignment]
        searching.tools = SimpleNamespace(prepared=index, scene=None, rasterizer=None, matcher=None)  # type: ignore[assignment]
        monkeypatch.setattr(view_index, "replace", lambda index, **_: index)
        list(view_index._free_view_stages(ImageVariant(400), searching))
        return list(asked)

    assert searched(0) == [list(range(8)), [5, 6, 7]]
    assert searched(-1) == []
    assert searched(0, found=()) == []
    assert searched(0, most=0) == []


@pytest.mark.parametrize(
    ("finished", "mirrored", "unique", "made"),
    [
        (False, False, False, ["mirror"]),
        (True, True, False, ["mirror"]),
        (True, False, True, ["mirror", "rivals"]),
        (True, False, False, ["mirror", "rivals", "ambiguity"]),
    ],
)
def test_only_an_answer_that_is_not_mirrored_is_compared_with_others(
    monkeypatch, finished, mirrored, unique, made
) -> None:
    found: list[str] = []

    def check(name: str, value: Any) -> Callable[..., Any]:
        def run(_: Any) -> Any:
            found.append(name)
            yield from ()
            return value

        return run

    for name, value in (("mirror", mirrored), ("rivals", unique), ("ambiguity", None)):
        monkeypatch.setattr(view_index, f"check_{name}", check(name, value))
    searching = state()
    searching.finished = finished
    drained(view_index._doubts(searching))
    assert found == made


# ------------------------------------------------------------------ readings of the device


@pytest.mark.parametrize(
    ("status", "finished", "prefers", "replaced"),
    [
        ("localized", False, False, True),
        ("localized", True, False, False),
        ("localized", True, True, True),
        ("uncertain", False, True, False),
    ],
)
def test_an_answer_that_the_readings_contradict_gives_way_to_one_that_the_gate_accepts(
    monkeypatch, status, finished, prefers, replaced
) -> None:
    searched = []

    def search(name, variant, untried, state):
        searched.append((name, variant, untried))
        yield SOMEWHERE
        return StageOutcome(refined())

    monkeypatch.setattr(view_index, "_search_views", search)
    monkeypatch.setattr(view_index, "contradicts", lambda *_: True)
    monkeypatch.setattr(SearchState, "verify", lambda self, found: verdict(status))
    monkeypatch.setattr(SearchState, "readings_prefer", lambda self, one, other: prefers)
    searching, answer = state(), VerifiedPose(refined(), verdict(), ImageVariant(320, 1))
    searching.best, searching.finished = answer, finished
    searching.images = SimpleNamespace(query=SimpleNamespace(scene_priors=object()))  # type: ignore[assignment]
    for steps, rolls in ((None, 1), (6, 6)):
        searching.best, searching.finished = answer, finished
        searching.retrieval = SimpleNamespace(  # type: ignore[assignment]
            roll_by_gravity=lambda steps=steps: steps, ranked=lambda variant, count, only_agreeing: np.arange(3)
        )
        records, _ = drained(view_index._check_readings(searching, Options()))
        assert [record.stage for record in records] == ["some", "check_readings"]
        assert searched[-1] == ("retrieve_by_readings", ImageVariant(320, rolls), deque([0, 1, 2]))
        assert (searching.best is not answer) is replaced
        assert searching.finished is (finished or replaced)
    searching.retrieval = SimpleNamespace(roll_by_gravity=lambda: None, ranked=lambda *_, **__: [])  # type: ignore[assignment]
    assert drained(view_index._check_readings(searching, Options()))[0] == []
    monkeypatch.setattr(view_index, "contradicts", lambda *_: False)
    assert drained(view_index._check_readings(searching, Options()))[0] == []
    searching.best = None
    monkeypatch.setattr(view_index, "contradicts", lambda *_: 1 / 0)
    assert drained(view_index._check_readings(searching, Options()))[0] == []


# ------------------------------------------------------------------ is the photo mirrored?


@pytest.mark.parametrize(
    ("status", "symmetric", "found", "finished", "other", "mirrored"),
    [
        ("localized", True, True, True, "uncertain", True),
        ("not_localized", True, True, True, "localized", None),
        ("localized", False, True, True, "localized", None),
        ("localized", True, False, True, "localized", None),
        # Of a refused answer the mirror image must be accepted.
        ("uncertain", True, True, False, "uncertain", None),
        ("uncertain", True, True, False, "localized", True),
    ],
)
def test_a_mirror_image_that_is_less_unlike_the_photo_is_told(
    monkeypatch, status, symmetric, found, finished, other, mirrored
) -> None:
    names = ("gradients", "gradients_half", "colours", "colours_half", "local_colour_correlation")
    asked: list[tuple] = []
    pair = SimpleNamespace(verify=lambda pose: verdict(other), appearance_at=lambda pose: dict.fromkeys(names, 0.81))
    monkeypatch.setattr(ambiguity_check, "mirror_image_of", lambda *_: pair)
    monkeypatch.setattr(ambiguity_check, "prefers", lambda *_: False)
    monkeypatch.setattr(ambiguity_check, "_search_mirrored", returns(refined() if found else None, asked))
    monkeypatch.setattr(ambiguity_check, "seen_from", lambda *_: PoseAtDistance(HERE, 4.0))

    def checked(signal: float) -> tuple[list, bool]:
        searching = state()
        searching.tools.prepared.like_its_mirror_image = symmetric  # type: ignore[misc]
        searching.images = SimpleNamespace(query=SimpleNamespace(scene_priors=None))  # type: ignore[assignment]
        given = replace(verdict(status), signals=dict.fromkeys(names, signal))
        searching.best = VerifiedPose(refined(0.03), given, ImageVariant(400, 3))
        searching.finished = finished
        return drained(ambiguity_check.check_mirror(searching))

    records, is_mirrored = checked(0.8)
    assert is_mirrored is bool(mirrored)
    assert [record.mirrored for record in records] == ([] if mirrored is None else [True])
    if mirrored:
        # Turned to the other side; twice the answer's residual.
        assert asked[0][0][1:] == (ImageVariant(400, 5), pytest.approx(0.06))
        records, is_mirrored = checked(0.82)
        assert [record.mirrored for record in records] == [is_mirrored] == [False]


@pytest.mark.parametrize(
    ("shift", "signal", "mirrored"),
    # Beyond twice the distance that is seen, 4 units, it must be four times less unlike the photo.
    [(7.9, 0.81, True), (8.1, 0.81, False), (8.1, 0.949, False), (8.1, 0.951, True)],
)
def test_a_mirror_image_in_another_place_must_fit_much_better(monkeypatch, shift, signal, mirrored) -> None:
    names = ("gradients", "gradients_half", "colours", "colours_half", "local_colour_correlation")
    pair = SimpleNamespace(appearance_at=lambda pose: dict.fromkeys(names, signal))
    there = replace(refined(), pose=moved(HERE, np.array([0, 0, 0, shift, 0, 0])))
    monkeypatch.setattr(ambiguity_check, "mirror_image_of", lambda *_: pair)
    monkeypatch.setattr(ambiguity_check, "prefers", lambda *_: False)
    monkeypatch.setattr(ambiguity_check, "_search_mirrored", returns(there))
    monkeypatch.setattr(ambiguity_check, "seen_from", lambda *_: PoseAtDistance(HERE, 4.0))
    searching = state()
    searching.tools.prepared.like_its_mirror_image = True  # type: ignore[misc]
    searching.images = SimpleNamespace(query=SimpleNamespace(scene_priors=None))  # type: ignore[assignment]
    given = replace(verdict("localized"), signals=dict.fromkeys(names, 0.8))
    searching.best, searching.finished = VerifiedPose(refined(0.03), given, ImageVariant(400, 3)), True
    assert drained(ambiguity_check.check_mirror(searching))[1] is mirrored


# ------------------------------------------------------------------ the record of an answer through another lens


def test_an_answer_through_a_fisheye_is_told_by_the_lens_that_was_assumed() -> None:
    searching = state()
    assert searching.with_answer(SOMEWHERE) is SOMEWHERE
    assert searching.answer() is None
    there = moved(HERE, np.array([0, 0, 0, 1.0, 2, 3]))
    searching.best = VerifiedPose(replace(refined(), pose=there), verdict(), ImageVariant(416))
    told = searching.with_answer(SOMEWHERE)
    assert (told.pose, told.correction, told.lens) == (there, IntrinsicsCorrection(), None)
    lens = Intrinsics(800, 500, 600.0, 600.0, 420.0, 230.0)
    searching.assumed = replace(QUERY, photo_intrinsics=replace(lens, fx=400.0, fy=400.0, cx=400.0, cy=250.0))
    searching.images = SimpleNamespace(query=replace(QUERY, photo_intrinsics=lens))  # type: ignore[assignment]
    told = searching.with_answer(SOMEWHERE)
    assert told.lens == lens
    assert told.correction == IntrinsicsCorrection(1.5, pytest.approx(20 / 800), pytest.approx(-20 / 800))


# ------------------------------------------------------------------ the check of the lens


def photo_of(free_lens: bool = True, distorted: bool = False) -> Query:
    lens = replace(LENS, trust="approximate" if free_lens else "exact")
    whole = replace(lens, model="SIMPLE_RADIAL", distortion=(0.1,)) if distorted else lens
    return Query(np.zeros((312, 416, 3), np.uint8), lens, "given", whole)


@pytest.mark.parametrize(
    ("query", "status", "share", "distortion", "suspicious"),
    [
        (photo_of(), "uncertain", 0.9, 0.0, True),
        (photo_of(free_lens=False), "uncertain", 0.9, 0.0, True),
        (photo_of(distorted=True), "uncertain", 0.1, 0.9, False),
        (photo_of(), "not_localized", 0.1, 0.9, False),
        (photo_of(free_lens=False), "localized", 0.1, 0.9, False),
        (photo_of(), "localized", 0.649, 0.0, True),
        (photo_of(), "localized", 0.651, 0.0, False),
        # By k1 r^2 at the corner.
        (photo_of(), "localized", 0.9, 0.0899, False),
        (photo_of(), "localized", 0.9, 0.0901, True),
        (photo_of(), "localized", 0.9, -0.0901, True),
    ],
)
def test_a_lens_is_suspicious_where_the_answer_is_refused_or_much_is_distorted(
    query, status, share, distortion, suspicious
) -> None:
    searching = state()
    searching.images = SimpleNamespace(query=query)  # type: ignore[assignment]
    # A focal length of 320, and the principal point at (249.6, 124.8): so far away is the lower left corner.
    squared_radius = (249.6 / 320) ** 2 + (187.2 / 320) ** 2
    correction = IntrinsicsCorrection(0.8, 0.1, -0.075, distortion / squared_radius)
    given = replace(verdict(status), signals={"inlier_share": share})
    best = VerifiedPose(replace(refined(), correction=correction), given, ImageVariant(416))
    assert lens_check._is_suspicious(searching, best) is suspicious


def test_a_pixel_crops_lens_is_that_of_the_whole_photo() -> None:
    # Shown is a photo of 1000 x 600 at 0.4 and 0.5 of its size; the lens moved the principal point by (6, -4) there.
    shown, whole = Intrinsics(400, 300, 200.0, 250.0, 190.0, 160.0), Intrinsics(1000, 600, 500.0, 500.0, 480.0, 310.0)
    query = Query(np.zeros((300, 400, 3), np.uint8), shown, "given", whole)
    lens = replace(shown, fx=220.0, fy=280.0, cx=196.0, cy=156.0, model="OPENCV_FISHEYE", distortion=(0.1, 0, 0, 0))
    found = lens_check.photo_lens(query, lens)
    assert (found.width, found.height, found.model, found.distortion) == (1000, 600, lens.model, lens.distortion)
    assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx((550, 560, 495, 302))


@pytest.mark.parametrize(
    ("fisheye", "surely", "unmodelled", "answer", "outcome"),
    [
        (False, False, False, True, "kept"),
        (True, False, False, True, "fisheye"),
        (True, False, False, False, "kept"),
        (True, True, False, False, "refused"),
        (False, False, True, True, "refused"),
    ],
)
def test_what_a_fisheye_explains_is_taken_through_one(
    monkeypatch, fisheye, surely, unmodelled, answer, outcome
) -> None:
    models = SimpleNamespace(
        fisheye=None, is_fisheye=lambda: fisheye, is_surely_fisheye=lambda: surely, is_unmodelled=lambda: unmodelled
    )
    other = state()
    monkeypatch.setattr(lens_check, "_is_suspicious", lambda *_: True)
    monkeypatch.setattr(lens_check, "_fitted_models", lambda *_: models)
    monkeypatch.setattr(lens_check, "_through_fisheye", returns(other if answer else None))
    searching = state()
    searching.best = VerifiedPose(
        refined(), replace(verdict("localized", "verified"), fitting_correction=IntrinsicsCorrection(2.0)),
        ImageVariant(416),
    )  # fmt: skip
    before = searching.best
    records, after = drained(lens_check.check_lens(searching))
    assert after is (other if outcome == "fisheye" else searching)
    assert [record.stage for record in records] == (["check_lens"] if outcome == "refused" else [])
    if outcome == "refused":
        now = searching.best.verdict
        assert (now.status, now.reason) == (Status.UNCERTAIN, Reason.LENS_UNMODELLED)
        assert now.fitting_correction is None
    else:
        assert searching.best is before
    # Nothing is fitted to few matches, to an answer that isn't suspicious, or to none.
    monkeypatch.setattr(lens_check, "_fitted_models", lambda *_: None)
    assert drained(lens_check.check_lens(searching)) == ([], searching)
    monkeypatch.setattr(lens_check, "_is_suspicious", lambda *_: False)
    monkeypatch.setattr(lens_check, "_fitted_models", lambda *_: 1 / 0)
    assert drained(lens_check.check_lens(searching)) == ([], searching)
    searching.best = None
    assert drained(lens_check.check_lens(searching)) == ([], searching)


@pytest.mark.parametrize(("count", "fitted"), [(79, False), (80, True)])
def test_lens_models_are_fitted_to_eighty_matches(monkeypatch, count: int, fitted: bool) -> None:
    asked: list[tuple] = []
    found = Correspondences(*(np.zeros((count, d), np.float32) for d in (2, 2, 3)))
    monkeypatch.setattr(lens_check, "correspondences", lambda *_: found)
    monkeypatch.setattr(lens_check, "fit_lens_models", lambda *given: asked.append(given) or "models")
    searching = state()
    searching.images = SimpleNamespace(query=photo_of(), matcher=None, features=lambda: None)  # type: ignore[assignment]
    searching.renderer = SimpleNamespace(at=lambda *_: SimpleNamespace(view=lambda matcher: None))  # type: ignore[assignment]
    fitting = IntrinsicsCorrection(1.2)
    for told, expected in ((None, IntrinsicsCorrection()), (fitting, fitting)):
        best = VerifiedPose(refined(), replace(verdict(), fitting_correction=told), ImageVariant(416))
        assert lens_check._fitted_models(searching, best) == ("models" if fitted else None)
        if fitted:
            start, error_px = asked[-1][3:]
            assert (start.correction, error_px) == (expected, SEARCH.matching.rematch_error_px)


# ------------------------------------------------------------------ what lowers an answer's verdict in the end


def test_an_answer_is_qualified_by_mirror_lens_rivals_and_budget() -> None:
    good = replace(estimate(HERE).verdict, right_place=0.96, precise=0.9, score=0.864)
    last = IterationRecord("verify", HERE)
    assert localizing._qualified(good, last, False) == good
    assert localizing._qualified(good, last, True) == good
    told = localizing._qualified(good, replace(last, mirrored=True), False)
    assert (told.status, told.reason) == (Status.UNCERTAIN, Reason.MIRRORED)
    told = localizing._qualified(good, replace(last, correction=IntrinsicsCorrection(k1=0.4)), False)
    assert (told.status, told.reason) == (Status.UNCERTAIN, Reason.FOCAL_UNCERTAIN)
    least = localizing.VERIFICATION.min_localized
    for rest, reason in ((least + 0.01, Reason.VERIFIED), (least - 0.01, Reason.AMBIGUOUS)):
        others = Candidates(np.tile(np.eye(4), (2, 1, 1)), np.array([0.75, 0.25]) * (1 - rest))
        told = localizing._qualified(good, replace(last, alternatives=others), False)
        assert told.reason is reason
        if reason is Reason.AMBIGUOUS:
            assert told.place_probability == pytest.approx(rest * 0.96)
    refused = replace(good, status=Status.UNCERTAIN, reason=Reason.FEW_INLIERS)
    assert localizing._qualified(refused, last, False).reason is Reason.FEW_INLIERS
    assert localizing._qualified(refused, last, True).reason is Reason.BUDGET_EXHAUSTED


def test_a_budget_ends_after_its_seconds_and_with_its_renders() -> None:
    def exhausted(seconds: float | None, renders: int | None) -> bool:
        clock: Any = SimpleNamespace(wall_s=2.0)
        tally: Any = SimpleNamespace(count=7)
        return localizing._exhausted(Request(budget_s=seconds, budget_renders=renders), clock, tally)

    assert [exhausted(s, None) for s in (None, 1.9, 2.0, 2.1)] == [False, True, False, False]
    assert [exhausted(None, n) for n in (6, 7, 8)] == [True, True, False]
    assert exhausted(1.9, 8)
    assert exhausted(2.1, 7)


def test_the_time_before_a_record_is_its_stages_and_the_rest_is_verifications() -> None:
    times = [("retrieve", 0.5, 0.3), ("match", 0.7, 0.45), ("match", 1.2, 0.6), ("verify", 1.3, 0.65)]
    records = [IterationRecord(stage, HERE, elapsed_s=wall, cpu_s=cpu) for stage, wall, cpu in times]
    clock: Any = SimpleNamespace(wall_s=1.7, cpu_s=0.9)
    found = {each.stage: (each.wall_s, each.cpu_s) for each in localizing._timings(records, clock)}
    assert found == {
        "retrieve": pytest.approx((0.5, 0.3)), "match": pytest.approx((0.7, 0.3)), "verify": pytest.approx((0.5, 0.3)),
    }  # fmt: skip
