"""The search's decisions at their thresholds: planted scores, matches and verdicts, just at, below and above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_bench import estimate

from service.estimators import ambiguity_check, search_state
from service.estimators.search_config import SEARCH
from service.estimators.search_state import SearchState, Stage, VerifiedPose
from service.geometry import look_at, moved, pose_distance
from service.interfaces import Features, Frame
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.matching import match_stages
from service.pose.matching.correspondences import Correspondences
from service.pose.matching.match_stages import MATCHING, match_candidates, render_and_rematch
from service.pose.retrieval import image_variant, view_placement
from service.pose.retrieval.image_variant import ImageVariant, Retrieval
from service.pose.retrieval.scores import ScoreConfig, retrieval_scores, top_indices
from service.pose.retrieval.view_placement import PLACEMENT, search_camera, shows_single_surface
from service.results import Reason, Status, Verdict
from service.types import BoxPrior, Camera, Intrinsics, Pose, Query

HERE = Pose(np.eye(4))
LENS = Intrinsics(416, 312, 400.0, 400.0, 208.0, 156.0)
QUERY = Query(np.zeros((312, 416, 3), np.uint8), LENS, "given", LENS)
NO_FEATURES = Features(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros((0, 2), np.float32))


def matches(count: int) -> Correspondences:
    points = np.tile(np.float32([0, 0, 2]), (count, 1))
    return Correspondences(*(np.zeros((count, 2), np.float32) for _ in range(2)), points)


def agreed(inliers: int, of: int = 100, pose: Pose = HERE) -> AbsolutePose:
    return AbsolutePose(pose, np.arange(of) < inliers)


def drained(generator: Any) -> tuple[list, Any]:
    """Return a generator's records and what it returns."""
    records = []
    while True:
        try:
            records.append(next(generator))
        except StopIteration as end:
            return records, end.value


# ------------------------------------------------------------------ matching with views and renders


def matched(monkeypatch: pytest.MonkeyPatch, single: Sequence[int], pooled: int, count: int = 100):
    """Match with views of which so many matches agree, and so many of all together."""
    left, asked = iter(single), []

    def solve(found, query, max_error_px, max_trials):
        asked.append(max_trials)
        inliers = pooled if len(found.photo_px) > count else next(left)
        return agreed(inliers, len(found.photo_px)) if inliers else None

    monkeypatch.setattr(match_stages, "correspondences", lambda *_: matches(count))
    monkeypatch.setattr(match_stages, "solve_matches", solve)
    view = SimpleNamespace(camera=Camera(LENS, HERE))
    images: Any = SimpleNamespace(query=QUERY, matcher=None)
    records, found = drained(match_candidates(NO_FEATURES, [view] * len(single), images, 4.0))  # type: ignore[list-item]
    return [record.stage for record in records], found, asked


def test_no_further_view_is_matched_once_sixty_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    stages, found, asked = matched(monkeypatch, [59, 60, 99], 0)
    assert (stages, found.num_inliers, asked) == (["match"] * 2, 60, [500, 500])
    stages, found, asked = matched(monkeypatch, [59, 30, 58], 58)
    assert (stages, found.num_inliers) == (["match"] * 3 + ["match_pooled"], 59)
    assert asked == [500] * 3 + [2000]
    assert matched(monkeypatch, [59, 30, 58], 60)[1].num_inliers == 60
    assert matched(monkeypatch, [0, 0], 0)[1] is None
    assert matched(monkeypatch, [0, 0], 20)[1].num_inliers == 20


@pytest.mark.parametrize(
    ("inliers", "of", "chance"), [(12, 100, False), (11, 100, True), (55, 1000, False), (54, 1000, True)]
)
def test_twelve_or_55_thousandths_of_the_matches_are_more_than_chance(inliers: int, of: int, chance: bool) -> None:
    assert MATCHING.may_be_chance(agreed(inliers, of)) is chance


def test_pooled_matches_that_may_be_chance_give_way_to_a_view_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    # 12 of 100 with one view; 16 of 300 may be chance, 17 aren't; below 12 both may be.
    assert matched(monkeypatch, [12, 0, 0], 16)[1].num_inliers == 12
    assert matched(monkeypatch, [12, 0, 0], 17)[1].num_inliers == 17
    assert matched(monkeypatch, [11, 0, 0], 16)[1].num_inliers == 16
    assert matched(monkeypatch, [12, 0, 0], 12)[1].inlier.size == 100


