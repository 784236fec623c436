"""A known place: what a file states of a photo in the target frame, before the photo is localized."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from service.errors import InvalidRequest
from service.geodesy import enu_from_geographic
from service.geometry import rotation_from_quat
from service.photos.intrinsics import ORIENTATIONS
from service.registration.observations import Observation
from service.registration.registration import Origin
from service.types import Intrinsics, Pose, frozen

HEADING_SIGMA = 0.26
"""rad: 15 degrees, of a phone's compass."""


@dataclass(frozen=True, slots=True)
class KnownPlace:
    """A photo's place; rotations are of the photo as it is stored, before its EXIF orientation is applied."""

    name: str
    """The photo's path or file name; empty where it is known by its time only."""
    position: Float64[np.ndarray, "3"] | None = None
    """Metres, or latitude, longitude (degrees) and height (metres above the ellipsoid): see `KnownPlaces`."""
    covariance: Float64[np.ndarray, "3 3"] | None = None
    """Of the position in metres (east, north, up of a geographic one)."""
    target_from_camera: Float64[np.ndarray, "3 3"] | None = None
    """OpenCV's camera axes."""
    rotation_sigma: float | None = None
    """rad."""
    heading: float | None = None
    """Of the optical axis, rad clockwise from north (y)."""
    heading_sigma: float = HEADING_SIGMA
    """rad."""
    time_s: float | None = None
    intrinsics: Intrinsics | None = None
    """Of the photo as it is stored."""

    def __post_init__(self) -> None:
        for name in ("position", "covariance", "target_from_camera"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, frozen(value, np.float64))


@dataclass(frozen=True, slots=True)
class KnownPlaces:
    """The known places of one file, and what holds for all of them."""

    kind: str
    """The reader's name for it, which results repeat."""
    places: tuple[KnownPlace, ...]
    is_geographic: bool = False
    """Positions are latitude, longitude and height; rotations and headings are in East-North-Up at the position."""
    up: tuple[float, float, float] | None = None
    """Of the target frame, where it is known."""
    drift: float = 0.0
    """As `Evidence.drift`."""
    may_be_turned: bool = False
    """Photos of this kind are often stored upright while their poses are of the camera's sensor."""
    warnings: tuple[str, ...] = ()


def in_metres(known: KnownPlaces, origin: Origin | None = None) -> tuple[KnownPlaces, Origin | None]:
    """Return geographic places in East-North-Up of an origin, and the origin; others as they are.

    The origin is by default their median, which no outlier moves.
    """
    if not known.is_geographic:
        return known, None
    numbers = np.array([p.position for p in known.places if p.position is not None]).reshape(-1, 3)
    if not len(numbers):
        return replace(known, is_geographic=False), None
    place = origin or Origin(*(float(v) for v in np.median(numbers, axis=0)))
    zero = np.array([place.latitude_deg, place.longitude_deg, place.height_m])

    def moved(p: KnownPlace) -> KnownPlace:
        return p if p.position is None else replace(p, position=enu_from_geographic(zero, p.position[None])[0])

    places = tuple(moved(p) for p in known.places)
    return replace(known, places=places, is_geographic=False, up=(0.0, 0.0, 1.0)), place


def observation_of(
    place: KnownPlace, name: str, pose: Pose, covariance: Float64[np.ndarray, "6 6"] | None, orientation: int = 1
) -> Observation:
    """Return a localized photo as an observation of the registration.

    `pose` and its covariance are those of the upright photo; `orientation` is EXIF's, by which it was turned.
    """
    turned = None
    if place.target_from_camera is not None:
        stored_from_upright = _stored_from_upright(orientation)
        turned = None if stored_from_upright is None else place.target_from_camera @ stored_from_upright
    return Observation(
        name=name,
        position_in_world=pose.position_in_world,
        position=place.position,
        position_covariance=place.covariance,
        world_from_camera=pose.world_from_camera[:3, :3],
        target_from_camera=turned,
        rotation_sigma=place.rotation_sigma,
        heading=place.heading,
        heading_sigma=place.heading_sigma,
        localization_covariance=covariance,
    )


def rotation_of(wxyz: Sequence[float], where: str) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation of a quaternion that a file gives to a few digits. Raises InvalidRequest."""
    length = float(np.linalg.norm(wxyz))
    if not abs(length - 1) < 1e-2:  # NaN fails, too
        raise InvalidRequest(f"a quaternion must have length 1, has {length:.4g}.", where=where)
    return rotation_from_quat(np.array(wxyz, np.float64))


def _stored_from_upright(orientation: int) -> Float64[np.ndarray, "3 3"] | None:
    """Return the rotation of camera axes by EXIF's orientation; None for mirrored photos, which no pose describes."""
    transpose, mirror_x, mirror_y = ORIENTATIONS.get(orientation, ORIENTATIONS[1])
    upright_from_stored = np.eye(3)
    if transpose:
        upright_from_stored[:2, :2] = [[0, 1], [1, 0]]
    upright_from_stored = np.diag([-1.0 if mirror_x else 1.0, -1.0 if mirror_y else 1.0, 1.0]) @ upright_from_stored
    return upright_from_stored.T if np.linalg.det(upright_from_stored) > 0 else None
