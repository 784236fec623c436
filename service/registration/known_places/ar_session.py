"""Poses of an AR session in `transforms.json`, as nerfcapture and other ARKit recorders write it.

`transform_matrix` is ARKit's `camera.transform`: metres, y up by gravity, OpenGL's camera axes, of the sensor's image,
whose long side is horizontal. Apps that store photos upright leave the pose as it is.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from service.errors import BadInput, InvalidRequest
from service.photos.intrinsics import intrinsics_from
from service.registration.known_places.known_place import KnownPlace, KnownPlaces
from service.scene_formats.nerfstudio import OPENCV_FROM_OPENGL
from service.types import Intrinsics, Pose

ARKIT_DRIFT = 0.01
"""Share of the path: what visual-inertial odometry of phones is measured at."""
_LENSES = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}


def accepts(head: str, name: str) -> bool:
    """Whether a file is a transforms.json."""
    return head.lstrip().startswith("{") and '"frames"' in head


def read(text: str, name: str) -> KnownPlaces:
    """Parse the poses of all frames. Raises InvalidRequest with the frame."""
    try:
        data = json.loads(text)
    except ValueError as error:
        raise InvalidRequest(f"not JSON: {error}.", where=name) from None
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InvalidRequest("'frames' must be a list of frames.", where=name)
    places = [_place({**data, **f} if isinstance(f, dict) else {}, f"{name}, frame {i}") for i, f in enumerate(frames)]
    return KnownPlaces("ar_session", tuple(places), up=(0.0, 1.0, 0.0), drift=ARKIT_DRIFT, may_be_turned=True)


def _place(frame: Mapping[str, Any], where: str) -> KnownPlace:
    path = frame.get("file_path")
    if not isinstance(path, str) or not path:
        raise InvalidRequest("a frame needs a 'file_path'.", where=where)
    try:
        pose = Pose(np.array(frame.get("transform_matrix"), np.float64) @ OPENCV_FROM_OPENGL)
    except (BadInput, ValueError, TypeError):
        raise InvalidRequest("'transform_matrix' must be a rigid 4x4 matrix of numbers.", where=where) from None
    time = frame.get("timestamp", frame.get("time_s"))
    return KnownPlace(
        name=path,
        position=pose.position_in_world,
        target_from_camera=pose.world_from_camera[:3, :3],
        time_s=float(time) if isinstance(time, int | float) else None,
        intrinsics=_intrinsics(frame, where),
    )


def _intrinsics(frame: Mapping[str, Any], where: str) -> Intrinsics | None:
    """Return the pinhole camera, which phones' undistorted pictures have; None where it is not stated."""
    stated = {name: frame[key] for key, name in _LENSES.items() if key in frame}
    if len(stated) < len(_LENSES):
        return None
    try:
        return intrinsics_from({**stated, "trust": "approximate"})
    except BadInput as error:
        raise InvalidRequest(str(error), where=where) from None
