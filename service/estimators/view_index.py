"""The default estimator: retrieve views like the photo from an index, match, solve PnP, refine. Needs no prior.

    photo's features -> retrieval scores of rendered views -> matches with the best of them -> scene points -> PnP
    -> while few agree, or the gate refuses what few led to: render there, match again, solve decoupled
    -> refine photometrically on a small render, then on larger ones
    -> verification gate -> do readings of the device contradict? -> did another lens take the photo, or a camera that
       turned?
    -> where the scene has a digest of its training photos: a more exact pose by their patches
    -> is the photo mirrored? Do many matches agree on another pose that is as good?

At first a small copy of the photo is compared, rotated as its corners suggest if no view is much like it. Only if the
gate refuses the answer costlier stages follow: the photo in its full size; larger still, with further views; views
beside the index (`free_views`); then poses sampled near views. From a prior pose refinement is tried first; where that
fails, a render at the prior pose is the first candidate view of the first search, if that is of the upright photo.
`SearchConfig` says where sizes and thresholds come from.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from service.errors import InvalidOptions
from service.estimators.ambiguity_check import check_ambiguity, check_mirror
from service.estimators.lens_check import check_lens
from service.estimators.patch_stage import refine_by_patches
from service.estimators.rivals import check_rivals
from service.estimators.search_config import SEARCH, SearchConfig
from service.estimators.search_state import (
    SearchState,
    Stage,
    StageOutcome,
    StageResult,
    VerifiedPose,
    changed,
    run_stage,
)
from service.estimators.shutter_check import check_shutter
from service.interfaces import Answer, Tools
from service.pose.absolute_pose.device_priors import contradicts
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.descent.hypotheses import poses_near_views
from service.pose.features.image_sizes import PHOTO_PX, sized
from service.pose.features.rendered_views import View, views_from
from service.pose.matching.correspondences import MATCH_ERROR_PX
from service.pose.matching.match_stages import match_candidates, record_of, render_and_rematch, solve_matches
from service.pose.matching.render_and_match import render_and_match
from service.pose.refinement.refine_stage import refine_stage, rematch_and_refine
from service.pose.retrieval.image_variant import ImageVariant, Retrieval
from service.pose.retrieval.index import ViewIndex, WholeIndex
from service.pose.retrieval.scores import top_indices
from service.pose.retrieval.stored_index import prepared_index
from service.results import Candidates, IterationRecord, Status
from service.types import Camera, Query


@dataclass(frozen=True, slots=True)
class Options:
    candidates: int = 5
    """Index views that the photo in its full size is matched with, 1 to 64; then, larger, with as many others or a
    sixteenth of all (64 at most), whichever is more. The small copy before is matched with two, at most."""
    effort: Literal["fast", "normal", "exhaustive"] = "normal"
    """How hard to search for a photo that the verification gate doesn't accept. `fast`: in the index, and
    with the photo turned. `normal`: then among views beside the index, and among sampled poses if something in the
    photo was recognised. `exhaustive`: among sampled poses until the budget ends."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "use_attribute_docstrings": True}

    def __post_init__(self) -> None:
        if not 1 <= self.candidates <= 64:
            raise InvalidOptions(f"must lie in 1..64, is {self.candidates}.", where="candidates")
        if self.effort not in ("fast", "normal", "exhaustive"):
            raise InvalidOptions(f"must be fast, normal or exhaustive, is '{self.effort}'.", where="effort")


def prepare(tools: Tools[None], cache_dir: Path | None) -> ViewIndex:
    """Make the scene's view index, or read it from the cache: once, in 1 to 4 CPU seconds; or its first part."""
    return prepared_index(tools, cache_dir)