def rematched(monkeypatch: pytest.MonkeyPatch, rounds: Sequence[tuple[int, float, float]]):
    """Rematch where each round has so many inliers of 100, and turns (degrees) and moves (units) the pose."""
    left = iter(rounds)

    def solve(near, found, query, config):
        inliers, degrees, units = next(left)
        return agreed(inliers, 100, moved(near.pose, np.array([0, np.radians(degrees), 0, units, 0, 0])))

    view = SimpleNamespace(camera=Camera(LENS, HERE), points_in_world=np.tile(np.float32([0, 0, 2]), (5, 1)))
    monkeypatch.setattr(match_stages, "correspondences", lambda *_: matches(100))
    monkeypatch.setattr(match_stages, "solve_matches_near", solve)
    renderer = SimpleNamespace(at=lambda query, pose: SimpleNamespace(view=lambda matcher: view))
    images = SimpleNamespace(query=QUERY, matcher=None, features=lambda: None)
    records, outcome = drained(render_and_rematch(agreed(20), images, renderer))  # type: ignore[arg-type]
    return len(records), outcome


@pytest.mark.parametrize(
    ("rounds", "count"),
    [
        # Settled: by less than 0.3 degrees, and 0.005 of a distance of 2.
        ([(30, 0.29, 0.0)], 1),
        ([(30, 0.31, 0.0), (30, 0.0, 0.0)], 2),
        ([(30, 0.0, 0.0099)], 1),
        ([(30, 0.0, 0.0101), (30, 0.0, 0.0)], 2),
        # Most agree: more than 70 of 100.
        ([(71, 5.0, 0.0)], 1),
        ([(70, 5.0, 0.0), (30, 0.0, 0.0)], 2),
        # Three at most.
        ([(30, 5.0, 0.0)] * 3, 3),
    ],
)
def test_a_rematch_is_the_last_that_settles_or_that_most_matches_agree_with(monkeypatch, rounds, count) -> None:
    records, outcome = rematched(monkeypatch, rounds)
    assert (records, outcome.rounds) == (count, count)
    assert outcome.found.num_inliers == rounds[-1][0]


def test_fewer_than_15_inliers_with_a_render_are_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    assert rematched(monkeypatch, [(15, 0.0, 0.0)])[1].found is not None
    records, outcome = rematched(monkeypatch, [(40, 5.0, 0.0), (14, 0.0, 0.0)])
    assert (records, outcome.found, outcome.rounds) == (1, None, 1)


def test_decoupled_steps_need_six_matches() -> None:
    near, few = agreed(5), matches(MATCHING.decoupled.min_points - 1)
    assert MATCHING.decoupled.min_points == 6
    assert match_stages.solve_matches_near(near, few, QUERY) is None
    # Nearer to the prior's box than 3 degrees and a twentieth of the distance of 2 a pose may be refined into it.
    for aside, allowed in ((0.09, True), (0.11, False)):
        box = BoxPrior(np.array([aside, -1, -1.0]), np.array([1.0, 1, 1]))
        assert match_stages._allowed_by_prior(HERE, matches(9), replace(QUERY, region=box)) is allowed


# ------------------------------------------------------------------ variants of the photo, and scores


def retrieval(query: Query = QUERY, focal: float = 400.0, views: int = 3, **planted: float) -> Retrieval:
    """Compare with views of this focal length (at 416 px), apart by one unit along x; scores by `size_rolls`."""
    lens = replace(LENS, fx=focal, fy=focal)
    poses = [moved(HERE, np.array([0, 0, 0, float(k), 0, 0])) for k in range(views)]
    index = SimpleNamespace(
        views=[SimpleNamespace(camera=Camera(lens, pose), features=NO_FEATURES) for pose in poses], corners=None
    )
    images = SimpleNamespace(query=query, corners=lambda: None, features=lambda size, rolls: (size, rolls))
    found = Retrieval(images, index)  # type: ignore[arg-type]
    for name, score in planted.items():
        size, rolls = map(int, name.strip("_").split("_"))
        found._scores[ImageVariant(size, rolls)] = np.array([0.1, score, 0.2])
    return found


