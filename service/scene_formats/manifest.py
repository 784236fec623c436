"""The optional `scene.json` of a scene folder: facts that a scene file has no field for.

    {"name": "Studio", "file": "scene.ply", "convention": "opengl", "up": [0, 0, 1], "metres_per_unit": 0.5,
     "world_from_scene": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
     "background": [0, 0, 0], "training_size": [640, 480], "render_mode": "default",
     "geo_anchor": {"latitude": 47.3, "longitude": 8.5, "height": 450.0,
                    "enu_from_world": [[0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 0.5, 0], [0, 0, 0, 1]]}}

Every key may be left out; an unknown one is an error: a misspelt key would be ignored silently.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from service.errors import CorruptScene, SceneError, UnsupportedFormat
from service.types import GeoAnchor

MANIFEST = "scene.json"

MAX_JSON_BYTES = 64 * 1024 * 1024
_MAX_NAME_BYTES = 255
"""Of a file, on all usual file systems."""


def told_by_manifest(entry: str) -> str:
    """Return how a user adds an entry to a scene's manifest: a scene that came as a bare file has none."""
    return f"to tell it, put {entry} into a {MANIFEST} beside the scene file, both in one folder or ZIP"


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a folder's `scene.json` says; None: it says nothing."""

    name: str | None = None
    file: str | None = None
    """Of the scene, where the folder has several candidates."""
    convention: Literal["opengl", "opencv"] = "opengl"
    """Camera axes in `transforms*.json`: nerfstudio's and Blender's are OpenGL's."""
    up: tuple[float, float, float] | None = None
    """In the world frame, that is after `world_from_scene`; unit length."""
    world_from_scene: Float64[np.ndarray, "4 4"] | None = None
    """Similarity (rotation, translation, one scale) that is applied to the Gaussians and the training cameras."""
    metres_per_unit: float | None = None
    """Of the world frame."""
    background: tuple[float, float, float] | None = None
    training_size: tuple[int, int] | None = None
    """Width and height of the photos in training, if the camera file is of larger ones or missing."""
    render_mode: str | None = None
    geo_anchor: GeoAnchor | None = None


def read_manifest(folder: Path) -> Manifest:
    """Return the folder's manifest; an empty one if it has none. Raises CorruptScene, UnsupportedFormat."""
    path = folder / MANIFEST
    if not path.is_file():
        return Manifest()
    data = read_json(path)
    known = [f.name for f in fields(Manifest)]
    unknown = sorted(data.keys() - set(known))
    if unknown:
        raise CorruptScene(f"unknown key '{unknown[0]}'; known: {', '.join(known)}.", where=MANIFEST)
    return Manifest(**{key: _READERS[key](key, value) for key, value in data.items()})


