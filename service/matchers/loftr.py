"""LoFTR (Sun et al., CVPR 2021): pairs two images without features of each; weights from a folder.

What the supplement's iComMa matches with, and most likely its own method. See `service.matchers.networks`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from service.interfaces import ImagePairs
from service.matchers import networks

WEIGHTS = ("loftr_outdoor.ckpt",)


class Loftr:
    name = "loftr"

    def __init__(self) -> None:
        self._network = networks.loftr(*WEIGHTS)

    def match_images(self, a: UInt8[np.ndarray, "h w 3"], b: UInt8[np.ndarray, "h2 w2 3"]) -> ImagePairs:
        return networks.paired(self._network, a, b)


def create() -> Loftr:
    """Return a matcher. Raises BackendMissing for a file that is not its weights."""
    return Loftr()


def missing() -> str | None:
    """Return what is not there to run it."""
    return networks.missing_weights(*WEIGHTS)
