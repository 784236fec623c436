"""Positions and headings in photos' EXIF data: GPS with altitude, the direction that the camera looked in.

EXIF's altitude is above the sea (the geoid), heights here are above the ellipsoid: the geoid's height, which differs
from place to place by up to 100 m, is added where the user gives it. Phones seldom state their accuracy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from service.registration.known_places.known_place import KnownPlace, KnownPlaces

GPS_SIGMA_M, GPS_SIGMA_UP_M = 5.0, 10.0
"""Of a phone under open sky; the height is worse than the place. EXIF's own value replaces the first."""
_TRUE_SIGMA, _MAGNETIC_SIGMA = np.radians(15.0), np.radians(25.0)
"""Of a phone's compass; by magnetic north with a declination that isn't known."""
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_DIRECTION_REF, _DIRECTION, _ERROR = 16, 17, 31


def read(photos: Sequence[tuple[str, Mapping[int, Any]]], geoid_m: float | None) -> KnownPlaces:
    """Return the places of photos by their GPS directories (values by tag); those without a position are left out."""
    found = [place for name, tags in photos if (place := _place(name, tags, geoid_m or 0.0)) is not None]
    warnings = []
    if found and geoid_m is None:
        warnings.append(
            "EXIF's altitudes are above the sea; heights above the ellipsoid differ by up to 100 m: give --geoid-m."
        )
    return KnownPlaces("exif", tuple(found), is_geographic=True, warnings=tuple(warnings))


def _place(name: str, tags: Mapping[int, Any], geoid_m: float) -> KnownPlace | None:
    latitude = _degrees(tags.get(_LATITUDE), tags.get(_LATITUDE_REF), "S", 90)
    longitude = _degrees(tags.get(_LONGITUDE), tags.get(_LONGITUDE_REF), "W", 180)
    # Exactly zero in both is a receiver without a fix.
    if latitude is None or longitude is None or (latitude == 0 and longitude == 0):
        return None
    error = _number(tags.get(_ERROR))
    sigma = error if error is not None and 0.01 <= error <= 1000 else GPS_SIGMA_M
    altitude = _number(tags.get(_ALTITUDE))
    below = tags.get(_ALTITUDE_REF) in (1, b"\x01", "\x01")
    # Without an altitude nothing is known of the height.
    sigma_up = max(sigma, GPS_SIGMA_UP_M) if altitude is not None else 1e4
    height = (-altitude if below else altitude) + geoid_m if altitude is not None else 0.0
    direction = _number(tags.get(_DIRECTION))
    magnetic = str(tags.get(_DIRECTION_REF, "T"))[:1].upper() == "M"
    return KnownPlace(
        name=name,
        position=np.array([latitude, longitude, height]),
        covariance=np.diag([sigma, sigma, sigma_up]) ** 2,
        heading=None if direction is None else float(np.radians(direction % 360)),
        heading_sigma=float(_MAGNETIC_SIGMA if magnetic else _TRUE_SIGMA),
    )


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
