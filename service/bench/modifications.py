"""Modifications of the benches' photos: `--modify NAME=VALUE`. Where geometry changes, camera and truth change with it.

gain, gamma     of the sRGB values              occlusion  rectangles of another scene's photos over this share
white_balance   red times, blue divided by it    scale      resampled by this factor
blur            sigma in px at 800 px           roll       about the optical axis, degrees; padding transparent
noise           sigma, in 0..1                  crop       the middle: this share of width and height
jpeg            quality                         focal      the focal length sent is the true one times this

Those of other lenses (`lens_modifications`), at most one of the first column in a list:

k1              of a radial distortion          off_centre    a corner: this share of width and height
fisheye         1: equidistant                  zoom          digital: by this factor, to the same size
shutter_yaw     degrees a second while a rolling shutter reads the photo in 20 ms; shutter_pitch likewise

Those of light, motion, sensor and screen (`capture_modifications`):

vignetting      share, in the corners           motion_blur   length in px at 800 px
local_light     strength of regions, shadow     phone_noise   sigma at full signal, then smeared
colour_cast     strength                        letterbox, white_bars  share of the sides
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Float64

from service.bench.capture_modifications import CAPTURE_MODIFICATIONS
from service.bench.lens_modifications import LENS_MODIFICATIONS, require_pinhole
from service.bench.modified_photo import Change, Photo
from service.errors import InvalidOptions, UnknownName
from service.geometry import so3_exp
from service.photos.images import encode_image, read_query
from service.types import Intrinsics, Pose


def modify(photo: Photo, specs: Sequence[str], rng: np.random.Generator) -> Photo:
    """Return the photo after modifications 'NAME=VALUE', in their order. Raises UnknownName, InvalidOptions."""
    for spec in specs:
        change, value = _parse(spec)
        photo = change(photo, value, rng)
    return photo


def require_modifications(specs: Sequence[str]) -> None:
    """Raise UnknownName or InvalidOptions for the first modification that doesn't exist or has a wrong value."""
    for spec in specs:
        _parse(spec)


def _parse(spec: str) -> tuple[Change, float]:
    name, _, text = spec.partition("=")
    if name not in MODIFICATIONS:
        raise UnknownName(f"unknown modification '{name}'; known: {', '.join(sorted(MODIFICATIONS))}.", where="modify")
    try:
        value = float(text)
    except ValueError:
        raise InvalidOptions(f"must be NAME=NUMBER, is '{spec}'.", where="modify") from None
    low, high, change = MODIFICATIONS[name]
    if not low <= value <= high:
        raise InvalidOptions(f"'{name}' takes {low:g} to {high:g}, not {value:g}.", where="modify")
    return change, value


def _gain(photo: Photo, factor: float, rng: np.random.Generator) -> Photo:
    # Of the sRGB values: an approximation of another exposure, which would multiply linear light.
    return replace(photo, rgb=np.clip(photo.rgb * np.float32(factor), 0, 1))


def _gamma(photo: Photo, exponent: float, rng: np.random.Generator) -> Photo:
    return replace(photo, rgb=(photo.rgb ** np.float32(exponent)).astype(np.float32))


def _noise(photo: Photo, sigma: float, rng: np.random.Generator) -> Photo:
    """Add independent Gaussian noise to every channel."""
    noise = rng.normal(0.0, sigma, photo.rgb.shape).astype(np.float32)
    return replace(photo, rgb=np.clip(photo.rgb + noise, 0, 1))


def _blur(photo: Photo, sigma: float, rng: np.random.Generator) -> Photo:
    """Blur by a separable Gaussian; sigma in pixels of a photo with a long side of 800."""
    sigma = sigma * photo.intrinsics.long_side / 800
    # Beyond three sigma a Gaussian has 0.3 % of its weight.
    reach = max(1, int(np.ceil(3 * sigma)))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    rgb = photo.rgb
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (reach, reach)
        padded = np.pad(rgb, padding, mode="edge")
        size = rgb.shape[axis]
        rgb = np.zeros_like(rgb)
        for offset, weight in enumerate(kernel):
            rgb += weight * padded.take(range(offset, offset + size), axis)
    return replace(photo, rgb=rgb)


