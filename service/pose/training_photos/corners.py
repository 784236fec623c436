"""Corners of a training photo, spread over it, with the surface there from a render."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from service.interfaces import Frame
from service.pose.training_photos.patch_matching import PATCHES
from service.types import Camera


@dataclass(frozen=True, slots=True)
class CornerConfig:
    """Which corners of a training photo are kept."""

    count: int = 400
    """Corners of a photo at most: a patch takes 400 bytes, and two thirds of them can be triangulated."""
    spacing_px: int = 8
    min_eigenvalue: float = 3e-5
    """Of the structure tensor (Shi and Tomasi), over 5 pixels, as OpenCV scales it."""
    window_px: int = 5
    cells_across: int = 8
    """Corners are taken in turns from square cells, so many across the photo: with the strongest ones alone the pose
    of a photo of foliage is half as exact."""
    max_depth_range: float = 0.12
    """Relative, over five pixels of the render: beyond it a corner lies on a depth edge."""
    min_alpha: float = 0.5


CORNERS = CornerConfig()


@dataclass(frozen=True, slots=True)
class SurfaceCorners:
    """Corners of one photo, with the surface's inverse depth there as a linear function of the pixel."""

    px: Float64[np.ndarray, "n 2"]
    """Whole numbers: corners of four pixels, the middles of patches with an even side."""
    depth: Float64[np.ndarray, "n"]
    slope: Float64[np.ndarray, "n 2"]
    """d (1 / depth) / d pixel."""
    patches: UInt8[np.ndarray, "n side side"]

    def some(self, index: Int64[np.ndarray, "m"]) -> SurfaceCorners:
        """Return some of the corners."""
        return SurfaceCorners(self.px[index], self.depth[index], self.slope[index], self.patches[index])


def surface_corners(
    photo: UInt8[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"] | None,
    frame: Frame,
    camera: Camera,
    config: CornerConfig = CORNERS,
) -> SurfaceCorners:
    """Find corners of the photo on smooth, opaque surface; `camera` rendered the frame at the photo's pose."""
    px = _corners(photo, valid, config)
    height, width = photo.shape
    scale = np.array([camera.intrinsics.width / width, camera.intrinsics.height / height])
    column, row = np.clip((px * scale).astype(int), 2, [camera.intrinsics.width - 3, camera.intrinsics.height - 3]).T
    offsets = np.array([(dx, dy) for dy in (-2, 0, 2) for dx in (-2, 0, 2)])
    around = np.stack([frame.median_depth[row + dy, column + dx] for dx, dy in offsets], 1).astype(np.float64)
    nearest, farthest = around.min(1, initial=np.inf), around.max(1, initial=0.0)
    smooth = (nearest > 0) & (farthest < (1 + config.max_depth_range) * nearest)
    found = np.flatnonzero(smooth & (frame.alpha[row, column] > config.min_alpha))
    found = found[_spread(px[found], width, config)]
    px, around = px[found], around[found]
    # A plane's inverse depth is linear in the image; a least-squares fit to the nine depths.
    moved = offsets / scale
    slope = (1.0 / around) @ moved / (moved**2).sum(0)
    half = PATCHES.side_px // 2
    patches = [photo[y - half : y + half, x - half : x + half] for x, y in px.astype(int)]
    stacked = np.stack(patches) if patches else np.zeros((0, PATCHES.side_px, PATCHES.side_px), np.uint8)
    return SurfaceCorners(px, np.median(around, 1), slope, stacked)


def _corners(
    photo: UInt8[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"] | None, config: CornerConfig
) -> Float64[np.ndarray, "n 2"]:
    """Return corners, strongest first, whose patches lie inside the photo's valid part."""
    strength = cv2.cornerMinEigenVal(photo, config.window_px, ksize=3)
    is_peak = strength >= cv2.dilate(strength, np.ones((config.spacing_px, config.spacing_px), np.uint8))
    is_peak &= strength > config.min_eigenvalue
    margin = PATCHES.side_px // 2 + 1
    if valid is not None:
        around = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
        is_peak &= cv2.erode(valid.astype(np.uint8), around, borderType=cv2.BORDER_REPLICATE) > 0
    is_peak[:margin] = is_peak[-margin:] = False
    is_peak[:, :margin] = is_peak[:, -margin:] = False
    row, column = np.nonzero(is_peak)
    order = np.argsort(-strength[row, column], kind="stable")
    return np.stack([column[order], row[order]], 1).astype(np.float64)


def _spread(px: Float64[np.ndarray, "n 2"], width: int, config: CornerConfig) -> Int64[np.ndarray, "m"]:
    """Return which corners to keep: the strongest of each cell, then the second of each, until there are enough."""
    return take_in_turns(cells_of(px, width, config.cells_across), config.count)


def cells_of(px: Float64[np.ndarray, "n 2"], width: int, across: int) -> Int64[np.ndarray, "n"]:
    """Return the number of the square cell that each pixel lies in, of so many across an image of this width."""
    column, row = np.floor(px * (across / width)).astype(np.int64).T
    return column + across * row


def take_in_turns(groups: Int64[np.ndarray, "n"], count: int) -> Int64[np.ndarray, "m"]:
    """Return the places of at most `count` elements: the first of each group, then the second of each, and so on."""
    order = np.argsort(groups, kind="stable")
    rank = np.empty(len(groups), np.int64)
    # How many of the same group come before.
    rank[order] = np.arange(len(groups)) - np.searchsorted(groups[order], groups[order])
    return np.sort(np.argsort(rank, kind="stable")[:count])
