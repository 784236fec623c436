"""Which camera took a photo, and with which focal length, by what its EXIF data says; nothing of it is trusted.

EXIF is written by cameras, editors and attackers alike: every value is checked for type and range, and what fails is
left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

_MAKE, _MODEL, _LENS_MODEL = 0x010F, 0x0110, 0xA434
_FOCAL_LENGTH, _FOCAL_35MM, _DIGITAL_ZOOM = 0x920A, 0xA405, 0xA404
_PIXEL_WIDTH, _PIXEL_HEIGHT = 0xA002, 0xA003
_MAX_TEXT = 64
"""Characters of a name: makers use up to 40."""
_SAME_ASPECT = 0.01
"""Relative difference of two aspect ratios that is no crop, beside that of rounding to whole pixels."""


@dataclass(frozen=True, slots=True)
class CameraIdentity:
    """A photo's camera by its header: by this, photos of one camera in one setting are recognized."""

    width: int
    """Of the photo as it is stored, before its EXIF orientation is applied."""
    height: int
    orientation: int = 1
    """EXIF's, 1..8: how the stored photo has to be turned to be upright."""
    is_video: bool = False
    make: str = ""
    model: str = ""
    lens_model: str = ""
    focal_length_mm: float | None = None
    """Of the lens, rounded to 0.01 mm."""
    focal_35mm: float | None = None
    """Focal length in mm of a 36 x 24 mm camera with the same field of view."""
    digital_zoom: float = 1.0
    exif_width: int | None = None
    """Of the photo as the camera stored it, by EXIF; programs that crop or resize often leave it."""
    exif_height: int | None = None

    @property
    def is_named(self) -> bool:
        """Whether EXIF names the camera's make or model."""
        return bool(self.make or self.model)

    @property
    def aspect(self) -> float:
        """Long side over short side, whichever way the camera was held; to two digits, for resized photos."""
        return round(_aspect(self.width, self.height), 2)

    @property
    def is_cropped(self) -> bool:
        """Whether the photo has another shape than the camera stored, and fits into that."""
        if self.exif_width is None or self.exif_height is None:
            return False
        before, now = sorted((self.exif_width, self.exif_height)), sorted((self.width, self.height))
        fits = now[0] <= before[0] and now[1] <= before[1]
        return fits and abs(_aspect(*before) / _aspect(*now) - 1) > _SAME_ASPECT + 1 / now[0]


def identity_from_exif(
    tags: Mapping[int, Any], exif_tags: Mapping[int, Any], size: tuple[int, int], orientation: int
) -> CameraIdentity:
    """Read an identity from EXIF's first directory and its Exif directory, as values by tag number.

    `size` is the stored photo's width and height in pixels, `orientation` EXIF's, checked.
    """
    focal_length = _number(exif_tags.get(_FOCAL_LENGTH), 0.1, 10_000.0)
    pixels = [_number(exif_tags.get(tag), 1, 1_000_000) for tag in (_PIXEL_WIDTH, _PIXEL_HEIGHT)]
    return CameraIdentity(
        *size,
        orientation,
        make=_text(tags.get(_MAKE)),
        model=_text(tags.get(_MODEL)),
        lens_model=_text(exif_tags.get(_LENS_MODEL)),
        focal_length_mm=None if focal_length is None else round(focal_length, 2),
        focal_35mm=_number(exif_tags.get(_FOCAL_35MM), 4.0, 2000.0),
        # 0 means that digital zoom was not used.
        digital_zoom=round(_number(exif_tags.get(_DIGITAL_ZOOM), 1.0, 200.0) or 1.0, 2),
        exif_width=None if None in pixels else int(pixels[0] or 0),
        exif_height=None if None in pixels else int(pixels[1] or 0),
    )


@dataclass(frozen=True, slots=True)
class FocalMode:
    """A value that a photo's focal length may well have, with a normal distribution about it."""

    log_focal: float
    """Logarithm of the focal length over the photo's long side."""
    sigma: float
    probability: float


