"""Decode the bytes of a photo to a `Query`: upright, undistorted, uint8, no larger than needed, with a pinhole camera.

JPEG, PNG, WebP and HEIC. The size is checked in the header before anything is decoded. Colour profiles are
not applied: a phone's Display P3 comes out slightly paler, which gain and bias of the photometric refinement absorb.

Focal lengths without calibration are EXIF's 35 mm equivalent (`exif_focal_prior`). Without EXIF, fx = 0.78 x long side:
28 mm, near the main camera of phones (24 to 28 mm), whose photos lose their EXIF in messengers.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import ExifTags, Image
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.WebPImagePlugin import WebPImageFile

from service.errors import InvalidImage
from service.photos.camera_identity import CameraIdentity, exif_focal_prior, identity_from_exif
from service.photos.decode_config import DEFAULTS
from service.photos.decoded_pixels import DecodedPixels
from service.photos.heic import decode_heic
from service.photos.intrinsics import ORIENTATIONS, require_size, undistorted
from service.photos.jpeg_segments import END, lacks_only_its_end, scans_and_end
from service.photos.unread_photos import unread_format
from service.types import LENS_PRIORS, Intrinsics, IntrinsicsSource, LensPrior, Pose, Query

# The classes are called directly: Image.open would try every format that Pillow knows, and warn before the size
# is checked.
_DECODERS = (
    ("JPEG", JpegImageFile, DEFAULTS.max_pixels, lambda d: d.startswith(b"\xff\xd8\xff")),
    ("PNG", PngImageFile, DEFAULTS.max_pixels, lambda d: d.startswith(b"\x89PNG\r\n\x1a\n")),
    ("WebP", WebPImageFile, DEFAULTS.max_pixels_webp, lambda d: d[:4] == b"RIFF" and d[8:12] == b"WEBP"),
    ("HEIC", None, DEFAULTS.max_pixels, lambda d: d[4:8] == b"ftyp"),
)
"""Name, Pillow's decoder (none: a process of its own), the most pixels, and whether a file begins like one."""
log = logging.getLogger(__name__)


def read_query(
    data: bytes,
    *,
    intrinsics: Intrinsics | None = None,
    prior: Pose | None = None,
    background_rgb: tuple[float, float, float] = (0.0, 0.0, 0.0),
    long_side: int = DEFAULTS.long_side_px,
    lens_prior: LensPrior | None = None,
) -> Query:
    """Decode a photo. Raises InvalidImage, InvalidIntrinsics.

    `intrinsics` refer to the upright photo in its full size; without them the focal length is EXIF's or a default.
    `lens_prior` says how certain they are where earlier photos of the camera are their source.
    Transparent parts are invalid in the query's mask and filled with `background_rgb` (0..1): with the scene's, a
    cut-out object has the same edges as in a render. `long_side` is the target in pixels, exceeded by
    `DecodeConfig.oversize` at most.
    """
    return open_photo(data).query(
        intrinsics=intrinsics,
        lens_prior=lens_prior,
        prior=prior,
        background_rgb=background_rgb,
        long_side=long_side,
    )


@dataclass(frozen=True, slots=True)
class OpenedPhoto:
    """A photo of which only the header was read."""

    name: str
    """Of its format."""
    image: Image.Image
    camera: CameraIdentity
    """Its camera, by the header."""

    @property
    def gps(self) -> dict[int, Any]:
        """EXIF's GPS directory, values by tag; empty if there is none. Nothing of it is checked."""
        try:
            return dict(_exif(self.image).get_ifd(ExifTags.IFD.GPSInfo))
        except Exception as error:  # whatever a hostile file makes Pillow raise
            log.info("GPS ignored: %s", _short(error))
            return {}

    def query(
        self,
        *,
        intrinsics: Intrinsics | None = None,
        lens_prior: LensPrior | None = None,
        prior: Pose | None = None,
        background_rgb: tuple[float, float, float] = (0.0, 0.0, 0.0),
        long_side: int = DEFAULTS.long_side_px,
    ) -> Query:
        """Decode the pixels, as `read_query` does, once. Raises InvalidImage, InvalidIntrinsics."""
        decoded = _decode(self.image, self.name, background_rgb, long_side)
        return _query(decoded, self.camera, intrinsics, lens_prior, prior)


