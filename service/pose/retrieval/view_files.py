"""Views of a scene in a file, `.npz`: cameras and features of all views, one after the other, and further arrays."""

from __future__ import annotations

import logging
import os
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from service.disk_cache import mark_used
from service.interfaces import Features
from service.pose.features.rendered_views import View
from service.types import Camera, Intrinsics, Pose

log = logging.getLogger(__name__)


def write_views(path: Path, views: Sequence[View], others: Mapping[str, np.ndarray]) -> None:
    """Write to the side and rename, so that no reader sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cameras = [view.camera for view in views]
    pinholes = [(c.intrinsics.fx, c.intrinsics.fy, c.intrinsics.cx, c.intrinsics.cy) for c in cameras]
    arrays = {
        "counts": np.array([len(view.points_in_world) for view in views]),
        "sizes": np.array([(c.intrinsics.width, c.intrinsics.height) for c in cameras]),
        "pinholes": np.array(pinholes),
        "world_from_camera": np.stack([c.pose.world_from_camera for c in cameras]),
        "points_px": np.concatenate([view.features.points_px for view in views]),
        "scores": np.concatenate([view.features.scores for view in views]),
        "descriptors": np.concatenate([view.features.descriptors for view in views]),
        "points_in_world": np.concatenate([view.points_in_world for view in views]),
    }
    # Two processes may write the same file at once.
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".partial")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays, **others)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_views(path: Path | None) -> tuple[tuple[View, ...], dict[str, np.ndarray]] | None:
    """Return the views and the file's further arrays; None, logged, where the file isn't there or can't be read."""
    if path is None or not path.exists():
        return None
    try:
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
        mark_used(path)
        return tuple(_views_of(stored)), stored
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        log.warning("computing anew what %s, which can't be read, holds (%s)", path.name, error)
        return None


def _views_of(stored: Mapping[str, np.ndarray]) -> list[View]:
    stops = np.cumsum(stored["counts"])
    views = []
    for i, (start, stop) in enumerate(zip(stops - stored["counts"], stops, strict=True)):
        (width, height), (fx, fy, cx, cy) = stored["sizes"][i].tolist(), stored["pinholes"][i].tolist()
        features = Features(*(stored[name][start:stop] for name in ("points_px", "scores", "descriptors")))
        camera = Camera(Intrinsics(width, height, fx, fy, cx, cy), Pose(stored["world_from_camera"][i]))
        views.append(View(camera, features, stored["points_in_world"][start:stop]))
    return views
