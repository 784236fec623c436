"""What is known of an approximate camera before a photo is localized: normal priors on its intrinsics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.types import IntrinsicsCorrection


@dataclass(frozen=True, slots=True)
class IntrinsicsPrior:
    """Independent, zero-mean normal distributions of the three components of `correction_vector`."""

    focal_sigma: float
    """Standard deviation of the logarithm of the focal length."""
    principal_point_sigma: float = 0.007
    """Standard deviation of the principal point, in long sides of the image: phones and calibrated test cameras have
    0.001 to 0.03."""
    max_sigmas: float = 4.0
    """Bound on every component, in standard deviations: a correction that goes further has diverged."""

    @property
    def precision(self) -> Float64[np.ndarray, "3"]:
        """Inverse variances of `correction_vector`."""
        return self._sigmas**-2.0

    def stepped(self, correction: IntrinsicsCorrection, step: Float64[np.ndarray, "3"]) -> IntrinsicsCorrection:
        """Return the correction after a step of its `correction_vector`, clipped at `max_sigmas`."""
        bounds = self.max_sigmas * self._sigmas
        log_focal, shift_x, shift_y = np.clip(correction_vector(correction) + step, -bounds, bounds)
        return IntrinsicsCorrection(float(np.exp(log_focal)), float(shift_x), float(shift_y))

    @property
    def _sigmas(self) -> Float64[np.ndarray, "3"]:
        return np.array([self.focal_sigma, self.principal_point_sigma, self.principal_point_sigma])


def correction_vector(correction: IntrinsicsCorrection) -> Float64[np.ndarray, "3"]:
    """Return (log focal factor, shift x, shift y): zeros at the given intrinsics; shifts in long sides of the image."""
    return np.array([np.log(correction.focal_factor), correction.shift_x, correction.shift_y])
