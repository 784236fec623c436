"""Values that lie exactly at a bound, and on which side of it docstrings and names ("less than", "at most") put them.

Other tests are just below and just above; the bounds here are those of a config, or are set to the value that is
planted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_gate_thresholds import (
    ASKED,
    CERTAIN,
    HERE,
    captured_from,
    columns,
    covariance,
    cropped,
    frame,
    grey_photo,
    of_rig,
    rig_photo,
    seen,
    signals,
    towards,
    verdict,
)
from test_odometry_fit import EXACT, fixed, step_fixes
from test_search_thresholds import LENS, agreed, drained, matches, rematched, retrieval, state
from test_search_thresholds import verdict as told_verdict

from service.device_readings import HeadingPrior, ScenePriors, UpPrior
from service.estimators import ambiguity_check, rivals, search_state
from service.estimators.search_state import SearchState, Stage, VerifiedPose
from service.geometry import moved
from service.interfaces import Features, Frame
from service.live.fusion import FUSION, Fusion
from service.live.live_values import OdometryFacts
from service.pose.absolute_pose import device_priors, fisheye
from service.pose.absolute_pose.device_priors import DEVICE_PRIORS, PriorResidual, agreement, prefers
from service.pose.absolute_pose.fisheye import FISHEYE, LensModels
from service.pose.absolute_pose.p3p import polish_distances
from service.pose.features.rendered_views import View, backprojected
from service.pose.features.unknown_background import UNKNOWN_BACKGROUND, has_white_border, shows_background
from service.pose.matching import match_stages
from service.pose.refinement import gauss_newton
from service.pose.refinement.lens_test import LensFit, moves_pose
from service.pose.refinement.refinement_config import RefinementConfig
from service.pose.retrieval import free_views, index_builder, outer_planes, scene_symmetries, view_placement, viewpoints
from service.pose.retrieval.ambiguous_hypotheses import AMBIGUITY, PoseAtDistance, _shows_the_same, _unexplained
from service.pose.retrieval.image_variant import ImageVariant, Retrieval
from service.pose.retrieval.index_builder import IndexBuilder, PartsConfig
from service.pose.retrieval.lod_proxy import LOD, OccludedRenderer, lod_proxy, occlusion_depths
from service.pose.retrieval.outer_planes import PLANES, before_planes, ground_normal
from service.pose.retrieval.scene_symmetries import SYMMETRY, Repetitions, is_examined
from service.pose.retrieval.view_placement import PLACEMENT, shows_single_surface
from service.pose.verification import advice, gate
from service.pose.verification.advice import ADVICE
from service.pose.verification.appearance import GLOBAL_SIGNALS
from service.pose.verification.captured_volume import CAPTURE, is_outside
from service.pose.verification.gate import VERIFICATION, verdict_of
from service.pose.verification.photo_quality import PHOTO_QUALITY, photo_faults
from service.pose.verification.precision import AskedBounds
from service.pose.verification.rig_gate import rig_verdict
from service.pose.verification.signals import geometry_signals
from service.results import Reason
from service.types import Camera, Intrinsics, IntrinsicsCorrection, Pose, SceneInfo

INFO = SceneInfo("room", "room", "0" * 64, "ply", metres_per_unit=1.0)


def at(x: float = 0.0) -> Pose:
    return moved(HERE, np.array([0, 0, 0, x, 0, 0]))


# ------------------------------------------------------------------ the gate


def test_signals_and_precision_at_the_gates_bounds_pass() -> None:
    found = signals()
    scales = VERIFICATION.model.scales
    mean = float(np.mean([scales[name](found[name]) for name in GLOBAL_SIGNALS]))
    assert not gate._is_unlike(found, replace(VERIFICATION, unlike=mean))
    spread = covariance(1e-6, 0.05)
    precise = verdict(uncertainty=replace(CERTAIN, covariance=spread)).precise
    assert 0 < precise < 1
    model = SimpleNamespace(scales=scales, probability=lambda _: 0.95, below_floor=lambda *_: [])
    config = replace(VERIFICATION, model=model, min_precise=precise)
    uncertain = replace(CERTAIN, covariance=spread)
    assert verdict_of(found, uncertain, ASKED, config=config).reason is Reason.VERIFIED
    # Of approximate intrinsics: these would suffice where they alone are at the bound.
    worse = replace(CERTAIN, covariance=covariance(1e-6, 1.0), given_lens=spread)
    assert verdict_of(found, worse, ASKED, config=config).reason is Reason.FOCAL_UNCERTAIN


def test_a_cropped_photo_at_the_bounds_is_certain() -> None:
    each = cropped(sigma_deg=1.5, sigma=0.1)
    assert each.if_cropped is not None
    spread = each.if_cropped.covariance
    deg, units = float(np.degrees(np.sqrt(np.trace(spread[:3, :3])))), float(np.sqrt(np.trace(spread[3:, 3:])))
    near = AskedBounds(5.0, 0.02, 1.0)
    # Bounds of the default accuracy: these are not widened.
    assert near.looser_rotation == near.looser_position == 1.0
    config = replace(VERIFICATION, max_sigma_deg_if_cropped=deg, max_sigma_share_if_cropped=units)
    assert gate._is_certain_if_cropped(each, near, config)
    for name, bound in (("max_sigma_deg_if_cropped", deg), ("max_sigma_share_if_cropped", units)):
        assert not gate._is_certain_if_cropped(each, near, replace(config, **{name: 0.999 * bound}))


def test_a_covariance_that_is_as_wide_is_not_replaced_by_that_of_a_crop() -> None:
    doubtful = replace(cropped(), focal_step=0.1)
    assert doubtful.if_cropped is not None
    alike = replace(doubtful.if_cropped, covariance=covariance(), step=np.full(6, 0.3))
    assert verdict(uncertainty=replace(doubtful, if_cropped=alike)).covariance == pytest.approx(covariance())


@pytest.mark.parametrize(
    ("count", "drop", "ratio", "contradicts"),
    [(40, 30.0, 0.5, True), (39, 99.0, 0.5, False), (40, 29.0, 0.5, False), (40, 30.0, 0.98, True),
     (40, 59.0, 0.99, False), (40, 60.0, 0.99, True)],
)  # fmt: skip
def test_matches_speak_against_a_lens_from_their_least_number_and_cost_on(
    monkeypatch, count, drop, ratio, contradicts
) -> None:
    """Forty matches, 30 of the cost where the pixels agree, 60 alone; the bound of the pixels' residual is 0.98."""
    test = replace(
        VERIFICATION.refinement.lens_test,
        min_cost_drop=30.0,
        min_cost_drop_alone=60.0,
        max_loss_ratio_with_matches=0.98,
    )
    config = replace(VERIFICATION, min_lens_matches=40, refinement=replace(VERIFICATION.refinement, lens_test=test))
    turned = np.array([0, 1.0, 0, 0, 0, 0])
    evidence = SimpleNamespace(cost_drop=drop, motion=turned, correction=IntrinsicsCorrection(1.1))
    monkeypatch.setattr(gate, "evidence_against_lens", lambda *_: evidence)
    fit = LensFit(IntrinsicsCorrection(), np.zeros(6), ratio, False)
    query: Any = SimpleNamespace(intrinsics=LENS)
    found = gate._with_evidence_of_matches(
        replace(CERTAIN, lens_fit=fit), matches(count), query, LENS, HERE, config
    ).lens_fit
    assert found is not None
    assert found.contradicts is contradicts
    decided = replace(CERTAIN, lens_fit=replace(fit, contradicts=True))
    assert gate._with_evidence_of_matches(decided, matches(count), query, LENS, HERE, config) is decided


