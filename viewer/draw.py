"""Pictures for people: photo and render composed, matches drawn, numbers as colours. The only file with cv2.

Images are uint8 RGB. Pixel coordinates have the centre of the top-left pixel at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from service.types import MatchVectors

Mode = Literal["side by side", "blend", "difference"]
MODES: tuple[Mode, ...] = get_args(Mode)

INLIER, OUTLIER = (70, 225, 120), (240, 70, 70)
# Dull blue to bright yellow, lightness rising all the way: readable on a dark ground and without hue.
_RAMP = np.array([(72, 84, 150), (44, 130, 165), (60, 175, 150), (150, 205, 90), (255, 225, 60)], np.float64)
_GAP_PX = 4
_BOX_PX = (480, 560)
"""Width and height that one image of a pair may fill."""

cv2.setNumThreads(1)


def decode(data: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image in a JPEG, PNG or WebP. Raises ValueError if it is none."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB) if data else None
    if image is None:
        raise ValueError("not an image")
    return image


def reduced(image: UInt8[np.ndarray, "h w 3"], long_side: int) -> UInt8[np.ndarray, "a b 3"]:
    """Return the image with at most this long side."""
    factor = min(1.0, long_side / max(image.shape[:2]))
    return _resized(image, round(image.shape[1] * factor), round(image.shape[0] * factor))


def overlaid(
    mode: Literal["blend", "difference"],
    photo: UInt8[np.ndarray, "h w 3"],
    render: UInt8[np.ndarray, "a b 3"],
    weight: float = 0.5,
) -> UInt8[np.ndarray, "c d 3"]:
    """Return photo and render on top of one another; in a blend `weight` is the render's share, 0..1."""
    height = _common_height([photo], (2 * _BOX_PX[0], _BOX_PX[1]))
    photo = _with_height(photo, height)
    render = _resized(render, photo.shape[1], photo.shape[0])
    if mode == "blend":
        return cv2.addWeighted(photo, 1 - weight, render, weight, 0)
    # Doubled: at the answer most differences are below a tenth of the range and would look black.
    return np.minimum(cv2.absdiff(photo, render).astype(np.uint16) * 2, 255).astype(np.uint8)


def side_by_side(
    photo: UInt8[np.ndarray, "h w 3"], render: UInt8[np.ndarray, "a b 3"], matches: MatchVectors | None = None
) -> UInt8[np.ndarray, "c d 3"]:
    """Return photo and render, equally high, with a line per match: outliers below, inliers above."""
    height = _common_height([photo, render], _BOX_PX)
    left, right = _with_height(photo, height), _with_height(render, height)
    pair = np.concatenate([left, np.zeros((height, _GAP_PX, 3), np.uint8), right], 1)
    if matches is None:
        return pair
    k = matches.render_camera.intrinsics
    starts = matches.photo_px * [left.shape[1] / photo.shape[1], height / photo.shape[0]]
    ends = matches.render_px * [right.shape[1] / k.width, height / k.height] + [left.shape[1] + _GAP_PX, 0]
    lines = pair.copy()
    for i in np.argsort(matches.inlier, kind="stable"):
        colour = INLIER if matches.inlier[i] else OUTLIER
        a, b = _fixed(starts[i]), _fixed(ends[i])
        cv2.line(lines, a, b, colour, 1, cv2.LINE_AA, _SHIFT)
        for end in (a, b):
            cv2.circle(lines, end, 2 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
    # Translucent, so that three hundred lines don't hide what they connect.
    return cv2.addWeighted(pair, 0.35, lines, 0.65, 0)


def score_colours(scores: Float[np.ndarray, "k"]) -> UInt8[np.ndarray, "k 3"]:
    """Return colours from dull blue (worst) to yellow (best); equal scores are all best."""
    spread = np.ptp(scores) if len(scores) else 0.0
    share = (scores - scores.min()) / spread if spread > 0 else np.ones(len(scores))
    return ramp(share)


def ramp(share: Float[np.ndarray, "k"]) -> UInt8[np.ndarray, "k 3"]:
    """Return colours for values 0..1."""
    stops = np.linspace(0, 1, len(_RAMP))
    return np.stack([np.interp(share, stops, channel) for channel in _RAMP.T], -1).round().astype(np.uint8)


_SHIFT = 4
"""Fractional bits of OpenCV's drawing coordinates."""


def _fixed(point: Sequence[float] | np.ndarray) -> tuple[int, int]:
    """To OpenCV's fixed point, whose top-left pixel centre is (0, 0)."""
    x, y = (np.asarray(point) - 0.5) * (1 << _SHIFT)
    return round(float(x)), round(float(y))


def _common_height(images: Sequence[np.ndarray], box: tuple[int, int]) -> int:
    """Return the greatest height at which each image fits the box, enlarged at most twofold."""
    heights = [min(box[0] * im.shape[0] / im.shape[1], box[1], 2 * im.shape[0]) for im in images]
    return max(1, int(min(heights)))


def _with_height(image: UInt8[np.ndarray, "h w 3"], height: int) -> UInt8[np.ndarray, "a b 3"]:
    return _resized(image, round(image.shape[1] * height / image.shape[0]), height)


def _resized(image: UInt8[np.ndarray, "h w 3"], width: int, height: int) -> UInt8[np.ndarray, "a b 3"]:
    size = max(1, width), max(1, height)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if height < len(image) else cv2.INTER_LINEAR)
