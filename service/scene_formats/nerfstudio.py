"""Read training cameras from `transforms*.json` of nerfstudio and Blender (NeRF-Synthetic).

Their camera axes are OpenGL's (+y up, -z forward) unless the manifest has "convention": "opencv". Intrinsics are given
for a frame or for the whole file; Blender's files have only `camera_angle_x`, the horizontal field of view in radians.
Distortion is left out, as in `colmap`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import CorruptScene, InvalidImage, InvalidIntrinsics, InvalidPrior
from service.photos.images import photo_size
from service.scene_formats.manifest import Manifest, colour, numbers, read_json
from service.types import Camera, Intrinsics, NamedCamera, Pose

DATAPARSER = "dataparser_transforms.json"
"""What nerfstudio writes beside its models: how its trainer moved and scaled the cameras."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Of camera axes; its own inverse."""
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".webp")
"""Blender's file paths have no suffix."""


@dataclass(frozen=True, slots=True)
class TransformsFile:
    """A parsed file. A frame is checked when its camera is requested: a broken one that is not used is no error."""

    path: Path
    data: dict[str, Any]
    frames: dict[str, dict[str, Any]]
    """By the photo's path, without a leading './'."""

    @classmethod
    def open(cls, path: Path) -> TransformsFile:
        """Parse the file and index its frames by photo. Raises CorruptScene."""
        data = read_json(path)
        frames = data.get("frames")
        if not isinstance(frames, list):
            raise CorruptScene("'frames' must be a list.", where=path.name)
        by_name = {}
        for index, frame in enumerate(frames):
            name = frame.get("file_path") if isinstance(frame, dict) else None
            if not isinstance(name, str) or not name:
                raise CorruptScene("a frame needs a 'file_path'.", where=f"{path.name}, frame {index}")
            by_name[normalized(name)] = frame
        return cls(path, data, by_name)

    def split(self, kind: str) -> list[str] | None:
        """Return the photos listed as train, test or val; None if the file has no such list."""
        names = self.data.get(f"{kind}_filenames")
        if names is None:
            return None
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise CorruptScene("must be a list of file names.", where=f"{self.path.name}: {kind}_filenames")
        return [normalized(n) for n in names]

    def training_photos(self) -> list[str]:
        """Return the photos in `train_filenames`; without that list, all but those of the other lists."""
        # Test photos must not be training cameras: a bench would find its answers in the index.
        listed = self.split("train")
        if listed is not None:
            return [name for name in self.frames if name in set(listed)]
        others = {*(self.split("test") or ()), *(self.split("val") or ())}
        return [name for name in self.frames if name not in others]

    def background(self) -> tuple[float, float, float] | None:
        """Return the background colour (0..1) that the scene was trained with, if the file has one."""
        value = self.data.get("background")
        return None if value is None else colour(f"{self.path.name}: background", value)

    def camera(self, photo: str, manifest: Manifest) -> NamedCamera:
        """Return a photo's camera, in the scene file's frame and OpenCV axes. Raises CorruptScene."""
        frame = self.frames[photo]
        where = f"{self.path.name}, frame '{photo[:100]}'"
        matrix = numbers(frame.get("transform_matrix"), (4, 4), f"{where}: transform_matrix")
        if manifest.convention == "opengl":
            matrix = matrix @ OPENCV_FROM_OPENGL
        try:
            # A frame's own values take precedence over the file's.
            intrinsics = self._intrinsics({**self.data, **frame}, photo, manifest, where)
            return NamedCamera(photo, Camera(intrinsics, Pose(matrix)))
        except (InvalidIntrinsics, InvalidPrior) as error:
            raise CorruptScene(str(error), where=where) from None

    def _intrinsics(self, values: dict[str, Any], photo: str, manifest: Manifest, where: str) -> Intrinsics:
        width, height = self._size(values, photo, manifest, where)

        def number(key: str, default: float | None = None) -> float:
            value = values.get(key, default)
            return float(numbers(value, (), f"{where}: {key}"))

        if "fl_x" in values:
            fx = number("fl_x")
        else:
            fx = float(width / 2 / np.tan(number("camera_angle_x") / 2))
        return Intrinsics(width, height, fx, number("fl_y", fx), number("cx", width / 2), number("cy", height / 2))

    def _size(self, values: dict[str, Any], photo: str, manifest: Manifest, where: str) -> tuple[int, int]:
        if "w" in values and "h" in values:
            width, height = numbers([values["w"], values["h"]], (2,), f"{where}: w, h")
            return int(width), int(height)
        file = self.photo_file(photo)
        if file is not None:
            try:
                return photo_size(file.read_bytes())
            except InvalidImage as error:
                raise CorruptScene(f"the photo has no size: {error}", where=where) from None
        if manifest.training_size:
            return manifest.training_size
        raise CorruptScene(
            "the size of the photo is unknown: no 'w' and 'h', and the photo is not there.",
            where=where,
            hint="Add w and h, or training_size to scene.json.",
        )

    def photo_file(self, photo: str) -> Path | None:
        """Return the path of the photo if it exists within the folder."""
        folder = self.path.parent.resolve()  # a path out of the folder, or a link, must not be followed
        try:
            files = [(folder / (photo + suffix)).resolve() for suffix in _SUFFIXES]
            return next((f for f in files if f.is_relative_to(folder) and f.is_file()), None)
        except (OSError, ValueError):  # too long a name, or no name that a file could have
            return None


def transforms_of(cameras: Sequence[NamedCamera]) -> dict[str, Any]:
    """Return cameras as the content of a `transforms.json`: OpenGL's axes, and intrinsics in each frame."""
    return {"frames": [_frame(named) for named in cameras]}


def _frame(named: NamedCamera) -> dict[str, Any]:
    k = named.camera.intrinsics
    matrix = named.camera.pose.world_from_camera @ OPENCV_FROM_OPENGL
    intrinsics = {"w": k.width, "h": k.height, "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy}
    return {"file_path": named.name, "transform_matrix": matrix.tolist(), **intrinsics}


def transforms_path(folder: Path) -> Path | None:
    """Find the file with the training cameras: transforms_train.json, then transforms.json, then any other."""
    for name in ("transforms_train.json", "transforms.json"):
        if (folder / name).is_file():
            return folder / name
    others = sorted(folder.glob("transforms*.json"))
    return next((p for p in others if not p.stem.endswith(("_test", "_val"))), None)


def normalized(photo: str) -> str:
    """Return the path with forward slashes and no leading './'."""
    return photo.replace("\\", "/").removeprefix("./")