def run(
    query: Query, tools: Tools[ViewIndex], options: Options, config: SearchConfig = SEARCH
) -> Generator[IterationRecord, None, Answer | None]:
    """Search until the gate accepts an answer, then look for reasons to doubt it; see the module.

    Yields a record for each hypothesis and check; returns the best answer with its verdict, accepted or not, or None
    where no stage led to a pose. An answer that refinement from a prior pose leads to is compared neither with other
    lenses nor with its mirror image and rivals, and with other hypotheses only without a prior region.
    """
    state = SearchState.of(query, tools, config)
    if query.prior:
        yield from run_stage(state, _refine_from_prior(state))
        if state.finished:
            state = yield from check_shutter(state)
            yield from _check_readings(state, options)
            yield from refine_by_patches(state)
            if query.region is None:  # a prior pose doesn't decide between places that look alike
                yield from check_ambiguity(state)
            return state.answer()
    yield from _search(state, options)
    whole = state.tools.prepared.whole
    if not state.finished and whole:
        yield from _await_index(state, whole)
        yield from _search(state, options)
    yield from _check_readings(state, options)
    state = yield from check_lens(state)
    state = yield from check_shutter(state)
    yield from refine_by_patches(state)
    yield from changed(_doubts(state), state.with_answer)
    return state.answer()


def _search(state: SearchState, options: Options) -> Generator[IterationRecord, None, None]:
    """Run the stages of the search until one ends it."""
    # A generator: a later stage is prepared only if the earlier ones failed.
    for stage in _search_stages(state, options):
        yield from run_stage(state, stage)
        if not state.finished and state.unmatched is not None:
            yield from run_stage(state, replace(stage, records=_rematch(state.unmatched, state)))
        if state.finished:
            break


def _await_index(state: SearchState, whole: WholeIndex) -> Generator[IterationRecord, None, None]:
    """Wait until the index has all of its views, and search among these from then on."""
    first = state.tools.prepared.views[0].camera.pose
    # A record each time: between two a job may be cancelled, or its budget end.
    while (index := whole.result(state.config.index_wait_s)) is None:
        yield state.with_answer(IterationRecord("await_index", first))
    yield state.with_answer(IterationRecord("await_index", first))
    state.search_in(index)


def _check_readings(state: SearchState, options: Options) -> Generator[IterationRecord, None, None]:
    """Where the answer contradicts what the device measured, search among the views that agree with it, with the photo
    turned as gravity says. An answer that the gate accepts there replaces it if the readings decide for that one."""
    answer, retrieval = state.best, state.retrieval
    priors = state.images.query.scene_priors
    if answer is None or not contradicts(priors, answer.refined.pose, answer.verdict.covariance):
        return
    steps = retrieval.roll_by_gravity()
    variant = answer.variant if steps is None else replace(answer.variant, roll_steps_45deg=steps)
    views = retrieval.ranked(variant, options.candidates, only_agreeing=True)
    if not len(views):
        return
    search = _search_views("retrieve_by_readings", variant, deque(views), state)
    found = (yield from changed(search, state.with_answer)).refined
    if found is None:
        return
    other = VerifiedPose(found, state.verify(found), variant)
    if other.verdict.status is Status.LOCALIZED and (not state.finished or state.readings_prefer(other, answer)):
        state.best, state.finished = other, True
    yield (state.best or answer).record("check_readings")


def _doubts(state: SearchState) -> Generator[IterationRecord, None, None]:
    """Compare the answer of a search with the photo's mirror image, with its rivals, and with other hypotheses."""
    mirrored = yield from check_mirror(state)
    if not state.finished or mirrored:
        return
    is_unique = yield from check_rivals(state)
    if not is_unique:
        yield from check_ambiguity(state)


