"""What a scene folder says of its training: cameras, background, photos, and how a trainer moved the world.

The first one that is there is read: `transforms*.json`, COLMAP's `sparse/0` (of which that is made), Inria's
`cameras.json`, or MultiSet's `poses.json`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64

from service.errors import CorruptScene, InvalidImage
from service.photos.images import open_photo
from service.scene_formats.camera_evidence import Photo
from service.scene_formats.colmap import read_cameras as read_colmap_cameras
from service.scene_formats.colmap import read_points
from service.scene_formats.frame_candidates import FLIP, CameraFile, Stated
from service.scene_formats.inria import ARGUMENTS, CAMERAS, background_of
from service.scene_formats.inria import read_cameras as read_inria_cameras
from service.scene_formats.layouts import COLMAP_FOLDER
from service.scene_formats.manifest import Manifest, numbers, read_json
from service.scene_formats.multiset import POSES, is_of_multiset
from service.scene_formats.multiset import read_cameras as read_multiset_cameras
from service.scene_formats.nerfstudio import DATAPARSER, TransformsFile, transforms_path
from service.scene_formats.normalizations import COLMAP_TO_Z_UP
from service.types import NamedCamera

CAMERA_FRAME = "camera-frame.json"
"""Where the camera file's frame was found to be, in the scene's folder: `service/scene_manager/camera_frame.py`."""
_ELSEWHERE = (".", "sparse", "sparse/*", "colmap/sparse/*", "dense/sparse", "dense/sparse/*", "distorted/sparse/*")
"""Where other programs put COLMAP models."""
_PHOTO_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".webp")
_PHOTO_PX = 128
_MAX_PHOTO_BYTES = 50_000_000


@dataclass(frozen=True, slots=True)
class TrainingFiles:
    """The training cameras as their file has them, and the background."""

    file: CameraFile
    background: tuple[float, float, float] | None = None
    warnings: tuple[str, ...] = ()
    has_lens: bool = True
    """The cameras' intrinsics are of the file, not assumed."""


def read_training(folder: Path, manifest: Manifest, without_photos: Collection[str] = ()) -> TrainingFiles:
    """Read the training cameras of a folder. Raises CorruptScene."""
    found = _read_training(folder, manifest, without_photos)
    measured = _measured_frame(folder)
    if measured is None:
        return found
    return replace(found, file=replace(found.file, stated=(*found.file.stated, measured)))


def _read_training(folder: Path, manifest: Manifest, without_photos: Collection[str]) -> TrainingFiles:
    def keep(name: str) -> bool:
        return not any(same_photo(name, photo) for photo in without_photos)

    arguments = folder / ARGUMENTS
    background = background_of(arguments) if arguments.is_file() else None
    transforms = transforms_path(folder)
    if transforms is not None:
        file = TransformsFile.open(transforms)
        return TrainingFiles(_of_transforms(file, manifest, keep), file.background() or background)
    model = folder / COLMAP_FOLDER
    if any((model / f"images.{suffix}").is_file() for suffix in ("bin", "txt")):
        stated = tuple(_of_dataparser(folder, ("", np.eye(4)), ("COLMAP's world turned to z up", COLMAP_TO_Z_UP)))
        cameras = read_colmap_cameras(model, keep)
        return TrainingFiles(CameraFile(cameras, read_points=lambda: read_points(model), stated=stated), background)
    if (folder / CAMERAS).is_file():
        return TrainingFiles(CameraFile(read_inria_cameras(folder / CAMERAS, keep)), background)
    if is_of_multiset(folder / POSES):
        cameras = read_multiset_cameras(folder / POSES, keep)
        return TrainingFiles(CameraFile(cameras), background, _models_elsewhere(folder), has_lens=False)
    return TrainingFiles(CameraFile(()), background, _models_elsewhere(folder))


def same_photo(a: str, b: str) -> bool:
    """Whether two names may mean the same photo: one path is the tail of the other, suffixes apart.

    "0001.png", "images/0001" and "./data/images/0001.jpg" are the same; "train/r_0" and "test/r_0" are not.
    """
    # Camera files name photos by different roots, and with or without a suffix.
    parts = [_parts(name) for name in (a, b)]
    shared = min(len(p) for p in parts)
    return shared > 0 and parts[0][-shared:] == parts[1][-shared:]


def _parts(name: str) -> tuple[str, ...]:
    path = PurePosixPath(name.replace("\\", "/"))
    return (*path.parts[:-1], path.stem) if path.name else path.parts


def photos_beside(folder: Path, background: tuple[float, float, float] | None) -> Callable[[NamedCamera], Photo | None]:
    """Return what finds a camera's photo in a scene folder, small; None where there is none of the camera's shape."""

    def photo_of(named: NamedCamera) -> Photo | None:
        path = training_photo_path(folder, named.name)
        if path is None:
            return None
        try:
            query = open_photo(path.read_bytes()).query(long_side=_PHOTO_PX, background_rgb=background or (0, 0, 0))
        except (InvalidImage, OSError):
            return None
        # The photo's own intrinsics have its full size.
        photo, camera = query.photo_intrinsics, named.camera.intrinsics
        is_alike = abs(photo.width * camera.height - photo.height * camera.width) < 0.02 * photo.width * camera.height
        return query.rgb if is_alike else None

    return photo_of


