"""Positions and poses of photos in a CSV table, or a JSON list of the same keys.

    name,x,y,z[,sigma_m][,qw,qx,qy,qz[,sigma_deg]]
    name,latitude,longitude,height[,sigma_m][,sigma_up_m][,heading_deg[,heading_sigma_deg]]

Metres, or degrees and metres above the WGS84 ellipsoid. The quaternion turns OpenCV's camera axes to the target frame.
JSON is a list of objects, or an object with the list as `places`, and `up` (3 numbers): what is up in the target frame.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from service.errors import InvalidRequest
from service.registration.known_places.known_place import HEADING_SIGMA, KnownPlace, KnownPlaces, rotation_of

MAX_METRES, MIN_SIGMA = 1e8, 1e-6
"""Of coordinates, and of standard deviations in metres or degrees."""
_LOCAL, _GEOGRAPHIC, _QUATERNION = ("x", "y", "z"), ("latitude", "longitude", "height"), ("qw", "qx", "qy", "qz")
_OTHERS = ("name", "sigma_m", "sigma_up_m", "sigma_deg", "heading_deg", "heading_sigma_deg", "time_s")
_KNOWN = (*_LOCAL, *_GEOGRAPHIC, *_QUATERNION, *_OTHERS)


def accepts(head: str, name: str) -> bool:
    """Whether a file is such a table, by its first characters and its name."""
    first = head.lstrip("\ufeff \t\r\n")
    if first.startswith("[") or (first.startswith("{") and '"places"' in head):
        return True
    columns = {c.strip() for c in first.partition("\n")[0].split(",")}
    return "name" in columns and bool(columns & {"x", "latitude"})


def read(text: str, name: str) -> KnownPlaces:
    """Parse a table. Raises InvalidRequest with the row."""
    text, up = text.lstrip("\ufeff"), None
    if text.lstrip().startswith(("[", "{")):
        try:
            data = json.loads(text)
        except ValueError as error:
            raise InvalidRequest(f"not JSON: {error}.", where=name) from None
        if isinstance(data, dict):
            up = data.get("up")
            data = data.get("places")
        if not isinstance(data, list):
            raise InvalidRequest("must be a list of places, or an object with the list as 'places'.", where=name)
        return table(data, up, name)
    rows = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    # An empty cell is a value that isn't known: its column is for other rows.
    return table([{k: v for k, v in row.items() if v not in (None, "")} for row in rows], None, name)


def table(rows: list[Any], up: Any, name: str) -> KnownPlaces:
    """Return the places of rows that are mappings. Raises InvalidRequest with the row."""
    places, geographic = [], set()
    for number, row in enumerate(rows, 1):
        where = f"{name}, place {number}"
        if not isinstance(row, dict) or not isinstance(row.get("name"), str) or not row["name"]:
            raise InvalidRequest("a place needs a 'name': the photo's file name.", where=where)
        unknown = sorted(str(key) for key in row.keys() - set(_KNOWN))
        if unknown:
            raise InvalidRequest(f"unknown key '{unknown[0][:40]}'; known: {', '.join(_KNOWN)}.", where=where)
        place, on_earth = _place(row, where)
        places.append(place)
        geographic |= set() if place.position is None else {on_earth}
    if len(geographic) > 1:
        raise InvalidRequest("give all positions as x, y, z, or all as latitude, longitude, height.", where=name)
    axis = None
    if up is not None:
        axis = unit_vector(up, f"{name}: up")
    return KnownPlaces("table", tuple(places), geographic == {True}, axis)


def unit_vector(value: Any, where: str) -> tuple[float, float, float]:
    """Return three numbers as a unit vector. Raises InvalidRequest."""
    try:
        vector = np.array([float(v) for v in value])
    except (TypeError, ValueError):
        vector = np.zeros(0)
    length = float(np.linalg.norm(vector)) if vector.shape == (3,) else 0.0
    if not 1e-9 < length < 1e9:
        raise InvalidRequest("must be three numbers, not all zero.", where=where)
    x, y, z = (float(v) for v in vector / length)
    return x, y, z


def _place(row: Mapping[str, Any], where: str) -> tuple[KnownPlace, bool]:
    on_earth = any(key in row for key in _GEOGRAPHIC)
    columns = _GEOGRAPHIC if on_earth else _LOCAL
    position = _numbers(row, columns, where)
    if on_earth and position is not None and (abs(position[0]) > 90 or abs(position[1]) > 180):
        raise InvalidRequest("latitude must lie in -90..90, longitude in -180..180.", where=where)
    quaternion = _numbers(row, _QUATERNION, where)
    heading = _numbers(row, ("heading_deg",), where)
    if position is None and quaternion is None:
        raise InvalidRequest(f"needs {', '.join(columns)} or {', '.join(_QUATERNION)}.", where=where)
    sigma, sigma_up = (_sigma(row, key, where) for key in ("sigma_m", "sigma_up_m"))
    turn, heading_sigma = (_sigma(row, key, where) for key in ("sigma_deg", "heading_sigma_deg"))
    covariance = None if sigma is None else np.diag([sigma, sigma, sigma_up or sigma]) ** 2
    time = _numbers(row, ("time_s",), where)
    place = KnownPlace(
        name=row["name"],
        position=position,
        covariance=covariance,
        target_from_camera=None if quaternion is None else rotation_of(quaternion.tolist(), where),
        rotation_sigma=None if turn is None else float(np.radians(turn)),
        heading=None if heading is None else float(np.radians(heading[0])),
        heading_sigma=float(np.radians(heading_sigma)) if heading_sigma else HEADING_SIGMA,
        time_s=None if time is None else float(time[0]),
    )
    return place, on_earth


def _numbers(row: Mapping[str, Any], keys: tuple[str, ...], where: str) -> np.ndarray | None:
    there = [key for key in keys if key in row]
    if not there:
        return None
    missing = [key for key in keys if key not in row]
    if missing:
        raise InvalidRequest(f"has {there[0]}, but no {missing[0]}.", where=where)
    try:
        values = np.array([float(row[key]) for key in keys])
    except (TypeError, ValueError):
        raise InvalidRequest(f"{', '.join(keys)} must be numbers.", where=where) from None
    if not np.all(np.abs(values) <= MAX_METRES):  # NaN fails, too
        raise InvalidRequest(f"{', '.join(keys)} must be finite numbers up to {MAX_METRES:g}.", where=where)
    return values


def _sigma(row: Mapping[str, Any], key: str, where: str) -> float | None:
    value = _numbers(row, (key,), where)
    if value is not None and value[0] < MIN_SIGMA:
        raise InvalidRequest(f"{key} must be at least {MIN_SIGMA:g}.", where=where)
    return None if value is None else float(value[0])
