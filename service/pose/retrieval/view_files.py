"""Views of a scene as a folder of arrays: cameras and features of all views, one after the other, and further arrays.

They are read as memory maps: a search touches the features of the few views that it matches, and the kernel may drop
the pages.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from service.disk_cache import mark_used
from service.interfaces import Features
from service.mapped_arrays import open_arrays, write_arrays
from service.pose.features.rendered_views import View
from service.types import Camera, Intrinsics, Pose

log = logging.getLogger(__name__)


def write_views(folder: Path, views: Sequence[View], others: Mapping[str, np.ndarray]) -> None:
    """Write the views and further arrays in the place of what is there, whole or not at all. Raises OSError."""
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
    # A folder can't be renamed to one that has files: one that couldn't be read, or another process's, the same.
    shutil.rmtree(folder, ignore_errors=True)
    write_arrays(folder, {**arrays, **others})


def read_views(folder: Path | None) -> tuple[tuple[View, ...], dict[str, np.ndarray]] | None:
    """Return the views and the folder's further arrays; None, logged, where it isn't there or can't be read."""
    if folder is None or not folder.exists():
        return None
    try:
        stored = open_arrays(folder, [file.stem for file in folder.glob("*.npy")])
        views = tuple(_views_of(stored))
    except (OSError, ValueError, KeyError) as error:
        log.warning("computing anew what %s, which can't be read, holds (%s)", folder.name, error)
        return None
    mark_used(folder)
    return views, stored


def _views_of(stored: Mapping[str, np.ndarray]) -> list[View]:
    stops = np.cumsum(stored["counts"])
    # Plain arrays over the same memory: slicing a map costs more than slicing them.
    own = [np.asarray(stored[name]) for name in ("points_px", "scores", "descriptors", "points_in_world")]
    if any(len(array) != sum(stored["counts"]) for array in own):
        raise ValueError("arrays of different lengths")
    views = []
    for i, (start, stop) in enumerate(zip(stops - stored["counts"], stops, strict=True)):
        (width, height), (fx, fy, cx, cy) = stored["sizes"][i].tolist(), stored["pinholes"][i].tolist()
        *features, points = (array[start:stop] for array in own)
        camera = Camera(Intrinsics(width, height, fx, fy, cx, cy), Pose(stored["world_from_camera"][i]))
        views.append(View(camera, Features(*features), points))
    return views
