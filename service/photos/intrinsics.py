"""A photo's intrinsics: parse them, check them against the photo, and undistort the photo to a pinhole."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from service.distortion import fisheye_radius, radial_radius
from service.errors import InvalidIntrinsics
from service.types import LENS_PRIORS, Intrinsics, IntrinsicsCorrection, Query

DISTORTION_COUNTS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 8,
    "SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2, "OPENCV_FISHEYE": 4,
}  # fmt: skip
"""COLMAP's camera models -> number of parameters after focal lengths and principal point."""
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


MAX_APPROXIMATE_FOCAL_PX = 1e6
"""Of a longest real lens it is some 1e5."""


def intrinsics_from(mapping: Mapping[str, Any]) -> Intrinsics:
    """Parse `{width, height, fx, fy, cx, cy, model?, distortion?, trust?}`. Raises InvalidIntrinsics with the field.

    `distortion` has COLMAP's parameters of `model` after the focal lengths and the principal point.
    """
    required, optional = ("width", "height", "fx", "fy", "cx", "cy"), ("model", "distortion", "trust")
    unknown = [key for key in mapping if key not in (*required, *optional)]
    if unknown:
        known = ", ".join((*required, *optional))
        raise InvalidIntrinsics(f"unknown; known: {known}.", where=str(unknown[0])[:40])
    for key in required:
        if key not in mapping:
            raise InvalidIntrinsics("is missing.", where=key)
    values = {key: _number(mapping[key], key) for key in required}
    for key in ("width", "height"):
        if values[key] != int(values[key]):
            raise InvalidIntrinsics(f"must be a whole number of pixels, is {values[key]}.", where=key)
    model = mapping.get("model", "PINHOLE")
    if not isinstance(model, str) or model not in DISTORTION_COUNTS:
        raise InvalidIntrinsics(
            f"unknown camera model {str(model)[:40]!r}; known: {', '.join(DISTORTION_COUNTS)}.",
            where="model",
        )
    distortion = mapping.get("distortion", ())
    if not isinstance(distortion, list | tuple) or len(distortion) != DISTORTION_COUNTS[model]:
        count = len(distortion) if isinstance(distortion, list | tuple) else "no list"
        raise InvalidIntrinsics(
            f"{model} has {DISTORTION_COUNTS[model]} parameters after the principal point, here are {count}.",
            where="distortion",
        )
    if model in ONE_FOCAL and values["fx"] != values["fy"]:
        raise InvalidIntrinsics(f"{model} has one focal length: fy must equal fx.", where="fy")
    trust = mapping.get("trust", "exact")
    # An estimate may be ten times as long, which has to be a focal length, too.
    if trust == "approximate" and max(values["fx"], values["fy"]) > MAX_APPROXIMATE_FOCAL_PX:
        raise InvalidIntrinsics(
            f"must be at most {MAX_APPROXIMATE_FOCAL_PX:g} pixels where it is approximate, is {values['fx']:g}.",
            where="fx",
        )
    return Intrinsics(
        width=int(values["width"]),
        height=int(values["height"]),
        **{key: values[key] for key in required[2:]},
        model=model,
        distortion=tuple(_number(v, "distortion") for v in distortion),
        trust=trust,
    )


ORIENTATIONS = {
    1: (False, False, False),
    2: (False, True, False),
    3: (False, True, True),
    4: (False, False, True),
    5: (True, False, False),
    6: (True, True, False),
    7: (True, True, True),
    8: (True, False, True),
}
"""EXIF orientation -> what makes a stored image upright: transpose, then mirror left-right, then mirror top-bottom."""
UPRIGHT, CLOCKWISE = ORIENTATIONS[1], ORIENTATIONS[6]


