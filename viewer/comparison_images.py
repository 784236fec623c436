"""Photo and render composed for comparison, and match vectors drawn over them. The only file with cv2.

Images are uint8 RGB. The centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

import base64
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Float, Float64, Int32, UInt8

from service.types import Camera, Intrinsics
from viewer.match_geometry import MatchView

Overlay = Literal["blend", "checker", "difference"]
Mode = Literal["side by side", Overlay, "flicker"]
MODES: tuple[Mode, ...] = get_args(Mode)

_WIDTH_PX, _HEIGHT_PX = 800, 1160
"""Largest size of any composed image: twice what the docked window shows, for dense displays and for enlarging."""
_GAP_PX = 8
_ARROW_TIP_PX = 12
_CHECKER_COLUMNS = 10
_BACKGROUND = (36, 36, 36)
"""The colour of viser's dark panels."""
_SHIFT = 4
"""Fractional bits of OpenCV's drawing coordinates."""
_DOT_OFFSETS = np.argwhere(np.hypot(*np.mgrid[-3:4, -3:4]) < 3.3) - 3
"""Rows and columns of a dot's pixels relative to its centre."""

# The cores are the service's.
cv2.setNumThreads(1)


def decode(data: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image in a JPEG, PNG or WebP file. Raises ValueError if it can't be decoded."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB) if data else None
    if image is None:
        raise ValueError("not an image")
    return image


def shrink(image: UInt8[np.ndarray, "h w 3"], long_side: int) -> UInt8[np.ndarray, "a b 3"]:
    """Return the image with its longer side at most `long_side` px."""
    factor = min(1.0, long_side / max(image.shape[:2]))
    return _resize(image, round(image.shape[1] * factor), round(image.shape[0] * factor))


def undistorted(photo: UInt8[np.ndarray, "h w 3"], camera: Intrinsics, k1: float) -> UInt8[np.ndarray, "h w 3"]:
    """Return a photo without its radial distortion `k1`, as the pinhole `camera` sees it; black beside the photo."""
    return cv2.undistort(photo, _matrix(camera), np.array([k1, 0.0, 0.0, 0.0])).astype(np.uint8)


def with_photo(
    image: UInt8[np.ndarray, "h w 3"],
    view: Camera,
    photo: UInt8[np.ndarray, "a b 3"],
    camera: Camera,
    opacity: float,
) -> UInt8[np.ndarray, "h w 3"]:
    """Return a view's image with a photo over it that was taken from the view's position.

    The photo is warped by the homography between the pinholes `view` and `camera`, of the sizes of image and photo, so
    that it keeps its own aspect. `opacity`: the photo's, 0..1.
    """
    turn = view.pose.world_from_camera[:3, :3].T @ camera.pose.world_from_camera[:3, :3]
    homography = _matrix(view.intrinsics) @ turn @ np.linalg.inv(_matrix(camera.intrinsics))
    size = image.shape[1], image.shape[0]
    inside = cv2.warpPerspective(np.full(photo.shape[:2], 255, np.uint8), homography, size)
    share = (opacity / 255 * inside)[..., None]
    warped = cv2.warpPerspective(photo, homography, size)
    return ((1 - share) * image + share * warped).round().astype(np.uint8)


def _matrix(camera: Intrinsics) -> Float64[np.ndarray, "3 3"]:
    # OpenCV's centre of the top-left pixel is (0, 0).
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]], np.float64)


