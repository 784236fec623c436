"""The scene's anchors: named points, and the one that the user has picked to be named."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64

from viewer.layers.layer import Layer

_COLOUR, _PICKED = (255, 140, 0), (255, 225, 60)


class AnchorLayer(Layer):
    """Points with their names."""

    name = "anchors"

    def show(self, anchors: Mapping[str, Float64[np.ndarray, "3"]]) -> None:
        """Draw a scene's anchors, by name."""
        # Nodes go by their number: of fewer anchors than before the last ones would stay.
        self.clear()
        if self.extent is None:
            return
        points = np.array(list(anchors.values())).reshape(-1, 3)
        colours = np.tile(np.array(_COLOUR, np.uint8), (len(points), 1))
        self._draw_points("points", points, colours, 0.12 * self.extent.frustum_depth)
        for number, (name, point) in enumerate(anchors.items()):
            self._draw_label(f"name {number}", name, point)

    def pick(self, point: Float64[np.ndarray, "3"]) -> None:
        """Draw a point that is to be named."""
        if self.extent is not None:
            self._draw_points("picked", point[None], np.array([_PICKED], np.uint8), 0.15 * self.extent.frustum_depth)