@pytest.mark.parametrize(
    ("focal", "long_side"),
    [
        # Angles of a pixel that differ by less than 1.4 are the same scale.
        (1.39 * 400, 416), (1.41 * 400, 586), (400 / 1.39, 416), (400 / 1.41, 295), (8 * 400, 640), (0.1 * 400, 160),
    ],
)  # fmt: skip
def test_the_photo_is_resized_to_the_scale_of_the_views(focal: float, long_side: int) -> None:
    assert retrieval(focal=focal).upright_variant() == ImageVariant(long_side)
    guessed = replace(QUERY, intrinsics_source="guessed")
    assert retrieval(guessed, focal).upright_variant() == ImageVariant(416)


def test_a_smaller_variants_features_are_less_precise() -> None:
    assert [ImageVariant(size).max_error_px for size in (208, 416, 640)] == [8.0, 4.0, 4.0]
    assert ImageVariant(416, 3).scaled(0.77) == ImageVariant(320, 3)


@pytest.mark.parametrize(
    ("turned", "rolls"),
    [({"_416_2": 1.31}, 2), ({"_416_2": 1.29}, 0), ({"_416_2": 1.4, "_416_6": 1.5}, 6)],
)
def test_a_rotation_needs_thirteen_tenths_of_the_upright_score(monkeypatch, turned: dict, rolls: int) -> None:
    # 1 / 0.77 is 1.299.
    monkeypatch.setattr(image_variant, "rolls_to_upright", lambda *_: [0, 2, 6, 4])
    planted = {"_416_0": 1.0, "_416_2": 0.0, "_416_6": 0.0, "_416_4": 9.0}  # the third is not compared
    found = retrieval(**planted | turned)
    assert found.rotated_variant(ImageVariant(416)) == ImageVariant(416, rolls)
    assert found.rotated_variant(ImageVariant(416), likeliest_only=True) == ImageVariant(416)


def test_a_view_is_like_the_photo_from_a_score_of_one_and_a_half_on() -> None:
    assert retrieval(_416_0=1.5).is_upright(ImageVariant(416))
    assert not retrieval(_416_0=1.49).is_upright(ImageVariant(416))


def test_a_photo_turned_by_an_odd_multiple_of_45_degrees_is_four_fifths_as_large() -> None:
    found = retrieval()
    assert found.features(ImageVariant(400, 2)) == (400, 2)
    assert found.features(ImageVariant(400, 3)) == (320, 3)


def test_views_far_from_the_priors_region_are_below_all_others() -> None:
    box = BoxPrior(np.full(3, -0.5), np.array([2.5, 0.5, 0.5]))
    found = retrieval(replace(QUERY, region=box), views=30)
    demoted = found._demoted_outside_prior(np.linspace(1.0, 2.0, 30))
    # Three lie in the box; with the nearest others sixteen are searched.
    assert (demoted == 0).tolist() == [False] * 16 + [True] * 14
    assert found._demoted_outside_prior(np.linspace(-2.0, 1.0, 30))[16:] == pytest.approx(-2.0)
    wide = BoxPrior(np.full(3, -0.5), np.array([20.5, 0.5, 0.5]))
    assert (retrieval(replace(QUERY, region=wide), views=30)._demoted_outside_prior(np.ones(30)) == 0).sum() == 9
    few = retrieval(replace(QUERY, region=box), views=4)
    assert (few._demoted_outside_prior(np.ones(4)) == 1).all()


def unit(rows: Sequence[Sequence[float]]) -> np.ndarray:
    table = np.array(rows, np.float32)
    return table / np.linalg.norm(table, axis=1, keepdims=True)