def _jpeg(photo: Photo, quality: float, rng: np.random.Generator) -> Photo:
    lens = photo.intrinsics
    # As a pinhole's, for reading would undistort the photo.
    pinhole = replace(lens, model="PINHOLE", distortion=())
    query = read_query(encode_image(photo.rgb, quality=round(quality)), intrinsics=pinhole)
    camera = replace(query.intrinsics, model=lens.model, distortion=lens.distortion)
    return replace(photo, rgb=query.rgb.astype(np.float32) / 255, intrinsics=camera)


def _occlusion(photo: Photo, share: float, rng: np.random.Generator) -> Photo:
    """Cover a share of the photo by rectangles of a tenth to a half of each side.

    The last rectangle is cut short, so that the share is exact to the pixel.
    """
    if not photo.occluders:
        raise InvalidOptions(
            "'occlusion' needs photos of another scene to cut from.", where="modify", hint="Name a folder of some."
        )
    rgb, covered = photo.rgb.copy(), np.zeros(photo.rgb.shape[:2], bool)
    height, width = photo.rgb.shape[:2]
    wanted = round(share * covered.size)
    while (left := wanted - int(covered.sum())) > 0:
        tall, wide = (max(1, int(side * rng.uniform(0.1, 0.5))) for side in (height, width))
        top, first = int(rng.integers(0, height - tall + 1)), int(rng.integers(0, width - wide + 1))
        area = np.s_[top : top + tall, first : first + wide]
        new = np.zeros_like(covered)
        new[area] = ~covered[area]
        # What exceeds the share stays uncovered.
        new.ravel()[np.flatnonzero(new)[left:]] = False
        piece = _random_crop(photo.occluders[int(rng.integers(len(photo.occluders)))], tall, wide, rng)
        rgb[area] = np.where(new[area][..., None], piece, rgb[area])
        covered |= new
    return replace(photo, rgb=rgb)


def _random_crop(
    photo: Float32[np.ndarray, "h w 3"], tall: int, wide: int, rng: np.random.Generator
) -> Float32[np.ndarray, "tall wide 3"]:
    """Return a random crop; a photo that is too small is padded by reflection."""
    height, width = photo.shape[:2]
    photo = np.pad(photo, ((0, max(0, tall - height)), (0, max(0, wide - width)), (0, 0)), mode="symmetric")
    top, left = int(rng.integers(0, photo.shape[0] - tall + 1)), int(rng.integers(0, photo.shape[1] - wide + 1))
    return photo[top : top + tall, left : left + wide]


def _white_balance(photo: Photo, factor: float, rng: np.random.Generator) -> Photo:
    # Warmer above 1, colder below.
    return replace(photo, rgb=np.clip(photo.rgb * np.array([factor, 1.0, 1.0 / factor], np.float32), 0, 1))


def _saturation(photo: Photo, factor: float, rng: np.random.Generator) -> Photo:
    """Scale the distance of colours from their luma (ITU-R BT.601); 0 gives a grey photo."""
    luma = photo.rgb @ np.array([[0.299], [0.587], [0.114]], np.float32)
    return replace(photo, rgb=np.clip(luma + factor * (photo.rgb - luma), 0, 1).astype(np.float32))


def _scale(photo: Photo, factor: float, rng: np.random.Generator) -> Photo:
    """Resample: by the mean over each new pixel's area, or by interpolation where the photo is enlarged."""
    old = photo.intrinsics
    return photo.resized(max(2, round(old.width * factor)), max(2, round(old.height * factor)))


def _focal(photo: Photo, factor: float, rng: np.random.Generator) -> Photo:
    return replace(photo, sent_focal_factor=photo.sent_focal_factor * factor)


