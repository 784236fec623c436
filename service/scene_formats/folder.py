"""Load a scene: one scene file, an optional manifest and optional training cameras, checked and frozen."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np

from service.errors import SceneNotFound
from service.scene_formats.camera_fit import CameraFit, fitted
from service.scene_formats.frame_candidates import CameraFile
from service.scene_formats.gaussians import RawGaussians, checked
from service.scene_formats.layouts import scene_file
from service.scene_formats.manifest import MANIFEST, Manifest, read_manifest, require_render_mode
from service.scene_formats.recentring import Extent, extent_of, near_plane_for, origin_for, recentred
from service.scene_formats.similarity import moved_gaussians, moved_pose
from service.scene_formats.training_files import TrainingFiles, photos_beside, read_training
from service.scene_origin import shifted_camera
from service.types import GaussianScene, NamedCamera, SceneFrame, SceneInfo

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
    found = TrainingFiles(CameraFile(tuple(training or ()))) if given else read_training(path, manifest, without_photos)
    listed = found.file.cameras if cameras else ()
    lenses = found.file.cameras if found.has_lens else ()
    size = manifest.training_size or _median_size(lenses)
    background = manifest.background or found.background
    fit = None if given or not listed else fitted(raw, found.file, photos_beside(path, background), background)
    # Cameras that were left out count in the digest, too: by their file, since another one may fit.
    raw, used, extent, origin = _in_world(raw, fit.cameras if fit else listed, manifest)
    facts = (found.background, size, _training_focal_px(lenses if cameras else (), manifest.training_size))
    facts += ("cameras unverified",) if fit and fit.is_doubtful else ()
    info = SceneInfo(
        id=_scene_id(path),
        name=manifest.name or _scene_id(path),
        sha256=_digest([file, *_parts_of(reader, file)], path, used or listed, facts),
        format=reader.__name__.rsplit(".", 1)[-1],
        background_rgb=background or (0.0, 0.0, 0.0),
        background_is_known=bool(background),
        up_in_world=manifest.up or _up(raw.up, manifest),
        metres_per_unit=manifest.metres_per_unit,
        render_mode=mode,
        training_focal_px=facts[2],
        training_long_side_px=max(size) if size else None,
        geo_anchor=manifest.geo_anchor,
        warnings=(*raw.warnings, *found.warnings, *(fit.warnings if fit else ())),
        origin_in_world=origin,
        near_plane=near_plane_for(extent),
        frames=_frames(manifest, fit),
        cameras_doubtful=bool(fit and fit.is_doubtful),
    )
    log.info("loaded %s: %d Gaussians, %d training cameras", file.name, len(raw.means), len(used))
    return GaussianScene(raw.means, raw.quats, raw.scales, raw.opacities, raw.sh, info, used)


def _scene_id(path: Path) -> str:
    return path.resolve().name if path.is_dir() else path.stem  # resolved, since "." has no name


def _in_world(
    raw: RawGaussians, cameras: tuple[NamedCamera, ...], manifest: Manifest
) -> tuple[RawGaussians, tuple[NamedCamera, ...], Extent, tuple[float, float, float]]:
    """Return Gaussians and cameras in the world, less an origin; the Gaussians' extent before that; the origin."""
    if manifest.world_from_scene is not None:
        raw = moved_gaussians(raw, manifest.world_from_scene)
        cameras = tuple(_moved(camera, manifest.world_from_scene) for camera in cameras)
    extent = extent_of(raw)
    origin = origin_for(extent)
    if any(origin):
        cameras = tuple(shifted_camera(camera, -np.array(origin)) for camera in cameras)
    return recentred(raw, origin), cameras, extent, origin


def _frames(manifest: Manifest, fit: CameraFit | None) -> tuple[SceneFrame, ...]:
    """Return the scene file's frame, and the camera file's where its cameras fit."""
    file_from_world = np.eye(4) if manifest.world_from_scene is None else np.linalg.inv(manifest.world_from_scene)
    frames = [SceneFrame("file", file_from_world, "the scene file", True)]
    if fit and fit.cameras:
        cameras_from_world = np.linalg.inv(fit.file_from_cameras) @ file_from_world
        frames.append(SceneFrame("cameras", cameras_from_world, fit.decided_by, fit.verified))
    return tuple(frames)


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
