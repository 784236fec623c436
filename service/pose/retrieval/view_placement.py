"""Where to view a scene from when nothing is known of where its photos were taken.

    opaque Gaussians -> places in free space that look at some of them -> small renders of its LOD proxy -> good?
        ^------------ aim at what no good view shows yet <---------------|
    good views -> the few that together see every surface from every side that any of them sees

Three kinds of places: on shells around the middle (objects), anywhere in the volume (rooms), and at the distance
inferred from a Gaussian's size: training splits and merges Gaussians until each fills about a pixel of the photos, so
distance = size x focal length, whatever the scene's unit and however far its background is.

Photos are taken upright, and features tolerate a roll of some 30 degrees. Where neither the scene's file nor a ground
between walls tells the up direction, z and -y are assumed, as Blender's and nerfstudio's scenes and COLMAP's have it:
each place has a view upright by each.

A view is good if it is solid, free and inside. Solid: most of the image shows one opaque surface, not nearer than a
floater would be; from behind walls, inside floaters and towards parts never photographed, the depths along a ray
disagree. Near training cameras of a room's corner 0.8 to 0.94 of the image are solid, elsewhere 0.05 to 0.3; objects
that were photographed all around are solid from everywhere. Free: not among Gaussians. Inside: where most good views
are surrounded by the scene, one that isn't looks at the outside of its walls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from service.geometry import look_at, transformed, unproject
from service.interfaces import Frame, Rasterizer
from service.pose.retrieval.free_space import Space, fibonacci_directions, free_space_of
from service.pose.retrieval.lod_proxy import lod_proxy
from service.pose.retrieval.outer_planes import before_planes
from service.types import Camera, GaussianScene, Intrinsics, Pose


@dataclass(frozen=True, slots=True)
class PlacementConfig:
    """How views are searched in a scene without cameras. Counts and shares are this search's own choice."""

    render_px: int = 64
    """Long side of a candidate's render."""
    fov_deg: float = 60.0
    """Horizontal field of view."""
    shell_radii: tuple[float, ...] = (1.2, 2.0, 3.4, 5.0)
    """In units of the radius that holds half of the opaque Gaussians."""
    shell_candidates: int = 40
    volume_candidates: int = 150
    size_candidates: int = 100
    """First candidates: on each shell, anywhere in the volume, at the distance that Gaussians' sizes suggest."""
    best: int = 50
    candidates_near_each: int = 4
    """The best of them, and how many candidates are drawn near each."""
    min_distance: float = 0.06
    """What is nearer than this share of the typical distance blocks the view."""
    opaque_alpha: float = 0.9
    max_depth_spread: float = 0.05
    """A pixel shows a single surface where its alpha is greater than this, and its mean depth differs from the median
    one by less than this share."""
    score_quantile: float = 0.9
    min_score_share: float = 0.5
    """A candidate is solid if its share of such pixels is at least `min_score_share` of this quantile of all shares;
    in the choice at the end, of the shares of those as far from the scene's middle, by octave."""
    voxel_share: float = 0.25
    """Side of the voxels in which surfaces are recorded, as a share of the typical distance."""
    rounds: int = 24
    round_candidates: int = 150
    """Further rounds, at most, and the candidates of each."""
    wide_turn: float = 0.8
    """Standard deviation of the change of the viewing direction in those rounds (a vector of unit length)."""
    sufficient_coverage: float = 0.95
    min_gain: float = 0.005
    """Share of the opaque Gaussians that any good view sees: the search ends there, or when a round adds less."""
    least_seen_share: float = 0.25
    """The share of them, seen by the fewest good views, that a round aims at."""
    interior_enclosure: float = 0.7
    relative_enclosure: float = 0.6
    enclosure_quantile: float = 0.95
    """The scene is an interior if this quantile of the solid views' enclosures (shares of closed directions) is at
    least `interior_enclosure`, and...; a good view then needs `relative_enclosure` of that quantile."""
    room_enclosure: float = 0.85
    """...the median of those above a half is at least this: within a room it is 0.95, within hollow objects 0.6 to 0.8.
    A room that is taken for an open scene wastes some views; of a bowl that is taken for a room all are in it."""
    min_views: int = 64
    max_views: int = 20_000
    covered_share: float = 0.93
    """The choice ends with `max_views`, or once it has `min_views` and shows this share of what all good views show."""
    tolerated_roll_deg: float = 30.0
    """Rolls that features tolerate: of views that another up direction turns by more, both are kept."""
    repeat_weight: float = 0.25
    """Worth of what another view of the choice shows already, relative to what none shows."""


