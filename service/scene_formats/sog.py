"""Read PlayCanvas' SOG, versions 1 and 2: `meta.json` and lossless WebP images, a pixel a Gaussian; a ZIP or a folder.

Positions have 16 bits in a logarithmic scale; scales, colours and SH are entries of code books (version 2) or lie
between bounds (version 1); SH of degree 1 and more are rows of a palette. An own decoder: gsply's needs imagecodecs,
reads members of any size, and runs on numba's thread pool, which is not safe for concurrent callers.
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL.WebPImagePlugin import WebPImageFile

from service.errors import CorruptScene, UnsupportedFormat
from service.scene_formats.gaussians import RawGaussians, require_count
from service.scene_formats.manifest import MAX_JSON_BYTES, numbers, read_json

SUFFIXES = (".sog",)
NAMES = ("meta.json",)
"""Of a file in a folder of its own, beside its images."""
_MAX_PLANE_BYTES = 512 * 1024**2
_PALETTE_COLUMNS = 64
_MAX_PALETTE = 65_536
"""Labels have 16 bits."""
_COEFFICIENTS = {1: 3, 2: 8, 3: 15}
_Load = Callable[[str], bytes]


def accepts(head: bytes, suffix: str) -> bool:
    """Whether it is a ZIP with the suffix, or by name and look the `meta.json` of a folder."""
    return (suffix in SUFFIXES and head.startswith(b"PK")) or (suffix in NAMES and b'"means"' in head)


def read(path: Path) -> RawGaussians:
    """Return the Gaussians of a bundle, or of the folder that a `meta.json` is in.

    Raises CorruptScene, UnsupportedFormat; sizes of images are checked before they are decoded.
    """
    if path.name in NAMES:
        return _decoded(read_json(path), lambda name: _beside(path, name), path.name)
    try:
        with zipfile.ZipFile(path) as bundle:
            meta = json.loads(_member(bundle, "meta.json", MAX_JSON_BYTES, path.name))
            if not isinstance(meta, dict):
                raise CorruptScene("meta.json must be a JSON object.", where=path.name)
            return _decoded(meta, lambda name: _member(bundle, name, _MAX_PLANE_BYTES, path.name), path.name)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError, RuntimeError, ValueError, OSError) as error:
        raise CorruptScene(f"its ZIP archive can't be read: {str(error)[:200]}.", where=path.name) from None


def parts(path: Path) -> list[Path]:
    """Return the images beside a `meta.json`; none of a bundle. Raises CorruptScene."""
    if path.name not in NAMES:
        return []
    names = (name for value in read_json(path).values() if isinstance(value, dict) for name in value.get("files", ()))
    return [file for name in names if isinstance(name, str) and (file := path.parent / Path(name).name).is_file()]


def _member(bundle: zipfile.ZipFile, name: str, limit: int, where: str) -> bytes:
    """Read a file of the bundle, up to `limit` bytes."""
    # With or without a folder around its files.
    entry = next((e for e in bundle.infolist() if e.filename.rsplit("/", 1)[-1] == name), None)
    if entry is None:
        raise CorruptScene(f"the bundle has no '{name[:80]}'.", where=where)
    if entry.file_size > limit or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise CorruptScene(f"'{name[:80]}' is larger than {limit} bytes, or not deflated.", where=where)
    with bundle.open(entry) as file:
        # The size in the directory may be a lie: no more is unpacked than is allowed.
        return file.read(limit)


def _beside(meta: Path, name: str) -> bytes:
    """Read an image in the folder of `meta.json`; not one elsewhere, wherever a link leads."""
    file = meta.parent / name
    if Path(name).name != name or not file.is_file():
        raise CorruptScene(f"image '{name[:80]}' not found beside it.", where=meta.name)
    if not file.resolve().is_relative_to(meta.parent.resolve()) or file.stat().st_size > _MAX_PLANE_BYTES:
        raise CorruptScene(f"'{name[:80]}' is a link out of the folder, or too large.", where=meta.name)
    return file.read_bytes()


def _decoded(meta: dict[str, Any], load: _Load, where: str) -> RawGaussians:
    version = meta.get("version", 1)
    if version not in (1, 2):
        raise UnsupportedFormat(f"SOG version {str(version)[:20]}; known: 1, 2.", where=where)
    shape = _object(meta, "means", where).get("shape")
    count = meta.get("count") if version == 2 else shape[0] if isinstance(shape, list) and shape else None
    if not isinstance(count, int):
        raise CorruptScene("the number of Gaussians must be a whole number.", where=where)
    require_count(count, where)
    means, quats, scales, colours = (_planes(meta, name, load, count, where) for name in _PLANES)
    opacities = colours[0][:, 3].astype(np.float32) / 255
    rgb = _values(meta, "sh0", colours[0][:, : 4 if version == 1 else 3], version, where)
    if version == 1:
        # Logits, the fourth of the bounds.
        opacities = 1 / (1 + np.exp(-rgb[:, 3]))
    sh = np.concatenate([rgb[:, None, :3], _palette(meta, load, count, version, where)], 1)
    with np.errstate(over="ignore"):  # what overflows is left out by `checked`
        return RawGaussians(
            means=_means(meta, means, where),
            quats=_quaternions(quats[0]),
            scales=np.exp(_values(meta, "scales", scales[0][:, :3], version, where)),
            opacities=opacities,
            sh=sh,
            render_mode="antialiased" if meta.get("antialias") is True else None,
        )


_PLANES = {"means": 2, "quats": 1, "scales": 1, "sh0": 1}
"""Attributes and the number of their images."""


def _object(meta: dict[str, Any], name: str, where: str) -> dict[str, Any]:
    value = meta.get(name)
    if not isinstance(value, dict):
        raise CorruptScene(f"'{name}' must be an object.", where=where)
    return value


def _files(meta: dict[str, Any], name: str, number: int, where: str) -> list[str]:
    files = _object(meta, name, where).get("files")
    if not isinstance(files, list) or len(files) < number or not all(isinstance(f, str) for f in files):
        raise CorruptScene(f"'{name}.files' must name {number} image(s).", where=where)
    return files[:number]


def _planes(meta: dict[str, Any], name: str, load: _Load, count: int, where: str) -> list[UInt8[np.ndarray, "n 4"]]:
    # Images are rectangles: up to a row more than there are Gaussians, of small ones up to a block.
    limit = 2 * count + 65_536
    return [
        _pixels(load(file), limit, count, f"{where}: {file[:80]}") for file in _files(meta, name, _PLANES[name], where)
    ]


def _pixels(data: bytes, limit: int, count: int, where: str) -> UInt8[np.ndarray, "n 4"]:
    width, height = _size(data, where)
    if not count <= width * height <= limit:
        raise CorruptScene(f"{width} x {height} pixels; {count} to {limit} are expected.", where=where)
    return _image(data, where).reshape(-1, 4)[:count]


def _size(data: bytes, where: str) -> tuple[int, int]:
    """Return width and height by the file's header: decoders allocate memory as soon as they open a file."""
    kind = data[12:16]
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(data) < 30 or kind not in (b"VP8L", b"VP8X"):
        raise CorruptScene("not a lossless WebP image.", where=where)
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    bits = int.from_bytes(data[21:25], "little")
    return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)


