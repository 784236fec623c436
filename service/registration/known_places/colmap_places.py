"""Poses of the photos of a COLMAP model: of the folder with `images.bin` or `images.txt`, or with a `sparse/0`.

The target frame is the model's, in metres if it was georegistered or scaled.
"""

from __future__ import annotations

from pathlib import Path

from service.errors import InvalidRequest
from service.registration.known_places.known_place import KnownPlace, KnownPlaces
from service.scene_formats.colmap import read_cameras
from service.scene_formats.layouts import COLMAP_FOLDER


def read(folder: Path) -> KnownPlaces:
    """Read the poses. Raises InvalidRequest, CorruptScene."""
    for place in (folder, folder / COLMAP_FOLDER):
        if any((place / f"images.{suffix}").is_file() for suffix in ("bin", "txt")):
            cameras = read_cameras(place, lambda _: True)
            break
    else:
        raise InvalidRequest("holds no COLMAP model (images.bin or images.txt).", where=str(folder))
    places = []
    for named in cameras:
        pose = named.camera.pose
        places.append(KnownPlace(named.name, pose.position_in_world, None, pose.world_from_camera[:3, :3]))
    return KnownPlaces("colmap", tuple(places))
