"""Cache of loaded scenes: their arrays as memory-mapped files, so that opening one takes milliseconds at any size.

    CACHE/scenes/KEY/  means.npy quats.npy scales.npy opacities.npy sh.npy poses.npy  scene.json (all else)

The key is a hash of the names, sizes, modification times and inodes of the scene's files, which are not read for it:
the digest in `SceneInfo.sha256` is of the time they were read. A file that is replaced has another inode, one that is
written has another time. A damaged or outdated entry is rebuilt. What is derived from a scene's Gaussians is kept in
its entry, too (`entry_of`), and goes with it.
"""

from __future__ import annotations

import hashlib
import logging
import mmap
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.codec import decode, encode
from service.disk_cache import mark_used
from service.mapped_arrays import open_arrays, write_arrays
from service.scene_formats.folder import load_scene
from service.scene_formats.layouts import files_of
from service.types import Camera, GaussianScene, Intrinsics, NamedCamera, Pose, SceneInfo

_VERSION = 4
_ARRAYS = ("means", "quats", "scales", "opacities", "sh")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Facts:
    """All of a scene but its arrays. Thousands of cameras share a lens or a few, and their poses are an array, too."""

    info: SceneInfo
    camera_names: tuple[str, ...]
    lens_of_camera: tuple[int, ...]
    lenses: tuple[Intrinsics, ...]


def mapped_scene(path: Path, cache_dir: Path) -> GaussianScene:
    """Return the scene of a folder or file as `load_scene` does, mapped from the cache; fills it. Raises SceneError."""
    if not path.exists():
        return load_scene(path)
    folder = cache_dir / "scenes" / _key(path)
    try:
        opened = _opened(folder)
        mark_used(folder)
        return opened
    except FileNotFoundError:
        pass
    except (OSError, ValueError, TypeError, KeyError) as error:
        _log.warning("%s is rebuilt: %s", folder, error)
        shutil.rmtree(folder, ignore_errors=True)
    scene = load_scene(path)
    try:
        _write(folder, scene)
        return _opened(folder)
    except OSError as error:  # a full disk: the scene is in memory all the same
        _log.warning("the scene is not cached: %s", error)
    return scene


def entry_of(scene: GaussianScene) -> Path | None:
    """Return the cache's folder that a scene is mapped from; None: it isn't mapped."""
    mapping = _mapping(scene.means)
    return None if mapping is None else Path(mapping.filename).parent


def release(scene: GaussianScene) -> None:
    """Return the memory of a mapped scene's arrays to the system; pages that are used again are read from disk."""
    for name in _ARRAYS:
        mapping = _mapping(getattr(scene, name))
        if mapping is not None and hasattr(mmap, "MADV_DONTNEED"):
            mapping._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]


def _mapping(array: Any) -> Any:
    """Return the memory map that an array is a view of (through slices and reshapes), None if it is of none."""
    while array is not None and not isinstance(array, np.memmap):
        array = array.base
    return array


def _key(path: Path) -> str:
    """Hash the stamps of all files that `load_scene` may read."""
    stats = [(str(file), file.stat()) for file in sorted(set(files_of(path)))]
    stamps = [(name, stat.st_size, stat.st_mtime_ns, stat.st_ino) for name, stat in stats]
    return hashlib.sha256(repr((_VERSION, str(path.resolve()), stamps)).encode()).hexdigest()[:32]


def _opened(folder: Path) -> GaussianScene:
    facts = decode(_Facts, (folder / "scene.json").read_text("utf-8"))
    arrays = open_arrays(folder, _ARRAYS)
    poses = np.load(folder / "poses.npy", allow_pickle=False)
    cameras = tuple(
        NamedCamera(name, Camera(facts.lenses[lens], Pose(pose)))
        for name, lens, pose in zip(facts.camera_names, facts.lens_of_camera, poses, strict=True)
    )
    scene = GaussianScene(**arrays, info=facts.info, cameras=cameras)
    if len({len(array) for array in arrays.values()}) != 1:
        raise ValueError("arrays of different lengths")
    return scene


def _write(folder: Path, scene: GaussianScene) -> None:
    cameras = [named.camera for named in scene.cameras]
    lenses = {camera.intrinsics: None for camera in cameras}
    places = {lens: place for place, lens in enumerate(lenses)}
    lens_of_camera = tuple(places[camera.intrinsics] for camera in cameras)
    facts = _Facts(scene.info, tuple(named.name for named in scene.cameras), lens_of_camera, tuple(lenses))
    poses = np.array([camera.pose.world_from_camera for camera in cameras]).reshape(-1, 4, 4)
    arrays = {name: getattr(scene, name) for name in _ARRAYS} | {"poses": poses}
    write_arrays(folder, arrays, {"scene.json": encode(facts)})
