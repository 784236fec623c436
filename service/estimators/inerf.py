"""iNeRF (Yen-Chen et al., IROS 2021) on Gaussians, as the supplement's section B runs it.

    xi = argmin mean over 512 pixels of (I(exp(xi) P_0) - Q)^2,   pixels from interest regions, anew at each step

SE(3), Adam, rate 0.05 * 0.8^(step / 100), 500 steps; the answer is the last pose. From the supplement: all of
these. Ours: renders of 416 px in the long side (the supplement has none), the whole of which is rendered for the 512
pixels; a twist in the normalized world instead of a screw axis.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float32, UInt8

from service.errors import InvalidPrior
from service.interfaces import Tools
from service.pose.descent.adam import Adam
from service.pose.descent.gradient_descent import Se3, loss_and_gradient, require_within
from service.pose.descent.losses import Loss, interest_region, loss_against, require_loss
from service.pose.features.image_sizes import RENDER_PX, sized
from service.pose.features.query_images import QueryImages
from service.pose.features.scene_focus import Focus, focus_of_scene
from service.results import IterationRecord
from service.types import Pose, Query


@dataclass(frozen=True, slots=True)
class InerfConfig:
    """The rate's schedule, from the supplement."""

    decay: float = 0.8
    """Factor of the rate in `decay_steps` steps."""
    decay_steps: int = 100


INERF = InerfConfig()
LIMITS = {"steps": (1, 100_000), "rays": (0, 10_000_000), "rate": (0, 10), "long_side_px": (32, 4096)}


NEEDS_PRIOR = True


@dataclass(frozen=True, slots=True)
class Options:
    steps: int = 500
    rays: int = 512
    """Pixels that count in a step, from the photo's interest regions; 0: all pixels of the picture."""
    rate: float = 0.05
    """Adam's at the start; 0.8 times as much every 100 steps."""
    loss: str = "l2"
    """l1, l2, relative, feature, corner or blur."""
    long_side_px: int = RENDER_PX
    """Long side of the renders, in pixels."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "use_attribute_docstrings": True}

    def __post_init__(self) -> None:
        require_within(self, LIMITS)
        require_loss(self.loss)


def prepare(tools: Tools[None], cache_dir: Path | None) -> Focus:
    """Return the scene's focus, which defines the normalized units."""
    return focus_of_scene(tools.scene, tools.rasterizer)


def run(
    query: Query, tools: Tools[Focus], options: Options, config: InerfConfig = INERF
) -> Generator[IterationRecord, None, None]:
    """Descend from the prior; the last record's pose is the answer. Raises InvalidPrior without a prior."""
    start = required_prior(query, "inerf")
    intrinsics = sized(query.intrinsics, options.long_side_px)
    images = QueryImages(query, tools.matcher)
    photo = images.resized(intrinsics)
    loss = loss_against(options.loss, photo, images.valid_mask(intrinsics))
    draw_mask = _pixel_sampler(photo, options.rays, tools.rng) if options.rays else None
    pose_of = Se3(start, tools.prepared)
    numbers, adam = np.zeros(6), Adam(6, options.rate)
    yield IterationRecord("start", start)
    for step in range(options.steps):
        adam.rate = options.rate * config.decay ** (step / config.decay_steps)
        # New pixels in each step: stochastic gradient descent, as in the paper.
        chosen = _on_pixels(loss, draw_mask()) if draw_mask else loss
        value, gradient = loss_and_gradient(tools.rasterizer, intrinsics, pose_of.pose(numbers), chosen)
        numbers = numbers - adam.step(pose_of.gradient(numbers, gradient))
        yield IterationRecord("descend", pose_of.pose(numbers), loss=value)


def required_prior(query: Query, name: str) -> Pose:
    """Return the query's prior pose. Raises InvalidPrior, naming the estimator, if it has none."""
    if query.prior is None:
        raise InvalidPrior(
            f"'{name}' moves a given pose, and there is none.", where="prior", hint="Send one, or take view_index."
        )
    return query.prior


def _pixel_sampler(
    photo: UInt8[np.ndarray, "h w 3"], rays: int, rng: np.random.Generator
) -> Callable[[], Float32[np.ndarray, "h w 1"]]:
    """Return a function that draws a step's pixels: a mask, zero elsewhere, whose mean is 1.

    Pixels are of the photo's interest regions, or of the whole picture where those are smaller than `rays`.
    """
    region = np.flatnonzero(interest_region(photo))
    # A photo without texture has hardly any feature points.
    if len(region) < rays:
        region = np.arange(photo.shape[0] * photo.shape[1])

    def draw_mask() -> Float32[np.ndarray, "h w 1"]:
        mask = np.zeros(photo.shape[0] * photo.shape[1], np.float32)
        # Scaled to a mean of 1, so that gradient and learning rate keep their size.
        mask[rng.choice(region, min(rays, len(region)), replace=False)] = len(mask) / min(rays, len(region))
        return mask.reshape(*photo.shape[:2], 1)

    return draw_mask


def _on_pixels(loss: Loss, mask: Float32[np.ndarray, "h w 1"]) -> Loss:
    """Return the loss with the gradient of the mask's pixels alone; its value stays that of all pixels."""

    def of(render: Float32[np.ndarray, "h w 3"]) -> tuple[float, Float32[np.ndarray, "h w 3"]]:
        value, gradient = loss(render)
        # A loss of few pixels would make the trace noisy.
        return value, gradient * mask

    return of
