"""Points picked in the scene: with coordinates, two with their distance, three or more of the floor.

    {"points": [{"in_world": [1, 2, 3], "x": 10, "y": 4, "z": 0, "sigma_m": 0.02}],
     "lengths": [{"from_in_world": [0, 0, 0], "to_in_world": [1, 0, 0], "metres": 2.4}],
     "floor": [[0, 0, 0], [1, 0, 0], [0, 1, 0]]}

A point has `latitude`, `longitude` and `height` instead where it is known on Earth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from service.errors import InvalidRequest
from service.registration.known_places import place_table
from service.registration.known_places.known_place import KnownPlaces
from service.registration.observations import Direction, Height, Length

MAX_POINTS = 100
LENGTH_SIGMA = 0.01
"""Of a length, as a share of it: both ends are picked by hand."""
_FLOOR_SIGMA = np.radians(1.0)
_FLATNESS = 0.02
"""Smaller over larger spread of floor points below which they lie on a line."""
_KEYS = ("points", "lengths", "floor")


@dataclass(frozen=True, slots=True)
class ScenePoints:
    """Points, lengths and floor points that were picked in the scene."""

    known: KnownPlaces
    """Of the points, in their order."""
    in_world: tuple[Float64[np.ndarray, "3"], ...]
    lengths: tuple[Length, ...]
    floor: Float64[np.ndarray, "n 3"]


def read(data: Any, where: str) -> ScenePoints:
    """Parse an object as above. Raises InvalidRequest with the element."""
    if not isinstance(data, dict) or not data or set(data) - set(_KEYS):
        raise InvalidRequest(f"must be an object with some of the keys {', '.join(_KEYS)}.", where=where)
    rows, in_world = [], []
    for number, point in enumerate(_list(data, "points", where), 1):
        place = f"{where}: points, {number}"
        if not isinstance(point, dict):
            raise InvalidRequest("must be an object with in_world and coordinates.", where=place)
        in_world.append(_vector(point.get("in_world"), f"{place}: in_world"))
        rows.append({"name": f"point {number}"} | {key: v for key, v in point.items() if key != "in_world"})
    lengths = tuple(_length(v, f"{where}: lengths, {i}") for i, v in enumerate(_list(data, "lengths", where), 1))
    floor = [_vector(v, f"{where}: floor, {i}") for i, v in enumerate(_list(data, "floor", where), 1)]
    known = place_table.table(rows, None, f"{where}: points")
    return ScenePoints(known, tuple(in_world), lengths, np.array(floor).reshape(-1, 3))


def floor_evidence(
    floor: Float64[np.ndarray, "n 3"], above: Float64[np.ndarray, "3"], up: Sequence[float]
) -> tuple[Direction, list[Height]]:
    """Return floor points as evidence: their normal is up, towards a point above them, and their height is 0.

    Raises InvalidRequest for fewer than three, or for points on a line.
    """
    middle = floor.mean(0) if len(floor) else np.zeros(3)
    singular, axes = np.linalg.svd(floor - middle)[1:]
    if len(floor) < 3 or singular[1] < _FLATNESS * singular[0]:
        raise InvalidRequest("needs three points of the floor that don't lie on a line.", where="floor")
    normal = axes[2] if axes[2] @ (above - middle) > 0 else -axes[2]
    return Direction(normal, np.array(up, np.float64), float(_FLOOR_SIGMA)), [Height(p, 0.0, 0.02) for p in floor]


def _list(data: Mapping[str, Any], key: str, where: str) -> list[Any]:
    value = data.get(key, [])
    if not isinstance(value, list) or len(value) > MAX_POINTS:
        raise InvalidRequest(f"must be a list of at most {MAX_POINTS}.", where=f"{where}: {key}")
    return value


def _vector(value: Any, where: str) -> Float64[np.ndarray, "3"]:
    try:
        vector = np.array(value, np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.all(np.abs(vector) <= place_table.MAX_METRES):  # NaN fails, too
        raise InvalidRequest(f"must be three finite numbers up to {place_table.MAX_METRES:g}.", where=where)
    return vector


def _length(value: Any, where: str) -> Length:
    keys = {"from_in_world", "to_in_world", "metres", "sigma_m"}
    if not isinstance(value, dict) or set(value) - keys or not keys - {"sigma_m"} <= value.keys():
        raise InvalidRequest("must have from_in_world, to_in_world and metres.", where=where)
    start, end = (_vector(value[key], f"{where}: {key}") for key in ("from_in_world", "to_in_world"))
    try:
        metres = float(value["metres"])
        sigma = float(value.get("sigma_m", LENGTH_SIGMA * metres))
    except (TypeError, ValueError):
        metres = sigma = 0.0
    if not (1e-6 < metres < 1e7 and 1e-7 < sigma < 1e7) or np.allclose(start, end, rtol=0, atol=1e-12):
        raise InvalidRequest("must be a positive length between two different points.", where=where)
    return Length(start, end, metres, sigma)
