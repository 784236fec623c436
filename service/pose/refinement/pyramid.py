"""Pyramids of photo, render and depth for photometric refinement: what is compared, and how its pixels move."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from service.interfaces import Frame
from service.pose.refinement.refinement_config import LocalLightConfig, PyramidConfig

FAR = np.float32(1e30)
"""Depth in the place of none, where the nearest is wanted."""


def clip_like_photo(
    photo: UInt8[np.ndarray, "h w 3"], frame: Frame, config: PyramidConfig
) -> Float32[np.ndarray, "h w 3"]:
    """Return the render's colours, and where the photo is saturated, with the photo's exposure and clipped at 1.

    The exposure is, by channel, the median ratio of blocks that are neither dark nor clipped, at least 1. Without this
    the photo's intensity isn't a function of the render's, where single channels are clipped.
    """
    if np.count_nonzero(photo >= config.saturated) < config.saturated_share * photo.size:
        return frame.rgb
    # Means of blocks, so that a small misalignment hardly changes the ratio.
    size = (photo.shape[1] // config.exposure_block_px, photo.shape[0] // config.exposure_block_px)
    observed, expected = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (photo, frame.rgb))
    observed = observed / np.float32(255)
    gains = []
    for a, b in zip(np.moveaxis(observed, 2, 0), np.moveaxis(expected, 2, 0), strict=True):
        exposed = (a > config.min_exposed) & (a < config.max_exposed) & (b > config.min_exposed)
        gains.append(max(1.0, float(np.median(a[exposed] / b[exposed]))) if exposed.any() else 1.0)
    brighter = np.asarray(cv2.transform(frame.rgb, np.diag(gains)))
    return np.minimum(brighter, np.float32(1), out=brighter)


def intensity(rgb: Float32[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Return the mean of the channels, 0..1."""
    # 3 * 255 for bytes.
    scale = np.float32(1 / 765 if rgb.dtype == np.uint8 else 1 / 3)
    return (rgb[..., 0].astype(np.float32) + rgb[..., 1] + rgb[..., 2]) * scale


def evened_light(
    image: Float32[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"] | None, config: LocalLightConfig
) -> Float32[np.ndarray, "h w"]:
    """Return the image with about the same mean (0.5) and contrast everywhere, in Gaussian windows of its valid pixels.

    Invariant to a gain and a bias that change slowly; what it doesn't take out are edges of shadows.
    """
    sigma = config.window_share * max(image.shape)
    known = np.ones_like(image) if valid is None else valid.astype(np.float32)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.GaussianBlur(values * known, (0, 0), sigma)) / weight

    weight = np.maximum(cv2.GaussianBlur(known, (0, 0), sigma), np.float32(1e-3))
    offset = image - mean(image)
    spread = np.sqrt(mean(offset * offset))
    return (0.5 + config.contrast * offset / (spread + config.min_contrast)).astype(np.float32)


def pyramid(image: Float32[np.ndarray, "h w"], levels: int, sigma_px: float) -> list[Float32[np.ndarray, "_ _"]]:
    """Return blurred levels, finest first; each has half the size of the one before, by area averaging."""
    raw = [image]
    for _ in range(levels - 1):
        height, width = raw[-1].shape
        raw.append(np.asarray(cv2.resize(raw[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)))
    return [np.asarray(cv2.GaussianBlur(level, (0, 0), sigma_px)) for level in raw]


def occluder_depth(frame: Frame, config: PyramidConfig) -> Float32[np.ndarray, "h w"]:
    """Return the z-depth (scene units) with which each pixel's gradient moves; 0 where the render shows no surface.

    An occluding edge moves with the occluder, on both of its sides: within `edge_px` of a depth edge, or of the
    object's outline, the nearer depth holds. Without this a blurred photo of an object pulls the camera away (of 26
    blurred photos 0 are within 1 degree and 0.01 units without, 16 with; medians of sharp ones gain a fifth).
    """
    depth = np.where(frame.alpha > config.min_alpha, frame.median_depth, np.float32(0))
    around = np.ones((2 * config.edge_px + 1, 2 * config.edge_px + 1), np.uint8)
    # Erosion takes the minimum over the window: the nearest depth around.
    nearest = cv2.erode(np.where(depth > 0, depth, FAR), around)
    edge = (nearest < FAR) & ((depth == 0) | (depth > (1 + config.edge_jump) * nearest))
    return np.where(edge, nearest, depth).astype(np.float32)


def depth_pyramid(depth: Float32[np.ndarray, "h w"], levels: int, max_ratio: float) -> list[Float32[np.ndarray, "_ _"]]:
    """Return levels, finest first, of 2x2 averages; 0 where one of the four has no depth, or they differ by more."""
    result = [depth]
    for _ in range(levels - 1):
        fine = result[-1]
        # An odd last row or column is dropped.
        height, width = fine.shape[0] // 2 * 2, fine.shape[1] // 2 * 2
        quads = np.stack([fine[y:height:2, x:width:2] for y in (0, 1) for x in (0, 1)])
        nearest, farthest = quads.min(0), quads.max(0)
        smooth = (nearest > 0) & (farthest < max_ratio * nearest)
        result.append(np.where(smooth, quads.mean(0), np.float32(0)).astype(np.float32))
    return result
