"""Read Niantic's .spz, versions 1 to 4: quantized arrays, one gzip stream (to version 3) or one zstd stream each (4).

Positions are fixed-point numbers of 24 bits (half floats in version 1), scales bytes (16 steps per unit of their
logarithm), rotations three bytes (to version 2) or the "smallest three" in 4 bytes. The axes are right, up, back
(RUB), those of a .ply right, down, front: Gaussians are turned by 180 degrees about x. An own decoder: gsply's turns no
axes, and runs on numba's thread pool, which is not safe for concurrent callers. https://github.com/nianticlabs/spz
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard
from jaxtyping import Float32, UInt8

from service.errors import CorruptScene, UnsupportedFormat
from service.scene_formats.gaussians import RawGaussians, cut_sh, require_count
from service.scene_formats.similarity import moved_gaussians

SUFFIXES = (".spz",)
_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_ANTIALIASED = 1
"""The flag of scenes that were trained with antialiasing."""
_COLOUR_SCALE = np.float32(0.15)
_RDF_FROM_RUB = np.diag([1.0, -1.0, -1.0, 1.0])
_COEFFICIENTS = (0, 3, 8, 15, 24)


def accepts(head: bytes, suffix: str) -> bool:
    """Whether it begins like version 4, or like a gzip file and has the suffix."""
    return head.startswith(_MAGIC) or (suffix in SUFFIXES and head.startswith(_GZIP))


def read(path: Path) -> RawGaussians:
    """Return the Gaussians in the axes of a .ply. Raises CorruptScene, UnsupportedFormat; sizes are checked first."""
    return moved_gaussians(decoded(path.read_bytes(), path.name), _RDF_FROM_RUB)


def decoded(data: bytes, where: str) -> RawGaussians:
    """Return the Gaussians of a whole file of any version, in its own axes, which are glTF's. Raises as `read`."""
    if data.startswith(_GZIP):
        return _legacy(data, where)
    header = _header(data, where, versions=(4,))
    if len(data) < 32:
        raise CorruptScene("truncated within the header of 32 bytes.", where=where)
    streams, toc = data[15], struct.unpack_from("<I", data, 16)[0]
    sections = header.sections()
    # What is empty (SH of degree 0) has no stream.
    present = [(name, size) for name, size in sections.items() if size]
    if streams < len(present) or toc + 16 * streams > len(data):
        raise CorruptScene(f"its table names {streams} streams at byte {toc}.", where=where)
    at, parts = toc + 16 * streams, dict.fromkeys(sections, b"")
    for number, (name, size) in enumerate(present):
        packed, unpacked = struct.unpack_from("<QQ", data, toc + 16 * number)
        if unpacked != size or at + packed > len(data):
            raise CorruptScene(f"'{name}' has {unpacked} bytes; {size} are needed.", where=f"{where}, byte {at}")
        parts[name] = _zstd(data[at : at + packed], size, f"{where}, byte {at}")
        at += packed
    return _gaussians(header, parts, where)


@dataclass(frozen=True, slots=True)
class _Header:
    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int

    def sections(self) -> dict[str, int]:
        """Return the sizes of the arrays in bytes, in the file's order."""
        n = self.count
        return {
            "positions": (6 if self.version == 1 else 9) * n,
            "alphas": n,
            "colours": 3 * n,
            "scales": 3 * n,
            "rotations": (3 if self.version < 3 else 4) * n,
            "sh": 3 * _COEFFICIENTS[self.degree] * n,
        }


def _header(data: bytes, where: str, versions: tuple[int, ...]) -> _Header:
    if len(data) < 16 or not data.startswith(_MAGIC):
        raise CorruptScene("not an SPZ file: it doesn't begin with 'NGSP'.", where=where)
    version, count, degree, bits, flags = struct.unpack_from("<IIBBB", data, 4)
    if version not in versions:
        raise UnsupportedFormat(
            f"SPZ version {version} in this container; known: {', '.join(map(str, versions))}.", where=where
        )
    if degree >= len(_COEFFICIENTS) or bits > 24:
        raise CorruptScene(f"SH degree {degree}, {bits} fractional bits; the limits are 4 and 24.", where=where)
    require_count(count, where)
    return _Header(version, count, degree, bits, flags)


