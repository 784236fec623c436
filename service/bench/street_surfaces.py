"""Painted surfaces of the synthetic street, and how Gaussians are put on them.

A surface is a rectangle, a cylinder, or a cloud of leaves; a paint gives the colour (sRGB, 0..1) of points on it, by
their position (u, v) in scene units. Lengths are in scene units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from service.scene_formats.gaussians import RawGaussians, sh_from_rgb

Points = Float64[np.ndarray, "n 2"]
Colours = Float64[np.ndarray, "n 3"]
Paint = Callable[[Points], Colours]
Place = Sequence[float] | Float64[np.ndarray, "3"]
Sampler = Callable[[int, np.random.Generator], tuple[np.ndarray, np.ndarray, np.ndarray]]
LATTICE = 61
"""Cells after which a noise repeats."""


@dataclass(frozen=True, slots=True)
class Surface:
    """A surface that Gaussians are put on."""

    area: float
    """Times its density relative to others."""
    sample: Sampler
    """Returns about so many points in the world, their unit normals and colours."""


def rectangle(corner: Place, u: Place, v: Place, paint: Paint, weight: float = 1.0) -> Surface:
    """Return the rectangle of a corner and two edges, seen from both sides."""
    origin, edges = np.array(corner, float), np.array([u, v], float)
    lengths = np.linalg.norm(edges, axis=1)
    normal = np.cross(*edges) / np.prod(lengths)

    def sample(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        share = _jittered_grid(count, lengths, rng)
        return origin + share @ edges, np.tile(normal, (len(share), 1)), paint(share * lengths)

    return Surface(float(np.prod(lengths)) * weight, sample)


def box(corner: Place, size: Place, paint: Paint, weight: float = 1.0) -> list[Surface]:
    """Return the four sides and the top of a box whose edges are those of the world."""
    (x, y, z), (a, b, c) = corner, size
    sides = [((x, y, z), (a, 0, 0), (0, 0, c)), ((x, y + b, z), (a, 0, 0), (0, 0, c)),
             ((x, y, z), (0, b, 0), (0, 0, c)), ((x + a, y, z), (0, b, 0), (0, 0, c)),
             ((x, y, z + c), (a, 0, 0), (0, b, 0))]  # fmt: skip
    return [rectangle(at, u, v, paint, weight) for at, u, v in sides]


def cylinder(foot: Place, radius: float, height: float, paint: Paint) -> Surface:
    """Return an upright cylinder without its ends."""

    def sample(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        around = 2 * np.pi * radius
        share = _jittered_grid(count, np.array([around, height]), rng)
        angle = 2 * np.pi * share[:, 0]
        normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(share))], 1)
        points = np.array(foot) + radius * normals + share[:, 1:] * [0, 0, height]
        return points, normals, paint(share * [around, height])

    return Surface(2 * np.pi * radius * height, sample)


def leaves(middle: Place, radii: Place, paint: Paint) -> Surface:
    """Return the leaves of a tree: in clumps about an ellipsoid, turned at random."""

    def sample(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        clumps = _directions(40, rng) * rng.uniform(0.4, 1.0, (40, 1))
        chosen = rng.integers(40, size=count)
        points = np.array(middle) + (clumps[chosen] + 0.16 * rng.standard_normal((count, 3))) * radii
        return points, _directions(count, rng), paint(points[:, :2] + points[:, 2:])

    return Surface(8 * float(np.mean(radii)) ** 2, sample)


def noise(rng: np.random.Generator, cell: float, colours: int = 1) -> Callable[[Points], Float64[np.ndarray, "n c"]]:
    """Return a smooth random function of the position, -1..1: values of a lattice of this cell, interpolated."""
    values = rng.uniform(-1, 1, (LATTICE, LATTICE, colours))

    def at(points: Points) -> np.ndarray:
        first = np.floor(points / cell).astype(np.int64)
        share = points / cell - first
        (x, y), (a, b) = first.T, (share * share * (3 - 2 * share)).T[..., None]
        corner = [values[(x + i) % LATTICE, (y + j) % LATTICE] for i in (0, 1) for j in (0, 1)]
        return (corner[0] * (1 - b) + corner[1] * b) * (1 - a) + (corner[2] * (1 - b) + corner[3] * b) * a

    return at


def cells(rng: np.random.Generator, size: tuple[float, float], shift: float = 0.0) -> Callable[[Points], np.ndarray]:
    """Return a random value 0..1 for each cell of a grid, as of bricks; odd rows are shifted by this share of one."""
    values = rng.random((LATTICE, LATTICE))

    def at(points: Points) -> np.ndarray:
        row = np.floor(points[:, 1] / size[1]).astype(np.int64)
        column = np.floor(points[:, 0] / size[0] + shift * (row % 2)).astype(np.int64)
        return values[column % LATTICE, row % LATTICE]

    return at


def rough(rng: np.random.Generator, rgb: Place, amount: float, sizes: Sequence[float]) -> Paint:
    """Return a colour with noise in cells of several sizes."""
    parts = [noise(rng, cell, 3) for cell in sizes]
    grey = [noise(rng, cell) for cell in sizes]
    return lambda p: np.array(rgb) + amount * sum(0.35 * c(p) + g(p) for c, g in zip(parts, grey, strict=True))


def bricks(rng: np.random.Generator, rgb: Place) -> Paint:
    """Return a wall of bricks of different brightness, darker and lighter in patches."""
    each, base, tall = cells(rng, (0.14, 0.05), 0.5), rough(rng, rgb, 0.1, (1.3, 0.4, 0.12)), rng.uniform(0.25, 0.45)
    return lambda p: base(p) + tall * (each(p) - 0.5)[:, None] * np.array(rgb)


def placed(surfaces: Sequence[Surface], count: int, rng: np.random.Generator) -> RawGaussians:
    """Return about `count` flat, nearly opaque Gaussians on the surfaces, at the same density everywhere."""
    per_area = count / sum(surface.area for surface in surfaces)
    parts, spacings = [], []
    for surface in surfaces:
        part = surface.sample(max(4, round(surface.area * per_area)), rng)
        parts.append(part)
        spacings.append(np.full(len(part[0]), np.sqrt(surface.area / len(part[0]))))
    points, normals, colours = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    # 0.7 of the spacing: no pixel between four neighbours lets more than 3 % through.
    scales = 0.7 * np.concatenate(spacings)[:, None] * np.exp(rng.normal(0, 0.15, (len(points), 3)))
    scales[:, 2] *= 0.15
    return gaussians(points, normals, scales, rng.uniform(0.9, 0.995, len(points)), colours)


def gaussians(
    points: np.ndarray, normals: np.ndarray, scales: np.ndarray, opacities: np.ndarray, rgb: Colours
) -> RawGaussians:
    """Return Gaussians whose third axis is the normal."""
    sh = sh_from_rgb(np.clip(rgb, 0.01, 0.99).astype(np.float32))
    means, scales, opacities = (values.astype(np.float32) for values in (points, scales, opacities))
    return RawGaussians(means, _turned_to(normals), scales, opacities, sh)


def _turned_to(normals: Float64[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 4"]:
    """Return quaternions (wxyz) that turn the z axis to these directions."""
    x, y, z = normals.T
    # Of opposite directions any axis will do.
    quats = np.where((z > -1 + 1e-9)[:, None], np.stack([1 + z, -y, x, 0 * z], 1), [0.0, 1.0, 0.0, 0.0])
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def _jittered_grid(count: int, lengths: np.ndarray, rng: np.random.Generator) -> Points:
    """Return about `count` places in the unit square, one in each cell of a grid that is square on the surface."""
    across = max(1, round(np.sqrt(count * lengths[0] / lengths[1])))
    along = max(1, round(count / across))
    i, j = (grid.ravel() for grid in np.mgrid[:across, :along])
    return (np.stack([i, j], 1) + 0.5 + rng.uniform(-0.3, 0.3, (len(i), 2))) / [across, along]


def _directions(count: int, rng: np.random.Generator) -> Float64[np.ndarray, "n 3"]:
    found = rng.standard_normal((count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)
