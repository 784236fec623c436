"""Where to look at a scene from when nothing tells where its photos were taken.

    opaque Gaussians -> places in free space that look at some of them -> small renders of a thinned scene -> good?
        ^------------ aim at what no good view has seen yet <------------|
    good views -> the few that together see every surface from every side that any of them sees

Three kinds of places: on shells around the middle (objects), anywhere in the volume (rooms), and at the distance
that a Gaussian's size tells: trainers split and merge until a Gaussian fills about a pixel of the photos, so distance
= size x focal length, whatever the scene's unit and however far its background is.

A view is good if it is solid, free and inside. Solid: most of the image shows one opaque surface, not nearer than a
floater would be; from behind walls, inside floaters and towards parts never photographed, the depths along a ray
disagree. Near training cameras of a room's corner 0.8 to 0.94 of the image are solid, elsewhere 0.05 to 0.3; objects
that were photographed all around are solid from everywhere. Free: not among Gaussians. Inside: where most good views
are surrounded by the scene, one that isn't looks at the outside of its walls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from service.geometry import look_at, transformed, unproject
from service.interfaces import Frame, Rasterizer
from service.pose.retrieval.free_space import MIN_OPACITY, Space, lattice, survey
from service.pose.retrieval.lod_proxy import thinned
from service.types import Camera, GaussianScene, Intrinsics, Pose

SEARCH_PX = 64
SEARCH_FOV_DEG = 60.0
SHELLS = (1.2, 2.0, 3.4, 5.0)
"""Radii, in units of the radius that holds half of the opaque Gaussians."""
SHELL_CANDIDATES, VOLUME_CANDIDATES, SIZE_CANDIDATES = 40, 150, 100
BEST, OFFSPRING = 50, 4
NEAREST = 0.06
"""What is nearer than this share of the typical distance is in the way."""
ROUNDS, ROUND_CANDIDATES = 24, 150
WIDE_TURN = 0.8
ENOUGH_SEEN, LEAST_GAIN = 0.95, 0.005
"""Of the opaque Gaussians, by any good view: the search ends there, or when a round adds less."""
LEAST_SEEN = 0.25
"""The share of them, seen by the fewest good views, that a round aims at."""
SURROUNDED = 0.7
AS_SURROUNDED = 0.6
"""Where one good view in twenty has this share of all directions closed, the others need this share of that."""
AT_LEAST, AT_MOST, COVERED = 64, 1000, 0.93
FLOATER_REACH, FLOATER_NEIGHBOURS = 0.05, 8
"""A surface has more Gaussians than these in 3 x 3 x 3 cells, each a share of the typical distance wide."""
SEEN_AGAIN = 0.25
"""Worth of what another view of the choice shows already."""


@dataclass(frozen=True, slots=True)
class Placement:
    """The views that were found, and how much of the scene they show."""

    cameras: tuple[Camera, ...]
    candidates: int
    good: int
    coverage: float
    """Share of the opaque Gaussians that the chosen views see."""
    typical_distance: float
    """From which the Gaussians' sizes say that they were photographed; scene units, median."""
    interior: bool
    """The scene surrounds its views."""


