"""Bytes of a photo -> `Query`: upright, undistorted, uint8, no larger than needed, with a pinhole camera.

JPEG, PNG, WebP and HEIC. The size is checked in the header before anything is decoded. Colour profiles are
not applied: a phone's Display P3 comes out slightly paler, which gain and bias of the alignment absorb.

Focal lengths without calibration: EXIF's 35 mm equivalent f is taken as fx = f / 36 mm x long side. Makers
who define it by the diagonal (43.27 mm) instead mean 4 % more on a 4:3 sensor and the same on a 3:2 one.
Without EXIF, fx = 0.78 x long side: 28 mm, near the main camera of phones (24 to 28 mm), whose photos lose
their EXIF in messengers.
"""

from __future__ import annotations

import base64
import json
import logging
import os
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from PIL import ExifTags, Image
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.WebPImagePlugin import WebPImageFile

from service.errors import InvalidImage
from service.photos.intrinsics import require_size, undistorted
from service.types import Intrinsics, Pose, Query

MAX_PIXELS = 64 * 1024 * 1024
"""A phone's 64 megapixels are 9248 x 6936: more than 64 million, less than this."""
MAX_PIXELS_WHOLE = 25 * 1024 * 1024
"""Of WebP: it can't be decoded at a reduced size, and 64 megapixels, which 120 kB may hold, would take 1.9 GB."""
MAX_SCANS = 24
"""Of a progressive JPEG. Each is a walk over all pixels, for which an attacker needs 100 bytes; encoders make 10."""
LONG_SIDE, NEARLY = 1000, 1.3
"""Of `Query.rgb`, and how much more it may have where resampling would cost more time than it saves. Features are
looked for at 800 pixels at most; a JPEG of 12 megapixels is decoded at a quarter of its size."""
OPAQUE = 128
"""Of 255: what is more transparent is unknown."""
MIN_SIDE = 32
"""Of `Query.rgb`; the features need more anyway."""
GUESSED_FOCAL = 0.78
"""In long sides; see the module's docstring."""

# The classes are called directly: Image.open would try every format that Pillow knows, and warn before we
# check.
_DECODERS = (
    ("JPEG", JpegImageFile, MAX_PIXELS, lambda d: d.startswith(b"\xff\xd8\xff")),
    ("PNG", PngImageFile, MAX_PIXELS, lambda d: d.startswith(b"\x89PNG\r\n\x1a\n")),
    ("WebP", WebPImageFile, MAX_PIXELS_WHOLE, lambda d: d[:4] == b"RIFF" and d[8:12] == b"WEBP"),
    ("HEIC", None, MAX_PIXELS, lambda d: d[4:8] == b"ftyp"),
)
_HEIC_S = 30
"""Wall time; 64 megapixels take two seconds."""
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
"""Not a stuffed byte, nor a restart within a scan."""
_BAND_PX = 1 << 21
"""Converted at once: the whole photo is in memory once as it was decoded, and once as RGB."""
_ORIENTATIONS = {
    1: (False, False, False),
    2: (False, True, False),
    3: (False, True, True),
    4: (False, False, True),
    5: (True, False, False),
    6: (True, True, False),
    7: (True, True, True),
    8: (True, False, True),
}
"""EXIF orientation -> what makes the image upright: transpose, mirror left-right, mirror top-bottom."""
log = logging.getLogger(__name__)


def read_query(
    data: bytes,
    *,
    intrinsics: Intrinsics | None = None,
    prior: Pose | None = None,
    background_rgb: tuple[float, float, float] = (0.0, 0.0, 0.0),
    long_side: int = LONG_SIDE,
) -> Query:
    """Decode a photo. Raises InvalidImage, InvalidIntrinsics.

    `intrinsics` refer to the upright photo in its full size. Transparent parts are unknown: nothing is expected
    there. They are filled with `background_rgb` (0..1): pass the scene's, then a cut-out object has the edges that
    it has in a render. `long_side` is about the most that the query's picture has.
    """
    name, photo = _open(data)
    decoded = _decode(photo, name, background_rgb, long_side)
    focal_mm = _focal_35mm(photo) if intrinsics is None else None
    return _query(decoded, focal_mm, intrinsics, prior)


