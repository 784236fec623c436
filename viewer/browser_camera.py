"""The camera of one browser's 3D view."""

from __future__ import annotations

import time

from viewer.camera_views import Viewpoint, interpolate_views
from viewer.layers.layer import Canvas

_FLIGHT_S, _FRAME_S = 0.8, 1 / 30


class BrowserCamera:
    """Sets the browser's camera. All methods are called from one thread."""

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas

    @property
    def aspect(self) -> float:
        """Width / height of the browser's viewport."""
        return float(self._canvas.camera.aspect)

    def set_clipping(self, near: float, far: float) -> None:
        """Draw only what lies between these depths; scene units."""
        self._canvas.camera.near, self._canvas.camera.far = near, far

    def set_view(self, view: Viewpoint) -> None:
        """Move the camera at once."""
        camera = self._canvas.camera
        with self._canvas.atomic():
            camera.up_direction = view.up
            camera.position = view.position
            camera.look_at = view.look_at  # after the position, which moves it along
            camera.fov = view.fov_rad

    def fly_to(self, goal: Viewpoint) -> None:
        """Move the camera along a smooth path; blocks for 0.8 s."""
        camera = self._canvas.camera
        # Copies, as viser's arrays change with the camera.
        start = Viewpoint(camera.position.copy(), camera.look_at.copy(), camera.up_direction.copy(), camera.fov)
        began = time.monotonic()
        share = 0.0
        while share < 1:
            share = min(1.0, (time.monotonic() - began) / _FLIGHT_S)
            self.set_view(interpolate_views(start, goal, share))
            self._canvas.flush()
            time.sleep(_FRAME_S)
