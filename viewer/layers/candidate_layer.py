"""The candidate poses that an estimator has scored."""

from __future__ import annotations

import numpy as np

from service.results import Candidates
from service.types import Intrinsics
from viewer.colours import score_colours
from viewer.frusta import edge_colours, frustum_edges
from viewer.layers.layer import Layer, linear_colours

_MAX_FRUSTA = 24
"""Of the best candidates; hundreds would hide one another, so the others are points only."""


class CandidateLayer(Layer):
    """Candidates coloured by score: all as points, the best as frusta."""

    name = "candidates"

    def show(self, candidates: Candidates | None, photo: Intrinsics) -> None:
        """Draw candidates as cameras with the intrinsics `photo`; None removes them."""
        if self.extent is None:
            return
        poses = candidates.world_from_camera if candidates else np.zeros((0, 4, 4))
        scores = candidates.scores if candidates else np.zeros(0)
        colours = score_colours(scores)
        depth = self.extent.frustum_depth
        # Stable: of equal scores the same frusta are shown after each step.
        best = np.argsort(-scores, kind="stable")[:_MAX_FRUSTA]
        segments = frustum_edges(poses[best], [photo] * len(best), 0.7 * depth)
        self._draw_lines("candidates", segments, edge_colours(linear_colours(colours[best])), 1.5)
        self._draw_points("cloud", poses[:, :3, 3], colours, 0.07 * depth)
