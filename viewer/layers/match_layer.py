"""The matches of a step in 3D."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from viewer.layers.layer import Layer, linear_colours
from viewer.match_geometry import MatchView


class MatchLayer(Layer):
    """Matched points of the scene, each with a line to the ray of the photo's point."""

    name = "match vectors"

    def show(self, view: MatchView | None, colours: UInt8[np.ndarray, "m 3"] | None) -> None:
        """Draw the matches of a step with a colour for each; None removes them."""
        if self.extent is None:
            return
        segments, drawn = np.zeros((0, 2, 3), np.float32), np.zeros((0, 3), np.uint8)
        if view is not None and colours is not None:
            segments, drawn = view.segments, colours[view.drawn]
        # Each segment has its colour at both ends.
        self._draw_lines("vectors", segments, np.repeat(linear_colours(drawn)[:, None], 2, 1), 2.0)
        self._draw_points("points", segments[:, 0], drawn, 0.05 * self.extent.frustum_depth)
