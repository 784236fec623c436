"""Ways to spoil a bench's photos: `--modify NAME=VALUE`. Geometry changes carry camera and truth along.

gain, gamma     of the sRGB values              occlusion  rectangles of another scene's photos over this share
white_balance   red times it, blue over it      scale      resampled by this factor
blur            sigma in px at 800 px           roll       about the optical axis, degrees; padding transparent
noise           sigma, in 0..1                  crop       the middle: this share of width and height
jpeg            quality                         focal      the focal length told is this many times the true one
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64

from service.errors import InvalidOptions, UnknownName
from service.geometry import so3_exp
from service.photos.images import encode_image, read_query, resized
from service.types import Intrinsics, Pose


@dataclass(frozen=True, slots=True)
class Shot:
    """A photo with its pinhole camera and its true pose."""

    rgb: Float32[np.ndarray, "h w 3"]
    """sRGB, 0..1."""
    intrinsics: Intrinsics
    pose: Pose
    mask: Bool[np.ndarray, "h w"] | None = None
    """Which pixels are of the photo; the others are transparent in the file. None: all."""
    told_focal: float = 1.0
    """What the focal length is multiplied with when it is sent along."""
    occluders: tuple[Float32[np.ndarray, "_ _ 3"], ...] = ()
    """Photos of another scene."""

    def pixels(self) -> Float32[np.ndarray, "h w c"]:
        """Return what a file has to hold: RGB, or RGBA with the mask."""
        if self.mask is None:
            return self.rgb
        return np.concatenate([self.rgb, self.mask[..., None].astype(np.float32)], 2)


def modified(shot: Shot, specs: Sequence[str], rng: np.random.Generator) -> Shot:
    """Apply 'NAME=VALUE' one after the other. Raises UnknownName, InvalidOptions."""
    for spec in specs:
        change, value = _parsed(spec)
        shot = change(shot, value, rng)
    return shot


def require_modifications(specs: Sequence[str]) -> None:
    """Raise UnknownName or InvalidOptions for the first that can't be done."""
    for spec in specs:
        _parsed(spec)


def _parsed(spec: str) -> tuple[_Change, float]:
    name, _, text = spec.partition("=")
    if name not in MODIFICATIONS:
        raise UnknownName(
            f"there is no modification '{name}'; known: {', '.join(sorted(MODIFICATIONS))}.", where="modify"
        )
    try:
        value = float(text)
    except ValueError:
        raise InvalidOptions(f"must be NAME=NUMBER, is '{spec}'.", where="modify") from None
    low, high, change = MODIFICATIONS[name]
    if not low <= value <= high:
        raise InvalidOptions(f"'{name}' takes {low:g} to {high:g}, not {value:g}.", where="modify")
    return change, value


def _gain(shot: Shot, factor: float, rng: np.random.Generator) -> Shot:
    """Multiplies the sRGB values, as exposure roughly does."""
    return replace(shot, rgb=np.clip(shot.rgb * np.float32(factor), 0, 1))


def _gamma(shot: Shot, exponent: float, rng: np.random.Generator) -> Shot:
    return replace(shot, rgb=(shot.rgb ** np.float32(exponent)).astype(np.float32))


def _noise(shot: Shot, sigma: float, rng: np.random.Generator) -> Shot:
    """Gaussian, independent in every channel."""
    noise = rng.normal(0.0, sigma, shot.rgb.shape).astype(np.float32)
    return replace(shot, rgb=np.clip(shot.rgb + noise, 0, 1))


def _blur(shot: Shot, sigma: float, rng: np.random.Generator) -> Shot:
    """Gaussian; sigma in pixels of a photo with a long side of 800."""
    sigma = sigma * shot.intrinsics.long_side / 800
    reach = max(1, int(np.ceil(3 * sigma)))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    rgb = shot.rgb
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (reach, reach)
        padded = np.pad(rgb, padding, mode="edge")
        size = rgb.shape[axis]
        rgb = np.zeros_like(rgb)
        for offset, weight in enumerate(kernel):
            rgb += weight * padded.take(range(offset, offset + size), axis)
    return replace(shot, rgb=rgb)


def _jpeg(shot: Shot, quality: float, rng: np.random.Generator) -> Shot:
    query = read_query(encode_image(shot.rgb, quality=round(quality)), intrinsics=shot.intrinsics)
    return replace(shot, rgb=query.rgb.astype(np.float32) / 255, intrinsics=query.intrinsics)


def _occlusion(shot: Shot, share: float, rng: np.random.Generator) -> Shot:
    """Rectangles of a tenth to a half of each side, the last one cut short: the share is exact to the pixel."""
    if not shot.occluders:
        raise InvalidOptions(
            "'occlusion' needs photos of another scene to cut from.", where="modify", hint="Name a folder of some."
        )
    rgb, covered = shot.rgb.copy(), np.zeros(shot.rgb.shape[:2], bool)
    height, width = shot.rgb.shape[:2]
    wanted = round(share * covered.size)
    while (left := wanted - int(covered.sum())) > 0:
        tall, wide = (max(1, int(side * rng.uniform(0.1, 0.5))) for side in (height, width))
        top, first = int(rng.integers(0, height - tall + 1)), int(rng.integers(0, width - wide + 1))
        area = np.s_[top : top + tall, first : first + wide]
        new = np.zeros_like(covered)
        new[area] = ~covered[area]
        new.ravel()[np.flatnonzero(new)[left:]] = False
        piece = _piece(shot.occluders[int(rng.integers(len(shot.occluders)))], tall, wide, rng)
        rgb[area] = np.where(new[area][..., None], piece, rgb[area])
        covered |= new
    return replace(shot, rgb=rgb)


