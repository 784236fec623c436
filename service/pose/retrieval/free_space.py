"""The space of a scene: where its opaque Gaussians are, what is free, and from which distance it was photographed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from service.jit import kernel
from service.pose.retrieval.outer_planes import ground_normal, outer_planes
from service.types import GaussianScene


@dataclass(frozen=True, slots=True)
class SpaceConfig:
    """How a scene's free space is gridded, and how distances are inferred from the Gaussians' sizes."""

    min_opacity: float = 0.3
    """Of the Gaussians that count as surface."""
    max_points: int = 400_000
    max_cells: int = 400_000
    """Of the grid over the middle 98 % of the volume."""
    points_per_cell: int = 4
    """On the six sides of a cube of cells: fewer cells, if there are not enough points to close a wall."""
    gaussian_px: float = 1.2
    """Middle one of the median Gaussian's three sizes in its training photos; 0.5 to 2.4 in seven scenes."""
    assumed_focal_px: float = 1000.0
    """Of training photos of which nothing is known."""
    max_typical_radii: float = 2.0
    max_radii: float = 5.0
    """Radii of the scene that the typical distance, and any, is at most: few, large Gaussians seem to be far away."""
    far_radii: float = 8.0
    """What is farther from the middle, such as a shell of sky, has no part in the outer planes nor, where there are
    some, in the grid."""
    min_good_views: int = 200
    max_good_views: int = 1200
    good_views_per_area: int = 40
    """Good views to search: so many for each square of the typical distance that the surfaces have, within bounds."""
    enclosure_rays: int = 32
    skipped_cells: float = 2.0
    """Cells at the start of a ray that are not examined: they may be of the surface that it leaves."""


SPACE = SpaceConfig()


