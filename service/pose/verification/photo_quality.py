"""What is wrong with a photo as a picture: dark, overexposed, blurred, plain."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8


@dataclass(frozen=True, slots=True)
class PhotoQualityConfig:
    """From when on a photo counts as bad; grey values are sRGB, 0..1."""

    blur_window_px: int = 9
    long_side_px: int = 640
    """At which blur is measured, at most."""
    max_blur: float = 0.65
    """Blur effect (0..1): photos of ten scenes, some at night, have 0.23 to 0.58, blurred by 4 px of 800 0.6 to
    0.82."""
    dark: float = 0.25
    """The grey value that nine in ten pixels of a dark photo are below."""
    white: float = 0.98
    max_white_share: float = 0.35
    """Share of pixels that are white, beyond that of the render, from which on a photo counts as overexposed."""


PHOTO_QUALITY = PhotoQualityConfig()


def photo_faults(
    rgb: UInt8[np.ndarray, "h w 3"],
    rendered: Float32[np.ndarray, "_ _ 3"],
    config: PhotoQualityConfig = PHOTO_QUALITY,
) -> list[str]:
    """Return what to do about a bad photo, as sentences; none for a good one. `rendered` (0..1) is the scene there."""
    grey = _grey(rgb.astype(np.float32) / np.float32(255))
    scale = config.long_side_px / max(grey.shape)
    if scale < 1.0:
        grey = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    found = []
    if np.quantile(grey, 0.9) < config.dark:
        found.append("The photo is dark: take it with more light or a longer exposure.")
    # A scene's background may be white.
    if (grey > config.white).mean() > config.max_white_share + (_grey(rendered) > config.white).mean():
        found.append("Much of the photo is overexposed: take it with a shorter exposure.")
    if blur_effect(grey, config.blur_window_px) > config.max_blur:
        found.append("The photo is blurred: hold the camera still, and focus.")
    return found


def _grey(rgb: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))


def blur_effect(grey: Float32[np.ndarray, "h w"], window_px: int = PHOTO_QUALITY.blur_window_px) -> float:
    """Return how little blurring an image changes the differences of neighbouring pixels: 0 sharp, 1 blurred.

    Crete et al., "The blur effect: perception and estimation with a new no-reference perceptual blur metric" (2007);
    the greater one of both directions. An image without any differences counts as sharp.
    """
    effects = []
    for axis, size in ((0, (1, window_px)), (1, (window_px, 1))):
        blurred = np.asarray(cv2.blur(grey, size))
        own, smoothed = (np.abs(np.diff(image, axis=axis)) for image in (grey, blurred))
        lost = np.maximum(own - smoothed, 0.0).sum()
        total = own.sum()
        effects.append(1.0 - float(lost / total) if total > 0 else 0.0)
    return max(effects)