def query_of(
    rgb: UInt8[np.ndarray, "h w 3"],
    *,
    intrinsics: Intrinsics | None = None,
    prior: Pose | None = None,
    long_side: int = LONG_SIDE,
) -> Query:
    """Return the query of an upright photo that is decoded already. Raises InvalidImage, InvalidIntrinsics."""
    height, width = rgb.shape[:2]
    target = _target((width, height), long_side)
    if max(width, height) <= NEARLY * max(target):
        target = width, height
    else:
        rgb = np.asarray(cv2.resize(rgb, target, interpolation=cv2.INTER_AREA))
    scale = (target[0] / width, target[1] / height)
    return _query(_Decoded(rgb, None, width, height, scale, (0.0, 0.0), ()), None, intrinsics, prior)


def _query(decoded: _Decoded, focal_mm: float | None, intrinsics: Intrinsics | None, prior: Pose | None) -> Query:
    """Find out about the camera, and take its distortion out."""
    warnings = list(decoded.warnings)
    if intrinsics is not None:
        require_size(intrinsics, decoded.width, decoded.height)
        source = "given"
    else:
        source = "exif" if focal_mm else "guessed"
        if not focal_mm:
            warnings.append(
                "The photo says nothing of its focal length; it is estimated with the pose, starting from 28 mm "
                "(35 mm equivalent). Send intrinsics for an exact pose."
            )
        long_side = max(decoded.width, decoded.height)
        focal = focal_mm / 36.0 * long_side if focal_mm else GUESSED_FOCAL * long_side
        size = decoded.width, decoded.height
        intrinsics = Intrinsics(*size, focal, focal, size[0] / 2, size[1] / 2, trust="approximate")
    camera = decoded.camera(intrinsics)
    rgb, pinhole, seen = undistorted(decoded.rgb, camera)
    known = decoded.known
    if seen is not None and not seen.all():
        known = seen if known is None else seen & (undistorted(known.astype(np.uint8), camera)[0] > 0)
    return Query(rgb, pinhole, source, intrinsics, prior, tuple(warnings), known)


def encode_image(
    rgb: UInt8[np.ndarray, "h w c"] | Float32[np.ndarray, "h w c"],
    kind: Literal["jpg", "png"] = "jpg",
    *,
    quality: int = 90,
) -> bytes:
    """Return an image (uint8, or float32 in 0..1) as a file; `quality` is JPEG's, 1 to 100; a PNG may be RGBA."""
    if rgb.dtype != np.uint8:
        rgb = np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if kind == "jpg" else []
    order = [2, 1, 0, *range(3, rgb.shape[2])]
    encoded, data = cv2.imencode(f".{kind}", np.ascontiguousarray(rgb[:, :, order]), options)
    if not encoded:
        raise ValueError(f"an image of shape {rgb.shape} can't be {kind}")
    return data.tobytes()


def with_palette(png: bytes) -> bytes:
    """Return a PNG with 256 colours of its own, opaque: about a third of the bytes."""
    shown = BytesIO()
    Image.open(BytesIO(png)).convert("RGB").quantize(256).save(shown, "png", optimize=True)
    return shown.getvalue()


def resized(rgb: Float32[np.ndarray, "h w 3"], width: int, height: int) -> Float32[np.ndarray, "height width 3"]:
    """Resample: area averages where it shrinks, so nothing aliases; else bilinear."""
    shrinks = width * height < rgb.shape[0] * rgb.shape[1]
    mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(rgb, (width, height), interpolation=mode), np.float32)


def photo_size(data: bytes) -> tuple[int, int]:
    """Return width and height of the upright photo, from its header. Raises InvalidImage."""
    _, photo = _open(data, header_only=True)
    transpose, _, _ = _ORIENTATIONS[_orientation(photo)]
    return (photo.height, photo.width) if transpose else photo.size


@dataclass(frozen=True, slots=True)
class _Decoded:
    rgb: UInt8[np.ndarray, "h w 3"]
    """Upright, reduced."""
    known: Bool[np.ndarray, "h w"] | None
    width: int
    """Of the upright photo in its full size."""
    height: int
    scale: tuple[float, float]
    """Pixels of `rgb` per pixel of the photo."""
    offset: tuple[float, float]
    """Where the photo's corner lies in `rgb`: not exactly 0 after JPEG's own reduction and a mirroring."""
    warnings: tuple[str, ...]

    def camera(self, photo: Intrinsics) -> Intrinsics:
        """Return the camera of `rgb` for that of the photo."""
        (sx, sy), (ox, oy) = self.scale, self.offset
        return replace(
            photo,
            width=self.rgb.shape[1],
            height=self.rgb.shape[0],
            fx=photo.fx * sx,
            fy=photo.fy * sy,
            cx=photo.cx * sx + ox,
            cy=photo.cy * sy + oy,
        )


