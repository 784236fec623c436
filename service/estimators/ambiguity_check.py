"""Checks of an accepted answer: does its mirror image fit better, and do other poses explain the photo as well?"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from service.estimators.search_state import SearchState, VerifiedPose, changed
from service.geometry import pose_distance
from service.pose.absolute_pose.device_priors import prefers
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.features.image_sizes import scaled_px
from service.pose.features.mirrored_query import mirrored_query
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import VIEWS, camera_of, in_batches
from service.pose.matching.match_stages import match_candidates
from service.pose.refinement.refine_stage import RefinedPose, refine_stage, rematch_and_refine
from service.pose.retrieval.ambiguous_hypotheses import PoseAtDistance, ambiguous_hypotheses
from service.pose.retrieval.image_variant import ImageVariant
from service.pose.retrieval.scores import top_indices
from service.pose.verification.ambiguity import explains_whole_photo, rank_answers
from service.pose.verification.mirror_images import dissimilarity, may_be_mirrored
from service.results import Candidates, IterationRecord, Status
from service.types import Camera


def check_mirror(state: SearchState) -> Generator[IterationRecord, None, bool]:
    """Where the scene is like its mirror image, find out whether the photo's mirror image fits better; return that.

    In another place it must fit much better: that the photo is mirrored is less probable than that a place has a
    mirror image. Where the gate refused the answer, the mirror image counts only if the gate accepts it.
    """
    best, config = state.best, state.config
    if best is None or best.verdict.status is Status.NOT_LOCALIZED:
        return False
    if not state.tools.prepared.like_its_mirror_image or not may_be_mirrored(best.verdict.signals, config.mirror):
        return False
    mirrored = mirror_image_of(state, best)
    # Mirroring turns a rotation into its opposite.
    variant = replace(best.variant, roll_steps_45deg=-best.variant.roll_steps_45deg % 8)
    search = _search_mirrored(mirrored, variant, config.mirror.max_loss_ratio * best.loss)
    found = yield from changed(
        search, lambda record: state.with_answer(replace(record, stage="check_mirror", matches=None))
    )
    if found is None:
        return False
    # A camera that was rolled, by gravity: its mirror image is rolled to the other side.
    if prefers(state.images.query.scene_priors, best.refined.pose, best.verdict.covariance, found.pose, None):
        return False
    # Both may be wrong: a poor answer is no evidence for the mirror image.
    if not state.finished and mirrored.verify(found).status is not Status.LOCALIZED:
        return False
    limit = dissimilarity(best.verdict.signals)
    alike = dissimilarity(mirrored.appearance_at(found))
    if alike < limit:
        seen = seen_from(state, best)
        _, way = pose_distance(found.pose, seen.pose)
        if way > config.mirror.same_place * seen.distance:
            limit *= config.mirror.max_ratio_elsewhere
    is_mirrored = alike < limit
    yield replace(best.record("check_mirror"), mirrored=is_mirrored)
    return is_mirrored


def mirror_image_of(state: SearchState, answer: VerifiedPose) -> SearchState:
    """Return the state of a search for the photo's mirror image, through the lens that the answer has."""
    # The intrinsics that were estimated hold for the mirror image, too.
    query = mirrored_query(state.images.query.corrected(answer.refined.correction))
    query = replace(query, prior=None, region=None, scene_priors=None)
    return SearchState.of(query, state.tools, state.config)


def _search_mirrored(
    state: SearchState, variant: ImageVariant, max_loss: float
) -> Generator[IterationRecord, None, RefinedPose | None]:
    """Match the mirrored photo and refine; end early where the first refinement's residual is greater than this."""
    config, retrieval = state.config, state.retrieval
    views = (retrieval.index.views[i] for i in top_indices(retrieval.scores(variant), config.small_photo_views))
    features = retrieval.features(variant)
    found = yield from match_candidates(features, views, state.images, variant.max_error_px, config.matching)
    if found is None or found.num_inliers < config.matching.min_inliers:
        return None
    outcome = yield from refine_stage(found, state.images, state.renderer, config.refinement, max_loss)
    return outcome.refined


