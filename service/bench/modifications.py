"""Ways to spoil a bench's photos: `--modify NAME=VALUE`. Geometry changes carry camera and truth along."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from service.errors import InvalidOptions, UnknownName
from service.geometry import so3_exp
from service.images import encode_image, read_query
from service.types import Intrinsics, Pose


@dataclass(frozen=True, slots=True)
class Shot:
    """A photo with its pinhole camera and its true pose."""

    rgb: Float32[np.ndarray, "h w 3"]
    """sRGB, 0..1."""
    intrinsics: Intrinsics
    pose: Pose


def modified(shot: Shot, specs: Sequence[str], rng: np.random.Generator) -> Shot:
    """Apply 'NAME=VALUE' one after the other. Raises UnknownName, InvalidOptions."""
    for spec in specs:
        name, _, text = spec.partition("=")
        if name not in MODIFICATIONS:
            raise UnknownName(
                f"there is no modification '{name}'; known: {', '.join(sorted(MODIFICATIONS))}.", where="modify"
            )
        try:
            value = float(text)
        except ValueError:
            raise InvalidOptions(f"must be NAME=NUMBER, is '{spec}'.", where="modify") from None
        low, high, change = MODIFICATIONS[name]
        if not low <= value <= high:
            raise InvalidOptions(f"'{name}' takes {low:g} to {high:g}, not {value:g}.", where="modify")
        shot = change(shot, value, rng)
    return shot


def _gain(shot: Shot, factor: float, rng: np.random.Generator) -> Shot:
    """Multiplies the sRGB values, as exposure roughly does."""
    return replace(shot, rgb=np.clip(shot.rgb * np.float32(factor), 0, 1))


def _gamma(shot: Shot, exponent: float, rng: np.random.Generator) -> Shot:
    return replace(shot, rgb=(shot.rgb ** np.float32(exponent)).astype(np.float32))


def _noise(shot: Shot, sigma: float, rng: np.random.Generator) -> Shot:
    """Gaussian, independent in every channel."""
    noise = rng.normal(0.0, sigma, shot.rgb.shape).astype(np.float32)
    return replace(shot, rgb=np.clip(shot.rgb + noise, 0, 1))


def _blur(shot: Shot, sigma: float, rng: np.random.Generator) -> Shot:
    """Gaussian; sigma in pixels of a photo with a long side of 800."""
    sigma = sigma * shot.intrinsics.long_side / 800
    reach = max(1, int(np.ceil(3 * sigma)))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    rgb = shot.rgb
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (reach, reach)
        padded = np.pad(rgb, padding, mode="edge")
        size = rgb.shape[axis]
        rgb = np.zeros_like(rgb)
        for offset, weight in enumerate(kernel):
            rgb += weight * padded.take(range(offset, offset + size), axis)
    return replace(shot, rgb=rgb)


def _jpeg(shot: Shot, quality: float, rng: np.random.Generator) -> Shot:
    query = read_query(encode_image(shot.rgb, quality=round(quality)), intrinsics=shot.intrinsics)
    return replace(shot, rgb=query.rgb.astype(np.float32) / 255, intrinsics=query.intrinsics)


def _occlude(shot: Shot, share: float, rng: np.random.Generator) -> Shot:
    """Noisy squares of up to a quarter of the short side, until this share of the photo is covered."""
    rgb = shot.rgb.copy()
    covered = np.zeros(rgb.shape[:2], bool)
    largest = max(2, min(covered.shape) // 4)
    while covered.mean() < share:
        size = int(rng.integers(max(1, largest // 3), largest))
        y, x = (int(rng.integers(0, side - size + 1)) for side in covered.shape)
        shade = rng.uniform(0, 1, 3) + rng.normal(0, 0.15, (size, size, 1))
        rgb[y : y + size, x : x + size] = np.clip(shade, 0, 1)
        covered[y : y + size, x : x + size] = True
    return replace(shot, rgb=rgb)


def _crop(shot: Shot, share: float, rng: np.random.Generator) -> Shot:
    """Keeps the middle: `share` of width and height."""
    old = shot.intrinsics
    width, height = max(1, round(old.width * share)), max(1, round(old.height * share))
    left, top = (old.width - width) // 2, (old.height - height) // 2
    camera = replace(old, width=width, height=height, cx=old.cx - left, cy=old.cy - top)
    return replace(shot, rgb=shot.rgb[top : top + height, left : left + width].copy(), intrinsics=camera)


def _roll(shot: Shot, degrees: float, rng: np.random.Generator) -> Shot:
    """Turns the camera about its axis; the picture grows so that nothing is cut off, corners are black."""
    old = shot.intrinsics
    camera_from_rolled = so3_exp(np.array([0.0, 0.0, np.radians(degrees)]))
    focal = float(np.sqrt(old.fx * old.fy))
    corners = np.array([[0, 0], [old.width, 0], [0, old.height], [old.width, old.height]], float)
    rays = np.concatenate([(corners - [old.cx, old.cy]) / [old.fx, old.fy], np.ones((4, 1))], 1)
    extent = focal * (rays @ camera_from_rolled)[:, :2]
    low = extent.min(0)  # not rounded: quarter turns then take pixel centres to pixel centres
    width, height = (int(v) for v in np.ceil(extent.max(0) - low - 1e-6))
    camera = Intrinsics(width, height, focal, focal, float(-low[0]), float(-low[1]))
    rows, columns = np.mgrid[:height, :width]
    x, y = (columns + 0.5 - camera.cx) / focal, (rows + 0.5 - camera.cy) / focal
    rays = np.stack([x, y, np.ones_like(x)], -1) @ camera_from_rolled.T
    rgb = _sampled(shot.rgb, rays[..., 0] * old.fx + old.cx, rays[..., 1] * old.fy + old.cy)
    matrix = shot.pose.world_from_camera.copy()
    matrix[:3, :3] = matrix[:3, :3] @ camera_from_rolled
    return Shot(rgb, camera, Pose(matrix))


def _sampled(
    rgb: Float32[np.ndarray, "h w 3"], x: Float64[np.ndarray, "a b"], y: Float64[np.ndarray, "a b"]
) -> Float32[np.ndarray, "a b 3"]:
    """Bilinear; black outside."""
    height, width = rgb.shape[:2]
    inside = (x > 0) & (x < width) & (y > 0) & (y < height)
    x, y = np.clip(x - 0.5, 0, width - 1), np.clip(y - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    u, v = (x - left)[..., None], (y - top)[..., None]
    upper = rgb[top, left] * (1 - u) + rgb[top, left + 1] * u
    lower = rgb[top + 1, left] * (1 - u) + rgb[top + 1, left + 1] * u
    return ((upper * (1 - v) + lower * v) * inside[..., None]).astype(np.float32)


_Change = Callable[[Shot, float, np.random.Generator], Shot]
MODIFICATIONS: dict[str, tuple[float, float, _Change]] = {
    "gain": (0.05, 20.0, _gain),
    "gamma": (0.1, 10.0, _gamma),
    "noise": (0.0, 1.0, _noise),
    "blur": (0.0, 50.0, _blur),
    "jpeg": (1.0, 100.0, _jpeg),
    "occlude": (0.0, 0.9, _occlude),
    "crop": (0.1, 1.0, _crop),
    "roll": (-180.0, 180.0, _roll),
}
"""Name -> least value, greatest value, what it does."""
