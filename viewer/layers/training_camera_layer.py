"""The scene's training cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from service.types import Camera
from viewer.colours import TRAINING_COLOUR
from viewer.frusta import frustum_edges, hit_frustum, stack_poses
from viewer.layers.layer import Canvas, Layer

_DEPTH = 0.6
"""Of a frustum, in the scene's frustum depths."""


class TrainingCameraLayer(Layer):
    """Frusta of all training cameras, as one node."""

    name = "training cameras"

    def __init__(self, canvas: Canvas, *, visible: bool = True) -> None:
        super().__init__(canvas, visible=visible)
        self._cameras: Sequence[Camera] = ()

    def show(self, cameras: Sequence[Camera]) -> None:
        """Draw a scene's training cameras."""
        self._cameras = cameras
        if self.extent is None:
            return
        poses = stack_poses([c.pose for c in cameras])
        segments = frustum_edges(poses, [c.intrinsics for c in cameras], _DEPTH * self.extent.frustum_depth)
        self._draw_lines("cameras", segments, TRAINING_COLOUR, 1.0)

    def hit(self, origin: Float64[np.ndarray, "3"], direction: Float64[np.ndarray, "3"]) -> Camera | None:
        """Return the nearest visible camera whose frustum a ray hits."""
        if self.extent is None or not self.visible:
            return None
        poses = stack_poses([camera.pose for camera in self._cameras])
        index = hit_frustum(origin, direction, poses, _DEPTH * self.extent.frustum_depth)
        return None if index is None else self._cameras[index]
