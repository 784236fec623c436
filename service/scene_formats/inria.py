"""Read what Inria's trainer leaves in its output folder beside the scene: `cameras.json` and `cfg_args`.

Rotations are world_from_camera, positions the cameras' centres, axes OpenCV's. https://github.com/graphdeco-inria
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import CorruptScene, InvalidIntrinsics, InvalidPrior
from service.scene_formats.manifest import MAX_JSON_BYTES, numbers
from service.types import Camera, Intrinsics, NamedCamera, Pose

CAMERAS, ARGUMENTS = "cameras.json", "cfg_args"
_MAX_ARGUMENT_BYTES = 100_000


def read_cameras(path: Path, keep: Callable[[str], bool]) -> tuple[NamedCamera, ...]:
    """Return the cameras of the photos for whose names `keep` is true, sorted by name. Raises CorruptScene."""
    if path.stat().st_size > MAX_JSON_BYTES:
        raise CorruptScene(f"larger than {MAX_JSON_BYTES} bytes.", where=path.name)
    try:
        entries = json.loads(path.read_text("utf-8"))
    except (ValueError, RecursionError) as error:
        raise CorruptScene(f"not JSON: {str(error)[:200]}.", where=path.name) from None
    if not isinstance(entries, list):
        raise CorruptScene("must be a list of cameras.", where=path.name)
    found = []
    for number, entry in enumerate(entries):
        where = f"{path.name}, camera {number}"
        if not isinstance(entry, dict) or not isinstance(entry.get("img_name"), str):
            raise CorruptScene("a camera needs an 'img_name'.", where=where)
        if keep(entry["img_name"]):
            found.append(_camera(entry, where))
    return tuple(sorted(found, key=lambda camera: camera.name))


def background_of(path: Path) -> tuple[float, float, float] | None:
    """Return white if the scene was trained on it, black if not; None if the file doesn't say."""
    if path.stat().st_size > _MAX_ARGUMENT_BYTES:
        return None
    # `Namespace(sh_degree=3, ...)`: Python, which is searched and never evaluated.
    white = re.search(r"\bwhite_background=(True|False)\b", path.read_text("utf-8", "replace"))
    return None if white is None else (1.0, 1.0, 1.0) if white[1] == "True" else (0.0, 0.0, 0.0)


def _camera(entry: dict[str, Any], where: str) -> NamedCamera:
    matrix = np.eye(4)
    matrix[:3, :3] = numbers(entry.get("rotation"), (3, 3), f"{where}: rotation")
    matrix[:3, 3] = numbers(entry.get("position"), (3,), f"{where}: position")
    size = numbers([entry.get("width"), entry.get("height")], (2,), f"{where}: width, height")
    fx, fy = numbers([entry.get("fx"), entry.get("fy")], (2,), f"{where}: fx, fy")
    width, height = int(size[0]), int(size[1])
    try:
        intrinsics = Intrinsics(width, height, float(fx), float(fy), width / 2, height / 2)
        return NamedCamera(entry["img_name"], Camera(intrinsics, Pose(matrix)))
    except (InvalidIntrinsics, InvalidPrior) as error:
        raise CorruptScene(str(error), where=where) from None
