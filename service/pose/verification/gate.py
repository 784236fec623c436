"""The verification gate: one rule that decides, for the answer of any estimator, whether it is accepted.

Signals of several kinds are measured at the pose: whether the render there has the photo's gradients (fine structure,
whatever the exposure) and its colours, each over most of the photo and over its better half (the rest may be occluded),
and whether the colours agree where the gradients do (repeated things seen one further, and mirror images, have the
right edges and the wrong colours; see `appearance.py`); how many fresh matches between photo and render agree with
the pose, without any fit, what share that is, and how they are spread; and by how much refinement would still move the
pose. `gate_model.py` computes from them how probably the pose is in the right place (within 5 degrees and 1/80 of
the training cameras' median distance from the scene's focus), and which signals are below their floors. `precision.py`
computes from the covariance how probably a pose in the right place is as accurate as was asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.absolute_pose.prior_region import inside_prior
from service.pose.absolute_pose.unknown_lens import evidence_against_lens
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import RenderedView
from service.pose.matching.correspondences import Correspondences, correspondences
from service.pose.refinement.lens_test import LensFit, moves_pose
from service.pose.refinement.photometric import RefinementResult
from service.pose.refinement.refinement_config import REFINEMENT, RefinementConfig
from service.pose.refinement.uncertainty import PoseUncertainty, pose_uncertainty
from service.pose.verification.appearance import GLOBAL_SIGNALS, appearance, visible_alpha
from service.pose.verification.gate_model import SHIPPED_MODEL, GateModel
from service.pose.verification.precision import AskedBounds, probability_within
from service.pose.verification.signals import NO_MATCHES, SIGNALS, geometry_signals, match_signals, typical_depth
from service.results import Reason, Status, Verdict
from service.types import Camera, Intrinsics, Pose, Query


@dataclass(frozen=True, slots=True)
class VerificationConfig:
    """When a pose is accepted."""

    model: GateModel = SHIPPED_MODEL
    refinement: RefinementConfig = REFINEMENT
    """How the step is made that measures the uncertainty."""
    min_localized: float = 0.8
    min_uncertain: float = 0.1
    """Least probabilities of the right place of the statuses `localized` and `uncertain`."""
    min_precise: float = 0.91
    """Least probability of `localized` that the errors are within the bounds asked for. By the default ones, a standard
    deviation of the position of 0.9 to 0.94 % of the distance to what is seen, as its directions have it: six in seven
    such positions are within 1.25 % of it. Photos of the test scenes have 0.02 to 0.2 %, cropped to an eighth 1 %.
    Wrong answers with estimated intrinsics have 0.95 % and more: crops and turntables through long lenses."""
    doubtful_score: float = 0.5
    """Probability of the right place, at most, where a signal is below its floor, and of being precise, where the
    intrinsics are in doubt."""
    unrecognised: float = 0.35
    """Mean of the scaled signals of a kind below which nothing was recognised: foreign photos have 0.0 to 0.3."""
    unlike: float = 0.3
    """Scaled mean of the global appearance below which nothing else is measured: right poses of photos degraded within
    reason and beyond have 0.76 and more, those of photos of other scenes 0.0 to 0.36."""
    min_features: int = 30
    """Features of a photo; with fewer, that is the reason of a refusal."""
    min_coverage: float = 0.04
    """Share of the photo in which the scene is opaque."""
    max_sigma_share_if_cropped: float = 0.0125
    """Standard deviation of the position, relative to the distance to what is seen, if the photo may have been cropped
    off centre, with approximate intrinsics: beyond it a plane may be seen from elsewhere with another principal point.
    Right answers have up to 0.0105, wrong ones of this kind 0.027 and more."""
    max_sigma_deg_if_cropped: float = 2.0
    """Likewise of the rotation."""
    max_significance_if_cropped: float = 6.6
    """Square of the next step, in standard deviations, from which on it is no chance (one in a hundred): then it must
    not move the pose. Right answers have 4.6 at most, wrong ones of this kind 9.3 and more."""
    max_focal_step: float = 0.008
    """By which another step would change the logarithm of an approximate focal length: a method may not have estimated
    it at all, and one that is 1 % off moves the camera by 1 % of the distance. Where a looser accuracy than the default
    is asked for, this and the limits `if_cropped` are as much looser."""
    max_drift_px_free_lens: float = 0.3
    """By which another step would move the image, with approximate intrinsics: refinement settles at 0.3 px, and what
    it has not settled may still be a tenth of the distance off, for distance and focal length move along together."""
    min_lens_matches: int = 50
    """Matches with which exact intrinsics are tested: ten unknowns with ten times as many equations."""
    max_inlier_scale: float = 10.0
    """Inliers of a partly invalid photo are scaled up to those of a whole one, at most by this factor."""


VERIFICATION = VerificationConfig()
LENS_DOUBTS = (Reason.FOCAL_UNCERTAIN, Reason.INTRINSICS_CONTRADICTED, Reason.LENS_UNMODELLED)
"""Doubts about the intrinsics, on which the accuracy depends, not about the place."""


def verify(
    images: QueryImages,
    pose: Pose,
    rendered: RenderedView,
    refinement: RefinementResult | None = None,
    pixels_may_decide: bool = False,
    supporting_matches: int = 0,
    light_may_differ: bool = False,
    config: VerificationConfig = VERIFICATION,
) -> Verdict:
    """Return the verdict on a pose; `rendered` is a render with the photo's intrinsics there or within a pixel of it.

    `refinement` is the refinement on that render that led to the pose, if one did: it saves a linearization. With
    `pixels_may_decide`, for a pose that something else supports already, no fresh matches are made if the signals of
    the pixels suffice; the verdict then reports the `supporting_matches` with a view that led to the pose.
    `light_may_differ`: colours that disagree don't count where matches and gradients support the pose; not for a scene
    that repeats itself, where colours tell similar things apart.
    """
    query, frame, size = images.query, rendered.frame, rendered.camera.intrinsics
    asked = AskedBounds.of(query.accuracy, typical_depth(frame))
    signals, uncertainty = _photometric_signals(images, pose, rendered, refinement, config)
    # Fresh matches cost most of a verification, but where the scene's model is poor only they show wrong intrinsics.
    undecided = uncertainty is None or _lens_is_undecided(uncertainty, asked.distance, config)
    if pixels_may_decide and not undecided and photometric_suffices(signals, config):
        verdict = verdict_of(signals, uncertainty, asked, config=config)
        return _within_prior(replace(verdict, inliers=supporting_matches), images, pose)
    features, valid = images.features(), images.valid_mask(size)
    few = len(features.scores) < config.min_features
    # Neither matches nor a refinement make a picture of something else right.
    if _is_unlike(signals, config):
        return verdict_of(signals | NO_MATCHES, uncertainty, asked, few, config=config)
    found = correspondences(features, rendered.view(images.matcher), images.matcher)
    signals |= match_signals(found, visible_alpha(frame, valid), query, size, pose)
    if uncertainty and query.lens_prior is None:
        uncertainty = _with_evidence_of_matches(uncertainty, found, query, size, pose, config)
    # A masked photo has fewer matches than a whole one, without being less certain.
    if valid is not None:
        signals["inliers"] /= max(float(valid.mean()), 1 / config.max_inlier_scale)
    return _within_prior(verdict_of(signals, uncertainty, asked, few, light_may_differ, config), images, pose)


def _photometric_signals(
    images: QueryImages,
    pose: Pose,
    rendered: RenderedView,
    refinement: RefinementResult | None,
    config: VerificationConfig,
) -> tuple[dict[str, float], PoseUncertainty | None]:
    """Return the signals of the pixels, and the uncertainty of the pose (None: undetermined, or a hopeless pose)."""
    frame, size = rendered.frame, rendered.camera.intrinsics
    photo, valid = images.resized(size), images.valid_mask(size)
    signals = appearance(photo, frame, valid)
    uncertainty = None
    if not _is_unlike(signals, config):
        answer = Camera(images.query.intrinsics.resized(size.width, size.height), pose)
        uncertainty = pose_uncertainty(
            photo, frame, rendered.camera, answer, images.query.lens_prior, valid, refinement, config.refinement
        )
    return signals | geometry_signals(frame, size, uncertainty), uncertainty


def _lens_is_undecided(uncertainty: PoseUncertainty, distance: float, config: VerificationConfig) -> bool:
    """Return whether the pixels don't show if exact intrinsics are right: matches may."""
    fit, test = uncertainty.lens_fit, config.refinement.lens_test
    if uncertainty.loss > test.suspicious_loss:
        return True
    if fit is None or fit.contradicts or fit.loss_ratio > test.suspicious_loss_ratio:
        return False
    return moves_pose(fit.motion, distance, test.contradicting_deg, test.contradicting_share)