def test_a_score_is_by_how_much_a_view_exceeds_the_usual_similarity() -> None:
    photo = unit([[1, 0, 0, 0]])
    # Cosines 1, 0.8, 0.6, 0.28 and 0: the fourth best is what is usual.
    views = [unit([[c, s, 0, 0]]) for c, s in ((0.6, 0.8), (1, 0), (0, 1), (0.8, 0.6), (0.28, 0.96))]
    assert retrieval_scores(photo, views) == pytest.approx([0.32, 0.72, 0, 0.52, 0], abs=1e-6)
    # Of a hundred views it is the sixth best: a twentieth of them are ahead.
    many = [unit([[c, (1 - c * c) ** 0.5, 0, 0]]) for c in np.linspace(0.01, 1.0, 100)]
    assert retrieval_scores(photo, many)[-6:] == pytest.approx([0, 0.01, 0.02, 0.03, 0.04, 0.05], abs=1e-5)
    # Of fewer views than that the last.
    assert retrieval_scores(photo, views[:2]) == pytest.approx([0.0, 0.4], abs=1e-6)


def test_the_strongest_150_features_are_compared() -> None:
    photo = np.tile(unit([[0, 1]]), (151, 1))
    photo[149:] = unit([[1, 0]])
    view = np.tile(unit([[0, -1]]), (151, 1))
    view[149] = unit([[1, 0]])
    late = np.tile(unit([[0, -1]]), (151, 1))
    late[150] = unit([[1, 0]])
    # One of the two features of the photo, in the view where it is the 150th.
    assert retrieval_scores(photo, [view, late]) == pytest.approx([1.0, 0.0])
    assert retrieval_scores(photo, [view, late], ScoreConfig(151, 151)) == pytest.approx([0.0, 0.0])
    assert top_indices(np.array([0.1, 0.5, 0.5, 0.9]), 3).tolist() == [3, 1, 2]


# ------------------------------------------------------------------ views of a scene without cameras


def test_a_pixel_shows_a_single_surface_within_the_stated_bounds() -> None:
    ones = np.ones((2, 2), np.float32)
    for alpha, depth, median, single in (
        (0.91, 1.0, 1.0, True),
        (0.9, 1.0, 1.0, False),
        (1.0, 1.049, 1.0, True),
        (1.0, 0.951, 1.0, True),
        (1.0, 1.051, 1.0, False),
        (1.0, 0.5, 0.5, False),  # as near as it may not be
        (1.0, 0.51, 0.51, True),
    ):
        frame = Frame(np.zeros((2, 2, 3), np.float32), alpha * ones, depth * ones, median * ones)
        assert shows_single_surface(frame, 0.5).all() == single


def test_searched_views_are_four_to_three_with_sixty_degrees() -> None:
    lens = search_camera(64)
    assert (lens.width, lens.height, lens.cx, lens.cy) == (64, 48, 32.0, 24.0)
    assert np.degrees(2 * np.arctan(0.5 * lens.width / lens.fx)) == pytest.approx(60)
    assert lens.fy == lens.fx


def choice(cells: Sequence[Sequence[int]], **changed: float) -> list[int]:
    config = replace(PLACEMENT, **{"min_views": 1} | changed)
    return view_placement._choice([np.array(row, np.int64) for row in cells], config).tolist()


def test_the_choice_adds_the_view_that_shows_most_until_93_hundredths_are_shown() -> None:
    shared = list(range(100))
    # Everything is seen twice; the first view shows 92 or 93 of 100 cells, the second the rest, too.
    assert choice([shared[:92], shared]) == [1]
    assert choice([shared[:93], shared[93:], shared[:50], shared[50:]]) == [0]
    assert choice([shared[:92], shared[92:], shared[:50], shared[50:]]) in ([0, 1], [0, 3])
    assert choice([shared[:93], shared[93:], shared[:50], shared[50:]], min_views=2)[0] == 0
    assert len(choice([shared[:93], shared[93:], shared[:50], shared[50:]], min_views=2)) == 2
    assert len(choice([shared[:40], shared[40:], shared[:50], shared[50:]], max_views=1)) == 1


