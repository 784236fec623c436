"""Printed things of the studio scene, drawn like textures.py: posters, book spines, globe, view.

Arrays are (height, width, 3), sRGB values in 0..1, row 0 at the top of the picture.
"""

from __future__ import annotations

import numpy as np
from textures import CREAM, INK, PALETTE, Array, Rng, blend, cells, fbm, grid, ramp, step


def globe(rng: Rng) -> Array:
    """Invented continents with a graticule, equirectangular."""
    h, w = 384, 768
    land = fbm((h, w), (90, 110), rng, 6)
    y, x = grid(h, w)
    # Fade the seam towards sea so that both ends of the map meet.
    land = land * np.clip(np.minimum(x, w - x) / 40, 0, 1)
    high = ramp(fbm((h, w), (40, 40), rng), [(0.42, 0.52, 0.25), (0.80, 0.68, 0.40), (0.62, 0.42, 0.27)])
    image = ramp(fbm((h, w), (60, 60), rng), [(0.15, 0.36, 0.50), (0.33, 0.58, 0.66)])
    mask = step(land, 0.54, 0.02)
    image = blend(image, high, mask)
    image = blend(image, INK, (np.abs(land - 0.54) < 0.008).astype(float))
    lines = np.minimum(np.abs((x % 64) - 32), np.abs((y % 48) - 24))
    return blend(image, CREAM, 0.5 * (lines < 1))


def sky_view(height: int, width: int, rng: Rng) -> Array:
    """What is seen through the window: sky, soft clouds, hills and tree tops."""
    y, _ = grid(height, width)
    clouds = step(fbm((height, width), (110, 230), rng, 6), 0.55, 0.35)
    image = ramp(y / height, [(0.50, 0.70, 0.90), (0.78, 0.87, 0.94), (0.95, 0.94, 0.88)])
    image = blend(image, (0.98, 0.97, 0.94), 0.85 * clouds)
    for k, tone in enumerate([(0.60, 0.71, 0.72), (0.45, 0.60, 0.47), (0.30, 0.47, 0.27)]):
        ridge = height * (0.55 + 0.12 * k) - 90 * (fbm((1, width), (1, 260 - 60 * k), rng, 6) - 0.5)
        leafy = 0.75 + 0.5 * fbm((height, width), (22, 22), rng, 5)
        image = blend(image, np.asarray(tone) * leafy[..., None], step(y - ridge, 0, 3))
    return np.clip(image, 0, 1)


