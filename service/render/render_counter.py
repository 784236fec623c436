"""A rasterizer that counts its renders: budgets and benchmarks are measured in renders, too."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from service.interfaces import Frame, Rasterizer, RenderTally, SceneGradients
from service.types import Camera, GaussianScene


class Counted(Rasterizer):
    """`Rasterizer` that delegates to another one and counts images and gradients; one for each job."""

    def __init__(self, inner: Rasterizer, tally: RenderTally) -> None:
        self.name = inner.name
        self.inner, self.tally = inner, tally

    @property
    def nbytes(self) -> int:
        """As the inner rasterizer."""
        return self.inner.nbytes

    @property
    def cameras_at_once(self) -> int:
        """As the inner rasterizer."""
        return self.inner.cameras_at_once

    @property
    def tensor_device(self) -> str:
        """As the inner rasterizer."""
        return self.inner.tensor_device

    def of(self, scene: GaussianScene) -> Counted:
        """As the inner rasterizer; the new one adds to the same tally."""
        return Counted(self.inner.of(scene), self.tally)

    def trained_at(self, long_side_px: int) -> Counted:
        """As the inner rasterizer; the new one adds to the same tally."""
        return Counted(self.inner.trained_at(long_side_px), self.tally)

    def over(self, background_rgb: tuple[float, float, float]) -> Counted:
        """As the inner rasterizer; the new one adds to the same tally."""
        return Counted(self.inner.over(background_rgb), self.tally)

    def render(self, cameras: Sequence[Camera], *rest: Any, **named: Any) -> list[Frame]:
        """Render; each image counts as one."""
        self.tally.count += len(cameras)
        return self.inner.render(cameras, *rest, **named)

    def pose_gradient(
        self, camera: Camera, d_rgb: Any, d_depth: Any = None, d_alpha: Any = None
    ) -> Float64[np.ndarray, "6"]:
        """Return the gradient; it counts as one render."""
        self.tally.count += 1
        return self.inner.pose_gradient(camera, d_rgb, d_depth, d_alpha)

    def pose_gradients(self, cameras: Sequence[Camera], d_rgb: Sequence[Any]) -> Float64[np.ndarray, "n 6"]:
        """Return the gradients; each counts as one render."""
        self.tally.count += len(cameras)
        return self.inner.pose_gradients(cameras, d_rgb)

    def scene_gradients(self, camera: Camera, d_rgb: Any, d_depth: Any = None, d_alpha: Any = None) -> SceneGradients:
        """Return the gradients; they count as one render."""
        self.tally.count += 1
        return self.inner.scene_gradients(camera, d_rgb, d_depth, d_alpha)