def test_a_motion_at_the_bound_moves_nothing() -> None:
    turn, way = np.array([0.5, 0, 0, 0, 0, 0]), np.array([0, 0, 0, 0.5, 0, 0])
    assert not moves_pose(turn, 1.0, float(np.degrees(0.5)), 1.0)
    assert not moves_pose(way, 1.0, 90.0, 0.5)


def test_a_rig_is_as_precise_as_the_bound_asks_for() -> None:
    spread = covariance(1e-6, 0.05)
    precise = of_rig(rig_photo(), rig_photo(), spread=spread).precise
    assert precise is not None
    model = SimpleNamespace(probability=lambda _: 0.9)
    for least, reason in ((precise, Reason.VERIFIED), (precise + 1e-9, Reason.POSITION_UNCERTAIN)):
        config = replace(VERIFICATION, model=model, min_precise=least)
        assert rig_verdict([rig_photo(), rig_photo()], spread, ASKED, 0.0, gate=config).reason is reason


def test_a_spread_as_large_as_the_distance_is_undetermined() -> None:
    step = np.array([0, 0, 0, 0.01, 0, 0])
    spread = np.diag([1e-8] * 3 + [16.0, 0.0, 0.0])  # a standard deviation of 4 at a depth of 4
    found = geometry_signals(
        frame(), Intrinsics(120, 90, 100.0, 100.0, 60.0, 45.0), replace(CERTAIN, last_step=step, covariance=spread)
    )
    assert found["sigma_share"] == 1.0
    assert found["drift_px"] == 1000.0


# ------------------------------------------------------------------ captured, and what is said of a photo


@pytest.mark.parametrize("distance", [32.0, 4 / 3])
def test_a_sight_eight_times_nearer_or_three_times_farther_is_not_captured(distance: float) -> None:
    assert captured_from(towards(0, distance)) == 0.0


def test_a_pose_is_inside_with_half_of_what_it_sees_and_needs_a_render_from_half_the_distance_on(monkeypatch) -> None:
    lens = Intrinsics(128, 128, 100.0, 100.0, 64.0, 64.0)
    nothing = Features(*(np.zeros(shape, np.float32) for shape in ((3, 2), (3,), (3, 64))))
    view = View(Camera(lens, HERE), nothing, np.array([[0, 0, 4.0]] * 3, np.float32))
    rendered: list[Any] = []
    rasterizer: Any = SimpleNamespace(render=lambda cameras: rendered.append(cameras) or [None])
    for share, outside in ((0.5, False), (0.4999, True), (None, False)):
        monkeypatch.setattr("service.pose.verification.captured_volume.captured_share", lambda *_, s=share: s)
        assert is_outside(lens, at(2.0), rasterizer, [view]) is outside
    assert len(rendered) == 3
    is_outside(lens, at(1.999), rasterizer, [view])
    assert len(rendered) == 3
    assert (CAPTURE.min_share, CAPTURE.near_share) == (0.5, 0.5)


def test_a_photo_at_the_bound_of_darkness_is_not_dark() -> None:
    black = np.zeros((48, 64, 3), np.float32)
    grey = float(np.quantile(np.float32(63) / np.float32(255) * np.ones(9, np.float32), 0.9))
    photo = grey_photo(63)
    for bound, dark in ((grey, False), (1.001 * grey, True)):
        assert any("dark" in said for said in photo_faults(photo, black, replace(PHOTO_QUALITY, dark=bound))) is dark
    # As many white pixels more than the render's as are allowed: half of them.
    photo = grey_photo(100)
    photo[:, :32] = 255
    for share, overexposed in ((0.5, False), (0.49, True)):
        found = photo_faults(photo, black, replace(PHOTO_QUALITY, max_white_share=share))
        assert any("overexposed" in said for said in found) is overexposed


