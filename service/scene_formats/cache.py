"""Cache of loaded scenes: their arrays as memory-mapped files, so that opening one takes milliseconds at any size.

    CACHE/scenes/KEY/  means.npy quats.npy scales.npy opacities.npy sh.npy  scene.json (all else)

The key is a hash of the names, sizes and modification times of the scene's files, which are not read for it. Arrays
are written by `numpy.save` and opened without pickle; a damaged or outdated entry is rebuilt.
"""

from __future__ import annotations

import hashlib
import logging
import mmap
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.codec import decode, encode
from service.disk_cache import mark_used
from service.scene_formats.folder import load_scene
from service.scene_formats.layouts import files_of
from service.types import GaussianScene, NamedCamera, SceneInfo

_VERSION = 3
_ARRAYS = ("means", "quats", "scales", "opacities", "sh")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Facts:
    """All of a scene but its arrays."""

    info: SceneInfo
    cameras: tuple[NamedCamera, ...]


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


def release(scene: GaussianScene) -> None:
    """Return the memory of a mapped scene's arrays to the system; pages that are used again are read from disk."""
    for name in _ARRAYS:
        array: Any = getattr(scene, name)
        # Through the views (slices, reshapes) down to the mapping itself.
        while array is not None and not isinstance(array, np.memmap):
            array = array.base
        if array is not None and hasattr(mmap, "MADV_DONTNEED"):
            array._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]


def _key(path: Path) -> str:
    """Hash the stamps of all files that `load_scene` may read."""
    stamps = [(str(f), f.stat().st_size, f.stat().st_mtime_ns) for f in sorted(set(files_of(path)))]
    return hashlib.sha256(repr((_VERSION, str(path.resolve()), stamps)).encode()).hexdigest()[:32]


def _opened(folder: Path) -> GaussianScene:
    facts = decode(_Facts, (folder / "scene.json").read_text("utf-8"))
    arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in _ARRAYS}
    scene = GaussianScene(**arrays, info=facts.info, cameras=facts.cameras)
    if len({len(array) for array in arrays.values()}) != 1:
        raise ValueError("arrays of different lengths")
    return scene


def _write(folder: Path, scene: GaussianScene) -> None:
    # Written beside its place and renamed: another process sees all of it or nothing.
    draft = folder.with_name(f"{folder.name}.{os.getpid()}")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    try:
        for name in _ARRAYS:
            np.save(draft / f"{name}.npy", getattr(scene, name), allow_pickle=False)
        (draft / "scene.json").write_text(encode(_Facts(scene.info, scene.cameras)), "utf-8")
        draft.replace(folder)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
