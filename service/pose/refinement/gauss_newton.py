"""Gauss-Newton with iteratively reweighted residuals on one level of the pyramid."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32, Float64

from service.geometry import se3_exp
from service.pose.absolute_pose.lens_prior import FOCAL, K1, SHIFT, correction_vector, prior_precision, stepped
from service.pose.refinement.kernels import damped_solution, normal_equations
from service.pose.refinement.pyramid_level import CORRECTION, PHOTOMETRIC, TWIST, PyramidLevel, RefinementState
from service.pose.refinement.refinement_config import RefinementConfig
from service.types import Intrinsics


def minimize(level: PyramidLevel, state: RefinementState, settled_px: float, config: RefinementConfig) -> float:
    """Minimize the level's robust photometric error, changing `state`; return its mean absolute residual (0..1).

    Steps end when one moves the image by less than `settled_px` pixels of the level, or after `max_steps`. Infinite
    where too few pixels overlap, or the normal equations can't be solved.
    """
    if len(level.pixels) < config.min_pixels:
        return np.inf
    typical_depth = float(np.median(level.points[2]))
    loss = np.inf
    for _ in range(config.max_steps):
        residuals, weights, loss = level.residuals(state, config)
        if not np.isfinite(loss):
            return np.inf
        step = _step(level.jacobian, residuals, weights, state, loss, config)
        if not np.all(np.isfinite(step)):
            return np.inf
        # Inverse compositional: the step moves the render, so the photo moves by its inverse.
        state.photo_from_render = state.photo_from_render @ se3_exp(-step[TWIST])
        state.photometric += step[PHOTOMETRIC]
        if state.prior:
            state.correction = stepped(state.correction, step[CORRECTION])
        if _motion_px(step, level.photo_intrinsics, typical_depth) < settled_px:
            break
    return loss


def _motion_px(step: Float64[np.ndarray, "14"], intrinsics: Intrinsics, depth: float) -> float:
    """Return an upper bound of the image motion by a step, in pixels, at this depth."""
    twist, correction = step[TWIST].tolist(), step[CORRECTION].tolist()
    # Of focal length and distortion at the end of the longer side.
    radius = 0.5 * intrinsics.long_side / intrinsics.fx
    magnified = radius * abs(correction[FOCAL]) + radius**3 * abs(correction[K1])
    shifted = intrinsics.long_side * max(map(abs, correction[SHIFT]))
    moved = math.hypot(*twist[:3]) + math.hypot(*twist[3:]) / depth + magnified
    return intrinsics.fx * moved + shifted


def _step(
    jacobian: Float32[np.ndarray, "14 n"],
    residuals: Float32[np.ndarray, "n"],
    weights: Float32[np.ndarray, "n"],
    state: RefinementState,
    loss: float,
    config: RefinementConfig,
) -> Float64[np.ndarray, "14"]:
    """Solve the weighted normal equations; zeros for unknowns that are not estimated.

    Each unknown is scaled by its hessian's diagonal first, for they differ by orders of magnitude.
    """
    if not state.prior:
        jacobian = jacobian[: CORRECTION.start]
    if not config.estimate_photometric:
        jacobian = jacobian.copy()
        jacobian[PHOTOMETRIC] = 0
    hessian, rhs = normal_equations(jacobian, weights, residuals, state.factors)
    if state.prior:
        # With L1 weights the hessian is about `loss` times the information, so the prior is scaled likewise.
        precision = config.correlated_pixels * loss * prior_precision(state.prior, state.correction)
        hessian[range(10, 14), range(10, 14)] += precision
        rhs[CORRECTION] -= precision * correction_vector(state.correction)
    step = np.zeros(14)
    # Damping keeps unknowns without any gradient in place, such as the blur of a flat render.
    step[: len(jacobian)] = damped_solution(hessian, rhs, 1e-6)
    return step
