"""The uncertainty of a pose from one photo and a frame rendered nearby: covariance, and last Gauss-Newton step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from service.geometry import se3_log
from service.interfaces import Frame
from service.pose.absolute_pose.lens_prior import prior_precision
from service.pose.refinement.covariance import inverse_spd, jackknife_variance_scale, scores_by_cell
from service.pose.refinement.gauss_newton import minimize
from service.pose.refinement.photometric import RefinementResult
from service.pose.refinement.pyramid_level import (
    CORRECTION,
    NEUTRAL,
    TWIST,
    PyramidLevel,
    RefinementState,
    linearized_levels,
)
from service.pose.refinement.refinement_config import REFINEMENT, RefinementConfig
from service.types import NO_CORRECTION, Camera, IntrinsicsCorrection, LensPrior

FOCAL = CORRECTION.start
"""Place of log focal in the vector of unknowns."""


@dataclass(frozen=True, slots=True)
class PoseUncertainty:
    last_step: Float64[np.ndarray, "6"]
    """The right twist (rad, scene units) by which refinement would still move the pose: refined = pose @ exp(twist)."""
    covariance: Float64[np.ndarray, "k k"]
    """Of the right twist, true = pose @ exp(twist); with an approximate camera also of its `correction_vector`."""
    focal_step: float
    """By how much the logarithm of the focal length would change if it were free..."""
    focal_sigma: float
    """...and the standard deviation of that; infinite where the pixels don't determine it."""


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
    if not np.isfinite(minimize(level, state, config.settled_px, config)):
        return None
    last_step = se3_log(before @ np.linalg.inv(state.photo_from_render))
    scores, hessians, scale = _scores(level, state, frame, config)
    hessian = hessians.sum(0)
    covariance = _covariance(hessian, scale, lens_prior, correction)
    if covariance is None:
        return None
    focal_step, focal_error = _focal(level, state, scores, hessian, lens_prior, config)
    return PoseUncertainty(last_step, covariance, focal_step, focal_error)


def _scores(
    level: PyramidLevel, state: RefinementState, frame: Frame, config: RefinementConfig
) -> tuple[Float64[np.ndarray, "cells 14"], Float64[np.ndarray, "cells 14 14"], float]:
    """Return the cells' scores and hessians at the state, and the variance scale of the unknowns but the correction."""
    residuals, weights, _ = level.residuals(state, config)
    jacobian = level.jacobian * state.factors[:, None].astype(np.float32)
    inner = (frame.alpha.shape[0] - 2, frame.alpha.shape[1] - 2)
    uncertainty = config.uncertainty
    scores, hessians, places = scores_by_cell(
        jacobian, weights, residuals, level.pixels, inner, config.l1_floor, uncertainty.cell_px
    )
    # Of twist and photometric parameters alone: with exact intrinsics the correction isn't an unknown.
    found = jackknife_variance_scale(scores[:, :FOCAL], hessians[:, :FOCAL, :FOCAL], places, uncertainty)
    return scores, hessians, uncertainty.variance_share * max(found, uncertainty.min_variance_scale)


def _focal(
    level: PyramidLevel,
    state: RefinementState,
    scores: Float64[np.ndarray, "cells 14"],
    hessian: Float64[np.ndarray, "14 14"],
    lens_prior: LensPrior | None,
    config: RefinementConfig,
) -> tuple[float, float]:
    """Return the step of log focal, were it free, and its standard deviation."""
    uncertainty = config.uncertainty
    inverse = inverse_spd(hessian[: FOCAL + 1, : FOCAL + 1])
    if inverse is None:  # a flat wall seen straight on doesn't determine it
        return 0.0, np.inf
    focal_step = float((inverse @ scores.sum(0)[: FOCAL + 1])[-1])
    if not lens_prior and abs(focal_step) > uncertainty.suspicious_focal_step:
        # From a pose that makes up for a wrong focal length one step leads only a fifth of the way.
        prior = LensPrior(uncertainty.free_focal_sigma)
        free = replace(state, prior=prior, photometric=state.photometric.copy())
        minimize(level, free, config.settled_px, config)
        focal_step = float(np.log(free.correction.focal_factor))
    # A wrong focal length makes residuals that are correlated over quarters, so only the cells' scatter is used here.
    sigma = uncertainty.focal_inflation * float(np.linalg.norm(scores[:, : FOCAL + 1] @ inverse[-1]))
    return focal_step, sigma


def _covariance(
    hessian: Float64[np.ndarray, "14 14"],
    scale: float,
    lens_prior: LensPrior | None,
    correction: IntrinsicsCorrection,
) -> Float64[np.ndarray, "k k"] | None:
    """Return the covariance of the twist, with an approximate camera also of its correction.

    The photometric parameters are marginalized. None if it isn't positive definite.
    """
    if not np.isfinite(scale):
        return None
    if lens_prior is None:
        found = inverse_spd(hessian[:FOCAL, :FOCAL])
        return None if found is None else scale * found[TWIST, TWIST]
    information = hessian / scale
    # A prior is information: added before the photometric parameters are marginalized.
    information[CORRECTION, CORRECTION] += np.diag(prior_precision(lens_prior, correction))
    keep = np.r_[TWIST, CORRECTION]
    found = inverse_spd(information)
    return None if found is None else found[np.ix_(keep, keep)]
