"""The six photometric losses of the supplement (section F) between a render I and the photo Q, with d loss / d I.

Over the n values of the picture (pixels times channels, sRGB in 0..1):

    l1        mean |I - Q|
    l2        mean (I - Q)^2
    relative  mean (I - Q)^2 / (I'^2 + 0.01)          I' = I held constant
    feature   l2 + 0.7    mean over F of (I - Q)^2    F: interest regions, feature points of Q dilated 3 x 5 px
    corner    l2 + 7.5e-5 sum over C of (I - Q)^2     C: Shi-Tomasi corners of Q dilated with a kernel of 51 px
    blur      l2 + 0.8    mean (G I - G Q)^2          G: Gaussian blur with sigma 5 px

From the supplement: the six, "applied on top of the L2 loss", and the numbers. Ours, because it is silent: the form of
the relative loss (Instant-NGP's); SIFT points as features, as iNeRF's code takes them; the *sum* for corners (with a
mean, 7.5e-5 would be nothing); kernel and sigma are taken for a long side of 800 px and scaled with the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from service.errors import UnknownName

RELATIVE_FLOOR = 0.01
FEATURE_WEIGHT, CORNER_WEIGHT, BLUR_WEIGHT = 0.7, 7.5e-5, 0.8
CORNER_KERNEL_PX, BLUR_SIGMA_PX = 51.0, 5.0
REFERENCE_PX = 800
CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX = 200, 0.01, 10

Image = Float32[np.ndarray, "h w 3"]


@dataclass(frozen=True, slots=True)
class Loss:
    """A loss against one photo, ready for any number of renders of its size."""

    of: Callable[[Image], tuple[float, Image]]
    """Value and d value / d render."""

    def __call__(self, render: Image) -> tuple[float, Image]:
        return self.of(render)


def loss_against(name: str, photo: UInt8[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"] | None = None) -> Loss:
    """Return the loss against a photo; where it is unknown, any render is right. Raises UnknownName."""
    made = _maker(name)(photo)
    if known is None:
        return Loss(made)
    target, weight = _unit(photo), known[..., None]

    def of(render: Image) -> tuple[float, Image]:
        value, gradient = made(np.where(weight, render, target))
        return value, gradient * weight

    return Loss(of)


def require_loss(name: str) -> None:
    """Raise UnknownName unless there is such a loss."""
    _maker(name)


def _maker(name: str) -> Callable[[UInt8[np.ndarray, "h w 3"]], Callable[[Image], tuple[float, Image]]]:
    if name not in LOSSES:
        raise UnknownName(f"there is no loss '{name}'; known: {', '.join(LOSSES)}.", where="loss")
    return LOSSES[name]


def interest_region(photo: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Return iNeRF's interest regions: feature points, dilated three times by 5 x 5."""
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    keypoints = cv2.SIFT.create().detect(gray, None)
    points = [(float(k.pt[0]), float(k.pt[1])) for k in keypoints]
    return _around(points, gray.shape, 13)  # three dilations by 5 are one by 13


def _l1(photo: UInt8[np.ndarray, "h w 3"]) -> Callable[[Image], tuple[float, Image]]:
    target = _unit(photo)

    def of(render: Image) -> tuple[float, Image]:
        difference = render - target
        return float(np.abs(difference).mean()), np.sign(difference) / np.float32(difference.size)

    return of


def _l2(photo: UInt8[np.ndarray, "h w 3"]) -> Callable[[Image], tuple[float, Image]]:
    return _weighted(photo, np.float32(1.0))


def _relative(photo: UInt8[np.ndarray, "h w 3"]) -> Callable[[Image], tuple[float, Image]]:
    target = _unit(photo)

    def of(render: Image) -> tuple[float, Image]:
        difference = render - target
        over = 1 / (render * render + np.float32(RELATIVE_FLOOR))
        return float((difference * difference * over).mean()), 2 * difference * over / np.float32(difference.size)

    return of


def _feature(photo: UInt8[np.ndarray, "h w 3"]) -> Callable[[Image], tuple[float, Image]]:
    region = interest_region(photo)
    extra = FEATURE_WEIGHT * region * (region.size / max(int(region.sum()), 1))
    return _weighted(photo, (1 + extra[..., None]).astype(np.float32))


def _corner(photo: UInt8[np.ndarray, "h w 3"]) -> Callable[[Image], tuple[float, Image]]:
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    found = cv2.goodFeaturesToTrack(gray, CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX)
    points = [] if found is None else [tuple(point) for point in found.reshape(-1, 2)]
    region = _around(points, gray.shape, _odd(CORNER_KERNEL_PX * _scale(gray)))
    extra = CORNER_WEIGHT * 3 * region.size * region  # times the mean over 3 * size values: the sum
    return _weighted(photo, (1 + extra[..., None]).astype(np.float32))


def _blur(photo: UInt8[np.ndarray, "h w 3"]) -> Callable[[Image], tuple[float, Image]]:
    target, sigma = _unit(photo), BLUR_SIGMA_PX * _scale(photo)

    def blurred(image: Image) -> Image:
        # Zero outside: symmetric, so the blur is its own adjoint.
        return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), np.float32)

    def of(render: Image) -> tuple[float, Image]:
        difference = render - target
        smooth = blurred(difference)
        value = float((difference**2).mean() + BLUR_WEIGHT * (smooth**2).mean())
        return value, (difference + np.float32(BLUR_WEIGHT) * blurred(smooth)) * np.float32(2 / difference.size)

    return of


def _weighted(
    photo: UInt8[np.ndarray, "h w 3"], weights: Float32[np.ndarray, "h w 1"] | np.float32
) -> Callable[[Image], tuple[float, Image]]:
    """Mean of weights times squared differences."""
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


def _scale(image: np.ndarray) -> float:
    return max(image.shape[:2]) / REFERENCE_PX


def _odd(pixels: float) -> int:
    return 2 * max(0, round((pixels - 1) / 2)) + 1


def _unit(photo: UInt8[np.ndarray, "h w 3"]) -> Image:
    return photo.astype(np.float32) / np.float32(255)


LOSSES: dict[str, Callable[[UInt8[np.ndarray, "h w 3"]], Callable[[Image], tuple[float, Image]]]] = {
    "l1": _l1,
    "l2": _l2,
    "relative": _relative,
    "feature": _feature,
    "corner": _corner,
    "blur": _blur,
}