def glyphs(image: Array, box: tuple[int, int, int, int], size: int, ink: Array, rng: Rng) -> None:
    """Rows of invented letters inside box (top, left, bottom, right), drawn in place."""
    top, left, bottom, right = box
    for y in range(top, bottom - size, int(size * 1.7)):
        x = left
        stop = right - int(rng.random() ** 2 * (right - left) * 0.5)
        while x < stop - size:
            if rng.random() > 0.16:
                mask = np.kron(rng.random((4, 3)) < 0.58, np.ones((-(-size // 4), -(-size // 4))))
                part = image[y : y + size, x : x + (size * 3) // 4]
                part[mask[: part.shape[0], : part.shape[1]] > 0] = ink
            x += size


def poster_mountains(h: int, w: int, rng: Rng) -> Array:
    """Layers of ridges under a big sun."""
    y, x = grid(h, w)
    image = ramp(y / h, [(0.16, 0.30, 0.45), (0.91, 0.66, 0.45), (0.97, 0.86, 0.62)])
    sun = np.hypot(x - w * 0.62, y - h * 0.34)
    image = blend(image, (0.98, 0.93, 0.76), 1 - step(sun, w * 0.17, 2))
    for k in range(6):
        ridge = h * (0.42 + 0.1 * k) - h * 0.22 * (fbm((1, w), (1, w * (0.6 - 0.07 * k)), rng, 6) - 0.4)
        tone = ramp(np.array(k / 5), [(0.74, 0.50, 0.45), (0.45, 0.32, 0.42), (0.11, 0.16, 0.24)])
        grain = 0.85 + 0.3 * fbm((h, w), (20, 50), rng, 3)
        image = blend(image, tone * grain[..., None], step(y - ridge, 0, 2))
    return image


def poster_circles(h: int, w: int, rng: Rng) -> Array:
    """Grid of concentric circles on coloured squares."""
    image = np.zeros((h, w, 3))
    n = 4
    size = w // n
    y, x = grid(size, size)
    for top in range(0, h, size):
        for left in range(0, w, size):
            wobble = 9 * (fbm((size, size), (40, 40), rng, 2) - 0.5)
            radius = np.hypot(x - size * 0.5, y - size * (0.46 + 0.08 * rng.random())) + wobble
            picks = PALETTE[rng.permutation(len(PALETTE))]
            ring = np.clip(radius / (size * (0.10 + 0.03 * rng.random())), 0, 9).astype(int)
            part = image[top : top + size, left : left + size]
            part[:] = picks[ring][: part.shape[0], : part.shape[1]]
    return image * (0.85 + 0.25 * fbm((h, w), (12, 12), rng))[..., None]


def poster_marble(h: int, w: int, rng: Rng) -> Array:
    """Marbled paper."""
    a = fbm((h, w), (160, 160), rng, 4)
    b = fbm((h, w), (70, 120), rng, 4)
    wave = 0.5 + 0.5 * np.sin(22 * a + 9 * b)
    return ramp(wave, PALETTE[[2, 6, 4, 8, 0, 5]])


def poster_glass(h: int, w: int, rng: Rng) -> Array:
    """Stained-glass cells."""
    index, border = cells(h, w, 70, rng, 30)
    tones = PALETTE[rng.integers(0, len(PALETTE), 70)] * (0.8 + 0.3 * rng.random((70, 1)))
    shade = 0.8 + 0.35 * fbm((h, w), (30, 30), rng)
    return np.clip(blend(tones[index] * shade[..., None], INK, 1 - step(border, 7, 3)), 0, 1)


def poster_type(h: int, w: int, rng: Rng) -> Array:
    """Exhibition bill in an invented script."""
    image = np.ones((h, w, 3)) * (0.95, 0.91, 0.82)
    y, x = grid(h, w)
    disc = np.hypot(x - w * 0.66, y - h * 0.60)
    image = blend(image, PALETTE[0], 1 - step(disc, w * 0.27, 2))
    stripes = step(np.sin((x + y) * 0.16), 0.1, 0.2) * (disc < w * 0.40) * (disc > w * 0.31)
    image = blend(image, PALETTE[2], stripes)
    glyphs(image, (h // 16, w // 12, h // 3, w - w // 12), w // 7, np.asarray(INK), rng)
    glyphs(image, (h // 2, w // 12, h - h // 12, w // 2 + 40), w // 22, np.asarray(INK), rng)
    return image * (0.93 + 0.1 * fbm((h, w), (60, 60), rng))[..., None]


def poster_blocks(h: int, w: int, rng: Rng) -> Array:
    """Overlapping rectangles, discs and bars."""
    image = np.ones((h, w, 3)) * CREAM
    y, x = grid(h, w)
    for k in range(26):
        cy, cx = rng.random(2) * (h, w)
        ry, rx = (0.05 + 0.18 * rng.random(2)) * w
        if k % 3 == 0:
            mask = np.hypot((x - cx) / rx, (y - cy) / rx) < 1
        elif k % 3 == 1:
            mask = (np.abs(x - cx) < rx) & (np.abs(y - cy) < ry)
        else:
            mask = (np.abs((x - cx) + (y - cy)) < 7) & (np.abs(x - cx) < 2 * rx)
        image = blend(image, PALETTE[rng.integers(len(PALETTE))], 0.88 * mask)
    return image * (0.88 + 0.18 * fbm((h, w), (25, 25), rng))[..., None]


def poster_contours(h: int, w: int, rng: Rng) -> Array:
    """Map of an invented island with contour lines."""
    field = fbm((h, w), (190, 190), rng, 6)
    sea, coast = [(0.20, 0.42, 0.52), (0.50, 0.70, 0.70)], [(0.93, 0.89, 0.72)]
    land = [(0.60, 0.66, 0.38), (0.78, 0.60, 0.36), (0.95, 0.93, 0.90)]
    image = ramp(field, sea + coast + land)
    lines = np.abs((field * 22) % 1 - 0.5)
    image = blend(image, (0.30, 0.22, 0.18), 0.8 * (1 - step(lines, 0.10, 0.08)))
    y, x = grid(h, w)
    mesh = np.minimum(np.abs(x % 90 - 45), np.abs(y % 90 - 45))
    return blend(image, INK, 0.45 * (mesh < 0.8))


def poster_leaves(h: int, w: int, rng: Rng) -> Array:
    """Botanical print: stems with leaves of many shapes."""
    shade = 0.93 + 0.1 * fbm((h, w), (50, 50), rng)
    image = shade[..., None] * (0.92, 0.89, 0.79)
    y, x = grid(h, w)
    for stem in range(3):
        sx = w * (0.22 + 0.28 * stem)
        curve = sx + 26 * np.sin(y / h * 4 + stem * 2)
        image = blend(image, (0.25, 0.33, 0.20), (np.abs(x - curve) < 2.5) & (y > h * 0.12))
        for k in range(9):
            cy = h * (0.14 + 0.085 * k)
            side = 1 if k % 2 else -1
            cx = sx + 26 * np.sin(cy / h * 4 + stem * 2) + side * w * 0.075
            tilt = side * (0.5 + 0.4 * rng.random())
            u = (x - cx) * np.cos(tilt) + (y - cy) * np.sin(tilt)
            v = -(x - cx) * np.sin(tilt) + (y - cy) * np.cos(tilt)
            size = w * (0.06 + 0.03 * rng.random())
            inside = (u / size) ** 2 + (v / (size * 0.42)) ** 2
            tone = PALETTE[[3, 9, 2, 0][rng.integers(4)]] * (0.8 + 0.3 * rng.random())
            image = blend(image, tone, (1 - step(inside, 1, 0.1)))
            image = blend(image, CREAM, ((np.abs(v) < 1.5) & (inside < 0.8)).astype(float))
    return image


POSTERS = (
    poster_mountains,
    poster_circles,
    poster_marble,
    poster_glass,
    poster_type,
    poster_blocks,
    poster_contours,
    poster_leaves,
)

SPINE = (48, 384)  # width and height of one book spine in the atlas
SPINES = (24, 6)  # columns and rows of the atlas


def spine_atlas(rng: Rng) -> Array:
    """Atlas of book spines: each cell has its own colours, bands, title and ornament."""
    w, h = SPINE
    image = np.zeros((h * SPINES[1], w * SPINES[0], 3))
    for row in range(SPINES[1]):
        for col in range(SPINES[0]):
            cell = image[row * h : (row + 1) * h, col * w : (col + 1) * w]
            paint_spine(cell, rng)
    return np.clip(image, 0, 1)


def paint_spine(cell: Array, rng: Rng) -> None:
    """Paint one spine in place."""
    h, w = cell.shape[:2]
    tone = PALETTE[rng.integers(len(PALETTE))] * (0.7 + 0.4 * rng.random())
    light = tone.mean() > 0.5
    ink = np.asarray(INK if light else CREAM)
    if rng.random() < 0.3:
        ink = PALETTE[1] if not light else PALETTE[5]
    cell[:] = tone * (0.86 + 0.28 * fbm((h, w), (60, 10), rng, 4))[..., None]
    for _ in range(rng.integers(1, 5)):
        at, thick = int(rng.random() * (h - 30)), int(3 + 16 * rng.random() ** 2)
        cell[at : at + thick] = PALETTE[rng.integers(len(PALETTE))]
    top = int(h * (0.12 + 0.3 * rng.random()))
    glyphs(cell, (top, 8, top + int(h * (0.2 + 0.3 * rng.random())), w - 4), 13, ink, rng)
    y, x = grid(h, w)
    spot = np.hypot(x - w / 2, y - h * (0.78 + 0.1 * rng.random()))
    cell[spot < w * 0.26] = ink
    cell[spot < w * 0.13] = tone
    cell[:, [0, -1]] *= 0.6
