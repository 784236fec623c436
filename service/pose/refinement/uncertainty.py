"""The uncertainty of a pose from one photo and a frame rendered nearby: covariance, and last Gauss-Newton step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from service.geometry import se3_log
from service.interfaces import Frame
from service.pose.absolute_pose.lens_prior import SHIFT, correction_vector, prior_precision
from service.pose.refinement.covariance import inverse_spd, jackknife_variance_scale, scores_by_cell
from service.pose.refinement.gauss_newton import minimize
from service.pose.refinement.lens_test import LensFit, fit_lens
from service.pose.refinement.photometric import RefinementResult
from service.pose.refinement.pyramid_level import (
    CORRECTION,
    NEUTRAL,
    TWIST,
    PyramidLevel,
    RefinementState,
    linearized_levels,
)
from service.pose.refinement.refinement_config import (
    REFINEMENT,
    LensErrorConfig,
    LensTestConfig,
    RefinementConfig,
)
from service.pose.refinement.rolling_shutter import ShutterMotion, shutter_motion, with_shutter_rows
from service.types import NO_CORRECTION, UNKNOWN_PRINCIPAL_POINT, Camera, IntrinsicsCorrection, LensPrior

FOCAL = CORRECTION.start
"""Place of log focal in the vector of unknowns."""


@dataclass(frozen=True, slots=True)
class PoseIfCropped:
    """The pose if the principal point may be anywhere, as in a photo that was cropped off centre."""

    covariance: Float64[np.ndarray, "6 6"]
    """Of the right twist."""
    step: Float64[np.ndarray, "6"]
    """The right twist (rad, scene units) that refinement with such a prior would begin with."""
    significance: float
    """The square of that step of all unknowns in standard deviations."""


@dataclass(frozen=True, slots=True)
class PoseUncertainty:
    """How well a photo determines a refined pose: the step that is left, and the covariance."""

    last_step: Float64[np.ndarray, "6"]
    """The right twist (rad, scene units) by which refinement would still move the pose: refined = pose @ exp(twist)."""
    covariance: Float64[np.ndarray, "k k"]
    """Of the right twist, true = pose @ exp(twist); with an approximate camera also of its `correction_vector`."""
    given_lens: Float64[np.ndarray, "6 6"] | None = None
    """Covariance of the twist if the intrinsics were known; None: they are."""
    if_cropped: PoseIfCropped | None = None
    """Of approximate intrinsics; None: they are exact, or the principal point is from a good source."""
    focal_step: float = 0.0
    """By how much the logarithm of an approximate focal length would still change."""
    lens_fit: LensFit | None = None
    """Of exact intrinsics: others that fit the photo, where these would move the pose; None: there are none."""
    untested_lens: Float64[np.ndarray, "6 6"] | None = None
    """Of exact intrinsics that the photo can't confirm: the covariance of the twist if they are a little off."""
    shutter: ShutterMotion | None = None
    """Of a camera that turned while the photo was taken; the covariance includes it. None: it shows no such motion."""
    loss: float = 0.0
    """Mean absolute residual (0..1) at the answer."""


def pose_uncertainty(
    photo: UInt8[np.ndarray, "h w 3"],
    frame: Frame,
    camera: Camera,
    answer: Camera,
    lens_prior: LensPrior | None,
    valid_mask: Bool[np.ndarray, "h w"] | None = None,
    result: RefinementResult | None = None,
    config: RefinementConfig = REFINEMENT,
) -> PoseUncertainty | None:
    """Estimate the uncertainty of `answer` from the frame, which `camera` rendered nearby, at the photo's full size.

    The shape of the covariance is the inverse hessian's, its scale the jackknife's (see `covariance`). The frame is
    linearized anew unless `result` is the refinement on this very frame that led to the answer. None where the pixels
    don't determine the pose.
    """
    final = result.final_level if result else None
    if final:
        level, photometric = final.level, final.photometric
    else:
        (level,) = linearized_levels(
            photo, valid_mask, frame, camera.intrinsics, answer.intrinsics, 1, bool(lens_prior), config
        )
        photometric = NEUTRAL
    before = answer.pose.camera_from_world @ camera.pose.world_from_camera
    # The level of a refinement has the photo as it is, else photo and camera are corrected already.
    correction = result.correction if result and final else NO_CORRECTION
    state = RefinementState(before, correction, None, photometric.copy())
    loss = minimize(level, state, config.settled_px, config)
    if not np.isfinite(loss):
        return None
    last_step = se3_log(before @ np.linalg.inv(state.photo_from_render))
    score, hessian, scale = _normal_equations(level, state, frame, config)
    if lens_prior is None:
        found = _with_exact_lens(level, state, hessian, scale, config)
    else:
        focal_lengths = answer.intrinsics.fx / answer.intrinsics.long_side
        found = _with_estimated_lens(hessian, score, scale, lens_prior, correction, focal_lengths, config)
    if found is None:
        return None
    information = hessian if lens_prior is None else _with_prior(hessian, scale, lens_prior, correction)
    # After the lens: where that is estimated it takes up a part of the motion.
    shutter = shutter_motion(information, score, scale, lens_prior is not None, config.shutter)
    found = replace(found, last_step=last_step, shutter=shutter, loss=loss)
    if shutter is None:
        return found
    motion = config.shutter.uncertainty_factor * shutter.motion
    return _with_shutter(found, np.outer(motion, motion) + shutter.covariance)


