"""A scene's registration as the API takes it and returns it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from service.errors import InvalidRequest
from service.registration.gathering import GatherOptions, LocalizedPhoto
from service.registration.known_places import place_table
from service.registration.known_places.known_place import KnownPlaces
from service.registration.known_places.scene_points import ScenePoints
from service.registration.known_places.scene_points import read as read_points
from service.registration.registration import Part, Registration
from service.types import Pose
from service.web.api_model import Model
from service.web.schemas.poses import Matrix, Transform

Point = Annotated[list[float], Field(min_length=3, max_length=3)]


class PlaceIn(Model):
    """What is known of a place: its position in metres, or on Earth; of a photo also its orientation."""

    x: float | None = None
    """With `y` and `z`: metres in a right-handed frame of your own."""
    y: float | None = None
    z: float | None = None
    latitude: float | None = None
    """With `longitude` and `height`: WGS84, in degrees."""
    longitude: float | None = None
    height: float | None = None
    """Metres above the ellipsoid."""
    sigma_m: float | None = None
    """Standard deviation of each coordinate. Without it the noise is estimated from the residuals of all."""
    sigma_up_m: float | None = None
    """Of the height, where it is another."""


class PhotoPlaceIn(PlaceIn):
    """A photo that was localized in the scene, and where it was taken."""

    job: str = Field(max_length=64)
    """Id of the job that localized it; a single photo's."""
    qw: float | None = None
    """With `qx`, `qy`, `qz`: unit quaternion that turns OpenCV's camera axes of the upright photo to your frame (on
    Earth: East-North-Up)."""
    qx: float | None = None
    qy: float | None = None
    qz: float | None = None
    sigma_deg: float | None = None
    """Standard deviation of the orientation about each axis."""
    heading_deg: float | None = None
    """Azimuth of the optical axis, clockwise from north."""
    heading_sigma_deg: float | None = None


class PointPlaceIn(PlaceIn):
    """A point of the scene with coordinates."""

    in_world: Point


class LengthIn(Model):
    """The distance between two points of the scene."""

    from_in_world: Point
    to_in_world: Point
    metres: float
    sigma_m: float | None = None
    """Default: 1 %."""


class RegistrationIn(Model):
    """What is known of the scene's place; at least one of the lists."""

    photos: list[PhotoPlaceIn] = Field(default_factory=list, max_length=100)
    points: list[PointPlaceIn] = Field(default_factory=list, max_length=100)
    lengths: list[LengthIn] = Field(default_factory=list, max_length=100)
    floor: list[Point] = Field(default_factory=list, max_length=100)
    """Three points or more of a level floor, which don't lie on a line."""
    up: Point | None = None
    """What is up in the frame of x, y, z."""
    metres_per_unit: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Of the scene, where it is certain: then it isn't estimated."""
    drift: float = Field(default=0.0, ge=0, le=1)
    """By how much the photos' places drift, as a share of the path between them in their order: odometry's."""


class ResidualOut(Model):
    """How far a place is from where the registration puts it."""

    name: str
    used: bool
    """False: an outlier, of which nothing was taken."""
    metres: float | None
    degrees: float | None
    """Of the orientation, or of the heading."""


class OriginOut(Model):
    """A point on WGS84, whose East-North-Up frame the registration is in."""

    latitude: float
    longitude: float
    height: float
    """Metres above the ellipsoid."""


class RegistrationOut(Model):
    """Where a scene is, how large, and which way is up."""

    revision: int
    """Counts the scene's registrations; results name it."""
    created: datetime
    applies: bool
    """False: the scene has changed since, so results don't use it. True also while the scene isn't in memory."""
    determined: list[Part]
    """What the places determine."""
    reason: str
    """Why the other parts aren't determined; empty where all are."""
    frame: Literal["enu", "local"]
    """`enu`: East-North-Up at `origin`; `local`: the frame of the places that were given."""
    origin: OriginOut | None
    target_from_world: Matrix
    """4x4 similarity from the scene's world to metres in `frame`; arbitrary in what isn't determined."""
    metres_per_unit: float | None
    metres_per_unit_sigma: float | None
    up_in_world: list[float] | None
    centre_in_world: list[float]
    covariance: Matrix
    """7x7 of (rotation in rad, shift in metres, both along the axes of `frame`; log of the scale), about
    `centre_in_world`."""
    residuals: list[ResidualOut]
    warnings: list[str]