def _crop(photo: Photo, share: float, rng: np.random.Generator) -> Photo:
    """Keep the middle: `share` of width and height."""
    old = photo.intrinsics
    width, height = max(1, round(old.width * share)), max(1, round(old.height * share))
    return photo.cut((old.width - width) // 2, (old.height - height) // 2, width, height)


def _roll(photo: Photo, degrees: float, rng: np.random.Generator) -> Photo:
    """Roll the camera; the image is enlarged so that nothing is cut off, and the padding is masked."""
    old = require_pinhole(photo)
    camera_from_rolled = so3_exp(np.array([0.0, 0.0, np.radians(degrees)]))
    focal = float(np.sqrt(old.fx * old.fy))
    corners = np.array([[0, 0], [old.width, 0], [0, old.height], [old.width, old.height]], float)
    rays = np.concatenate([(corners - [old.cx, old.cy]) / [old.fx, old.fy], np.ones((4, 1))], 1)
    # The rolled corners in pixels about the principal point.
    extent = focal * (rays @ camera_from_rolled)[:, :2]
    low = extent.min(0)  # not rounded, so that quarter turns map pixel centres onto pixel centres
    width, height = (int(v) for v in np.ceil(extent.max(0) - low - 1e-6))
    camera = Intrinsics(width, height, focal, focal, float(-low[0]), float(-low[1]))
    rows, columns = np.mgrid[:height, :width]
    x, y = (columns + 0.5 - camera.cx) / focal, (rows + 0.5 - camera.cy) / focal
    rays = np.stack([x, y, np.ones_like(x)], -1) @ camera_from_rolled.T
    at = rays[..., 0] * old.fx + old.cx, rays[..., 1] * old.fy + old.cy
    # Bilinear weights below 1 mark pixels that mix with the padding.
    before = np.ones(photo.rgb.shape[:2], bool) if photo.mask is None else photo.mask
    mask = _sample(np.repeat(before[..., None], 3, 2).astype(np.float32), *at)[..., 0] > 0.999
    matrix = photo.pose.world_from_camera.copy()
    matrix[:3, :3] = matrix[:3, :3] @ camera_from_rolled
    focal = photo.focal_of_whole
    rolled = replace(photo, rgb=_sample(photo.rgb, *at), intrinsics=camera, pose=Pose(matrix), focal_as_taken=focal)
    return replace(rolled, mask=None if mask.all() else mask)


def _sample(
    rgb: Float32[np.ndarray, "h w 3"], x: Float64[np.ndarray, "a b"], y: Float64[np.ndarray, "a b"]
) -> Float32[np.ndarray, "a b 3"]:
    """Sample bilinearly at pixels (x, y); black outside."""
    height, width = rgb.shape[:2]
    inside = (x > 0) & (x < width) & (y > 0) & (y < height)
    x, y = np.clip(x - 0.5, 0, width - 1), np.clip(y - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    u, v = (x - left)[..., None], (y - top)[..., None]
    upper = rgb[top, left] * (1 - u) + rgb[top, left + 1] * u
    lower = rgb[top + 1, left] * (1 - u) + rgb[top + 1, left + 1] * u
    return ((upper * (1 - v) + lower * v) * inside[..., None]).astype(np.float32)


MODIFICATIONS: dict[str, tuple[float, float, Change]] = (
    {
        "gain": (0.05, 20.0, _gain),
        "gamma": (0.1, 10.0, _gamma),
        "white_balance": (0.2, 5.0, _white_balance),
        "saturation": (0.0, 3.0, _saturation),
        "noise": (0.0, 1.0, _noise),
        "blur": (0.0, 50.0, _blur),
        "jpeg": (1.0, 100.0, _jpeg),
        "occlusion": (0.0, 0.9, _occlusion),
        "scale": (0.05, 4.0, _scale),
        "focal": (0.5, 2.0, _focal),
        "crop": (0.1, 1.0, _crop),
        "roll": (-180.0, 180.0, _roll),
    }
    | LENS_MODIFICATIONS
    | CAPTURE_MODIFICATIONS
)
"""Name -> smallest value, largest value, function."""