@dataclass(frozen=True, slots=True)
class ExifFocalConfig:
    """How far the 35 mm equivalent is believed. Estimates: no photos with known lenses back them."""

    tag_sigma: float = 0.03
    """Of one definition: whole millimetres are 1.1 % at 26 mm; focusing and stabilization move the lens by 1 %."""
    zoom_probability: float = 0.3
    """That the tag leaves out a digital zoom that EXIF states beside it; Apple's includes it."""
    resampled_probability: tuple[float, float] = (0.3, 0.8)
    """That a photo which was evidently cropped was resized, too: of one with more than half of the frame's pixels
    along its short side, and of a smaller one."""
    longer_probability: float = 0.08
    """That the photo shows less than the tag says: cropped or zoomed without a trace."""
    longer_log: float = 0.4
    longer_sigma: float = 0.3
    """A crop to half of the width is 0.69."""
    max_focal: float = 100.0
    """In long sides of the photo: no lens has more, 2000 mm are 56."""


EXIF_FOCAL = ExifFocalConfig()


def exif_focal_prior(identity: CameraIdentity, config: ExifFocalConfig = EXIF_FOCAL) -> tuple[FocalMode, ...]:
    """Return what the 35 mm equivalent says of the focal length, likeliest first; probabilities add up to 1.

    Makers define it by the width (36 mm) or the diagonal (43.27 mm) of the frame: the first mode lies between both,
    and its sigma spans them. Of a photo that was evidently cropped the tag is of the whole frame, whose size in pixels
    EXIF has. Empty where there is no such tag, or it and the sizes together are of no lens.
    """
    if identity.focal_35mm is None:
        return ()
    long_side, (frame_long, frame_short) = max(identity.width, identity.height), _frame(identity)
    by_width = float(np.log(identity.focal_35mm / 36.0 * frame_long / long_side))
    diagonal = np.hypot(frame_long, frame_short) / frame_long
    half_gap = float(np.log(diagonal * 36.0 / np.hypot(36.0, 24.0))) / 2
    if by_width > np.log(config.max_focal):
        return ()
    middle, sigma = by_width + half_gap, float(np.hypot(config.tag_sigma, half_gap))
    others = [FocalMode(middle + config.longer_log, config.longer_sigma, config.longer_probability)]
    if identity.digital_zoom > 1.0:
        zoomed = middle + float(np.log(identity.digital_zoom))
        others.append(FocalMode(zoomed, sigma, config.zoom_probability))
    if identity.is_cropped:
        # Between the whole long side and a part as long as the short side, resized to any number of pixels.
        least, most = (middle - float(np.log(side / long_side)) for side in (frame_long, frame_short))
        probability = config.resampled_probability[2 * long_side < frame_short]
        others.append(FocalMode((least + most) / 2, (most - least) / 2 + sigma, probability))
    # Each is independent of the others: the tag alone is right if none of them is.
    tag = float(np.prod([1 - mode.probability for mode in others]))
    modes = [FocalMode(middle, sigma, tag), *others]
    total = sum(mode.probability for mode in modes)
    scaled = [FocalMode(mode.log_focal, mode.sigma, mode.probability / total) for mode in modes]
    return tuple(sorted(scaled, key=lambda mode: -mode.probability))


def _frame(identity: CameraIdentity) -> tuple[int, int]:
    """Return long and short side, in the photo's pixels, of the frame that the 35 mm equivalent refers to."""
    if identity.is_cropped and identity.exif_width and identity.exif_height:
        sides = identity.exif_width, identity.exif_height
    else:
        sides = identity.width, identity.height
    return max(sides), min(sides)


def _aspect(a: float, b: float) -> float:
    return max(a, b) / max(min(a, b), 1)


def _text(value: Any) -> str:
    """Return a printable text of bounded length; empty for what is none."""
    if isinstance(value, bytes):
        value = value[: 4 * _MAX_TEXT].decode("utf-8", "replace")
    if not isinstance(value, str):
        return ""
    printable = "".join(c for c in value[: 4 * _MAX_TEXT].partition("\0")[0] if c.isprintable())
    return printable.strip()[:_MAX_TEXT]


def _number(value: Any, low: float, high: float) -> float | None:
    """Return a number within bounds; None for what is none, as a fraction over zero or a list of several."""
    if isinstance(value, tuple | list) and len(value) == 1:
        value = value[0]
    if isinstance(value, bool | str | bytes | tuple | list | dict) or value is None:
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return None
    return number if low <= number <= high else None
