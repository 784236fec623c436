"""A photo's position and heading by its EXIF data: parsed, and as readings of the device where a request asks for that.

EXIF's altitude is above the sea (the geoid), heights here are above the ellipsoid: they differ by up to 100 m, by 30 m
as a standard deviation over the Earth (EGM2008). Phones seldom state their accuracy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from service.device_readings import DeviceReadings, GpsPosition, Heading
from service.photos.images import OpenedPhoto
from service.types import Query

GPS_SIGMA_M, GPS_SIGMA_UP_M = 5.0, 10.0
"""Of a phone under open sky; the height is worse than the place. EXIF's own value replaces the first."""
GEOID_SIGMA_M = 30.0
_TRUE_SIGMA_DEG, _MAGNETIC_SIGMA_DEG = 15.0, 25.0
"""Of a phone's compass; by magnetic north with a declination that isn't known."""
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_DIRECTION_REF, _DIRECTION, _ERROR = 16, 17, 31


@dataclass(frozen=True, slots=True)
class ExifPlace:
    """Where a photo was taken by its EXIF data, on WGS84."""

    latitude_deg: float
    longitude_deg: float
    sigma_m: float
    altitude_m: float | None
    """Above the sea."""
    heading_deg: float | None
    """Of the camera's axis, clockwise from north, 0 to 360."""
    heading_sigma_deg: float


def exif_place(tags: Mapping[int, Any]) -> ExifPlace | None:
    """Return the place in a GPS directory (values by tag), of which nothing need be sound; None: it has none."""
    latitude = _degrees(tags.get(_LATITUDE), tags.get(_LATITUDE_REF), "S", 90)
    longitude = _degrees(tags.get(_LONGITUDE), tags.get(_LONGITUDE_REF), "W", 180)
    # Exactly zero in both is a receiver without a fix.
    if latitude is None or longitude is None or (latitude == 0 and longitude == 0):
        return None
    error, altitude, direction = (_number(tags.get(tag)) for tag in (_ERROR, _ALTITUDE, _DIRECTION))
    below = tags.get(_ALTITUDE_REF) in (1, b"\x01", "\x01")
    magnetic = str(tags.get(_DIRECTION_REF, "T"))[:1].upper() == "M"
    return ExifPlace(
        latitude,
        longitude,
        error if error is not None and 0.01 <= error <= 1000 else GPS_SIGMA_M,
        -altitude if altitude is not None and below else altitude,
        None if direction is None else direction % 360,
        _MAGNETIC_SIGMA_DEG if magnetic else _TRUE_SIGMA_DEG,
    )


def with_readings(query: Query, given: DeviceReadings | None, exif_of: OpenedPhoto | None = None) -> Query:
    """Return the query with what a device measured beside it; `exif_of`: of this photo's EXIF data what isn't given."""
    if exif_of is None:
        return replace(query, readings=given)
    place, given = exif_place(exif_of.gps), given or DeviceReadings()
    if place is None:
        missing = "the photo has no position in its EXIF data, as `gps` says it has."
        return replace(query, readings=given, warnings=(*query.warnings, missing))
    height_sigma = float(np.hypot(max(place.sigma_m, GPS_SIGMA_UP_M), GEOID_SIGMA_M))
    # Broken altitudes are left out, like all of EXIF that is broken.
    height = place.altitude_m if place.altitude_m is not None and abs(place.altitude_m) < 1e5 else None
    gps = GpsPosition(place.latitude_deg, place.longitude_deg, place.sigma_m, height, height_sigma)
    heading = None if place.heading_deg is None else Heading(place.heading_deg, place.heading_sigma_deg)
    return replace(query, readings=replace(given, gps=given.gps or gps, heading=given.heading or heading))


def _degrees(value: Any, reference: Any, negative: str, bound: float) -> float | None:
    """Return degrees from degrees, minutes and seconds; None for what is none."""
    try:
        parts = [float(part) for part in value]
    except (TypeError, ValueError, ArithmeticError):
        return None
    if len(parts) != 3 or not np.all(np.isfinite(parts)):
        return None
    degrees = parts[0] + parts[1] / 60 + parts[2] / 3600
    sign = -1.0 if str(reference)[:1].upper() == negative else 1.0
    return sign * degrees if 0 <= degrees <= bound else None


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return None
    return number if np.isfinite(number) else None