def _piece(
    photo: Float32[np.ndarray, "h w 3"], tall: int, wide: int, rng: np.random.Generator
) -> Float32[np.ndarray, "tall wide 3"]:
    """Cut a piece out; a photo that is too small is continued by its mirror image."""
    height, width = photo.shape[:2]
    photo = np.pad(photo, ((0, max(0, tall - height)), (0, max(0, wide - width)), (0, 0)), mode="symmetric")
    top, left = int(rng.integers(0, photo.shape[0] - tall + 1)), int(rng.integers(0, photo.shape[1] - wide + 1))
    return photo[top : top + tall, left : left + wide]


def _white_balance(shot: Shot, factor: float, rng: np.random.Generator) -> Shot:
    """Warmer above 1, colder below."""
    return replace(shot, rgb=np.clip(shot.rgb * np.array([factor, 1.0, 1.0 / factor], np.float32), 0, 1))


def _saturation(shot: Shot, factor: float, rng: np.random.Generator) -> Shot:
    """Of the colours, by luma (ITU-R BT.601); 0 leaves a gray picture."""
    luma = shot.rgb @ np.array([[0.299], [0.587], [0.114]], np.float32)
    return replace(shot, rgb=np.clip(luma + factor * (shot.rgb - luma), 0, 1).astype(np.float32))


def _scale(shot: Shot, factor: float, rng: np.random.Generator) -> Shot:
    """Every pixel of the new size is the mean over what it covers, or interpolated where it grows."""
    old = shot.intrinsics
    camera = old.resized(max(2, round(old.width * factor)), max(2, round(old.height * factor)))
    rgb, mask = resized(shot.rgb, camera.width, camera.height), shot.mask
    if mask is not None:
        grown = np.repeat(mask[..., None], 3, 2).astype(np.float32)
        mask = resized(grown, camera.width, camera.height)[..., 0] > 0.999
    return replace(shot, rgb=rgb, mask=mask, intrinsics=camera)


def _focal(shot: Shot, factor: float, rng: np.random.Generator) -> Shot:
    return replace(shot, told_focal=shot.told_focal * factor)


def _crop(shot: Shot, share: float, rng: np.random.Generator) -> Shot:
    """Keeps the middle: `share` of width and height."""
    old = shot.intrinsics
    width, height = max(1, round(old.width * share)), max(1, round(old.height * share))
    left, top = (old.width - width) // 2, (old.height - height) // 2
    camera = replace(old, width=width, height=height, cx=old.cx - left, cy=old.cy - top)
    area = np.s_[top : top + height, left : left + width]
    mask = None if shot.mask is None else shot.mask[area].copy()
    return replace(shot, rgb=shot.rgb[area].copy(), mask=mask, intrinsics=camera)


def _roll(shot: Shot, degrees: float, rng: np.random.Generator) -> Shot:
    """Turns the camera about its axis; the picture grows so that nothing is cut off, and the padding is masked."""
    old = shot.intrinsics
    camera_from_rolled = so3_exp(np.array([0.0, 0.0, np.radians(degrees)]))
    focal = float(np.sqrt(old.fx * old.fy))
    corners = np.array([[0, 0], [old.width, 0], [0, old.height], [old.width, old.height]], float)
    rays = np.concatenate([(corners - [old.cx, old.cy]) / [old.fx, old.fy], np.ones((4, 1))], 1)
    extent = focal * (rays @ camera_from_rolled)[:, :2]
    low = extent.min(0)  # not rounded: quarter turns then take pixel centres to pixel centres
    width, height = (int(v) for v in np.ceil(extent.max(0) - low - 1e-6))
    camera = Intrinsics(width, height, focal, focal, float(-low[0]), float(-low[1]))
    rows, columns = np.mgrid[:height, :width]
    x, y = (columns + 0.5 - camera.cx) / focal, (rows + 0.5 - camera.cy) / focal
    rays = np.stack([x, y, np.ones_like(x)], -1) @ camera_from_rolled.T
    at = rays[..., 0] * old.fx + old.cx, rays[..., 1] * old.fy + old.cy
    before = np.ones(shot.rgb.shape[:2], bool) if shot.mask is None else shot.mask
    mask = _sampled(np.repeat(before[..., None], 3, 2).astype(np.float32), *at)[..., 0] > 0.999
    matrix = shot.pose.world_from_camera.copy()
    matrix[:3, :3] = matrix[:3, :3] @ camera_from_rolled
    turned = replace(shot, rgb=_sampled(shot.rgb, *at), intrinsics=camera, pose=Pose(matrix))
    return replace(turned, mask=None if mask.all() else mask)


def _sampled(
    rgb: Float32[np.ndarray, "h w 3"], x: Float64[np.ndarray, "a b"], y: Float64[np.ndarray, "a b"]
) -> Float32[np.ndarray, "a b 3"]:
    """Bilinear; black outside."""
    height, width = rgb.shape[:2]
    inside = (x > 0) & (x < width) & (y > 0) & (y < height)
    x, y = np.clip(x - 0.5, 0, width - 1), np.clip(y - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    u, v = (x - left)[..., None], (y - top)[..., None]
    upper = rgb[top, left] * (1 - u) + rgb[top, left + 1] * u
    lower = rgb[top + 1, left] * (1 - u) + rgb[top + 1, left + 1] * u
    return ((upper * (1 - v) + lower * v) * inside[..., None]).astype(np.float32)


_Change = Callable[[Shot, float, np.random.Generator], Shot]
MODIFICATIONS: dict[str, tuple[float, float, _Change]] = {
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
"""Name -> least value, greatest value, what it does."""
