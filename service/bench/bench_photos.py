"""The test photos of a scene folder with their true cameras, and how they are modified before they are sent."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from service.bench.modifications import modify
from service.bench.modified_photo import Photo
from service.errors import CorruptScene, SceneNotFound, SplatfixError
from service.photos.images import encode_image, read_query
from service.photos.intrinsics import intrinsics_from
from service.scene_formats.colmap import read_cameras
from service.scene_formats.layouts import COLMAP_FOLDER
from service.scene_formats.manifest import read_manifest
from service.scene_formats.nerfstudio import TransformsFile, transforms_path
from service.scene_formats.similarity import moved_pose
from service.types import Camera, Intrinsics, NamedCamera, Pose

HOLD_OUT_EVERY = 8
"""Without a list of test photos, every eighth by name is one, as is usual with LLFF's data. The scene may have been
trained on them, too; only their cameras are held back."""


@dataclass(frozen=True, slots=True)
class BenchPhoto:
    """A test photo."""

    name: str
    """As the file with the true poses has it."""
    path: Path
    camera: Camera
    """The true camera, in the world frame."""
    aliases: tuple[str, ...] = ()
    """Other names that the same view may have among the scene's training cameras."""
    flatten: bool = False
    """Whether its transparent parts are filled with the background; else they are unknown."""

    @property
    def names(self) -> tuple[str, ...]:
        """All names of the view, whose cameras are held back."""
        return (self.name, *self.aliases)


def find_photos(folder: Path) -> list[BenchPhoto]:
    """Return the test photos of a scene folder. Raises SceneError.

    From the first of these that exists: truth.json (scenes/studio); transforms_test.json (Blender); the
    `test_filenames` of transforms.json (nerfstudio); every eighth photo of transforms.json or sparse/0.
    """
    if not folder.is_dir():
        raise SceneNotFound("no such folder.", where=str(folder))
    if (folder / "truth.json").is_file():
        photos = _from_truth(folder)
    elif (folder / "transforms_test.json").is_file():
        photos = _from_transforms(folder / "transforms_test.json", folder)
    elif (transforms := transforms_path(folder)) is not None:
        photos = _from_transforms(transforms, folder)
    elif (folder / COLMAP_FOLDER).is_dir():
        cameras = read_cameras(folder / COLMAP_FOLDER, lambda name: True)[::HOLD_OUT_EVERY]
        photos = [_photo(folder, "images/" + c.name, c, (c.name,)) for c in cameras]
    else:
        photos = []
    if not photos:
        raise SceneNotFound("there are no test photos with poses.", where=str(folder))
    return photos


@dataclass(frozen=True, slots=True)
class SentPhoto:
    """A photo as it is sent to be localized, and its truth."""

    data: bytes
    """The file: unaltered, or modified and stored as a PNG without EXIF."""
    intrinsics: Intrinsics
    """Sent with it: the true ones, unless the modification `focal` changes them."""
    truth: Camera


def prepare_photo(
    photo: BenchPhoto,
    modifications: tuple[str, ...],
    background_rgb: tuple[float, float, float],
    seed: int,
    occluders: Sequence[Float32[np.ndarray, "h w 3"]] = (),
) -> SentPhoto:
    """Return a photo after its modifications, and its true camera, which changes with them.

    `occluders` are photos of another scene. Raises UnknownName, InvalidOptions.
    """
    data = photo.path.read_bytes()
    # The original file, so that decoding and EXIF are measured as the service meets them.
    if not modifications and not photo.flatten:
        return SentPhoto(data, photo.camera.intrinsics, photo.camera)
    query = read_query(data, intrinsics=photo.camera.intrinsics, background_rgb=background_rgb)
    undistorted = Photo(
        query.rgb.astype(np.float32) / 255, query.intrinsics, photo.camera.pose, occluders=tuple(occluders)
    )
    modified = modify(undistorted, modifications, np.random.default_rng(seed))
    k, factor = modified.intrinsics, modified.sent_focal_factor
    sent = replace(k, fx=k.fx * factor, fy=k.fy * factor)
    return SentPhoto(encode_image(modified.pixels(), "png"), sent, Camera(k, modified.pose))


def _from_truth(folder: Path) -> list[BenchPhoto]:
    """Read a list of {photo, original, intrinsics, world_from_camera}; OpenCV axes, world frame."""
    path = folder / "truth.json"
    try:
        entries = json.loads(path.read_text("utf-8"))
        return [_from_entry(folder, entry) for entry in entries]
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise CorruptScene(f"not a list of photos with their truth: {error!r}.", where=path.name) from None


def _from_entry(folder: Path, entry: dict[str, Any]) -> BenchPhoto:
    name, original = entry["photo"], entry.get("original")
    # The demo scenes' photos are in a subfolder; other files with true poses name paths.
    files = [folder / name, folder / "photos" / name]
    file = next((f for f in files if f.is_file()), files[0])
    try:
        pose = Pose(np.array(entry["world_from_camera"], np.float64))
        camera = Camera(intrinsics_from(entry["intrinsics"]), pose)
    except SplatfixError as error:
        raise CorruptScene(str(error), where=f"truth.json, '{name}'") from None
    return BenchPhoto(name, file, camera, (original,) if original else ())


def _from_transforms(path: Path, folder: Path) -> list[BenchPhoto]:
    file, manifest = TransformsFile.open(path), read_manifest(folder)
    names = file.split("test")
    if names is None:
        # A file of test photos has no others.
        step = 1 if path.stem.endswith("_test") else HOLD_OUT_EVERY
        names = sorted(file.frames)[::step]
    return [_photo(folder, str(file.photo_file(name) or name), file.camera(name, manifest)) for name in names]


def _photo(folder: Path, file: str, named: NamedCamera, aliases: tuple[str, ...] = ()) -> BenchPhoto:
    camera = moved_camera(named.camera, read_manifest(folder).world_from_scene)
    return BenchPhoto(named.name, folder / file, camera, aliases)


def moved_camera(camera: Camera, world_from_scene: Float64[np.ndarray, "4 4"] | None) -> Camera:
    """Return a camera in the world frame from one in the scene file's; None: the frames are the same."""
    if world_from_scene is None:
        return camera
    return Camera(camera.intrinsics, moved_pose(camera.pose, world_from_scene))
