"""Which training photos see the same, and which of their features are the same point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from service.geometry import hat
from service.types import Camera, Intrinsics

_BLOCK = 64
"""Rows of the similarity matrix at a time: they stay in the processor's cache."""


@dataclass(frozen=True, slots=True)
class MatchingConfig:
    """As hloc and COLMAP match; values of their own defaults where they have one."""

    ratio: float = 0.8
    """Of the distances to the nearest and second nearest descriptor (Lowe 2004); COLMAP's default."""
    max_distance: float = 0.7
    """Of unit descriptors; COLMAP's default."""
    pairs_of_photo: int = 12
    """Training photos that each one is matched with: those with the nearest poses."""
    max_pair_angle_deg: float = 60.0
    """Between optical axes; SIFT pairs little beyond."""
    pair_angle_deg: float = 30.0
    """An angle that counts as much as the median distance between two photos."""
    epipolar_px: float = 4.0
    """Largest distance of a match from its epipolar line, as hloc checks matches of photos with known poses."""


MATCHING = MatchingConfig()


@dataclass(frozen=True, slots=True)
class PhotoFeatures:
    """Local features of one photo."""

    px: Float64[np.ndarray, "n 2"]
    """Centre of the top-left pixel = (0.5, 0.5)."""
    descriptors: Float32[np.ndarray, "n d"]
    """Of unit length."""

    def kept(self, keep: Bool[np.ndarray, "n"]) -> PhotoFeatures:
        """Return the chosen features only."""
        return PhotoFeatures(self.px[keep], self.descriptors[keep])


def matched(a: PhotoFeatures, b: PhotoFeatures, config: MatchingConfig = MATCHING) -> Int64[np.ndarray, "m 2"]:
    """Return pairs of indices: mutual nearest neighbours that pass the ratio test from `a` to `b`."""
    if len(a.px) < 2 or len(b.px) < 2:
        return np.zeros((0, 2), np.int64)
    nearest = np.zeros(len(a.px), np.int64)
    best, second = np.zeros((2, len(a.px)), np.float32)
    best_of_b = np.full(len(b.px), -2.0, np.float32)
    columns = np.ascontiguousarray(b.descriptors.T)
    for begin in range(0, len(a.px), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        similarity = a.descriptors[block] @ columns
        rows = np.arange(len(similarity))
        np.maximum(best_of_b, similarity.max(axis=0), out=best_of_b)
        nearest[block] = similarity.argmax(axis=1)
        best[block] = similarity[rows, nearest[block]]
        similarity[rows, nearest[block]] = -2.0
        second[block] = similarity.max(axis=1)
    squared, squared_second = 2.0 - 2.0 * best, 2.0 - 2.0 * second
    good = (best >= best_of_b[nearest]) & (squared < config.max_distance**2)
    good &= squared < config.ratio**2 * squared_second
    return np.stack([np.flatnonzero(good), nearest[good]], axis=1)


def pairs_of_cameras(cameras: Sequence[Camera], config: MatchingConfig = MATCHING) -> list[tuple[int, int]]:
    """Return the pairs of photos to match, by their poses alone: each with those that are nearest and look alike."""
    positions = np.stack([camera.pose.position_in_world for camera in cameras])
    axes = np.stack([camera.pose.world_from_camera[:3, 2] for camera in cameras])
    angles = np.degrees(np.arccos(np.clip(axes @ axes.T, -1.0, 1.0)))
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    # Photos of one place have no distance to compare with.
    typical = np.median(distances) or 1.0
    cost = angles / config.pair_angle_deg + distances / typical
    cost[angles > config.max_pair_angle_deg] = np.inf
    np.fill_diagonal(cost, np.inf)
    pairs = set()
    for first, row in enumerate(cost):
        for second in np.argsort(row)[: config.pairs_of_photo]:
            if np.isfinite(row[second]):
                pairs.add((min(first, int(second)), max(first, int(second))))
    return sorted(pairs)


def near_epipolar_lines(
    a: Camera, b: Camera, a_px: Float64[np.ndarray, "m 2"], b_px: Float64[np.ndarray, "m 2"], limit_px: float
) -> Bool[np.ndarray, "m"]:
    """Return which matches two posed cameras allow: each point within `limit_px` of the other's epipolar line."""
    b_from_a = b.pose.camera_from_world @ a.pose.world_from_camera
    essential = hat(b_from_a[:3, 3]) @ b_from_a[:3, :3]
    fundamental = _camera_from_px(b.intrinsics).T @ essential @ _camera_from_px(a.intrinsics)
    a_points, b_points = np.column_stack([a_px, np.ones(len(a_px))]), np.column_stack([b_px, np.ones(len(b_px))])
    lines_in_b, lines_in_a = a_points @ fundamental.T, b_points @ fundamental
    product = np.abs(np.sum(b_points * lines_in_b, axis=1))
    # Two cameras in one place have no epipolar lines, and what they pair can't be triangulated.
    with np.errstate(divide="ignore", invalid="ignore"):
        in_b = product / np.linalg.norm(lines_in_b[:, :2], axis=1)
        in_a = product / np.linalg.norm(lines_in_a[:, :2], axis=1)
    return np.maximum(in_a, in_b) < limit_px


def _camera_from_px(k: Intrinsics) -> Float64[np.ndarray, "3 3"]:
    return np.linalg.inv([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]])