def _image(data: bytes, where: str) -> UInt8[np.ndarray, "h w 4"]:
    try:
        return np.asarray(WebPImageFile(BytesIO(data)).convert("RGBA"))
    except Exception as error:  # decoders raise almost anything on a broken file
        raise CorruptScene(f"the image can't be decoded: {str(error)[:100]}.", where=where) from None


def _means(meta: dict[str, Any], planes: list[UInt8[np.ndarray, "n 4"]], where: str) -> Float32[np.ndarray, "n 3"]:
    low, high = _bounds(meta, "means", 3, where)
    # An image has 8 bits: the low and the high bytes are two of them.
    share = (planes[0][:, :3] + planes[1][:, :3].astype(np.float64) * 256) / 65_535
    logarithm = low + share * (high - low)
    return (np.sign(logarithm) * np.expm1(np.abs(logarithm))).astype(np.float32)


def _bounds(
    meta: dict[str, Any], name: str, number: int, where: str
) -> tuple[Float64[np.ndarray, "m"], Float64[np.ndarray, "m"]]:
    """Return the lower and upper bound of each channel; 700: exp() of more exceeds the range of numbers."""
    entry = _object(meta, name, where)
    ends = []
    for end in ("mins", "maxs"):
        value = entry.get(end)
        shape = (number,) if isinstance(value, list) else ()
        ends.append(np.broadcast_to(numbers(value, shape, f"{where}: {name}.{end}"), number))
        if np.abs(ends[-1]).max() > 700:
            raise CorruptScene(f"'{name}.{end}' must lie within -700..700.", where=where)
    return ends[0], ends[1]


