"""Read .ksplat of mkkellogg's viewer: sections of Gaussians in buckets, at compression level 0, 1 or 2.

Level 0 has 4-byte floats; from level 1, positions are 16-bit steps about their bucket's centre, all else is half
floats; at level 2 spherical harmonics are bytes. Scales are stored as they are, colours and opacities as bytes,
quaternions as wxyz. https://github.com/mkkellogg/GaussianSplats3D (SplatBuffer.js)
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from service.errors import CorruptScene, UnsupportedFormat
from service.scene_formats.gaussians import RawGaussians, joined, require_count, sh_from_rgb

SUFFIXES = (".ksplat",)
_HEADER, _SECTION = 4096, 1024
_COEFFICIENTS = (0, 3, 8, 15)
_MAX_SECTIONS = 10_000


def accepts(head: bytes, suffix: str) -> bool:
    """Whether the suffix is the format's, whose header has no mark to recognize it by."""
    return suffix in SUFFIXES and not head.startswith(b"PK\x03\x04")  # a ZIP, of whatever


@dataclass(frozen=True, slots=True)
class _Section:
    count: int
    capacity: int
    """Gaussians that the section has room for."""
    bucket_size: int
    buckets: int
    block_size: float
    bucket_bytes: int
    range: int
    full_buckets: int
    partial_buckets: int
    degree: int

    @property
    def bucket_storage(self) -> int:
        return 4 * self.partial_buckets + self.bucket_bytes * self.buckets


def read(path: Path) -> RawGaussians:
    """Return the Gaussians; SH of degree 0 to 3. Raises CorruptScene, UnsupportedFormat; sizes are checked first."""
    data = np.fromfile(path, np.uint8)
    if len(data) < _HEADER:
        raise CorruptScene(f"truncated: {len(data)} bytes, the header has {_HEADER}.", where=path.name)
    major, minor, sections, count, level = struct.unpack_from("<BBxxI8xIH", data[:_HEADER].tobytes())
    if major != 0 or minor < 1 or level > 2:
        raise UnsupportedFormat(
            f".ksplat version {major}.{minor}, compression level {level}; known: 0.1 and later, 0 to 2.",
            where=path.name,
        )
    require_count(count, path.name)
    if sections > _MAX_SECTIONS or _HEADER + _SECTION * sections > len(data):
        raise CorruptScene(f"{sections} sections in {len(data)} bytes.", where=path.name)
    low, high = (float(value) for value in struct.unpack_from("<2f", data[:_HEADER].tobytes(), 36))
    # 0 stands for the writer's default range.
    bounds = (low or -1.5, high or 1.5)
    at, found = _HEADER + _SECTION * sections, []
    for number in range(sections):
        section = _section(data, _HEADER + _SECTION * number, level, f"{path.name}, section {number}")
        # Sections lie one after the other with all the room they have, used or not.
        end = at + section.bucket_storage + _record(level, section.degree).itemsize * section.capacity
        if section.count > section.capacity or end > len(data):
            raise CorruptScene(
                f"truncated: section {number} ends at byte {end}.", where=f"{path.name}, byte {len(data)}"
            )
        if section.count:
            found.append(_gaussians(data[at:end], section, level, bounds, f"{path.name}, section {number}"))
        at = end
    if sum(len(part.means) for part in found) != count:
        raise CorruptScene(f"its sections don't hold the {count} Gaussians of the header.", where=path.name)
    return joined(found)


def _record(level: int, degree: int) -> np.dtype:
    number, position = ("<f4", "<f4") if level == 0 else ("<f2", "<u2")
    harmonic = "u1" if level == 2 else number
    return np.dtype(
        [
            ("mean", position, 3),
            ("scale", number, 3),
            ("quat", number, 4),
            ("rgba", "u1", 4),
            ("sh", harmonic, (3 * _COEFFICIENTS[degree],)),
        ]
    )


def _section(data: np.ndarray, at: int, level: int, where: str) -> _Section:
    values = struct.unpack_from("<IIIIfH2xI4xIIH", data[at : at + _SECTION].tobytes())
    count, capacity, bucket_size, buckets, block_size, bucket_bytes, steps, full, partial, degree = values
    if degree >= len(_COEFFICIENTS):
        raise CorruptScene(f"SH degree {degree}; the limit is 3.", where=where)
    if buckets and (bucket_bytes != 12 or full + partial > buckets or not np.isfinite(block_size)):
        raise CorruptScene(f"{full} full and {partial} other buckets of {buckets}.", where=where)
    # 0 stands for the default of the level.
    steps = steps or (1 if level == 0 else 32_767)
    return _Section(*(count, capacity, bucket_size, buckets, block_size, bucket_bytes, steps, full, partial, degree))


def _gaussians(
    data: np.ndarray, section: _Section, level: int, bounds: tuple[float, float], where: str
) -> RawGaussians:
    records = data[section.bucket_storage :].view(_record(level, section.degree))[: section.count]
    means = records["mean"].astype(np.float32)
    if level:
        start = 4 * section.partial_buckets
        centres = data[start : section.bucket_storage].view("<f4").reshape(-1, 3)
        steps = (means - section.range) * np.float32(section.block_size / 2 / section.range)
        means = steps + centres[_buckets(data, section, where)]
    rgba = records["rgba"].astype(np.float32) / 255
    rest = records["sh"].astype(np.float32)
    if level == 2:
        rest = bounds[0] + rest / 255 * (bounds[1] - bounds[0])
    return RawGaussians(
        means=means,
        quats=records["quat"].astype(np.float32),
        scales=records["scale"].astype(np.float32),
        opacities=rgba[:, 3],
        sh=np.concatenate([sh_from_rgb(rgba[:, :3]), _rest(rest.astype(np.float32))], 1),
    )


def _buckets(data: np.ndarray, section: _Section, where: str) -> Int64[np.ndarray, "n"]:
    """Return the bucket of each Gaussian: full ones first, then the others with their sizes."""
    sizes = data[: 4 * section.partial_buckets].view("<u4").astype(np.int64)
    full = section.full_buckets * section.bucket_size
    if full + int(sizes.sum()) != section.count:
        raise CorruptScene(f"its buckets don't hold its {section.count} Gaussians.", where=where)
    of_full = np.arange(full, dtype=np.int64) // max(section.bucket_size, 1)
    return np.concatenate([of_full, section.full_buckets + np.repeat(np.arange(len(sizes)), sizes)])


def _rest(values: Float32[np.ndarray, "n m"]) -> Float32[np.ndarray, "n k 3"]:
    """Reorder the SH of degree 1 and more: stored band by band, in each all of red, then green, then blue."""
    bands = [
        values[:, 3 * first : 3 * last] for first, last in ((0, 3), (3, 8), (8, 15)) if values.shape[1] >= 3 * last
    ]
    return np.concatenate(
        [np.empty((len(values), 0, 3), np.float32), *(b.reshape(len(b), 3, -1).transpose(0, 2, 1) for b in bands)], 1
    )