def _search_stages(state: SearchState, options: Options) -> Iterator[Stage]:
    """Yield the stages of the search, cheapest first; in a part of an index those that only compare its views."""
    config, retrieval = state.config, state.retrieval
    has_cameras = bool(state.tools.scene.cameras)
    # Views that the scene itself placed are as near as its detail requires, whatever their focal length.
    upright = retrieval.upright_variant() if has_cameras else ImageVariant(PHOTO_PX)
    small = upright.scaled(config.small_photo_factor)
    if not retrieval.is_upright(small):
        small = retrieval.rotated_variant(small, likeliest_only=True)
    views = retrieval.ranked(small, min(config.small_photo_views, options.candidates))
    rotated = small.roll_steps_45deg != 0
    name = "retrieve_rotated" if rotated else "retrieve"
    # A render at the prior pose shows the scene as the photo as it is does, not as the rotated one.
    yield Stage(_search_views(name, small, deque(views), state, try_prior_view=not rotated), small)
    # Anew: of a small copy the wrong rotation may have looked better.
    variant = retrieval.rotated_variant(upright)
    views = retrieval.ranked(variant, options.candidates)
    name = "retrieve_rotated" if variant.roll_steps_45deg else "retrieve_full_size"
    yield Stage(_search_views(name, variant, deque(views), state), variant)
    variant = variant.scaled(config.large_photo_factor)
    scores = retrieval.scores(variant)
    ranked = top_indices(scores, len(scores))[options.candidates :]
    further = min(len(scores) // config.further_views_divisor, config.max_further_views)
    untried = deque(ranked[: max(options.candidates, further)])
    # A stage ends early where matches or refinement fail; the next goes on with the other views.
    while untried:
        yield Stage(_search_views("retrieve_more_views", variant, untried, state), variant)
    if options.effort == "fast" or retrieval.index.whole:
        return
    yield from _free_view_stages(upright, state)
    if options.effort == "normal" and not state.recognised:
        return
    for _ in range(config.sample_rounds if options.effort == "normal" else config.max_sample_rounds):
        yield Stage(_sample_poses(variant, state), variant)


def _refine_from_prior(state: SearchState) -> Stage:
    """Refine from the prior pose, which may be some ten degrees off; end early where nothing fits."""

    def records() -> StageResult:
        assert state.images.query.prior is not None
        start = AbsolutePose(state.images.query.prior, np.zeros(0, bool))
        config = state.config
        found = yield from refine_stage(start, state.images, state.renderer, config.refinement, config.max_prior_loss)
        return StageOutcome(found.refined)

    return Stage(records(), ImageVariant(state.config.ambiguity_photo_px), from_prior=True)


def _search_views(
    name: str, variant: ImageVariant, untried: deque[int], state: SearchState, *, try_prior_view: bool = False
) -> StageResult:
    """Go from views, the likeliest first, to a refined pose; end early where too few matches agree.

    Views that were matched are taken from `untried`. `try_prior_view`: match with a render at the prior pose, if there
    is one, before the views.
    """
    images = state.images
    index, prior = state.tools.prepared, images.query.prior
    poses = [index.views[i].camera.pose for i in untried]
    scores = state.retrieval.scores(variant)[list(untried)]
    candidates = Candidates(np.stack([pose.world_from_camera for pose in poses]), scores)
    yield IterationRecord(name, prior or poses[0], candidates=candidates)
    views = (index.views[untried.popleft()] for _ in range(len(untried)))
    if prior and try_prior_view:
        views = chain([state.renderer.at(images.query, prior).view(images.matcher)], views)
    return (yield from _match_and_refine(views, variant, state))


def _free_view_stages(upright: ImageVariant, state: SearchState) -> Iterator[Stage]:
    """Yield stages that match with views beside those of the index, which are rendered when first needed."""
    tools, index = state.tools, state.tools.prepared
    few_features = len(state.images.features().scores) < state.config.verification.min_features
    if not state.config.free_views or few_features:
        return
    views = index.free_views.of(tools.scene, tools.rasterizer, tools.matcher, index.views)
    if not views:
        return
    retrieval = Retrieval(state.images, replace(index, views=views, words=None), state.config.retrieval)
    variant = retrieval.rotated_variant(upright)
    scores = retrieval.scores(variant)
    untried = deque(top_indices(scores, state.config.free_views))
    while untried:
        cameras = [views[i].camera for i in untried]
        yield Stage(_search_free_views(cameras, scores[list(untried)], untried, variant, state), variant)


def _search_free_views(
    cameras: Sequence[Camera], scores: np.ndarray, untried: deque[int], variant: ImageVariant, state: SearchState
) -> StageResult:
    """Render views beside those of the index anew, and go from them to a refined pose."""
    tools = state.tools
    candidates = Candidates(np.stack([camera.pose.world_from_camera for camera in cameras]), scores)
    yield IterationRecord("retrieve_free_views", cameras[0].pose, candidates=candidates)

    def views() -> Iterator[View]:
        for view in views_from(cameras, tools.rasterizer, tools.matcher):
            untried.popleft()
            yield view

    # The last views there are: of few matches, too, a render at the pose shows whether they are chance.
    return (yield from _match_and_refine(views(), variant, state, min_share=0.0))


def _match_and_refine(
    views: Iterable[View], variant: ImageVariant, state: SearchState, min_share: float | None = None
) -> StageResult:
    """Match with views, and refine the pose that most matches agree with, after a rematch if these are few.

    `min_share`: of the matches, if it isn't the usual one.
    """
    images, config = state.images, state.config
    matching = config.matching if min_share is None else replace(config.matching, min_inlier_share=min_share)
    features = state.retrieval.features(variant)
    found = yield from match_candidates(features, views, images, variant.max_error_px, matching)
    if found is None or matching.may_be_chance(found):
        return StageOutcome(None)
    rounds = 0
    # With many inliers refinement converges from the pose as it is.
    if found.num_inliers < config.rematch_below_inliers:
        rematch = yield from render_and_rematch(found, images, state.renderer, config.matching)
        found, rounds = rematch.found, rematch.rounds
    if found is None:
        return StageOutcome(None, rounds > 0)
    outcome = yield from refine_stage(found, images, state.renderer, config.refinement)
    if outcome.restart is None:
        few = rounds == 0 and found.num_inliers < config.rematch_if_refused_below_inliers
        return StageOutcome(outcome.refined, rounds > 0, found if few else None)
    again = yield from rematch_and_refine(
        outcome.restart, images, state.renderer, config.matching, config.refinement, outcome.refined
    )
    return StageOutcome(again.refined, rounds + again.rounds > 0)


def _rematch(found: AbsolutePose, state: SearchState) -> StageResult:
    """Match with a render at a pose whose refinement the gate refused, and refine again."""
    config = state.config
    again = yield from rematch_and_refine(found, state.images, state.renderer, config.matching, config.refinement)
    return StageOutcome(again.refined, again.rounds > 0)


def _sample_poses(variant: ImageVariant, state: SearchState) -> StageResult:
    """Render at poses sampled near the views, match, and go on from the pose that most matches agree with."""
    images, tools, config = state.images, state.tools, state.config
    # The sampled poses are rotated like the photo, so that features match.
    roll_rad = -0.25 * np.pi * variant.roll_steps_45deg
    scores = state.retrieval.scores(variant)
    poses = poses_near_views(tools.prepared.views, scores, roll_rad, config.samples, tools.rng)
    size = sized(images.query.intrinsics, config.sample_render_px)
    error_px = MATCH_ERROR_PX * PHOTO_PX / config.sample_render_px
    best: AbsolutePose | None = None
    for matches, view in render_and_match([Camera(size, pose) for pose in poses], tools.rasterizer, images):
        found = solve_matches(matches, images.query, error_px, config.matching.view_trials)
        if found and (best is None or found.num_inliers > best.num_inliers):
            best = found
        yield record_of(view.camera, matches, found, best, "sample_poses")
    if best is None or best.num_inliers < config.min_sample_inliers:
        return StageOutcome(None)
    again = yield from rematch_and_refine(best, images, state.renderer, config.matching, config.refinement)
    return StageOutcome(again.refined, again.rounds > 0)
