"""From the share of degraded renders that are found to the probability that a real photo is: logistic calibration.

    logit p = offset + slope * logit(share)

(Platt, "Probabilistic outputs for support vector machines", 1999.) A render shows the scene exactly as it is stored; a
photo differs from it by what was changed, moved, lit otherwise, or reconstructed badly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

MIN_PHOTOS = 4
"""Held-out photos, below which nothing is calibrated."""


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """Normal distributions of offset and slope before a scene's own photos are known."""

    offset: float = 0.0
    slope: float = 1.0
    offset_sigma: float = 1.5
    slope_sigma: float = 0.3


PRIOR = CalibrationPrior()
_WIDE = 5.0
"""Standard deviation of weights of which nothing is known: only keeps them finite where one outcome is missing."""
_SHARES = (0.01, 0.99)
"""Shares are kept within: a kernel over a few trials can't tell them from 0 and 1."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """A fitted calibration: logit p = offset + slope * logit(share)."""

    offset: float = 0.0
    slope: float = 1.0
    photos: int = 0
    """Held-out photos that it was fitted on; 0: it changes nothing, and the map is an upper bound."""
    brier: float | None = None
    """Mean squared difference of probability and outcome of these photos, each left out of its own fit."""

    def applied(self, shares: Float64[np.ndarray, "k"]) -> Float64[np.ndarray, "k"]:
        """Return the probability (0..1) for each share of renders found: the share itself where nothing was fitted."""
        if not self.photos:
            return shares
        return _sigmoid(self.offset + self.slope * _logit(shares))


def calibrated(
    shares: Float64[np.ndarray, "k"], found: Bool[np.ndarray, "k"], prior: CalibrationPrior = PRIOR
) -> Calibration:
    """Fit the calibration to held-out photos: the share of renders found near each, and whether it was found.

    Maximum a posteriori, by Newton's method; nothing is changed where there are fewer than MIN_PHOTOS.
    """
    # With its prior the fit exists for a single photo, too, but the map would be called calibrated by next to nothing.
    if len(shares) < MIN_PHOTOS:
        return Calibration()
    offset, slope = _fit(shares, found, prior)
    return Calibration(offset, slope, len(shares), brier_score(left_out(shares, found, prior), found))


def left_out(
    shares: Float64[np.ndarray, "k"], found: Bool[np.ndarray, "k"], prior: CalibrationPrior = PRIOR
) -> Float64[np.ndarray, "k"]:
    """Return each photo's probability by the fit to the others."""
    result = np.empty(len(shares))
    for i in range(len(shares)):
        others = np.arange(len(shares)) != i
        offset, slope = _fit(shares[others], found[others], prior)
        result[i] = _sigmoid(offset + slope * _logit(shares[i : i + 1]))[0]
    return result


def brier_score(probabilities: Float64[np.ndarray, "k"], found: Bool[np.ndarray, "k"]) -> float:
    """Return the mean squared difference of probability and outcome: 0 is perfect, 0.25 is that of always 0.5."""
    return float(np.mean((probabilities - found) ** 2))


def fitted_line(
    x: Float64[np.ndarray, "k"], found: Bool[np.ndarray, "k"]
) -> Callable[[Float64[np.ndarray, "n"]], Float64[np.ndarray, "n"]]:
    """Return the logistic regression of an outcome on one variable, as a function of that variable."""
    offset, slope = _maximum(np.stack([np.ones(len(x)), x], 1), found, np.zeros(2), np.full(2, _WIDE))
    return lambda values: _sigmoid(offset + slope * values)


def _fit(
    shares: Float64[np.ndarray, "k"], found: Bool[np.ndarray, "k"], prior: CalibrationPrior
) -> tuple[float, float]:
    design = np.stack([np.ones(len(shares)), _logit(shares)], 1)
    mean, sigma = np.array([prior.offset, prior.slope]), np.array([prior.offset_sigma, prior.slope_sigma])
    offset, slope = _maximum(design, found, mean, sigma)
    return float(offset), float(slope)


def _maximum(
    design: Float64[np.ndarray, "k d"],
    found: Bool[np.ndarray, "k"],
    mean: Float64[np.ndarray, "d"],
    sigma: Float64[np.ndarray, "d"],
) -> Float64[np.ndarray, "d"]:
    """Return the weights of a logistic regression with a normal prior, by damped Newton steps."""
    precision, at = np.diag(sigma**-2), mean.copy()
    # The posterior is log-concave: so many steps reach its maximum to many digits.
    for _ in range(50):
        p = _sigmoid(design @ at)
        gradient = design.T @ (found - p) - precision @ (at - mean)
        hessian = (design * (p * (1 - p))[:, None]).T @ design + precision
        # Where the sigmoid is flat a full Newton step overshoots: no weight moves by more than 1 at once.
        step = np.linalg.solve(hessian, gradient)
        at = at + step / max(1.0, float(np.abs(step).max()))
    return at


def _logit(shares: Float64[np.ndarray, "k"]) -> Float64[np.ndarray, "k"]:
    clipped = np.clip(shares, *_SHARES)
    return np.log(clipped / (1 - clipped))


def _sigmoid(x: Float64[np.ndarray, "k"]) -> Float64[np.ndarray, "k"]:
    return 1 / (1 + np.exp(-x))