def refinement_covariance(
    result: RefinementResult, frame: Frame, camera: Camera, config: RefinementConfig = REFINEMENT
) -> Float64[np.ndarray, "6 6"] | None:
    """Return the covariance of the right twist that a refinement on a frame led to, given the intrinsics.

    `camera` rendered the frame. By the pixels alone, without what is added for errors that no photo shows. None:
    undetermined.
    """
    final = result.final_level
    if final is None:
        return None
    photo_from_render = result.pose.camera_from_world @ camera.pose.world_from_camera
    state = RefinementState(photo_from_render, result.correction, None, final.photometric.copy())
    _, hessian, scale = _normal_equations(final.level, state, frame, config)
    return _covariance(hessian[:FOCAL, :FOCAL], scale)


def _with_exact_lens(
    level: PyramidLevel,
    state: RefinementState,
    hessian: Float64[np.ndarray, "16 16"],
    scale: float,
    config: RefinementConfig,
) -> PoseUncertainty | None:
    covariance = _covariance(hessian[:FOCAL, :FOCAL], scale)
    if covariance is None:
        return None
    of_lens = slice(0, CORRECTION.stop)
    information = _with_prior(hessian, scale, config.lens_test.prior, NO_CORRECTION)[of_lens, of_lens]
    free = inverse_spd(information)
    lens_fit = fit_lens(level, state, config)
    # Beside the covariance, not in it: the gate trusts exact intrinsics, whoever uses the pose should know of the rest.
    untested = _covariance_of_untested_lens(level, hessian, scale, free, config.lens_test)
    return PoseUncertainty(np.zeros(6), covariance, lens_fit=lens_fit, untested_lens=untested)


def _with_estimated_lens(
    hessian: Float64[np.ndarray, "16 16"],
    score: Float64[np.ndarray, "16"],
    scale: float,
    lens_prior: LensPrior,
    correction: IntrinsicsCorrection,
    focal_lengths: float,
    config: RefinementConfig,
) -> PoseUncertainty | None:
    """`focal_lengths`: the focal length, in long sides."""
    of_lens = slice(0, CORRECTION.stop)
    # A prior is information: added before the photometric parameters are marginalized.
    covariance = _covariance(_with_prior(hessian, scale, lens_prior, correction)[of_lens, of_lens], scale)
    if covariance is None:
        return None
    error = config.lens_error
    shift = error.principal_point * focal_lengths
    errors = np.array([error.log_focal, error.k1, shift, shift])
    covariance = _with_lens_error(covariance, errors, 1.0 / prior_precision(lens_prior, correction))
    given_lens = _covariance(hessian[:FOCAL, :FOCAL], scale)
    return PoseUncertainty(
        np.zeros(6),
        covariance,
        given_lens,
        _pose_if_cropped(hessian, score, scale, lens_prior, correction, error),
        _focal_step(hessian, score),
    )


def _pose_if_cropped(
    hessian: Float64[np.ndarray, "16 16"],
    score: Float64[np.ndarray, "16"],
    scale: float,
    lens_prior: LensPrior,
    correction: IntrinsicsCorrection,
    error: LensErrorConfig,
) -> PoseIfCropped | None:
    """Return covariance and next step of the pose with a prior on the principal point that is as wide as crops are.

    The usual prior's tails are broad, but an estimate near its centre looks certain even where another rotation with
    another principal point fits as well, or better: what is seen is nearly a plane.
    """
    if lens_prior.principal_point_scale < UNKNOWN_PRINCIPAL_POINT:
        return None
    precision, distance = prior_precision(lens_prior, correction), correction_vector(correction)
    precision[SHIFT] = 1.0 / error.crop_scale**2
    of_lens = slice(0, CORRECTION.stop)
    information, pull = hessian[of_lens, of_lens].copy(), score[of_lens].copy()
    information[CORRECTION, CORRECTION] += scale * np.diag(precision)
    pull[CORRECTION] -= scale * precision * distance
    inverse = inverse_spd(information)
    if inverse is None:
        return None
    step = inverse @ pull
    return PoseIfCropped(scale * inverse[TWIST, TWIST], step[TWIST], float(step @ pull) / scale)


