"""A distance between two points of the scene."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from viewer.layers.layer import Canvas, Layer

_COLOUR = (255, 225, 60)


class MeasureLayer(Layer):
    """Points that the user has clicked, at most two, and the line between them with its length."""

    name = "measured distance"

    def __init__(self, canvas: Canvas, *, visible: bool = True) -> None:
        super().__init__(canvas, visible=visible)
        self._points: list[Float64[np.ndarray, "3"]] = []

    def add(self, point: Float64[np.ndarray, "3"], metres_per_unit: float | None) -> None:
        """Add a point; a third begins another distance."""
        if self.extent is None:
            return
        self._points = [*(self._points if len(self._points) < 2 else []), point]
        drawn = np.array(self._points)
        colours = np.tile(np.array(_COLOUR, np.uint8), (len(drawn), 1))
        self._draw_points("points", drawn, colours, 0.1 * self.extent.frustum_depth)
        # A first point alone removes the line of the last distance.
        self._draw_lines("line", drawn[None].astype(np.float32)[:, :2] if len(drawn) == 2 else drawn[:0], _COLOUR, 3.0)
        if len(drawn) == 2:
            units = float(np.linalg.norm(drawn[1] - drawn[0]))
            text = f"{units * metres_per_unit:.3g} m" if metres_per_unit else f"{units:.3g} units"
            self._draw_label("length", text, drawn.mean(0))
        else:
            self._remove("length")

    def clear(self) -> None:
        """Remove the points and their distance."""
        self._points = []
        super().clear()
