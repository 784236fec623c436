"""A phone's camera: radial distortion, rolling shutter, vignetting, noise, white balance, tone curve, sharpening.

Works on linear images with Rec. 709 primaries, 1 is white. Camera axes are OpenCV's, pixel centres at +0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray
Rng = np.random.Generator

K1 = -0.08
MARGIN = 1.16
"""Size of the pinhole image that is resampled, relative to the photo's: K1 and the shutter show more than that."""
DENSITY = 4 / 3
"""Its pixels per pixel of the photo."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
READOUT = 0.030
"""Seconds from the first row's exposure to the last one's."""


@dataclass(frozen=True)
class Lens:
    """A photo's size, focal length (px) and distortion (COLMAP's SIMPLE_RADIAL), and the rotation while it is read out.

    `turn` is a rotation vector in radians: what the camera turns about its own axes from the first row to the last one.
    """

    width: int
    height: int
    focal: float
    k1: float
    turn: tuple[float, float, float]


def pinhole_size(width: int, height: int) -> tuple[int, int]:
    """Return the width and height of the pinhole image to render for a photo of this size; both are even."""
    return tuple(2 * round(side * MARGIN * DENSITY / 2) for side in (width, height))  # type: ignore[return-value]


def hand_shake(rng: Rng) -> tuple[float, float, float]:
    """Return the rotation vector of one readout at 3 to 15 degrees a second, mostly pitch and yaw."""
    axis = rng.normal(size=3) * (1, 1, 0.5)
    turn = axis / np.linalg.norm(axis) * np.radians(3 + 12 * rng.random()) * READOUT
    return tuple(turn.tolist())


def through_lens(image: Array, image_focal: float, lens: Lens) -> Array:
    """Resample a pinhole image, taken when the middle row is exposed, as the lens and the shutter show it.

    Each pixel is the mean of 2 x 2 points.
    """
    total = np.zeros((lens.height, lens.width, image.shape[2]))
    for dy in (0.25, 0.75):
        for dx in (0.25, 0.75):
            u, v = np.meshgrid(np.arange(lens.width) + dx, np.arange(lens.height) + dy)
            x, y = straightened(lens, u, v)
            total += bilinear(image, image_focal * x + image.shape[1] / 2, image_focal * y + image.shape[0] / 2)
    return total / 4


def straightened(lens: Lens, u: Array, v: Array) -> tuple[Array, Array]:
    """Return the direction (x, y, 1) that a photo's points show, in the axes of the camera at the middle row."""
    x, y = (u - lens.width / 2) / lens.focal, (v - lens.height / 2) / lens.focal
    distorted = np.maximum(np.hypot(x, y), 1e-12)
    radius = distorted
    for _ in range(20):  # Newton's method
        slope = 1 + 3 * lens.k1 * radius**2
        radius = radius - (radius * (1 + lens.k1 * radius**2) - distorted) / slope
    rays = np.stack([x * radius / distorted, y * radius / distorted, np.ones_like(x)], -1)
    time = v / lens.height - 0.5
    turned = rotated(rays, time[..., None] * np.array(lens.turn))
    return turned[..., 0] / turned[..., 2], turned[..., 1] / turned[..., 2]


def rotated(vectors: Array, turns: Array) -> Array:
    """Rotate each vector by its rotation vector (Rodrigues' formula)."""
    angle = np.linalg.norm(turns, axis=-1, keepdims=True)
    axis = turns / np.maximum(angle, 1e-12)
    along = np.sum(axis * vectors, -1, keepdims=True) * axis
    return along + (vectors - along) * np.cos(angle) + np.cross(axis, vectors) * np.sin(angle)


def bilinear(image: Array, u: Array, v: Array) -> Array:
    """Return the image's values at positions. Raises ValueError if one is outside the outermost pixel centres."""
    x, y = u - 0.5, v - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    if min(left.min(), top.min()) < 0 or left.max() > image.shape[1] - 2 or top.max() > image.shape[0] - 2:
        raise ValueError("the rendered image is too small for the lens")
    fx, fy = (x - left)[..., None], (y - top)[..., None]
    upper = image[top, left] * (1 - fx) + image[top, left + 1] * fx
    lower = image[top + 1, left] * (1 - fx) + image[top + 1, left + 1] * fx
    return upper * (1 - fy) + lower * fy


def srgb(linear: Array) -> Array:
    """Encode linear values; above 1 they are clipped."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def metered(linear: Array, level: float) -> Array:
    """Return the image exposed so that the geometric mean of its luminance is `level`."""
    return linear * (level / np.exp(np.mean(np.log(linear @ LUMINANCE + 1e-3))))


def noisy(linear: Array, shot: float, read: float, rng: Rng) -> Array:
    """Add noise of variance `shot` x value + `read`^2."""
    return linear + rng.normal(size=linear.shape) * np.sqrt(shot * np.maximum(linear, 0) + read**2)


def develop(linear: Array, rng: Rng) -> Array:
    """Return a phone's photo (sRGB 0..1) by daylight: highlights rolled off, more contrast and colour, sharpened."""
    height, width = linear.shape[:2]
    v, u = np.mgrid[:height, :width] + 0.5
    off_axis = ((u - width / 2) ** 2 + (v - height / 2) ** 2) / (width**2 + height**2) * 4
    balance = np.exp(rng.normal(size=3) * 0.05)
    exposed = linear * balance * (1 - 0.3 * off_axis)[..., None]
    exposed = noisy(metered(exposed, 0.16) * 2 ** rng.normal(0, 0.25), 3e-4, 0.002, rng)
    grey = (exposed @ LUMINANCE)[..., None]
    rolled = 1 - np.exp(-1.4 * np.maximum(grey + 1.15 * (exposed - grey), 0))
    curve = srgb(rolled)
    curve = 0.6 * curve + 0.4 * curve**2 * (3 - 2 * curve)
    return np.clip(curve + 0.5 * (curve - softened(curve)), 0, 1)


def softened(image: Array) -> Array:
    """Return the image blurred by a binomial filter of 3 x 3."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    return (rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]) / 16


def develop_dark(linear: Array, rng: Rng) -> Array:
    """Return a photo (sRGB 0..1) of a dark room: half of the lamp's colour removed, much noise."""
    mean = linear.reshape(-1, 3).mean(0)
    balance = np.sqrt(mean[1] / mean)
    return srgb(noisy(metered(linear * balance, 0.09), 2e-3, 0.004, rng))