def test_advice_at_its_bounds() -> None:
    assert advice._about_direction(np.diag([2.0, 1.0, 1.0]), replace(ADVICE, widest_share=0.5))
    assert not advice._about_direction(np.diag([2.0, 1.0, 1.0]), replace(ADVICE, widest_share=0.51))
    # A lens that would make the position as certain as the bound says gains nothing.
    told = replace(
        verdict(), covariance=np.diag([1e-8] * 3 + [4.0, 0, 0]), covariance_given_lens=np.diag([0] * 3 + [1.0, 0, 0])
    )
    for gain, said in ((0.5, False), (0.51, True)):
        found = advice._about_position(
            seen(distance=10.0), told, 1e9, replace(ADVICE, lens_gain=gain, max_flatness=0.0)
        )
        assert any("exact intrinsics" in each for each in found) is said
    # As near as a quarter of the content's size is not near.
    for extent, near in ((40.0, False), (40.1, True)):
        found = advice._about_position(
            seen(distance=10.0), told, extent, replace(ADVICE, near_share=0.25, max_flatness=0.0)
        )
        assert any("step back" in each for each in found) is near
    some = seen(distance=10.0)
    flat = advice._flatness(some)
    for bound, is_flat in ((flat, False), (1.001 * flat, True)):
        found = advice._about_position(some, told, 0.0, replace(ADVICE, max_flatness=bound))
        assert any("one plane" in each for each in found) is is_flat
    assert advice._about_view(seen(columns(50) | columns(25, at_left=False)), ADVICE) == []
    points = np.full((4, 2), 0.5)
    assert advice._only_side(points, ADVICE) == "right"


# ------------------------------------------------------------------ the search's decisions


def test_of_equal_counts_the_first_pose_is_kept(monkeypatch) -> None:
    def found_by(single: Sequence[int], pooled: int) -> tuple[Any, list[Any]]:
        poses: list[Any] = []

        def solve(found, query, max_error_px, max_trials):
            pool = len(found.photo_px) > 100
            inliers = pooled if pool else single[len(poses)]
            poses.append(agreed(inliers, len(found.photo_px), at(float(len(poses)))))
            return poses[-1]

        monkeypatch.setattr(match_stages, "correspondences", lambda *_: matches(100))
        monkeypatch.setattr(match_stages, "solve_matches", solve)
        view = SimpleNamespace(camera=Camera(LENS, HERE))
        images: Any = SimpleNamespace(query=SimpleNamespace(intrinsics=LENS), matcher=None)
        found = drained(match_stages.match_candidates(None, [view] * len(single), images, 4.0))[1]  # type: ignore[arg-type,list-item]
        return found, poses

    found, poses = found_by([30, 30], 30)
    assert found.pose is poses[0].pose
    found, poses = found_by([30, 31], 32)
    assert found.pose is poses[2].pose


def test_a_verdict_of_the_same_rank_replaces_none(monkeypatch) -> None:
    searching = state()
    first, second = (SimpleNamespace(num_inliers=n, pose=HERE, correction=None) for n in (1, 2))
    monkeypatch.setattr(search_state, "only_colours_doubt", lambda *_: False)
    monkeypatch.setattr(SearchState, "verify", lambda self, refined, *_, **__: told_verdict())

    def outcome(refined: Any) -> Iterator[Any]:
        yield from ()
        return SimpleNamespace(recognised=False, unmatched=None, refined=refined)

    for again in (None, (SimpleNamespace(num_inliers=9, pose=HERE, correction=None), told_verdict())):
        searching.best = None

        def other_light(*_: Any, again: Any = again) -> Iterator[Any]:
            yield from ()
            return again

        monkeypatch.setattr(search_state, "_may_be_in_other_light", lambda *_: True)
        monkeypatch.setattr(search_state, "refined_in_other_light", other_light)
        for refined in (first, second):
            list(search_state.run_stage(searching, Stage(outcome(refined), ImageVariant(416))))  # type: ignore[arg-type]
        assert searching.best is not None
        assert searching.best.refined is first


def test_a_rival_fits_as_well_only_if_it_is_less_dissimilar_and_has_enough_edges(monkeypatch) -> None:
    planted = dict.fromkeys(
        ("gradients", "gradients_half", "colours", "colours_half", "local_colour_correlation"), 0.75
    )
    monkeypatch.setattr(SearchState, "appearance_at", lambda self, rival: planted)
    searching = state()
    for least, limit, fits in ((0.75, 1.26, True), (0.75, 1.25, False), (0.7501, 9.0, False)):
        searching.config = replace(searching.config, min_rival_gradients=least)
        assert rivals._fits_as_well(searching, None, limit) is fits  # type: ignore[arg-type]


def mirrored(monkeypatch, counts: Sequence[int | None]) -> int | None:
    """Match the mirror image of a render with views of which so many matches agree; return which pose is refined."""
    poses = [count and agreed(count, 100, at(float(k))) for k, count in enumerate(counts)]
    left, refined = iter(poses), []

    def refine(best: Any, *_: Any) -> Iterator[Any]:
        refined.append(int(best.pose.position_in_world[0]))
        yield from ()
        return SimpleNamespace(refined="refined")

    monkeypatch.setattr(rivals, "correspondences", lambda *_: matches(100))
    monkeypatch.setattr(rivals, "estimate_absolute_pose", lambda *_: next(left))
    monkeypatch.setattr(rivals, "rematch_and_refine", refine)
    render = SimpleNamespace(frame=SimpleNamespace(rgb=np.zeros((4, 4, 3), np.float32)), camera=Camera(LENS, HERE))
    matcher = SimpleNamespace(extract=lambda *_: SimpleNamespace(descriptors=None))
    prepared = SimpleNamespace(views=[None] * len(counts), scores=lambda _: np.linspace(1, 0, len(counts)))
    searching: Any = SimpleNamespace(
        images=SimpleNamespace(corrected=lambda _: SimpleNamespace(query=None, matcher=matcher)),
        config=replace(state().config, min_mirror_inliers=20, rival_views=len(counts)),
        renderer=SimpleNamespace(at=lambda *_: render),
        tools=SimpleNamespace(prepared=prepared),
        with_answer=lambda record: record,
    )
    other: Any = SimpleNamespace(images=None, renderer=None)
    answer: Any = SimpleNamespace(refined=SimpleNamespace(pose=HERE, correction=None))
    found = drained(rivals._refined_mirror_image(searching, other, answer))[1]
    assert (found == "refined") is bool(refined)
    return refined[0] if refined else None


