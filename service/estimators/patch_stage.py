"""The default estimator's last stage where the scene has a digest of its training photos: a more exact pose.

Photos show more detail than renders, so the places of patches of training photos in the photo tell the pose better than
photometric refinement alone. The verdict on the place stays as it is; the covariance becomes smaller.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

from service.estimators.search_state import SearchState, VerifiedPose
from service.geometry import pose_distance
from service.interfaces import SurfacePoints
from service.pose.absolute_pose.prior_region import inside_prior
from service.pose.refinement.uncertainty import refinement_covariance
from service.pose.training_photos.patch_matching import grey
from service.pose.training_photos.patch_pose import PatchPose, patch_pose
from service.pose.verification.precision import probability_within
from service.results import IterationRecord, Status, Verdict
from service.types import Camera


def refine_by_patches(state: SearchState) -> Generator[IterationRecord, None, None]:
    """Where patches of training photos agree with the answer, make it that of patches and pixels together."""
    best, points = state.best, state.tools.surface_points
    if points is None or best is None or best.verdict.status is Status.NOT_LOCALIZED:
        return
    found = _patch_pose(state, best, points)
    if found is None or not inside_prior(state.images.query.region, found.pose):
        return
    # The refinement at hand led to another pose.
    refined = replace(best.refined, pose=found.pose, photometric=None)
    state.best = replace(best, refined=refined, verdict=_verdict(best.verdict, found))
    step_deg, step_units = pose_distance(best.refined.pose, found.pose)
    record = replace(state.best.record("refine_by_patches"), num_matches=found.found, num_inliers=found.agreeing)
    yield state.with_answer(replace(record, step_deg=step_deg, step_units=step_units))


def _patch_pose(state: SearchState, best: VerifiedPose, points: SurfacePoints) -> PatchPose | None:
    """Return the pose by patches; None with approximate intrinsics, too small a photo, or too few patches."""
    query, config = state.images.query, state.config
    rendered, refinement = best.refined.rendered, best.refined.photometric
    if rendered is None or refinement is None:
        return None
    if query.lens_prior is not None or query.intrinsics.long_side < config.patches.min_photo_px:
        return None
    covariance = refinement_covariance(refinement, rendered.frame, rendered.camera, config.refinement.photometric)
    if covariance is None:
        return None
    camera = Camera(query.intrinsics, best.refined.pose)
    return patch_pose(grey(query.rgb), query.valid_mask, camera, covariance, rendered, points, config.patches)


def _verdict(verdict: Verdict, found: PatchPose) -> Verdict:
    """Return the verdict with the covariance of patches and pixels, unless more than these makes the pose uncertain."""
    if verdict.asked is None or verdict.intrinsics_untested or verdict.shutter_motion:
        return verdict
    refined = replace(verdict, covariance=found.covariance)
    if verdict.status is not Status.LOCALIZED:
        return refined
    precise = probability_within(found.covariance, *verdict.asked)
    return replace(refined, precise=precise, score=verdict.place_probability * precise)