def training_photo_path(folder: Path, name: str) -> Path | None:
    """Return where in a scene folder the photo of a training camera lies; None: it isn't there, or too large a file."""
    path = _photo_path(folder, name)
    return None if path is None or path.stat().st_size > _MAX_PHOTO_BYTES else path


def _photo_path(folder: Path, name: str) -> Path | None:
    root = folder.resolve()  # a path out of the folder, or a link, must not be followed
    try:
        for place in (name, f"images/{name}", f"images/{PurePosixPath(name).name}"):
            for suffix in _PHOTO_SUFFIXES:
                path = (root / (place + suffix)).resolve()
                if path.is_relative_to(root) and path.is_file():
                    return path
    except (OSError, ValueError):  # too long a name, or no name that a file could have
        pass
    return None


def _of_transforms(file: TransformsFile, manifest: Manifest, keep: Callable[[str], bool]) -> CameraFile:
    photos = [photo for photo in file.training_photos() if keep(photo)]
    others = []
    for photo in file.frames:
        if photo not in photos and keep(photo):
            try:
                others.append(file.camera(photo, manifest))
            except CorruptScene:  # a broken frame that is not used is no error
                continue
    applied = _applied(file.data, file.path.name)
    stated = list(_of_dataparser(file.path.parent, ("applied_transform", applied), ("", np.eye(4))))
    if not np.array_equal(applied, np.eye(4)):
        stated.append(Stated("applied_transform undone", applied))
    cameras = tuple(file.camera(photo, manifest) for photo in photos)
    flip = FLIP if manifest.convention == "opengl" else None
    return CameraFile(cameras, tuple(others), stored_from_opencv=flip, stated=tuple(stated))


def _applied(data: dict[str, Any], where: str) -> Float64[np.ndarray, "4 4"]:
    """Return what undoes ns-process-data's `applied_transform` and `applied_scale`. Raises CorruptScene."""
    if "applied_transform" not in data and "applied_scale" not in data:
        return np.eye(4)
    matrix = _transform(data.get("applied_transform", np.eye(4)[:3].tolist()), f"{where}: applied_transform")
    scale = float(numbers(data.get("applied_scale", 1.0), (), f"{where}: applied_scale"))
    if not scale > 0:
        raise CorruptScene(f"must be positive, is {scale}.", where=f"{where}: applied_scale")
    return np.linalg.inv(np.diag([scale, scale, scale, 1.0]) @ matrix)


def _measured_frame(folder: Path) -> Stated | None:
    """Return what localizing the photos has told, None where that wasn't done. Raises CorruptScene."""
    path = folder / CAMERA_FRAME
    if not path.is_file():
        return None
    where = f"{path.name}: file_from_cameras"
    matrix = numbers(read_json(path).get("file_from_cameras"), (4, 4), where)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    turned = matrix[:3, :3] @ matrix[:3, :3].T
    if not scale > 0 or np.abs(turned / scale**2 - np.eye(3)).max() > 1e-3:
        raise CorruptScene("must be a similarity.", where=where, hint="Delete the file, and align the scene again.")
    return Stated("found by localizing their photos", matrix, is_measured=True)


def _of_dataparser(folder: Path, *worlds: tuple[str, Float64[np.ndarray, "4 4"]]) -> list[Stated]:
    """Return what nerfstudio's trainer wrote, for each world that it may have begun with, the likelier one first.

    A world is given by its transform from the camera file's. nerfstudio writes the product of its normalization with
    `applied_transform`, and of both scales, but centres in the camera file's unit. Raises CorruptScene.
    """
    path = folder / DATAPARSER
    if not path.is_file():
        return []
    data = read_json(path)
    scale = float(numbers(data.get("scale", 1.0), (), f"{path.name}: scale"))
    if not scale > 0:
        raise CorruptScene(f"must be positive, is {scale}.", where=f"{path.name}: scale")
    model = _transform(data.get("transform"), f"{path.name}: transform")
    distinct = worlds[1:] if np.array_equal(worlds[0][1], worlds[1][1]) else worlds
    stated = []
    for name, world in distinct:
        unit = np.cbrt(np.linalg.det(world[:3, :3]))
        rigid = world @ np.diag([1 / unit, 1 / unit, 1 / unit, 1.0])
        matrix = np.diag([scale * unit] * 3 + [1.0]) @ model @ rigid
        stated.append(Stated(f"{path.name}{f' and {name}' if name else ''}", matrix, True))
    return stated


def _transform(value: Any, where: str) -> Float64[np.ndarray, "4 4"]:
    """Return a 3x4 or 4x4 rigid motion. Raises CorruptScene."""
    rows = 4 if isinstance(value, list) and len(value) == 4 else 3
    matrix = np.eye(4)
    matrix[:rows] = numbers(value, (rows, 4), where)
    gram = matrix[:3, :3] @ matrix[:3, :3].T
    if np.abs(gram - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix[:3, :3]) < 0:
        raise CorruptScene("must rotate and translate: no scale, no mirroring.", where=where)
    return matrix


def _models_elsewhere(folder: Path) -> tuple[str, ...]:
    """Return a warning for each COLMAP model in a place where it is not looked for."""
    files = [file for place in _ELSEWHERE for file in sorted(folder.glob(f"{place}/images.*"))]
    places = dict.fromkeys(f.parent.relative_to(folder).as_posix() for f in files if f.suffix in (".bin", ".txt"))
    return tuple(f"A COLMAP model in '{place}' is not read: move it to sparse/0." for place in places)