class RegisteredOut(Model):
    """The result in metres, by the scene's registration."""

    revision: int
    """Of the registration that was in force when the job began."""
    determined: list[Part]
    frame: Literal["enu", "local"]
    metres_per_unit: float | None
    metres_per_unit_sigma: float | None
    target_from_camera: Transform | None
    """The pose in `frame`, in metres and OpenCV's camera axes; null unless everything is determined."""
    position_covariance: Matrix | None
    """3x3, square metres, along the axes of `frame`: of localization and registration together."""
    sigma_m: float | None
    """Square root of its trace; without a complete registration of the localization alone."""
    sigma_deg: float | None
    """Of the orientation, likewise."""


def registration_out(registration: Registration, *, applies: bool) -> RegistrationOut:
    """Convert a registration."""
    up, place = registration.up_in_world, registration.origin
    return RegistrationOut(
        revision=registration.revision,
        created=datetime.fromtimestamp(registration.created, UTC),
        applies=applies,
        determined=list(registration.determined),
        reason=registration.reason,
        frame="local" if place is None else "enu",
        origin=place and OriginOut(latitude=place.latitude_deg, longitude=place.longitude_deg, height=place.height_m),
        target_from_world=registration.target_from_world.tolist(),
        metres_per_unit=registration.metres_per_unit,
        metres_per_unit_sigma=registration.metres_per_unit_sigma,
        up_in_world=None if up is None else up.tolist(),
        centre_in_world=registration.centre_in_world.tolist(),
        covariance=registration.covariance.tolist(),
        residuals=[
            ResidualOut(name=r.name, used=r.used, metres=r.metres, degrees=r.degrees) for r in registration.residuals
        ],
        warnings=list(registration.warnings),
    )


def known_photos(
    wanted: RegistrationIn, poses: Sequence[tuple[Pose, np.ndarray | None]]
) -> tuple[KnownPlaces, list[LocalizedPhoto]]:
    """Return the photos' places, with the poses of their jobs. Raises InvalidRequest with the photo."""
    rows = [{"name": p.job, **_given(p, "job")} for p in wanted.photos]
    known = place_table.table(rows, None, "photos")
    named = zip(known.places, poses, strict=True)
    return known, [LocalizedPhoto(place.name, place, pose, covariance) for place, (pose, covariance) in named]


def picked_points(wanted: RegistrationIn) -> ScenePoints | None:
    """Return the points, lengths and floor of a request; None without any. Raises InvalidRequest."""
    lists: dict[str, Any] = {
        "points": [_given(p) for p in wanted.points],
        "lengths": [_given(p) for p in wanted.lengths],
        "floor": wanted.floor,
    }
    given = {name: values for name, values in lists.items() if values}
    return read_points(given, "body") if given else None


def gather_options(wanted: RegistrationIn) -> GatherOptions:
    """Return what a request states beside places. Raises InvalidRequest."""
    up = None if wanted.up is None else place_table.unit_vector(wanted.up, "up")
    return GatherOptions(up, wanted.metres_per_unit, wanted.drift)


def require_places(wanted: RegistrationIn) -> None:
    """Raises InvalidRequest for a request without any place."""
    if not (wanted.photos or wanted.points or wanted.lengths or wanted.floor):
        raise InvalidRequest(
            "holds no places.", where="body", hint="Give photos, points, lengths or floor: see docs/registration.md."
        )


def _given(value: Model, *without: str) -> dict[str, Any]:
    return value.model_dump(exclude_none=True, exclude=set(without))
