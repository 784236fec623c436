"""A job's pose in the words of other programs."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from datetime import datetime
from typing import Literal

from service.api.schemas import IntrinsicsOut, Result
from service.errors import NoGeoAnchor
from service.images import ONE_FOCAL

ExportFormat = Literal["colmap", "nerfstudio", "tum", "geopose"]
EXPORT_TYPES: dict[ExportFormat, str] = {
    "colmap": "text/plain",
    "nerfstudio": "application/json",
    "tum": "text/plain",
    "geopose": "application/geopose+json",
}


def exported(kind: ExportFormat, photo_name: str, created: datetime, result: Result) -> str:
    """Return the pose as text. Raises NoGeoAnchor."""
    name = re.sub(r"[^\w./+-]+", "_", photo_name) or "photo.jpg"  # a space or line break would end the field
    return _FORMATS[kind](name, created, result)


def _colmap(name: str, created: datetime, result: Result) -> str:
    """Two lines of images.txt (the second lists observed points: none), after comments with the camera."""
    pose = result.pose.camera_from_world
    k = result.intrinsics
    camera = _numbers(*_colmap_parameters(k))
    return (
        f"# cameras.txt: 1 {k.model} {k.width} {k.height} {camera}\n"
        "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n"
        f"1 {_numbers(*pose.quaternion_wxyz, *pose.translation)} 1 {name}\n"
        "\n"
    )


def _colmap_parameters(k: IntrinsicsOut) -> list[float]:
    return [*([k.fx] if k.model in ONE_FOCAL else [k.fx, k.fy]), k.cx, k.cy, *k.distortion]


# nerfstudio's names of COLMAP's parameters after the principal point.
_FISHEYE = ("k1", "k2", "k3", "k4")
_DISTORTION = {
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_RADIAL_FISHEYE": _FISHEYE[:1],
    "RADIAL_FISHEYE": _FISHEYE[:2],
    "OPENCV_FISHEYE": _FISHEYE,
}


def _nerfstudio(name: str, created: datetime, result: Result) -> str:
    """An entry of `frames`, which brings its own intrinsics."""
    k = result.intrinsics
    frame = {
        "file_path": name,
        "transform_matrix": result.pose.opengl.world_from_camera.matrix,
        "camera_model": "OPENCV_FISHEYE" if "FISHEYE" in k.model else "OPENCV",
        "w": k.width,
        "h": k.height,
        "fl_x": k.fx,
        "fl_y": k.fy,
        "cx": k.cx,
        "cy": k.cy,
        **dict(zip(_DISTORTION.get(k.model, ()), k.distortion, strict=True)),
    }
    return json.dumps(frame, indent=2) + "\n"


def _tum(name: str, created: datetime, result: Result) -> str:
    """`timestamp tx ty tz qx qy qz qw`, of world_from_camera."""
    w, x, y, z = result.pose.world_from_camera.quaternion_wxyz
    return f"{created.timestamp():.6f} {_numbers(*result.pose.position, x, y, z, w)}\n"


def _geopose(name: str, created: datetime, result: Result) -> str:
    if result.geopose is None:
        raise NoGeoAnchor(
            f"scene '{result.scene.id}' has no place on Earth.",
            where="format",
            hint="Give its scene.json a geo_anchor, and localize again.",
        )
    return result.geopose.model_dump_json(indent=2) + "\n"


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.17g}" for value in values)


_FORMATS: dict[ExportFormat, Callable[[str, datetime, Result], str]] = {
    "colmap": _colmap,
    "nerfstudio": _nerfstudio,
    "tum": _tum,
    "geopose": _geopose,
}
