"""The background of a scene whose files don't say it: black, or white where a photo shows white around the scene.

Objects are trained over a plain background, mostly black or white, which few files name. A photo of such an object has
the background along its border; a scene that fills its views has none, and then neither matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8

from service.interfaces import Rasterizer
from service.types import Camera

WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class UnknownBackgroundConfig:
    """When white is assumed."""

    border_share: float = 0.02
    """Width of a photo's border, of its long side."""
    white_from: int = 250
    """Grey level (0..255) of each channel from which on a pixel is white: JPEG changes it a little."""
    min_white_share: float = 0.5
    """Of the border: an object may reach it on some sides."""
    render_px: int = 64
    views: int = 8
    """Renders, and their long side, that show whether the scene leaves any background uncovered."""
    max_alpha: float = 0.5
    min_uncovered_share: float = 0.05
    """A view shows the background if this share of it is less opaque than `max_alpha`."""


UNKNOWN_BACKGROUND = UnknownBackgroundConfig()


def has_white_border(
    rgb: UInt8[np.ndarray, "h w 3"],
    valid: Bool[np.ndarray, "h w"] | None = None,
    config: UnknownBackgroundConfig = UNKNOWN_BACKGROUND,
) -> bool:
    """Return whether at least half of the photo's border is white; invalid pixels don't count (None: all are valid)."""
    width = max(1, round(config.border_share * max(rgb.shape[:2])))
    border = np.ones(rgb.shape[:2], bool)
    border[width:-width, width:-width] = False
    if valid is not None:
        border &= valid
    white = border & np.all(rgb >= config.white_from, axis=2)
    return bool(border.any() and white.sum() >= config.min_white_share * border.sum())


def shows_background(
    rasterizer: Rasterizer, cameras: Sequence[Camera], config: UnknownBackgroundConfig = UNKNOWN_BACKGROUND
) -> bool:
    """Return whether the median of some evenly spread views leaves part of the image uncovered."""
    chosen = cameras[:: max(1, len(cameras) // config.views)]
    small = [Camera(camera.intrinsics.with_long_side(config.render_px), camera.pose) for camera in chosen]
    shares = [(frame.alpha < config.max_alpha).mean() for frame in rasterizer.render(small, approximate=True)]
    return bool(shares and np.median(shares) >= config.min_uncovered_share)