def test_a_mirror_image_is_refined_from_the_first_of_the_views_with_most_matches(monkeypatch) -> None:
    assert mirrored(monkeypatch, [20]) == 0
    assert mirrored(monkeypatch, [19]) is None
    assert mirrored(monkeypatch, [None, 25, 30, 30]) == 2
    assert mirrored(monkeypatch, [30, None, 25]) == 0
    assert mirrored(monkeypatch, [None, None]) is None


def test_an_answer_that_fits_as_well_in_another_light_stays(monkeypatch) -> None:
    """Only a higher rank replaces it."""
    for place, taken in ((0.9, False), (0.95, True)):
        searching = state()
        uncertain = replace(told_verdict(reason="position_uncertain"), right_place=0.9)
        monkeypatch.setattr(SearchState, "verify", lambda self, *_, given=uncertain, **__: given)
        answer = VerifiedPose(SimpleNamespace(pose=HERE, correction=None), uncertain, ImageVariant(416))  # type: ignore[arg-type]
        monkeypatch.setattr(VerifiedPose, "record", lambda self, stage: stage)
        again = (SimpleNamespace(pose=at(1.0), correction=None), replace(uncertain, right_place=place, score=place))

        def other_light(*_: Any, again: Any = again, **__: Any) -> Iterator[Any]:
            yield "a record"
            return again

        monkeypatch.setattr(rivals, "refined_in_other_light", other_light)
        records, _ = drained(rivals._accept(searching, answer))
        assert records == ["a record", "check_rivals"]
        assert searching.best is not None
        assert (searching.best.refined is again[0]) is taken


def test_a_mirror_image_needs_the_matches_of_any_answer(monkeypatch) -> None:
    searching = state()
    searching.retrieval = SimpleNamespace(  # type: ignore[assignment]
        index=SimpleNamespace(views=[]), scores=lambda _: np.zeros(0), features=lambda _: None
    )
    least = searching.config.matching.min_inliers

    def candidates(count: int | None) -> Any:
        def match(*_: Any) -> Iterator[Any]:
            yield from ()
            return count and agreed(count)

        return match

    def refine(*given: Any) -> Iterator[Any]:
        yield from ()
        return SimpleNamespace(refined="refined")

    monkeypatch.setattr(ambiguity_check, "refine_stage", refine)
    searching.images = SimpleNamespace()  # type: ignore[assignment]
    for count, found in ((None, None), (least - 1, None), (least, "refined")):
        monkeypatch.setattr(ambiguity_check, "match_candidates", candidates(count))
        assert drained(ambiguity_check._search_mirrored(searching, ImageVariant(416), 1.0))[1] == found


# ------------------------------------------------------------------ matches, lenses and readings


def test_poses_as_far_apart_as_the_bound_are_one_answer() -> None:
    """Two hundredths of a distance of 50 are 1."""
    assert not PoseAtDistance(HERE, 50.0).differs_from(at(1.0), replace(AMBIGUITY, distinct_share=0.02))
    assert PoseAtDistance(HERE, 49.9).differs_from(at(1.0), replace(AMBIGUITY, distinct_share=0.02))
    view: Any = SimpleNamespace(camera=Camera(LENS, HERE), points_in_world=np.array([[0, 0, 2.0]] * 9))
    for way, same in ((0.5, False), (0.499, True)):
        assert _shows_the_same(view, at(way), replace(AMBIGUITY, same_view_share=0.25)) is same
    # A match at the largest error that counts as explained.
    found = matches(2)
    found.photo_px[:] = [[208.0, 156.0], [208.0, 160.0]]
    assert len(_unexplained(found, LENS, HERE, 4.0).photo_px) == 0
    assert len(_unexplained(found, LENS, HERE, 3.9).photo_px) == 1


def test_a_reading_at_its_quantile_contradicts_nothing() -> None:
    one = PriorResidual("up", np.array([2.0]), np.zeros((1, 6)), np.eye(1))
    for bound, against in ((4.0, False), (3.99, True)):
        assert one.contradicts(None, replace(DEVICE_PRIORS, chi_square=(bound, 1.0, 1.0))) is against


def test_a_difference_at_the_bound_decides_between_two_poses(monkeypatch) -> None:
    planted = {0.0: 1.0, 1.0: 3.0}
    monkeypatch.setattr(
        device_priors,
        "residuals",
        lambda priors, pose, config: [
            PriorResidual("up", np.array([planted[pose.position_in_world[0]]]), np.zeros((1, 6)), np.eye(1))
        ],
    )
    for preferred, decides in ((8.0, True), (8.01, False)):
        assert prefers(ScenePriors(), HERE, None, at(1.0), None, replace(DEVICE_PRIORS, preferred=preferred)) is decides


def test_a_camera_as_level_as_the_bound_has_a_heading() -> None:
    lying = Pose(np.array([[1, 0, 0, 0], [0, 0.8, 0.6, 0], [0, -0.6, 0.8, 0], [0, 0, 0, 1.0]]))
    assert lying.axis_in_world.tolist() == [0.0, 0.6, 0.8]
    east, north = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    priors = ScenePriors(heading=HeadingPrior(east, north, 1.0, 0.1))
    for least, has in ((0.6, True), (0.6001, False)):
        config = replace(DEVICE_PRIORS, least_level=least)
        assert bool(device_priors.residuals(priors, lying, config)) is has
        told = agreement(priors, lying.world_from_camera[None], np.ones(1), config)
        assert bool(told[0] < 1) is has
    # A camera turned by gravity.
    up = UpPrior(np.array([0.25, 0.0, -np.sqrt(1 - 0.0625)]), np.array([0.0, 0.0, 1.0]), 0.1)
    found = retrieval()
    found.images.query = SimpleNamespace(scene_priors=ScenePriors(up=up))  # type: ignore[assignment]
    for least, steps in ((0.25, 2), (0.2501, None)):
        assert with_config(found, least_level=least).roll_by_gravity() == steps