def test_what_a_single_candidate_sees_counts_half_and_what_is_shown_a_quarter() -> None:
    # Five cells that nobody else sees are worth 5; three that two see are worth 6.
    assert choice([[0, 1, 2, 3, 4], [7, 8, 9], [7, 8, 9]], max_views=1) == [1]
    assert choice([[0, 1, 2, 3, 4, 5, 6], [7, 8, 9], [7, 8, 9]], max_views=1) == [0]
    # After the first: another five new ones twice seen (10), or 44 that are shown already (44 x 2 / 4 = 22).
    shown, new = list(range(44)), list(range(100, 105))
    assert choice([[*shown, 50, 51], shown, new, new, [50, 51]], min_views=2, max_views=2) == [0, 1]
    assert choice([[*shown[:18], 50], shown[:18], new, new, [50]], min_views=2, max_views=2) == [0, 2]


@pytest.mark.parametrize(("roll_deg", "count"), [(29, 1), (31, 2)])
def test_a_place_has_a_second_view_where_the_other_up_turns_it_by_thirty_degrees(roll_deg: int, count: int) -> None:
    up = np.array([0.0, -np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))])
    pose = look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]), up)
    found = view_placement._uprights(pose, ((0.0, -1.0, 0.0),), PLACEMENT)
    assert len(found) == count
    assert found[0] is pose
    if count == 2:
        turn_deg, way = pose_distance(found[1], pose)
        assert (turn_deg, way) == (pytest.approx(roll_deg), 0.0)


def test_poses_are_varied_by_three_tenths_of_the_distance_and_fifteen_degrees() -> None:
    space, rng = SimpleNamespace(radius=5.0, distance=2.0, up=np.array([0.0, 0, 1])), np.random.default_rng(0)
    pose = look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]), space.up)
    varied = [view_placement._jittered(pose, space, rng) for _ in range(400)]  # type: ignore[arg-type]
    shifts = np.abs([each.position_in_world for each in varied])
    assert 0.57 < shifts.max() <= 0.6
    # The tangent of the turn is about a normal variate in two directions.
    turned = [np.tan(np.arccos(np.clip(each.axis_in_world[0], -1, 1))) for each in varied]
    assert np.sqrt(np.median(np.square(turned))) == pytest.approx(0.25 * np.sqrt(2 * np.log(2)), rel=0.12)
    assert all(abs(each.world_from_camera[2, 0]) < 1e-9 for each in varied)  # upright


def test_candidates_by_size_look_at_gaussians_from_about_their_distance_and_mostly_level() -> None:
    rng = np.random.default_rng(0)
    points = np.array([[0.0, 0, 0], [100.0, 0, 0]])
    space: Any = SimpleNamespace(
        points=points, distances=np.array([2.0, 7.0]), up=np.array([0.0, 0, 1]),
        free_distance=lambda targets, directions, most: np.full(len(targets), 1e9),
    )  # fmt: skip
    poses = view_placement._by_size(space, rng, 400, np.array([True, False]))
    away = np.array([np.linalg.norm(pose.position_in_world) for pose in poses])
    assert 0.8 <= away.min() < 0.84
    assert 3.0 < away.max() <= 3.2
    assert np.median(away) == pytest.approx(2 * np.sqrt(0.4 * 1.6), rel=0.08)
    rising = np.array([pose.axis_in_world[2] for pose in poses])
    # Of directions even on a sphere, with half of the vertical part: (artanh(a) / a - 1) / 3 with a = sqrt(3 / 4).
    assert np.mean(rising**2) == pytest.approx(0.174, abs=0.025)
    space.free_distance = lambda targets, directions, most: np.full(len(targets), 1.0)
    walled = view_placement._by_size(space, rng, 50)
    nearest = np.min([[np.linalg.norm(p.position_in_world - point) for p in walled] for point in points], axis=0)
    assert nearest.max() == pytest.approx(0.9)


# ------------------------------------------------------------------ what a stage's outcome leads to


def verdict(status: str = "uncertain", reason: str = "render_mismatch", **signals: float) -> Verdict:
    told = {"local_colour_correlation": 0.9, "gradients_half": 0.9} | signals
    found = estimate(HERE, Status(status)).verdict
    return replace(found, reason=Reason(reason), signals=told, right_place=0.9, score=0.9)


