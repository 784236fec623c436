"""The rows of `splatfix bench field`: what is changed of lens, photo or scene, one factor at a time; and combinations.

A row's name is group/factor=value/what is told of the lens; patterns choose rows by it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal, get_args

from service.bench.lens_modifications import RAYS_MODIFICATIONS
from service.errors import UnknownName
from service.types import Intrinsics

Told = Literal["told", "approximate", "exif", "withheld", "pinhole", "centred"]
"""What is sent of the lens: the true intrinsics (with the row's focal factor); these as approximate ones; nothing but
EXIF's 35 mm focal length; nothing; the true ones as those of an exact pinhole; with the principal point in the middle.
"""
TOLD: tuple[Told, ...] = get_args(Told)


@dataclass(frozen=True, slots=True)
class Row:
    """Queries that differ from a plain photo in one way."""

    name: str
    told: Told = "told"
    modify: tuple[str, ...] = ()
    """Modifications of the photo, in their order."""
    modify_scene: tuple[str, ...] = ()

    @property
    def pool(self) -> str:
        """The name without its values: rows that are alike are counted together."""
        return re.sub(r"=[^/]*", "", self.name)

    @property
    def group(self) -> str:
        """lens, photo, scene or random."""
        return self.name.partition("/")[0]

    def fits(self, lens: Intrinsics) -> bool:
        """Whether the row can be made of a photo with this lens."""
        names = [spec.partition("=")[0] for spec in self.modify]
        bends = any(name in RAYS_MODIFICATIONS for name in names)
        distorted = lens.model not in ("PINHOLE", "SIMPLE_PINHOLE")
        # A second distortion has no model; without any there is nothing to conceal.
        if distorted and (bends or "roll" in names):
            return False
        return self.told != "pinhole" or distorted or bends

    @property
    def needs_occluders(self) -> bool:
        """Whether photos of another scene hide parts."""
        return any(spec.startswith("occlusion=") for spec in self.modify)


K1 = (-0.1, -0.08, -0.04, -0.02, -0.01, 0.01, 0.02, 0.04, 0.08, 0.1)
FOCAL_FACTORS = (0.9, 0.94, 0.97, 1.03, 1.05, 1.1)


def lens_rows() -> list[Row]:
    """Return the rows of lenses: the photo is another camera's, or something else is told of it."""
    told: Sequence[Told] = ("told", "exif", "withheld")
    rows = [_lens_row("", told_one) for told_one in (*told, "pinhole")]
    rows += [_lens_row(f"k1={k1:g}", one) for k1 in K1 for one in (*told, "pinhole")]
    rows += [_lens_row(f"focal={factor:g}", "told") for factor in FOCAL_FACTORS]
    rows += [_lens_row(f"focal={factor:g}", "approximate") for factor in (0.9, 1.1)]
    # EXIF by a third too short or too long: an adapted lens, another camera's tag.
    rows += [_lens_row(f"focal={factor:g}", "exif") for factor in (0.67, 1.33)]
    rows += [_lens_row(f"crop={share:g}", one) for share in (0.75, 0.5) for one in told]
    rows += [_lens_row(f"off_centre={share:g}", one) for share in (0.8, 0.6) for one in (*told, "centred")]
    rows += [_lens_row(f"zoom={factor:g}", one) for factor in (1.5, 2) for one in told]
    rows += [_lens_row("fisheye=1", one) for one in (*told, "pinhole")]
    rows += [_lens_row(f"shutter_{axis}=30", one) for axis in ("yaw", "pitch") for one in told]
    return rows + [Row(f"lens/phone/{one}", one, PHONE) for one in (*told, "pinhole")]


def _lens_row(spec: str, told: Told) -> Row:
    return Row(f"lens/{spec}/{told}" if spec else f"lens/{told}", told, (spec,) if spec else ())


PHONE = ("k1=-0.08", "vignetting=0.3", "gamma=0.9", "saturation=1.2", "white_balance=1.05", "phone_noise=0.03",
         "jpeg=60")  # fmt: skip
"""What a phone makes of a photo."""
PHOTO_SPECS = (
    "gain=0.7", "gain=1.4", "gamma=0.6", "gamma=1.6", "white_balance=1.2", "saturation=0", "blur=4", "noise=0.1",
    "jpeg=20", "scale=0.5", "scale=0.25", "roll=45", "roll=90", "roll=180", "occlusion=0.2", "occlusion=0.35",
    "vignetting=0.5", "vignetting=0.8", "local_light=0.4", "local_light=0.8", "local_light=1.2", "motion_blur=4",
    "motion_blur=8", "colour_cast=0.2", "colour_cast=0.5", "phone_noise=0.05", "phone_noise=0.15",
)  # fmt: skip
"""Modifications of the rows of photos."""
SCREEN_SPECS = ("letterbox=0.2", "letterbox=0.4", "white_bars=0.1")
SCENE_SPECS = (
    "sh_degree=0", "sh_degree=1", "splat=1", "spz=1", "sog=1", "thin=0.5", "thin=0.75", "soft=0.33", "floaters=1",
    "floaters=2", "hole=0.125", "warm=1", "dark=0.5",
)  # fmt: skip


def photo_rows() -> list[Row]:
    """Return the rows of photos: told lens, other pixels. A screenshot says nothing of its lens."""
    rows = [Row(f"photo/{spec}", modify=(spec,)) for spec in PHOTO_SPECS]
    return rows + [Row(f"photo/{spec}/{told}", told, (spec,)) for spec in SCREEN_SPECS for told in ("told", "withheld")]


def scene_rows() -> list[Row]:
    """Return the rows of scenes: plain photos with a told lens, in a scene that something was done to."""
    return [Row(f"scene/{spec}", modify_scene=(spec,)) for spec in SCENE_SPECS]


def all_rows() -> list[Row]:
    """Return the written list of rows."""
    return lens_rows() + photo_rows() + scene_rows()


def chosen_rows(patterns: Sequence[str]) -> list[Row]:
    """Return the rows whose name fits any pattern (`lens/k1=*`); all without patterns. Raises UnknownName."""
    rows = all_rows()
    for pattern in patterns:
        if not any(fnmatchcase(row.name, pattern) for row in rows):
            raise UnknownName(f"no row is like '{pattern}'.", where="row", hint="`--list` prints the rows.")
    return [row for row in rows if not patterns or any(fnmatchcase(row.name, pattern) for pattern in patterns)]