def test_lens_models_at_their_bounds() -> None:
    def fit(cost: float, inliers: int = 40) -> Any:
        return SimpleNamespace(cost=cost, inlier=np.arange(100) < inliers, leaves_misfit=lambda config: True)

    significant = FISHEYE.significant_drop
    assert not LensModels(fit(100.0 + significant), fit(100.0)).is_surely_fisheye()
    assert LensModels(fit(100.0, FISHEYE.min_inliers), fit(200.0)).is_unmodelled()
    bounds = replace(FISHEYE, misfit_drop=1.0, misfit_px=1.0)
    whole = fisheye.LensModelFit(fisheye.SIMPLE_RADIAL, HERE, IntrinsicsCorrection(), 0.0, np.ones(3, bool), 1.0, 2.0)
    assert not whole.leaves_misfit(bounds)
    assert not replace(whole, misfit_drop=2.0, misfit_px=1.0).leaves_misfit(bounds)
    assert replace(whole, misfit_drop=2.0).leaves_misfit(bounds)


def test_half_of_a_border_that_is_just_white_makes_the_background_white() -> None:
    photo = np.zeros((100, 100, 3), np.uint8)
    photo[:, :50] = UNKNOWN_BACKGROUND.white_from
    assert has_white_border(photo)
    assert not has_white_border(photo - (photo > 0).astype(np.uint8))
    photo[0, 49] = 0
    assert not has_white_border(photo)
    for alpha, share, shown in ((0.49, 1, True), (0.5, 1, False), (0.49, 2, True)):
        image = np.ones((20, 20), np.float32)
        image[:share] = alpha
        rasterizer: Any = SimpleNamespace(render=lambda cameras, approximate, i=image: [SimpleNamespace(alpha=i)])
        assert shows_background(rasterizer, [Camera(LENS, HERE)]) is shown


@pytest.mark.parametrize(("pixels", "settled_px", "steps"), [(50, 0.5, 5), (50, 0.5001, 1), (49, 0.5, 0)])
def test_refinement_goes_on_from_its_least_pixels_until_a_step_is_smaller_than_the_bound(
    monkeypatch, pixels, settled_px, steps
) -> None:
    taken: list[int] = []
    monkeypatch.setattr(gauss_newton, "_motion_px", lambda *_: 0.5)
    monkeypatch.setattr(gauss_newton, "_step", lambda *_: taken.append(1) or np.zeros(14))
    level: Any = SimpleNamespace(
        pixels=range(pixels), points=np.ones((3, pixels)), residuals=lambda *_: (None, None, 0.25), jacobian=None,
        photo_intrinsics=None,
    )  # fmt: skip
    start: Any = SimpleNamespace(photo_from_render=np.eye(4), photometric=np.zeros(4), prior=None)
    config = replace(RefinementConfig(), min_pixels=50, max_steps=5)
    loss = gauss_newton.minimize(level, start, settled_px, config)
    assert len(taken) == steps
    assert loss == (0.25 if steps else np.inf)


def test_a_rematch_that_moves_as_far_as_the_bound_has_not_settled(monkeypatch) -> None:
    config = replace(match_stages.MATCHING, settled_share=0.6, conclusive_share=1.0)
    monkeypatch.setattr(match_stages.render_and_rematch, "__defaults__", (config,))
    # Six tenths of 2.5, the distance from there to the points 2 ahead.
    assert rematched(monkeypatch, [(30, 0.0, 1.5), (30, 0.0, 0.0)])[0] == 2
    assert rematched(monkeypatch, [(30, 0.0, 1.499)])[0] == 1


# ------------------------------------------------------------------ views


def with_config(found: Retrieval, **changed: Any) -> Retrieval:
    return replace(found, config=replace(found.config, **changed))


def test_a_photo_at_the_bound_of_the_same_scale_is_resized_and_a_rotation_must_score_more() -> None:
    found = retrieval(focal=800.0)
    for bound, size in ((2.0, 640), (2.01, 416)):
        assert with_config(found, same_scale=bound).upright_variant() == ImageVariant(size)
    assert with_config(retrieval(focal=200.0), same_scale=2.0).upright_variant() == ImageVariant(208)
    for score, rolls in ((1.0, 0), (1.01, 2)):
        turned = with_config(retrieval(**{"_416_0": 1.0, "_416_2": score}), rotation_bias=1.0)
        turned._suggested.append(2)
        turned.images.query = SimpleNamespace(scene_priors=None)  # type: ignore[assignment]
        assert turned.rotated_variant(ImageVariant(416)) == ImageVariant(416, rolls)


