"""The six photometric losses of the supplement (section F) between a render I and the photo Q, with d loss / d I.

Over the n values of the picture (pixels times channels, sRGB in 0..1):

    l1        mean |I - Q|
    l2        mean (I - Q)^2
    relative  mean (I - Q)^2 / (I'^2 + 0.01)          I' = I held constant
    feature   l2 + 0.7    mean over F of (I - Q)^2    F: interest regions, feature points of Q dilated 3 x 5 px
    corner    l2 + 7.5e-5 sum over C of (I - Q)^2     C: Shi-Tomasi corners of Q dilated with a kernel of 51 px
    blur      l2 + 0.8    mean (G I - G Q)^2          G: Gaussian blur with sigma 5 px

The supplement has the six, "applied on top of the L2 loss", and the numbers. Where it is silent: the form of the
relative loss is Instant-NGP's; SIFT points are the features, as in iNeRF's code; corners are *summed* (with a mean,
7.5e-5 would have no effect); kernel and sigma are taken for a long side of 800 px and scaled with the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from service.errors import UnknownName


@dataclass(frozen=True, slots=True)
class LossConfig:
    """Weights and sizes; from the supplement unless stated otherwise."""

    relative_floor: float = 0.01
    """Added to the squared render in the relative loss; Instant-NGP's."""
    feature_weight: float = 0.7
    corner_weight: float = 7.5e-5
    blur_weight: float = 0.8
    feature_kernel_px: int = 13
    """Side of the square about a feature point: three dilations by 5 are one by 13."""
    corner_kernel_px: float = 51.0
    """At a long side of `reference_px`, as is the blur's sigma."""
    blur_sigma_px: float = 5.0
    reference_px: int = 800
    """NeRF-Synthetic's size, assumed."""
    max_corners: int = 200
    """Ours, as are quality and distance."""
    corner_quality: float = 0.01
    """Share of the best corner's response."""
    corner_distance_px: float = 10
    """Least distance of two corners."""


LOSS = LossConfig()

Image = Float32[np.ndarray, "h w 3"]
Photo = UInt8[np.ndarray, "h w 3"]
Loss = Callable[[Image], tuple[float, Image]]
"""A loss against one photo, for any number of renders of its size: render -> value and d value / d render."""


def loss_against(
    name: str, photo: Photo, valid_mask: Bool[np.ndarray, "h w"] | None = None, config: LossConfig = LOSS
) -> Loss:
    """Return the named loss against a photo; at invalid pixels no render differs from it. Raises UnknownName."""
    made = _maker(name)(photo, config)
    if valid_mask is None:
        return made
    target, weight = _unit(photo), valid_mask[..., None]

    def of(render: Image) -> tuple[float, Image]:
        value, gradient = made(np.where(weight, render, target))
        return value, gradient * weight

    return of


def require_loss(name: str) -> None:
    """Raise UnknownName unless there is a loss of that name."""
    _maker(name)


def _maker(name: str) -> Callable[[Photo, LossConfig], Loss]:
    if name not in LOSSES:
        raise UnknownName(f"unknown loss '{name}'; known: {', '.join(LOSSES)}.", where="loss")
    return LOSSES[name]


def interest_region(photo: Photo, config: LossConfig = LOSS) -> Bool[np.ndarray, "h w"]:
    """Return iNeRF's interest regions: SIFT feature points, dilated three times by 5 x 5."""
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    keypoints = cv2.SIFT.create().detect(gray, None)
    points = [(float(k.pt[0]), float(k.pt[1])) for k in keypoints]
    return _around(points, gray.shape, config.feature_kernel_px)


def _l1(photo: Photo, config: LossConfig) -> Loss:
    target = _unit(photo)

    def of(render: Image) -> tuple[float, Image]:
        difference = render - target
        return float(np.abs(difference).mean()), np.sign(difference) / np.float32(difference.size)

    return of


def _l2(photo: Photo, config: LossConfig) -> Loss:
    return _weighted(photo, np.float32(1.0))


def _relative(photo: Photo, config: LossConfig) -> Loss:
    target = _unit(photo)

    def of(render: Image) -> tuple[float, Image]:
        difference = render - target
        # Held constant in the gradient, as in Instant-NGP.
        over = 1 / (render * render + np.float32(config.relative_floor))
        return float((difference * difference * over).mean()), 2 * difference * over / np.float32(difference.size)

    return of


def _feature(photo: Photo, config: LossConfig) -> Loss:
    region = interest_region(photo, config)
    # The mean over F as a weighted mean over all pixels.
    extra = config.feature_weight * region * (region.size / max(int(region.sum()), 1))
    return _weighted(photo, (1 + extra[..., None]).astype(np.float32))


def _corner(photo: Photo, config: LossConfig) -> Loss:
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    found = cv2.goodFeaturesToTrack(gray, config.max_corners, config.corner_quality, config.corner_distance_px)
    points = [] if found is None else [tuple(point) for point in found.reshape(-1, 2)]
    region = _around(points, gray.shape, _odd(config.corner_kernel_px * _scale(gray, config)))
    extra = config.corner_weight * 3 * region.size * region  # times the mean over 3 * size values: the sum
    return _weighted(photo, (1 + extra[..., None]).astype(np.float32))


def _blur(photo: Photo, config: LossConfig) -> Loss:
    target, sigma = _unit(photo), config.blur_sigma_px * _scale(photo, config)

    def blurred(image: Image) -> Image:
        # With zeros outside the blur is symmetric, so it is its own adjoint.
        return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), np.float32)

    def of(render: Image) -> tuple[float, Image]:
        difference = render - target
        smooth = blurred(difference)
        value = float((difference**2).mean() + config.blur_weight * (smooth**2).mean())
        return value, (difference + np.float32(config.blur_weight) * blurred(smooth)) * np.float32(2 / difference.size)

    return of


def _weighted(photo: Photo, weights: Float32[np.ndarray, "h w 1"] | np.float32) -> Loss:
    """Return the mean of weights times squared differences."""
    target = _unit(photo)

    def of(render: Image) -> tuple[float, Image]:
        weighted = weights * (render - target)
        value = float((weighted * (render - target)).mean())
        return value, np.asarray(weighted * np.float32(2 / target.size), np.float32)

    return of


def _around(points: Sequence[Sequence[float]], shape: tuple[int, ...], kernel_px: int) -> Bool[np.ndarray, "h w"]:
    """Return the pixels within a square of that side around a point."""
    mask = np.zeros(shape[:2], np.uint8)
    for x, y in points:
        mask[min(int(y), shape[0] - 1), min(int(x), shape[1] - 1)] = 1
    return cv2.dilate(mask, np.ones((kernel_px, kernel_px), np.uint8)) > 0


def _scale(image: np.ndarray, config: LossConfig) -> float:
    return max(image.shape[:2]) / config.reference_px


def _odd(pixels: float) -> int:
    return 2 * max(0, round((pixels - 1) / 2)) + 1


def _unit(photo: Photo) -> Image:
    return photo.astype(np.float32) / np.float32(255)


LOSSES: dict[str, Callable[[Photo, LossConfig], Loss]] = {
    "l1": _l1,
    "l2": _l2,
    "relative": _relative,
    "feature": _feature,
    "corner": _corner,
    "blur": _blur,
}
