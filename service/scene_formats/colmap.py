"""Read training cameras from a COLMAP model (`sparse/0`), binary or text.

COLMAP has the axes (x right, y down, z forward), pixel centres at half integers and the quaternion order wxyz that are
used here; it stores camera_from_world. Of a distorted camera the pinhole part is kept: 3DGS trains on undistorted
photos, and views of the scene are rendered by a pinhole anyway. Formats: https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from service.errors import CorruptScene, InvalidIntrinsics, InvalidPrior
from service.geometry import rotation_from_quat
from service.types import Camera, Intrinsics, NamedCamera, Pose

_MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4), 16: ("EUCM", 6),
}  # fmt: skip
"""COLMAP's number of a camera model -> its name and number of parameters."""
_ONE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_DIVISION",
              "SIMPLE_FISHEYE"}  # fmt: skip
_NO_PINHOLE = {17: " (EQUIRECTANGULAR)"}
"""Models without a focal length."""
MAX_FILE_BYTES = 2 * 1024**3


@dataclass(frozen=True, slots=True)
class _Image:
    name: str
    camera_id: int
    quat_translation: tuple[float, ...]
    """camera_from_world: wxyz, then x y z."""


def read_cameras(folder: Path, keep: Callable[[str], bool]) -> tuple[NamedCamera, ...]:
    """Return the cameras of the photos for whose names `keep` is true, sorted by name. Raises CorruptScene."""
    binary = (folder / "images.bin").is_file()
    suffix = "bin" if binary else "txt"
    paths = [folder / f"{name}.{suffix}" for name in ("cameras", "images")]
    for path in paths:
        if not path.is_file():
            raise CorruptScene("the file is missing beside its twin.", where=f"{folder.name}/{path.name}")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise CorruptScene(f"larger than {MAX_FILE_BYTES} bytes.", where=path.name)
    try:
        intrinsics = (_binary_cameras if binary else _text_cameras)(paths[0])
        images = _binary_images(paths[1]) if binary else _text_images(paths[1])
        cameras = [_camera(i, intrinsics[i.camera_id]) for i in images if keep(i.name)]
    except (struct.error, ValueError, KeyError, IndexError) as error:
        raise CorruptScene(f"not a COLMAP model: {error}.", where=str(folder.name)) from None
    except (InvalidIntrinsics, InvalidPrior) as error:
        raise CorruptScene(str(error), where=f"{folder.name}/*.{suffix}") from None
    return tuple(sorted(cameras, key=lambda c: c.name))


def read_poses(path: Path) -> list[tuple[str, Pose]]:
    """Return names and poses of an images.bin or images.txt, which needs no cameras beside it. Raises CorruptScene."""
    try:
        images = _binary_images(path) if path.suffix == ".bin" else _text_images(path)
        return [(image.name, _pose_of(image)) for image in images]
    except (struct.error, ValueError, IndexError, InvalidPrior) as error:
        raise CorruptScene(f"not COLMAP's images: {error}.", where=path.name) from None


def _binary_cameras(path: Path) -> dict[int, Intrinsics]:
    data, at = path.read_bytes(), 8  # behind the count
    result = {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        if model not in _MODELS:
            raise ValueError(f"camera {number} has the camera model {model}{_NO_PINHOLE.get(model, '')}, not read here")
        name, count = _MODELS[model]
        result[number] = _intrinsics(name, width, height, list(struct.unpack_from(f"<{count}d", data, at + 24)))
        at += 24 + 8 * count
    return result


def _binary_images(path: Path) -> list[_Image]:
    data, at = path.read_bytes(), 8  # behind the count
    result = []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        values = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8", "replace")
        # Each image's 2D points follow (x, y, id of the 3D point: 24 bytes); they are skipped.
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        if at > len(data):
            raise ValueError(f"images.bin ends within '{name}'")
        result.append(_Image(name, values[8], values[1:8]))
    return result


def _text_cameras(path: Path) -> dict[int, Intrinsics]:
    result = {}
    known = {name for name, _ in _MODELS.values()}
    for line in _lines(path):
        if line.strip():
            number, model, width, height, *parameters = line.split()
            if model not in known:
                raise ValueError(f"camera {number} has the camera model {model[:40]}, not read here")
            result[int(number)] = _intrinsics(model, int(width), int(height), [float(p) for p in parameters])
    return result


def _text_images(path: Path) -> list[_Image]:
    """Parse images.txt: two lines an image; the second one, its points, may be empty. Other blank lines don't count."""
    lines, result = iter(_lines(path)), []
    for line in lines:
        if not line.strip():
            continue
        words = line.split(maxsplit=9)  # a file name may contain spaces
        pose = tuple(float(word) for word in words[1:8])
        result.append(_Image(words[9].strip(), int(words[8]), pose))
        if len(next(lines, "").split()) % 3:
            raise ValueError(f"no line of points (x y id ..., or empty) follows '{words[9].strip()}' in {path.name}")
    return result


def read_points(folder: Path) -> Float64[np.ndarray, "p 3"] | None:
    """Return the positions in points3D; None where there is no such file, or it can't be read."""
    binary, text = folder / "points3D.bin", folder / "points3D.txt"
    try:
        if binary.is_file() and binary.stat().st_size <= MAX_FILE_BYTES:
            return _binary_points(binary.read_bytes())
        if text.is_file() and text.stat().st_size <= MAX_FILE_BYTES:
            rows = [line.split(maxsplit=4)[1:4] for line in _lines(text) if line.strip()]
            return np.array(rows, np.float64).reshape(-1, 3)
    except (struct.error, ValueError, CorruptScene):
        pass
    return None


def _binary_points(data: bytes) -> Float64[np.ndarray, "p 3"]:
    """Each point is 51 bytes (id, x y z, colour, error, length of its track), then 8 for each image that sees it."""
    found, at = [], 8  # behind the count
    for _ in range(struct.unpack_from("<Q", data)[0]):
        *position, track = struct.unpack_from("<3d11xQ", data, at + 8)
        found.append(position)
        at += 51 + 8 * track
    return np.array(found, np.float64).reshape(-1, 3)


def _lines(path: Path) -> list[str]:
    """Return the lines that are no comments. Raises CorruptScene for another encoding than UTF-8."""
    try:
        text = path.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CorruptScene(f"not UTF-8: {error}.", where=path.name, hint="Save it as UTF-8.") from None
    return [line for line in text.splitlines() if not line.startswith("#")]


def _intrinsics(model: str, width: int, height: int, parameters: list[float]) -> Intrinsics:
    if model in _ONE_FOCAL:
        parameters = [parameters[0], *parameters]
    fx, fy, cx, cy = parameters[:4]
    return Intrinsics(width, height, fx, fy, cx, cy)


def _camera(image: _Image, intrinsics: Intrinsics) -> NamedCamera:
    return NamedCamera(image.name, Camera(intrinsics, _pose_of(image)))


def _pose_of(image: _Image) -> Pose:
    quat, translation = np.array(image.quat_translation[:4]), np.array(image.quat_translation[4:])
    if not np.linalg.norm(quat) > 1e-9:
        raise ValueError(f"the quaternion of '{image.name}' has length zero")
    # The inverse of (R, t) is (R^T, -R^T t).
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = rotation_from_quat(quat).T
    world_from_camera[:3, 3] = -world_from_camera[:3, :3] @ translation
    return Pose(world_from_camera)
