"""Draws plan views: the parts of one, and a coverage map with its legend in words."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from service.coverage.coverage_map import CoverageMap
from service.photos.images import encode_image

LEVELS: tuple[tuple[float, tuple[int, int, int], str], ...] = (
    (0.9, (8, 81, 156), "found: 90 % and more"),
    (0.7, (74, 152, 207), "usually found: 70 to 90 %"),
    (0.4, (214, 124, 16), "sometimes found: 40 to 70 %"),
    (0.0, (166, 60, 6), "rarely found: below 40 %"),
)
"""Least probability, colour (sRGB, from blue to orange: told apart also by those who don't see red or green), words."""
_PX, _MARGIN, _LEGEND = 900, 40, 200
PAPER = (255, 255, 255)
_BLIND, _CAMERA, _INK = (205, 205, 205), (190, 40, 40), (30, 30, 30)


def drawn_plan(
    found: CoverageMap,
    surfaces_in_world: Float[np.ndarray, "n 3"],
    cameras_in_world: Float[np.ndarray, "k 3"],
    metres_per_unit: float | None = None,
) -> bytes:
    """Return a PNG: each cell a disc of wedges, one a heading; the scene's surfaces grey, its training cameras red."""
    cells, cameras = (points @ found.plan_from_world.T for points in (found.positions_in_world, cameras_in_world))
    around = np.concatenate([cells[:, :2], cameras[:, :2]])
    low, high = around.min(0) - 1.5 * found.cell, around.max(0) + 1.5 * found.cell
    scale = (_PX - 2 * _MARGIN) / float((high - low).max())
    height = int((high - low)[1] * scale) + 2 * _MARGIN

    def pixels(points: np.ndarray) -> np.ndarray:
        x, y = ((points[:, :2] - low) * scale).T
        return np.stack([_MARGIN + x, height - _MARGIN - y], 1)

    image = np.full((height + _LEGEND, _PX, 3), PAPER, np.uint8)
    shade(image[:height], pixels(surfaces_in_world @ found.plan_from_world.T))
    radius = 0.46 * found.cell * scale
    for middle, row, sees in zip(pixels(cells), found.probabilities, found.sees_scene, strict=True):
        for heading, probability, seen in zip(found.headings_rad, row, sees, strict=True):
            half = np.pi / len(found.headings_rad)
            draw_wedge(image, middle, radius, heading, half, level_colour(probability) if seen else _BLIND)
    for at in pixels(cameras):
        draw_dot(image, at)
    _legend(image, height, found, scale / (metres_per_unit or 1.0), "m" if metres_per_unit else "units")
    return encode_image(image, "png")


def level_colour(probability: float) -> tuple[int, int, int]:
    """Return the colour of a probability."""
    return next(colour for least, colour, _ in LEVELS if probability >= least)


def shade(image: UInt8[np.ndarray, "h w 3"], at: np.ndarray) -> None:
    """Darken pixels by the number of the scene's surfaces there."""
    height, width = image.shape[:2]
    x, y = np.floor(at).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    counts = np.bincount(y[inside] * width + x[inside], minlength=height * width).reshape(height, width)
    smooth = cv2.GaussianBlur(counts.astype(np.float32), (0, 0), 1.5)
    # The densest pixels are walls, seen along their height: relative to those floors would be white.
    dark = np.clip(smooth / max(float(np.quantile(smooth, 0.98)), 1e-6), 0, 1)[..., None]
    image[:] = (image * (1 - 0.35 * dark)).astype(np.uint8)


def draw_wedge(
    image: np.ndarray, middle: np.ndarray, radius: float, heading: float, half: float, colour: Sequence[int]
) -> None:
    """Draw a sector around `middle`, `half` radians to either side of a heading from the plan's first axis."""
    angles = heading + np.linspace(-0.9 * half, 0.9 * half, 6)
    # Image rows go down, the plan's second axis up.
    rim = middle + radius * np.stack([np.cos(angles), -np.sin(angles)], 1)
    corners = np.concatenate([middle + 0.25 * (rim[[0]] - middle), rim, middle + 0.25 * (rim[[-1]] - middle)])
    # In sixteenths of a pixel (the last argument): whole pixels would make narrow wedges uneven.
    cv2.fillPoly(image, [np.rint(corners * 16).astype(np.int32)], colour, cv2.LINE_AA, 4)


def _legend(image: np.ndarray, top: int, found: CoverageMap, scale: float, unit: str) -> None:
    write_words(image, found.title, (_MARGIN, top + 22), 0.6)
    rows = [*((colour, words) for _, colour, words in LEVELS), (_BLIND, "nothing of the scene in view")]
    for number, (colour, words) in enumerate(rows):
        x, y = _MARGIN + 430 * (number % 2), top + 52 + 26 * (number // 2)
        cv2.rectangle(image, (x, y - 13), (x + 18, y + 3), colour, -1)
        write_words(image, words, (x + 28, y), 0.5)
    draw_dot(image, np.array([_MARGIN + 439.0, top + 99.0]), 4)
    write_words(image, "training camera", (_MARGIN + 458, top + 104), 0.5)
    write_scale(image, (_MARGIN, top + 140), scale, f"{unit}; each wedge points where the camera looks")
    write_words(image, f"{len(found.trials)} renders made as photos are, seen from above", (_MARGIN, top + 175), 0.5)


def draw_dot(image: UInt8[np.ndarray, "h w 3"], at: Float[np.ndarray, "2"], radius: int = 3) -> None:
    """Draw the place of a training camera."""
    cv2.circle(image, tuple(np.rint(at).astype(int).tolist()), radius, _CAMERA, -1, cv2.LINE_AA)


def write_scale(image: UInt8[np.ndarray, "h w 3"], at: tuple[int, int], scale: float, unit: str) -> None:
    """Draw a line of a round length, about 100 pixels, from a pixel to the right; `scale` is pixels per unit."""
    length = round_length(100 / scale)
    end = at[0] + round(length * scale)
    cv2.line(image, at, (end, at[1]), _INK, 2)
    write_words(image, f"{length:g} {unit}", (end + 12, at[1] + 5), 0.5)


def round_length(about: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at most `about`."""
    power = 10.0 ** np.floor(np.log10(about))
    return float(max(step for step in (1, 2, 5) if step * power <= about * (1 + 1e-9)) * power)


def write_words(image: UInt8[np.ndarray, "h w 3"], words: str, at: tuple[int, int], size: float) -> None:
    """Write a line from the pixel of its lower left corner."""
    cv2.putText(image, words, at, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)
