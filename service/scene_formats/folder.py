"""Load a scene: one scene file, an optional manifest and optional training cameras, checked and frozen."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from types import ModuleType

import numpy as np

from service.errors import CorruptScene, SceneNotFound, UnsupportedFormat
from service.scene_formats.colmap import read_cameras
from service.scene_formats.formats import SCENE_FORMATS, is_scene_file, readable_suffixes, reader_for
from service.scene_formats.gaussians import checked
from service.scene_formats.manifest import MANIFEST, Manifest, read_manifest, require_render_mode
from service.scene_formats.nerfstudio import TransformsFile, transforms_path
from service.scene_formats.similarity import moved_gaussians, moved_pose
from service.types import GaussianScene, NamedCamera, SceneInfo

COLMAP_FOLDER = Path("sparse", "0")
_HEAD_BYTES = 4096
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
        raise SceneNotFound("there is no such file or folder.", where=str(path))
    manifest = read_manifest(path) if path.is_dir() else Manifest()
    file, reader = _scene_file(path, manifest)
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
    info = SceneInfo(
        id=_scene_id(path),
        name=manifest.name or _scene_id(path),
        sha256=_digest(file, path, used, (found.background, size, focal_px)),
        format=reader.__name__.rsplit(".", 1)[-1],
        background_rgb=manifest.background or found.background or (0.0, 0.0, 0.0),
        background_is_known=bool(manifest.background or found.background),
        up_in_world=manifest.up,
        metres_per_unit=manifest.metres_per_unit,
        render_mode=mode,
        training_focal_px=focal_px,
        training_long_side_px=max(size) if size else None,
        geo_anchor=manifest.geo_anchor,
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


def _training(folder: Path, manifest: Manifest, without_photos: Collection[str]) -> _Training:
    """Read the training cameras; transforms*.json before sparse/0, from which it was converted where both exist."""

    def keep(name: str) -> bool:
        return not any(same_photo(name, photo) for photo in without_photos)

    transforms = transforms_path(folder)
    if transforms is not None:
        file = TransformsFile.open(transforms)
        photos = [photo for photo in file.training_photos() if keep(photo)]
        return _Training(tuple(file.camera(photo, manifest) for photo in photos), file.background())
    if any((folder / COLMAP_FOLDER / f"images.{suffix}").is_file() for suffix in ("bin", "txt")):
        return _Training(read_cameras(folder / COLMAP_FOLDER, keep))
    return _Training()


def _scene_file(path: Path, manifest: Manifest) -> tuple[Path, ModuleType]:
    """Find the scene file and its reader. Raises SceneNotFound, UnsupportedFormat, CorruptScene."""
    if path.is_file():
        candidates = [path]
    elif manifest.file:
        candidates = [path / manifest.file]
        if not candidates[0].is_file():
            raise SceneNotFound(f"there is no '{manifest.file}'.", where=f"{MANIFEST}: file")
    else:
        files = sorted(p for p in path.iterdir() if p.is_file() and is_scene_file(p))
        # A file that can't be read here doesn't make another one ambiguous.
        candidates = [p for p in files if p.suffix.lower() in readable_suffixes()] or files
    if not candidates:
        raise SceneNotFound(f"the folder has no scene file ({', '.join(readable_suffixes())}).", where=str(path))
    if len(candidates) > 1:
        raise CorruptScene(
            f"several scene files: {', '.join(p.name for p in candidates[:5])}.",
            where=str(path),
            hint=f'Name one in {MANIFEST}: {{"file": "{candidates[0].name}"}}.',
        )
    # Formats are recognized by their first bytes: the suffix .ply stands for two.
    with candidates[0].open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        raise CorruptScene("the file is empty (0 bytes).", where=candidates[0].name)
    reader = reader_for(head, candidates[0].suffix.lower())
    if reader:
        return candidates[0], reader
    raise UnsupportedFormat(
        f"not a scene file that is read here; known: {', '.join(SCENE_FORMATS.names())}.",
        where=candidates[0].name,
    )


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


def _digest(file: Path, path: Path, cameras: tuple[NamedCamera, ...], *facts: object) -> str:
    """Return the sha256 of everything that a render or an index of the scene depends on."""
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256")
    if (path / MANIFEST).is_file():
        digest.update((path / MANIFEST).read_bytes())
    digest.update(repr(facts).encode())
    # The cameras as used, moved and filtered: an index depends on them.
    for camera in cameras:
        digest.update(repr((camera.name, camera.camera.intrinsics)).encode())
        digest.update(camera.camera.pose.world_from_camera.tobytes())
    return digest.hexdigest()
