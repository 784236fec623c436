"""A job's pose, or a sequence's, in the words of other programs."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

import numpy as np

from service.errors import NoGeoAnchor
from service.photos.intrinsics import ONE_FOCAL
from service.results import Status
from service.types import Pose
from service.web.schemas.conversion import pose_out
from service.web.schemas.job_results import FrameOut, Result
from service.web.schemas.poses import IntrinsicsOut, PoseOut

ExportFormat = Literal["colmap", "nerfstudio", "tum", "geopose"]
EXPORT_TYPES: dict[ExportFormat, str] = {
    "colmap": "text/plain",
    "nerfstudio": "application/json",
    "tum": "text/plain",
    "geopose": "application/geopose+json",
}


def exported(kind: ExportFormat, photo_name: str, created: datetime, result: Result) -> str:
    """Return the pose, or those of a sequence that were localized, as text. Raises NoGeoAnchor."""
    if result.frames is None:
        places = [_Place(_field(photo_name), created.timestamp(), result.pose)]
    else:
        places = _places(result.frames)
    return _FORMATS[kind](places, result)


def trajectory_of(frames: Sequence[FrameOut]) -> str:
    """Return those that were localized as TUM's tools read them."""
    return "".join(map(_tum_line, _places(frames)))


def _places(frames: Sequence[FrameOut]) -> list[_Place]:
    found = [frame for frame in frames if frame.status is Status.LOCALIZED]
    return [_Place(_field(frame.name), frame.time_s, _pose_of(frame)) for frame in found]


@dataclass(frozen=True, slots=True)
class _Place:
    name: str
    time_s: float
    pose: PoseOut


def _pose_of(frame: FrameOut) -> PoseOut:
    return pose_out(Pose(np.array(frame.world_from_camera.matrix)))


def _field(name: str) -> str:
    return re.sub(r"[^\w./+-]+", "_", name) or "photo.jpg"  # a space or line break would end the field


def _colmap(places: Sequence[_Place], result: Result) -> str:
    """Two lines of images.txt each (the second lists observed points: none), after comments with the camera."""
    k = result.intrinsics
    lines = [f"# cameras.txt: 1 {k.model} {k.width} {k.height} {_numbers(*_colmap_parameters(k))}"]
    lines.append("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
    for number, place in enumerate(places, 1):
        pose = place.pose.camera_from_world
        lines += [f"{number} {_numbers(*pose.quaternion_wxyz, *pose.translation)} 1 {place.name}", ""]
    return "\n".join(lines) + "\n"


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


def _nerfstudio(places: Sequence[_Place], result: Result) -> str:
    """An entry of `frames`, which brings its own intrinsics; of a sequence a file of them."""
    entries = [_nerfstudio_frame(place, result.intrinsics) for place in places]
    return json.dumps({"frames": entries} if result.frames is not None else entries[0], indent=2) + "\n"


def _nerfstudio_frame(place: _Place, k: IntrinsicsOut) -> dict[str, Any]:
    return {
        "file_path": place.name,
        "transform_matrix": place.pose.opengl.world_from_camera.matrix,
        "camera_model": "OPENCV_FISHEYE" if "FISHEYE" in k.model else "OPENCV",
        "w": k.width,
        "h": k.height,
        "fl_x": k.fx,
        "fl_y": k.fy,
        "cx": k.cx,
        "cy": k.cy,
        **dict(zip(_DISTORTION.get(k.model, ()), k.distortion, strict=True)),
    }


def _tum(places: Sequence[_Place], result: Result) -> str:
    """`timestamp tx ty tz qx qy qz qw`, of world_from_camera."""
    return "".join(map(_tum_line, places))


def _tum_line(place: _Place) -> str:
    w, x, y, z = place.pose.world_from_camera.quaternion_wxyz
    return f"{place.time_s:.6f} {_numbers(*place.pose.position, x, y, z, w)}\n"


def _geopose(places: Sequence[_Place], result: Result) -> str:
    """Of a sequence the last."""
    if result.geopose is None:
        raise NoGeoAnchor(
            f"scene '{result.scene.id}' has no place on Earth.",
            where="format",
            hint="Give its scene.json a geo_anchor, and localize again.",
        )
    return result.geopose.model_dump_json(indent=2) + "\n"


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.17g}" for value in values)


_FORMATS: dict[ExportFormat, Callable[[Sequence[_Place], Result], str]] = {
    "colmap": _colmap,
    "nerfstudio": _nerfstudio,
    "tum": _tum,
    "geopose": _geopose,
}
