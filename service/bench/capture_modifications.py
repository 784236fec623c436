"""Modifications of a bench's photo by light, motion, sensor and screen; the camera stays, but for a screenshot's bars.

Light is changed in linear light, taken as the 2.2nd power of the sRGB values.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from service.bench.modified_photo import Change, Photo

GAMMA = 2.2
READ_NOISE = 0.02
"""Signal at which a sensor's constant noise equals that of the signal; 0..1, linear."""
SMEAR_PX = 2.0
"""Standard deviation of a phone's denoising, in pixels of a photo with a long side of 800."""


def _relit(photo: Photo, gain: Float64[np.ndarray, "..."]) -> Photo:
    """Multiply the linear light by a gain for each pixel or channel; too bright is clipped."""
    linear = photo.rgb.astype(np.float64) ** GAMMA * gain
    return replace(photo, rgb=(np.clip(linear, 0, 1) ** (1 / GAMMA)).astype(np.float32))


def _places(photo: Photo) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
    """Return x and y of each pixel from the image's middle, in long sides."""
    height, width = photo.rgb.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    side = max(width, height)
    return (columns + 0.5 - width / 2) / side, (rows + 0.5 - height / 2) / side


def vignetting(photo: Photo, share: float, rng: np.random.Generator) -> Photo:
    """Darken towards the corners by the square of the radius, there by `share`."""
    x, y = _places(photo)
    radius = np.hypot(x, y)
    return _relit(photo, (1 - share * (radius / radius.max()) ** 2)[..., None])


def local_light(photo: Photo, strength: float, rng: np.random.Generator) -> Photo:
    """Light parts of the photo otherwise: four smooth coloured regions, brighter or darker by up to e^strength, and a
    shadow with a hard edge, darker by e^-strength and bluish.
    """
    x, y = _places(photo)
    log_gain = np.zeros(photo.rgb.shape, np.float64)
    for sign in (1, -1, 1, -1):
        centre, radius = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.15, 0.4)
        region = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * radius**2))
        log_gain += sign * strength * region[..., None] * (1 + 0.3 * rng.uniform(-1, 1, 3))
    angle, offset = rng.uniform(0, 2 * np.pi), rng.uniform(-0.2, 0.2)
    shaded = x * np.cos(angle) + y * np.sin(angle) > offset
    # Shadows are lit by the sky.
    log_gain -= strength * shaded[..., None] * np.array([1.1, 1.0, 0.9])
    return _relit(photo, np.exp(log_gain))


def colour_cast(photo: Photo, strength: float, rng: np.random.Generator) -> Photo:
    """Colour the light: the channels' logarithms change by a random direction of this length that keeps their mean."""
    direction = rng.normal(size=3)
    direction -= direction.mean()
    return _relit(photo, np.exp(strength * direction / np.linalg.norm(direction)))


def motion_blur(photo: Photo, length: float, rng: np.random.Generator) -> Photo:
    """Average along a line of this length (pixels at a long side of 800) in a random direction.

    The pose is that of the middle of the exposure.
    """
    length = length * photo.intrinsics.long_side / 800
    angle, reach = rng.uniform(0, np.pi), int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for step in np.linspace(-length / 2, length / 2, 8 * reach + 1):
        x, y = reach + step * np.cos(angle), reach + step * np.sin(angle)
        left, top = int(x), int(y)
        right, bottom = x - left, y - top
        weights = np.outer([1 - bottom, bottom], [1 - right, right])
        area = kernel[top : top + 2, left : left + 2]
        area += weights[: area.shape[0], : area.shape[1]].astype(np.float32)
    blurred = cv2.filter2D(photo.rgb, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    return replace(photo, rgb=np.asarray(blurred, np.float32))


def phone_noise(photo: Photo, sigma: float, rng: np.random.Generator) -> Photo:
    """Add a sensor's noise, whose variance grows with the signal (`sigma` at full signal, linear), then smear it.

    The smear is that of a phone's denoising: a bilateral filter, stronger where the noise is.
    """
    linear = photo.rgb.astype(np.float64) ** GAMMA
    noisy = linear + sigma * np.sqrt(linear + READ_NOISE) * rng.normal(size=linear.shape)
    encoded = (np.clip(noisy, 0, 1) ** (1 / GAMMA)).astype(np.float32)
    smear = SMEAR_PX * photo.intrinsics.long_side / 800
    # Differences as small as the noise are smoothed, larger ones are edges.
    smooth = cv2.bilateralFilter(encoded, 0, 2 * sigma, smear)
    return replace(photo, rgb=np.clip(np.asarray(smooth, np.float32), 0, 1))


def letterbox(photo: Photo, share: float, rng: np.random.Generator) -> Photo:
    """Put black bars above and below, which are `share` of the new height: a screenshot."""
    return _framed(photo, 0, round(photo.intrinsics.height * share / (1 - share) / 2), 0.0)


def white_bars(photo: Photo, share: float, rng: np.random.Generator) -> Photo:
    """Put white bars on all sides, which are `share` of the new width and height."""
    width, height = photo.intrinsics.width, photo.intrinsics.height
    beside, above = (round(side * share / (1 - share) / 2) for side in (width, height))
    return _framed(photo, beside, above, 1.0)


def _framed(photo: Photo, beside: int, above: int, value: float) -> Photo:
    """Add bars of one brightness left and right, above and below."""
    old = photo.intrinsics
    camera = replace(
        old, width=old.width + 2 * beside, height=old.height + 2 * above, cx=old.cx + beside, cy=old.cy + above
    )
    around = ((above, above), (beside, beside))
    rgb: Float32[np.ndarray, "_ _ 3"] = np.pad(photo.rgb, (*around, (0, 0)), constant_values=value)
    # Nothing tells that they don't belong to the photo.
    mask = None if photo.mask is None else np.pad(photo.mask, around, constant_values=True)
    return replace(photo, rgb=rgb, mask=mask, intrinsics=camera, focal_as_taken=photo.focal_of_whole)


CAPTURE_MODIFICATIONS: dict[str, tuple[float, float, Change]] = {
    "vignetting": (0.0, 0.95, vignetting),
    "local_light": (0.0, 3.0, local_light),
    "colour_cast": (0.0, 2.0, colour_cast),
    "motion_blur": (0.0, 50.0, motion_blur),
    "phone_noise": (0.0, 1.0, phone_noise),
    "letterbox": (0.0, 0.8, letterbox),
    "white_bars": (0.0, 0.8, white_bars),
}
"""As `modifications.MODIFICATIONS`."""
