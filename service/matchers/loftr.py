"""LoFTR (Sun et al., CVPR 2021): pairs two images without features of each; weights from a folder.

The paper's iComMa matches with it in the supplement, and most likely for its own method, too. See
`service.matchers.networks`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from service.interfaces import ImagePairs
from service.matchers import networks

WEIGHTS = ("loftr_outdoor.ckpt",)


class Loftr:
    """Implements `ImageMatcher` by LoFTR (Sun et al. 2021), a network without a detector."""

    name = "loftr"

    def __init__(self) -> None:
        self._network = networks.loftr(*WEIGHTS)

    def match_images(self, a: UInt8[np.ndarray, "h w 3"], b: UInt8[np.ndarray, "h2 w2 3"]) -> ImagePairs:
        """Return the pairs of points that show the same, with their confidence."""
        return networks.match_loftr(self._network, a, b)


def create() -> Loftr:
    """Load the network. Raises BackendMissing for a file that is not its weights."""
    return Loftr()


def missing() -> str | None:
    """Return which weight file is missing; None if none is."""
    return networks.missing_weights(*WEIGHTS)
