"""Alterations of rendered held-out photos: exposure, occlusion, JPEG with EXIF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from cameras import View
from PIL import ExifTags, Image, ImageDraw, ImageFilter

Array = np.ndarray

# Gains in linear light for red, green and blue: too dark, too bright, a warm white balance.
GAINS = ((0.65, 0.65, 0.65), (1.4, 1.4, 1.4), (1.22, 1.0, 0.66))
COVERED = (0.15, 0.20)  # share of the photo that an occluder may cover
ORIENTATIONS = {6: 1, 8: -1}  # EXIF orientation: quarter turns left from upright to stored
QUALITY = 92


def read(path: Path) -> Array:
    """Photo as floats, sRGB 0..1."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), np.float64) / 255


def expose(photo: Array, which: int) -> Array:
    """Return the photo under another exposure or white balance."""
    linear = np.where(photo <= 0.04045, photo / 12.92, ((photo + 0.055) / 1.055) ** 2.4)
    linear = np.clip(linear * GAINS[which], 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def noise(height: int, width: int, cell: int, rng: np.random.Generator) -> Array:
    """Smooth coloured noise, 0..1."""
    small = rng.integers(0, 255, (height // cell + 2, width // cell + 2, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC)) / 255


def person(draw: ImageDraw.ImageDraw, w: int, h: int, size: float) -> None:
    """Head and shoulders of somebody standing in the way, at the left."""
    x, top, r = w * 0.24, h * (1 - 1.05 * size), h * 0.19 * size
    draw.ellipse((x - r, top, x + r, top + 2.5 * r), fill=255)
    draw.rectangle((x - 0.5 * r, top + 2 * r, x + 0.5 * r, top + 3.2 * r), fill=255)
    draw.rounded_rectangle((x - 2.3 * r, top + 2.9 * r, x + 2.3 * r, h * 1.4), r, fill=255)


def hand(draw: ImageDraw.ImageDraw, w: int, h: int, size: float) -> None:
    """Palm and spread fingers reaching in from the right edge."""
    s = h * size
    x, y = w - 0.20 * s, h * 0.60
    draw.ellipse((x - 0.30 * s, y - 0.26 * s, x + 0.5 * s, y + 0.34 * s), fill=255)
    fingers = ((-0.52, -0.30), (-0.62, -0.12), (-0.62, 0.08), (-0.50, 0.26), (-0.05, -0.52))
    for dx, dy in fingers:
        tip = (x + dx * s, y + dy * s)
        draw.line((x, y, *tip), fill=255, width=int(0.13 * s))
        r = 0.065 * s
        draw.ellipse((tip[0] - r, tip[1] - r, tip[0] + r, tip[1] + r), fill=255)


def parcels(draw: ImageDraw.ImageDraw, w: int, h: int, size: float) -> None:
    """Two boxes held into the picture, with a pattern that the scene does not have."""
    a, b = w * 0.42 * size, h * 0.62 * size
    x, y = w * 0.60, h * 0.72
    draw.polygon([(x, y - b / 2), (x + a, y - b / 3), (x + a * 0.9, y + b), (x - a * 0.1, y + b)], 255)
    draw.rectangle((0, 0, a * 0.55, b * 0.5), fill=255)


OCCLUDERS = (
    (person, (0.12, 0.13, 0.18), 0.04, 7),
    (hand, (0.62, 0.42, 0.33), 0.05, 5),
    (parcels, (0.42, 0.40, 0.44), 0.85, 3),
)  # shape, colour, strength of the noise on it, blur in pixels (it is out of focus)


def occlude(photo: Array, which: int) -> tuple[Array, float]:
    """Return the photo with an occluder in front, and the share of its area that is covered."""
    height, width = photo.shape[:2]
    shape, colour, grain, blur = OCCLUDERS[which]
    for size in np.linspace(0.2, 1.6, 141):
        mask = Image.new("L", (width, height))
        shape(ImageDraw.Draw(mask), width, height, float(size))
        alpha = np.asarray(mask.filter(ImageFilter.GaussianBlur(blur)), np.float64) / 255
        share = float(np.mean(alpha > 0.5))
        if share >= sum(COVERED) / 2:
            break
    rng = np.random.default_rng(which)
    texture = np.asarray(colour) + grain * (noise(height, width, 24, rng) - 0.5)
    shade = np.linspace(1.15, 0.75, height)[:, None, None]
    front = np.clip(texture * shade, 0, 1)
    return photo + (front - photo) * alpha[..., None], share


def write_jpeg(
    photo: Array,
    view: View,
    orientation: int,
    path: Path,
    quality: int = QUALITY,
    subsampling: int = 0,
    device: str | None = None,
) -> None:
    """JPEG as a camera would store it: pixels rotated by `orientation`, focal length and orientation in EXIF.

    `subsampling` of the chroma is Pillow's (0: none, 2: half the resolution), `device` the camera's model in EXIF.
    """
    pixels = np.round(np.clip(photo, 0, 1) * 255).astype(np.uint8)
    stored = np.ascontiguousarray(np.rot90(pixels, ORIENTATIONS.get(orientation, 0)))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    if device is not None:
        exif[ExifTags.Base.Model] = device
    long_side = max(view.width, view.height)
    lens = exif.get_ifd(ExifTags.IFD.Exif)
    lens[ExifTags.Base.FocalLengthIn35mmFilm] = round(36 * view.focal / long_side)
    partial = path.with_name(f"_{path.name}")
    Image.fromarray(stored).save(partial, quality=quality, subsampling=subsampling, exif=exif)
    partial.replace(path)