def oriented(intrinsics: Intrinsics, transpose: bool, mirror_x: bool, mirror_y: bool) -> Intrinsics:
    """Return the camera of an image that is transposed and then mirrored, left-right and top-bottom.

    Radial distortion stays as it is; the tangential coefficients p1 and p2, which COLMAP's models have after k1 and k2,
    change places and signs.
    """
    camera, changed = intrinsics, list(intrinsics.distortion)
    tangential = "FISHEYE" not in camera.model and len(changed) >= 4
    if transpose:
        camera = replace(
            camera,
            width=camera.height,
            height=camera.width,
            fx=camera.fy,
            fy=camera.fx,
            cx=camera.cy,
            cy=camera.cx,
        )
        if tangential:
            changed[2:4] = changed[3], changed[2]
    if mirror_x:
        camera = replace(camera, cx=camera.width - camera.cx)
        if tangential:
            changed[3] = -changed[3]
    if mirror_y:
        camera = replace(camera, cy=camera.height - camera.cy)
        if tangential:
            changed[2] = -changed[2]
    return replace(camera, distortion=tuple(changed))


def require_size(
    given: Intrinsics, width: int, height: int, upright_from_stored: tuple[bool, bool, bool] = UPRIGHT
) -> None:
    """Raise InvalidIntrinsics unless they are for an upright photo of this size.

    The error names what probably happened: turned (intrinsics of the camera's landscape buffer, or a photo that lost
    its EXIF orientation), resized, or cropped, as for a display; and has the intrinsics that fit then.
    `upright_from_stored` is how the photo was turned, as `oriented` takes it.
    """
    if (given.width, given.height) == (width, height):
        return
    expected = f"they are for {given.width} x {given.height}, the upright photo has {width} x {height}"
    is_turned = (given.width - given.height) * (width - height) < 0
    turn = upright_from_stored if upright_from_stored[0] else CLOCKWISE
    camera = oriented(given, *turn) if is_turned else given
    fitting = _cropped(camera, width, height)
    is_resized = abs(camera.width * height - camera.height * width) <= 0.01 * camera.width * height
    hints = []
    if is_turned:
        hints.append(_turned_hint(camera, upright_from_stored))
    if not is_resized:
        hints.append(
            f"The photo was cropped to another shape. If that was done about its centre, as for a display, send "
            f"{_as_json(fitting)}; of another part, not resized, keep fx and fy, and subtract its left and upper edge "
            "from cx and cy."
        )
    elif is_turned:
        hints.append(f"Send {_as_json(fitting)}.")
    else:
        hints.append(f"Scale all of them by the ratio of the widths: {_as_json(fitting)}.")
    what = "width and height are swapped: " if is_turned else ""
    raise InvalidIntrinsics(f"{what}{expected}.", where="intrinsics", hint=" ".join(hints))


def _turned_hint(camera: Intrinsics, upright_from_stored: tuple[bool, bool, bool]) -> str:
    if upright_from_stored[0]:
        return "They are of the camera's buffer, before the photo was turned by its EXIF orientation."
    other_way = oriented(camera, False, True, True)
    return (
        "Either they are of the camera's buffer, before it was turned upright, or the photo isn't upright, for it lost "
        "its EXIF orientation: turn it. The values below are for a buffer turned clockwise; for the other way mirror "
        f"the principal point ({other_way.cx:g}, {other_way.cy:g} at {camera.width} x {camera.height})."
    )


def _cropped(camera: Intrinsics, width: int, height: int) -> Intrinsics:
    """Return the camera of the image after it was scaled to cover this size, and cut to it about its centre."""
    factor = max(width / camera.width, height / camera.height)
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * factor,
        fy=camera.fy * factor,
        cx=width / 2 + (camera.cx - camera.width / 2) * factor,
        cy=height / 2 + (camera.cy - camera.height / 2) * factor,
    )


def _as_json(intrinsics: Intrinsics) -> str:
    """Return the JSON that `intrinsics_from` reads, rounded to hundredths of a pixel."""
    values: dict[str, Any] = {"width": intrinsics.width, "height": intrinsics.height}
    values |= {name: round(getattr(intrinsics, name), 2) for name in ("fx", "fy", "cx", "cy")}
    if intrinsics.model != "PINHOLE":
        values |= {"model": intrinsics.model, "distortion": list(intrinsics.distortion)}
    if intrinsics.trust != "exact":
        values["trust"] = intrinsics.trust
    return json.dumps(values)


