"""What hangs on the walls and from the ceiling of the studio."""

from __future__ import annotations

from itertools import pairwise

import bpy
import materials
import numpy as np
import objects
import prints
import shapes

Rng = np.random.Generator
Material = bpy.types.Material


def pictures(walnut: Material, rng: Rng) -> None:
    """Posters and paintings on all four walls, no two the same."""
    black = materials.plain("frame_black", (0.10, 0.10, 0.11), 0.4)
    pale = materials.plain("frame_pale", (0.82, 0.74, 0.60), 0.5)
    north, south, west, east = (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)
    n, s, w, e = 3.995, 0.005, 0.005, 4.995  # just before each wall
    # lower left corner, direction of the lower edge, size, painter, pixels (rows, columns), frame
    hangings = (
        ((1.42, n, 1.32), north, (0.52, 0.72), prints.poster_type, (760, 560), black),
        ((2.08, n, 1.50), north, (0.50, 0.625), prints.poster_circles, (700, 560), pale),
        ((2.72, n, 1.40), north, (0.50, 0.68), prints.poster_leaves, (760, 560), walnut),
        ((3.40, n, 1.25), north, (0.60, 0.80), prints.poster_blocks, (760, 560), black),
        ((0.30, n, 1.55), north, (0.82, 0.62), prints.poster_contours, (560, 740), walnut),
        ((4.25, n, 1.62), north, (0.55, 0.70), prints.poster_glass, (640, 500), pale),
        ((3.15, s, 1.50), south, (1.30, 0.82), prints.poster_mountains, (620, 980), walnut),
        ((1.35, s, 1.45), south, (0.48, 0.64), prints.poster_marble, (640, 480), pale),
        ((0.72, s, 1.50), south, (0.46, 0.64), prints.poster_type, (700, 500), black),
        ((3.76, s, 1.55), south, (0.40, 0.55), prints.poster_leaves, (700, 500), pale),
        ((w, 0.25, 1.35), west, (0.55, 0.74), prints.poster_contours, (740, 550), black),
        ((w, 3.18, 1.45), west, (0.55, 0.70), prints.poster_mountains, (700, 550), walnut),
        ((e, 0.80, 1.30), east, (0.52, 0.70), prints.poster_marble, (700, 520), walnut),
        ((e, 3.75, 1.40), east, (0.60, 0.80), prints.poster_circles, (720, 540), black),
    )
    for k, (corner, along, size, paint, pixels, wood) in enumerate(hangings):
        objects.frame(f"picture{k}", corner, along, size, paint(*pixels, rng), wood)


def pendant(steel: Material) -> None:
    """Lacquered pendant lamp over the table."""
    x, y = 2.62, 1.9
    red = materials.plain("shade", (0.82, 0.38, 0.14), 0.3, coat=0.8)
    glow = materials.plain("bulb", (1.0, 0.86, 0.62), emission=2.0)
    shapes.tube("cable", [(x, y, 2.7), (x, y, 2.15)], 0.005, steel)
    profile = [(0.24, 0), (0.225, 0.05), (0.14, 0.14), (0.04, 0.19), (0.03, 0.23), (0, 0.235)]
    shapes.lathe("shade", profile, (x, y, 1.92), red, 56)
    shapes.sphere("bulb", 0.05, (x, y, 1.99), glow, 24)


def flags(steel: Material, rng: Rng) -> None:
    """Two strings of printed flags, which give the space under the ceiling something to track."""
    strings = (((0.05, 0.35, 2.45), (4.95, 3.7, 2.42)), ((0.05, 3.6, 2.5), (4.95, 0.45, 2.44)))
    for s, ends in enumerate(strings):
        start, end = np.asarray(ends)
        t = np.linspace(0, 1, 16)[:, None]
        spots = start + (end - start) * t - (0, 0, 0.315) * t * (1 - t)
        shapes.tube(f"string{s}", [tuple(p) for p in spots], 0.003, steel)
        for k, (p, q) in enumerate(pairwise(spots)):
            left, right = p + (q - p) * 0.2, p + (q - p) * 0.8
            tip = (left + right) / 2 - (0, 0, 0.24)
            image = prints.POSTERS[(k + 5 * s) % 8](150, 150, rng)
            skin = materials.picture(f"flag{s}_{k}", np.clip(image, 0, 1), 0.9)
            corners, uv = [left, right, tip], [(0, 1), (0.5, 0), (1, 1)]
            shapes.add_mesh(f"flag{s}_{k}", corners, [(0, 2, 1)], skin, uv)
