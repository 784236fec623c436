"""The default estimator's comparison of a pose with its rivals, in a scene that repeats itself.

There edges and matches agree at wrong poses, too: at the mirror image, and one thing further. Colours tell them apart,
by a level that only holds in the light, and for the trainer, that it was set with. Compared with one another the right
pose has the better colours in any light: all of them are judged by the same photo.

    a pose that only colours speak against -> its mirror image; places where the scene, or the photo, looks alike
    -> refined -> are photo and render less alike at each of them?
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from service.estimators.ambiguity_check import (
    hypotheses_of_photo,
    mirror_image_of,
    refine_ambiguous,
    rendered_ahead,
    seen_from,
    twins_of,
)
from service.estimators.search_state import (
    SearchState,
    VerifiedPose,
    changed,
    only_colours_doubt,
    refined_in_other_light,
)
from service.pose.absolute_pose.pnp import AbsolutePose, estimate_absolute_pose
from service.pose.features.image_sizes import scaled_px
from service.pose.features.mirrored_query import mirrored_intrinsics
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import VIEWS, to_uint8
from service.pose.matching.correspondences import MATCH_ERROR_PX, correspondences
from service.pose.refinement.refine_stage import RefinedPose, rematch_and_refine
from service.pose.retrieval.ambiguous_hypotheses import PoseAtDistance, ambiguous_hypotheses, shifted_hypotheses
from service.pose.retrieval.scores import top_indices
from service.pose.verification.mirror_images import dissimilarity
from service.results import IterationRecord, Reason


def check_rivals(state: SearchState) -> Generator[IterationRecord, None, bool]:
    """Accept an answer that only colours speak against if they speak more against each rival; return whether it was."""
    answer, config = state.best, state.config
    if answer is None or not only_colours_doubt(state, answer.refined, answer.verdict):
        return False
    limit = dissimilarity(answer.verdict.signals) / config.max_rival_ratio
    if state.tools.prepared.like_its_mirror_image:
        mirrored = mirror_image_of(state, answer)
        found = yield from _refined_mirror_image(state, mirrored, answer)
        if found is not None and _fits_as_well(mirrored, found, limit):
            return False
    seen = seen_from(state, answer)
    for rival in rendered_ahead(state, _rivals(state, answer, seen), answer):
        found = yield from refine_ambiguous(state, rival, answer)
        if found is None or not seen.differs_from(found.pose, config.ambiguity):
            continue
        if _fits_as_well(state, found, limit):
            return False
    yield from _accept(state, answer)
    return True


def _accept(state: SearchState, answer: VerifiedPose) -> Generator[IterationRecord, None, None]:
    """Verify the answer whatever its colours; refine it in other light where that leaves its position uncertain.

    Colours that are not the scene's are residuals of refinement, and make the covariance greater.
    """
    state.best = replace(answer, verdict=state.verify(answer.refined, is_unique=True))
    if state.best.verdict.reason is Reason.POSITION_UNCERTAIN:
        again = yield from refined_in_other_light(state, answer.refined, is_unique=True)
        if again is not None and again[1].rank > state.best.verdict.rank:
            state.best = replace(answer, refined=again[0], verdict=again[1])
    yield state.best.record("check_rivals")


def _fits_as_well(state: SearchState, rival: RefinedPose, limit: float) -> bool:
    """Return whether a pose shows the photo's edges, and is less dissimilar than this."""
    signals = state.appearance_at(rival)
    return signals["gradients_half"] >= state.config.min_rival_gradients and dissimilarity(signals) < limit


def _refined_mirror_image(
    state: SearchState, mirrored: SearchState, answer: VerifiedPose
) -> Generator[IterationRecord, None, RefinedPose | None]:
    """Find the place that looks like the mirror image of the render at the answer; refine the mirrored photo there.

    None: no place does.
    """
    images, config = state.images.corrected(answer.refined.correction), state.config
    rendered = state.renderer.at(images.query, answer.refined.pose)
    camera = mirrored_intrinsics(rendered.camera.intrinsics)
    # Mirroring the image changes its features.
    features = images.matcher.extract(np.ascontiguousarray(to_uint8(rendered.frame.rgb)[:, ::-1]), VIEWS.max_features)
    views = state.tools.prepared.views
    scores = state.tools.prepared.scores(features.descriptors)
    error_px = scaled_px(MATCH_ERROR_PX, camera)
    best: AbsolutePose | None = None
    for i in top_indices(scores, config.rival_views):
        matches = correspondences(features, views[i], images.matcher)
        found = estimate_absolute_pose(
            matches.photo_px, matches.points_in_world, camera, error_px, config.matching.view_trials
        )
        if found and (best is None or found.num_inliers > best.num_inliers):
            best = found
    if best is None or best.num_inliers < config.min_mirror_inliers:
        return None
    refinement = rematch_and_refine(best, mirrored.images, mirrored.renderer, config.matching, config.refinement)
    outcome = yield from changed(
        refinement, lambda record: state.with_answer(replace(record, stage="check_rivals", matches=None))
    )
    return outcome.refined


def _rivals(state: SearchState, answer: VerifiedPose, seen: PoseAtDistance) -> Iterator[AbsolutePose]:
    """Yield poses where the scene looks as at the answer, and poses that the photo's own matches lead to."""
    images, tools = state.images.corrected(answer.refined.correction), state.tools
    # The render in the place of the photo: whatever the light, the scene is like itself.
    view = state.renderer.at(images.query, seen.pose).view(images.matcher)
    camera, views = view.camera.intrinsics, tools.prepared.views
    scores = tools.prepared.scores(view.features.descriptors)
    error_px = scaled_px(MATCH_ERROR_PX, camera)
    config = state.config.ambiguity
    alike = ambiguous_hypotheses(
        view.features, camera, seen, views, scores, images.matcher, error_px, config.min_inliers, config
    )
    twins = twins_of(state, images, seen)
    return chain(twins, alike, hypotheses_of_photo(state, images, seen, whole=False), _shifted(state, images, seen))


def _shifted(state: SearchState, images: QueryImages, seen: PoseAtDistance) -> Iterator[AbsolutePose]:
    """Yield poses near the answer that show other things in the places of those that it shows."""
    assert state.best is not None
    retrieval, variant, camera = state.retrieval, state.best.variant, images.query.intrinsics
    error_px = scaled_px(variant.max_error_px, camera)
    features, scores = retrieval.features(variant), retrieval.scores(variant)
    return shifted_hypotheses(
        features, camera, seen, retrieval.index.views, scores, images.matcher, error_px, state.config.ambiguity
    )