def open_photo(data: bytes) -> OpenedPhoto:
    """Read a photo's header; a HEIC, or a JPEG without an end, is decoded already. Raises InvalidImage."""
    name, image = _open(data)
    return OpenedPhoto(name, image, _identity(image))


def query_of(
    rgb: UInt8[np.ndarray, "h w 3"],
    *,
    intrinsics: Intrinsics | None = None,
    lens_prior: LensPrior | None = None,
    prior: Pose | None = None,
    long_side: int = DEFAULTS.long_side_px,
) -> Query:
    """Return the query of an upright photo that is decoded already. Raises InvalidImage, InvalidIntrinsics."""
    height, width = rgb.shape[:2]
    target = _target((width, height), long_side)
    if max(width, height) <= DEFAULTS.oversize * max(target):
        target = width, height
    else:
        rgb = np.asarray(cv2.resize(rgb, target, interpolation=cv2.INTER_AREA))
    scale = (target[0] / width, target[1] / height)
    return _query(DecodedPixels(rgb, None, width, height, scale, (0.0, 0.0), ()), None, intrinsics, lens_prior, prior)


def _query(
    decoded: DecodedPixels,
    identity: CameraIdentity | None,
    intrinsics: Intrinsics | None,
    lens_prior: LensPrior | None,
    prior: Pose | None,
) -> Query:
    """Choose the intrinsics (given, EXIF, default), scale them to the decoded image, and undistort it."""
    warnings = list(decoded.warnings)
    if intrinsics is not None:
        require_size(intrinsics, decoded.width, decoded.height, decoded.upright_from_stored)
        source: IntrinsicsSource = "memory" if lens_prior else "given"
    else:
        intrinsics, source, lens_prior = _assumed_intrinsics((decoded.width, decoded.height), identity)
        if source == "guessed":
            warnings.append(
                "The photo's metadata has no focal length; it is estimated with the pose, starting from 28 mm "
                "(35 mm equivalent). Send intrinsics for an exact pose."
            )
    camera = decoded.camera(intrinsics)
    rgb, pinhole, inside = undistorted(decoded.rgb, camera)
    valid_mask = decoded.valid_mask
    # Where nothing was cut off, there is no mask: code without one is faster.
    if inside is not None and not inside.all():
        if valid_mask is not None:
            inside = inside & (undistorted(valid_mask.astype(np.uint8), camera)[0] > 0)
        valid_mask = inside
    turned = decoded.upright_from_stored[0]
    given = rgb, pinhole, source, intrinsics, prior, tuple(warnings), valid_mask, lens_prior
    return Query(*given, rows_are_columns=turned)


def _assumed_intrinsics(
    size: tuple[int, int], identity: CameraIdentity | None
) -> tuple[Intrinsics, IntrinsicsSource, LensPrior]:
    """Return the intrinsics of a photo that came without any: by EXIF's likeliest focal length, or the default."""
    modes = exif_focal_prior(identity) if identity else ()
    focal = max(size) * (float(np.exp(modes[0].log_focal)) if modes else DEFAULTS.default_focal)
    source: IntrinsicsSource = "exif" if modes else "guessed"
    prior = LENS_PRIORS[source]
    if modes:
        prior = replace(prior, log_focal_scale=modes[0].sigma)
    if identity and identity.is_cropped:
        prior = replace(prior, principal_point_scale=DEFAULTS.cropped_principal_point_scale)
    intrinsics = Intrinsics(*size, focal, focal, size[0] / 2, size[1] / 2, trust="approximate")
    return intrinsics, source, prior


def encode_image(
    rgb: UInt8[np.ndarray, "h w c"] | Float32[np.ndarray, "h w c"],
    kind: Literal["jpg", "png"] = "jpg",
    *,
    quality: int = 90,
) -> bytes:
    """Encode an image (uint8, or float32 in 0..1, clipped) as a file; `quality` is JPEG's, 1..100; PNG may be RGBA."""
    if rgb.dtype != np.uint8:
        rgb = np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if kind == "jpg" else []
    order = [2, 1, 0, *range(3, rgb.shape[2])]  # OpenCV writes BGR
    encoded, data = cv2.imencode(f".{kind}", np.ascontiguousarray(rgb[:, :, order]), options)
    if not encoded:
        raise ValueError(f"an image of shape {rgb.shape} can't be {kind}")
    return data.tobytes()


