"""The registration of a scene: the similarity from its world to a target frame in metres, with its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64

from service.geometry import hat
from service.types import GeoAnchor, Pose, frozen

Part = Literal["scale", "up", "heading", "position"]
PARTS: tuple[Part, ...] = ("scale", "up", "heading", "position")


@dataclass(frozen=True, slots=True)
class Residual:
    """How far an observation is from where the registration puts it."""

    name: str
    used: bool
    """False: an outlier, of which nothing was taken."""
    metres: float | None
    """Of its position; None where none is known."""
    degrees: float | None
    """Of its rotation, else of its heading; None where none is known."""


@dataclass(frozen=True, slots=True)
class Origin:
    """A point on WGS84, whose East-North-Up frame is the target frame."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    """Above the ellipsoid."""


@dataclass(frozen=True, slots=True)
class PlacedPose:
    """A camera's pose in the target frame."""

    pose: Pose
    """Metres; OpenCV's camera axes."""
    covariance: Float64[np.ndarray, "6 6"]
    """Of the twist (rad, metres) in the camera's frame, of localization and registration together."""

    @property
    def position_covariance(self) -> Float64[np.ndarray, "3 3"]:
        """Covariance of the position along the target's axes, square metres."""
        rotation = self.pose.world_from_camera[:3, :3]
        return rotation @ self.covariance[3:, 3:] @ rotation.T


@dataclass(frozen=True, slots=True)
class Registration:
    """The similarity from a scene's world to the target frame, with its covariance, and which parts of it are
    determined.
    """

    target_from_world: Float64[np.ndarray, "4 4"]
    """A similarity from the scene's world to metres; arbitrary in the parts that aren't determined."""
    centre_in_world: Float64[np.ndarray, "3"]
    """Where the covariance's shift is: the mean of the observations."""
    covariance: Float64[np.ndarray, "7 7"]
    """Of (rotation in rad, shift in metres, both along the target's axes; log of the scale), about the centre. Its 95 %
    region is that of a normal distribution: where noise was estimated from few residuals it is enlarged to that."""
    determined: tuple[Part, ...]
    reason: str
    """Why other parts aren't determined; empty where all are."""
    residuals: tuple[Residual, ...] = ()
    up_in_target: tuple[float, float, float] | None = None
    origin: Origin | None = None
    """None: the target frame is that of the file the places are from."""
    source: str = ""
    """What it was computed from."""
    noise: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the places by the residuals: `position` in metres, `rotation` in rad; those that were
    estimated."""
    warnings: tuple[str, ...] = ()
    scene_sha256: str = ""
    """Of the scene that was registered; of another one the registration may be wrong."""
    created: float = 0.0
    """Seconds since 1970."""
    revision: int = 0
    """Counts the registrations of a scene, from 1; no number is used twice."""

    def __post_init__(self) -> None:
        for name in ("target_from_world", "centre_in_world", "covariance"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64))

    @property
    def is_complete(self) -> bool:
        """Whether poses can be given in the target frame."""
        return len(self.determined) == len(PARTS)

    @property
    def scale(self) -> float:
        """Metres per scene unit, by the matrix; arbitrary where the scale isn't determined."""
        return float(np.cbrt(np.linalg.det(self.target_from_world[:3, :3])))

    @property
    def metres_per_unit(self) -> float | None:
        """None where the scale isn't determined."""
        return self.scale if "scale" in self.determined else None

    @property
    def metres_per_unit_sigma(self) -> float | None:
        """Its standard deviation; None where the scale isn't determined."""
        return self.scale * float(np.sqrt(self.covariance[6, 6])) if "scale" in self.determined else None

    @property
    def up_in_world(self) -> Float64[np.ndarray, "3"] | None:
        """Unit vector of the target's up axis in the scene's world; None where it isn't determined."""
        if "up" not in self.determined or self.up_in_target is None:
            return None
        return self.target_from_world[:3, :3].T @ np.array(self.up_in_target) / self.scale

    @property
    def geo_anchor(self) -> GeoAnchor | None:
        """Where the scene is on Earth; None where that isn't known."""
        if self.origin is None or not self.is_complete:
            return None
        place = self.origin
        return GeoAnchor(place.latitude_deg, place.longitude_deg, place.height_m, self.target_from_world)

    def onto(self, other: Registration) -> Registration:
        """Return the registration in the target frame of another scene, if this one's target is that scene's world.

        Both must be complete. Residuals are then in metres.
        """
        scale, rotation = other.scale, other.target_from_world[:3, :3] / other.scale
        centre = (self.target_from_world @ [*self.centre_in_world, 1.0])[:3]
        arm = other.target_from_world[:3, :3] @ (centre - other.centre_in_world)
        inner, outer = np.eye(7), np.eye(7)
        inner[:3, :3], inner[3:6, 3:6] = rotation, scale * rotation
        # The other's small rotations and scales move this one's centre.
        outer[3:6, :3], outer[3:6, 6] = -hat(arm), arm
        covariance = inner @ self.covariance @ inner.T + outer @ other.covariance @ outer.T
        residuals = tuple(replace(r, metres=None if r.metres is None else r.metres * scale) for r in self.residuals)
        return replace(
            self,
            target_from_world=other.target_from_world @ self.target_from_world,
            covariance=covariance,
            residuals=residuals,
            up_in_target=other.up_in_target,
            origin=other.origin,
        )

    def placed(self, pose: Pose, covariance: Float64[np.ndarray, "6 6"] | None) -> PlacedPose | None:
        """Return a pose of the scene's world in the target frame, None if the registration is incomplete.

        `covariance` is the pose's own (as a verdict's); without it only the registration's uncertainty is counted.
        """
        if not self.is_complete:
            return None
        scale = self.scale
        matrix = self.target_from_world @ pose.world_from_camera
        matrix[:3, :3] /= scale
        back = matrix[:3, :3].T
        arm = self.target_from_world[:3, :3] @ (pose.position_in_world - self.centre_in_world)
        # A small change of the similarity, as a twist in the camera's frame.
        change = np.zeros((6, 7))
        change[:3, :3] = back
        change[3:, :3], change[3:, 3:6], change[3:, 6] = -back @ hat(arm), back, back @ arm
        own = np.zeros((6, 6)) if covariance is None else covariance
        units = np.diag([1.0, 1.0, 1.0, scale, scale, scale])
        return PlacedPose(Pose(matrix), change @ self.covariance @ change.T + units @ own @ units)


def by_unit(metres_per_unit: float, up_in_world: tuple[float, float, float] | None) -> Registration:
    """Return the registration of a scene in its own world's axes, by a unit that is certain."""
    matrix = np.diag([metres_per_unit, metres_per_unit, metres_per_unit, 1.0])
    return Registration(matrix, np.zeros(3), np.zeros((7, 7)), PARTS, "", up_in_target=up_in_world)