def _values(
    meta: dict[str, Any], name: str, pixels: UInt8[np.ndarray, "n m"], version: int, where: str
) -> Float32[np.ndarray, "n m"]:
    """Return what bytes stand for: entries of the code book, or steps between the bounds in version 1."""
    if version == 1:
        low, high = _bounds(meta, name, pixels.shape[1], where)
        return (low + pixels / 255 * (high - low)).astype(np.float32)
    book = numbers(_object(meta, name, where).get("codebook"), (256,), f"{where}: {name}.codebook")
    return book.astype(np.float32)[pixels]


def _quaternions(pixels: UInt8[np.ndarray, "n 4"]) -> Float32[np.ndarray, "n 4"]:
    """Decode wxyz: the largest component's index is alpha - 252, the others are +-1/sqrt(2) in 255 steps."""
    largest = np.clip(pixels[:, 3].astype(np.intp) - 252, 0, 3)
    others = (pixels[:, :3].astype(np.float32) / 255 - np.float32(0.5)) * np.float32(np.sqrt(2))
    rows = np.arange(len(pixels))[:, None]
    quats = np.empty((len(pixels), 4), np.float32)
    quats[rows, np.arange(3) + (np.arange(3) >= largest[:, None])] = others
    quats[rows[:, 0], largest] = np.sqrt(np.maximum(0, 1 - (others**2).sum(1)))
    quats[pixels[:, 3] < 252] = (1, 0, 0, 0)
    return quats


def _palette(meta: dict[str, Any], load: _Load, count: int, version: int, where: str) -> Float32[np.ndarray, "n k 3"]:
    """Return the SH of degree 1 and more: a label a Gaussian, 64 palette entries in each row of `centroids`."""
    if "shN" not in meta:
        return np.empty((count, 0, 3), np.float32)
    centroids_file, labels_file = _files(meta, "shN", 2, where)
    data = load(centroids_file)
    width, height = _size(data, f"{where}: {centroids_file[:80]}")
    coefficients = width // _PALETTE_COLUMNS
    if coefficients not in _COEFFICIENTS.values() or height > _MAX_PALETTE // _PALETTE_COLUMNS:
        raise CorruptScene(f"a palette of {width} x {height} pixels; rows have 64 entries.", where=where)
    centroids = _image(data, f"{where}: {centroids_file[:80]}")[:, : _PALETTE_COLUMNS * coefficients, :3]
    entries = centroids.reshape(-1, coefficients, 3)
    labels = _pixels(load(labels_file), 2 * count + 65_536, count, f"{where}: {labels_file[:80]}")
    index = labels[:, 0] + labels[:, 1].astype(np.intp) * 256
    if index.max() >= len(entries):
        raise CorruptScene(f"label {index.max()} of {len(entries)} palette entries.", where=where)
    values = _values(meta, "shN", entries.reshape(-1, 1), version, where)
    return values.reshape(entries.shape)[index]