def _with_evidence_of_matches(
    uncertainty: PoseUncertainty,
    found: Correspondences,
    query: Query,
    size: Intrinsics,
    pose: Pose,
    config: VerificationConfig,
) -> PoseUncertainty:
    """Return the uncertainty with what the matches say against exact intrinsics, if these put the pose off.

    Where a scene's model is poor, matches err together, as with a wrong lens: without the pixels they have to say more.
    """
    test, fit = config.refinement.lens_test, uncertainty.lens_fit
    if len(found.photo_px) < config.min_lens_matches or (fit and fit.contradicts):
        return uncertainty
    are_alone = fit is not None and fit.loss_ratio > test.max_loss_ratio_with_matches
    least = test.min_cost_drop_alone if are_alone else test.min_cost_drop
    error_px = SIGNALS.max_error_px * query.intrinsics.long_side / size.long_side
    start = AbsolutePose(pose, np.zeros(len(found.photo_px), bool))
    given = (found.photo_px, found.points_in_world, query.intrinsics)
    evidence = evidence_against_lens(*given, start, test.prior, error_px)
    depth = float(np.median(np.linalg.norm(found.points_in_world - pose.position_in_world, axis=1)))
    moves = moves_pose(evidence.motion, depth, test.contradicting_deg, test.contradicting_share)
    if not moves or evidence.cost_drop < least:
        return uncertainty
    return replace(uncertainty, lens_fit=LensFit(evidence.correction, evidence.motion, 1.0, True))


