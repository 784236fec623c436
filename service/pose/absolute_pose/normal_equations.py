"""Robust normal equations of a pose and a lens: what the fits of all lens models share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from service.pose.absolute_pose.lens_prior import correction_vector, prior_cost, prior_precision
from service.types import IntrinsicsCorrection, LensPrior


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Of the right twist and the correction, with the prior on the correction."""

    cost: float
    hessian: Float64[np.ndarray, "10 10"]
    rhs: Float64[np.ndarray, "10"]
    weight: Float64[np.ndarray, "m"]
    """Of each correspondence, per squared pixel."""
    error: Float64[np.ndarray, "m"]
    """Reprojection error in standard deviations; infinite behind the camera."""


def normal_equations(
    jacobian: Float64[np.ndarray, "m 2 10"],
    residual: Float64[np.ndarray, "m 2"],
    ahead: Bool[np.ndarray, "m"],
    noise_px: float,
    scale: float,
    prior: LensPrior,
    correction: IntrinsicsCorrection,
) -> NormalEquations:
    """Weigh reprojection errors by Cauchy's function and add the prior as four more observations.

    `noise_px` is the standard deviation of a right correspondence, `scale` that of the weights in these deviations.
    """
    squared = (residual**2).sum(1) / noise_px**2
    # Points behind the camera cost as much as an outlier at a hundred scales, and pull nowhere.
    squared[~ahead] = (100.0 * scale) ** 2
    weight = np.where(ahead, 1.0 / (1.0 + squared / scale**2), 0.0) / noise_px**2
    rows = jacobian.reshape(-1, 10)
    weighted = rows * np.repeat(weight, 2)[:, None]
    hessian, rhs = weighted.T @ rows, weighted.T @ residual.reshape(-1)
    precision = prior_precision(prior, correction)
    hessian[range(6, 10), range(6, 10)] += precision
    rhs[6:] -= precision * correction_vector(correction)
    cost = scale**2 * float(np.log1p(squared / scale**2).sum()) + prior_cost(prior, correction)
    return NormalEquations(cost, hessian, rhs, weight, np.where(ahead, np.sqrt(squared), np.inf))
