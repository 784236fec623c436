"""The sizes at which photos and renders are compared."""

from __future__ import annotations

from service.types import Intrinsics

SIZE_MULTIPLE_PX = 32
"""Learned matchers resample images whose sides are no multiples of this."""
RENDER_PX = 416
"""Long side of the renders that are matched and refined with: the renderer's dilation is scaled, so a small render is
not biased."""
PHOTO_PX = 416
"""Long side at which the photo's features are extracted, and to which pixel thresholds of matching refer."""


def scaled_px(at_photo_px: float, intrinsics: Intrinsics) -> float:
    """Return a pixel threshold of matching in an image of this size; it is given at PHOTO_PX."""
    return at_photo_px * intrinsics.long_side / PHOTO_PX


def sized(intrinsics: Intrinsics, long_side: int) -> Intrinsics:
    """Return the camera of the image resampled to about this long side (px), both sides multiples of 32."""
    # At least one multiple: very wide images would have no height otherwise.
    factor = long_side / intrinsics.long_side / SIZE_MULTIPLE_PX
    width, height = (SIZE_MULTIPLE_PX * max(1, round(side * factor)) for side in (intrinsics.width, intrinsics.height))
    return intrinsics.resized(width, height)
