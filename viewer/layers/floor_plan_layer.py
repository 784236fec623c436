"""The scene cut open: what lies below the heads of those who took its photos, as points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from viewer.layers.layer import Layer
from viewer.scene_cache import SceneContent

_MAX_POINTS = 60_000
_ABOVE = 0.15
"""How far above the median training camera the cut is, in radii of the scene."""


class FloorPlanLayer(Layer):
    """The most important splats below the cut, in their colours: a plan that no ceiling hides."""

    name = "floor plan"

    def show(self, content: SceneContent) -> None:
        """Draw a scene's plan."""
        splats, extent = content.splats, content.extent
        # The service sends splats by importance, so the first matter most.
        kept = np.flatnonzero(below_the_cut(content))[:_MAX_POINTS]
        size = 0.008 * extent.radius
        self._draw_points("points", splats.centres[kept], splats.rgba[kept, :3], size)


def below_the_cut(content: SceneContent) -> Bool[np.ndarray, "n"]:
    """Return which splats lie below the cut; without training cameras, in the lower half of the scene."""
    heights = content.splats.centres @ content.extent.up
    cameras = [named.camera.pose.position_in_world @ content.extent.up for named in content.description.cameras]
    if cameras:
        return heights < np.median(cameras) + _ABOVE * content.extent.radius
    return heights < np.median(heights)
