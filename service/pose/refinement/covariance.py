"""How far an alignment errs, told from one photo: its residuals, the image cut in quarters, and what models have shown.

The score of the unknowns (columns . weight . residual, summed over pixels) has the variance s H, where H is the
hessian; the covariance is s H^-1. With independent residuals s would be known from their size. But a model's errors
are alike over large parts of the image (White's sandwich with blocks of 16 px, Liang and Zeger's clusters, finds a
tenth to a quarter of the true squared error), and fitting hides them where there are few, large parts. So s is from
the jackknife: without a quarter of what the photo tells, the unknowns move by d,

    s = mean over cuts of sum over quarters d^T H d / unknowns

which grants each quarter the weight that it has (the moves exceed errors where a quarter tells much), and is the mean
over eight cuts, because one alone has few degrees of freedom. Only the size is taken from the jackknife; the shape is
H's: four quarters can't tell 36 numbers.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from service.jit import kernel

CELL_PX = 16
TURNS = 4
"""Of the cross that cuts the image in quarters, within a right angle; each is cut first one way, then the other."""
REMAINS = 1e-3
"""Share of the hessian that no quarter takes away, so that what is left can be solved."""


def summed_by_cell(
    columns: Float32[np.ndarray, "k n"],
    weights: Float32[np.ndarray, "n"],
    residuals: Float32[np.ndarray, "n"],
    pixels: Int64[np.ndarray, "n"],
    shape: tuple[int, int],
    bend: float,
) -> tuple[Float64[np.ndarray, "cells k"], Float64[np.ndarray, "cells k k"], Float64[np.ndarray, "cells 2"]]:
    """Return scores, hessians and places of the image's cells that have pixels; `pixels` count through `shape`.

    The loss is bent only where residuals are below `bend`: the weights of the others would overstate it.
    """
    across = -(-shape[1] // CELL_PX)
    count = across * -(-shape[0] // CELL_PX)
    sums, hessians, used = _sums(columns, weights, residuals, pixels, shape[1], CELL_PX, count, bend)
    cells = np.flatnonzero(used)
    return sums[cells], hessians[cells], np.stack(np.divmod(cells, across), 1).astype(np.float64)


def spread(
    scores: Float64[np.ndarray, "cells k"],
    hessians: Float64[np.ndarray, "cells k k"],
    places: Float64[np.ndarray, "cells 2"],
) -> float:
    """Return s; infinite where the hessian is singular."""
    hessian = hessians.sum(0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    hessians, scores, hessian = hessians * np.outer(scale, scale), scores * scale, hessian * np.outer(scale, scale)
    try:
        information = np.einsum("cij,ji->c", hessians, np.linalg.inv(hessian))
        quarters = _quarters(places, np.maximum(information, 0.0)).astype(np.float64)
        left = (1 + REMAINS) * hessian - np.tensordot(quarters, hessians, 1)
        moves = np.linalg.solve(left, (quarters @ scores)[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return np.inf
    found = float(np.einsum("qi,ij,qj->", moves, hessian, moves)) / len(hessian) / (2 * TURNS)
    return found if np.isfinite(found) else np.inf


def inverse(hessian: Float64[np.ndarray, "k k"]) -> Float64[np.ndarray, "k k"] | None:
    """Return the inverse, symmetric and positive definite; None if there is none such."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    try:
        half = np.linalg.inv(np.linalg.cholesky(hessian * np.outer(scale, scale))) * scale
        result = half.T @ half
    except np.linalg.LinAlgError:
        return None
    return result if np.all(np.isfinite(result)) else None


def _quarters(
    places: Float64[np.ndarray, "cells 2"], information: Float64[np.ndarray, "cells"]
) -> Bool[np.ndarray, "quarters cells"]:
    """Return, for each cut, the four parts, which hold about as much information each."""
    parts = []
    for angle in 0.5 * np.pi / TURNS * np.arange(2 * TURNS):
        along, across = places @ [np.cos(angle), np.sin(angle)], places @ [-np.sin(angle), np.cos(angle)]
        first = along > _middle(along, information)
        for half in (first, ~first):
            beyond = across > _middle(across, information * half)
            parts += [half & beyond, half & ~beyond]
    return np.stack(parts)


def _middle(values: Float64[np.ndarray, "n"], weights: Float64[np.ndarray, "n"]) -> float:
    """Return the weighted median."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])])


@kernel
def _sums(columns, weights, residuals, pixels, width, cell_px, count, bend):
    """Return each cell's sums of score and hessian, and how many pixels it has."""
    size = columns.shape[0]
    across = (width + cell_px - 1) // cell_px
    scores = np.zeros((count, size))
    hessians = np.zeros((count, size, size))
    used = np.zeros(count, np.int64)
    for i in range(len(pixels)):
        cell = pixels[i] // width // cell_px * across + pixels[i] % width // cell_px
        used[cell] += 1
        bent = abs(residuals[i]) < bend
        for a in range(size):
            weighted = columns[a, i] * weights[i]
            scores[cell, a] += weighted * residuals[i]
            if bent:
                for b in range(a + 1):
                    hessians[cell, a, b] += weighted * columns[b, i]
    for cell in range(count):
        for a in range(size):
            for b in range(a):
                hessians[cell, b, a] = hessians[cell, a, b]
    return scores, hessians, used