def undistorted(
    image: UInt8[np.ndarray, "h w *channels"], intrinsics: Intrinsics
) -> tuple[UInt8[np.ndarray, "h w *channels"], Intrinsics, Bool[np.ndarray, "h w"] | None]:
    """Resample a distorted image to that of a pinhole with the same focal length, principal point and size.

    Returns the image (bicubic, black outside the photo), the pinhole's intrinsics, and the mask of pixels inside the
    photo; None if the camera has no distortion.
    """
    pinhole = replace(intrinsics, model="PINHOLE", distortion=())
    if not has_distortion(intrinsics):
        return image, pinhole, None
    x, y, inside = _undistortion(intrinsics)
    straight = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)
    straight[~inside] = 0  # bicubic interpolation bleeds across the border
    return straight, pinhole, inside


def distorted_pixels(
    points_in_camera: Float64[np.ndarray, "n 3"], intrinsics: Intrinsics
) -> Float64[np.ndarray, "n 2"]:
    """Return the pixels of points before the camera, seen through its lens."""
    coefficients = _coefficients(intrinsics)
    # OpenCV has the centre of the top-left pixel at (0, 0), this project at (0.5, 0.5).
    matrix = np.array([[intrinsics.fx, 0, intrinsics.cx - 0.5], [0, intrinsics.fy, intrinsics.cy - 0.5], [0, 0, 1]])
    points, still = points_in_camera.reshape(-1, 1, 3).astype(np.float64), np.zeros(3)
    if "FISHEYE" in intrinsics.model:
        px, _ = cv2.fisheye.projectPoints(points, still, still, matrix, coefficients)
    else:
        px, _ = cv2.projectPoints(points, still, still, matrix, coefficients)
    return np.asarray(px, np.float64).reshape(-1, 2) + 0.5


def undistorted_points(photo_px: Float32[np.ndarray, "n 2"], intrinsics: Intrinsics) -> Float32[np.ndarray, "n 2"]:
    """Return where pixels of a photo are in the image that `undistorted` makes of it.

    For radial distortion with one coefficient, the first of `distortion`: by Newton's method on the radius.
    """
    k1 = intrinsics.distortion[0]
    centre, focal = np.array([intrinsics.cx, intrinsics.cy]), np.array([intrinsics.fx, intrinsics.fy])
    distorted = (photo_px - centre) / focal
    radius = np.linalg.norm(distorted, axis=1)
    undistorted_radius = radius.copy()
    # Beyond the radius at which the distortion stops growing there is no solution: the slope is kept positive.
    for _ in range(8):
        square = undistorted_radius**2
        slope = np.maximum(1.0 + 3.0 * k1 * square, 0.1)
        undistorted_radius -= (undistorted_radius * (1.0 + k1 * square) - radius) / slope
        undistorted_radius = np.clip(undistorted_radius, 0.0, 3.0 * radius)
    factor = np.where(radius > 1e-9, undistorted_radius / np.maximum(radius, 1e-9), 1.0)
    return (centre + focal * distorted * factor[:, None]).astype(np.float32)


def undistorted_query(query: Query, correction: IntrinsicsCorrection) -> Query:
    """Return the query with corrected intrinsics, its pixels without the correction's distortion."""
    corrected = query.corrected(correction)
    if not correction.k1:
        return corrected
    camera = replace(corrected.intrinsics, model="OPENCV", distortion=(correction.k1, 0.0, 0.0, 0.0))
    rgb, _, inside = undistorted(query.rgb, camera)
    if inside is not None and query.valid_mask is not None:
        inside = inside & (undistorted(query.valid_mask.astype(np.uint8), camera)[0] > 0)
    return replace(corrected, rgb=rgb, valid_mask=inside)