PLACEMENT = PlacementConfig()
OTHER_UPS = ((0.0, -1.0, 0.0),)
"""Beside z, where a scene's up direction is unknown: COLMAP's first camera is upright in its world, y down."""


@dataclass(frozen=True, slots=True)
class Placement:
    """The views that were found, and how much of the scene they show."""

    cameras: tuple[Camera, ...]
    candidates: int
    good: int
    coverage: float
    """Share of the opaque Gaussians that the chosen views see."""
    typical_distance: float
    """Median distance from which the Gaussians were photographed, by their sizes; scene units."""
    interior: bool
    """The scene surrounds its views."""


def find_views(
    scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator, config: PlacementConfig = PLACEMENT
) -> Placement:
    """Return views like those of the photos that the scene was trained with; see the module.

    The search is random: `rng` is its only source of randomness.
    """
    space = free_space_of(scene)
    search = lod_proxy(scene, rasterizer, rng)
    views = _Views(space, search, config)
    views.add_candidates(
        _shells(space, config) + _in_volume(space, rng, config) + _by_size(space, rng, config.size_candidates)
    )
    # Near good candidates others are likely good, too.
    best = np.argsort(-np.array(views.scores), kind="stable")[: config.best]
    views.add_candidates(
        [_jittered(views.poses[i], space, rng) for i in best for _ in range(config.candidates_near_each)]
    )
    good = views.good()
    seen = views.seen(good)
    for _ in range(config.rounds):
        before, few = _covered(seen), len(good) < space.wanted_good_views
        if before > config.sufficient_coverage and not few:
            break
        # Half of the candidates aim at what is seen least, half vary the good views.
        aimed = _by_size(space, rng, config.round_candidates // 2, seen <= np.quantile(seen, config.least_seen_share))
        near = rng.choice(good, config.round_candidates // 2) if len(good) else []
        views.add_candidates(aimed + [_jittered(views.poses[i], space, rng, config.wide_turn) for i in near])
        good = views.good()
        seen = views.seen(good)
        if _covered(seen) - before < config.min_gain and not few:
            break
    others = () if space.is_up_known else OTHER_UPS
    # With a second up direction each place may have two views.
    limited = replace(config, max_views=config.max_views // (1 + len(others)))
    chosen = _chosen(views, good, limited)
    lens = search_camera(config.render_px, config.fov_deg)
    cameras = tuple(Camera(lens, pose) for i in chosen for pose in _uprights(views.poses[i], others, config))
    coverage = _covered(views.seen(chosen))
    return Placement(cameras, len(views.poses), len(good), coverage, space.distance, views.interior)


def _chosen(views: _Views, good: Int64[np.ndarray, "k"], config: PlacementConfig) -> Int64[np.ndarray, "c"]:
    """Return the choice of the good views and, where there is room, one of the best from afar."""
    chosen = good[_choice([views.cells(i) for i in good], config)]
    # An object before a soft background is rarely solid from where photos of the whole are taken.
    afar = np.setdiff1d(views.good(or_best_from_afar=True), good)
    room = config.max_views - len(chosen)
    if not len(afar) or room < 1:
        return chosen
    return np.concatenate(
        [chosen, afar[_choice([views.cells(i) for i in afar], replace(config, min_views=0, max_views=room))]]
    )


def _uprights(pose: Pose, ups: Sequence[tuple[float, float, float]], config: PlacementConfig) -> list[Pose]:
    """Return the pose, and the same place and viewing direction upright by others' up, where that rolls the image."""
    position, axis = pose.position_in_world, pose.axis_in_world
    turned = [look_at(position, position + axis, np.array(up)) for up in ups]
    least = np.cos(np.radians(config.tolerated_roll_deg))
    return [pose, *(t for t in turned if t.world_from_camera[:3, 0] @ pose.world_from_camera[:3, 0] < least)]


def coverage(scene: GaussianScene, rasterizer: Rasterizer, cameras: Sequence[Camera]) -> float:
    """Return the share of the opaque Gaussians that lie on surfaces which the cameras see."""
    views = _Views(free_space_of(scene), lod_proxy(scene, rasterizer, np.random.default_rng(0)), PLACEMENT)
    views.add([Camera(camera.intrinsics.with_long_side(PLACEMENT.render_px), camera.pose) for camera in cameras])
    return _covered(views.seen(np.arange(len(cameras))))


def _covered(seen: Int64[np.ndarray, "n"]) -> float:
    """Return the share of the points that are seen at all."""
    return float((seen > 0).mean())


def shows_single_surface(
    frame: Frame, min_distance: float, config: PlacementConfig = PLACEMENT
) -> Bool[np.ndarray, "h w"]:
    """Return which pixels show one opaque surface, not nearer than `min_distance`."""
    # Where several surfaces contribute, the mean depth differs from the median one.
    apart = np.abs(frame.depth - frame.median_depth)
    opaque = frame.alpha > config.opaque_alpha
    return opaque & (frame.median_depth > min_distance) & (apart < config.max_depth_spread * frame.median_depth)


def search_camera(long_side: int, fov_deg: float = PLACEMENT.fov_deg) -> Intrinsics:
    """Return the intrinsics of the views that are searched: 4:3, with this horizontal field of view."""
    focal = 0.5 * long_side / np.tan(np.radians(0.5 * fov_deg))
    height = long_side * 3 // 4
    return Intrinsics(long_side, height, focal, focal, 0.5 * long_side, 0.5 * height)


class _Views:
    """Candidate views, how solid each is, and what it sees of the scene."""

    def __init__(self, space: Space, rasterizer: Rasterizer, config: PlacementConfig) -> None:
        self.poses: list[Pose] = []
        self.scores: list[float] = []
        self._enclosures: list[float] = []
        self._least_enclosed = 0.0
        """Of a good view, as far as is known; more than 0: the scene surrounds them."""
        self._surfaces: list[Float64[np.ndarray, "n 3"]] = []
        self._surface_ids: list[Int64[np.ndarray, "_"]] = []
        """Of the voxels that each sees."""
        self._space, self._rasterizer, self._config = space, rasterizer, config
        self._voxel = config.voxel_share * space.distance
        points = cell_ids(np.floor(space.points / self._voxel).astype(np.int64))
        self._voxels, self._voxel_of = np.unique(points, return_inverse=True)

    def add_candidates(self, poses: Sequence[Pose]) -> None:
        """Render the candidates small, except those among Gaussians, behind planes and known to be outside."""
        positions = np.stack([pose.position_in_world for pose in poses])
        enclosures = self._space.enclosures(positions)
        # Rendering is what costs, so candidates are filtered by geometry first.
        free = ~self._space.occupied(positions) & before_planes(positions, self._space.planes)
        worth = np.flatnonzero(free & (enclosures >= self._least_enclosed))
        lens = search_camera(self._config.render_px, self._config.fov_deg)
        self.add([Camera(lens, poses[i]) for i in worth.tolist()])
        self._enclosures += enclosures[worth].tolist()

    @property
    def interior(self) -> bool:
        return self._least_enclosed > 0

    def add(self, cameras: Sequence[Camera]) -> None:
        nearest = self._config.min_distance * self._space.distance
        for camera, frame in zip(cameras, self._rasterizer.render(cameras, approximate=True), strict=True):
            height, width = frame.alpha.shape
            row, column = (grid.ravel() for grid in np.mgrid[2:height:4, 2:width:4])
            solid = shows_single_surface(frame, nearest, self._config)
            kept = solid[row, column]
            px = np.stack([column[kept], row[kept]], 1) + 0.5
            points = unproject(px, frame.median_depth[row, column][kept], camera.intrinsics)
            self.poses.append(camera.pose)
            self.scores.append(float(solid.mean()))
            self._surfaces.append(transformed(camera.pose.world_from_camera, points))
            voxels = np.floor(self._surfaces[-1] / self._voxel).astype(np.int64)
            self._surface_ids.append(np.unique(cell_ids(voxels)))

    def good(self, or_best_from_afar: bool = False) -> Int64[np.ndarray, "k"]:
        """Return which candidates are solid and, in an interior, inside; note whether the scene is an interior.

        `or_best_from_afar`: also those that are solid among the candidates as far from the scene's middle.
        """
        scores, enclosures = np.array(self.scores), np.array(self._enclosures)
        least = self._least_score(scores)
        if or_best_from_afar:
            away = np.linalg.norm([pose.position_in_world for pose in self.poses] - self._space.middle, axis=1)
            octaves = np.rint(np.log2(np.maximum(away / max(self._space.radius, 1e-12), 1)))
            # From farther away more of the image is background, which is rarely solid.
            limits = {octave: self._least_score(scores[octaves == octave]) for octave in np.unique(octaves)}
            by_octave = [limits[octave] for octave in octaves]
            least = np.minimum(least, by_octave)
        solid = np.flatnonzero((scores >= least) & (scores > 0))
        self._least_enclosed = self._least_enclosure(enclosures[solid])
        return solid[enclosures[solid] >= self._least_enclosed]

    def _least_enclosure(self, enclosures: Float64[np.ndarray, "k"]) -> float:
        """Return the enclosure that a good view needs, by those of solid ones; 0 where the scene is no interior."""
        within = enclosures[enclosures > 0.5]
        if not len(within) or float(np.median(within)) < self._config.room_enclosure:
            return 0.0
        # Not the maximum: a single view may stand in a closet.
        limit = float(np.quantile(enclosures, self._config.enclosure_quantile))
        return self._config.relative_enclosure * limit if limit >= self._config.interior_enclosure else 0.0

    def _least_score(self, scores: Float64[np.ndarray, "n"]) -> float:
        return self._config.min_score_share * float(np.quantile(scores, self._config.score_quantile))

    def seen(self, chosen: Int64[np.ndarray, "k"]) -> Int64[np.ndarray, "n"]:
        """Return for each point of the space how many of the views see its voxel."""
        ids = np.concatenate([*(self._surface_ids[i] for i in chosen), np.empty(0, np.int64)])
        at = np.minimum(np.searchsorted(self._voxels, ids), len(self._voxels) - 1)
        return np.bincount(at[self._voxels[at] == ids], minlength=len(self._voxels))[self._voxel_of]

    def cells(self, i: int) -> Int64[np.ndarray, "k"]:
        """Return what a view sees, as ids of (voxel, viewing direction, octave of distance): alike for like images."""
        points = self._surfaces[i]
        rays = points - self.poses[i].position_in_world
        distances = np.linalg.norm(rays, axis=1, keepdims=True)
        # Rounded to steps of some 40 degrees, and distances to octaves: within those, features match.
        directions = np.rint(1.4 * rays / np.maximum(distances, 1e-12))
        octaves = np.floor(np.log2(np.maximum(distances, 1e-12)))
        voxels = np.floor(points / self._voxel)
        return np.unique(cell_ids(np.concatenate([voxels, directions, octaves], 1).astype(np.int64)))


def cell_ids(rows: Int64[np.ndarray, "n d"]) -> Int64[np.ndarray, "n"]:
    """Return a hash of each row of small numbers; rare collisions do no harm."""
    result = np.zeros(len(rows), np.uint64)
    for column in rows.T:
        result = (result ^ column.astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        result ^= result >> np.uint64(29)
    return result.astype(np.int64)


def _choice(cells: Sequence[Int64[np.ndarray, "_"]], config: PlacementConfig) -> Int64[np.ndarray, "k"]:
    """Return a greedy set cover: always the view that adds most, until the choice shows what all together show.

    A cell that only a single candidate sees counts half: that candidate may be an outlier.
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
    while len(chosen) < min(config.max_views, len(rows)) and (
        len(chosen) < config.min_views or seen < config.covered_share * total
    ):
        gains = left[table].sum(1)
        gains[chosen] = -1
        taken = int(np.argmax(gains))
        new = np.unique(table[taken])
        seen += float(left[new][left[new] == worth[new]].sum())
        left[new] *= config.repeat_weight
        chosen.append(taken)
    return np.array(chosen, int)


def _shells(space: Space, config: PlacementConfig) -> list[Pose]:
    """Return poses all around the middle that look at it."""
    middle, radius = space.middle, space.radius
    directions = fibonacci_directions(config.shell_candidates)
    return [
        look_at(middle + factor * radius * d, middle, space.up) for factor in config.shell_radii for d in directions
    ]


def _in_volume(space: Space, rng: np.random.Generator, config: PlacementConfig) -> list[Pose]:
    """Return poses at random places in the volume that look at random Gaussians."""
    low, high = np.quantile(space.points, [0.05, 0.95], axis=0)
    positions = rng.uniform(low, high, (config.volume_candidates, 3))
    # Where there are more Gaussians there is more to see.
    targets = space.points[rng.integers(len(space.points), size=config.volume_candidates)]
    return _looking(positions, targets, space.up)


def _by_size(
    space: Space, rng: np.random.Generator, count: int, wanted: Bool[np.ndarray, "n"] | None = None
) -> list[Pose]:
    """Return poses that look at random Gaussians, of those wanted, from about the distance that their sizes suggest.

    Directions are horizontal rather than not.
    """
    among = np.arange(len(space.points)) if wanted is None else np.flatnonzero(wanted)
    taken = rng.choice(among, count)
    directions = rng.standard_normal((count, 3))
    # Photos are mostly taken level: the vertical part is halved.
    directions -= 0.5 * (directions @ space.up)[:, None] * space.up
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    targets = space.points[taken]
    distances = space.distances[taken] * np.exp(rng.uniform(np.log(0.4), np.log(1.6), count))
    # Not behind the next wall, as seen from the target.
    distances = np.minimum(distances, 0.9 * space.free_distance(targets, -directions, float(distances.max())))
    return _looking(targets - distances[:, None] * directions, targets, space.up)


def _looking(
    positions: Float64[np.ndarray, "n 3"], targets: Float64[np.ndarray, "n 3"], up: Float64[np.ndarray, "3"]
) -> list[Pose]:
    return [look_at(p, t, up) for p, t in zip(positions, targets, strict=True) if np.any(p != t)]


def _jittered(pose: Pose, space: Space, rng: np.random.Generator, turn: float = 0.25) -> Pose:
    """Return the pose moved a little and rotated, by some 15 degrees with the default `turn`, and upright."""
    reach = 0.3 * min(space.radius, space.distance)
    position = pose.position_in_world + reach * rng.uniform(-1, 1, 3)
    axis = pose.axis_in_world + turn * rng.standard_normal(3)
    return look_at(position, position + axis, space.up)
