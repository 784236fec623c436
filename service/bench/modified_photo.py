"""A photo that benches modify, with its camera; and sampling it at other places."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from service.photos.images import resized
from service.types import Intrinsics, Pose

VALID_SHARE = 0.999
"""Share of valid pixels in a resampled one from which on it is valid, too."""


@dataclass(frozen=True, slots=True)
class Photo:
    """A photo with its camera and its true pose."""

    rgb: Float32[np.ndarray, "h w 3"]
    """sRGB, 0..1."""
    intrinsics: Intrinsics
    """The true ones, with the distortion."""
    pose: Pose
    mask: Bool[np.ndarray, "h w"] | None = None
    """Pixels that belong to the photo; the others are transparent in the file. None: all belong to it."""
    sent_focal_factor: float = 1.0
    """The focal length sent with the photo, divided by the true one."""
    occluders: tuple[Float32[np.ndarray, "_ _ 3"], ...] = ()
    """Photos of another scene, from which `occlusion` cuts rectangles."""
    focal_as_taken: float | None = None
    """Focal length in long sides of the image as it was taken, before it was cut; None: it is whole."""

    @property
    def focal_of_whole(self) -> float:
        """The focal length in long sides of the image as it was taken: what EXIF says, before and after a crop."""
        if self.focal_as_taken is not None:
            return self.focal_as_taken
        return self.intrinsics.fx / self.intrinsics.long_side

    def pixels(self) -> Float32[np.ndarray, "h w c"]:
        """Return the pixels of a file: RGB, or RGBA with the mask as alpha; 0..1."""
        if self.mask is None:
            return self.rgb
        return np.concatenate([self.rgb, self.mask[..., None].astype(np.float32)], 2)

    def cut(self, left: int, top: int, width: int, height: int) -> Photo:
        """Return this part of the photo. The camera remains the same but for the principal point."""
        old, area = self.intrinsics, np.s_[top : top + height, left : left + width]
        camera = replace(old, width=width, height=height, cx=old.cx - left, cy=old.cy - top)
        mask = None if self.mask is None else self.mask[area].copy()
        focal = self.focal_of_whole
        return replace(self, rgb=self.rgb[area].copy(), mask=mask, intrinsics=camera, focal_as_taken=focal)

    def resized(self, width: int, height: int) -> Photo:
        """Return the photo resampled to another size; a pixel of valid and invalid ones becomes invalid."""
        rgb, mask, camera = resized(self.rgb, width, height), self.mask, self.intrinsics.resized(width, height)
        if mask is not None:
            mask = resized(_as_image(mask), width, height)[..., 0] > VALID_SHARE
        return replace(self, rgb=rgb, mask=mask, intrinsics=camera)


Change = Callable[[Photo, float, np.random.Generator], Photo]
"""A modification: photo, value, and where its randomness comes from."""
Sampling = Callable[
    [Float64[np.ndarray, "..."], Float64[np.ndarray, "..."]],
    tuple[Float64[np.ndarray, "..."], Float64[np.ndarray, "..."]],
]
"""Where in the old image a pixel (x, y) of the new one comes from."""


def sampled(
    rgb: Float32[np.ndarray, "h w 3"], x: Float64[np.ndarray, "a b"], y: Float64[np.ndarray, "a b"]
) -> Float32[np.ndarray, "a b 3"]:
    """Sample at pixels (x, y) by an 8 x 8 Lanczos kernel, clipped to 0..1; outside the nearest pixel of the edge."""
    # OpenCV has the centre of the first pixel at (0, 0). Its bicubic kernel shifts a ramp by 0.05 px, this one by 0.03.
    at = (x - 0.5).astype(np.float32), (y - 0.5).astype(np.float32)
    found = cv2.remap(rgb, *at, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(np.asarray(found, np.float32), 0, 1)


def resampled_within(photo: Photo, source_of: Sampling, camera: Intrinsics) -> Photo:
    """Return the photo as another camera with the same centre sees it, cut so that all its pixels are of the photo.

    `source_of` maps pixels of `camera`, which has the photo's size, to the photo's. What is kept is the largest centred
    rectangle of the same aspect whose edge lies inside of the photo: padding would tell an estimator of the distortion.
    """
    width, height = photo.intrinsics.width, photo.intrinsics.height
    margins = range(width // 2)
    margin = bisect_left(margins, True, key=lambda m: _edge_is_inside(m, width, height, source_of))
    top = round(margin * height / width)
    rows, columns = np.mgrid[top : height - top, margin : width - margin]
    x, y = source_of(columns + 0.5, rows + 0.5)
    mask = photo.mask
    if mask is not None:
        mask = sampled(_as_image(mask), x, y)[..., 0] > VALID_SHARE
    camera = replace(
        camera, width=width - 2 * margin, height=height - 2 * top, cx=camera.cx - margin, cy=camera.cy - top
    )
    return replace(photo, rgb=sampled(photo.rgb, x, y), mask=mask, intrinsics=camera)


def _as_image(mask: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 3"]:
    return np.repeat(mask[..., None], 3, 2).astype(np.float32)


def _edge_is_inside(margin: int, width: int, height: int, source_of: Sampling) -> bool:
    """Whether all pixels at the edge of the rectangle that a margin leaves come from inside of the image."""
    top = round(margin * height / width)
    columns, rows = np.arange(margin, width - margin) + 0.5, np.arange(top, height - top) + 0.5
    x = np.concatenate([columns, columns, np.full(len(rows), columns[0]), np.full(len(rows), columns[-1])])
    y = np.concatenate([np.full(len(columns), rows[0]), np.full(len(columns), rows[-1]), rows, rows])
    x, y = source_of(x, y)
    # The centres of the outermost pixels are the last places between two pixels.
    return bool(x.min() >= 0.5 and y.min() >= 0.5 and x.max() <= width - 0.5 and y.max() <= height - 0.5)