def has_distortion(intrinsics: Intrinsics) -> bool:
    """Return whether the camera is no pinhole."""
    return "FISHEYE" in intrinsics.model or any(intrinsics.distortion)


def taken_through(query: Query, lens: Intrinsics) -> Query:
    """Return the query of the same photo, whose pinhole was assumed, with this lens of the whole upright photo.

    Its pixels are undistorted; what is left to estimate has the prior of a fisheye.
    """
    photo, shown = query.photo_intrinsics, query.intrinsics
    # The map from the photo's pixels to the query's.
    sx, sy = shown.fx / photo.fx, shown.fy / photo.fy
    camera = replace(
        lens,
        width=shown.width,
        height=shown.height,
        fx=lens.fx * sx,
        fy=lens.fy * sy,
        cx=shown.cx + (lens.cx - photo.cx) * sx,
        cy=shown.cy + (lens.cy - photo.cy) * sy,
    )
    rgb, pinhole, inside = undistorted(query.rgb, camera)
    if inside is not None and query.valid_mask is not None:
        inside = inside & (undistorted(query.valid_mask.astype(np.uint8), camera)[0] > 0)
    return replace(
        query,
        rgb=rgb,
        intrinsics=pinhole,
        intrinsics_source="fisheye",
        photo_intrinsics=lens,
        valid_mask=None if inside is None or inside.all() else inside,
        lens_prior=LENS_PRIORS["fisheye"],
    )


@lru_cache(maxsize=4)
def _undistortion(
    intrinsics: Intrinsics,
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the photo's pixel (x, y) for each pixel of the pinhole, and whether it has one. Cached: cameras repeat."""
    pinhole, fisheye = replace(intrinsics, model="PINHOLE", distortion=()), "FISHEYE" in intrinsics.model
    coefficients = _coefficients(intrinsics)
    # OpenCV has the centre of the top-left pixel at (0, 0), this project at (0.5, 0.5).
    matrix = np.array([[pinhole.fx, 0, pinhole.cx - 0.5], [0, pinhole.fy, pinhole.cy - 0.5], [0, 0, 1]])
    make_maps = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    size = (pinhole.width, pinhole.height)
    x, y = make_maps(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1)
    inside = (x > -0.5) & (y > -0.5) & (x < pinhole.width - 0.5) & (y < pinhole.height - 0.5)
    return x, y, inside & ~_folded(pinhole, coefficients, fisheye)


def _coefficients(intrinsics: Intrinsics) -> Float64[np.ndarray, "k"]:
    coefficients = np.zeros(4 if "FISHEYE" in intrinsics.model else 8)  # cv2's order is COLMAP's: k1 k2 p1 p2 k3 ... k6
    coefficients[: len(intrinsics.distortion)] = intrinsics.distortion
    return coefficients


def _folded(pinhole: Intrinsics, coefficients: Float64[np.ndarray, "k"], fisheye: bool) -> Bool[np.ndarray, "h w"]:
    """Return the mask of pixels beyond the radius at which the distortion's polynomial stops growing.

    There it would show the inside of the image a second time.
    """
    x = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.fx
    y = (np.arange(pinhole.height) + 0.5 - pinhole.cy) / pinhole.fy
    radius = np.linspace(0.0, np.hypot(np.abs(x).max(), np.abs(y).max()), 1025)
    # Sampled, not solved: a thousandth of the image's diagonal is exact enough for a mask.
    turns = np.flatnonzero(np.diff((fisheye_radius if fisheye else radial_radius)(radius, coefficients)) <= 0)
    reach = radius[turns[0]] if len(turns) else np.inf
    return x[None] ** 2 + y[:, None] ** 2 > reach**2


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InvalidIntrinsics(f"must be a number, is {str(value)[:40]!r}.", where=where)
    if not abs(value) < 1e12:  # also nan
        raise InvalidIntrinsics(f"must be a finite number, is {str(value)[:40]}.", where=where)
    return float(value)
