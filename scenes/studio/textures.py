"""Procedural textures of the studio scene: plaster, wood, bricks, tiles, fabric, leaves.

Every texture is an array computed here from seeded noise and simple shapes, so the scene borrows
nothing. Arrays are (height, width, 3), sRGB values in 0..1, row 0 at the top of the picture.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

Rng = np.random.Generator
Array = np.ndarray

INK = (0.13, 0.14, 0.18)
CREAM = (0.94, 0.90, 0.80)
PALETTE = np.array(
    [
        (0.76, 0.29, 0.20),  # terracotta
        (0.91, 0.66, 0.25),  # ochre
        (0.16, 0.33, 0.47),  # deep blue
        (0.24, 0.50, 0.45),  # green
        (0.94, 0.88, 0.75),  # cream
        (0.55, 0.22, 0.30),  # wine
        (0.45, 0.64, 0.73),  # sky
        (0.19, 0.20, 0.26),  # ink
        (0.86, 0.50, 0.38),  # salmon
        (0.58, 0.62, 0.36),  # olive
    ]
)


def value_noise(shape: tuple[int, int], cell: tuple[float, float], rng: Rng) -> Array:
    """Smooth noise in 0..1 whose features are about `cell` (rows, columns) pixels large."""
    axes = []
    for size, step in zip(shape, cell, strict=True):
        at = np.arange(size) / step + rng.random()
        low = at.astype(int)
        frac = at - low
        axes.append((low, frac * frac * (3 - 2 * frac)))
    (row, fr), (col, fc) = axes
    grid = rng.random((row[-1] + 2, col[-1] + 2))
    fr = fr[:, None]
    top = grid[row][:, col] * (1 - fc) + grid[row][:, col + 1] * fc
    bottom = grid[row + 1][:, col] * (1 - fc) + grid[row + 1][:, col + 1] * fc
    return top * (1 - fr) + bottom * fr


def fbm(
    shape: tuple[int, int],
    cell: tuple[float, float],
    rng: Rng,
    octaves: int = 5,
    gain: float = 0.55,
) -> Array:
    """Sum of noise octaves, rescaled to 0..1 with mean about a half."""
    total = np.zeros(shape)
    weight = 0.0
    for k in range(octaves):
        size = (max(cell[0] / 2**k, 1.0), max(cell[1] / 2**k, 1.0))
        total += gain**k * value_noise(shape, size, rng)
        weight += gain**k
    return np.clip((total / weight - 0.5) * 1.6 + 0.5, 0, 1)


def blend(base: Array, colour: Array | tuple, mask: Array) -> Array:
    """`colour` over `base` where mask is 1."""
    return base + (np.asarray(colour) - base) * mask[..., None]


def ramp(value: Array, colours: Array | list) -> Array:
    """Colour ramp with evenly spaced stops over 0..1."""
    stops = np.asarray(colours, float)
    at = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(value, at, stops[:, c]) for c in range(3)], axis=-1)


def step(value: Array, edge: float, soft: float) -> Array:
    """0 below `edge`, 1 above, with a soft transition."""
    return np.clip((value - edge) / soft + 0.5, 0, 1)


def grid(height: int, width: int) -> tuple[Array, Array]:
    """Pixel centre coordinates (y, x)."""
    y, x = np.mgrid[0:height, 0:width]
    return y + 0.5, x + 0.5


def plaster(height: int, width: int, colour: tuple, rng: Rng, contrast: float = 1.0) -> Array:
    """Trowelled, slightly stained plaster: clouds, strokes and specks that never repeat."""
    shape = (height, width)
    clouds = fbm(shape, (150, 190), rng, 6) - 0.5
    strokes = fbm(shape, (10, 60), rng, 3) - 0.5
    strokes_up = fbm(shape, (70, 11), rng, 3) - 0.5
    pick = step(fbm(shape, (90, 90), rng, 2), 0.5, 0.2)
    shade = 1 + contrast * (0.30 * clouds + 0.22 * (pick * strokes + (1 - pick) * strokes_up))
    image = np.asarray(colour) * shade[..., None]
    warm = fbm(shape, (220, 160), rng, 5)
    image = blend(image, image * (1.04, 0.97, 0.86), contrast * step(warm, 0.62, 0.25))
    cracks = np.abs(fbm(shape, (160, 160), rng, 5) - 0.5)
    image = blend(image, image * 0.72, contrast * 0.55 * (1 - step(cracks, 0.008, 0.01)))
    specks = step(value_noise(shape, (3, 3), rng), 0.93, 0.05)
    return np.clip(blend(image, image * 0.78, contrast * 0.6 * specks), 0, 1)


def planks(height: int, width: int, rows: int, colours: list[tuple], rng: Rng, mean_length: float = 420) -> Array:
    """Boards running along x, each with its own tone and its own stretch of grain."""
    image = np.zeros((height, width, 3))
    edges = np.linspace(0, height, rows + 1).astype(int)
    for top, bottom in pairwise(edges):
        x = -int(rng.random() * mean_length)
        while x < width:
            length = int(mean_length * (0.6 + 0.8 * rng.random()))
            left, right = max(x, 0), min(x + length, width)
            if right > left:
                image[top:bottom, left:right] = board(bottom - top, right - left, colours, rng)
            x += length
    return image


def board(height: int, width: int, colours: list[tuple], rng: Rng) -> Array:
    """One wooden board with grain along x, a dark edge and perhaps a knot."""
    shape = (height, width)
    tone = np.asarray(colours[rng.integers(len(colours))]) * (0.82 + 0.36 * rng.random())
    y, x = grid(height, width)
    bend = fbm(shape, (height, 160), rng, 3) * height * 1.2
    if rng.random() < 0.45:
        ky, kx = height * (0.3 + 0.4 * rng.random()), width * rng.random()
        knot = np.exp(-(((x - kx) / (height * 0.7)) ** 2) - ((y - ky) / (height * 0.3)) ** 2)
    else:
        knot = np.zeros(shape)
    rings = 0.5 + 0.5 * np.sin((y + bend + 22 * knot) * (0.5 + 0.5 * rng.random()))
    streaks = fbm(shape, (2.5, 70), rng, 4)
    image = tone * (0.80 + 0.22 * rings + 0.36 * (streaks - 0.5) + 0.06)[..., None]
    image = blend(image, image * 0.45, step(knot, 0.72, 0.4))
    border = np.minimum(np.minimum(y, height - y), np.minimum(x, width - x))
    return np.clip(blend(image, image * 0.35, 1 - step(border, 1.2, 1.5)), 0, 1)


def bricks(height: int, width: int, brick: tuple[int, int], rng: Rng) -> Array:
    """Old brickwork: every brick has its own colour, wear and paint remains."""
    bh, bw = brick
    image = plaster(height, width, (0.74, 0.70, 0.64), rng)
    wear = fbm((height, width), (40, 40), rng, 4)
    tones = [(0.62, 0.30, 0.22), (0.70, 0.38, 0.27), (0.52, 0.26, 0.21), (0.74, 0.46, 0.34)]
    for row, top in enumerate(range(0, height, bh)):
        for left in range(-(row % 2) * bw // 2, width, bw):
            y0, y1 = top + 2, min(top + bh - 2, height)
            x0, x1 = max(left + 2, 0), min(left + bw - 2, width)
            if y1 <= y0 or x1 <= x0:
                continue
            tone = np.asarray(tones[rng.integers(4)]) * (0.75 + 0.5 * rng.random())
            if rng.random() < 0.06:
                tone = np.asarray((0.36, 0.27, 0.26))
            shade = 0.72 + 0.56 * fbm((y1 - y0, x1 - x0), (9, 14), rng, 3)
            image[y0:y1, x0:x1] = tone * shade[..., None]
    lime = step(wear, 0.70, 0.2) * 0.55
    return np.clip(blend(image, (0.84, 0.80, 0.74), lime), 0, 1)


def tiles(height: int, width: int, tile: int, rng: Rng) -> Array:
    """Patterned tiles: quarter circles turned at random, so the pattern does not repeat."""
    y, x = grid(tile, tile)
    image = np.zeros((height, width, 3))
    for top in range(0, height, tile):
        for left in range(0, width, tile):
            a, b = PALETTE[[2, 6, 3][rng.integers(3)]], np.asarray(CREAM)
            if rng.random() < 0.3:
                a = PALETTE[rng.integers(2)]
            near = np.minimum(np.hypot(x, y), np.hypot(tile - x, tile - y)) / tile
            cell = np.broadcast_to(b, (tile, tile, 3)) * (0.93 + 0.07 * rng.random())
            cell = blend(cell, a, step(near, 0.33, 0.04) * (1 - step(near, 0.67, 0.04)))
            cell = blend(cell, a * 0.6, 1 - step(near, 0.17, 0.04))
            cell = np.rot90(cell, rng.integers(4))
            border = np.minimum(np.minimum(x, tile - x), np.minimum(y, tile - y))
            cell = blend(cell, (0.62, 0.60, 0.56), 1 - step(border, 1.5, 1))
            part = image[top : top + tile, left : left + tile]
            part[:] = cell[: part.shape[0], : part.shape[1]]
    stain = 0.86 + 0.24 * fbm((height, width), (50, 50), rng, 4)
    return np.clip(image * stain[..., None], 0, 1)


def cells(height: int, width: int, count: int, rng: Rng, warp: float) -> tuple[Array, Array]:
    """Warped Voronoi cells: index of the nearest seed and distance to the cell's border."""
    y, x = grid(height, width)
    y = y + warp * (fbm((height, width), (90, 90), rng, 4) - 0.5)
    x = x + warp * (fbm((height, width), (90, 90), rng, 4) - 0.5)
    first = np.full((height, width), np.inf)
    second = first.copy()
    index = np.zeros((height, width), int)
    for k, (sy, sx) in enumerate(rng.random((count, 2)) * (height, width)):
        dist = np.hypot(y - sy, x - sx)
        closer = dist < first
        second = np.where(closer, first, np.minimum(second, dist))
        index[closer] = k
        first = np.where(closer, dist, first)
    return index, second - first


