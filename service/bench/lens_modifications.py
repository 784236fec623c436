"""Modifications of a bench's photo that are those of another lens, of a crop, or of a rolling shutter.

The photo is resampled as the other camera would have taken it, and cut to the pixels that it has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from service.bench.modified_photo import Change, Photo, resampled_within
from service.errors import InvalidOptions
from service.types import Intrinsics

READOUT_S = 0.02
"""Time in which a rolling shutter reads the whole photo."""
MIN_SLOPE = 0.2
"""Least derivative of the distorted radius; at 0 a lens shows the same twice."""
Radii = Float64[np.ndarray, "..."]


def radial(photo: Photo, k1: float, rng: np.random.Generator) -> Photo:
    """Distort radially: r becomes r (1 + k1 r^2), in focal lengths (COLMAP's SIMPLE_RADIAL)."""

    def undistorted(distorted: Radii) -> Radii:
        radius = distorted
        # Newton's method; the distortion is mild, so that a few steps reach float64's precision.
        for _ in range(20):
            radius = radius - (radius * (1 + k1 * radius**2) - distorted) / (1 + 3 * k1 * radius**2)
        return radius

    camera = photo.intrinsics
    wide = max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy
    # The derivative of the distorted radius at the corners.
    if 1 + 3 * k1 * (wide[0] ** 2 + wide[1] ** 2) < MIN_SLOPE:
        raise InvalidOptions(f"k1 = {k1:g} would fold the corners of a photo as wide as this.", where="modify")
    return _through_lens(photo, undistorted, "SIMPLE_RADIAL", (k1,))


def fisheye(photo: Photo, strength: float, rng: np.random.Generator) -> Photo:
    """Take the photo through an equidistant fisheye: the radius is the angle (OPENCV_FISHEYE without coefficients)."""
    return _through_lens(photo, lambda angle: np.tan(np.minimum(angle, 1.5)), "OPENCV_FISHEYE", (0.0, 0.0, 0.0, 0.0))


def _through_lens(
    photo: Photo, undistorted: Callable[[Radii], Radii], model: str, distortion: tuple[float, ...]
) -> Photo:
    """Return the photo with a radial distortion; `undistorted` maps radii, in focal lengths, back."""
    old = require_pinhole(photo)
    # The models have one focal length.
    focal = float(np.sqrt(old.fx * old.fy))

    def source_of(x: Radii, y: Radii) -> tuple[Radii, Radii]:
        x, y = (x - old.cx) / focal, (y - old.cy) / focal
        radius = np.hypot(x, y)
        factor = undistorted(radius) / np.maximum(radius, 1e-12)
        return x * factor * old.fx + old.cx, y * factor * old.fy + old.cy

    camera = replace(old, fx=focal, fy=focal, model=model, distortion=distortion)
    return resampled_within(photo, source_of, camera)


def require_pinhole(photo: Photo) -> Intrinsics:
    """Return the camera. Raises InvalidOptions if it isn't a pinhole."""
    if photo.intrinsics.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise InvalidOptions(
            f"the photo is one of a {photo.intrinsics.model} camera already: it can only be changed before that.",
            where="modify",
        )
    return photo.intrinsics


def off_centre(photo: Photo, share: float, rng: np.random.Generator) -> Photo:
    """Keep `share` of width and height, at a corner."""
    old = photo.intrinsics
    width, height = max(1, round(old.width * share)), max(1, round(old.height * share))
    right, bottom = rng.integers(0, 2, 2)
    return photo.cut(int(right) * (old.width - width), int(bottom) * (old.height - height), width, height)


def zoom(photo: Photo, factor: float, rng: np.random.Generator) -> Photo:
    """Zoom digitally: keep the middle, enlarged to the size of the whole. EXIF stays that of the whole."""
    old = photo.intrinsics
    width, height = max(2, round(old.width / factor)), max(2, round(old.height / factor))
    part = photo.cut((old.width - width) // 2, (old.height - height) // 2, width, height)
    return part.resized(old.width, old.height)


def shutter_yaw(photo: Photo, degrees_per_s: float, rng: np.random.Generator) -> Photo:
    """Turn the camera about its vertical axis while the shutter rolls."""
    return _shutter(photo, np.array([0.0, np.radians(degrees_per_s), 0.0]))


def shutter_pitch(photo: Photo, degrees_per_s: float, rng: np.random.Generator) -> Photo:
    """Turn the camera about its horizontal axis while the shutter rolls."""
    return _shutter(photo, np.array([np.radians(degrees_per_s), 0.0, 0.0]))


def _shutter(photo: Photo, rad_per_s: Float64[np.ndarray, "3"]) -> Photo:
    """Read the rows one after the other while the camera turns; the pose is that of the middle row.

    Each row is that of a camera rotated about the same centre: a homography.
    """
    old = require_pinhole(photo)
    speed = float(np.linalg.norm(rad_per_s))
    axis = rad_per_s / max(speed, 1e-12)

    def source_of(x: Radii, y: Radii) -> tuple[Radii, Radii]:
        angle = speed * READOUT_S * (y / old.height - 0.5)
        rays = np.stack([(x - old.cx) / old.fx, (y - old.cy) / old.fy, np.ones_like(x)], -1)
        # Rodrigues' formula, each ray with the angle of its row.
        cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
        turned = cosine * rays + sine * np.cross(axis, rays) + (1 - cosine) * (rays @ axis)[..., None] * axis
        return turned[..., 0] / turned[..., 2] * old.fx + old.cx, turned[..., 1] / turned[..., 2] * old.fy + old.cy

    return resampled_within(photo, source_of, old)


LENS_MODIFICATIONS: dict[str, tuple[float, float, Change]] = {
    "k1": (-0.3, 0.3, radial),
    "fisheye": (1.0, 1.0, fisheye),
    "shutter_yaw": (-360.0, 360.0, shutter_yaw),
    "shutter_pitch": (-360.0, 360.0, shutter_pitch),
    "off_centre": (0.1, 1.0, off_centre),
    "zoom": (1.0, 8.0, zoom),
}
"""As `modifications.MODIFICATIONS`."""
RAYS_MODIFICATIONS = ("k1", "fisheye", "shutter_yaw", "shutter_pitch")
"""Those that bend a pinhole's rays: at most one of them fits a photo."""