def _open(data: bytes, *, header_only: bool = False) -> tuple[str, Image.Image]:
    """Read the header and check the size. Raises InvalidImage."""
    if not data:
        raise InvalidImage("the photo is empty (0 bytes).", where="photo")
    fitting = [(name, decoder, limit) for name, decoder, limit, fits in _DECODERS if fits(data)]
    if not fitting:
        raise InvalidImage("not a JPEG, PNG, WebP or HEIC photo.", where="photo")
    name, decoder, limit = fitting[0]
    try:
        photo = _heic(data, 0 if header_only else limit) if decoder is None else decoder(BytesIO(data))
    except Image.DecompressionBombError as error:
        raise InvalidImage(f"too many pixels: {error}", where="photo") from None
    except Exception as error:  # decoders raise almost anything on a broken file
        raise InvalidImage(f"the {name} header is broken: {_short(error)}.", where="photo") from None
    if photo.width * photo.height > limit:
        raise InvalidImage(
            f"{photo.width} x {photo.height} are {photo.width * photo.height / 1e6:.0f} megapixels; "
            f"the limit is {limit / 1e6:.0f} for {name}.",
            where="photo",
            hint="Send it smaller: more than about 2 megapixels don't help.",
        )
    if isinstance(photo, JpegImageFile) and (scans := _scans(data)) > MAX_SCANS:
        raise InvalidImage(f"a JPEG of {scans} scans; the limit is {MAX_SCANS}.", where="photo", hint="Save it again.")
    return name, photo


def _heic(data: bytes, max_pixels: int) -> Image.Image:
    """Decode in another process, which may crash; larger ones not. Raises ValueError."""
    command = [sys.executable, "-I", str(Path(__file__).with_name("heic_child.py")), str(max_pixels)]
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    try:
        told = subprocess.run(command, input=data, capture_output=True, timeout=_HEIC_S, check=True, env=kept).stdout
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        raise ValueError(f"its decoder crashed or took too long ({type(error).__name__})") from error
    line, _, pixels = told.partition(b"\n")
    head = json.loads(line)
    if "error" in head:
        raise ValueError(head["error"])
    size = head["width"], head["height"]
    photo = Image.frombuffer(head["mode"], size, pixels) if pixels else _Large(*size)
    photo.info["exif"] = base64.b64decode(head["exif"])
    return photo


class _Large(Image.Image):
    """A photo that wasn't decoded: its size, and what EXIF says."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__()
        self._size = width, height


def _scans(data: bytes) -> int:
    """Count a JPEG's scans, up to its end: phones put videos behind it."""
    at, scans = 2, 0
    while found := _JPEG_MARKER.search(data, at):
        kind, at = found[0][-1], found.end()
        if kind == 0xD9:
            break
        scans += kind == 0xDA
        at += int.from_bytes(data[at : at + 2])  # the segment's length
    return scans