def rug(height: int, width: int, rng: Rng) -> Array:
    """Woven rug: patches of many colours with inner stripes, and a border of uneven blocks."""
    index, border = cells(height, width, 46, rng, 150)
    tones = PALETTE[rng.integers(0, len(PALETTE), 46)]
    image = tones[index] * 0.92
    rings = 0.5 + 0.5 * np.sin(border * (0.14 + 0.25 * rng.random(46)[index]))
    image = blend(image, PALETTE[rng.integers(0, len(PALETTE), 46)][index], step(rings, 0.8, 0.2))
    image = blend(image, CREAM, 1 - step(border, 7, 3))
    y, x = grid(height, width)
    inset = np.minimum(np.minimum(y, height - y), np.minimum(x, width - x))
    along = np.where(np.minimum(y, height - y) < np.minimum(x, width - x), x, y)
    picks = rng.integers(0, len(PALETTE), 400)
    blocks = PALETTE[picks[(along / 23).astype(int) + 80 * (y > height / 2) + 160 * (x > width / 2)]]
    image = np.where((inset < 46)[..., None], blocks, image)
    image = blend(image, INK, (np.abs(inset - 46) < 4).astype(float))
    image = blend(image, CREAM, (inset < 10).astype(float))
    weave = 0.80 + 0.3 * value_noise((height, width), (2, 2), rng)
    return np.clip(image * weave[..., None], 0, 1)