@dataclass(frozen=True, slots=True)
class Space:
    """The opaque Gaussians, at most `SpaceConfig.max_points`, and a grid over the middle 98 % of them."""

    points: Float64[np.ndarray, "n 3"]
    distances: Float64[np.ndarray, "n"]
    """From which each was photographed, by its size."""
    low: Float64[np.ndarray, "3"]
    cell: float
    filled: Bool[np.ndarray, "x y z"]
    middle: Float64[np.ndarray, "3"]
    radius: float
    """Holds half of the points."""
    up: Float64[np.ndarray, "3"]
    is_up_known: bool
    """Whether the scene's file or its ground tells it; else it is z."""
    distance: float
    """The typical one."""
    planes: Float64[np.ndarray, "k 4"]
    """The outer ones (`outer_planes`)."""

    @property
    def wanted_good_views(self) -> float:
        """How many good views are looked for."""
        area = self.filled.sum() * self.cell**2
        return float(
            np.clip(SPACE.good_views_per_area * area / self.distance**2, SPACE.min_good_views, SPACE.max_good_views)
        )

    def occupied(self, positions: Float64[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Return whether Gaussians are there; outside the grid there are none."""
        index = np.floor((positions - self.low) / self.cell).astype(int)
        inside = np.all((index >= 0) & (index < self.filled.shape), axis=-1)
        x, y, z = np.moveaxis(np.where(inside[..., None], index, 0), -1, 0)
        return inside & self.filled[x, y, z]

    def free_distance(
        self, points: Float64[np.ndarray, "n 3"], directions: Float64[np.ndarray, "n 3"], reach: float
    ) -> Float64[np.ndarray, "n"]:
        """Return the free distance from points of surfaces along directions, at most `reach`, in scene units."""
        starts = (points - self.low) / self.cell
        steps = _steps_in_the_clear(
            self.filled, starts, directions, SPACE.skipped_cells, max(0, round(reach / self.cell))
        )
        return np.minimum((SPACE.skipped_cells + steps) * self.cell, reach)

    def enclosures(self, positions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
        """Return for each position the share of all directions that end at a Gaussian within the grid."""
        starts = np.repeat((positions - self.low) / self.cell, SPACE.enclosure_rays, axis=0)
        directions = np.tile(fibonacci_directions(SPACE.enclosure_rays), (len(positions), 1))
        most = int(np.linalg.norm(self.filled.shape))
        met = _steps_in_the_clear(self.filled, starts, directions, SPACE.skipped_cells, most) < most
        return met.reshape(-1, SPACE.enclosure_rays).mean(1)


@kernel
def _steps_in_the_clear(filled, starts, directions, first, most):
    """Return how many steps of a cell each one gets, from `first` cells away on, before a filled one, or `most`."""
    steps = np.empty(len(starts), np.int64)
    for i in range(len(starts)):
        # No filled cell on the way so far.
        steps[i] = most
        for k in range(most):
            away = first + k
            x = int(np.floor(starts[i, 0] + away * directions[i, 0]))
            y = int(np.floor(starts[i, 1] + away * directions[i, 1]))
            z = int(np.floor(starts[i, 2] + away * directions[i, 2]))
            inside = min(x, y, z) >= 0 and x < filled.shape[0] and y < filled.shape[1] and z < filled.shape[2]
            if inside and filled[x, y, z]:
                steps[i] = k
                break
    return steps


def free_space_of(scene: GaussianScene) -> Space:
    """Return the space of a scene, from its Gaussians' places and sizes."""
    opaque = np.flatnonzero(scene.opacities > SPACE.min_opacity)
    opaque = opaque if len(opaque) else np.arange(scene.count)
    opaque = opaque[:: -(-len(opaque) // SPACE.max_points)]
    points = scene.means[opaque].astype(np.float64)
    sizes = np.sort(scene.scales[opaque].astype(np.float64), axis=1)[:, 1]  # long and thin ones: how fine they are
    # The largest and smallest Gaussians are background and noise.
    sizes = np.clip(sizes, *np.quantile(sizes, [0.1, 0.9]))
    info = scene.info
    focal = info.training_focal_px or info.training_long_side_px or SPACE.assumed_focal_px
    middle = np.median(points, axis=0)
    away = np.linalg.norm(points - middle, axis=1)
    radius = float(np.median(away))
    distances = np.clip(sizes * focal / SPACE.gaussian_px, 1e-9, max(SPACE.max_radii * radius, 1e-9))
    typical = float(min(np.median(distances), SPACE.max_typical_radii * radius))
    near = points[away <= SPACE.far_radii * radius]
    planes = outer_planes(near, typical)
    low, cell, filled = _grid(near if len(planes) else points)
    ground = ground_normal(planes)
    up = np.array(info.up_in_world or ((0.0, 0.0, 1.0) if ground is None else ground))
    known = info.up_in_world is not None or ground is not None
    return Space(points, distances, low, cell, filled, middle, radius, up, known, typical, planes)


def _grid(points: Float64[np.ndarray, "n 3"]) -> tuple[Float64[np.ndarray, "3"], float, Bool[np.ndarray, "x y z"]]:
    """Return the corner, the cells' side and the filled cells of a grid over the middle 98 % of the points."""
    # Floaters far away would make the grid too coarse.
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    low, high = low - 0.02 * (high - low), high + 0.02 * (high - low)  # walls may lie exactly there
    # A wall is a surface: its cells grow with the square of the resolution, the volume's with the cube.
    cells = min(SPACE.max_cells, (len(points) / (6 * SPACE.points_per_cell)) ** 1.5)
    cell = max(float(np.cbrt(np.prod(np.maximum(high - low, 1e-3 * (high - low).max())) / cells)), 1e-9)
    shape = np.floor((high - low) / cell).astype(int) + 1
    index = np.floor((points - low) / cell).astype(int)
    index = index[np.all((index >= 0) & (index < shape), axis=1)]
    counts = np.bincount(np.ravel_multi_index(index.T, shape), minlength=int(np.prod(shape)))
    return low, cell, (counts >= 2).reshape(shape)


def fibonacci_directions(count: int) -> Float64[np.ndarray, "n 3"]:
    """Return evenly spread directions (a Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + np.sqrt(5.0)) * i
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)
