"""Poses of photos in the files of others, for `splatfix bench evaluate`. What a file is, its content says.

| content | poses | names |
|---|---|---|
| COLMAP model, a folder or its `images.bin` or `images.txt` | camera_from_world, wxyz | the photos' |
| hloc's results: `name qw qx qy qz tx ty tz` in each line | camera_from_world | often without their folder |
| TUM: `time x y z qx qy qz qw` in each line | world_from_camera | none, but times |
| `dataset_*.txt` of Cambridge Landmarks: `name x y z w p q r` | position, camera_from_world | the photos' |
| folder of 7-Scenes: `*.pose.txt` | world_from_camera, 4 x 4 | without suffix |
| `transforms.json` | world_from_camera, OpenGL's axes | `file_path` |
| JSON list of `{"photo", "world_from_camera"}` | world_from_camera, 4 x 4 | `photo` |
| CSV of `splatfix localize`: `photo, status, x, y, z, qw, qx, qy, qz` | world_from_camera | `photo` |

Axes are OpenCV's but for `transforms.json`. Of our own CSV only localized rows are answers.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from service.errors import InvalidRequest, SceneError
from service.registration.known_places.known_place import rotation_of
from service.results import Status
from service.scene_formats.colmap import read_poses as read_colmap_poses
from service.scene_formats.layouts import COLMAP_FOLDER
from service.scene_formats.nerfstudio import OPENCV_FROM_OPENGL
from service.types import Pose

CAMBRIDGE = "Visual Landmark Dataset"
"""First words of Cambridge Landmarks' files, whose lines look like hloc's otherwise."""
SEVEN_SCENES_SUFFIX = ".pose.txt"


@dataclass(frozen=True, slots=True)
class PhotoPose:
    """A photo's pose in a file."""

    name: str
    """Empty in a trajectory."""
    pose: Pose
    time_s: float | None = None


def read_pose_file(path: Path) -> list[PhotoPose]:
    """Read a file's or a folder's poses. Raises InvalidRequest and CorruptScene with file and line."""
    if not path.exists():
        raise InvalidRequest("there is no such file or folder.", where=str(path))
    found = list(_of_folder(path) if path.is_dir() else _of_file(path))
    if not found:
        raise InvalidRequest("it holds no pose.", where=path.name)
    return found


def _of_folder(folder: Path) -> Iterator[PhotoPose]:
    for place in (folder, folder / COLMAP_FOLDER):
        for name in ("images.bin", "images.txt"):
            if (place / name).is_file():
                yield from _of_file(place / name)
                return
    paths = sorted(folder.rglob(f"*{SEVEN_SCENES_SUFFIX}"))
    if not paths:
        raise InvalidRequest("holds neither images.bin, images.txt nor *.pose.txt.", where=str(folder))
    for path in paths:
        name = path.relative_to(folder).as_posix().removesuffix(SEVEN_SCENES_SUFFIX)
        yield PhotoPose(name, _pose_of(_text(path).split(), path.name))


def _of_file(path: Path) -> Iterator[PhotoPose]:
    if path.suffix == ".bin" or path.name == "images.txt":
        yield from (PhotoPose(name, pose) for name, pose in read_colmap_poses(path))
        return
    text = _text(path)
    if text.lstrip().startswith(("{", "[")):
        yield from _of_json(text, path.name)
    elif path.name.endswith(SEVEN_SCENES_SUFFIX):
        yield PhotoPose(path.name.removesuffix(SEVEN_SCENES_SUFFIX), _pose_of(text.split(), path.name))
    elif path.suffix.lower() == ".csv":
        yield from _of_csv(text, path.name)
    elif text.startswith(CAMBRIDGE):
        yield from _of_lines(text.partition("\n")[2], path.name, "cambridge")
    else:
        words = next((line.split() for line in text.splitlines() if _is_data(line)), [])
        if len(words) >= 10:
            yield from (PhotoPose(name, pose) for name, pose in read_colmap_poses(path))
        else:
            yield from _of_lines(text, path.name, "tum" if words and _is_number(words[0].rstrip(",")) else "hloc")


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InvalidRequest(f"not UTF-8: {error}.", where=path.name) from None


