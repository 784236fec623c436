"""Whole runs with planted parts: the default estimator's order, the search for views, a proxy's Gaussians, support."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_bench import estimate
from test_search_flow import refined
from test_search_thresholds import HERE, LENS, QUERY, drained, state, verdict

from service import localize as localizing
from service.estimators import view_index
from service.estimators.search_state import SearchState, VerifiedPose
from service.estimators.view_index import Options
from service.geometry import moved
from service.interfaces import Features
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.features.query_images import QueryImages
from service.pose.retrieval import floaters, lod_proxy, view_placement
from service.pose.retrieval.image_variant import ImageVariant
from service.pose.retrieval.lod_proxy import LodConfig
from service.pose.retrieval.view_placement import PLACEMENT
from service.results import IterationRecord, Reason, Status
from service.types import BoxPrior, IntrinsicsCorrection, Query

BOX = BoxPrior(-np.ones(3), np.ones(3))

# ------------------------------------------------------------------ the default estimator


def made_by(
    monkeypatch: pytest.MonkeyPatch,
    query: Query,
    prior_ends: bool = False,
    ends_at: str = "third",
    unmatched: bool = False,
) -> list[str]:
    """Return the steps of a run, in order; the search has three stages, and ends with the named one."""
    made: list[str] = []
    searching = state()

    def step(name: str, value: Any = None) -> Callable[..., Any]:
        def run(*_: Any) -> Any:
            made.append(name)
            yield from ()
            return value

        return run

    def run_stage(state: SearchState, stage: Any) -> Any:
        name = getattr(stage, "name", stage)
        made.append(name)
        state.finished = name == ends_at or (name == "prior" and prior_ends)
        state.unmatched = AbsolutePose(HERE, np.zeros(3, bool)) if unmatched and name == "second" else None
        yield IterationRecord(name, HERE)

    monkeypatch.setattr(view_index.SearchState, "of", lambda *_: searching)
    monkeypatch.setattr(view_index.SearchState, "answer", lambda self: "answer")
    monkeypatch.setattr(view_index, "_refine_from_prior", lambda state: "prior")
    monkeypatch.setattr(view_index, "_search_stages", lambda *_: iter([SimpleNamespace(name=n) for n in NAMES]))
    monkeypatch.setattr(view_index, "_rematch", lambda *_: None)
    monkeypatch.setattr(view_index, "replace", lambda stage, records: "again")
    monkeypatch.setattr(view_index, "run_stage", run_stage)
    for name in ("_check_readings", "refine_by_patches", "check_ambiguity", "_doubts"):
        monkeypatch.setattr(view_index, name, step(name.strip("_")))
    for name in ("check_lens", "check_shutter"):
        monkeypatch.setattr(view_index, name, step(name, searching))
    _, answer = drained(view_index.run(query, SimpleNamespace(), Options()))  # type: ignore[arg-type]
    assert answer == "answer"
    return made


NAMES = ("first", "second", "third")
CHECKS = ["check_readings", "check_lens", "check_shutter", "refine_by_patches", "doubts"]


def test_a_search_ends_with_the_stage_that_is_accepted_and_checks_its_answer(monkeypatch) -> None:
    assert made_by(monkeypatch, QUERY, ends_at="first") == ["first", *CHECKS]
    assert made_by(monkeypatch, QUERY, ends_at="second") == ["first", "second", *CHECKS]
    assert made_by(monkeypatch, QUERY, ends_at="none") == [*NAMES, *CHECKS]
    # What few matches led to is matched with a render before the next stage, unless it is accepted.
    assert made_by(monkeypatch, QUERY, unmatched=True) == ["first", "second", "again", "third", *CHECKS]
    assert made_by(monkeypatch, QUERY, ends_at="again", unmatched=True) == ["first", "second", "again", *CHECKS]
    assert made_by(monkeypatch, QUERY, ends_at="second", unmatched=True) == ["first", "second", *CHECKS]


def test_a_prior_that_refinement_confirms_is_the_answer(monkeypatch) -> None:
    known = replace(QUERY, prior=HERE)
    checks = ["check_shutter", "check_readings", "refine_by_patches"]
    assert made_by(monkeypatch, known, prior_ends=True) == ["prior", *checks, "check_ambiguity"]
    # A region decides between places that look alike.
    assert made_by(monkeypatch, replace(known, region=BOX), prior_ends=True) == ["prior", *checks]
    assert made_by(monkeypatch, known, ends_at="first") == ["prior", "first", *CHECKS]


def test_views_are_matched_in_turn_after_a_render_at_the_prior(monkeypatch) -> None:
    poses = [moved(HERE, np.array([0, 0, 0, float(k), 0, 0])) for k in range(5)]
    views = [SimpleNamespace(camera=SimpleNamespace(pose=pose)) for pose in poses]
    seen: list[Any] = []

    def match(some, variant, state):
        for view in some:
            seen.append(view)
            if view is views[1]:
                break
        yield from ()

    monkeypatch.setattr(view_index, "_match_and_refine", match)
    searching = state()
    searching.tools = SimpleNamespace(prepared=SimpleNamespace(views=views))  # type: ignore[assignment]
    searching.retrieval = SimpleNamespace(scores=lambda variant: 10.0 - np.arange(5))  # type: ignore[assignment]
    searching.renderer = SimpleNamespace(at=lambda *_: SimpleNamespace(view=lambda matcher: "at the prior"))  # type: ignore[assignment]
    there = moved(HERE, np.array([0, 0, 0, 9.0, 0, 0]))
    for prior, tries, expected in ((None, True, []), (there, False, []), (there, True, ["at the prior"])):
        seen.clear()
        searching.images = SimpleNamespace(query=SimpleNamespace(prior=prior), matcher=None)  # type: ignore[assignment]
        untried = view_index.deque([3, 1, 4])
        search = view_index._search_views("name", ImageVariant(416), untried, searching, try_prior_view=tries)
        (record,) = list(search)
        assert record.pose is (prior or poses[3])
        assert record.candidates.scores.tolist() == [7, 9, 6]
        assert seen == [*expected, views[3], views[1]]
        assert list(untried) == [4]


# ------------------------------------------------------------------ the end of a localization


@pytest.mark.parametrize(
    ("status", "reason", "outside", "doubted"),
    [
        (Status.LOCALIZED, Reason.VERIFIED, True, True),
        (Status.LOCALIZED, Reason.VERIFIED, False, False),
        (Status.UNCERTAIN, Reason.LOW_COVERAGE, True, True),
        (Status.UNCERTAIN, Reason.MIRRORED, True, False),
        (Status.NOT_LOCALIZED, Reason.FEW_INLIERS, True, False),
    ],
)
def test_a_pose_outside_of_what_was_captured_is_doubted_unless_another_reason_decides(
    monkeypatch, status, reason, outside, doubted
) -> None:
    monkeypatch.setattr(localizing, "is_outside", lambda *_: outside)
    given = replace(estimate(HERE, status).verdict, reason=reason, right_place=0.9, precise=0.9)
    told = localizing._if_captured(given, QUERY, HERE, SimpleNamespace(prepared=None, rasterizer=None))  # type: ignore[arg-type]
    assert (told.reason is Reason.OUTSIDE_CAPTURED_VOLUME) is doubted
    assert told.status is (Status.UNCERTAIN if doubted else status)


def test_unknown_training_photos_are_taken_for_the_photos_own_size_within_bounds() -> None:
    def assumed(long_side: int, **info: Any) -> int | None:
        known = {"training_focal_px": None, "training_long_side_px": None} | info
        loaded: Any = SimpleNamespace(scene=SimpleNamespace(info=SimpleNamespace(**known)))
        query: Any = SimpleNamespace(photo_intrinsics=SimpleNamespace(long_side=long_side))
        return localizing._assumed_training_px(query, loaded)

    assert [assumed(side) for side in (640, 1000, 4000)] == [800, 1000, 1600]
    assert assumed(1000, training_focal_px=500.0) is None
    assert assumed(1000, training_long_side_px=640) is None


# ------------------------------------------------------------------ pictures of a photo whose distortion was estimated


class FixedMatcher:
    name = "fixed"

    def extract(self, rgb: np.ndarray, limit: int) -> Features:
        points = np.array([[208.0, 156.0], [380.0, 156.0], [100.0, 60.0]], np.float32)
        return Features(points, np.ones(3, np.float32), np.zeros((3, 2), np.float32))


def test_a_corrected_distortion_moves_features_and_resamples_pictures() -> None:
    column = np.mgrid[:312, :416][1]
    rgb = np.repeat((column // 2).astype(np.uint8)[..., None], 3, 2)
    images = QueryImages(replace(QUERY, rgb=rgb), FixedMatcher())  # type: ignore[arg-type]
    same = images.corrected(IntrinsicsCorrection(1.25))
    assert same.query.intrinsics.fx == 500.0
    assert same.resized(LENS) is images.resized(LENS)
    straight = images.corrected(IntrinsicsCorrection(1.25, k1=-0.2))
    (before, after) = (one.features().points_px for one in (images, straight))
    # A pixel at the undistorted radius r lies at r (1 + k1 r^2) in the photo, in focal lengths of 500.
    for old, new in zip(before, after, strict=True):
        offset = (new - [208.0, 156.0]) / 500
        assert (1 - 0.2 * offset @ offset) * offset * 500 + [208.0, 156.0] == pytest.approx(old, abs=0.01)
    assert np.hypot(*(after[1] - [208, 156])) > 172 + 2
    picture = straight.resized(LENS)
    offset = (300.5 - 208) / 500
    assert picture[155, 300, 0] == pytest.approx((208 + 500 * offset * (1 - 0.2 * offset**2) - 0.5) / 2, abs=0.8)
    # Barrel distortion leaves nothing unseen at k1 < 0; with k1 > 0 the corners are beyond the photo's edge.
    assert straight.valid_mask(LENS) is None
    bent = images.corrected(IntrinsicsCorrection(k1=0.3)).valid_mask(LENS)
    assert bent is not None
    assert bent[150:160, 100:300].all()
    assert not bent[2, 2]
    valid = np.ones((312, 416), bool)
    valid[:, :100] = False
    hidden = QueryImages(replace(QUERY, rgb=rgb, valid_mask=valid), FixedMatcher())  # type: ignore[arg-type]
    mask = hidden.corrected(IntrinsicsCorrection(k1=-0.2)).valid_mask(LENS)
    assert mask is not None
    edge = int(np.argmax(mask[156]))
    offset = (edge - 208) / 400
    assert 208 + 400 * offset * (1 - 0.2 * offset**2) == pytest.approx(100, abs=1.5)


# ------------------------------------------------------------------ the search for views


def searched(
    monkeypatch: pytest.MonkeyPatch, covered: list[float], good: list[int], wanted: float = 3, up: bool = True
) -> tuple[list[int], Any]:
    """Return how many candidates each round has, and what the search led to, by what is covered after each."""
    left, sizes, known = iter(covered), [], iter(good)

    class Views:
        interior = False

        def __init__(self, *_: Any) -> None:
            self.poses, self.scores = [HERE] * 10, list(range(10))

        def add_candidates(self, poses: list) -> None:
            sizes.append(len(poses))

        def good(self) -> np.ndarray:
            return np.arange(next(known, good[-1]))

        def seen(self, chosen: np.ndarray) -> np.ndarray:
            return (np.arange(1000) < 1000 * next(left, covered[-1])).astype(np.int64)

    space = SimpleNamespace(wanted_good_views=wanted, distance=2.0, is_up_known=up)
    monkeypatch.setattr(view_placement, "free_space_of", lambda scene: space)
    monkeypatch.setattr(view_placement, "lod_proxy", lambda *_: None)
    monkeypatch.setattr(view_placement, "_Views", Views)
    for name, count in (("_shells", 3), ("_in_volume", 4)):
        monkeypatch.setattr(view_placement, name, lambda *_, count=count: [HERE] * count)
    monkeypatch.setattr(view_placement, "_by_size", lambda space, rng, count, *_: [HERE] * count)
    monkeypatch.setattr(view_placement, "_jittered", lambda *_: HERE)
    asked: list[Any] = []
    monkeypatch.setattr(view_placement, "_chosen", lambda views, good, config: asked.append(config) or good[:1])
    config = replace(
        PLACEMENT, size_candidates=5, best=6, candidates_near_each=2, round_candidates=14, rounds=4, max_views=9
    )
    found = view_placement.find_views(SimpleNamespace(), None, np.random.default_rng(0), config)  # type: ignore[arg-type]
    return sizes, (asked[0].max_views, len(found.cameras))


def test_the_search_for_views_ends_where_enough_is_seen_or_little_is_gained(monkeypatch) -> None:
    first = [12, 12]  # three on shells, four in the volume, five by size; then two near each of the best six
    assert searched(monkeypatch, [0.96], [5])[0] == first
    # 0.95 isn't enough; 0.004 more is too little a gain, 0.005 isn't.
    assert searched(monkeypatch, [0.95, 0.954], [5])[0] == [*first, 14]
    assert searched(monkeypatch, [0.5, 0.505, 0.509], [5])[0] == [*first, 14, 14]
    assert searched(monkeypatch, [0.5, 0.6, 0.7, 0.8, 0.9], [5])[0] == [*first, 14, 14, 14, 14]
    # Too few good views go on, whatever is seen.
    assert searched(monkeypatch, [0.96, 0.96, 0.96], [2, 2, 3])[0] == [*first, 14, 14]
    assert searched(monkeypatch, [0.96], [0, 3])[0] == [*first, 7]
    # Without an up direction each place may have a second view.
    assert searched(monkeypatch, [0.96], [5])[1][0] == 9
    assert searched(monkeypatch, [0.96], [5], up=False)[1][0] == 9 // (1 + len(view_placement.OTHER_UPS))


# ------------------------------------------------------------------ a proxy of a large scene


def test_a_proxy_keeps_gaussians_by_their_area_and_enlarges_what_chance_chose(monkeypatch) -> None:
    rng = np.random.default_rng(0)
    count = 6000
    scales = np.sort(rng.uniform(0.1, 0.5, (count, 3)), axis=1)[:, [1, 0, 2]].astype(np.float32)
    scales[:100] *= 10
    opacities = rng.uniform(0.3, 1.0, count).astype(np.float32)
    made: list[Any] = []
    monkeypatch.setattr(lod_proxy, "replace", lambda scene, **changed: SimpleNamespace(**changed))
    arrays = {name: np.arange(count, dtype=np.float32)[:, None] for name in ("means", "quats")}
    scene: Any = SimpleNamespace(count=count, scales=scales, opacities=opacities, sh=np.zeros((count, 4, 3)), **arrays)
    renderer: Any = SimpleNamespace(of=lambda scene: made.append(scene) or "proxy")
    assert lod_proxy.lod_proxy(scene, renderer, rng, LodConfig(proxy_gaussians=1000)) == "proxy"
    (proxy,) = made
    chosen = proxy.means[:, 0].astype(int)
    assert len(chosen) == pytest.approx(1000, abs=80)
    assert proxy.sh.shape[1] == 1
    # The large ones are certain; of the others p is in proportion to the area of the larger two axes, by opacity.
    assert set(range(100)) <= set(chosen)
    areas = (scales[:, 0] * scales[:, 2] * opacities)[100:]
    share = 900 * areas / areas.sum()
    small = chosen >= 100
    wider = proxy.scales[small][:, [0, 2]] / scales[chosen[small]][:, [0, 2]]
    assert wider**2 == pytest.approx(np.repeat(2 / share[chosen[small] - 100][:, None], 2, 1), rel=1e-3)
    assert (proxy.scales[~small] == scales[:100]).all()
    # The thinnest axis stays.
    assert (proxy.scales[:, 1] == scales[chosen, 1]).all()
    # As many are kept as their areas say: the larger half has more than the smaller one.
    larger = np.isin(np.arange(100, count), chosen)[areas > np.median(areas)].sum()
    assert larger == pytest.approx(share[areas > np.median(areas)].sum(), abs=60)
    assert lod_proxy.lod_proxy(scene, renderer, rng, LodConfig(proxy_gaussians=count)) is renderer


# ------------------------------------------------------------------ what supports a Gaussian


def test_the_box_of_cameras_and_content_holds_its_borders() -> None:
    cameras = [
        SimpleNamespace(camera=SimpleNamespace(pose=moved(HERE, np.array([0, 0, 0, x, 0.0, 0])))) for x in (-3, 1)
    ]
    points = np.array([[0.0, y, y] for y in (-8, -1, 0, 2, 9)])
    means = np.array(
        [[-3, 0, 0], [1, 2, 2], [-3.1, 0, 0], [1.1, 0, 0], [0, 2.1, 0], [0, 0, -1], [0, 0, -1.1]], np.float32
    )
    scene: Any = SimpleNamespace(cameras=cameras, means=means)
    found = floaters._among_cameras_and_content(scene, SimpleNamespace(points=points))  # type: ignore[arg-type]
    assert found.tolist() == [True, True, False, False, False, True, False]


def test_support_is_the_area_of_others_in_a_cube_over_its_side_squared(monkeypatch) -> None:
    asked: list[tuple[float, list[int]]] = []

    def area_around(means, areas, largest, side, among):
        asked.append((round(side, 6), among.tolist()))
        # Of the second too little at any level.
        return np.array([{0: 1.0, 1: 0.2, 2: 0.5}[i] for i in among.tolist()]) * side**2

    monkeypatch.setattr(floaters, "_area_around", area_around)
    config = replace(floaters.FLOATERS, reach=0.05, finest_level=-2, coarsest_level=2, min_support=0.4)
    space: Any = SimpleNamespace(distance=4.0, middle=np.array([1.0, 2, 3]))
    # Middle scales of the base's 0.2, of a quarter of it and a fourfold of it.
    scales = np.float32([[0.1, 0.21, 0.9], [0.01, 0.051, 0.9], [0.1, 0.81, 0.9]])
    scene: Any = SimpleNamespace(means=np.zeros((3, 3), np.float32), scales=scales, opacities=np.ones(3, np.float32))
    found = floaters._supports(scene, space, np.arange(3), config)
    # The third's finest level is 2, the second's -2: it is asked at 0, -1 and -2; the first only at 0.
    assert asked == [(0.6, [0, 1]), (2.4, [2]), (0.3, [1]), (0.15, [1])]
    assert found == pytest.approx([1.0, 0.2, 0.5])


def test_an_answer_without_a_residual_has_an_infinite_one() -> None:
    assert VerifiedPose(refined(None), verdict(), ImageVariant(416)).loss == np.inf
    assert VerifiedPose(refined(0.02), verdict(), ImageVariant(416)).loss == 0.02
