"""A rasterizer that counts what it is asked for: budgets and benches are told in renders, too."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from service.interfaces import Frame, Rasterizer, RenderTally, SceneGradients
from service.types import Camera, GaussianScene


class Counted:
    """`Rasterizer` that passes everything on; one to a job, for its tally is not shared."""

    def __init__(self, inner: Rasterizer, tally: RenderTally) -> None:
        self.name = inner.name
        self.inner, self.tally = inner, tally

    @property
    def nbytes(self) -> int:
        return self.inner.nbytes

    def of(self, scene: GaussianScene) -> Counted:
        return Counted(self.inner.of(scene), self.tally)

    def trained_at(self, long_side_px: int) -> Counted:
        return Counted(self.inner.trained_at(long_side_px), self.tally)

    def render(self, cameras: Sequence[Camera], *rest: Any, **named: Any) -> list[Frame]:
        self.tally.count += len(cameras)
        return self.inner.render(cameras, *rest, **named)

    def pose_gradient(
        self, camera: Camera, d_rgb: Any, d_depth: Any = None, d_alpha: Any = None
    ) -> Float64[np.ndarray, "6"]:
        self.tally.count += 1
        return self.inner.pose_gradient(camera, d_rgb, d_depth, d_alpha)

    def scene_gradients(self, camera: Camera, d_rgb: Any, d_depth: Any = None, d_alpha: Any = None) -> SceneGradients:
        self.tally.count += 1
        return self.inner.scene_gradients(camera, d_rgb, d_depth, d_alpha)
