"""How probably a pose in the right place is as exact as was asked for, by its covariance.

The error of the pose, a twist, has a multivariate t distribution with the covariance as its scale matrix: its tails are
heavier than a normal distribution's, for degraded photos err by more than their covariance says. Asked is the
probability that rotation and position are both within their bounds, whatever the two have to do with one another. In
whitened coordinates that region is star-shaped about 0: in each direction s it ends at one radius R(s), and the
probability is the mean, over all directions, of the distribution function of the radius at R(s). The radius is
integrated in closed form and the directions by a fixed sample (after Deák, "Three digit accurate multiple normal
probabilities", Numerische Mathematik 35, 1980).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float64

from service.accuracy import DEFAULT_ACCURACY, Accuracy


@dataclass(frozen=True, slots=True)
class AskedBounds:
    """The accuracy asked for at a pose."""

    deg: float
    units: float
    """Of the position, in scene units."""
    distance: float
    """To what is seen there, in scene units."""

    @classmethod
    def of(cls, accuracy: Accuracy, distance: float) -> AskedBounds:
        """Return the bounds at this distance to what is seen; the accuracy is without metres."""
        return cls(accuracy.deg, accuracy.bound_units(distance), distance)

    @property
    def looser_rotation(self) -> float:
        """How many times as great as the default bound that of the rotation is; 1 where it is less."""
        return max(1.0, self.deg / DEFAULT_ACCURACY.deg)

    @property
    def looser_position(self) -> float:
        """Likewise that of the position."""
        return max(1.0, self.units / DEFAULT_ACCURACY.bound_units(self.distance))


DIRECTIONS = 6144
"""That are averaged over: an error of 0.001, root mean square, 0.006 where one direction is all that is uncertain."""
DEGREES_OF_FREEDOM = 4
"""Of the t distribution."""


def probability_within(covariance: Float64[np.ndarray, "6 6"], bound_deg: float, bound_units: float) -> float:
    """Return the probability (0..1) that a twist with this covariance has a rotation and a translation within bounds.

    `covariance` is of (rotation in rad, translation in scene units); it may be singular. The translation of a twist is
    the distance of the camera's centres up to the square of the rotation.
    """
    variances, axes = np.linalg.eigh(covariance)
    to_twist = axes * np.sqrt(np.maximum(variances, 0.0))
    squares = (to_twist @ _directions()) ** 2
    # A direction without uncertainty ends nowhere.
    with np.errstate(divide="ignore"):
        squared_radius = np.minimum(
            np.radians(bound_deg) ** 2 / squares[:3].sum(0), bound_units**2 / squares[3:].sum(0)
        )
    return float(_radius_within(squared_radius).mean())


def _radius_within(squared: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
    """Return the distribution function of a squared radius: of a standard t variate in 6 dimensions.

    Divided by 6 it has the F distribution with 6 and 4 degrees of freedom: the regularized incomplete beta function
    I_x(3, 2) = x^3 (4 - 3 x) with x = squared / (squared + 4).
    """
    # Written so that an infinite radius gives 1.
    rest = DEGREES_OF_FREEDOM / (squared + DEGREES_OF_FREEDOM)
    return (1.0 - rest) ** 3 * (1.0 + 3.0 * rest)


@cache
def _directions() -> Float64[np.ndarray, "6 n"]:
    """Return unit vectors as columns, spread evenly over the sphere in 6 dimensions; the same for every photo.

    An additive recurrence fills the unit cube evenly (Roberts, "The unreasonable effectiveness of quasirandom
    sequences", 2018); Box and Muller's transform makes normal variates of it, which have all directions alike.
    """
    golden = 1.0
    for _ in range(60):
        golden = (1.0 + golden) ** (1.0 / 7.0)
    even = (0.5 + np.outer(np.arange(1, DIRECTIONS + 1), golden ** -np.arange(1.0, 7.0))) % 1.0
    radius, angle = np.sqrt(-2.0 * np.log(even[:, :3])), 2.0 * np.pi * even[:, 3:]
    normal = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)], 1)
    # Contiguous rows: their sums are a fourth of the time that sums over 6 columns take.
    return np.ascontiguousarray((normal / np.linalg.norm(normal, axis=1)[:, None]).T)
