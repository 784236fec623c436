"""Load a scene: one scene file, an optional manifest and optional training cameras, checked and frozen."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from types import ModuleType

import numpy as np

from service.errors import SceneNotFound
from service.scene_formats.colmap import read_cameras as read_colmap_cameras
from service.scene_formats.gaussians import checked
from service.scene_formats.inria import ARGUMENTS, CAMERAS, background_of
from service.scene_formats.inria import read_cameras as read_inria_cameras
from service.scene_formats.layouts import COLMAP_FOLDER, scene_file
from service.scene_formats.manifest import MANIFEST, Manifest, read_manifest, require_render_mode
from service.scene_formats.nerfstudio import TransformsFile, transforms_path
from service.scene_formats.recentring import extent_of, near_plane_for, origin_for, recentred
from service.scene_formats.similarity import moved_gaussians, moved_pose
from service.scene_origin import shifted_camera
from service.types import GaussianScene, NamedCamera, SceneInfo

_ELSEWHERE = (".", "sparse", "sparse/*", "colmap/sparse/*", "dense/sparse", "dense/sparse/*", "distorted/sparse/*")
"""Where other programs put COLMAP models."""
log = logging.getLogger(__name__)


def load_scene(
    path: Path,
    *,
    without_photos: Collection[str] = (),
    cameras: bool = True,
    training: Sequence[NamedCamera] | None = None,
) -> GaussianScene:
    """Read a scene folder, or a bare scene file, into the world frame. Raises SceneError.

    The Gaussians and cameras of the folder are checked and moved by the manifest's `world_from_scene`.
    `without_photos` are names of photos whose cameras are not even read (a bench's queries); see `same_photo`.
    With `cameras=False` nothing is taken from the training cameras but the size of their photos. `training` are
    cameras in the scene file's frame that replace those of the folder.
    """
    if not path.exists():
        raise SceneNotFound("no such file or folder.", where=str(path))
    manifest = read_manifest(path) if path.is_dir() else Manifest()
    file, reader = scene_file(path, manifest)
    raw = checked(reader.read(file), file.name)
    mode = require_render_mode(manifest.render_mode or raw.render_mode or "default", file.name)
    # A bare file has neither manifest nor cameras: what lies beside it may belong to another scene.
    given = training is not None or path.is_file()
    found = _Training(tuple(training or ())) if given else _training(path, manifest, without_photos)
    size = manifest.training_size or _median_size(found.cameras)
    used = found.cameras if cameras else ()
    focal_px = _training_focal_px(used, manifest.training_size)
    if manifest.world_from_scene is not None:
        raw = moved_gaussians(raw, manifest.world_from_scene)
        used = tuple(_moved(camera, manifest.world_from_scene) for camera in used)
    extent = extent_of(raw)
    origin = origin_for(extent)
    raw, back = recentred(raw, origin), -np.array(origin)
    used = tuple(shifted_camera(camera, back) for camera in used) if any(origin) else used
    info = SceneInfo(
        id=_scene_id(path),
        name=manifest.name or _scene_id(path),
        sha256=_digest([file, *_parts_of(reader, file)], path, used, (found.background, size, focal_px)),
        format=reader.__name__.rsplit(".", 1)[-1],
        background_rgb=manifest.background or found.background or (0.0, 0.0, 0.0),
        background_is_known=bool(manifest.background or found.background),
        up_in_world=manifest.up or _up(raw.up, manifest),
        metres_per_unit=manifest.metres_per_unit,
        render_mode=mode,
        training_focal_px=focal_px,
        training_long_side_px=max(size) if size else None,
        geo_anchor=manifest.geo_anchor,
        warnings=(*raw.warnings, *found.warnings),
        origin_in_world=origin,
        near_plane=near_plane_for(extent),
    )
    log.info("loaded %s: %d Gaussians, %d training cameras", file.name, len(raw.means), len(used))
    return GaussianScene(raw.means, raw.quats, raw.scales, raw.opacities, raw.sh, info, used)


def _scene_id(path: Path) -> str:
    return path.resolve().name if path.is_dir() else path.stem  # resolved, since "." has no name


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


@dataclass(frozen=True, slots=True)
class _Training:
    """Cameras and background of a folder's camera files, in the scene file's frame."""

    cameras: tuple[NamedCamera, ...] = ()
    background: tuple[float, float, float] | None = None
    warnings: tuple[str, ...] = ()


def _training(folder: Path, manifest: Manifest, without_photos: Collection[str]) -> _Training:
    """Read the training cameras: transforms*.json, else sparse/0, of which it is made, else Inria's cameras.json."""

    def keep(name: str) -> bool:
        return not any(same_photo(name, photo) for photo in without_photos)

    arguments = folder / ARGUMENTS
    background = background_of(arguments) if arguments.is_file() else None
    transforms = transforms_path(folder)
    if transforms is not None:
        file = TransformsFile.open(transforms)
        photos = [photo for photo in file.training_photos() if keep(photo)]
        return _Training(tuple(file.camera(photo, manifest) for photo in photos), file.background() or background)
    if any((folder / COLMAP_FOLDER / f"images.{suffix}").is_file() for suffix in ("bin", "txt")):
        return _Training(read_colmap_cameras(folder / COLMAP_FOLDER, keep), background)
    if (folder / CAMERAS).is_file():
        return _Training(read_inria_cameras(folder / CAMERAS, keep), background)
    return _Training(background=background, warnings=_models_elsewhere(folder))


def _models_elsewhere(folder: Path) -> tuple[str, ...]:
    """Return a warning for each COLMAP model in a place where it is not looked for."""
    files = [file for place in _ELSEWHERE for file in sorted(folder.glob(f"{place}/images.*"))]
    places = dict.fromkeys(f.parent.relative_to(folder).as_posix() for f in files if f.suffix in (".bin", ".txt"))
    return tuple(f"A COLMAP model in '{place}' is not read: move it to sparse/0." for place in places)


def _parts_of(reader: ModuleType, file: Path) -> list[Path]:
    """Return the files beside the scene file that its format consists of."""
    return reader.parts(file) if hasattr(reader, "parts") else []


def _up(up: tuple[float, float, float] | None, manifest: Manifest) -> tuple[float, float, float] | None:
    """Return the file's up axis in the world frame."""
    if up is None or manifest.world_from_scene is None:
        return up
    turned = manifest.world_from_scene[:3, :3] @ np.array(up)
    x, y, z = (float(v) for v in turned / np.linalg.norm(turned))
    return x, y, z


def _median_size(cameras: tuple[NamedCamera, ...]) -> tuple[int, int] | None:
    """Return the median (width, height) of the photos: a few of another size must not count."""
    if not cameras:
        return None
    sizes = [(c.camera.intrinsics.width, c.camera.intrinsics.height) for c in cameras]
    return sorted(sizes)[len(sizes) // 2]


def _training_focal_px(cameras: tuple[NamedCamera, ...], size: tuple[int, int] | None) -> float | None:
    """Return the median focal length in pixels, scaled to the size of training if the cameras are of larger photos."""
    if not cameras:
        return None
    each = [c.camera.intrinsics for c in cameras]
    return float(np.median([i.fx * (max(size) / i.long_side if size else 1.0) for i in each]))


def _moved(camera: NamedCamera, world_from_scene: np.ndarray) -> NamedCamera:
    return replace(camera, camera=replace(camera.camera, pose=moved_pose(camera.camera.pose, world_from_scene)))


def _digest(files: Sequence[Path], path: Path, cameras: tuple[NamedCamera, ...], *facts: object) -> str:
    """Return the sha256 of everything that a render or an index of the scene depends on."""
    with files[0].open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256")
    for part in files[1:]:
        digest.update(part.read_bytes())
    if (path / MANIFEST).is_file():
        digest.update((path / MANIFEST).read_bytes())
    digest.update(repr(facts).encode())
    # The cameras as used, moved and filtered: an index depends on them.
    for camera in cameras:
        digest.update(repr((camera.name, camera.camera.intrinsics)).encode())
        digest.update(camera.camera.pose.world_from_camera.tobytes())
    return digest.hexdigest()
