"""DISK (Tyszkiewicz et al., 2020) with LightGlue; the weights come from a folder, see `service.matchers.networks`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int32, UInt8

from service.interfaces import Features
from service.matchers import networks

WEIGHTS = ("depth-save.pth", "disk_lightglue.pth")


class DiskLightGlue:
    """Implements `Matcher` by DISK's features (Tyszkiewicz et al. 2020) and LightGlue (Lindenberger et al. 2023)."""

    name = "disk_lightglue"

    def __init__(self) -> None:
        self._extract, self._network = networks.disk(WEIGHTS[0]), networks.lightglue(WEIGHTS[1])

    def extract(self, rgb: UInt8[np.ndarray, "h w 3"], limit: int) -> Features:
        """Return the `limit` strongest DISK features."""
        return networks.extracted(self._extract, rgb, limit)

    def match(self, a: Features, b: Features) -> Int32[np.ndarray, "m 2"]:
        """Return the pairs of indices that LightGlue (Lindenberger et al., ICCV 2023) assigns."""
        return networks.match_lightglue(self._network, a, b)


def create() -> DiskLightGlue:
    """Load the networks. Raises BackendMissing for files that are not their weights."""
    return DiskLightGlue()


def missing() -> str | None:
    """Return which weight files are missing; None if none is."""
    return networks.missing_weights(*WEIGHTS)
