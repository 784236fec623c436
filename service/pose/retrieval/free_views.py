"""Views beside those of the index: nearer, and from other sides, than the training cameras.

Photos of another day are taken from places of their own: from the other end of a table, or close to a wall that was
only photographed from across the room. Features tolerate some 35 degrees and a factor of 1.5 in distance, so that no
view of the index may be like such a photo.

    a point that an index view sees -> a camera nearer to it, turned about it -> small render -> solid?
    solid ones -> greedy set cover: the few that together show what the index doesn't

Such cameras stand in the space that the index views look through: free, and inside of what was captured. Most photos
don't need them, so they are rendered when the first photo does, and keep only what retrieval compares. They are stored
beside the index: of a scene that was loaded before, they are read.
"""

from __future__ import annotations

import heapq
import logging
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from service.geometry import look_at, transformed, unproject
from service.interfaces import Features, Frame, Matcher, Rasterizer
from service.pose.features.image_sizes import sized
from service.pose.features.rendered_views import View, in_batches, views_of
from service.pose.retrieval.free_space import free_space_of
from service.pose.retrieval.lod_proxy import lod_proxy
from service.pose.retrieval.outer_planes import before_planes
from service.pose.retrieval.scores import SCORES
from service.pose.retrieval.view_files import read_views, write_views
from service.pose.retrieval.view_placement import cell_ids, search_camera, shows_single_surface
from service.types import Camera, GaussianScene, Pose

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FreeViewConfig:
    """How the cameras are drawn and chosen. Counts and shares are this search's own choice."""

    views_per_index_view: int = 6
    max_views: int = 640
    candidates_per_view: int = 7
    """Views, at most, and candidates that are rendered for each of so many."""
    candidate_px: int = 64
    render_px: int = 384
    """Long sides of the renders of candidates and of views."""
    nearest: float = 0.25
    farthest: float = 1.2
    """Distance from the point that is looked at, relative to that of the index view that sees it."""
    turn: float = 0.6
    aim: float = 0.2
    """Standard deviations of the changes (vectors of unit length) of the direction to that point, and of the camera's
    axis away from it."""
    min_solid_share: float = 0.5
    """Of the image, in which one opaque surface is seen, not nearer than..."""
    min_distance: float = 0.06
    """...this share of the median distance to the index views' points."""
    voxel: float = 0.4
    """Side of the voxels in which surfaces are recorded, as a share of the distance they are seen from."""
    covered_share: float = 0.93
    """The choice ends once it shows this share of what all candidates show."""


FREE_VIEWS = FreeViewConfig()


@dataclass(slots=True)
class FreeViews:
    """The views of one scene beside its index: rendered once, by whoever needs them first, and kept in a file."""

    path: Path | None = None
    _views: tuple[View, ...] | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def of(
        self, scene: GaussianScene, rasterizer: Rasterizer, matcher: Matcher, index: Sequence[View]
    ) -> tuple[View, ...]:
        """Return the views, with their strongest features only."""
        with self._lock:
            if self._views is None:
                stored = read_views(self.path)
                self._views = stored[0] if stored else _rendered(scene, rasterizer, matcher, index)
                if self.path and self._views and not stored:
                    self._store(self.path, self._views)
            return self._views

    def _store(self, path: Path, views: Sequence[View]) -> None:
        try:
            write_views(path, views, {})
        except OSError as error:
            # The photo that needs the views can do without the file.
            log.warning("the views beside the index are not stored: %s", error)


def _rendered(
    scene: GaussianScene, rasterizer: Rasterizer, matcher: Matcher, index: Sequence[View]
) -> tuple[View, ...]:
    def seen(some: list[Camera]) -> list[View]:
        return [_strongest(view) for view in views_of(rasterizer.render(some), some, matcher)]

    with ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="free-views") as pool:
        cameras = free_view_cameras(scene, rasterizer, index, lambda f, items: list(pool.map(f, items)))
        return tuple(chain.from_iterable(pool.map(seen, in_batches(cameras, rasterizer.cameras_at_once))))


def _strongest(view: View) -> View:
    # Extractors return features by strength; copies, so that the others' memory is freed.
    features, count = view.features, SCORES.view_features
    kept = Features(*(a[:count].copy() for a in (features.points_px, features.scores, features.descriptors)))
    return View(view.camera, kept, view.points_in_world[:count].copy())