def _is_data(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


# Order of the seven numbers: of the translation and of wxyz; whether they are camera_from_world.
_ORDERS = {
    "hloc": ([4, 5, 6], [0, 1, 2, 3]),
    "tum": ([0, 1, 2], [6, 3, 4, 5]),
    "cambridge": ([0, 1, 2], [3, 4, 5, 6]),
}
_TOLD = {
    "hloc": "name qw qx qy qz tx ty tz",
    "tum": "time x y z qx qy qz qw",
    "cambridge": "name x y z qw qx qy qz",
}


def _of_lines(text: str, file: str, kind: str) -> Iterator[PhotoPose]:
    """Parse lines of a name or a time and seven numbers."""
    for number, line in enumerate(text.splitlines(), 1 + (kind == "cambridge")):
        if not _is_data(line):
            continue
        # A name may contain spaces.
        name, *words = (line.replace(",", " ") if kind == "tum" else line).rsplit(maxsplit=7)
        if kind == "cambridge" and not all(map(_is_number, words)):
            continue  # the titles of the columns
        where = f"{file}, line {number}"
        if len(words) != 7 or not all(map(_is_number, words)):
            raise InvalidRequest(f"must be '{_TOLD[kind]}'.", where=where)
        values = np.array(words, np.float64)
        at, turned = _ORDERS[kind]
        translation, rotation = values[at], rotation_of(values[turned].tolist(), where)
        if kind == "hloc":
            rotation, translation = rotation.T, -rotation.T @ translation
        elif kind == "cambridge":
            rotation = rotation.T
        time = float(name) if kind == "tum" and _is_number(name) else None
        if kind == "tum" and time is None:
            raise InvalidRequest(f"must be '{_TOLD[kind]}'.", where=where)
        yield PhotoPose("" if kind == "tum" else name, _rigid(rotation, translation, where), time)


def _rigid(rotation: Float64[np.ndarray, "3 3"], translation: Float64[np.ndarray, "3"], where: str) -> Pose:
    if not np.all(np.isfinite(translation)):
        raise InvalidRequest("a position must be finite.", where=where)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return Pose(matrix)


def _of_json(text: str, file: str) -> Iterator[PhotoPose]:
    """Parse transforms.json, or a list of photos with matrices."""
    try:
        data = json.loads(text)
    except ValueError as error:
        raise InvalidRequest(f"not JSON: {error}.", where=file) from None
    frames = data.get("frames") if isinstance(data, dict) else data
    name_key, key = ("file_path", "transform_matrix") if isinstance(data, dict) else ("photo", "world_from_camera")
    if not isinstance(frames, list):
        raise InvalidRequest("must have a list 'frames', or be a list of photos.", where=file)
    for index, frame in enumerate(frames):
        where = f"{file}, entry {index}"
        if not isinstance(frame, dict) or not isinstance(frame.get(name_key), str) or key not in frame:
            raise InvalidRequest(f"must have '{name_key}' and '{key}'.", where=where)
        pose = _pose_of(frame[key], where)
        matrix = pose.world_from_camera @ OPENCV_FROM_OPENGL if isinstance(data, dict) else pose.world_from_camera
        yield PhotoPose(frame[name_key], Pose(matrix))


def _pose_of(values: object, where: str) -> Pose:
    """Return the pose of the 16 numbers of a matrix, whose rotation is made exact. Raises InvalidRequest."""
    try:
        matrix = np.array(values, np.float64).reshape(4, 4)
    except (ValueError, TypeError):
        raise InvalidRequest("a pose must be a 4 x 4 matrix.", where=where) from None
    if not np.all(np.isfinite(matrix)) or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InvalidRequest("a pose must be finite, with a last row 0 0 0 1.", where=where)
    u, scales, vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(scales - 1).max() > 1e-2 or np.linalg.det(u @ vt) < 0:
        raise InvalidRequest("the rotation of a pose must be orthogonal and right-handed.", where=where)
    return _rigid(u @ vt, matrix[:3, 3], where)


def _of_csv(text: str, file: str) -> Iterator[PhotoPose]:
    """Parse the table that `splatfix localize --csv` writes, or one with these columns."""
    columns = ("photo", "x", "y", "z", "qw", "qx", "qy", "qz")
    table = csv.DictReader(text.splitlines())
    if missing := [name for name in columns if name not in (table.fieldnames or ())]:
        raise InvalidRequest(f"the table lacks the columns {', '.join(missing)}.", where=file)
    for row in table:
        where = f"{file}, line {table.line_num}"
        if row.get("status") not in (None, Status.LOCALIZED):
            continue
        if not all(_is_number(row[name] or "") for name in columns[1:]):
            raise InvalidRequest(f"{', '.join(columns[1:])} must be numbers.", where=where)
        x, y, z, *wxyz = (float(row[name]) for name in columns[1:])
        yield PhotoPose(row["photo"], _rigid(rotation_of(wxyz, where), np.array([x, y, z]), where))


def read_names(path: Path) -> list[str]:
    """Return the names in a list of photos; of hloc's lists of queries, in which intrinsics follow, too."""
    try:
        lines = [line.strip() for line in path.read_text("utf-8-sig").splitlines() if _is_data(line)]
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"can't be read: {error}.", where=str(path)) from None
    return [line.split()[0] if _has_intrinsics(line) else line for line in lines]


def _has_intrinsics(line: str) -> bool:
    words = line.split()
    return len(words) >= 6 and all(map(_is_number, words[2:]))
