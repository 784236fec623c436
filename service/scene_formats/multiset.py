"""Read the training poses of MultiSet's ZIP, `poses.json`, which lies beside a .ply.

A pose has a time (`ts`), a position (`T`) and a quaternion (`R`, xyzw): world_from_camera, in the scene file's frame.
The file has no lens, and its description no camera axes: OpenCV's are taken, and as for any camera file it is tried
whether others fit. https://docs.multiset.ai/basics/third-party-scans/gaussian-splat
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import CorruptScene, InvalidPrior
from service.geometry import rotation_from_quat
from service.scene_formats.manifest import numbers, read_json
from service.types import Camera, Intrinsics, NamedCamera, Pose

POSES = "poses.json"
_ASSUMED = Intrinsics(960, 720, 700.0, 700.0, 480.0, 360.0)
"""A phone's main camera: views are placed with it."""
_LEAST_NORM = 1e-6


def is_of_multiset(path: Path) -> bool:
    """Whether a file is there and has these poses: other programs call theirs `poses.json`, too."""
    try:
        entries = read_json(path).get("poses") if path.is_file() else None
    except CorruptScene:
        return False
    return isinstance(entries, list) and all(isinstance(e, dict) and {"T", "R"} <= e.keys() for e in entries)


def read_cameras(path: Path, keep: Callable[[str], bool]) -> tuple[NamedCamera, ...]:
    """Return a camera for each pose whose time, as its name, `keep` is true of. Raises CorruptScene."""
    entries = read_json(path)["poses"]
    found = [_camera(entry, f"{path.name}, pose {number}") for number, entry in enumerate(entries)]
    return tuple(camera for camera in found if keep(camera.name))


def _camera(entry: dict[str, Any], where: str) -> NamedCamera:
    if not isinstance(entry.get("ts"), str | int | float):
        raise CorruptScene("a pose needs a 'ts'.", where=where)
    xyzw = numbers(entry.get("R"), (4,), f"{where}: R")
    norm = float(np.linalg.norm(xyzw))
    if norm < _LEAST_NORM:
        raise CorruptScene("must not be zero.", where=f"{where}: R")
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_quat(np.roll(xyzw, 1) / norm)
    matrix[:3, 3] = numbers(entry.get("T"), (3,), f"{where}: T")
    try:
        return NamedCamera(str(entry["ts"]), Camera(_ASSUMED, Pose(matrix)))
    except InvalidPrior as error:
        raise CorruptScene(str(error), where=where) from None