def free_view_cameras(
    scene: GaussianScene,
    rasterizer: Rasterizer,
    index: Sequence[View],
    mapped: Callable = lambda f, items: [f(item) for item in items],
    config: FreeViewConfig = FREE_VIEWS,
) -> list[Camera]:
    """Return cameras that show what the index's views don't: other distances and sides of surfaces; see the module."""
    seeing = [view for view in index if len(view.points_in_world)]
    if not seeing:
        return []
    rng = np.random.default_rng(0)
    search = lod_proxy(scene, rasterizer, rng)
    lens = search_camera(config.candidate_px)
    limit = min(config.max_views, config.views_per_index_view * len(index))
    poses = _candidates(seeing, rng, config.candidates_per_view * limit, config)
    before = before_planes(np.stack([pose.position_in_world for pose in poses]), free_space_of(scene).planes)
    poses = [pose for pose, is_before in zip(poses, before, strict=True) if is_before]
    nearest = config.min_distance * float(np.median([view.distance for view in seeing]))
    batches = list(in_batches([Camera(lens, pose) for pose in poses], search.cameras_at_once))
    cells = list(chain.from_iterable(mapped(lambda some: _solid_cells(some, search, nearest, config), batches)))
    solid = [i for i, own in enumerate(cells) if own is not None]
    known = [_cells(view.points_in_world.astype(np.float64), view.camera.pose, config) for view in seeing]
    chosen = _choice([cells[i] for i in solid], np.unique(np.concatenate(known)), limit, config)
    return [Camera(sized(lens, config.render_px), poses[solid[i]]) for i in chosen]


def _candidates(views: Sequence[View], rng: np.random.Generator, count: int, config: FreeViewConfig) -> list[Pose]:
    """Return poses that look at points which the views see: mostly from nearer, from other sides, upright as they."""
    poses = []
    for i in rng.integers(len(views), size=count):
        points, pose = views[i].points_in_world, views[i].camera.pose
        target = points[rng.integers(len(points))].astype(np.float64)
        ray = target - pose.position_in_world
        distance = float(np.linalg.norm(ray)) * np.exp(rng.uniform(np.log(config.nearest), np.log(config.farthest)))
        direction = _unit(_unit(ray) + config.turn * rng.standard_normal(3))
        position = target - distance * direction
        axis = direction + config.aim * rng.standard_normal(3)
        poses.append(look_at(position, position + axis, -pose.world_from_camera[:3, 1]))
    return poses


def _unit(vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _solid_cells(
    cameras: Sequence[Camera], search: Rasterizer, nearest: float, config: FreeViewConfig
) -> list[Int64[np.ndarray, "_"] | None]:
    """Render candidates; return what each sees (`_cells`), None if too little of its image is a single surface."""
    frames = search.render(cameras, approximate=True)
    return [_cells_seen(*each, nearest, config) for each in zip(frames, cameras, strict=True)]


def _cells_seen(frame: Frame, camera: Camera, nearest: float, config: FreeViewConfig) -> Int64[np.ndarray, "k"] | None:
    height, width = frame.alpha.shape
    row, column = (grid.ravel() for grid in np.mgrid[2:height:4, 2:width:4])
    kept = shows_single_surface(frame, nearest)[row, column]
    if kept.mean() < config.min_solid_share:
        return None
    px = np.stack([column[kept], row[kept]], 1) + 0.5
    points = unproject(px, frame.median_depth[row, column][kept], camera.intrinsics)
    return _cells(transformed(camera.pose.world_from_camera, points), camera.pose, config)


def _cells(points: Float64[np.ndarray, "n 3"], pose: Pose, config: FreeViewConfig) -> Int64[np.ndarray, "k"]:
    """Return what a view sees, as ids of (voxel, viewing direction, octave of distance): alike for like images."""
    rays = points - pose.position_in_world
    distances = np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    octaves = np.rint(np.log2(distances))
    # Rounded to steps of some 40 degrees: within those, features match.
    directions = np.rint(1.4 * rays / distances)
    voxels = np.floor(points / (config.voxel * 2.0**octaves))
    return np.unique(cell_ids(np.concatenate([voxels, directions, octaves], 1).astype(np.int64)))


def _choice(
    cells: Sequence[Int64[np.ndarray, "_"]], known: Int64[np.ndarray, "k"], limit: int, config: FreeViewConfig
) -> list[int]:
    """Return a greedy set cover of the cells that aren't known, each of which counts as often as candidates see it."""
    if not cells:
        return []
    ids, inverse, counts = np.unique(np.concatenate(cells), return_inverse=True, return_counts=True)
    rows = np.split(inverse, np.cumsum([len(own) for own in cells])[:-1])
    left = np.where(np.isin(ids, known), 0.0, counts)
    enough = (1 - config.covered_share) * float(counts.sum())
    # Gains only decrease: the first one in the heap is the best as soon as it is up to date.
    heap = [(-float(left[row].sum()), i) for i, row in enumerate(rows)]
    heapq.heapify(heap)
    chosen: list[int] = []
    while heap and len(chosen) < limit and left.sum() > enough:
        _, i = heapq.heappop(heap)
        current = -float(left[rows[i]].sum())
        if heap and current > heap[0][0]:
            heapq.heappush(heap, (current, i))
            continue
        left[rows[i]] = 0.0
        chosen.append(i)
    return chosen
