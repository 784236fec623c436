"""Floaters: Gaussians in free space that belong to no surface, and whether they veil what is behind them.

Around a point of a surface its Gaussians cover about the section of a plane, whatever the scene's unit and density;
around a floater, next to nothing does. So for cubes from a Gaussian's own size up to a share of the distance that it is
seen from, the area which the others in the cube cover is compared with the cube's section:

    support = max over cubes of  sum of opacity x 2 pi x largest x middle scale of the others / side^2

Only Gaussians among cameras and content are asked for theirs: skies and far backgrounds are thin, but hide nothing.
Cubes tell nothing of Gaussians that are as large as the content: whatever is in them supports them. But where a camera
stood there is no surface, so a large Gaussian that has one inside is a floater, unless its middle is farther than the
content: it is drawn at its middle's depth.
Captures of real places have such Gaussians, too, which are part of what their photos show. They are left as they are
unless they veil the content: by their optical depth in front of it (the negative logarithm of the light that passes,
as of particles in a volume), averaged over the images of training cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from service.geometry import rotation_from_quat, transformed
from service.jit import inline, kernel
from service.pose.retrieval.free_space import SPACE, Space, free_space_of
from service.types import Camera, GaussianScene


@dataclass(frozen=True, slots=True)
class FloaterConfig:
    """What counts as a floater, and from when on floaters are left out."""

    min_support: float = 0.4
    """Planted floaters have 0.02 to 0.3 where they aren't near a surface; 99.9 % of the Gaussians of a scene trained on
    rendered photos have more."""
    reach: float = 0.025
    """Side of the cells, three to a cube, as a share of the typical distance. That is known within a factor of 2.4, and
    cubes mustn't reach from the middle of a street to its houses."""
    finest_level: int = -6
    coarsest_level: int = 5
    """Powers of two by which cells are smaller or larger than that: from the middle scale of the Gaussian on."""
    large: float = 0.01
    """Longest scale, as a share of the typical distance, from which Gaussians are asked for cameras inside."""
    inside: float = 2.0
    """Standard deviations from its middle within which a camera is inside of a Gaussian: beyond, a seventh is left of
    its opacity."""
    cameras: int = 24
    """Training cameras, about, from which the veil is measured."""
    content_quantile: float = 0.25
    front_share: float = 0.7
    """Floaters nearer than this share of that quantile of the depths in view are in front of the content..."""
    near_share: float = 0.02
    """...and count only from this share on: nearer ones hide much of one camera's image, and nothing of others'."""
    content_points: int = 20_000
    """Gaussians, about, whose depths are taken."""
    max_veil: float = 0.06
    """Median optical depth from which on floaters are left out. Ten scenes have 0.00 to 0.035, and a poor model of a
    room 0.22; with 3000 large faint floaters 0.22 to 1, with 900 0.07 to 0.7."""


FLOATERS = FloaterConfig()


@dataclass(frozen=True, slots=True)
class Floaters:
    """The floaters of a scene."""

    found: Bool[np.ndarray, "n"]
    """Which Gaussians are floaters."""
    veil: float
    """Optical depth of them in front of the content, the median of the cameras; 0 without any."""
    left_out: bool
    """Whether the veil is dense enough for localization to be without them."""


def find_floaters(scene: GaussianScene, config: FloaterConfig = FLOATERS) -> Floaters:
    """Return the floaters of a scene with training cameras; of one without any, none.

    0.1 s for 240,000 Gaussians; without renders.
    """
    found = np.zeros(scene.count, bool)
    if not scene.cameras:
        return Floaters(found, 0.0, False)
    space = free_space_of(scene)
    among = np.flatnonzero(_among_cameras_and_content(scene, space))
    found[among] = _supports(scene, space, among, config) < config.min_support
    found[_around_cameras(scene, space, config)] = True
    density = veil(scene, found, _some_cameras(scene, config), config)
    return Floaters(found, density, density > config.max_veil)


def without_floaters(scene: GaussianScene, config: FloaterConfig = FLOATERS) -> GaussianScene:
    """Return the scene without floaters that veil it: their opacities are 0. The other arrays are shared."""
    floaters = find_floaters(scene, config)
    if not floaters.left_out:
        return scene
    return replace(scene, opacities=np.where(floaters.found, np.float32(0), scene.opacities))