def read_json(path: Path) -> dict[str, Any]:
    """Parse a JSON file of bounded size that holds an object. Raises CorruptScene."""
    if path.stat().st_size > MAX_JSON_BYTES:
        raise CorruptScene(f"larger than {MAX_JSON_BYTES} bytes.", where=path.name)
    try:
        text = path.read_text("utf-8-sig")  # editors of Windows begin a file with a byte order mark
        data = json.loads(text)
        if "\\ud" in text.lower():  # half of a surrogate pair is no text that could be sent or stored
            json.dumps(data, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:  # nested deeper than Python's stack
        raise CorruptScene(f"not JSON: {str(error)[:200]}.", where=path.name) from None
    if not isinstance(data, dict):
        raise CorruptScene("must be a JSON object.", where=path.name)
    return data


def numbers(
    value: Any, shape: tuple[int, ...], where: str, error: type[SceneError] = CorruptScene
) -> Float64[np.ndarray, "..."]:
    """Return nested lists of finite numbers as an array of the given shape; raises `error` for anything else."""
    try:
        result = np.asarray(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        result = np.empty(0)
    # Another shape would be broadcast silently later.
    if result.shape != shape or not np.all(np.isfinite(result)):
        raise error(f"must be {' x '.join(map(str, shape)) or 'one'} finite number(s).", where=where)
    return result


def colour(where: str, value: Any) -> tuple[float, float, float]:
    """Return red, green, blue in 0..1. Raises CorruptScene."""
    rgb = numbers(value, (3,), where)
    if rgb.min() < 0 or rgb.max() > 1:
        raise CorruptScene(f"must be three numbers in 0..1, is {value}.", where=where)
    return float(rgb[0]), float(rgb[1]), float(rgb[2])


def _text(key: str, value: Any) -> str:
    if not isinstance(value, str) or not value.strip() or len(value) > 200:
        raise CorruptScene("must be a text of 1 to 200 characters.", where=f"{MANIFEST}: {key}")
    return value


def _file(key: str, value: Any) -> str:
    if _text(key, value) != Path(value).name or len(value.encode()) > _MAX_NAME_BYTES:
        raise CorruptScene("must be the name of a file in the folder.", where=f"{MANIFEST}: {key}")
    return value


def _choice(key: str, value: Any) -> str:
    if value not in ("opengl", "opencv"):
        raise CorruptScene(
            f"must be opengl or opencv, is {str(value)[:40]!r}.",
            where=f"{MANIFEST}: {key}",
            hint="It names the camera axes of transforms.json.",
        )
    return value


def _direction(key: str, value: Any) -> tuple[float, float, float]:
    vector = numbers(value, (3,), f"{MANIFEST}: {key}")
    length = float(np.linalg.norm(vector))
    if length < 1e-6:
        raise CorruptScene("must not be zero.", where=f"{MANIFEST}: {key}")
    x, y, z = (float(v) for v in vector / length)
    return x, y, z


def _similarity(key: str, value: Any) -> Float64[np.ndarray, "4 4"]:
    matrix = numbers(value, (4, 4), f"{MANIFEST}: {key}")
    # A similarity has A A^T = s^2 I; a negative determinant would mirror.
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    gram = matrix[:3, :3] @ matrix[:3, :3].T
    # 1e-4: matrices printed with 5 digits pass.
    if not 1e-6 < scale < 1e6 or np.abs(gram / scale**2 - np.eye(3)).max() > 1e-4:
        raise CorruptScene(
            "must rotate, translate and scale uniformly: no mirroring, no shear, one scale in 1e-6..1e6.",
            where=f"{MANIFEST}: {key}",
        )
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise CorruptScene("the last row must be 0 0 0 1.", where=f"{MANIFEST}: {key}")
    return matrix


def _length(key: str, value: Any) -> float:
    number = float(numbers(value, (), f"{MANIFEST}: {key}"))
    if number <= 0:
        raise CorruptScene(f"must be positive, is {number}.", where=f"{MANIFEST}: {key}")
    return number


def _size(key: str, value: Any) -> tuple[int, int]:
    size = numbers(value, (2,), f"{MANIFEST}: {key}")
    if size.min() < 1 or size.max() > 100_000 or np.any(size != np.round(size)):
        raise CorruptScene("must be width and height in whole pixels.", where=f"{MANIFEST}: {key}")
    return int(size[0]), int(size[1])


def _geo_anchor(key: str, value: Any) -> GeoAnchor:
    where, names = f"{MANIFEST}: {key}", ("latitude", "longitude", "height", "enu_from_world")
    if not isinstance(value, dict) or value.keys() != set(names):
        raise CorruptScene(f"must be an object with exactly the keys {', '.join(names)}.", where=where)
    latitude, longitude, height = (float(numbers(value[n], (), f"{where}.{n}")) for n in names[:3])
    # 20 km: deeper than any sea, higher than any aircraft that takes photos.
    for name, number, bound in (("latitude", latitude, 90), ("longitude", longitude, 180), ("height", height, 2e4)):
        if abs(number) > bound:
            raise CorruptScene(f"must lie in -{bound:g}..{bound:g}, is {number}.", where=f"{where}.{name}")
    return GeoAnchor(latitude, longitude, height, _similarity(f"{key}.enu_from_world", value["enu_from_world"]))


def require_render_mode(mode: Any, where: str) -> Literal["default", "antialiased"]:
    """Return the render mode if it is supported. Raises UnsupportedFormat, which names it."""
    if mode == "default" or mode == "antialiased":
        return mode
    raise UnsupportedFormat(
        f"render mode {str(mode)[:40]!r} is not supported; known: default, antialiased.",
        where=where,
        hint="2DGS scenes and other variants need another renderer: train the scene with plain 3DGS.",
    )


_READERS = {
    "name": _text,
    "file": _file,
    "convention": _choice,
    "up": _direction,
    "world_from_scene": _similarity,
    "metres_per_unit": _length,
    "background": lambda key, value: colour(f"{MANIFEST}: {key}", value),
    "training_size": _size,
    "render_mode": lambda key, value: require_render_mode(value, f"{MANIFEST}: {key}"),
    "geo_anchor": _geo_anchor,
}
