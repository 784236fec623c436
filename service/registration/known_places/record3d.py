"""Poses of Record3D's `metadata` (also `metadata.json`): all frames of one recording, as the app exports it.

`poses` are lists of qx, qy, qz, qw, x, y, z: ARKit's world_from_camera in metres, y up, OpenGL's camera axes; `K` is
the 3x3 camera matrix, column by column, of photos of `w` x `h`. Frame n is the photo `n.jpg`.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from service.errors import BadInput, InvalidRequest
from service.photos.intrinsics import intrinsics_from
from service.registration.known_places.ar_session import ARKIT_DRIFT
from service.registration.known_places.known_place import KnownPlace, KnownPlaces, rotation_of
from service.scene_formats.nerfstudio import OPENCV_FROM_OPENGL
from service.types import Intrinsics


def accepts(head: str, name: str) -> bool:
    """Whether a file is Record3D's metadata."""
    return head.lstrip().startswith("{") and '"frames"' not in head and name.partition(".")[0] == "metadata"


def read(text: str, name: str) -> KnownPlaces:
    """Parse the poses of all frames. Raises InvalidRequest with the frame."""
    try:
        data = json.loads(text)
        poses = np.array(data["poses"], np.float64).reshape(-1, 7)
    except (ValueError, KeyError, TypeError):
        raise InvalidRequest("'poses' must be a list of qx, qy, qz, qw, x, y, z.", where=name) from None
    if not len(poses) or not np.all(np.isfinite(poses)):
        raise InvalidRequest("'poses' must be finite numbers, at least of one pose.", where=name)
    intrinsics = _intrinsics(data, name)
    rate = data.get("fps")
    places = []
    for number, (x, y, z, w, *position) in enumerate(poses.tolist()):
        rotation = rotation_of([w, x, y, z], f"{name}, pose {number}") @ OPENCV_FROM_OPENGL[:3, :3]
        time = number / float(rate) if isinstance(rate, int | float) and rate > 0 else None
        places.append(
            KnownPlace(f"{number}.jpg", np.array(position), None, rotation, time_s=time, intrinsics=intrinsics)
        )
    return KnownPlaces("record3d", tuple(places), up=(0.0, 1.0, 0.0), drift=ARKIT_DRIFT, may_be_turned=True)


def _intrinsics(data: dict[str, Any], name: str) -> Intrinsics | None:
    if not {"K", "w", "h"} <= data.keys():
        return None
    try:
        k = np.array(data["K"], np.float64).reshape(3, 3).T
        lens = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
        return intrinsics_from({"width": data["w"], "height": data["h"], **lens, "trust": "approximate"})
    except (ValueError, TypeError, BadInput) as error:
        raise InvalidRequest(f"K, w and h are no camera: {error}", where=name) from None
