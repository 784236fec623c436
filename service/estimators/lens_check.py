"""The default estimator's check of the lens: is it a fisheye, or none that is modelled?

Made only where the search ended refused, or with a strong distortion, and the photo's distortion wasn't stated.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np

from service.estimators.search_state import SearchState, VerifiedPose, changed
from service.photos.intrinsics import has_distortion, taken_through
from service.pose.absolute_pose.fisheye import LensModelFit, LensModels, fit_lens_models
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.features.image_sizes import scaled_px
from service.pose.matching.correspondences import correspondences
from service.pose.refinement.refine_stage import rematch_and_refine
from service.pose.verification.gate import doubted
from service.results import IterationRecord, Reason, Status
from service.types import Intrinsics, Query


def check_lens(state: SearchState) -> Generator[IterationRecord, None, SearchState]:
    """Return the state to go on with: that of the photo undistorted as a fisheye's, where that explains it; else
    `state`, whose answer is refused as `lens_unmodelled` where another lens is evident.
    """
    best = state.best
    if best is None or not _is_suspicious(state, best):
        return state
    models = _fitted_models(state, best)
    if models is None:
        return state
    if models.is_fisheye():
        fisheye = yield from _through_fisheye(state, models.fisheye)
        if fisheye is not None:
            return fisheye
    if models.is_surely_fisheye() or models.is_unmodelled():
        yield _refused_as_unmodelled(state, best)
    return state


def _is_suspicious(state: SearchState, best: VerifiedPose) -> bool:
    query, config = state.images.query, state.config
    if has_distortion(query.photo_intrinsics) or best.verdict.status is Status.NOT_LOCALIZED:
        return False
    if best.verdict.status is not Status.LOCALIZED:
        return True
    # Exact intrinsics of an accepted answer were tested by the gate.
    if query.lens_prior is None:
        return False
    if best.verdict.signals.get("inlier_share", 1.0) < config.min_plain_inlier_share:
        return True
    camera = query.intrinsics.corrected(best.refined.correction)
    corner = np.hypot(
        max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy
    )
    return bool(abs(best.refined.correction.k1) * corner**2 > config.max_plain_distortion)


def _fitted_models(state: SearchState, best: VerifiedPose) -> LensModels | None:
    """Match the photo as it was taken with a render at the answer, and fit both models; None: too few matches."""
    images, refined = state.images, best.refined
    correction = best.verdict.fitting_correction or refined.correction
    view = state.renderer.at(images.query.corrected(refined.correction), refined.pose).view(images.matcher)
    matches = correspondences(images.features(), view, images.matcher)
    if len(matches.photo_px) < state.config.min_lens_matches:
        return None
    start = AbsolutePose(refined.pose, np.zeros(len(matches.photo_px), bool), correction)
    error_px = scaled_px(state.config.matching.rematch_error_px, images.query.intrinsics)
    return fit_lens_models(matches.photo_px, matches.points_in_world, images.query.intrinsics, start, error_px)


def _through_fisheye(state: SearchState, fit: LensModelFit) -> Generator[IterationRecord, None, SearchState | None]:
    """Match the undistorted photo with a render at the fitted pose, refine and verify.

    None: the gate has other doubts of that than its position or lens, so that it is no answer.
    """
    assumed = state.images.query
    query = taken_through(assumed, photo_lens(assumed, fit.lens(assumed.intrinsics)))
    other = SearchState.of(query, state.tools, state.config)
    other.assumed = assumed
    start = AbsolutePose(fit.pose, fit.inlier)
    search = rematch_and_refine(start, other.images, other.renderer, state.config.matching, state.config.refinement)
    found = (yield from changed(search, lambda record: state.with_answer(replace(record, matches=None)))).refined
    if found is None:
        return None
    verdict = other.verify(found)
    is_answer = verdict.status is Status.LOCALIZED or verdict.reason in state.config.fisheye_doubts
    assert state.best is not None
    if not is_answer:
        return None
    other.best = VerifiedPose(found, verdict, state.best.variant)
    other.finished = True
    yield other.with_answer(IterationRecord("check_lens", found.pose, num_inliers=verdict.inliers))
    return other


def photo_lens(query: Query, lens: Intrinsics) -> Intrinsics:
    """Return the camera of the whole upright photo for that of the query's pixels."""
    photo, shown = query.photo_intrinsics, query.intrinsics
    sx, sy = photo.fx / shown.fx, photo.fy / shown.fy
    return replace(
        lens,
        width=photo.width,
        height=photo.height,
        fx=lens.fx * sx,
        fy=lens.fy * sy,
        cx=photo.cx + (lens.cx - shown.cx) * sx,
        cy=photo.cy + (lens.cy - shown.cy) * sy,
    )


def _refused_as_unmodelled(state: SearchState, best: VerifiedPose) -> IterationRecord:
    """Refuse the answer because no model explains its lens; return its record."""
    verdict = doubted(best.verdict, Reason.LENS_UNMODELLED)
    # What fits best of the models doesn't fit.
    state.best = replace(best, verdict=replace(verdict, fitting_correction=None))
    return state.best.record("check_lens")