def fabric(height: int, width: int, rng: Rng) -> Array:
    """Upholstery print: irregular leaves and dots over a woven ground."""
    index, border = cells(height, width, 90, rng, 40)
    tones = PALETTE[rng.integers(0, len(PALETTE), 90)]
    ground = np.broadcast_to(PALETTE[rng.integers(0, 4)], (height, width, 3))
    image = blend(ground, tones[index], step(border, 14, 3))
    image = blend(image, CREAM, step(border, 34, 4))
    weave = 0.82 + 0.26 * value_noise((height, width), (2, 2), rng)
    return np.clip(image * weave[..., None], 0, 1)


def wood(height: int, width: int, tone: tuple, rng: Rng) -> Array:
    """Furniture wood, grain along x."""
    return board(height, width, [tone], rng)[4:-4, 4:-4]


def painted(height: int, width: int, tone: tuple, rng: Rng) -> Array:
    """Brushed, worn paint over wood."""
    shape = (height, width)
    streaks = fbm(shape, (4, 120), rng, 4) - 0.5
    image = np.asarray(tone) * (1 + 0.35 * streaks + 0.2 * (fbm(shape, (80, 80), rng) - 0.5))[..., None]
    chips = step(fbm(shape, (26, 40), rng, 5), 0.80, 0.05)
    return np.clip(blend(image, (0.66, 0.52, 0.36), chips), 0, 1)


def leaf(rng: Rng, tone: tuple = (0.20, 0.42, 0.19)) -> Array:
    """Leaf with a pale midrib and side veins."""
    y, x = grid(256, 96)
    veins = 0.5 + 0.5 * np.sin((y + 1.3 * np.abs(x - 48)) * 0.28)
    shade = 0.75 + 0.5 * fbm((256, 96), (60, 30), rng, 4)
    image = np.asarray(tone) * shade[..., None]
    image = blend(image, (0.55, 0.68, 0.36), 0.7 * step(veins, 0.93, 0.1))
    return np.clip(blend(image, (0.66, 0.75, 0.45), 1 - step(np.abs(x - 48), 3, 2)), 0, 1)
