"""Positions and headings in photos' EXIF data: GPS with altitude, the direction that the camera looked in.

EXIF's altitude is above the sea (the geoid), heights here are above the ellipsoid: the geoid's height, which differs
from place to place by up to 100 m, is added where the user gives it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from service.photos.exif_gps import GPS_SIGMA_UP_M, exif_place
from service.registration.known_places.known_place import KnownPlace, KnownPlaces


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
    found = exif_place(tags)
    if found is None:
        return None
    # Without an altitude nothing is known of the height.
    sigma_up = max(found.sigma_m, GPS_SIGMA_UP_M) if found.altitude_m is not None else 1e4
    height = 0.0 if found.altitude_m is None else found.altitude_m + geoid_m
    return KnownPlace(
        name=name,
        position=np.array([found.latitude_deg, found.longitude_deg, height]),
        covariance=np.diag([found.sigma_m, found.sigma_m, sigma_up]) ** 2,
        heading=None if found.heading_deg is None else float(np.radians(found.heading_deg)),
        heading_sigma=float(np.radians(found.heading_sigma_deg)),
    )