def photometric_suffices(signals: Mapping[str, float], config: VerificationConfig = VERIFICATION) -> bool:
    """Return whether the signals of the pixels are enough to accept a pose."""
    return config.model.probability(signals) >= config.min_localized and not config.model.below_floor(signals)


def _is_unlike(signals: Mapping[str, float], config: VerificationConfig) -> bool:
    scales = config.model.scales
    return bool(np.mean([scales[name](signals[name]) for name in GLOBAL_SIGNALS]) < config.unlike)


def _within_prior(verdict: Verdict, images: QueryImages, pose: Pose) -> Verdict:
    return verdict if inside_prior(images.query.region, pose) else downgraded(verdict, Reason.OUTSIDE_PRIOR)


def downgraded(verdict: Verdict, reason: Reason, most: float = VERIFICATION.doubtful_score) -> Verdict:
    """Return a `localized` verdict as `doubted`; others as they are."""
    return doubted(verdict, reason, most) if verdict.status is Status.LOCALIZED else verdict


def doubted(verdict: Verdict, reason: Reason, most: float = VERIFICATION.doubtful_score) -> Verdict:
    """Return a verdict as `uncertain`, with `precise` at most this if the reason is the lens, else `right_place`."""
    place, precise = verdict.place_probability, 1.0 if verdict.precise is None else verdict.precise
    if reason in LENS_DOUBTS:
        precise = min(precise, most)
    else:
        place = min(place, most)
    return replace(
        verdict, status=Status.UNCERTAIN, reason=reason, score=place * precise, right_place=place, precise=precise
    )


def verdict_of(
    signals: Mapping[str, float],
    uncertainty: PoseUncertainty | None,
    asked: AskedBounds,
    few_features: bool = False,
    light_may_differ: bool = False,
    config: VerificationConfig = VERIFICATION,
) -> Verdict:
    """Return the verdict on a pose with these signals, by the accuracy asked for there.

    A pose that the pixels don't determine is never `uncertain`: whoever is to check a pose needs its covariance.
    """
    # The sum of the model could compensate for one bad signal; floors don't.
    doubtful = config.model.below_floor(signals, light_may_differ)
    place = min(config.model.probability(signals), config.doubtful_score if doubtful else 1.0)
    precise = _precise(uncertainty and uncertainty.covariance, asked)
    little = signals["coverage"] < config.min_coverage
    doubt = Reason.LOW_COVERAGE if little else _doubt_about_position(signals, uncertainty, precise, asked, config)
    if place < config.min_localized:
        reason = Reason.FEW_FEATURES if few_features else _reason_of_refusal(signals, doubtful, config)
        if little and reason in (Reason.FEW_INLIERS, Reason.RENDER_MISMATCH):
            reason = Reason.LOW_COVERAGE  # of which the others are consequences
    else:
        reason = doubt or Reason.VERIFIED
    if little:
        place = min(place, config.doubtful_score)
    if doubt in LENS_DOUBTS:
        precise = min(precise, config.doubtful_score)
    status = _status(place, reason, uncertainty, config)
    inliers, correlation = int(signals.get("inliers", 0)), signals["gradients"]
    verdict = Verdict(
        status,
        reason,
        score=place * precise,
        inliers=inliers,
        gradient_correlation=correlation,
        coverage=signals["coverage"],
        covariance=None,
        signals=signals,
        right_place=place,
        precise=precise,
        asked=(asked.deg, asked.units),
    )
    return verdict if uncertainty is None else _with_uncertainty(verdict, uncertainty)


def _precise(covariance: Float64[np.ndarray, "k k"] | None, asked: AskedBounds) -> float:
    """Return the probability that the pose is as accurate as asked if this is its covariance; 0 without one."""
    return 0.0 if covariance is None else probability_within(covariance[:6, :6], asked.deg, asked.units)