def overlay(
    mode: Overlay,
    photo: UInt8[np.ndarray, "h w 3"],
    render: UInt8[np.ndarray, "a b 3"],
    weight: float = 0.5,
) -> UInt8[np.ndarray, "c d 3"]:
    """Return photo and render in one image: blended, in alternating tiles, or their absolute difference.

    `weight`: the render's share in a blend, 0..1. The render is resized to the photo.
    """
    photo = _fit(photo, _WIDTH_PX, _HEIGHT_PX)
    render = _resize(render, photo.shape[1], photo.shape[0])
    if mode == "blend":
        both = cv2.addWeighted(photo, 1 - weight, render, weight, 0)
    elif mode == "checker":
        rows, columns = np.indices(photo.shape[:2]) // max(1, photo.shape[1] // _CHECKER_COLUMNS)
        both = np.where(((rows + columns) % 2 == 0)[..., None], photo, render)
    else:
        # Doubled: at the final pose most differences are below a tenth of the range and would look black.
        both = np.minimum(cv2.absdiff(photo, render).astype(np.uint16) * 2, 255).astype(np.uint8)
    return _paste((both, ((_WIDTH_PX - both.shape[1]) // 2, 0)))


def flicker_html(photo: UInt8[np.ndarray, "h w 3"], render: UInt8[np.ndarray, "a b 3"]) -> str:
    """Return HTML in which photo and render alternate by a CSS animation, 0.7 s each."""
    photo = _fit(photo, _WIDTH_PX, _HEIGHT_PX)
    render = _resize(render, photo.shape[1], photo.shape[0])
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


def side_by_side(
    photo: UInt8[np.ndarray, "h w 3"],
    render: UInt8[np.ndarray, "a b 3"],
    view: MatchView | None = None,
    colours: UInt8[np.ndarray, "m 3"] | None = None,
) -> UInt8[np.ndarray, "c d 3"]:
    """Return photo and render with a line per match, outliers below inliers.

    The render is right of an upright photo and under a wide one, whichever shows both larger.
    """
    # The window is 800 x 1160 px: there two images are larger side by side only if they are upright.
    if photo.shape[1] < 0.9 * photo.shape[0]:
        box = (_WIDTH_PX - _GAP_PX) // 2, _HEIGHT_PX
        a, b = _fit(photo, *box), _fit(render, *box)
        left = (_WIDTH_PX - a.shape[1] - _GAP_PX - b.shape[1]) // 2
        corners = (left, 0), (left + a.shape[1] + _GAP_PX, 0)
    else:
        box = _WIDTH_PX, (_HEIGHT_PX - _GAP_PX) // 2
        a, b = _fit(photo, *box), _fit(render, *box)
        corners = ((_WIDTH_PX - a.shape[1]) // 2, 0), ((_WIDTH_PX - b.shape[1]) // 2, a.shape[0] + _GAP_PX)
    pair = _paste((a, corners[0]), (b, corners[1]))
    if view is None or colours is None:
        return pair
    k = view.render_camera.intrinsics
    # Matches outside of the render, or behind its camera (NaN), have no line.
    within = np.all((view.render_px >= 0) & (view.render_px < [k.width, k.height]), axis=1)
    starts = view.photo_px * [a.shape[1] / photo.shape[1], a.shape[0] / photo.shape[0]] + corners[0]
    ends = view.render_px * [b.shape[1] / k.width, b.shape[0] / k.height] + corners[1]
    order = np.argsort(view.inlier, kind="stable")
    order = order[within[order]]
    return _draw_lines(pair, np.stack([starts[order], ends[order]], axis=1), colours[order])


def _draw_lines(
    image: UInt8[np.ndarray, "h w 3"], segments: Float[np.ndarray, "k 2 2"], colours: UInt8[np.ndarray, "k 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image with translucent lines whose ends are opaque dots."""
    lines = image.copy()
    for line, colour in zip(_fixed_point(segments), colours.tolist(), strict=True):
        cv2.polylines(lines, [line], False, colour, 2, cv2.LINE_AA, _SHIFT)
    # The more lines, the more translucent: three hundred would hide what they connect.
    opacity = 0.3 + 0.4 / (1 + len(segments) / 50)
    image = cv2.addWeighted(image, 1 - opacity, lines, opacity, 0)
    _draw_dots(image, segments.reshape(-1, 2), np.repeat(colours, 2, axis=0))
    return image


def match_vectors_image(
    background: UInt8[np.ndarray, "h w 3"], view: MatchView, colours: UInt8[np.ndarray, "m 3"]
) -> UInt8[np.ndarray, "c d 3"]:
    """Return the match vectors as arrows over the photo, from the render's point to the photo's.

    `background` is the photo, or a render in its place, of any size; it is drawn dark and grey.
    """
    k = view.photo_camera.intrinsics
    image = _fit(background, _WIDTH_PX, _HEIGHT_PX)
    image = cv2.cvtColor((0.45 * cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).astype(np.uint8), cv2.COLOR_GRAY2RGB)
    # The background may have another size than the photo that the matches refer to.
    scale = np.array([image.shape[1] / k.width, image.shape[0] / k.height])
    starts, ends = (view.photo_px - view.vectors_px) * scale, view.photo_px * scale
    lengths, inks = np.linalg.norm(ends - starts, axis=1), colours.tolist()
    # Shorter ones would be covered by their dot, longer ones come from points beside the camera plane.
    drawn = (lengths > 3) & (lengths < 10 * _WIDTH_PX)
    pairs = _fixed_point(np.where(drawn[:, None, None], np.stack([starts, ends], axis=1), ends[:, None])).tolist()
    # Inliers last, on top of outliers.
    for i in np.argsort(view.inlier, kind="stable"):
        if drawn[i]:
            tip = min(0.5, _ARROW_TIP_PX / lengths[i])
            start, end = pairs[i]
            cv2.arrowedLine(image, start, end, inks[i], 2, cv2.LINE_AA, _SHIFT, tip)
        cv2.circle(image, pairs[i][1], 3 << _SHIFT, inks[i], -1, cv2.LINE_AA, _SHIFT)
    return _paste((image, ((_WIDTH_PX - image.shape[1]) // 2, 0)))


def _fixed_point(points: Float[np.ndarray, "*k 2"]) -> Int32[np.ndarray, "*k 2"]:
    """Return pixels as OpenCV's fixed-point coordinates, in which the top-left pixel's centre is (0, 0)."""
    return ((points - 0.5) * (1 << _SHIFT)).round().astype(np.int32)


def _draw_dots(
    image: UInt8[np.ndarray, "h w 3"], centres: Float[np.ndarray, "k 2"], colours: UInt8[np.ndarray, "k 3"]
) -> None:
    """Draw a dot on each centre, the last one on top; vectorized, as OpenCV draws only one a call."""
    places = np.floor(centres).astype(int)[:, None, ::-1] + _DOT_OFFSETS
    within = np.all((places >= 0) & (places < image.shape[:2]), axis=2)
    row, column = places[within].T
    image[row, column] = np.repeat(colours, within.sum(1), axis=0)


def _paste(*parts: tuple[np.ndarray, tuple[int, int]]) -> UInt8[np.ndarray, "c d 3"]:
    """Return images at their (left, top) corners on a background of the full width."""
    height = max(top + image.shape[0] for image, (_, top) in parts)
    whole = np.full((height, _WIDTH_PX, 3), _BACKGROUND, np.uint8)
    for image, (left, top) in parts:
        whole[top : top + image.shape[0], left : left + image.shape[1]] = image
    return whole


def _fit(image: UInt8[np.ndarray, "h w 3"], width: int, height: int) -> UInt8[np.ndarray, "a b 3"]:
    factor = min(width / image.shape[1], height / image.shape[0])
    return _resize(image, min(width, round(image.shape[1] * factor)), round(image.shape[0] * factor))


def _resize(image: UInt8[np.ndarray, "h w 3"], width: int, height: int) -> UInt8[np.ndarray, "a b 3"]:
    size = max(1, width), max(1, height)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if height < len(image) else cv2.INTER_LINEAR)
