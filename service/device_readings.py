"""What a device measured beside a photo: gravity, a position on Earth, a compass heading; each with its uncertainty.

As a request has them (`DeviceReadings`), and as priors in a scene's frame (`ScenePriors`). All are independent and
normally distributed. `service/pose/absolute_pose/device_priors.py` has the equations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.errors import InvalidPrior

MOST_M = 1e5
"""Standard deviations and heights beyond it, in metres, are no measurements."""
LEAST_SIGMA_DEG = 0.01


def _in_range(value: float, low: float, high: float, where: str, unit: str) -> None:
    # `not`: NaN compares false.
    if not low <= value <= high:
        raise InvalidPrior(f"must lie in {low:g}..{high:g} {unit}, is {value:g}.", where=where)


@dataclass(frozen=True, slots=True)
class Gravity:
    """Which way is up, by a device's accelerometer. Raises InvalidPrior."""

    direction: tuple[float, float, float]
    """Up in the upright photo's camera, OpenCV axes: (0, -1, 0) for a level camera. Of any length; kept at length 1."""
    sigma_deg: float = 1.0
    """Standard deviation about each of the two axes across."""

    def __post_init__(self) -> None:
        up = np.array(self.direction, np.float64)
        length = float(np.linalg.norm(up)) if up.shape == (3,) else 0.0
        if not 1e-6 < length < np.inf:
            raise InvalidPrior("must be three numbers that are a direction.", where="up_in_camera.direction")
        _in_range(self.sigma_deg, LEAST_SIGMA_DEG, 90, "up_in_camera.sigma_deg", "degrees")
        x, y, z = (up / length).tolist()
        object.__setattr__(self, "direction", (x, y, z))


@dataclass(frozen=True, slots=True)
class GpsPosition:
    """Where a device was, by satellites. Raises InvalidPrior."""

    latitude_deg: float
    longitude_deg: float
    sigma_m: float
    """Standard deviation to the east, and to the north. The radius that phones state holds 68 %: 1.5 times as much."""
    height_m: float | None = None
    """Above the ellipsoid; None: not used."""
    height_sigma_m: float = 10.0

    def __post_init__(self) -> None:
        _in_range(self.latitude_deg, -90, 90, "gps.latitude", "degrees")
        _in_range(self.longitude_deg, -180, 180, "gps.longitude", "degrees")
        _in_range(self.sigma_m, 0.001, MOST_M, "gps.sigma_m", "metres")
        if self.height_m is not None:
            _in_range(self.height_m, -MOST_M, MOST_M, "gps.height", "metres")
            _in_range(self.height_sigma_m, 0.001, MOST_M, "gps.height_sigma_m", "metres")


@dataclass(frozen=True, slots=True)
class Heading:
    """Which way the camera looked, by a compass. Raises InvalidPrior."""

    degrees: float
    """Of the camera's axis, clockwise from true north."""
    sigma_deg: float = 15.0
    """Standard deviation, of a level camera."""

    def __post_init__(self) -> None:
        _in_range(self.degrees, -360, 360, "heading.degrees", "degrees")
        _in_range(self.sigma_deg, LEAST_SIGMA_DEG, 180, "heading.sigma_deg", "degrees")


@dataclass(frozen=True, slots=True)
class DeviceReadings:
    """What was measured with one photo; None: nothing was."""

    gravity: Gravity | None = None
    gps: GpsPosition | None = None
    heading: Heading | None = None


@dataclass(frozen=True, slots=True)
class UpPrior:
    """Up in the camera and in the scene, both of length 1."""

    up_in_camera: Float64[np.ndarray, "3"]
    up_in_world: Float64[np.ndarray, "3"]
    sigma: float
    """rad, of both together."""


@dataclass(frozen=True, slots=True)
class PositionPrior:
    """Where the camera's centre is, in two directions or three: along the first rows of `metres_from_world`."""

    position_in_world: Float64[np.ndarray, "3"]
    """Scene units; arbitrary along what isn't measured."""
    metres_from_world: Float64[np.ndarray, "k 3"]
    """Metres east and north, and up where the height is known, for one unit along each of the world's axes."""
    covariance: Float64[np.ndarray, "k k"]
    """Square metres."""


@dataclass(frozen=True, slots=True)
class HeadingPrior:
    """Where the camera's axis points to, seen from above."""

    east_in_world: Float64[np.ndarray, "3"]
    north_in_world: Float64[np.ndarray, "3"]
    """Both of length 1."""
    radians: float
    """Clockwise from north."""
    sigma: float
    """rad, of a level camera."""


@dataclass(frozen=True, slots=True)
class ScenePriors:
    """Readings as priors of a pose in one scene, relative to its origin; None: not measured, or the scene can't say."""

    up: UpPrior | None = None
    position: PositionPrior | None = None
    heading: HeadingPrior | None = None
    warnings: tuple[str, ...] = ()
    """Which readings the scene has no use for, and why."""
