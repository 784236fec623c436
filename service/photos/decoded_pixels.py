"""A photo's pixels after decoding, and where rays of the photo's camera meet them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, UInt8

from service.photos.intrinsics import UPRIGHT
from service.types import Intrinsics


@dataclass(frozen=True, slots=True)
class DecodedPixels:
    """Upright pixels, perhaps reduced, of a photo in its full size."""

    rgb: UInt8[np.ndarray, "h w 3"]
    """Upright, reduced."""
    valid_mask: Bool[np.ndarray, "h w"] | None
    """False where the photo is transparent; None: nowhere."""
    width: int
    """Of the upright photo in its full size."""
    height: int
    scale: tuple[float, float]
    """Pixels of `rgb` per pixel of the photo."""
    offset: tuple[float, float]
    """Pixels of `rgb` at which the photo's corner lies: not exactly 0 after JPEG's reduction and a mirroring."""
    warnings: tuple[str, ...]
    upright_from_stored: tuple[bool, bool, bool] = UPRIGHT

    def camera(self, photo: Intrinsics) -> Intrinsics:
        """Return the camera of `rgb` for that of the photo."""
        (sx, sy), (ox, oy) = self.scale, self.offset
        return replace(
            photo,
            width=self.rgb.shape[1],
            height=self.rgb.shape[0],
            fx=photo.fx * sx,
            fy=photo.fy * sy,
            cx=photo.cx * sx + ox,
            cy=photo.cy * sy + oy,
        )
