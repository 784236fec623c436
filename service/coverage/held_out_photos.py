"""Photos of a scene's folder that it was not trained on, with their true cameras: what a map is calibrated on.

They are the `test_filenames` of a nerfstudio file, or those of a `truth.json` (scenes/studio). A photo that is listed
nowhere counts as trained on.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.errors import CorruptScene, SplatfixError
from service.photos.intrinsics import intrinsics_from
from service.scene_formats.manifest import read_manifest
from service.scene_formats.nerfstudio import TransformsFile, transforms_path
from service.scene_formats.similarity import moved_pose
from service.types import Camera, Pose

TRUTH = "truth.json"


@dataclass(frozen=True, slots=True)
class HeldOutPhoto:
    """A photo that the scene was not trained on, with the camera that took it."""

    name: str
    path: Path
    camera: Camera
    """The true one, in the world."""


def held_out_photos(folder: Path) -> list[HeldOutPhoto]:
    """Return the photos of a scene's folder that are there; none of a scene file. Raises CorruptScene."""
    if not folder.is_dir():
        return []
    if (folder / TRUTH).is_file():
        return _from_truth(folder)
    path = transforms_path(folder)
    if path is None:
        return []
    file, manifest = TransformsFile.open(path), read_manifest(folder)
    found = []
    for name in file.split("test") or ():
        # A split may name photos that were never posed, and data sets are published without their photos.
        photo = file.photo_file(name) if name in file.frames else None
        if photo is not None:
            camera, world_from_scene = file.camera(name, manifest).camera, manifest.world_from_scene
            if world_from_scene is not None:
                camera = Camera(camera.intrinsics, moved_pose(camera.pose, world_from_scene))
            found.append(HeldOutPhoto(name, photo, camera))
    return found


def _from_truth(folder: Path) -> list[HeldOutPhoto]:
    found = []
    try:
        entries = json.loads((folder / TRUTH).read_text("utf-8"))
        if not isinstance(entries, list):
            raise TypeError(type(entries).__name__)
        for entry in entries:
            name = entry["photo"]
            photo = next((p for p in (folder / name, folder / "photos" / name) if p.is_file()), None)
            if photo is not None:
                pose = Pose(np.array(entry["world_from_camera"], np.float64))
                found.append(HeldOutPhoto(name, photo, Camera(intrinsics_from(entry["intrinsics"]), pose)))
    except (ValueError, TypeError, KeyError, AttributeError, SplatfixError) as error:
        raise CorruptScene(f"not a list of photos with their truth: {error!r}.", where=TRUTH) from None
    return found