def undistorted_jpeg(jpeg: bytes, intrinsics: Intrinsics) -> bytes:
    """Return one of our own JPEGs as the image of a pinhole, black outside the photo; see `undistorted`."""
    with JpegImageFile(BytesIO(jpeg)) as image:
        rgb = np.asarray(image.convert("RGB"))
    return encode_image(undistorted(rgb, intrinsics)[0])


def with_focal_35mm(jpeg: bytes, focal_mm: int) -> bytes:
    """Return a JPEG without EXIF with this 35 mm equivalent focal length in one."""
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal_mm
    segment = exif.tobytes()
    # Right after the start of the image; a segment's length counts its own two bytes.
    return jpeg[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + jpeg[2:]


def with_palette(png: bytes) -> bytes:
    """Return a PNG with 256 colours of its own, opaque: about a third of the bytes."""
    shown = BytesIO()
    Image.open(BytesIO(png)).convert("RGB").quantize(256).save(shown, "png", optimize=True)
    return shown.getvalue()


def resized(rgb: Float32[np.ndarray, "h w 3"], width: int, height: int) -> Float32[np.ndarray, "height width 3"]:
    """Resample an image: area averages where it shrinks, which prevents aliasing, else bilinear."""
    shrinks = width * height < rgb.shape[0] * rgb.shape[1]
    mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(rgb, (width, height), interpolation=mode), np.float32)


def photo_size(data: bytes) -> tuple[int, int]:
    """Return width and height of the upright photo, from its header. Raises InvalidImage."""
    _, photo = _open(data, header_only=True)
    transpose, _, _ = ORIENTATIONS[_orientation(photo)]
    return (photo.height, photo.width) if transpose else photo.size


def _open(data: bytes, *, header_only: bool = False) -> tuple[str, Image.Image]:
    """Read the header and check the size. Raises InvalidImage."""
    if not data:
        raise InvalidImage("the photo is empty (0 bytes).", where="photo")
    # By its first bytes: what a client says of a file's type or name need not be true.
    if unread := unread_format(data):
        raise InvalidImage(f"{unread} file is not read here.", where="photo", hint="Convert it to JPEG.")
    matching = [(name, decoder, limit) for name, decoder, limit, begins_like in _DECODERS if begins_like(data)]
    if not matching:
        raise InvalidImage("not a JPEG, PNG, WebP or HEIC photo.", where="photo")
    name, decoder, limit = matching[0]
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
    if not isinstance(photo, JpegImageFile):
        return name, photo
    # Three times the pixels: looking for the end of a photo must take no longer than to decode the largest.
    mends = not header_only and 3 * photo.width * photo.height <= limit
    return name, _checked_jpeg(photo, data, mends_end=mends)


def _checked_jpeg(photo: JpegImageFile, data: bytes, *, mends_end: bool) -> JpegImageFile:
    """Return the JPEG, on request with an end if nothing but that is missing, for which it is decoded twice.

    Raises InvalidImage if it has too many scans.
    """
    scans, has_end = scans_and_end(data)
    if scans > DEFAULTS.max_scans:
        raise InvalidImage(
            f"a JPEG of {scans} scans; the limit is {DEFAULTS.max_scans}.", where="photo", hint="Save it again."
        )
    mends_end = mends_end and not has_end and lacks_only_its_end(data, _pixels_hash)
    return JpegImageFile(BytesIO(data + END)) if mends_end else photo


def _pixels_hash(jpeg: bytes) -> bytes:
    """Return a hash of a JPEG's pixels. Raises OSError."""
    return hashlib.sha256(JpegImageFile(BytesIO(jpeg)).tobytes()).digest()


def _heic(data: bytes, max_pixels: int) -> Image.Image:
    """Decode in another process; of a larger photo only the header. Raises ValueError."""
    decoded = decode_heic(data, max_pixels, DEFAULTS.max_heic_s)
    size = decoded.width, decoded.height
    photo = Image.frombuffer(decoded.mode, size, decoded.pixels) if decoded.pixels else _HeaderOnly(*size)
    photo.info["exif"] = decoded.exif
    return photo


