"""Slabs of depth in which a view of many Gaussians is drawn, near ones first.

A large scene has many times more Gaussians in the field of view than before the first surface. So the blocks in view
are put in order of their nearest points and cut into slabs; a slab is projected, sorted and blended before the next one
is looked at, and of that only blocks, chunks and Gaussians that reach into squares of 4 x 4 pixels which still let
light through. What an image costs follows what it shows, and so does the memory for it.

A Gaussian is drawn in the slab that its own depth is in, whichever its block is in; so the order is that of an image
drawn at once, but for Gaussians whose depths are equal to 1 part in 2 million: their keys are exact to that (see
`tiles`). Where a square is closed, at most `close_t` of a pixel's light is missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, UInt32


@dataclass(frozen=True, slots=True)
class SlabConfig:
    """When and how an image is drawn in slabs."""

    min_blocks: int = 1500
    """In view, from which on slabs are worth it: 384,000 Gaussians, more than many a scene has in all."""
    blocks: int = 512
    """Of the first slab: what 131,000 Gaussians take while they are sorted and blended is about a core's L2 cache."""
    growth: float = 1.25
    """Of each slab over the one before: farther ones are hidden more and more, and looking at them costs the same."""
    close_t: float = 0.001
    """Transmittance of all pixels at which a square takes nothing from the slabs behind: a quarter of a grey level."""


SLABS = SlabConfig()


def slabs(
    blocks: Int32[np.ndarray, "n"], extents: Float32[np.ndarray, "n 2"], near: float, config: SlabConfig
) -> Iterator[tuple[Int32[np.ndarray, "_"], np.float32, np.float32]]:
    """Yield for each slab the blocks that may reach into it, and the depths between which it is, near to far.

    `extents` has the smallest and the largest depth of each block. The last slab has no end.
    """
    order = np.argsort(extents[:, 0], kind="stable")
    blocks, nearest, farthest = blocks[order], extents[order, 0], extents[order, 1]
    # Blocks around the camera begin before the near plane, and aren't cut.
    last, size = int(np.searchsorted(nearest, near)), float(config.blocks)
    start = np.float32(near)
    end = start
    while end < np.inf:
        last, size = last + int(size), size * config.growth
        end = nearest[last] if last < len(blocks) else np.float32(np.inf)
        if end > start:
            # Of those that begin before its end, the ones that don't end before its start.
            yield blocks[:last][farthest[:last] >= start], start, end
            start = end


def open_sums(alive: UInt32[np.ndarray, "h w"]) -> Int32[np.ndarray, "_"]:
    """Return for each corner of squares how many open ones are above and left of it (a summed-area table), row by row.

    `alive` has a bit for each of the 4 x 4 squares of a tile, row by row.
    """
    high, wide = alive.shape
    bits = (alive[..., None] >> np.arange(16, dtype=np.uint32)) & np.uint32(1)
    is_open = bits.reshape(high, wide, 4, 4).swapaxes(1, 2).reshape(4 * high, 4 * wide)
    sums = np.zeros((4 * high + 1, 4 * wide + 1), np.int32)
    np.cumsum(np.cumsum(is_open, 0, np.int32), 1, out=sums[1:, 1:])
    return sums.reshape(-1)
