"""The limits and sizes of decoding photos."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DecodeConfig:
    """Limits against hostile files, and the size and focal length that a photo is given."""

    max_pixels: int = 64 * 1024 * 1024
    """A phone's 64 megapixels are 9248 x 6936: more than 64 million, less than this."""
    max_pixels_webp: int = 25 * 1024 * 1024
    """WebP can't be decoded at a reduced size, and 64 megapixels, which 120 kB may hold, would take 1.9 GB."""
    max_scans: int = 24
    """Of a progressive JPEG. Each is a pass over all pixels and takes 100 bytes of a hostile file; encoders make 10."""
    max_heic_s: float = 30.0
    """Wall time of the HEIC decoder; 64 megapixels take two seconds."""
    band_pixels: int = 1 << 21
    """Converted to RGB at once: the whole photo is in memory once as it was decoded, and once as RGB."""
    long_side_px: int = 1000
    """Of `Query.rgb`. Features are extracted at 800 pixels at most; a JPEG of 12 megapixels is decoded at a quarter
    of its size."""
    oversize: float = 1.3
    """Ratio of long sides up to which a decoded photo is kept as it is: resampling would cost more than it saves."""
    min_side_px: int = 32
    """Of `Query.rgb`; the features need more anyway."""
    opaque: int = 128
    """Alpha, of 255, from which on a pixel is valid."""
    default_focal: float = 0.78
    """In long sides; `service/photos/images.py` says why."""
    cropped_principal_point_scale: float = 0.1
    """Scale of the principal point's prior, in long sides, of a photo that has another shape than its camera's."""


DEFAULTS = DecodeConfig()