def test_what_is_at_the_bound_of_a_single_surface_is_none() -> None:
    ones = np.ones((2, 2), np.float32)
    for depth, single in ((1.5, False), (1.499, True)):
        each = Frame(np.zeros((2, 2, 3), np.float32), ones, depth * ones, ones)
        assert shows_single_surface(each, 0.5, replace(PLACEMENT, max_depth_spread=0.5)).all() == single
    lens = Intrinsics(8, 8, 8.0, 8.0, 4.0, 4.0)
    for spread, kept in ((1.5, 0), (1.49, 1)):
        depth = np.ones((8, 8), np.float32)
        depth[3, 3] = spread
        one = Features(np.array([[4.5, 4.5]], np.float32), np.ones(1, np.float32), np.ones((1, 2), np.float32))
        each = Frame(np.zeros((8, 8, 3), np.float32), np.ones((8, 8), np.float32), depth, depth)
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(
                "service.pose.features.rendered_views.VIEWS", SimpleNamespace(max_depth_range=0.5, min_alpha=0.5)
            )
            assert len(backprojected(one, each, Camera(lens, HERE)).points_in_world) == kept
            faint = replace(each, alpha=np.full((8, 8), 0.5, np.float32), median_depth=np.ones((8, 8), np.float32))
            assert len(backprojected(one, faint, Camera(lens, HERE)).points_in_world) == 0


def test_a_scene_is_an_interior_from_the_bounds_on() -> None:
    views: Any = view_placement._Views.__new__(view_placement._Views)
    views._config = replace(
        PLACEMENT, room_enclosure=0.75, interior_enclosure=0.875, enclosure_quantile=1.0, relative_enclosure=0.5
    )
    assert views._least_enclosure(np.array([0.625, 0.75, 0.875])) == 0.4375
    assert views._least_enclosure(np.array([0.625, 0.74, 0.875])) == 0.0
    assert views._least_enclosure(np.array([0.75, 0.8, 0.874])) == 0.0
    # Half enclosed is not within.
    assert views._least_enclosure(np.array([0.5, 0.5, 0.5, 0.75, 0.875])) == 0.4375
    assert views._least_enclosure(np.array([0.5, 0.5])) == 0.0


def test_good_views_have_the_least_score_and_the_least_enclosure() -> None:
    views: Any = view_placement._Views.__new__(view_placement._Views)
    views._config = replace(
        PLACEMENT, score_quantile=1.0, min_score_share=0.5, room_enclosure=0.5, interior_enclosure=0.5,
        enclosure_quantile=1.0, relative_enclosure=0.5,
    )  # fmt: skip
    views.scores, views._enclosures = [0.8, 0.4, 0.39, 0.0, 0.8], [1.0, 1.0, 1.0, 1.0, 0.5]
    assert views.good().tolist() == [0, 1, 4]
    assert views.interior
    views._enclosures[4] = 0.49
    assert views.good().tolist() == [0, 1]
    views.scores, views._enclosures = [0.0, 0.0], [0.0, 0.0]
    assert views.good().tolist() == []
    assert not views.interior


def test_views_are_as_far_apart_as_the_spacing() -> None:
    places = np.array([[0.0], [1.0], [2.0]])
    # From the middle, both others are exactly one spacing away: none is nearer than that.
    assert len(viewpoints.farthest_points(places, 1, 9, 1.0)) == 3
    assert len(viewpoints.farthest_points(places, 1, 9, 1.01)) == 1
    assert len(viewpoints.farthest_points(places, 2, 9, 1.01)) == 2
    config = replace(viewpoints.VIEWPOINTS, max_views=10, placement=replace(PLACEMENT, max_views=4))
    assert [config.cuts(*each) for each in ((10, 11), (9, 11), (10, 10), (4, 0), (3, 0))] == [
        True, False, False, True, False,
    ]  # fmt: skip


def test_free_views_are_solid_from_the_bound_on_and_chosen_until_enough_is_shown() -> None:
    depth = np.full((8, 16), 2.0, np.float32)
    alpha = np.ones((8, 16), np.float32)
    alpha[:, 8:] = 0.0
    each = Frame(np.zeros((8, 16, 3), np.float32), alpha, depth, depth)
    camera = Camera(Intrinsics(16, 8, 16.0, 16.0, 8.0, 4.0), HERE)
    for least, solid in ((0.5, True), (0.51, False)):
        config = replace(free_views.FREE_VIEWS, min_solid_share=least)
        assert (free_views._cells_seen(each, camera, 0.1, config) is not None) is solid
    cells = [np.array([1, 2, 3]), np.array([4]), np.array([5, 6])]
    for share, chosen in ((0.5, [0]), (0.51, [0, 2]), (5 / 6 + 1e-3, [0, 2, 1])):
        config = replace(free_views.FREE_VIEWS, covered_share=share)
        assert free_views._choice(cells, np.zeros(0, np.int64), 9, config) == chosen
    assert free_views._choice(cells, np.zeros(0, np.int64), 1, replace(config, covered_share=1.0)) == [0]
    # What another one has shown meanwhile counts no more; of equals the first.
    overlapping = [np.array([1, 2, 3, 4]), np.array([3, 4, 5]), np.array([7, 8])]
    assert free_views._choice(overlapping, np.zeros(0, np.int64), 9, replace(config, covered_share=1.0)) == [0, 2, 1]


def test_on_a_plane_is_not_before_it_and_cosines_at_the_bounds_are_neither_parallel_nor_perpendicular() -> None:
    plane = np.array([[0.0, 0.0, 1.0, -1.0]])
    assert before_planes(np.array([[0, 0, 1.0], [0, 0, 1.1], [0, 0, 0.9]]), plane).tolist() == [False, True, False]
    street = np.array([[0.0, 0, 1, 0], [0, 1.0, 0, 0], [0, -1.0, 0, 0]])
    assert ground_normal(street) is not None
    assert ground_normal(street, replace(PLANES, parallel=1.0)) is None
    assert ground_normal(street, replace(PLANES, perpendicular=0.0)) is None