def state(repeats: bool = False, free_lens: bool = False, place: float = 0.9, below: Any = None) -> SearchState:
    """A search's state whose gate finds a place so probable, and these signals below floors in the scene's light."""
    told = {False: ["colours"], True: []} if below is None else below
    model = SimpleNamespace(
        probability=lambda signals: place, below_floor=lambda signals, light_may_differ=False: told[light_may_differ]
    )
    config = replace(SEARCH, verification=replace(SEARCH.verification, model=model))
    return SearchState(
        SimpleNamespace(prepared=SimpleNamespace(repeats_itself=repeats, like_its_mirror_image=True, whole=None)),  # type: ignore[arg-type]
        SimpleNamespace(query=SimpleNamespace(lens_prior=object() if free_lens else None)),  # type: ignore[arg-type]
        None,  # type: ignore[arg-type]
        None,  # type: ignore[arg-type]
        config,
    )


@pytest.mark.parametrize(
    ("colour", "edges", "place", "status", "others"),
    [
        (0.969, 0.59, 0.8, "uncertain", True),
        (0.969, 0.6, 0.8, "uncertain", False),
        (0.97, 0.59, 0.8, "uncertain", False),  # sure colours
        (0.969, 0.59, 0.79, "uncertain", False),  # not the place
        (0.969, 0.59, 0.8, "not_localized", False),
    ],
)
def test_edges_in_colour_speak_against_a_place_below_six_tenths(
    monkeypatch, colour, edges, place, status, others
) -> None:
    found = state()
    monkeypatch.setattr(SearchState, "colour_edges_at", lambda self, refined: edges)
    each = replace(verdict(status, local_colour_correlation=colour), right_place=place)
    assert found._shows_other_colours(None, each) is others  # type: ignore[arg-type]


@pytest.mark.parametrize(("colour", "edges", "expected"), [(0.9, 0.0, True), (0.89, 0.72, True), (0.89, 0.71, False)])
def test_only_colours_doubt_where_local_colours_or_their_edges_agree(monkeypatch, colour, edges, expected) -> None:
    monkeypatch.setattr(SearchState, "colour_edges_at", lambda self, refined: edges)
    each, refined = verdict(local_colour_correlation=colour), SimpleNamespace()
    doubt = search_state.only_colours_doubt
    assert doubt(state(), refined, each) is expected  # type: ignore[arg-type]
    for other in (
        doubt(state(), refined, replace(each, status=Status.LOCALIZED)),  # type: ignore[arg-type]
        doubt(state(), refined, replace(each, reason=Reason.FEW_INLIERS)),  # type: ignore[arg-type]
        doubt(state(place=0.79), refined, each),  # type: ignore[arg-type]
        doubt(state(below={False: ["drift_px"], True: ["drift_px"]}), refined, each),  # type: ignore[arg-type]
        doubt(state(below={False: [], True: []}), refined, each),  # type: ignore[arg-type]
    ):
        assert not other
    assert doubt(state(place=0.8), refined, each) is expected  # type: ignore[arg-type]


def test_the_light_may_differ_where_three_quarters_of_the_gradients_agree() -> None:
    may = search_state._may_be_in_other_light
    assert may(state(), verdict(gradients_half=0.75))
    assert not may(state(), verdict(gradients_half=0.749))
    assert not may(state(repeats=True), verdict())
    assert not may(state(free_lens=True), verdict())
    assert not may(state(), verdict("localized", "verified"))
    assert not may(state(), verdict(reason="intrinsics_contradicted"))
    assert not may(state(), verdict(reason="outside_prior"))


@pytest.mark.parametrize(
    ("inliers", "free_lens", "expected", "decide"),
    [(60, False, False, True), (59, False, False, False), (59, False, True, True), (100, True, False, True),
     (99, True, False, False), (None, False, False, False)],
)  # fmt: skip
def test_pixels_alone_may_decide_after_sixty_inliers_and_a_hundred_with_any_lens(
    monkeypatch, inliers, free_lens, expected, decide
) -> None:
    asked = []
    found = state(free_lens=free_lens)
    monkeypatch.setattr(
        SearchState, "verify", lambda self, refined, may, **_: asked.append(may) or verdict("localized", "verified")
    )
    refined = SimpleNamespace(num_inliers=inliers, pose=HERE, correction=None)

    def outcome():
        yield from ()
        return SimpleNamespace(recognised=True, unmatched=None, refined=refined)

    records = list(search_state.run_stage(found, Stage(outcome(), ImageVariant(416), expected)))  # type: ignore[arg-type]
    assert asked == [decide]
    assert [record.stage for record in records] == ["verify"]
    assert found.finished
    assert found.recognised
    assert found.best is not None
    assert records[0].loss == pytest.approx(1 - 0.9)


