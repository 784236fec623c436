"""XFeat's features, paired by its authors' small LightGlue: slower, better on hard pairs."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Int32, UInt8

from service.interfaces import Features
from service.matchers import networks, xfeat


class XFeatLighterGlue:
    """`Matcher` by XFeat and LighterGlue."""

    name = "xfeat_lighterglue"

    def __init__(self) -> None:
        self._xfeat, self._network = xfeat.create(), networks.lighterglue()

    def extract(self, rgb: UInt8[np.ndarray, "h w 3"], limit: int) -> Features:
        """Return the `limit` strongest XFeat features."""
        return self._xfeat.extract(rgb, limit)

    def match(self, a: Features, b: Features) -> Int32[np.ndarray, "m 2"]:
        """Return the pairs of indices that LighterGlue assigns."""
        return networks.match_lightglue(self._network, a, b)


@cache
def create() -> XFeatLighterGlue:
    """Return the one instance: it has no state, and its weights need not be twice in memory."""
    return XFeatLighterGlue()
