"""What is known of the scale between odometry and scene, also after the fixes that showed it are gone."""

from __future__ import annotations

import math

_LEAST_SIGMA = 0.01
"""Devices' scales change by about that."""
_CONTRADICTION = 4.0
"""Standard deviations by which a scale that was known is wrong: that of a manifest, or of another device."""
_UNKNOWN_SIGMA = 0.7
"""Of the logarithm, when nothing is known."""


class ScaleMemory:
    """The logarithm of scene units per unit of the odometry, and its standard deviation."""

    def __init__(self, log_scale: float, sigma: float) -> None:
        """Begin with what is known before any fix."""
        self.log_scale, self.sigma = log_scale, sigma
        self._before = log_scale, sigma
        """Without the fixes since the odometry began anew."""

    def prior(self) -> tuple[float, float]:
        """Return what is known beside the fixes of the window.

        What is remembered came in part from fixes that are still there: it counts with a quarter of its weight.
        """
        doubled = max(2 * self.sigma, _LEAST_SIGMA)
        # What was known before any of these fixes counts in full: they aren't part of it.
        return (self.log_scale, doubled) if doubled < self._before[1] else self._before

    def learn(self, log_scale: float, sigma: float) -> bool:
        """Take over what a fit with `prior` led to; it isn't remembered as surer than the fixes alone are.

        Return False, and forget what was known, if the fixes alone contradict that.
        """
        expected, of_prior = self.prior()
        # Informations (inverse variances) of independent sources add up, so the prior's can be taken out again.
        alone = max(sigma**-2 - of_prior**-2, 1e-12) ** -0.5
        by_fixes = (log_scale / sigma**2 - expected / of_prior**2) * alone**2
        if abs(by_fixes - expected) > _CONTRADICTION * math.hypot(alone, of_prior):
            self.log_scale, self.sigma, self._before = by_fixes, 2 * alone, (by_fixes, _UNKNOWN_SIGMA)
            return False
        self.log_scale, self.sigma = log_scale, min(self.sigma, alone)
        return True

    def begin_anew(self) -> None:
        """Keep what is known: the fixes are forgotten, and their scale is still the device's."""
        self._before = self.log_scale, max(self.sigma, _LEAST_SIGMA)
