"""What a registration is computed from: places that are known both in the scene's world and in the target frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.types import frozen


@dataclass(frozen=True, slots=True)
class Observation:
    """A photo or a point: where it is in the scene, and what is known of it in the target frame (metres)."""

    name: str
    position_in_world: Float64[np.ndarray, "3"]
    """Of the camera's centre, or the point; scene units."""
    position: Float64[np.ndarray, "3"] | None = None
    """In the target frame."""
    position_covariance: Float64[np.ndarray, "3 3"] | None = None
    """Of `position`; None: its noise is estimated from the residuals of all."""
    world_from_camera: Float64[np.ndarray, "3 3"] | None = None
    """Of a localized photo: OpenCV's camera axes in the scene's world."""
    target_from_camera: Float64[np.ndarray, "3 3"] | None = None
    """The same axes in the target frame, where they are known."""
    rotation_sigma: float | None = None
    """Of `target_from_camera` about each axis, in rad; None: estimated from the residuals of all."""
    heading: float | None = None
    """Azimuth of the optical axis, in rad clockwise from the target frame's y axis (north), which has z up."""
    heading_sigma: float = 0.26
    """rad."""
    localization_covariance: Float64[np.ndarray, "6 6"] | None = None
    """Of the pose in the scene, as a verdict's: twist (rad, units) in the camera's frame."""

    def __post_init__(self) -> None:
        for name in (
            "position_in_world",
            "position",
            "position_covariance",
            "world_from_camera",
            "target_from_camera",
            "localization_covariance",
        ):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, frozen(value, np.float64))

    @property
    def world_covariance(self) -> Float64[np.ndarray, "3 3"]:
        """Covariance of `position_in_world` along the world's axes; zero where it isn't known."""
        if self.localization_covariance is None or self.world_from_camera is None:
            return np.zeros((3, 3))
        return self.world_from_camera @ self.localization_covariance[3:, 3:] @ self.world_from_camera.T

    @property
    def turn_covariance(self) -> Float64[np.ndarray, "3 3"]:
        """Covariance of the photo's rotation in the scene, about the camera's axes, rad^2."""
        return np.zeros((3, 3)) if self.localization_covariance is None else self.localization_covariance[:3, :3]


@dataclass(frozen=True, slots=True)
class Direction:
    """A direction that is known in both frames, unit length: what is up."""

    in_world: Float64[np.ndarray, "3"]
    in_target: Float64[np.ndarray, "3"]
    sigma: float
    """rad."""


@dataclass(frozen=True, slots=True)
class Length:
    """A distance between two points of the scene."""

    from_in_world: Float64[np.ndarray, "3"]
    to_in_world: Float64[np.ndarray, "3"]
    metres: float
    sigma: float
    """Metres."""

    @property
    def units(self) -> float:
        """The distance in the scene's units."""
        return float(np.linalg.norm(self.to_in_world - self.from_in_world))


@dataclass(frozen=True, slots=True)
class Height:
    """A point of the scene whose coordinate along the target frame's up axis is known."""

    in_world: Float64[np.ndarray, "3"]
    metres: float
    sigma: float
    """Metres."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Everything that is known of a scene's place."""

    observations: Sequence[Observation] = ()
    directions: Sequence[Direction] = ()
    lengths: Sequence[Length] = ()
    heights: Sequence[Height] = ()
    up: tuple[float, float, float] | None = None
    """The target frame's up axis; None: not known."""
    metres_per_unit: float | None = None
    """Of the scene, where it is certain: then it isn't estimated."""
    may_be_turned: bool = False
    """All photos may have been turned by the same quarter turns after their poses were taken."""
    drift: float = 0.0
    """By how much the observations' places drift, as a share of the path between them: a random walk, whose standard
    deviation at the end of the path is this share of its length. For odometry and AR sessions; in order of time."""
