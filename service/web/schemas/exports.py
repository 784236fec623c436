"""Exports of poses as text: COLMAP, nerfstudio, TUM trajectories, OGC GeoPose."""

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
from service.smoothing import TimedPose, smoothed
from service.types import Pose
from service.web.schemas.conversion import covariance_out, pose_out, transform_out
from service.web.schemas.job_results import FrameOut, Result
from service.web.schemas.poses import IntrinsicsOut, PoseOut

ExportFormat = Literal["colmap", "nerfstudio", "tum", "geopose"]
EXPORT_TYPES: dict[ExportFormat, str] = {
    "colmap": "text/plain",
    "nerfstudio": "application/json",
    "tum": "text/plain",
    "geopose": "application/geopose+json",
}


_INTERPOLATED = "# interpolated: the next photo was not localized itself"
"""A comment in COLMAP's and TUM's files."""


def exported(kind: ExportFormat, photo_name: str, created: datetime, result: Result, *, smooth: bool = False) -> str:
    """Return the pose, or all localized poses of a sequence, as text; `smooth` filters a sequence's jitter, and joins
    short gaps (`service/smoothing.py`). Raises NoGeoAnchor."""
    if result.frames is None:
        poses = [_NamedPose(_field(photo_name), created.timestamp(), result.pose)]
    else:
        poses = _smoothed(result.frames) if smooth else _localized(result.frames)
    return _FORMATS[kind](poses, result)


def trajectory_of(frames: Sequence[FrameOut], *, smooth: bool = False) -> str:
    """Return the localized frames as a TUM trajectory: `timestamp tx ty tz qx qy qz qw`."""
    return "".join(map(_tum_line, _smoothed(frames) if smooth else _localized(frames)))


def smoothed_frames(frames: Sequence[FrameOut]) -> list[tuple[FrameOut, bool]]:
    """Return the frames with smoothed poses, and whether each is interpolated; without those that no pose is known of.

    An interpolated frame keeps its own status, which is not `localized`.
    """
    timed = [
        TimedPose(
            frame.time_s,
            Pose(np.array(frame.world_from_camera.matrix)) if frame.status is Status.LOCALIZED else None,
            None if frame.covariance is None else np.array(frame.covariance.matrix),
        )
        for frame in frames
    ]
    found = []
    for frame, answer in zip(frames, smoothed(timed), strict=True):
        if answer is not None:
            pose = transform_out(answer.pose.world_from_camera)
            update = {"world_from_camera": pose, "covariance": covariance_out(answer.covariance)}
            found.append((frame.model_copy(update=update), answer.interpolated))
    return found


def _smoothed(frames: Sequence[FrameOut]) -> list[_NamedPose]:
    return [
        _NamedPose(_field(frame.name), frame.time_s, _pose_of(frame), interpolated)
        for frame, interpolated in smoothed_frames(frames)
    ]


def _localized(frames: Sequence[FrameOut]) -> list[_NamedPose]:
    found = [frame for frame in frames if frame.status is Status.LOCALIZED]
    return [_NamedPose(_field(frame.name), frame.time_s, _pose_of(frame)) for frame in found]


@dataclass(frozen=True, slots=True)
class _NamedPose:
    name: str
    time_s: float
    pose: PoseOut
    interpolated: bool = False


def _pose_of(frame: FrameOut) -> PoseOut:
    return pose_out(Pose(np.array(frame.world_from_camera.matrix)))


def _field(name: str) -> str:
    return re.sub(r"[^\w./+-]+", "_", name) or "photo.jpg"  # the formats separate fields by spaces and line breaks


def _colmap(poses: Sequence[_NamedPose], result: Result) -> str:
    """Two lines of images.txt for each pose (the second for observed points: none), after a comment with the camera."""
    k = result.intrinsics
    lines = [f"# cameras.txt: 1 {k.model} {k.width} {k.height} {_numbers(*_colmap_parameters(k))}"]
    lines.append("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
    for number, named in enumerate(poses, 1):
        pose = named.pose.camera_from_world
        lines += [_INTERPOLATED] if named.interpolated else []
        lines += [f"{number} {_numbers(*pose.quaternion_wxyz, *pose.translation)} 1 {named.name}", ""]
    return "\n".join(lines) + "\n"


def _colmap_parameters(k: IntrinsicsOut) -> list[float]:
    return [*([k.fx] if k.model in ONE_FOCAL else [k.fx, k.fy]), k.cx, k.cy, *k.distortion]


# Names in nerfstudio of the COLMAP parameters after the principal point, in their order.
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


def _nerfstudio(poses: Sequence[_NamedPose], result: Result) -> str:
    """An entry of `frames` with its intrinsics; for a sequence an object with all entries."""
    entries = [_nerfstudio_frame(named, result.intrinsics) for named in poses]
    for named, entry in zip(poses, entries, strict=True):
        if named.interpolated:
            entry["interpolated"] = True
    return json.dumps({"frames": entries} if result.frames is not None else entries[0], indent=2) + "\n"


def _nerfstudio_frame(named: _NamedPose, k: IntrinsicsOut) -> dict[str, Any]:
    return {
        "file_path": named.name,
        # nerfstudio has OpenGL's camera axes.
        "transform_matrix": named.pose.opengl.world_from_camera.matrix,
        "camera_model": "OPENCV_FISHEYE" if "FISHEYE" in k.model else "OPENCV",
        "w": k.width,
        "h": k.height,
        "fl_x": k.fx,
        "fl_y": k.fy,
        "cx": k.cx,
        "cy": k.cy,
        # strict: a model whose parameters are named here must have as many.
        **dict(zip(_DISTORTION.get(k.model, ()), k.distortion, strict=True)),
    }


def _tum(poses: Sequence[_NamedPose], result: Result) -> str:
    """`timestamp tx ty tz qx qy qz qw`, of world_from_camera."""
    return "".join(map(_tum_line, poses))


def _tum_line(named: _NamedPose) -> str:
    # TUM has the scalar part last.
    w, x, y, z = named.pose.world_from_camera.quaternion_wxyz
    line = f"{named.time_s:.6f} {_numbers(*named.pose.position, x, y, z, w)}\n"
    return f"{_INTERPOLATED}\n{line}" if named.interpolated else line


def _geopose(poses: Sequence[_NamedPose], result: Result) -> str:
    """The pose on Earth; of a sequence the last one."""
    if result.geopose is None:
        raise NoGeoAnchor(
            f"scene '{result.scene.id}' has no geo_anchor.",
            where="format",
            hint="Give its scene.json a geo_anchor, and localize again.",
        )
    return result.geopose.model_dump_json(indent=2) + "\n"


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.17g}" for value in values)


_FORMATS: dict[ExportFormat, Callable[[Sequence[_NamedPose], Result], str]] = {
    "colmap": _colmap,
    "nerfstudio": _nerfstudio,
    "tum": _tum,
    "geopose": _geopose,
}
