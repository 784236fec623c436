"""The contribution-pruned level of a scene: what hypotheses are rendered with.

A Gaussian's contribution is the sum of its blending weights over the pixels of some views. Those that together make
KEPT of all are kept. The weights cost no kernel of their own: a picture is linear in the colours, so the gradient of
the sum of its pixels by a colour coefficient is the weight times the basis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from service.interfaces import Rasterizer
from service.types import Camera, GaussianScene

KEPT = 0.95
"""Research: 34 % of a chair's Gaussians remain, 2.4 times faster, 40 dB against the full scene."""
SH_0 = 0.28209479177387814


def contributions(scene: GaussianScene, rasterizer: Rasterizer, cameras: Sequence[Camera]) -> Float64[np.ndarray, "n"]:
    """Return each Gaussian's largest sum of blending weights (pixels) in any of the views.

    A channel whose colour is clamped to 0 has no gradient: the largest of the three counts.
    """
    result = np.zeros(scene.count)
    for camera in cameras:
        ones = np.ones((camera.intrinsics.height, camera.intrinsics.width, 3), np.float32)
        found = rasterizer.scene_gradients(camera, ones)
        seen = found.index
        result[seen] = np.maximum(result[seen], found.sh[:, 0].max(1) / SH_0)
    return result


def pruned(scene: GaussianScene, contribution: Float64[np.ndarray, "n"], kept: float = KEPT) -> GaussianScene:
    """Return the scene of the Gaussians that make the share `kept` of all contribution, in their order."""
    order = np.argsort(-contribution, kind="stable")
    total = np.cumsum(contribution[order])
    count = int(np.searchsorted(total, kept * total[-1])) + 1
    chosen = np.sort(order[:count])
    arrays = {name: getattr(scene, name)[chosen] for name in ("means", "quats", "scales", "opacities", "sh")}
    return replace(scene, **arrays)
