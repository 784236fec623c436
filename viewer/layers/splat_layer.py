"""The scene's splats, drawn by the browser, and the background image that may stand in for them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt8

from viewer.layers.layer import Canvas, Layer
from viewer.scene_cache import SceneContent
from viewer.service_values import Splats

_MAX_COVARIANCE = 200.0**2
"""After scaling; float16 reaches 65504."""


class SplatLayer(Layer):
    """The splats, hidden while a render of the service is the background."""

    name = "splats"

    def __init__(self, canvas: Canvas, *, visible: bool = True) -> None:
        super().__init__(canvas, visible=visible)
        self._splats: Splats | None = None
        self._covered = False
        """Whether a render of the service is shown instead."""
        self._background = np.zeros((1, 1, 3), np.uint8)

    @property
    def pending(self) -> bool:
        """Whether the splats should be visible and haven't been sent yet."""
        return self._splats is not None and self.visible and not self._nodes

    def show(self, content: SceneContent) -> None:
        """Replace the scene; its splats are sent by `send`."""
        self.clear()
        self._splats = content.splats
        self._background = (255 * np.array([[content.description.background_rgb]])).astype(np.uint8)

    def send(self) -> None:
        """Send the splats: megabytes, after everything that is waited for."""
        if self._splats is None:
            return
        splats = self._splats
        # viser sends covariances as float16: scaled so that the largest just fits, small ones keep their digits.
        largest = float(splats.covariances[:, [0, 3, 5]].max(initial=1e-12))
        # Covariances scale with the square of lengths.
        k = np.sqrt(_MAX_COVARIANCE / largest)
        self._nodes["splats"] = self._canvas.scene.add_gaussian_splats(
            self._path("splats"),
            centers=splats.centres * np.float32(k),
            covariances=full_covariances(splats.covariances * np.float32(k * k)),
            rgbs=splats.rgba[:, :3],
            opacities=splats.rgba[:, 3:],
            scale=1 / k,
            visible=self._nodes_visible,
        )

    def show_background(self, image: UInt8[np.ndarray, "h w 3"] | None) -> None:
        """Show a render behind everything and hide the splats; None: the splats on the scene's background colour."""
        self._covered = image is not None
        with self._canvas.atomic():
            self._apply_visibility()
            if image is None:
                self._canvas.scene.set_background_image(self._background, format="png")
            else:
                self._canvas.scene.set_background_image(image, format="jpeg", jpeg_quality=92)

    @property
    def _nodes_visible(self) -> bool:
        return self.visible and not self._covered


def full_covariances(upper: Float32[np.ndarray, "n 6"]) -> Float32[np.ndarray, "n 3 3"]:
    """Return symmetric matrices from their upper triangles xx, xy, xz, yy, yz, zz."""
    return upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
