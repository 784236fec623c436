"""What alignment compares: photo and render as pyramids of brightness, each pixel of the render with its depth."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from service.interfaces import Frame

SATURATED, SATURATED_SHARE = 252, 0.005
"""Of 0..255; of all values of a photo, from which on the render is cut off as the photo is."""
EXPOSURE_PX = 16
"""Side of the squares whose means tell the exposure."""
SIGMA_PX = 0.7
"""Blur of photo and render at each level: renders are softer than photos."""
MIN_ALPHA = 0.5
EDGE_PX = 2
EDGE_JUMP = 0.06
"""Relative; a surface seen at 80 degrees from its normal changes by 0.02 over two pixels."""
FAR = np.float32(1e30)


def cut_off(photo: UInt8[np.ndarray, "h w 3"], frame: Frame) -> Float32[np.ndarray, "h w 3"]:
    """Return the render, and if the photo is saturated, as bright as the photo and cut off at 1.

    The photo's luma doesn't follow from the render's where single channels are cut off.
    """
    if np.count_nonzero(photo >= SATURATED) < SATURATED_SHARE * photo.size:
        return frame.rgb
    size = (photo.shape[1] // EXPOSURE_PX, photo.shape[0] // EXPOSURE_PX)
    shown, expected = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (photo, frame.rgb))
    shown = shown / np.float32(255)
    factors = []
    for a, b in zip(np.moveaxis(shown, 2, 0), np.moveaxis(expected, 2, 0), strict=True):
        fair = (a > 0.05) & (a < 0.9) & (b > 0.05)  # a black rim is none of the exposure's
        factors.append(max(1.0, float(np.median(a[fair] / b[fair]))) if fair.any() else 1.0)
    brighter = np.asarray(cv2.transform(frame.rgb, np.diag(factors)))
    return np.minimum(brighter, np.float32(1), out=brighter)


def luma(rgb: Float32[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Return the mean of the channels, 0..1."""
    scale = np.float32(1 / 765 if rgb.dtype == np.uint8 else 1 / 3)
    return (rgb[..., 0].astype(np.float32) + rgb[..., 1] + rgb[..., 2]) * scale


def pyramid(image: Float32[np.ndarray, "h w"], levels: int) -> list[Float32[np.ndarray, "_ _"]]:
    """Return the blurred levels, finest first; each has half the size of the one before."""
    raw = [image]
    for _ in range(levels - 1):
        height, width = raw[-1].shape
        raw.append(np.asarray(cv2.resize(raw[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)))
    return [np.asarray(cv2.GaussianBlur(level, (0, 0), SIGMA_PX)) for level in raw]


def edge_owner_depth(frame: Frame) -> Float32[np.ndarray, "h w"]:
    """Return the depth with which each pixel's gradient moves; 0 where nothing is seen.

    An occluding edge moves with what occludes, on both of its sides: within EDGE_PX of a depth edge, or of the
    object's outline, the nearer depth holds. Without this a blurred photo of an object pulls the camera away
    (s1 of 26 blurred photos: 0 without, 16 with; medians of sharp ones gain a fifth).
    """
    depth = np.where(frame.alpha > MIN_ALPHA, frame.median_depth, np.float32(0))
    around = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    nearest = cv2.erode(np.where(depth > 0, depth, FAR), around)
    edge = (nearest < FAR) & ((depth == 0) | (depth > (1 + EDGE_JUMP) * nearest))
    return np.where(edge, nearest, depth).astype(np.float32)


def depth_pyramid(depth: Float32[np.ndarray, "h w"], levels: int) -> list[Float32[np.ndarray, "_ _"]]:
    """Average 2x2 depths on smooth surface; 0 where a depth edge runs through them or there is none."""
    result = [depth]
    for _ in range(levels - 1):
        fine = result[-1]
        height, width = fine.shape[0] // 2 * 2, fine.shape[1] // 2 * 2
        quads = np.stack([fine[y:height:2, x:width:2] for y in (0, 1) for x in (0, 1)])
        nearest, farthest = quads.min(0), quads.max(0)
        smooth = (nearest > 0) & (farthest < 1.1 * nearest)
        result.append(np.where(smooth, quads.mean(0), np.float32(0)).astype(np.float32))
    return result
