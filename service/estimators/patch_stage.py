"""The default estimator's last stage where the scene has a digest of its training photos: a more exact pose.

Photos show more detail than renders, so the place of patches of training photos in the photo tells the pose better than
photometric refinement alone. The verdict on the place remains; only the covariance becomes smaller.
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
    before = best.refined
    # That refinement didn't lead here.
    refined = replace(before, pose=found.pose, correction=found.correction, photometric=None)
    state.best = replace(best, refined=refined, verdict=_verdict(best.verdict, found))
    step_deg, step_units = pose_distance(before.pose, found.pose)
    record = replace(state.best.record("refine_by_patches"), num_matches=found.found, num_inliers=found.agreeing)
    yield state.with_answer(replace(record, step_deg=step_deg, step_units=step_units))


def _patch_pose(state: SearchState, best: VerifiedPose, points: SurfacePoints) -> PatchPose | None:
    found = best.refined
    if found.photometric is None or found.rendered is None:
        return None
    images, rendered = state.images.corrected(found.correction), found.rendered
    covariance = refinement_covariance(
        found.photometric, rendered.frame, rendered.camera, images.query.lens_prior, state.config.refinement.photometric
    )
    if covariance is None:
        return None
    size = images.query.intrinsics
    return patch_pose(
        grey(images.resized(size)),
        images.valid_mask(size),
        Camera(size, found.pose),
        found.correction,
        covariance,
        rendered,
        points,
        state.config.patches,
    )


def _verdict(verdict: Verdict, found: PatchPose) -> Verdict:
    """Return the verdict with the covariance of patches and pixels, where nothing but these makes a pose uncertain."""
    is_exact = len(found.covariance) == 6
    if verdict.asked is None or not is_exact or verdict.intrinsics_untested or verdict.shutter_motion:
        return verdict
    if verdict.status is not Status.LOCALIZED:
        return replace(verdict, covariance=found.covariance)
    precise = probability_within(found.covariance, *verdict.asked)
    return replace(verdict, covariance=found.covariance, precise=precise, score=verdict.place_probability * precise)
