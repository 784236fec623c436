"""Variance of refined unknowns from one photo: scores of image cells, and the jackknife over quarters of the image.

The score of the unknowns (jacobian . weight . residual, summed over pixels) has the variance s H, where H is the
hessian; the covariance is s H^-1. With independent residuals s would follow from their size. But a model's errors are
correlated over large parts of the image (White's sandwich with blocks of 16 px, and Liang and Zeger's clusters, find a
tenth to a quarter of the true squared error), and fitting hides them where the parts are few and large. So s is from
the jackknife: without a quarter of the photo's information the unknowns move by d, and

    s = mean over cuts of sum over quarters d^T H d / unknowns

This gives each quarter the weight that it has (the moves exceed the errors where a quarter holds much information). It
is the mean over eight cuts, because one alone has few degrees of freedom. Only the scale is the jackknife's, the shape
is H's: four quarters don't determine a 6x6 matrix.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from service.pose.refinement.kernels import sum_scores_by_cell
from service.pose.refinement.refinement_config import UncertaintyConfig


def scores_by_cell(
    jacobian: Float32[np.ndarray, "k n"],
    weights: Float32[np.ndarray, "n"],
    residuals: Float32[np.ndarray, "n"],
    pixels: Int64[np.ndarray, "n"],
    shape: tuple[int, int],
    l1_floor: float,
    cell_px: int,
) -> tuple[Float64[np.ndarray, "cells k"], Float64[np.ndarray, "cells k k"], Float64[np.ndarray, "cells 2"]]:
    """Return scores, hessians and (row, column) places of the square cells of an image that have pixels.

    `pixels` index an image of `shape` (rows, columns), row by row. The loss has curvature only at residuals below
    `l1_floor`: the weights of the others would overstate it.
    """
    across = -(-shape[1] // cell_px)
    count = across * -(-shape[0] // cell_px)
    scores, hessians, used = sum_scores_by_cell(
        jacobian, weights, residuals, pixels, shape[1], cell_px, count, l1_floor
    )
    cells = np.flatnonzero(used)
    return scores[cells], hessians[cells], np.stack(np.divmod(cells, across), 1).astype(np.float64)


def jackknife_variance_scale(
    scores: Float64[np.ndarray, "cells k"],
    hessians: Float64[np.ndarray, "cells k k"],
    places: Float64[np.ndarray, "cells 2"],
    config: UncertaintyConfig,
) -> float:
    """Return s, the factor from the inverse hessian to the covariance; infinite where the hessian is singular."""
    hessian = hessians.sum(0)
    # Unknowns differ by orders of magnitude: scaled to a unit diagonal, the hessian is well conditioned.
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    hessians, scores, hessian = hessians * np.outer(scale, scale), scores * scale, hessian * np.outer(scale, scale)
    try:
        # A cell's share of the information, trace(H_cell H^-1); the shares add up to the number of unknowns.
        information = np.einsum("cij,ji->c", hessians, np.linalg.inv(hessian))
        quarters = _quarters(places, np.maximum(information, 0.0), config.cuts).astype(np.float64)
        # The unknowns move by (H - H_quarter)^-1 score_quarter where a quarter is left out.
        left = (1 + config.ridge) * hessian - np.tensordot(quarters, hessians, 1)
        moves = np.linalg.solve(left, (quarters @ scores)[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return np.inf
    found = float(np.einsum("qi,ij,qj->", moves, hessian, moves)) / len(hessian) / (2 * config.cuts)
    return found if np.isfinite(found) else np.inf


def inverse_spd(hessian: Float64[np.ndarray, "k k"]) -> Float64[np.ndarray, "k k"] | None:
    """Return the inverse, exactly symmetric; None if the matrix isn't positive definite."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    try:
        # By the Cholesky factor: it fails where the matrix isn't positive definite.
        half = np.linalg.inv(np.linalg.cholesky(hessian * np.outer(scale, scale))) * scale
        result = half.T @ half
    except np.linalg.LinAlgError:
        return None
    return result if np.all(np.isfinite(result)) else None


def _quarters(
    places: Float64[np.ndarray, "cells 2"], information: Float64[np.ndarray, "cells"], cuts: int
) -> Bool[np.ndarray, "quarters cells"]:
    """Return, for each of 2 * `cuts` cuts, four parts with about the same information each."""
    parts = []
    for angle in 0.5 * np.pi / cuts * np.arange(2 * cuts):
        along, across = places @ [np.cos(angle), np.sin(angle)], places @ [-np.sin(angle), np.cos(angle)]
        first = along > _weighted_median(along, information)
        # Each half is cut at its own median, so that all quarters hold the same.
        for half in (first, ~first):
            beyond = across > _weighted_median(across, information * half)
            parts += [half & beyond, half & ~beyond]
    return np.stack(parts)


def _weighted_median(values: Float64[np.ndarray, "n"], weights: Float64[np.ndarray, "n"]) -> float:
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])])