def find_views(scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator) -> Placement:
    """Find places from which the scene looks as it did to the cameras that it was trained with."""
    space = survey(scene)
    search = thinned(scene, rasterizer, rng)
    views = _Views(space, search)
    views.judge(_shells(space) + _in_volume(space, rng) + _by_size(space, rng, SIZE_CANDIDATES))
    best = np.argsort(-np.array(views.scores), kind="stable")[:BEST]
    views.judge([_jittered(views.poses[i], space, rng) for i in best for _ in range(OFFSPRING)])
    good = views.good()
    seen = views.seen(good)
    for _ in range(ROUNDS):
        before, few = _covered(seen), len(good) < space.enough
        if before > ENOUGH_SEEN and not few:
            break
        aimed = _by_size(space, rng, ROUND_CANDIDATES // 2, seen <= np.quantile(seen, LEAST_SEEN))
        near = rng.choice(good, ROUND_CANDIDATES // 2) if len(good) else []
        views.judge(aimed + [_jittered(views.poses[i], space, rng, WIDE_TURN) for i in near])
        good = views.good()
        seen = views.seen(good)
        if _covered(seen) - before < LEAST_GAIN and not few:
            break
    chosen = good[_choice([views.cells(i) for i in good])]
    lens = search_lens(SEARCH_PX)
    cameras = tuple(Camera(lens, views.poses[i]) for i in chosen)
    coverage = _covered(views.seen(chosen))
    return Placement(cameras, len(views.poses), len(good), coverage, space.distance, views.interior)


def coverage(scene: GaussianScene, rasterizer: Rasterizer, cameras: Sequence[Camera]) -> float:
    """Return the share of the opaque Gaussians that lie on surfaces which the cameras see."""
    views = _Views(survey(scene), thinned(scene, rasterizer, np.random.default_rng(0)))
    views.add([Camera(camera.intrinsics.with_long_side(SEARCH_PX), camera.pose) for camera in cameras])
    return _covered(views.seen(np.arange(len(cameras))))


def _covered(seen: Int64[np.ndarray, "n"]) -> float:
    """Return the share of the points that are seen at all."""
    return float((seen > 0).mean())


def floaters(scene: GaussianScene) -> float:
    """Return the share of the opaque Gaussians that have hardly any others around: no surface, but haze."""
    space = survey(scene)
    size = FLOATER_REACH * space.distance
    cells, counts = np.unique(np.floor(space.points / size).astype(np.int64), axis=0, return_counts=True)
    ids = _ids(cells)
    order = np.argsort(ids)
    around = np.zeros(len(cells), int)
    for step in np.ndindex(3, 3, 3):
        wanted = _ids(cells + np.array(step) - 1)
        at = order[np.minimum(np.searchsorted(ids, wanted, sorter=order), len(ids) - 1)]
        around += np.where(ids[at] == wanted, counts[at], 0)
    opaque = max(int((scene.opacities > MIN_OPACITY).sum()), len(space.points))
    alone = around <= max(1.0, FLOATER_NEIGHBOURS * len(space.points) / opaque)
    return float(counts[alone].sum() / counts.sum())


def solidity(frame: Frame, min_distance: float) -> float:
    """Return the share of the image that shows one opaque surface, not nearer than `min_distance`."""
    return float(_solid(frame, min_distance).mean())


def _solid(frame: Frame, min_distance: float) -> Bool[np.ndarray, "h w"]:
    apart = np.abs(frame.depth - frame.median_depth)
    return (frame.alpha > 0.9) & (frame.median_depth > min_distance) & (apart < 0.05 * frame.median_depth)


def search_lens(long_side: int) -> Intrinsics:
    """Return the lens of the found views: 4:3, SEARCH_FOV_DEG wide."""
    focal = 0.5 * long_side / np.tan(np.radians(0.5 * SEARCH_FOV_DEG))
    height = long_side * 3 // 4
    return Intrinsics(long_side, height, focal, focal, 0.5 * long_side, 0.5 * height)


class _Views:
    """Candidates, how solid each is, and what it sees of the scene."""

    def __init__(self, space: Space, rasterizer: Rasterizer) -> None:
        self.poses: list[Pose] = []
        self.scores: list[float] = []
        self._enclosures: list[float] = []
        self._least_enclosed = 0.0
        """Of a good view, as far as is known; more than 0: the scene surrounds them."""
        self._surfaces: list[Float64[np.ndarray, "n 3"]] = []
        self._surface_ids: list[Int64[np.ndarray, "_"]] = []
        """Of the voxels that each sees."""
        self._space, self._rasterizer = space, rasterizer
        self._voxel = 0.25 * space.distance
        points = _ids(np.floor(space.points / self._voxel).astype(np.int64))
        self._voxels, self._voxel_of = np.unique(points, return_inverse=True)

    def judge(self, poses: Sequence[Pose]) -> None:
        """Render the candidates small. Those among Gaussians are not worth it, nor those known to be outside."""
        positions = np.stack([pose.position_in_world for pose in poses])
        enclosures = self._space.enclosures(positions)
        worth = np.flatnonzero(~self._space.occupied(positions) & (enclosures >= self._least_enclosed))
        lens = search_lens(SEARCH_PX)
        self.add([Camera(lens, poses[i]) for i in worth.tolist()])
        self._enclosures += enclosures[worth].tolist()

    @property
    def interior(self) -> bool:
        return self._least_enclosed > 0

    def add(self, cameras: Sequence[Camera]) -> None:
        nearest = NEAREST * self._space.distance
        for camera, frame in zip(cameras, self._rasterizer.render(cameras, approximate=True), strict=True):
            height, width = frame.alpha.shape
            row, column = (grid.ravel() for grid in np.mgrid[2:height:4, 2:width:4])
            solid = _solid(frame, nearest)
            kept = solid[row, column]
            px = np.stack([column[kept], row[kept]], 1) + 0.5
            points = unproject(px, frame.median_depth[row, column][kept], camera.intrinsics)
            self.poses.append(camera.pose)
            self.scores.append(float(solid.mean()))
            self._surfaces.append(transformed(camera.pose.world_from_camera, points))
            voxels = np.floor(self._surfaces[-1] / self._voxel).astype(np.int64)
            self._surface_ids.append(np.unique(_ids(voxels)))

    def good(self) -> Int64[np.ndarray, "k"]:
        """Return which candidates are solid and, where that tells, inside; and take note whether it does."""
        scores, enclosures = np.array(self.scores), np.array(self._enclosures)
        solid = np.flatnonzero((scores >= 0.5 * np.quantile(scores, 0.9)) & (scores > 0))
        limit = float(np.quantile(enclosures[solid], 0.95)) if len(solid) else 0.0
        self._least_enclosed = AS_SURROUNDED * limit if limit >= SURROUNDED else 0.0
        return solid[enclosures[solid] >= self._least_enclosed]

    def seen(self, chosen: Int64[np.ndarray, "k"]) -> Int64[np.ndarray, "n"]:
        """Tell of each point of the space how many of the views see its voxel."""
        ids = np.concatenate([*(self._surface_ids[i] for i in chosen), np.empty(0, np.int64)])
        at = np.minimum(np.searchsorted(self._voxels, ids), len(self._voxels) - 1)
        return np.bincount(at[self._voxels[at] == ids], minlength=len(self._voxels))[self._voxel_of]

    def cells(self, i: int) -> Int64[np.ndarray, "k"]:
        """Return what a view sees as (voxel, direction of view, octave of distance): what makes pictures alike."""
        points = self._surfaces[i]
        rays = points - self.poses[i].position_in_world
        distances = np.linalg.norm(rays, axis=1, keepdims=True)
        directions = np.rint(1.4 * rays / np.maximum(distances, 1e-12))
        octaves = np.floor(np.log2(np.maximum(distances, 1e-12)))
        voxels = np.floor(points / self._voxel)
        return np.unique(_ids(np.concatenate([voxels, directions, octaves], 1).astype(np.int64)))


def _ids(rows: Int64[np.ndarray, "n d"]) -> Int64[np.ndarray, "n"]:
    """Return one number for each row of small numbers; chance collisions do no harm."""
    result = np.zeros(len(rows), np.uint64)
    for column in rows.T:
        result = (result ^ column.astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        result ^= result >> np.uint64(29)
    return result.astype(np.int64)


def _choice(cells: Sequence[Int64[np.ndarray, "_"]]) -> Int64[np.ndarray, "k"]:
    """Take the view that adds most, again and again, until the choice shows what all together show.

    What a single candidate sees counts half: it may be an odd place.
    """
    ids, inverse = np.unique(np.concatenate(cells), return_inverse=True)
    rows = np.split(inverse, np.cumsum([len(c) for c in cells])[:-1])
    worth = np.minimum(np.bincount(inverse, minlength=len(ids) + 1), 2).astype(np.float64)
    worth[len(ids)] = 0
    table = np.full((len(rows), max(map(len, rows))), len(ids))
    for row, own in zip(table, rows, strict=True):
        row[: len(own)] = own
    left, total, seen = worth.copy(), worth.sum(), 0.0
    chosen: list[int] = []
    while len(chosen) < min(AT_MOST, len(rows)) and (len(chosen) < AT_LEAST or seen < COVERED * total):
        gains = left[table].sum(1)
        gains[chosen] = -1
        taken = int(np.argmax(gains))
        new = np.unique(table[taken])
        seen += float(left[new][left[new] == worth[new]].sum())
        left[new] *= SEEN_AGAIN
        chosen.append(taken)
    return np.array(chosen, int)


def _shells(space: Space) -> list[Pose]:
    """Look at the middle from all around."""
    middle, radius = space.middle, space.radius
    directions = lattice(SHELL_CANDIDATES)
    return [look_at(middle + factor * radius * d, middle, space.up) for factor in SHELLS for d in directions]


def _in_volume(space: Space, rng: np.random.Generator) -> list[Pose]:
    """Look from random places in the volume towards random Gaussians."""
    low, high = np.quantile(space.points, [0.05, 0.95], axis=0)
    positions = rng.uniform(low, high, (VOLUME_CANDIDATES, 3))
    targets = space.points[rng.integers(len(space.points), size=VOLUME_CANDIDATES)]
    return _looking(positions, targets, space.up)


def _by_size(
    space: Space, rng: np.random.Generator, count: int, wanted: Bool[np.ndarray, "n"] | None = None
) -> list[Pose]:
    """Look at random Gaussians, of those wanted, from about as far as their sizes tell; rather level than not."""
    among = np.arange(len(space.points)) if wanted is None else np.flatnonzero(wanted)
    taken = rng.choice(among, count)
    directions = rng.standard_normal((count, 3))
    directions -= 0.5 * (directions @ space.up)[:, None] * space.up
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    targets = space.points[taken]
    distances = space.distances[taken] * np.exp(rng.uniform(np.log(0.4), np.log(1.6), count))
    distances = np.minimum(distances, 0.9 * space.clear(targets, -directions, float(distances.max())))
    return _looking(targets - distances[:, None] * directions, targets, space.up)


def _looking(
    positions: Float64[np.ndarray, "n 3"], targets: Float64[np.ndarray, "n 3"], up: Float64[np.ndarray, "3"]
) -> list[Pose]:
    return [look_at(p, t, up) for p, t in zip(positions, targets, strict=True) if np.any(p != t)]


def _jittered(pose: Pose, space: Space, rng: np.random.Generator, turn: float = 0.25) -> Pose:
    """Move a pose a little and turn it, by some 15 degrees if not said otherwise; upright again."""
    reach = 0.3 * min(space.radius, space.distance)
    position = pose.position_in_world + reach * rng.uniform(-1, 1, 3)
    axis = pose.axis_in_world + turn * rng.standard_normal(3)
    return look_at(position, position + axis, space.up)
