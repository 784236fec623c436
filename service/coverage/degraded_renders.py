"""Renders made as photos are: another exposure and white balance, a lens, blur, noise, JPEG's losses.

Light is changed in linear light, taken as the 2.2nd power of the sRGB values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from service.interfaces import Rasterizer
from service.photos.images import encode_image, read_query
from service.photos.intrinsics import undistorted
from service.types import Camera, Query

GAMMA = 2.2


@dataclass(frozen=True, slots=True)
class DegradationConfig:
    """Ranges of phone photos: standard deviations of normal distributions, or bounds of uniform ones."""

    long_side_px: int = 640
    gain_sigma: float = 0.3
    """Of the logarithm."""
    white_balance_sigma: float = 0.06
    vignetting: tuple[float, float] = (0.0, 0.35)
    """Light lost in the corners."""
    blur_px: tuple[float, float] = (0.3, 1.2)
    """Standard deviation at a long side of 800 px."""
    noise: tuple[float, float] = (0.005, 0.03)
    """Standard deviation at full signal."""
    k1_sigma: float = 0.02
    focal_sigma: float = 0.03
    """Of the logarithm of what is sent over the true focal length: EXIF is rounded, and cameras crop."""
    jpeg_quality: tuple[int, int] = (70, 92)
    margin: float = 0.03
    """Rendered beyond each side, for the lens to bend in."""


DEGRADATION = DegradationConfig()


def degraded_render(
    camera: Camera, rasterizer: Rasterizer, rng: np.random.Generator, config: DegradationConfig = DEGRADATION
) -> Query:
    """Render at a camera of the scene, degrade the image, and read it as a photo with approximate intrinsics."""
    rgb, kept = _through_lens(camera, rasterizer, rng, config)
    rgb = _sensed(_lit(rgb, rng, config), rng, config)
    # In a camera's order: lens, light, sensor, compression; the noise must come before JPEG, and after the blur.
    data = encode_image(rgb, quality=int(rng.integers(*config.jpeg_quality)))
    factor = float(np.exp(rng.normal(0, config.focal_sigma)))
    fx, fy = kept.intrinsics.fx * factor, kept.intrinsics.fy * factor
    return read_query(data, intrinsics=replace(kept.intrinsics, fx=fx, fy=fy, trust="approximate"))


def _through_lens(
    camera: Camera, rasterizer: Rasterizer, rng: np.random.Generator, config: DegradationConfig
) -> tuple[Float32[np.ndarray, "h w 3"], Camera]:
    """Return the render as a lens with some radial distortion shows it, with its camera."""
    k = replace(camera.intrinsics, model="PINHOLE", distortion=()).with_long_side(config.long_side_px)
    margin = round(config.margin * k.long_side)
    wide = replace(k, width=k.width + 2 * margin, height=k.height + 2 * margin, cx=k.cx + margin, cy=k.cy + margin)
    frame = rasterizer.render([Camera(wide, camera.pose)])[0]
    image = np.rint(np.clip(frame.rgb, 0, 1) * 255).astype(np.uint8)
    # Undistorting an image without distortion distorts it by the opposite amount, to first order.
    lens = replace(wide, model="OPENCV", distortion=(-float(rng.normal(0, config.k1_sigma)), 0.0, 0.0, 0.0))
    bent = undistorted(image, lens)[0][margin : margin + k.height, margin : margin + k.width]
    return bent.astype(np.float32) / 255, Camera(k, camera.pose)


def _lit(
    rgb: Float32[np.ndarray, "h w 3"], rng: np.random.Generator, config: DegradationConfig
) -> Float32[np.ndarray, "h w 3"]:
    height, width = rgb.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    squared = ((x / width - 0.5) ** 2 + (y / height - 0.5) ** 2) * 2
    # Red and blue change in opposite directions, as they do with a light's colour temperature.
    balance = np.exp(rng.normal(0, config.white_balance_sigma)) ** np.array([1, 0, -1])
    gain = np.exp(rng.normal(0, config.gain_sigma)) * balance
    light = rgb**GAMMA * gain * (1 - rng.uniform(*config.vignetting) * squared[..., None])
    return (np.clip(light, 0, 1) ** (1 / GAMMA)).astype(np.float32)


def _sensed(
    rgb: Float32[np.ndarray, "h w 3"], rng: np.random.Generator, config: DegradationConfig
) -> Float32[np.ndarray, "h w 3"]:
    """Blur by a separable Gaussian, and add noise whose variance grows with the signal."""
    sigma = rng.uniform(*config.blur_px) * max(rgb.shape[:2]) / 800
    reach = int(np.ceil(3 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    for axis in (0, 1):
        pad = [(reach, reach) if a == axis else (0, 0) for a in range(3)]
        padded, size = np.pad(rgb, pad, mode="edge"), rgb.shape[axis]
        shifted = np.stack([padded.take(range(i, i + size), axis) for i in range(len(kernel))])
        rgb = np.tensordot(kernel, shifted, 1).astype(np.float32)
    # Shot noise goes with the root of the signal; the constant is the sensor's noise in the dark.
    noise = rng.uniform(*config.noise) * np.sqrt(rgb + 0.05) * rng.standard_normal(rgb.shape, np.float32)
    return np.clip(rgb + noise, 0, 1).astype(np.float32)