def check_ambiguity(state: SearchState) -> Generator[IterationRecord, None, None]:
    """Look for other poses that the gate accepts; the best becomes the answer, and the last record has all but those
    that the device's readings decide against.

    A pose that explains the whole photo has no alternative in a scene that doesn't repeat itself.
    """
    answer = state.best
    assert answer is not None
    whole = explains_whole_photo(answer.verdict.signals, state.config.answers)
    if whole and not state.tools.prepared.repeats_itself:
        return
    images = state.images.corrected(answer.refined.correction)
    seen = seen_from(state, answer)
    answers = [answer]
    hypotheses = chain(twins_of(state, images, seen), hypotheses_of_photo(state, images, seen, whole))
    for other in rendered_ahead(state, hypotheses, answer):
        found = yield from refine_ambiguous(state, other, answer)
        ambiguity = state.config.ambiguity
        if found is None or not all(
            replace(seen, pose=found.pose).differs_from(known.refined.pose, ambiguity) for known in answers
        ):
            continue
        verdict = state.verify(found)
        if verdict.status is Status.LOCALIZED:
            answers.append(VerifiedPose(found, verdict, answer.variant))
    if len(answers) > 1:
        kept = [one for one in answers if not any(state.readings_prefer(other, one) for other in answers)]
        yield _ranked(state, kept or answers)


def seen_from(state: SearchState, answer: VerifiedPose) -> PoseAtDistance:
    """Return the answer's pose with the median distance to what it sees, which decides whether two poses differ."""
    images = state.images.corrected(answer.refined.correction)
    frame = state.renderer.at(images.query, answer.refined.pose).frame
    # The background has no distance.
    return PoseAtDistance(answer.refined.pose, float(np.median(frame.median_depth[frame.alpha > VIEWS.min_alpha])))


def twins_of(state: SearchState, images: QueryImages, answer: PoseAtDistance) -> list[AbsolutePose]:
    """Return the poses from which the scene may look as it does at the answer, by the motions that repeat it."""
    camera = Camera(images.query.intrinsics, answer.pose)
    # As many matches as the motion rests on, at least: enough for refinement to trust it.
    support = np.ones(state.config.refinement.trusted_inliers, bool)
    return [AbsolutePose(pose, support) for pose in state.tools.prepared.repetitions.twins(camera, answer.distance)]


def hypotheses_of_photo(
    state: SearchState, images: QueryImages, answer: PoseAtDistance, whole: bool
) -> Generator[AbsolutePose, None, None]:
    """Yield poses that many matches agree on which the answer doesn't explain."""
    assert state.best is not None
    config, variant = state.config.ambiguity, state.best.variant
    yield from ambiguous_hypotheses(
        state.retrieval.features(variant),
        images.query.intrinsics,
        answer,
        state.retrieval.index.views,
        state.retrieval.scores(variant),
        images.matcher,
        scaled_px(variant.max_error_px, images.query.intrinsics),
        config.min_inliers_if_explained if whole else config.min_inliers,
        config,
    )


def rendered_ahead(
    state: SearchState, hypotheses: Iterable[AbsolutePose], answer: VerifiedPose
) -> Iterator[AbsolutePose]:
    """Yield the hypotheses; the first renders of their refinements are made together if the renderer prefers that."""
    query = state.images.query.corrected(answer.refined.correction)
    for some in in_batches(hypotheses, state.tools.rasterizer.cameras_at_once):
        first_px = state.config.refinement.first_render_px
        state.renderer.render_ahead([camera_of(query, hypothesis.pose, first_px) for hypothesis in some])
        yield from some


def refine_ambiguous(
    state: SearchState, other: AbsolutePose, answer: VerifiedPose
) -> Generator[IterationRecord, None, RefinedPose | None]:
    """Refine an ambiguous hypothesis, unless its residual on a first render is much greater than the answer's."""
    config = state.config
    # The same camera took the photo, wherever it stood.
    other = replace(other, correction=answer.refined.correction)
    max_loss = config.max_ambiguous_loss_ratio * answer.loss
    if next(refine_stage(other, state.images, state.renderer, config.refinement, max_loss), None) is None:
        return None
    stage = rematch_and_refine(other, state.images, state.renderer, config.matching, config.refinement)
    return (yield from changed(stage, state.with_answer)).refined


def _ranked(state: SearchState, answers: list[VerifiedPose]) -> IterationRecord:
    """Make the answer with the least residual the best one; return the record that names the others."""
    # Residuals decide: verification has accepted all of them.
    (best, _), *others = rank_answers([answer.loss for answer in answers], state.config.answers)
    state.best = answers[best]
    alternatives = None
    if others:
        poses = np.stack([answers[i].refined.pose.world_from_camera for i, _ in others])
        alternatives = Candidates(poses, np.array([probability for _, probability in others]))
    return replace(state.best.record("check_ambiguity"), alternatives=alternatives)
