"""Where in the scene a photo would be found: a star at each place of the coverage map."""

from __future__ import annotations

import numpy as np

from viewer.colours import BLIND_COLOUR, coverage_colour
from viewer.layers.layer import Layer, linear_colours
from viewer.service_values import CoverageMap

_INNER, _OUTER = 0.12, 0.46
"""Ends of a star's rays, in cells from its middle."""


class CoverageLayer(Layer):
    """Each ray points where a camera looks, in the colour of the probability that its photo is found."""

    name = "coverage"

    def show(self, found: CoverageMap | None) -> None:
        """Draw a map; None: nothing."""
        if found is None:
            self.clear()
            return
        middles = np.repeat(found.positions_in_world, len(found.directions_in_world), 0)
        rays = np.tile(found.directions_in_world, (len(found.positions_in_world), 1)) * found.cell
        segments = np.stack([middles + _INNER * rays, middles + _OUTER * rays], 1).astype(np.float32)
        probabilities = found.probabilities.ravel()
        # NaN: from there a photo would see nothing of the scene.
        colours = np.array(
            [BLIND_COLOUR if np.isnan(p) else coverage_colour(p) for p in probabilities], np.uint8
        ).reshape(-1, 3)
        self._draw_lines("rays", segments, np.repeat(linear_colours(colours)[:, None], 2, 1), 4.0)