class _HeaderOnly(Image.Image):
    """A photo that wasn't decoded: its size and EXIF."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__()
        self._size = width, height


def _target(size: tuple[int, int], long_side: int) -> tuple[int, int]:
    """Return the size to reduce a photo to. Raises InvalidImage if it is too small."""
    # Half a pixel of tolerance: a side that rounds to the minimum is enough.
    if min(size) * min(1.0, DEFAULTS.long_side_px / max(size)) < DEFAULTS.min_side_px - 0.5:
        raise InvalidImage(
            f"{size[0]} x {size[1]} is too small or too narrow to localize: the short side must have "
            f"{DEFAULTS.min_side_px} pixels when the long one has at most {DEFAULTS.long_side_px}.",
            where="photo",
        )
    factor = min(1.0, long_side / max(size))
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def _decode(photo: Image.Image, name: str, background_rgb: tuple[float, float, float], long_side: int) -> DecodedPixels:
    """Decode, reduce and turn upright, keeping track of where rays go. Raises InvalidImage."""
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
    # JPEG's reduction rounds up to whole pixels: the decoded image may cover a fraction of a pixel more than the photo.
    covered = (pixels.shape[1] * step[0], pixels.shape[0] * step[1])
    # Intrinsics were checked against the header's size: another one would shift every ray.
    if min(covered[0] - raw_size[0], covered[1] - raw_size[1]) < 0:
        raise InvalidImage(f"the {name} decodes to another size than its header says.", where="photo")
    layers = [pixels] if alpha is None else [pixels, alpha]
    if max(pixels.shape[:2]) <= DEFAULTS.oversize * max(target):
        target = pixels.shape[1], pixels.shape[0]
    else:
        layers = [cv2.resize(layer, target, interpolation=cv2.INTER_AREA) for layer in layers]
    scale = [target[axis] / covered[axis] for axis in (0, 1)]
    # What is covered beyond the photo lies right and below; a mirroring brings it to the left and above.
    beyond = [target[axis] - raw_size[axis] * scale[axis] for axis in (0, 1)]
    transpose, mirror_x, mirror_y = ORIENTATIONS[_orientation(photo)]
    if transpose:
        scale, beyond, raw_size = scale[::-1], beyond[::-1], raw_size[::-1]
    upright = [_oriented(layer, transpose, mirror_x, mirror_y) for layer in layers]
    return DecodedPixels(
        upright[0],
        upright[1] >= DEFAULTS.opaque if len(upright) > 1 else None,
        *raw_size,
        scale=(scale[0], scale[1]),
        offset=(beyond[0] * mirror_x, beyond[1] * mirror_y),
        warnings=tuple(warnings),
        upright_from_stored=(transpose, mirror_x, mirror_y),
    )


def _oriented(layer: UInt8[np.ndarray, "..."], transpose: bool, mirror_x: bool, mirror_y: bool) -> np.ndarray:
    turned = layer.swapaxes(0, 1) if transpose else layer
    return np.ascontiguousarray(turned[:: -1 if mirror_y else 1, :: -1 if mirror_x else 1])


def _rgb(
    photo: Image.Image, background_rgb: tuple[float, float, float]
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"] | None, list[str]]:
    """Return colours, opacity unless all is opaque, and warnings."""
    rgb, alpha = np.empty((photo.height, photo.width, 3), np.uint8), None
    rows = max(1, DEFAULTS.band_pixels // photo.width)
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
    """Return EXIF's orientation, 1..8; 1 (upright) where it is missing or broken, and of HEIC, decoded upright."""
    value = _exif(photo).get(ExifTags.Base.Orientation, 1)
    return value if value in ORIENTATIONS else 1


def _identity(photo: Image.Image) -> CameraIdentity:
    tags = _exif(photo)
    return identity_from_exif(tags, tags.get_ifd(ExifTags.IFD.Exif), photo.size, _orientation(photo))


def _exif(photo: Image.Image) -> Image.Exif:
    """Return the photo's EXIF; an empty one if it has none or a broken one."""
    if "exif" not in photo.info:  # `getexif` of a PNG would decode it
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
