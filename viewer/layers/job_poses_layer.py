"""The cameras of all jobs of a scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from viewer.colours import STATUS_COLOURS
from viewer.frusta import edge_colours, frustum_edges, stack_poses
from viewer.layers.layer import Layer, linear_colours
from viewer.service_values import FoundCamera

_DEPTH = 0.8
"""Of a frustum, in the scene's frustum depths."""


class JobPosesLayer(Layer):
    """Frusta in the colours of their statuses, as one node."""

    name = "poses of all jobs"

    def show(self, cameras: Sequence[FoundCamera]) -> None:
        """Draw the cameras of photos that were localized, or uncertain."""
        if self.extent is None:
            return
        poses = stack_poses([found.camera.pose for found in cameras])
        intrinsics = [found.camera.intrinsics for found in cameras]
        segments = frustum_edges(poses, intrinsics, _DEPTH * self.extent.frustum_depth)
        colours = np.array([STATUS_COLOURS[found.status] for found in cameras], np.uint8).reshape(-1, 3)
        self._draw_lines("cameras", segments, edge_colours(linear_colours(colours)), 1.5)
