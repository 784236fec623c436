"""A digest of training photos in a file, `.npz`, beside the scene."""

from __future__ import annotations

import logging
import os
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from service.interfaces import SurfacePoints
from service.pose.training_photos.digest import PhotoDigest
from service.pose.training_photos.patch_matching import PATCHES

DIGEST_FILE = "training-photos.npz"
"""In the scene's folder, so that it goes wherever the scene goes."""
VERSION = 1
log = logging.getLogger(__name__)


def write_digest(digest: PhotoDigest, path: Path) -> None:
    """Write to the side and rename, so that no reader sees half a file. Raises OSError."""
    points = digest.points
    arrays = {
        "version": np.array(VERSION),
        "scene_key": np.array(digest.scene_key),
        "names": np.array(digest.names),
        "sha256": np.array(digest.sha256),
        "offsets": digest.offsets,
        "quality": np.array([digest.reprojection_px, digest.depth_ratio]),
        "effect": np.array(digest.effect or ()),
        "points_in_world": points.points_in_world,
        "covariances": points.covariances,
        "tangents": points.tangents,
        "patches": points.patches,
        "photo": points.photo,
        "photo_positions": points.photo_positions,
    }
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".partial")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_digest(path: Path, key: str) -> PhotoDigest | None:
    """Return a stored digest; None, logged, where it can't be read or is of another scene than that of `key`."""
    try:
        with zipfile.ZipFile(path) as archive:
            # Whoever uploads a scene may send any file, and a compressed one may unpack to any size.
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("it is compressed")
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
        digest = _digest_of(stored)
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        log.warning("%s can't be read and is not used (%s): make it again", path.name, error)
        return None
    if digest.scene_key != key:
        log.warning("%s is of other Gaussians than the scene's and is not used: make it again", path.name)
        return None
    return digest


def _digest_of(stored: dict[str, np.ndarray]) -> PhotoDigest:
    """Raises ValueError, KeyError, TypeError for arrays that no digest has: a file may come from anywhere."""
    if int(stored["version"]) != VERSION:
        raise ValueError("it is of another version")
    points = SurfacePoints(
        stored["points_in_world"].astype(np.float64),
        stored["covariances"].astype(np.float32),
        stored["tangents"].astype(np.float32),
        stored["patches"],
        stored["photo"].astype(np.int32),
        stored["photo_positions"].astype(np.float64),
    )
    count, photos, side = len(points.points_in_world), len(points.photo_positions), PATCHES.side_px
    shapes = {
        "points_in_world": (count, 3), "covariances": (count, 3, 3), "tangents": (count, 3, 2),
        "patches": (count, side, side), "photo": (count,), "photo_positions": (photos, 3),
        "names": (photos,), "sha256": (photos,), "offsets": (photos, 6), "quality": (2,),
    }  # fmt: skip
    for name, shape in shapes.items():
        if stored[name].shape != shape:
            raise ValueError(f"'{name}' has the shape {stored[name].shape} instead of {shape}")
    for name in ("points_in_world", "covariances", "tangents", "photo_positions", "offsets", "quality", "effect"):
        if not np.all(np.isfinite(stored[name])):
            raise ValueError(f"'{name}' has values that are not finite")
    if points.patches.dtype != np.uint8 or (count and not 0 <= points.photo.min() <= points.photo.max() < photos):
        raise ValueError("its patches are damaged")
    reprojection_px, depth_ratio = stored["quality"].tolist()
    distances = stored["effect"].tolist()
    effect = (float(distances[0]), float(distances[1])) if len(distances) == 2 else None
    names, hashes = tuple(stored["names"].tolist()), tuple(stored["sha256"].tolist())
    key, offsets = str(stored["scene_key"]), stored["offsets"]
    return PhotoDigest(points, key, names, hashes, offsets, reprojection_px, depth_ratio, effect)
