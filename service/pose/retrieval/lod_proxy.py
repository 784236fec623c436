"""A large scene at a glance: fewer Gaussians for small renders, and what those tell about what hides what."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32

from service.interfaces import Frame, Rasterizer
from service.types import Camera, GaussianScene

ENOUGH = 200_000
"""Gaussians: a view of 64 px doesn't show more."""
LARGE = 500_000
"""Gaussians from which on a look at fewer of them, which tells what hides what, is worth its time."""
GLANCE_PX = 64
OPAQUE, BEHIND = 0.9, 1.2
"""What is so many times as far as a surface of this alpha is behind it..."""
LOST = 0.1
"""...unless more than this share of the light may come from there. In the views of a building of 3 million Gaussians
one pixel in a hundred differs by more than 0.1 then; with the larger of both depths taken for the surface's, three."""


def thinned(scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator) -> Rasterizer:
    """Render a choice of the Gaussians: the large ones, and of the small ones some, as large as those that are gone.

    One of area a stays with the probability p = min(1, k a), and its area becomes 2 a / p: what is left to chance
    leaves holes otherwise.
    """
    if scene.count <= ENOUGH:
        return rasterizer
    least = scene.scales.min(1)
    areas = scene.scales.prod(1, np.float64) / np.maximum(least, 1e-30) * scene.opacities + 1e-30
    share = ENOUGH * areas / areas.sum()
    for _ in range(10):  # those that are certain leave room for others
        certain = share >= 1
        room = ENOUGH - np.count_nonzero(certain)
        share *= np.where(certain, 1.0, room / share.sum(where=~certain))
    chosen = np.flatnonzero(rng.random(scene.count, np.float32) < share)
    wider = np.sqrt(2.0 / share[chosen], where=share[chosen] < 1, out=np.ones(len(chosen)))
    scales = (scene.scales[chosen] * wider[:, None]).astype(np.float32)
    thinnest = np.argmin(scene.scales[chosen], axis=1)[:, None]
    np.put_along_axis(scales, thinnest, least[chosen, None], 1)
    arrays = {name: getattr(scene, name)[chosen] for name in ("means", "quats", "opacities")}
    return rasterizer.of(replace(scene, **arrays, scales=scales, sh=scene.sh[chosen, :1]))


def horizon(frame: Frame) -> Float32[np.ndarray, "h w"]:
    """Return the z-depth from which on what a pixel shows hides the rest there and beside it; infinite where open.

    Of a mean depth beyond the median's at most LOST comes from beyond there (Markov's inequality).
    """
    surface, beyond = frame.median_depth, frame.depth - frame.median_depth
    behind = np.maximum(BEHIND * surface, surface + beyond / LOST)
    return np.asarray(cv2.dilate(np.where(frame.alpha > OPAQUE, behind, np.float32(np.inf)), np.ones((3, 3), np.uint8)))


class Rough:
    """Renders a scene without what walls hide."""

    def __init__(self, scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator) -> None:
        self._rasterizer = rasterizer
        self._thinned = thinned(scene, rasterizer, rng) if scene.count > LARGE else None

    def render(self, camera: Camera) -> Frame:
        depths = None
        if self._thinned:
            small = Camera(camera.intrinsics.with_long_side(GLANCE_PX), camera.pose)
            depths = [horizon(frame) for frame in self._thinned.render([small], approximate=True)]
        return self._rasterizer.render([camera], approximate=True, occlusion_depths=depths)[0]