def _legacy(data: bytes, where: str) -> RawGaussians:
    """Decode versions 1 to 3. No more is unpacked than the header allows: small files can unpack to any size."""
    stream = zlib.decompressobj(31)
    try:
        head = stream.decompress(data, 16)
        header = _header(head, where, versions=(1, 2, 3))
        sections = header.sections()
        needed = sum(sections.values())
        body = stream.decompress(stream.unconsumed_tail, needed)
    except zlib.error as error:
        raise CorruptScene(f"its gzip stream is damaged: {error}.", where=where) from None
    if len(body) < needed:
        raise CorruptScene(f"truncated: {len(body)} of {needed} bytes.", where=where, hint="Copy or export it again.")
    parts, at = {}, 0
    for name, size in sections.items():
        parts[name] = body[at : at + size]
        at += size
    return _gaussians(header, parts, where)


def _zstd(data: bytes, size: int, where: str) -> bytes:
    try:
        # A frame that says it is larger is refused before it is unpacked; one that says nothing is cut.
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data) as stream:
            result = stream.read(size)
    except zstandard.ZstdError as error:
        raise CorruptScene(f"its zstd stream is damaged: {error}.", where=where) from None
    if len(result) < size:
        raise CorruptScene(f"truncated: {len(result)} of {size} bytes.", where=where)
    return result


def _gaussians(header: _Header, parts: dict[str, bytes], where: str) -> RawGaussians:
    n = header.count
    array = {name: np.frombuffer(data, np.uint8).reshape(n, -1) for name, data in parts.items()}
    rest = array["sh"].reshape(n, -1, 3).astype(np.float32)
    colours = (array["colours"].astype(np.float32) / 255 - np.float32(0.5)) / _COLOUR_SCALE
    sh, warnings = cut_sh(np.concatenate([colours[:, None], (rest - 128) / 128], 1))
    unpacked = _smallest_three if header.version >= 3 else _first_three
    return RawGaussians(
        means=_positions(header, array["positions"]),
        quats=unpacked(array["rotations"]),
        scales=np.exp(array["scales"].astype(np.float32) / 16 - 10),
        opacities=array["alphas"][:, 0].astype(np.float32) / 255,
        sh=sh,
        render_mode="antialiased" if header.flags & _ANTIALIASED else None,
        warnings=warnings,
    )


def _positions(header: _Header, data: UInt8[np.ndarray, "n b"]) -> Float32[np.ndarray, "n 3"]:
    if header.version == 1:
        return np.ascontiguousarray(data).view("<f2").astype(np.float32)
    low, middle, high = np.moveaxis(data.reshape(len(data), 3, 3).astype(np.int32), 2, 0)
    # The sign bit of 24 is brought to that of 32 and back.
    numbers = (low | middle << 8 | high << 16) << 8 >> 8
    return (numbers / float(1 << header.fractional_bits)).astype(np.float32)


def _first_three(data: UInt8[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 4"]:
    """Decode x, y, z of unit quaternions with w >= 0, as wxyz."""
    xyz = data.astype(np.float32) / np.float32(127.5) - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1, keepdims=True)))
    return np.concatenate([w, xyz], 1)


def _smallest_three(data: UInt8[np.ndarray, "n 4"]) -> Float32[np.ndarray, "n 4"]:
    """Decode 2 bits with the index (xyzw) of the largest component; sign and 9 bits each of the others, as wxyz."""
    packed = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.uint32)
    largest = (packed >> 30).astype(np.intp)
    fields = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], 1)
    magnitudes = (fields & 511).astype(np.float32) * np.float32(np.sqrt(0.5) / 511)
    others = np.where(fields >> 9, -magnitudes, magnitudes)
    rows = np.arange(len(packed))[:, None]
    xyzw = np.empty((len(packed), 4), np.float32)
    # The first of the others lies in the highest bits.
    xyzw[rows, np.arange(3) + (np.arange(3) >= largest[:, None])] = others
    xyzw[rows[:, 0], largest] = np.sqrt(np.maximum(0, 1 - (others**2).sum(1)))
    return xyzw[:, [3, 0, 1, 2]]
