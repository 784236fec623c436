"""Read the .splat format of web viewers: records of 32 bytes, no header, colours without view dependence."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.errors import CorruptScene
from service.scene_formats.gaussians import RawGaussians, require_count, sh_from_rgb

_RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
SUFFIXES = (".splat",)


def accepts(head: bytes, suffix: str) -> bool:
    """Whether the suffix is the format's, which has no header to recognize it by."""
    return suffix in SUFFIXES and not head.startswith(b"PK\x03\x04")  # a ZIP, of whatever


def read(path: Path) -> RawGaussians:
    """Return the Gaussians; scales are stored as they are, quaternions (wxyz) as 128 + 128 q, colours as bytes.

    Raises CorruptScene.
    """
    size = path.stat().st_size  # the only check that a format without a header allows
    if size % _RECORD.itemsize:
        raise CorruptScene(
            f"{size} bytes are not a whole number of {_RECORD.itemsize}-byte records.",
            where=f"{path.name}, record {size // _RECORD.itemsize}",
            hint="The file is truncated or no .splat: copy or export it again.",
        )
    require_count(size // _RECORD.itemsize, path.name)
    records = np.fromfile(path, _RECORD)
    rgba = records["rgba"].astype(np.float32) / np.float32(255)
    return RawGaussians(
        means=records["mean"].astype(np.float32),
        quats=(records["rotation"].astype(np.float32) - 128) / 128,
        scales=records["scale"].astype(np.float32),
        opacities=rgba[:, 3],
        sh=sh_from_rgb(rgba[:, :3]),
    )