def test_outer_planes_are_looked_for_among_as_many_points_as_the_least(monkeypatch) -> None:
    grid = np.stack([*map(np.ravel, np.meshgrid(np.arange(4.0), np.arange(4.0))), np.zeros(16)], 1)
    asked: list[int] = []

    def largest(points: np.ndarray, *_: Any) -> np.ndarray:
        asked.append(len(points))
        return np.array([0.0, 0.0, 1.0, 0.0])

    monkeypatch.setattr(outer_planes, "_largest_plane", largest)
    above = grid + np.array([0, 0, 1.0])
    config = replace(PLANES, min_share=0.5, max_beyond=0.0)
    # Half of the points are in the plane, which is enough; the others lie exactly `near` away, so they aren't near.
    found = outer_planes._outer_planes(np.concatenate([grid, above]), 1.0, 0.5, config)
    assert asked[0] == 32
    assert len(found) == 0  # half of all lie before it, which is not more than the share
    found = outer_planes._outer_planes(np.concatenate([grid, above]), 1.0, 0.5, replace(config, min_share=0.49))
    assert found.tolist() == [[0.0, 0.0, 1.0, 0.0]]


def test_a_twin_needs_the_least_share_and_differs_from_the_bound_on() -> None:
    lens = Intrinsics(100, 100, 100.0, 100.0, 50.0, 50.0)
    points = np.zeros((10, 3), np.float32)
    points[:3, 2] = 2.0
    points[3:, 2] = -2.0
    motion = moved(HERE, np.array([0, 0, 0, 1.0, 0, 0])).world_from_camera
    repeated = Repetitions(motion[None], points[None])
    for least, distance, count in ((0.3, 9.0, 1), (0.31, 9.0, 0), (0.3, 10.0, 1), (0.3, 10.01, 0)):
        config = replace(SYMMETRY, min_seen_share=least, same_twin_share=0.1)
        assert len(repeated.twins(Camera(lens, HERE), distance, config)) == count
    several = [moved(HERE, np.array([0, 0, 0, float(k), 0, 0])).world_from_camera for k in range(1, 8)]
    many = Repetitions(np.stack(several), np.stack([points] * 7))
    assert len(many.twins(Camera(lens, HERE), 1.0, SYMMETRY)) == SYMMETRY.max_twins == 4
    # At the image's edge nothing is in it.
    edge = np.array([[-1.0, 0, 2.0], [1.0, 0, 2.0], [0, -1.0, 2.0], [0, 1.0, 2.0], [0, 0, 2.0]], np.float32)
    assert scene_symmetries._share_in_image(edge, Camera(lens, HERE)) == pytest.approx(0.2)


def test_a_scene_of_the_most_views_is_examined_as_smaller_ones_are() -> None:
    config = replace(SYMMETRY, max_views=40, every=4, max_turned=5)
    assert [n for n in range(41) if is_examined(n, 40, config)] == list(range(0, 41, 4))
    assert [n for n in range(41) if is_examined(n, 41, config)] == list(range(0, 41, 9))
    # Of 40, every eighth: four times two, for five.
    assert [n for n in range(0, 40, 4) if scene_symmetries._is_turned(n, 40, config)] == list(range(0, 40, 8))
    assert scene_symmetries._is_turned(9, 41, config)


def test_a_residual_at_the_bound_is_alike_and_sixty_matches_make_a_mirror_image(monkeypatch) -> None:
    images: Any = SimpleNamespace(query=SimpleNamespace(intrinsics=LENS), resized=lambda _: None)
    rasterizer: Any = SimpleNamespace(render=lambda _: [None])
    for loss, alike in ((SYMMETRY.max_residual, True), (1.001 * SYMMETRY.max_residual, False)):
        monkeypatch.setattr(
            scene_symmetries, "refine_photometric", lambda *_, loss=loss: SimpleNamespace(pose=HERE, loss=loss)
        )
        assert (scene_symmetries._if_alike(images, HERE, rasterizer, SYMMETRY) is HERE) is alike
    pool: Any = SimpleNamespace(map=map)
    views: Any = [SimpleNamespace(camera=None)] * 4
    everywhere: Any = SimpleNamespace(render=lambda cameras: [None] * len(cameras))
    for count, like in ((60, True), (59, False)):
        monkeypatch.setattr(scene_symmetries, "_mirrored_inliers", lambda *_, count=count: count)
        assert scene_symmetries.like_its_mirror_image(views, None, everywhere, None, pool) is like  # type: ignore[arg-type]


def test_an_index_of_the_least_number_of_views_is_built_in_parts_that_double(monkeypatch) -> None:
    monkeypatch.setattr(
        index_builder, "WholeIndex", lambda count, grown: SimpleNamespace(publish=lambda part: (count, grown, part))
    )
    for count, published in ((7, None), (8, [4]), (9, [4, 8]), (16, [4, 8]), (17, [4, 8, 16])):
        builder: Any = IndexBuilder.__new__(IndexBuilder)
        builder._cameras, builder._part, builder.whole = [None] * count, lambda views: views, lambda: "whole"
        found = builder.first_part(lambda whole: f"finished {whole}", PartsConfig(first_views=2, min_views=8))
        if published is None:
            assert found == "finished whole"
            continue
        whole, grown, first = found
        parts: list[int] = []
        assert (whole, first, grown(parts.append)) == (count, 2, "finished whole")
        assert parts == published


def test_a_proxy_stands_for_more_gaussians_than_it_may_have() -> None:
    scene: Any = SimpleNamespace(count=5, scales=np.ones((5, 3), np.float32), opacities=np.ones(5, np.float32))
    rasterizer: Any = SimpleNamespace(name="whole")
    rng = np.random.default_rng(0)
    assert lod_proxy(scene, rasterizer, rng, replace(LOD, proxy_gaussians=5)) is rasterizer
    assert OccludedRenderer(scene, rasterizer, rng, replace(LOD, min_gaussians=5))._proxy is None
    ones = np.ones((4, 4), np.float32)
    for alpha, hides in ((0.75, False), (0.76, True)):
        each = Frame(np.zeros((4, 4, 3), np.float32), alpha * ones, 2 * ones, 2 * ones)
        assert np.isfinite(occlusion_depths(each, replace(LOD, opaque_alpha=0.75))).all() == hides


