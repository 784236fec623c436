"""Pictures for people: photo and render composed, matches drawn, numbers as colours. The only file with cv2.

Images are uint8 RGB. Pixel coordinates have the centre of the top-left pixel at (0.5, 0.5).
"""

from __future__ import annotations

import base64
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Float, Int32, UInt8

from viewer.match_geometry import MatchView

Overlay = Literal["blend", "checker", "difference"]
Mode = Literal["beside", Overlay, "flicker"]
MODES: tuple[Mode, ...] = get_args(Mode)
ColourBy = Literal["inlier", "residual"]

INLIER, OUTLIER, UNKNOWN = (70, 225, 120), (240, 70, 70), (150, 150, 150)
_RESIDUAL_PX = 0.5, 50.0
"""Ends of the colours of residuals, logarithmic between them."""
_RESIDUAL_RAMP = np.array([INLIER, (225, 225, 80), OUTLIER], np.float64)
# Dull blue to bright yellow, lightness rising all the way: readable on a dark ground and without hue.
_RAMP = np.array([(72, 84, 150), (44, 130, 165), (60, 175, 150), (150, 205, 90), (255, 225, 60)], np.float64)
_GAP_PX = 8
_TIP_PX = 12
_TILES = 10
"""Of a checkerboard, in a row."""
_WIDTH_PX, _HEIGHT_PX = 800, 1160
"""Of every picture, at most: twice what the docked window shows, for fine displays and for enlarging."""
_GROUND = (36, 36, 36)
"""viser's dark panels."""

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
    mode: Overlay,
    photo: UInt8[np.ndarray, "h w 3"],
    render: UInt8[np.ndarray, "a b 3"],
    weight: float = 0.5,
) -> UInt8[np.ndarray, "c d 3"]:
    """Return photo and render on top of one another; in a blend `weight` is the render's share, 0..1."""
    photo = _fitted(photo, _WIDTH_PX, _HEIGHT_PX)
    render = _resized(render, photo.shape[1], photo.shape[0])
    if mode == "blend":
        both = cv2.addWeighted(photo, 1 - weight, render, weight, 0)
    elif mode == "checker":
        rows, columns = np.indices(photo.shape[:2]) // max(1, photo.shape[1] // _TILES)
        both = np.where(((rows + columns) % 2 == 0)[..., None], photo, render)
    else:
        # Doubled: at the answer most differences are below a tenth of the range and would look black.
        both = np.minimum(cv2.absdiff(photo, render).astype(np.uint16) * 2, 255).astype(np.uint8)
    return _pasted((both, ((_WIDTH_PX - both.shape[1]) // 2, 0)))


def flicker_html(photo: UInt8[np.ndarray, "h w 3"], render: UInt8[np.ndarray, "a b 3"]) -> str:
    """Return HTML that shows photo and render in turn, once a second each; the browser does it alone."""
    photo = _fitted(photo, _WIDTH_PX, _HEIGHT_PX)
    render = _resized(render, photo.shape[1], photo.shape[0])
    below, above = (
        f"<img alt='{name}' src='{_data_url(image)}' style='width:100%;display:block;{style}'>"
        for name, image, style in (
            ("photo", photo, ""),
            ("render", render, "position:absolute;inset:0;animation:splatfix-flicker 1.4s steps(1) infinite"),
        )
    )
    return (
        "<style>@keyframes splatfix-flicker{0%{opacity:0}50%{opacity:1}100%{opacity:1}}</style>"
        f"<div class='splatfix-flicker' style='position:relative;margin:0 .6em .5em'>{below}{above}</div>"
    )


def _data_url(image: UInt8[np.ndarray, "h w 3"]) -> str:
    data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])[1]
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def match_colours(view: MatchView, by: ColourBy) -> UInt8[np.ndarray, "m 3"]:
    """Return a colour for each match: whether it agrees with the pose, or how far it is off."""
    if by == "inlier":
        return np.array([OUTLIER, INLIER], np.uint8)[view.inlier.astype(int)]
    low, high = np.log(_RESIDUAL_PX)
    share = (np.log(np.nan_to_num(view.residual_px, nan=1.0).clip(1e-6)) - low) / (high - low)
    colours = _interpolated(_RESIDUAL_RAMP, np.clip(share, 0, 1))
    colours[np.isnan(view.residual_px)] = UNKNOWN
    return colours


def beside(
    photo: UInt8[np.ndarray, "h w 3"],
    render: UInt8[np.ndarray, "a b 3"],
    view: MatchView | None = None,
    colours: UInt8[np.ndarray, "m 3"] | None = None,
) -> UInt8[np.ndarray, "c d 3"]:
    """Return photo and render with a line per match: outliers below, inliers above.

    The render is right of an upright photo, and under a wide one: so both are as large as the window allows.
    """
    if photo.shape[1] < 0.9 * photo.shape[0]:
        box = (_WIDTH_PX - _GAP_PX) // 2, _HEIGHT_PX
        a, b = _fitted(photo, *box), _fitted(render, *box)
        left = (_WIDTH_PX - a.shape[1] - _GAP_PX - b.shape[1]) // 2
        corners = (left, 0), (left + a.shape[1] + _GAP_PX, 0)
    else:
        box = _WIDTH_PX, (_HEIGHT_PX - _GAP_PX) // 2
        a, b = _fitted(photo, *box), _fitted(render, *box)
        corners = ((_WIDTH_PX - a.shape[1]) // 2, 0), ((_WIDTH_PX - b.shape[1]) // 2, a.shape[0] + _GAP_PX)
    pair = _pasted((a, corners[0]), (b, corners[1]))
    if view is None or colours is None:
        return pair
    k = view.render_camera.intrinsics
    # Not what lies outside, or behind the camera: NaN.
    within = np.all((view.render_px >= 0) & (view.render_px < [k.width, k.height]), axis=1)
    starts = view.photo_px * [a.shape[1] / photo.shape[1], a.shape[0] / photo.shape[0]] + corners[0]
    ends = view.render_px * [b.shape[1] / k.width, b.shape[0] / k.height] + corners[1]
    order = np.argsort(view.inlier, kind="stable")
    order = order[within[order]]
    both = np.stack([starts[order], ends[order]], axis=1)
    lines = pair.copy()
    for line, ink in zip(_fixed(both), colours[order].tolist(), strict=True):
        cv2.polylines(lines, [line], False, ink, 2, cv2.LINE_AA, _SHIFT)
    # Lines translucent, the more the denser: three hundred must not hide what they connect. The ends are plain.
    opacity = 0.3 + 0.4 / (1 + len(order) / 50)
    picture = cv2.addWeighted(pair, 1 - opacity, lines, opacity, 0)
    _dot(picture, both.reshape(-1, 2), np.repeat(colours[order], 2, axis=0))
    return picture


def flow(
    ground: UInt8[np.ndarray, "h w 3"], view: MatchView, colours: UInt8[np.ndarray, "m 3"]
) -> UInt8[np.ndarray, "c d 3"]:
    """Return all match vectors in the photo: arrows from where the render has a point to where the photo has it.

    `ground` is the photo, or what stands for it, in any size; it is dimmed.
    """
    k = view.photo_camera.intrinsics
    picture = _fitted(ground, _WIDTH_PX, _HEIGHT_PX)
    picture = cv2.cvtColor((0.45 * cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)).astype(np.uint8), cv2.COLOR_GRAY2RGB)
    scale = np.array([picture.shape[1] / k.width, picture.shape[0] / k.height])
    starts, ends = (view.photo_px - view.vectors_px) * scale, view.photo_px * scale
    lengths, inks = np.linalg.norm(ends - starts, axis=1), colours.tolist()
    drawn = (lengths > 3) & (lengths < 10 * _WIDTH_PX)
    pairs = _fixed(np.where(drawn[:, None, None], np.stack([starts, ends], axis=1), ends[:, None])).tolist()
    for i in np.argsort(view.inlier, kind="stable"):
        if drawn[i]:
            tip = min(0.5, _TIP_PX / lengths[i])
            start, end = pairs[i]
            cv2.arrowedLine(picture, start, end, inks[i], 2, cv2.LINE_AA, _SHIFT, tip)
        cv2.circle(picture, pairs[i][1], 3 << _SHIFT, inks[i], -1, cv2.LINE_AA, _SHIFT)
    return _pasted((picture, ((_WIDTH_PX - picture.shape[1]) // 2, 0)))


def score_colours(scores: Float[np.ndarray, "k"]) -> UInt8[np.ndarray, "k 3"]:
    """Return colours from dull blue (worst) to yellow (best); equal scores are all best."""
    spread = np.ptp(scores) if len(scores) else 0.0
    share = (scores - scores.min()) / spread if spread > 0 else np.ones(len(scores))
    return _interpolated(_RAMP, share)


def _interpolated(ramp: Float[np.ndarray, "s 3"], share: Float[np.ndarray, "k"]) -> UInt8[np.ndarray, "k 3"]:
    stops = np.linspace(0, 1, len(ramp))
    return np.stack([np.interp(share, stops, channel) for channel in ramp.T], -1).round().astype(np.uint8)


_DOT = np.argwhere(np.hypot(*np.mgrid[-3:4, -3:4]) < 3.3) - 3
"""Rows and columns of a dot's pixels from its middle."""
_SHIFT = 4
"""Fractional bits of OpenCV's drawing coordinates."""


def _fixed(points: Float[np.ndarray, "*k 2"]) -> Int32[np.ndarray, "*k 2"]:
    """To OpenCV's fixed point, whose top-left pixel centre is (0, 0)."""
    return ((points - 0.5) * (1 << _SHIFT)).round().astype(np.int32)


def _dot(
    picture: UInt8[np.ndarray, "h w 3"], centres: Float[np.ndarray, "k 2"], colours: UInt8[np.ndarray, "k 3"]
) -> None:
    """Put a dot on each centre, the last one on top. Of hundreds, OpenCV draws one at a time."""
    places = np.floor(centres).astype(int)[:, None, ::-1] + _DOT
    within = np.all((places >= 0) & (places < picture.shape[:2]), axis=2)
    row, column = places[within].T
    picture[row, column] = np.repeat(colours, within.sum(1), axis=0)


def _pasted(*parts: tuple[np.ndarray, tuple[int, int]]) -> UInt8[np.ndarray, "c d 3"]:
    """Put images at their (left, top) corners on a ground of the full width."""
    height = max(top + image.shape[0] for image, (_, top) in parts)
    ground = np.full((height, _WIDTH_PX, 3), _GROUND, np.uint8)
    for image, (left, top) in parts:
        ground[top : top + image.shape[0], left : left + image.shape[1]] = image
    return ground


def _fitted(image: UInt8[np.ndarray, "h w 3"], width: int, height: int) -> UInt8[np.ndarray, "a b 3"]:
    factor = min(width / image.shape[1], height / image.shape[0])
    return _resized(image, min(width, round(image.shape[1] * factor)), round(image.shape[0] * factor))


def _resized(image: UInt8[np.ndarray, "h w 3"], width: int, height: int) -> UInt8[np.ndarray, "a b 3"]:
    size = max(1, width), max(1, height)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if height < len(image) else cv2.INTER_LINEAR)
