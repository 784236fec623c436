"""A level-of-detail proxy of a large scene: fewer Gaussians for small renders, and the depths beyond which these show
that everything is occluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float32

from service.interfaces import Frame, Rasterizer
from service.types import Camera, GaussianScene


@dataclass(frozen=True, slots=True)
class LodConfig:
    """When and how coarsely a scene is simplified."""

    proxy_gaussians: int = 200_000
    """A render of 64 px doesn't show more."""
    min_gaussians: int = 500_000
    """Gaussians from which on finding out what is occluded saves more time than it takes."""
    render_px: int = 64
    """Long side of the renders that say what is occluded."""
    opaque_alpha: float = 0.9
    behind_factor: float = 1.2
    """What is this many times as far as a surface of that opacity is occluded..."""
    max_lost_share: float = 0.1
    """...unless more than this share of the light may come from there. In the views of a building of 3 million
    Gaussians one pixel in a hundred differs by more than 0.1 then; with the larger of both depths taken for the
    surface's, three."""


LOD = LodConfig()


def lod_proxy(
    scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator, config: LodConfig = LOD
) -> Rasterizer:
    """Return a renderer of a random choice of the Gaussians: the large ones, and some of the small ones, enlarged.

    One of area a is kept with the probability p = min(1, k a), and its area becomes 2 a / p: random choice would leave
    holes otherwise.
    """
    if scene.count <= config.proxy_gaussians:
        return rasterizer
    # A Gaussian's visible area is about that of its two larger axes.
    least = scene.scales.min(1)
    areas = scene.scales.prod(1, np.float64) / np.maximum(least, 1e-30) * scene.opacities + 1e-30
    share = config.proxy_gaussians * areas / areas.sum()
    for _ in range(10):  # those that are certain leave room for others
        certain = share >= 1
        room = config.proxy_gaussians - np.count_nonzero(certain)
        share *= np.where(certain, 1.0, room / share.sum(where=~certain))
    chosen = np.flatnonzero(rng.random(scene.count, np.float32) < share)
    # Twice the area that is lost, because random choice leaves gaps.
    wider = np.sqrt(2.0 / share[chosen], where=share[chosen] < 1, out=np.ones(len(chosen)))
    scales = (scene.scales[chosen] * wider[:, None]).astype(np.float32)
    # The thinnest axis stays: a surface mustn't become thick.
    thinnest = np.argmin(scene.scales[chosen], axis=1)[:, None]
    np.put_along_axis(scales, thinnest, least[chosen, None], 1)
    arrays = {name: getattr(scene, name)[chosen] for name in ("means", "quats", "opacities")}
    return rasterizer.of(replace(scene, **arrays, scales=scales, sh=scene.sh[chosen, :1]))


def occlusion_depths(frame: Frame, config: LodConfig = LOD) -> Float32[np.ndarray, "h w"]:
    """Return the z-depth beyond which everything at a pixel and beside it is occluded; infinite where none is.

    Of a mean depth beyond the median's at most `max_lost_share` comes from beyond there (Markov's inequality).
    """
    surface, beyond = frame.median_depth, frame.depth - frame.median_depth
    behind = np.maximum(config.behind_factor * surface, surface + beyond / config.max_lost_share)
    # Depth varies within the coarse pixel, so neighbours count, too.
    occluded = np.where(frame.alpha > config.opaque_alpha, behind, np.float32(np.inf))
    return np.asarray(cv2.dilate(occluded, np.ones((3, 3), np.uint8)))


class OccludedRenderer:
    """Renders a scene; of a large one, without what nearer surfaces occlude."""

    def __init__(
        self, scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator, config: LodConfig = LOD
    ) -> None:
        self._rasterizer, self._config = rasterizer, config
        self._proxy = lod_proxy(scene, rasterizer, rng, config) if scene.count > config.min_gaussians else None

    def render(self, cameras: Sequence[Camera]) -> list[Frame]:
        """Return approximate renders; of a large scene, without what is occluded."""
        depths = None
        if self._proxy:
            small = [Camera(c.intrinsics.with_long_side(self._config.render_px), c.pose) for c in cameras]
            coarse = self._proxy.render(small, approximate=True)
            depths = [occlusion_depths(frame, self._config) for frame in coarse]
        return self._rasterizer.render(cameras, approximate=True, occlusion_depths=depths)