# ------------------------------------------------------------------ a live camera's odometry


def test_odometry_at_its_bounds_has_not_begun_anew() -> None:
    fusion = Fusion(OdometryFacts(), INFO)
    turned = 0.5
    config = replace(FUSION, most_turn_deg_s=float(np.degrees(turned)), least_jump_deg=1.0, most_speed=2.0)
    fusion._config = config
    assert not fusion._is_jump(3.0, 0.0, 0.0)
    assert not fusion._is_jump(1.0, 0.0, 2.0)
    assert not fusion._is_jump(1.0, turned, 0.0)
    assert fusion._is_jump(1.0, 1.001 * turned, 2.0)
    assert not fusion._is_jump(0.01, 0.0, FUSION.least_jump)
    fusion._config = replace(config, least_jump_deg=float(np.degrees(turned)), most_turn_deg_s=1.0)
    assert not fusion._is_jump(0.1, turned, 0.0)
    # Jitter of the times: no less than a sixtieth of a second counts.
    fusion._config = replace(config, most_speed=30.0)
    assert not fusion._is_jump(1e-6, 0.0, 0.5)
    assert fusion._is_jump(1e-6, 0.0, 0.501)


def test_fixes_that_differ_by_the_bounds_break_nothing() -> None:
    fusion = Fusion(OdometryFacts(), INFO)
    fusion.move(0.0, HERE)
    fusion.fix(0.0, HERE, EXACT, 4.0)
    assert fusion._scale is not None
    fusion._scale.sigma = 1e-9
    for jump, breaks in ((0.25, False), (0.249, True)):
        fusion._config = replace(FUSION, break_jump=jump)
        assert fusion._breaks(*step_fixes(0.25, 0.0, 1e-6)) is breaks


def test_four_fixes_within_the_time_may_tell_of_a_break(monkeypatch) -> None:
    for times, broken in (((0.0, 0.25, 0.5, 1.0), True), ((0.0, 0.25, 0.5, 1.001), False), ((0.0, 0.25, 0.5), False)):
        fusion = Fusion(OdometryFacts(), INFO)
        fusion._last.extend(replace(fixed(HERE), time_s=time_s) for time_s in times)
        monkeypatch.setattr(Fusion, "_breaks", lambda self, a, b: a.time_s == 0.25)
        assert fusion._has_broken() is broken


def test_a_window_loses_what_is_as_far_or_as_old_as_the_bounds() -> None:
    fusion = Fusion(OdometryFacts(), INFO)
    fusion._fixes = [replace(fixed(at(x)), way=way, time_s=0.0) for x, way in ((50.0, 0.0), (60.0, 1.0), (70.0, 9.0))]
    assert fusion._keep(replace(fixed(HERE), way=10.0, time_s=1.0))
    assert [fix.way for fix in fusion._fixes] == [1.0, 9.0, 10.0]
    # The viewpoint's older fix is out of date after exactly three seconds.
    for age, kept in ((3.0, 1), (2.99, 2)):
        fusion._fixes = [replace(fixed(HERE), time_s=0.0)]
        assert not fusion._keep(replace(fixed(HERE), time_s=age))
        assert len(fusion._fixes) == kept
    near = replace(fixed(at(1.0)), depth=4.0)
    for share, is_near in ((0.25, False), (0.251, True)):
        fusion._config = replace(FUSION, cell_way=share)
        assert fusion._is_near(near, [fixed(HERE)]) is is_near


def test_an_estimate_at_the_bounds_is_carried_and_predicts_a_way() -> None:
    fusion: Any = Fusion(OdometryFacts(), INFO)
    fusion._fitted = SimpleNamespace(depth=4.0)
    spread = np.diag([0.25] * 3 + [1.0] * 3 + [9.0])
    fusion._carried = lambda late: (HERE, spread)
    for deg, share, known in (
        (float(np.degrees(0.5)), 0.25, True), (28.0, 0.25, False), (float(np.degrees(0.5)), 0.249, False),
    ):  # fmt: skip
        fusion._config = replace(FUSION, most_turn_deg=deg, most_share=share)
        assert (fusion.carried() is not None) is known
    moving = Fusion(OdometryFacts(), INFO)
    for time_s in (0.0, 0.1):
        moving.move(time_s, at(time_s))
    moving._scale = SimpleNamespace(log_scale=0.0, sigma=0.2)  # type: ignore[assignment]
    for unsure, x in ((0.2, 1.1), (0.199, 7.0)):
        moving._config = replace(FUSION, unsure=unsure)
        assert moving.predicted(0.0, at(1.0), 0.1, at(7.0)).position_in_world[0] == pytest.approx(x)


def test_samples_as_old_as_the_memory_are_kept_and_frames_of_one_time_are_one() -> None:
    fusion = Fusion(OdometryFacts(), INFO)
    for time_s in (0.0, 3.0, 3.0, 6.0):
        fusion.move(time_s, HERE)
    assert [sample.time_s for sample in fusion._samples] == [0.0, 3.0, 6.0]


@pytest.mark.parametrize("near", [None, 0, 1, 2])
def test_no_distance_of_a_minimal_pose_is_zero(near: int | None) -> None:
    """Distances that are exact already: nothing is changed, and the triangle's corners lie in front of the camera."""
    distances = np.array([1.0, 1.5, 2.0])
    if near is not None:
        distances[near] = 0.0
    cosines = np.array([0.5, 0.25, 0.125])
    pairs = ((0, 1), (0, 2), (1, 2))
    squares = [
        distances[i] ** 2 + distances[j] ** 2 - 2 * c * distances[i] * distances[j]
        for (i, j), c in zip(pairs, cosines, strict=True)
    ]
    polished = distances.copy()
    assert bool(polish_distances.py_func(polished, cosines, np.array(squares))) is (near is None)
    assert np.array_equal(polished, distances)