def _status(place: float, reason: Reason, uncertainty: PoseUncertainty | None, config: VerificationConfig) -> Status:
    if reason is Reason.VERIFIED:
        return Status.LOCALIZED
    return Status.UNCERTAIN if place >= config.min_uncertain and uncertainty else Status.NOT_LOCALIZED


def _reason_of_refusal(signals: Mapping[str, float], doubtful: list[str], config: VerificationConfig) -> Reason:
    """Return which kind of signals, matches or pixels, is the worse one; of those below their floors, if any are."""
    scales = config.model.scales
    scaled = {name: float(scales[name](value)) for name, value in signals.items() if name in scales}
    # A signal below its floor is why the pose was refused.
    scaled = {name: scaled[name] for name in doubtful} or scaled
    matches = np.mean([value for name, value in scaled.items() if name in NO_MATCHES] or [1.0])
    pixels = np.mean([value for name, value in scaled.items() if name not in NO_MATCHES] or [1.0])
    if max(matches, pixels) < config.unrecognised:
        return Reason.NO_MATCHING_VIEW
    return Reason.FEW_INLIERS if matches < pixels else Reason.RENDER_MISMATCH


def _doubt_about_position(
    signals: Mapping[str, float],
    uncertainty: PoseUncertainty | None,
    precise: float,
    asked: AskedBounds,
    config: VerificationConfig,
) -> Reason | None:
    """Return why a pose where photo and render agree may be less accurate than asked; None if there is no reason."""
    is_precise = precise >= config.min_precise
    if uncertainty is None:
        return Reason.POSITION_UNCERTAIN
    if uncertainty.lens_fit and uncertainty.lens_fit.contradicts:
        return Reason.INTRINSICS_CONTRADICTED
    if abs(uncertainty.focal_step) > config.max_focal_step * asked.looser_position:
        return Reason.FOCAL_UNCERTAIN
    given_lens = uncertainty.given_lens
    settled = given_lens is None or signals["drift_px"] <= config.max_drift_px_free_lens
    if is_precise and settled and _is_certain_if_cropped(uncertainty, asked, config):
        return None
    if given_lens is None:
        return Reason.POSITION_UNCERTAIN
    # With known intrinsics the position would be certain: then they are what is missing.
    is_known = is_precise or _precise(given_lens, asked) >= config.min_precise
    return Reason.FOCAL_UNCERTAIN if is_known else Reason.POSITION_UNCERTAIN


def _is_certain_if_cropped(uncertainty: PoseUncertainty, asked: AskedBounds, config: VerificationConfig) -> bool:
    """Return whether the pose would be certain, and the same, if the principal point might be anywhere."""
    cropped, test = uncertainty.if_cropped, config.refinement.lens_test
    if cropped is None:
        return True
    sigma_deg = np.degrees(np.sqrt(np.trace(cropped.covariance[:3, :3])))
    sigma, units = np.sqrt(np.trace(cropped.covariance[3:6, 3:6])), asked.looser_position * asked.distance
    if sigma_deg > config.max_sigma_deg_if_cropped * asked.looser_rotation:
        return False
    if sigma > config.max_sigma_share_if_cropped * units:
        return False
    moves = moves_pose(cropped.step, units, test.contradicting_deg * asked.looser_rotation, test.contradicting_share)
    return not (moves and cropped.significance > config.max_significance_if_cropped)


def _with_uncertainty(verdict: Verdict, uncertainty: PoseUncertainty) -> Verdict:
    # What another step would still change is an error, too: it adds its square.
    step, given_lens = np.outer(uncertainty.last_step, uncertainty.last_step), uncertainty.given_lens
    fit, untested, shutter = uncertainty.lens_fit, uncertainty.untested_lens, uncertainty.shutter
    told = uncertainty.covariance[:6, :6] if untested is None else untested
    cropped = uncertainty.if_cropped
    if verdict.reason is Reason.FOCAL_UNCERTAIN and cropped and np.trace(cropped.covariance) > np.trace(told):
        told = cropped.covariance + np.outer(cropped.step, cropped.step)
    # Exact intrinsics are no unknowns of the covariance.
    sigmas = np.sqrt(uncertainty.covariance.diagonal()[6:]).tolist() or [0.0] * 4
    return replace(
        verdict,
        covariance=told + step,
        intrinsics_untested=untested is not None,
        shutter_motion=shutter and (shutter.shear, shutter.stretch),
        covariance_given_lens=None if given_lens is None else given_lens + step,
        correction_sigma=(sigmas[0], sigmas[1], sigmas[2], sigmas[3]),
        fitting_correction=fit.correction if fit and fit.contradicts else None,
    )
