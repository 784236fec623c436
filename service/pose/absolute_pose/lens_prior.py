"""The prior on an approximate camera, as estimators of pose and intrinsics use it.

Of `LensPrior`, the scale s of a component with heavy tails enters least squares by its weight 1 / (s^2 + d^2) at a
distance d from the centre: a normal distribution's near it, and ever less beyond (iteratively reweighted, Cauchy's
distribution but for a factor).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.types import IntrinsicsCorrection, LensPrior

SIZE = 4
"""Length of a `correction_vector`."""
FOCAL, K1, SHIFT = 0, 1, slice(2, 4)
"""Places of its components: log focal factor, radial distortion, shift of the principal point in long sides."""


@dataclass(frozen=True, slots=True)
class CorrectionBounds:
    """Largest components of a correction: one that goes further has diverged."""

    log_focal: float = 2.3
    k1: float = 0.4
    shift: float = 0.6

    @property
    def vector(self) -> Float64[np.ndarray, "4"]:
        """The bounds in the order of `correction_vector`."""
        return np.array([self.log_focal, self.k1, self.shift, self.shift])


BOUNDS = CorrectionBounds()


def correction_vector(correction: IntrinsicsCorrection) -> Float64[np.ndarray, "4"]:
    """Return (log focal factor, k1, shift x, shift y): zeros at the given intrinsics; shifts in long sides."""
    return np.array([np.log(correction.focal_factor), correction.k1, correction.shift_x, correction.shift_y])


def correction_of(vector: Float64[np.ndarray, "4"]) -> IntrinsicsCorrection:
    """Return the correction with these components, clipped to BOUNDS."""
    log_focal, k1, shift_x, shift_y = np.clip(vector, -BOUNDS.vector, BOUNDS.vector).tolist()
    return IntrinsicsCorrection(float(np.exp(log_focal)), shift_x, shift_y, k1)


def at_bounds(correction: IntrinsicsCorrection) -> bool:
    """Return whether a component was clipped, so that the true one may lie beyond."""
    return bool((np.abs(correction_vector(correction)) > 0.999 * BOUNDS.vector).any())


def stepped(correction: IntrinsicsCorrection, step: Float64[np.ndarray, "4"]) -> IntrinsicsCorrection:
    """Return the correction after a step of its `correction_vector`."""
    return correction_of(correction_vector(correction) + step)


def prior_precision(prior: LensPrior, correction: IntrinsicsCorrection) -> Float64[np.ndarray, "4"]:
    """Return the weights of the prior's four observations, that each component is zero, at this correction."""
    squared = _scales(prior) ** 2
    distance = correction_vector(correction)
    # The distortion's prior is normal: its weight is the same everywhere.
    distance[K1] = 0.0
    return 1.0 / (squared + distance**2)


def prior_cost(prior: LensPrior, correction: IntrinsicsCorrection) -> float:
    """Return twice the negative logarithm of the prior's density, less its least value."""
    squared = (correction_vector(correction) / _scales(prior)) ** 2
    return float(np.log1p(squared[FOCAL]) + squared[K1] + np.log1p(squared[SHIFT]).sum())


def _scales(prior: LensPrior) -> Float64[np.ndarray, "4"]:
    shift = prior.principal_point_scale
    return np.array([prior.log_focal_scale, prior.k1_sigma, shift, shift])