def veil(
    scene: GaussianScene, floaters: Bool[np.ndarray, "n"], cameras: Sequence[Camera], config: FloaterConfig = FLOATERS
) -> float:
    """Return the median over cameras of the floaters' optical depth in front of the content, averaged over the image.

    Each adds its opacity times its image's area, at most the whole image.
    """
    solid = np.flatnonzero(~floaters & (scene.opacities > SPACE.min_opacity))
    solid = scene.means[solid[:: -(-len(solid) // config.content_points) or 1]].astype(np.float64)
    who = np.flatnonzero(floaters)
    means, opacities = scene.means[who].astype(np.float64), scene.opacities[who]
    areas = opacities * _areas(np.sort(scene.scales[who].astype(np.float64), axis=1))
    depths = []
    for camera in cameras:
        content = _depths_in_view(solid, camera)
        content = content[np.isfinite(content)]
        if not len(content):
            continue
        front = float(np.quantile(content, config.content_quantile))
        depth = _depths_in_view(means, camera)
        seen = (depth > config.near_share * front) & (depth < config.front_share * front)
        lens = camera.intrinsics
        shares = areas[seen] / depth[seen] ** 2 * (lens.fx * lens.fy / (lens.width * lens.height))
        depths.append(np.minimum(shares, opacities[seen]).sum())
    return float(np.median(depths)) if depths else 0.0


def _depths_in_view(points: Float64[np.ndarray, "n 3"], camera: Camera) -> Float64[np.ndarray, "n"]:
    """Return the z-depths of the points in a camera's image; infinite for the others."""
    x, y, z = transformed(camera.pose.camera_from_world, points).T
    lens = camera.intrinsics
    # Behind the camera, and beside it, neither condition is asked.
    away = np.where(z == 0, 1.0, np.abs(z))
    column, row = (lens.fx * x / away + lens.cx), (lens.fy * y / away + lens.cy)
    inside = (z > 0) & (column > 0) & (column < lens.width) & (row > 0) & (row < lens.height)
    return np.where(inside, z, np.inf)


def _around_cameras(scene: GaussianScene, space: Space, config: FloaterConfig) -> Int64[np.ndarray, "k"]:
    """Return the large Gaussians that have a training camera inside, ahead of it and nearer than the content."""
    longest = scene.scales.max(1)
    who = np.flatnonzero(longest > config.large * space.distance)
    # A sky may have all cameras inside, too, but its middle is farther than the content.
    reach = np.minimum(config.inside * longest[who], _front(scene, space, config))
    means, octaves = scene.means[who].astype(np.float64), np.floor(np.log2(np.maximum(reach, 1e-30)))
    # By size and along the scene's longest side: a camera is asked of few of many millions.
    side = int(np.argmax(np.ptp(means, axis=0))) if len(who) else 0
    order = np.argsort(means[:, side], kind="stable")
    around = np.zeros(len(who), bool)
    poses = [named.camera.pose for named in scene.cameras]
    for octave in np.unique(octaves):
        part = order[octaves[order] == octave]
        middles, width = means[part], 2.0 ** (octave + 1)
        places = np.ascontiguousarray(middles[:, side])
        turns = rotation_from_quat(scene.quats[who[part]])
        scales, reaches = scene.scales[who[part]].astype(np.float64), reach[part]
        for pose in poses:
            at = pose.position_in_world
            some = slice(*np.searchsorted(places, [at[side] - width, at[side] + width]))
            around[part[some]] |= _is_around(
                at, pose.axis_in_world, middles[some], turns[some], scales[some], reaches[some], config.inside
            )
    return who[around]


def _front(scene: GaussianScene, space: Space, config: FloaterConfig) -> float:
    """Return the depth of the content's nearer part, the median of some cameras; 0 where none sees any."""
    solid = space.points[:: -(-len(space.points) // config.content_points)]
    depths = [_depths_in_view(solid, camera) for camera in _some_cameras(scene, config)]
    depths = [depth[np.isfinite(depth)] for depth in depths]
    nearer = [np.quantile(depth, config.content_quantile) for depth in depths if len(depth)]
    return float(np.median(nearer)) if nearer else 0.0


def _some_cameras(scene: GaussianScene, config: FloaterConfig) -> list[Camera]:
    return [named.camera for named in scene.cameras[:: -(-len(scene.cameras) // config.cameras)]]


def _among_cameras_and_content(scene: GaussianScene, space: Space) -> Bool[np.ndarray, "n"]:
    """Return which Gaussians are in the box around the training cameras and the middle half of the opaque ones."""
    places = [named.camera.pose.position_in_world for named in scene.cameras]
    corners = np.concatenate([np.stack(places), np.quantile(space.points, [0.25, 0.75], axis=0)])
    return ((scene.means >= corners.min(0)) & (scene.means <= corners.max(0))).all(1)


def _supports(
    scene: GaussianScene, space: Space, among: Int64[np.ndarray, "k"], config: FloaterConfig
) -> Float64[np.ndarray, "k"]:
    """Return the supports of these Gaussians; where one reaches `min_support`, it may be larger than is returned."""
    base = max(config.reach * space.distance, 1e-9)  # 0: all Gaussians at one place
    means = scene.means.astype(np.float64) - space.middle
    sizes = np.sort(scene.scales.astype(np.float64), axis=1)
    areas = scene.opacities * _areas(sizes)
    own = np.log2(np.maximum(sizes[among, 1] / base, 1e-9))
    finest = np.clip(np.floor(own), config.finest_level, config.coarsest_level)
    result = np.zeros(len(among))
    # Most are decided at the first level; finer ones are for thin things, coarser ones for large Gaussians.
    for level in sorted(range(config.finest_level, config.coarsest_level + 1), key=lambda n: (n < 0, abs(n))):
        asked = np.flatnonzero((finest <= level) & (level <= np.maximum(finest, 0)) & (result < config.min_support))
        if len(asked):
            side = 3 * base * 2.0**level
            covered = _area_around(means, areas, sizes[:, 2], side, among[asked])
            result[asked] = np.maximum(result[asked], covered / side**2)
    return result


def _areas(sizes: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
    """Return the integrals of Gaussians with these ascending scales over their largest sections, of a peak of 1."""
    return 2 * np.pi * sizes[:, 1] * sizes[:, 2]


def _area_around(
    means: Float64[np.ndarray, "n 3"],
    areas: Float64[np.ndarray, "n"],
    largest: Float64[np.ndarray, "n"],
    side: float,
    asked: Int64[np.ndarray, "k"],
) -> Float64[np.ndarray, "k"]:
    """Return the area of the others in the cube of 3 x 3 x 3 cells around each of the Gaussians `asked`.

    Gaussians longer than the cube aren't of it.
    """
    keys = _keys(np.floor(means[asked] / (side / 3)).astype(np.int64))
    cells, cell_of = np.unique(keys, return_inverse=True)
    steps = _keys(np.indices((3, 3, 3)).reshape(3, -1).T.astype(np.int64)) - _keys(np.ones((1, 3), np.int64))
    near = np.unique(cells[:, None] + steps)
    # At most a quarter full, so that looking up takes a step or two.
    table = np.full(1 << int(np.ceil(np.log2(4 * len(near)))), -1, np.int64)
    totals = np.zeros(len(table))
    _insert(table, near)
    _add_areas(table, totals, means, areas, largest, side)
    own = np.where(largest[asked] < side, areas[asked], 0.0)
    return _sums(table, totals, cells, steps)[cell_of] - own


_BITS = 21
"""Of a cell's number along each axis; farther ones are counted as the last."""
_OFFSET = 1 << (_BITS - 1)


def _keys(cells: Int64[np.ndarray, "n 3"]) -> Int64[np.ndarray, "n"]:
    """Return one number for each cell; differences of keys are the same wherever two cells are."""
    x, y, z = (np.clip(cells, 2 - _OFFSET, _OFFSET - 2) + _OFFSET).T
    return (x << (2 * _BITS)) | (y << _BITS) | z


@inline
def _slot(table, key):
    """Return where a key is in a hash table with linear probing, or the free place where it belongs."""
    mask = np.int64(len(table) - 1)
    # Multiplicative hashing (Knuth): the high bits of the product depend on all bits of the key.
    at = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)) & mask
    while table[at] != key and table[at] != -1:
        at = (at + 1) & mask
    return at


@kernel
def _is_around(eye, axis, means, turns, scales, reach, inside):
    """Return which Gaussians an eye is inside of, ahead of it and nearer than their reach.

    `turns`: their axes as columns; `inside`: standard deviations.
    """
    result = np.zeros(len(means), np.bool_)
    for i in range(len(means)):
        x, y, z = means[i, 0] - eye[0], means[i, 1] - eye[1], means[i, 2] - eye[2]
        if x * x + y * y + z * z >= reach[i] * reach[i] or x * axis[0] + y * axis[1] + z * axis[2] <= 0:
            continue
        squared = 0.0
        for k in range(3):
            along = x * turns[i, 0, k] + y * turns[i, 1, k] + z * turns[i, 2, k]
            squared += (along / max(scales[i, k], 1e-30)) ** 2
        result[i] = squared < inside * inside
    return result


@kernel
def _insert(table, keys):
    """Write the keys into an empty table (-1)."""
    for i in range(len(keys)):
        table[_slot(table, keys[i])] = keys[i]


@kernel
def _add_areas(table, totals, means, areas, largest, side):
    """Add the areas of the Gaussians, except those longer than the cube, to the totals of the cells in the table."""
    for i in range(len(means)):
        if largest[i] < side:
            key = np.int64(0)
            for axis in range(3):
                cell = np.int64(np.floor(means[i, axis] / (side / 3)))
                cell = min(max(cell, np.int64(2 - _OFFSET)), np.int64(_OFFSET - 2)) + np.int64(_OFFSET)
                key = (key << np.int64(_BITS)) | cell
            at = _slot(table, key)
            if table[at] == key:
                totals[at] += areas[i]


@kernel
def _sums(table, totals, cells, steps):
    """Return for each cell the sum of the totals at these steps from it."""
    result = np.zeros(len(cells))
    for i in range(len(cells)):
        for k in range(len(steps)):
            result[i] += totals[_slot(table, cells[i] + steps[k])]
    return result
