"""Whether cameras belong to a scene, without a renderer: its opaque Gaussians as points, seen coarsely by each camera.

Cameras that a scene was trained with see much of it (`seen`), it covers some of their image (`coverage`), and what they
see in front has a size of some pixels, since training splits larger Gaussians. Where the photos are at hand, colours
decide: their correlation with those of the foremost points, which is greatest at the right place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from service.scene_formats.gaussians import RawGaussians
from service.types import SH_C0, Camera


@dataclass(frozen=True, slots=True)
class EvidenceConfig:
    """How coarsely a scene is looked at, and what counts as fitting."""

    points: int = 20_000
    cameras: int = 10
    cells: int = 32
    """On an image's long side."""
    min_opacity: float = 0.5
    front: float = 1.08
    """A point is in front if its depth is at most this times the least in its cell."""
    full_coverage: float = 0.15
    """Of an image by an object that its photos show whole."""
    least_covering: float = 0.2
    """Quantile over the cameras: of wrong ones some see nothing."""
    sizes_px: tuple[float, float] = (0.5, 15.0)
    """Of the Gaussians in front; a factor of 3 beyond counts nothing."""
    filled: float = 0.9
    part: float = 0.5
    """Of the images and of the points: cameras that see more of the one and less of the other are within the scene."""


EVIDENCE = EvidenceConfig()


@dataclass(frozen=True, slots=True)
class Points:
    """A scene's opaque Gaussians, about its middle."""

    positions: Float32[np.ndarray, "n 3"]
    sizes: Float32[np.ndarray, "n"]
    """Geometric mean of the two larger standard deviations."""
    rgb: Float32[np.ndarray, "n 3"]
    middle: Float64[np.ndarray, "3"]
    background_rgb: tuple[float, float, float] | None
    """None: not known."""