def _with_shutter(found: PoseUncertainty, added: Float64[np.ndarray, "6 6"]) -> PoseUncertainty:
    """Return the uncertainty with this covariance of the twist added."""
    covariance = found.covariance.copy()
    covariance[:6, :6] += added
    known, untested = found.given_lens, found.untested_lens
    return replace(
        found,
        covariance=covariance,
        given_lens=None if known is None else known + added,
        untested_lens=None if untested is None else untested + added,
    )


def _normal_equations(
    level: PyramidLevel, state: RefinementState, frame: Frame, config: RefinementConfig
) -> tuple[Float64[np.ndarray, "16"], Float64[np.ndarray, "16 16"], float]:
    """Return score and hessian at the state, with shear and stretch, and the variance scale.

    The scale is that of twist and photometric parameters: with exact intrinsics the correction isn't an unknown.
    """
    residuals, weights, _ = level.residuals(state, config)
    jacobian = with_shutter_rows(level, level.jacobian * state.factors[:, None].astype(np.float32))
    inner = (frame.alpha.shape[0] - 2, frame.alpha.shape[1] - 2)
    uncertainty = config.uncertainty
    scores, hessians, places = scores_by_cell(
        jacobian, weights, residuals, level.pixels, inner, config.l1_floor, uncertainty.cell_px
    )
    found = jackknife_variance_scale(scores[:, :FOCAL], hessians[:, :FOCAL, :FOCAL], places, uncertainty)
    scale = max(found, uncertainty.min_variance_scale)
    return scores.sum(0), hessians.sum(0), scale


def _focal_step(hessian: Float64[np.ndarray, "16 16"], score: Float64[np.ndarray, "16"]) -> float:
    """Return the step of log focal, distortion and pose free; 0 where the pixels don't determine it."""
    free = FOCAL + 2
    inverse = inverse_spd(hessian[:free, :free])
    return 0.0 if inverse is None else float((inverse @ score[:free])[FOCAL])


def _covariance_of_untested_lens(
    level: PyramidLevel,
    hessian: Float64[np.ndarray, "16 16"],
    scale: float,
    free: Float64[np.ndarray, "14 14"] | None,
    config: LensTestConfig,
) -> Float64[np.ndarray, "6 6"] | None:
    """Return the covariance of the twist with the intrinsics as uncertain as `config.untested`.

    `free` is the inverse hessian with free intrinsics. None where these hardly make the position less certain: then
    the photo tells them.
    """
    depth = float(np.median(level.points[2]))
    if free is not None and np.sqrt(scale * np.trace(free[3:6, 3:6])) < config.untestable_share * depth:
        return None
    of_lens = slice(0, CORRECTION.stop)
    covariance = _covariance(_with_prior(hessian, scale, config.untested, NO_CORRECTION)[of_lens, of_lens], scale)
    return None if covariance is None else covariance[:6, :6]


def _with_prior(
    hessian: Float64[np.ndarray, "16 16"], scale: float, prior: LensPrior, correction: IntrinsicsCorrection
) -> Float64[np.ndarray, "16 16"]:
    """Return the information of pixels and prior; `scale` is that of the pixels' variance."""
    information = hessian.copy()
    # The diagonal alone: an infinite scale would make the rest of a matrix undefined.
    of_lens = np.arange(CORRECTION.start, CORRECTION.stop)
    information[of_lens, of_lens] += scale * prior_precision(prior, correction)
    return information


def _with_lens_error(
    covariance: Float64[np.ndarray, "10 10"], errors: Float64[np.ndarray, "4"], prior_variance: Float64[np.ndarray, "4"]
) -> Float64[np.ndarray, "10 10"]:
    """Return the covariance with independent errors of the intrinsics, which the pose follows as it says, added.

    No more than makes the intrinsics as uncertain as before: the prior from other photos includes their errors.
    """
    by_lens = np.linalg.solve(covariance[6:, 6:], covariance[6:]).T
    left = np.maximum(prior_variance - covariance.diagonal()[6:], 0.0)
    return covariance + by_lens * np.minimum(errors**2, left) @ by_lens.T


def _covariance(information: Float64[np.ndarray, "n n"], scale: float) -> Float64[np.ndarray, "k k"] | None:
    """Return the covariance of the twist and, if it is among the unknowns, the correction.

    The photometric parameters are marginalized. None if it isn't positive definite.
    """
    found = inverse_spd(information) if np.isfinite(scale) else None
    keep = np.r_[TWIST, CORRECTION] if len(information) > FOCAL else np.r_[TWIST]
    return None if found is None else scale * found[np.ix_(keep, keep)]
