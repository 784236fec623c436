"""The median depth, which gsplat doesn't compute, from its kernel that lists the Gaussians which each pixel blends.

They are taken 256 at a time and from near to far, until the transmittance falls to one half:

    tile's list, by depth   |  256 Gaussians  |  256 Gaussians  | ...
    transmittance of a ray  1 ......... 0.7   0.7 ... 0.5 <- here: the ray is left out of later passes
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

TILE = 16
"""Pixels; gsplat's kernels take TILE * TILE Gaussians of a tile's list at a time."""


def median_depth(
    blended: Callable[..., tuple[Tensor, Tensor, Tensor]], meta: dict[str, Any], shape: Sequence[int], at_once: int
) -> Float[Tensor, "c h w"]:
    """Return the z-depth of the Gaussian at which each ray's transmittance falls to one half; 0: it never does.

    `blended` is gsplat's `rasterize_to_indices_in_range`, `meta` what its `rasterization` returns; `at_once` rays are
    followed at a time.
    """
    total = int(np.prod(shape))
    offsets = meta["isect_offsets"].flatten()
    median = torch.zeros(total, device=offsets.device)
    longest = int(torch.diff(offsets, append=offsets.new_tensor([len(meta["flatten_ids"])])).max())
    for first in range(0, total, at_once):
        rays = slice(first, first + at_once)
        through = torch.zeros(total, device=offsets.device)  # a ray of transmittance 0 blends nothing
        through[rays] = 1
        for step in range(-(-longest // TILE**2)):
            _advance(blended, meta, shape, step, through, median)
            if not through[rays].any():
                break
    return median.reshape(*shape)


def _advance(
    blended: Callable[..., tuple[Tensor, Tensor, Tensor]],
    meta: dict[str, Any],
    shape: Sequence[int],
    step: int,
    through: Float[Tensor, "r"],
    median: Float[Tensor, "r"],
) -> None:
    """Blend the next 256 Gaussians of the tiles' lists; a ray whose transmittance falls to one half ends there."""
    _, height, width = shape
    centres, conics, opacities = meta["means2d"], meta["conics"], meta["opacities"]
    gaussian, pixel, image = blended(
        step, step + 1, through.reshape(*shape), centres, conics, opacities, width, height, TILE,
        meta["isect_offsets"], meta["flatten_ids"],
    )  # fmt: skip
    if not len(gaussian):
        return
    ray = image * (height * width) + pixel
    dx, dy = (centres[image, gaussian] - torch.stack([pixel % width, pixel // width], -1) - 0.5).unbind(-1)
    a, b, c = conics[image, gaussian].unbind(-1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacities[image, gaussian] * torch.exp(-sigma)).clamp(max=0.999)
    # The entries are sorted by ray, then depth: transmittance is a running product that restarts with each ray,
    # computed as a sum of logarithms minus the sum at the ray's start, in float64, as thousands are added up.
    starts = torch.ones_like(ray, dtype=torch.bool)
    starts[1:] = ray[1:] != ray[:-1]
    kept = torch.log1p(-alpha.double())
    sums = kept.cumsum(0)
    after = through[ray] * torch.exp(sums - (sums - kept)[starts][starts.cumsum(0) - 1])
    below_half = after <= 0.5
    crossing = below_half.clone()
    crossing[1:] &= starts[1:] | ~below_half[:-1]
    last = starts.roll(-1)
    through[ray[last]] = after[last].to(through.dtype)
    through[ray[crossing]] = 0
    median[ray[crossing]] = meta["depths"][image, gaussian][crossing].to(median.dtype)