Photo = UInt8[np.ndarray, "h w 3"]
"""A training photo, small; what is transparent shows the background."""
_BACKGROUNDS = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
"""What scenes are trained on, where no file says it."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """How well cameras fit a scene."""

    geometry: float
    """0..1: share of the points that some camera sees, less where little is covered or sizes are unlikely."""
    correlation: float | None
    """Mean over the photos, -1..1; None without photos. A median would be too rough to rank what hardly differs."""
    surrounded: bool = False
    """The scene fills the images, and each camera sees a part of it only."""

    @property
    def score(self) -> float:
        """Comparable between placements of the same cameras."""
        return self.geometry if self.correlation is None else self.correlation


def points_of(
    raw: RawGaussians, background_rgb: tuple[float, float, float] | None = None, config: EvidenceConfig = EVIDENCE
) -> Points:
    """Return an evenly spread choice of the opaque Gaussians."""
    opaque = np.flatnonzero(raw.opacities > config.min_opacity)
    chosen = opaque if len(opaque) else np.arange(len(raw.means))
    chosen = chosen[:: max(1, len(chosen) // config.points)]
    means = raw.means[chosen].astype(np.float64)
    middle = np.median(means, axis=0)
    sizes = np.sqrt(np.sort(raw.scales[chosen], axis=1)[:, 1:].prod(1))
    rgb = np.clip(0.5 + SH_C0 * raw.sh[chosen, 0], 0, 1)
    return Points(
        (means - middle).astype(np.float32), sizes.astype(np.float32), rgb.astype(np.float32), middle, background_rgb
    )


def evidence(
    points: Points, cameras: Sequence[Camera], photos: Sequence[Photo | None], config: EvidenceConfig = EVIDENCE
) -> Evidence:
    """Look at the scene with each camera; `photos` are of these cameras, None where there is none."""
    seen = np.zeros(len(points.positions), bool)
    coverage, shares, sizes_px, correlations = [], [], [], []
    for camera, photo in zip(cameras, photos, strict=True):
        look = _look(points, camera, config)
        seen[look.front] = True
        coverage.append(look.coverage)
        shares.append(look.share)
        if len(look.front):
            sizes_px.append(look.size_px)
        if photo is not None:
            correlations.append(_correlation(look, points, photo))
    if not sizes_px:
        return Evidence(0.0, 0.0 if correlations else None)
    covered = min(1.0, float(np.quantile(coverage, config.least_covering)) / config.full_coverage)
    geometry = float(seen.mean()) * covered * _likelihood(float(np.median(sizes_px)), config)
    surrounded = float(np.median(coverage)) >= config.filled and float(np.median(shares)) <= config.part
    return Evidence(geometry, float(np.mean(correlations)) if correlations else None, surrounded)


def _likelihood(size_px: float, config: EvidenceConfig) -> float:
    """Return 1 within the usual sizes, down to 0 at a third of the least and three times the largest."""
    low, high = config.sizes_px
    beyond = max(np.log(low / size_px), np.log(size_px / high), 0.0) if size_px > 0 else np.inf
    return float(max(0.0, 1.0 - beyond / np.log(3.0)))


@dataclass(frozen=True, slots=True)
class _Look:
    """What one camera sees."""

    front: np.ndarray
    """Indices of the foremost points."""
    cell: np.ndarray
    """Of each of them, row by row."""
    shape: tuple[int, int]
    """Rows and columns of cells."""
    coverage: float
    share: float
    """Of all points, that are in the image."""
    size_px: float


def _look(points: Points, camera: Camera, config: EvidenceConfig) -> _Look:
    k, pose = camera.intrinsics, camera.pose.world_from_camera
    across = max(1, round(config.cells * k.width / k.long_side))
    down = max(1, round(config.cells * k.height / k.long_side))
    position = (pose[:3, 3] - points.middle).astype(np.float32)
    x, y, z = ((points.positions - position) @ pose[:3, :3].astype(np.float32)).T
    ahead = np.flatnonzero(z > 1e-3 * np.abs(z).max())
    x, y, z = x[ahead], y[ahead], z[ahead]
    u, v = (k.fx * x / z + k.cx) / k.width, (k.fy * y / z + k.cy) / k.height
    inside = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    cell = np.minimum((v[inside] * down).astype(int), down - 1) * across
    cell += np.minimum((u[inside] * across).astype(int), across - 1)
    z, chosen = z[inside], ahead[inside]
    nearest = np.full(down * across, np.inf, np.float32)
    np.minimum.at(nearest, cell, z)
    front = z <= config.front * nearest[cell]
    size_px = float(np.median(points.sizes[chosen[front]] / z[front]) * k.fx) if front.any() else 0.0
    covered = float(np.isfinite(nearest).mean())
    share = len(chosen) / len(points.positions)
    return _Look(chosen[front], cell[front], (down, across), covered, share, size_px)


def _correlation(look: _Look, points: Points, photo: Photo) -> float:
    """Return how the colours of photo and points in front correlate: where there are points, and over the whole image.

    The first one is blind to outlines, the second one to holes between points; their mean is returned.
    """
    count = np.bincount(look.cell, minlength=look.shape[0] * look.shape[1])
    hit = count > 0
    if not hit.any():
        return 0.0
    drawn = np.stack([np.bincount(look.cell, points.rgb[look.front, c], len(count)) for c in range(3)], 1)
    drawn /= np.maximum(count, 1)[:, None]
    backgrounds = _BACKGROUNDS if points.background_rgb is None else [points.background_rgb]
    shown = _cells(photo, look.shape)
    whole = max(_correlated(np.where(hit[:, None], drawn, rgb), shown) for rgb in backgrounds)
    return (_correlated(drawn[hit], shown[hit]) + whole) / 2


def _correlated(a: Float64[np.ndarray, "c 3"], b: Float64[np.ndarray, "c 3"]) -> float:
    a, b = a - a.mean(0), b - b.mean(0)
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-9))


def _cells(photo: Photo, shape: tuple[int, int]) -> Float64[np.ndarray, "c 3"]:
    """Return the photo's mean colour in each cell; of a photo with fewer pixels than cells, 0 in some."""
    height, width = photo.shape[:2]
    rows = ((np.arange(height) + 0.5) / height * shape[0]).astype(int)
    columns = ((np.arange(width) + 0.5) / width * shape[1]).astype(int)
    cell, total = (rows[:, None] * shape[1] + columns).ravel(), shape[0] * shape[1]
    sums = [np.bincount(cell, photo[..., c].ravel(), total) for c in range(3)]
    return np.stack(sums, 1) / np.maximum(np.bincount(cell, minlength=total), 1)[:, None] / 255
