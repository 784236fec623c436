"""One level of the image pyramid, linearized at the render: its points and jacobian, computed once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from service.interfaces import Frame
from service.pose.refinement.kernels import fill_residuals, linearize
from service.pose.refinement.pyramid import (
    clip_like_photo,
    depth_pyramid,
    evened_light,
    intensity,
    occluder_depth,
    pyramid,
)
from service.pose.refinement.refinement_config import RefinementConfig
from service.types import Intrinsics, IntrinsicsCorrection, LensPrior

TWIST, PHOTOMETRIC, CORRECTION = slice(0, 6), slice(6, 10), slice(10, 14)
"""Places of the unknowns: twist, (gain, bias, gamma, blur), and `correction_vector`."""
UNKNOWN = np.float32(-1e4)
"""Value of a photo's invalid pixels; blurred or interpolated with valid ones it stays negative."""
NEUTRAL = np.array([1.0, 0.0, 0.0, 0.0])
"""Photometric parameters of a photo that equals the render."""


@dataclass(slots=True)
class RefinementState:
    """The unknowns, changed step by step."""

    photo_from_render: Float64[np.ndarray, "4 4"]
    correction: IntrinsicsCorrection
    prior: LensPrior | None
    """On the photo's intrinsics; None: they are exact, and not estimated."""
    photometric: Float64[np.ndarray, "4"]
    """Gain, bias, gamma, blur (in squared pixels of the level)."""

    @property
    def factors(self) -> Float64[np.ndarray, "14"]:
        """Factors of the jacobian's rows: the photo shows the render's gradients times the gain."""
        factors = np.full(14, self.photometric[0])
        factors[PHOTOMETRIC] = 1.0
        return factors


@dataclass(frozen=True, slots=True)
class PyramidLevel:
    """A photo and a render at one size: the pixels that count, with their scene points and derivatives."""

    photo: Float32[np.ndarray, "h w"]
    """Luma, 0..1; negative where invalid."""
    pixels: Int64[np.ndarray, "n"]
    """Places in the render without its border, row by row."""
    points: Float32[np.ndarray, "3 n"]
    """In the render's camera frame, scene units."""
    jacobian: Float32[np.ndarray, "14 n"]
    photo_intrinsics: Intrinsics
    """At this level, without the correction."""

    def thinned(self, count: int) -> PyramidLevel:
        """Return the level with every second, third... pixel: about `count` of them."""
        step = max(1, len(self.pixels) // count)
        pixels, points, jacobian = (
            np.ascontiguousarray(part[..., ::step]) for part in (self.pixels, self.points, self.jacobian)
        )
        return PyramidLevel(self.photo, pixels, points, jacobian, self.photo_intrinsics)

    def residuals(
        self, state: RefinementState, config: RefinementConfig
    ) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"], float]:
        """Return residuals photo - render, weights (0 outside the photo), and the mean absolute residual.

        The mean is infinite where fewer than `min_pixels` overlap.
        """
        residuals, weights = np.empty((2, len(self.pixels)), np.float32)
        camera = self.photo_intrinsics.corrected(state.correction)
        k = np.array([camera.fx, camera.fy, camera.cx, camera.cy, state.correction.k1])
        total, count = fill_residuals(
            self.photo, self.points, self.jacobian[PHOTOMETRIC], state.photo_from_render, k,
            state.photometric, config.l1_floor, residuals, weights,
        )  # fmt: skip
        if count < config.min_pixels:
            return residuals, weights, np.inf
        weights = weights * _tukey_weights(residuals, weights, config)
        # Pixels outside the photo, or cut off, stay out.
        if config.weighting == "least_squares":
            weights = np.where(weights > 0, np.float32(1 / config.l1_floor), np.float32(0))
        return residuals, weights, total / count


def linearized_levels(
    photo: UInt8[np.ndarray, "h w 3"],
    valid_mask: Bool[np.ndarray, "h w"] | None,
    frame: Frame,
    render_intrinsics: Intrinsics,
    photo_intrinsics: Intrinsics,
    levels: int,
    with_intrinsics: bool,
    config: RefinementConfig,
) -> Iterator[PyramidLevel]:
    """Yield the pyramid's levels, coarsest first; each is linearized only when the caller goes on to it.

    `with_intrinsics`: the photo's intrinsics will be estimated, too, which takes more pixels.
    """
    image, expected = intensity(photo), intensity(clip_like_photo(photo, frame, config.pyramid))
    if config.local_light:
        image = evened_light(image, valid_mask, config.local_light)
        expected = evened_light(expected, None, config.local_light)
    if valid_mask is not None:
        # Before the pyramid is built, so that pixels that mix with invalid ones are invalid, too.
        image[~valid_mask] = UNKNOWN
    settings = config.pyramid
    photos = pyramid(image, levels, settings.blur_sigma_px)
    renders = pyramid(expected, levels, settings.blur_sigma_px)
    depths = depth_pyramid(occluder_depth(frame, settings), levels, settings.max_depth_ratio)
    most = config.max_pixels_intrinsics if with_intrinsics else config.max_pixels
    for photo_level, render, depth in zip(reversed(photos), reversed(renders), reversed(depths), strict=True):
        height, width = render.shape
        # Without the border, which has no gradient.
        pixels = np.flatnonzero(depth[1:-1, 1:-1].ravel() > 0)
        stride = max(1, -(-len(pixels) // most))
        pixels = np.ascontiguousarray(pixels[::stride])  # one memory layout: one compilation
        points, jacobian = linearize(render, depth, pixels, intrinsics_vector(render_intrinsics.resized(width, height)))
        yield PyramidLevel(photo_level, pixels, points, jacobian, photo_intrinsics.resized(width, height))


def _tukey_weights(
    residuals: Float32[np.ndarray, "n"], weights: Float32[np.ndarray, "n"], config: RefinementConfig
) -> Float32[np.ndarray, "n"]:
    """Return Tukey's bisquare weights: 1 at no residual, 0 from `cutoff_medians` medians on.

    The median is that of every fourth pixel of positive weight.
    """
    # A quarter of the pixels gives the same median for a quarter of the time.
    some = np.abs(residuals[::4][weights[::4] > 0])
    middle = len(some) // 2
    median = max(float(np.partition(some, middle)[middle]), config.min_median) if len(some) else config.min_median
    ratio = residuals * np.float32(1 / (config.cutoff_medians * median))
    kept = np.maximum(1 - ratio * ratio, 0)
    return kept * kept


def intrinsics_vector(intrinsics: Intrinsics) -> Float64[np.ndarray, "4"]:
    """Return fx, fy, cx, cy in pixels."""
    return np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