def _target(size: tuple[int, int], long_side: int) -> tuple[int, int]:
    """Return the size to reduce a photo to. Raises InvalidImage if it is too small."""
    if min(size) * min(1.0, LONG_SIDE / max(size)) < MIN_SIDE - 0.5:
        raise InvalidImage(
            f"{size[0]} x {size[1]} is too small or too narrow to localize: the short side must have "
            f"{MIN_SIDE} pixels when the long one has at most {LONG_SIDE}.",
            where="photo",
        )
    factor = min(1.0, long_side / max(size))
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def _decode(photo: Image.Image, name: str, background_rgb: tuple[float, float, float], long_side: int) -> _Decoded:
    raw_size = photo.size
    target = _target(raw_size, long_side)
    step = (1.0, 1.0)
    if isinstance(photo, JpegImageFile):
        drafted = photo.draft(None, (target[0], target[1]))  # decodes at 1/2, 1/4 or 1/8, never below target
        if drafted:
            step = (raw_size[0] / drafted[1][2], raw_size[1] / drafted[1][3])
    try:
        photo.load()
        pixels, alpha, warnings = _rgb(photo, background_rgb)
    except Exception as error:
        raise InvalidImage(
            f"the {name} can't be decoded, it is truncated or damaged: {_short(error)}.",
            where="photo",
            hint="Upload the file again.",
        ) from None
    covered = (pixels.shape[1] * step[0], pixels.shape[0] * step[1])
    if min(covered[0] - raw_size[0], covered[1] - raw_size[1]) < 0:
        raise InvalidImage(f"the {name} decodes to another size than its header says.", where="photo")
    layers = [pixels] if alpha is None else [pixels, alpha]
    if max(pixels.shape[:2]) <= NEARLY * max(target):
        target = pixels.shape[1], pixels.shape[0]
    else:
        layers = [cv2.resize(layer, target, interpolation=cv2.INTER_AREA) for layer in layers]
    scale = [target[axis] / covered[axis] for axis in (0, 1)]
    beyond = [target[axis] - raw_size[axis] * scale[axis] for axis in (0, 1)]
    transpose, mirror_x, mirror_y = _ORIENTATIONS[_orientation(photo)]
    if transpose:
        layers = [layer.swapaxes(0, 1) for layer in layers]
        scale, beyond, raw_size = scale[::-1], beyond[::-1], raw_size[::-1]
    turned = [np.ascontiguousarray(layer[:: -1 if mirror_y else 1, :: -1 if mirror_x else 1]) for layer in layers]
    return _Decoded(
        turned[0],
        turned[1] >= OPAQUE if len(turned) > 1 else None,
        *raw_size,
        scale=(scale[0], scale[1]),
        offset=(beyond[0] * mirror_x, beyond[1] * mirror_y),
        warnings=tuple(warnings),
    )


def _rgb(
    photo: Image.Image, background_rgb: tuple[float, float, float]
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"] | None, list[str]]:
    """Return colours, opacity unless all is opaque, and warnings."""
    rgb, alpha = np.empty((photo.height, photo.width, 3), np.uint8), None
    rows = max(1, _BAND_PX // photo.width)
    for top in range(0, photo.height, rows):
        band = photo.crop((0, top, photo.width, min(top + rows, photo.height)))
        rgb[top : top + rows], band_alpha = _band_rgb(band, background_rgb)
        if band_alpha is not None:
            alpha = np.full(rgb.shape[:2], 255, np.uint8) if alpha is None else alpha
            alpha[top : top + rows] = band_alpha
    return rgb, alpha, [] if alpha is None else ["Transparent parts of the photo are ignored."]


def _band_rgb(
    band: Image.Image, background_rgb: tuple[float, float, float]
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"] | None]:
    if band.mode.startswith(("I", "F")):  # 16-bit gray, which Pillow's own conversion would clip at 255
        gray = (np.asarray(band).astype(np.uint32) >> 8).clip(0, 255).astype(np.uint8)
        return np.repeat(gray[:, :, None], 3, axis=2), None
    if not band.has_transparency_data:
        return np.asarray(band.convert("RGB")), None
    rgba = band.convert("RGBA")
    alpha = rgba.getchannel("A")
    canvas = Image.new("RGB", band.size, tuple(round(255 * c) for c in background_rgb))
    canvas.paste(rgba, mask=alpha)
    return np.asarray(canvas), None if alpha.getextrema()[0] == 255 else np.asarray(alpha)


def _orientation(photo: Image.Image) -> int:
    """Return 1 to 8; 1, upright, for what is missing or unreadable. A HEIC's decoder turns it, and says 1."""
    value = _exif(photo).get(ExifTags.Base.Orientation, 1)
    return value if value in _ORIENTATIONS else 1


def _focal_35mm(photo: Image.Image) -> float | None:
    """Return EXIF's focal length in mm on 35 mm film, if it is there and possible."""
    value = _exif(photo).get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLengthIn35mmFilm)
    try:
        focal = float(value) if value is not None else 0.0
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return focal if 4.0 <= focal <= 2000.0 else None


def _exif(photo: Image.Image) -> Image.Exif:
    """Return the photo's EXIF; an empty one if it has none or a broken one."""
    if "exif" not in photo.info:  # asking a PNG would decode it
        return Image.Exif()
    try:
        exif = photo.getexif()
        exif.get_ifd(ExifTags.IFD.Exif)
        return exif
    except Exception as error:
        log.info("EXIF ignored: %s", _short(error))
        return Image.Exif()


def _short(error: Exception) -> str:
    return (str(error) or type(error).__name__)[:200].rstrip(".")
