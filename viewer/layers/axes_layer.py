"""The scene's frame: its axes, its up direction, and a length to compare with."""

from __future__ import annotations

import numpy as np

from viewer.layers.layer import Layer

_COLOURS = np.array([(240, 80, 80), (90, 210, 90), (90, 140, 255), (240, 240, 240)], np.uint8)
_FARTHEST = 2.0
"""Radii from the scene's centre up to which the axes stand in the world's origin; beyond, in the centre."""


class AxesLayer(Layer):
    """The world's axes x, y, z and the up direction, each as long as the label of x says."""

    name = "axes and scale"

    def show(self, metres_per_unit: float | None) -> None:
        """Draw the axes; the length is a round number of metres where the scene has a scale, else of units."""
        if self.extent is None:
            return
        scale, unit = metres_per_unit or 1.0, "m" if metres_per_unit else "units"
        shown = round_length(0.4 * self.extent.radius * scale)
        # In a world of map coordinates the origin may be out of sight.
        far = np.linalg.norm(self.extent.centre) > _FARTHEST * self.extent.radius
        start = self.extent.centre if far else np.zeros(3)
        ends = start + shown / scale * np.vstack([np.eye(3), self.extent.up])
        segments = np.stack([np.broadcast_to(start, (4, 3)), ends], axis=1).astype(np.float32)
        self._draw_lines("lines", segments, np.repeat(_COLOURS[:, None], 2, 1), 3.0)
        for end, text in zip(ends, (f"x, {shown:g} {unit}", "y", "z", "up"), strict=True):
            self._draw_label(text.partition(",")[0], text, end)


def round_length(limit: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten up to a positive limit."""
    power = 10.0 ** np.floor(np.log10(limit))
    # Rounding must not exclude the limit itself.
    return float(power * max(step for step in (1, 2, 5) if step * power <= limit * (1 + 1e-9)))