def test_a_better_answer_replaces_the_best_and_a_doubt_that_is_conclusive_ends_the_search(monkeypatch) -> None:
    found = state()
    verdicts = iter(
        [verdict("localized", "verified"), replace(verdict(), right_place=0.99), verdict(reason="position_uncertain")]
    )
    monkeypatch.setattr(SearchState, "verify", lambda self, refined, may, **_: next(verdicts))
    monkeypatch.setattr(search_state, "_may_be_in_other_light", lambda *_: False)
    monkeypatch.setattr(search_state, "only_colours_doubt", lambda *_: False)
    kept = []
    for number, unmatched in enumerate((None, None, None)):
        refined = SimpleNamespace(num_inliers=number, pose=HERE, correction=None)

        def outcome(refined=refined, unmatched=unmatched):
            yield from ()
            return SimpleNamespace(recognised=False, unmatched=unmatched, refined=refined)

        list(search_state.run_stage(found, Stage(outcome(), ImageVariant(416))))  # type: ignore[arg-type]
        kept.append((found.best.refined.num_inliers, found.finished))  # type: ignore[union-attr]
    assert kept[:2] == [(0, True), (0, False)]
    assert kept[2] == (0, Reason.POSITION_UNCERTAIN in search_state.CONCLUSIVE_DOUBTS)


@pytest.mark.parametrize(
    ("against", "kept"),
    [({}, "ab"), ({"a": "b"}, "b"), ({"b": "a"}, "a"), ({"a": "b", "b": "a"}, "ab")],
)
def test_what_the_devices_readings_speak_against_is_no_alternative(against: dict, kept: str, monkeypatch) -> None:
    """All answers stay where each is refused for another one."""

    def one(name: str) -> Any:
        return SimpleNamespace(name=name, verdict=SimpleNamespace(signals={}), variant=None, refined=REFINED)

    def refine(*_: Any) -> Any:
        yield "a record"
        return SimpleNamespace(pose="elsewhere")

    seen = SimpleNamespace(pose=HERE, differs_from=lambda *_: True)
    for name, value in {
        "explains_whole_photo": lambda *_: False, "seen_from": lambda *_: seen, "twins_of": lambda *_: [],
        "hypotheses_of_photo": lambda *_: [], "rendered_ahead": lambda *_: ["hypothesis"], "refine_ambiguous": refine,
        "replace": lambda value, **_: value, "VerifiedPose": lambda *_: one("b"),
        "_ranked": lambda _, answers: "".join(each.name for each in answers),
    }.items():  # fmt: skip
        monkeypatch.setattr(ambiguity_check, name, value)
    searching: Any = SimpleNamespace(
        best=one("a"), config=SimpleNamespace(answers=None, ambiguity=None),
        images=SimpleNamespace(corrected=lambda _: None),
        verify=lambda _: SimpleNamespace(status=Status.LOCALIZED),
        readings_prefer=lambda other, than: against.get(than.name) == other.name,
    )  # fmt: skip
    records, _ = drained(ambiguity_check.check_ambiguity(searching))
    assert records == ["a record", kept]


REFINED = SimpleNamespace(correction=None, pose=HERE)


@pytest.mark.parametrize("loss", [0.02, 0.05])
def test_an_ambiguous_hypothesis_may_leave_three_times_the_answers_residual(monkeypatch, loss: float) -> None:
    seen = []
    monkeypatch.setattr(
        ambiguity_check, "refine_stage", lambda other, images, renderer, config, most: seen.append(most) or iter(())
    )
    answer = VerifiedPose(SimpleNamespace(loss=loss, correction=None), verdict(), ImageVariant(416))  # type: ignore[arg-type]
    records, refined = drained(ambiguity_check.refine_ambiguous(state(), agreed(30), answer))
    assert (records, refined, seen) == ([], None, [pytest.approx(3 * loss)])
