"""Read a gzipped .ply of any layout: it is unpacked into a temporary file of bounded size and read from there."""

from __future__ import annotations

import gzip
import tempfile
import zlib
from pathlib import Path

from service.errors import CorruptScene, SceneError
from service.scene_formats import compressed_ply, ply
from service.scene_formats.gaussians import RawGaussians

SUFFIXES = (".ply.gz",)
_GZIP = b"\x1f\x8b"
MAX_BYTES = 8 * 1024**3
"""Unpacked: more than the largest scene of 20 million Gaussians at SH degree 3 takes."""
MAX_RATIO = 50
"""Of unpacked to packed size: quantized scenes reach 10; a bomb 1000."""
_CHUNK = 1 << 20
_HEAD = 4096


def accepts(head: bytes, suffix: str) -> bool:
    """Whether it is a gzip file with the suffix."""
    return suffix in SUFFIXES and head.startswith(_GZIP)


def read(path: Path) -> RawGaussians:
    """Return the Gaussians as the reader of the unpacked file does. Raises CorruptScene, UnsupportedFormat."""
    limit = min(MAX_BYTES, MAX_RATIO * path.stat().st_size + (1 << 20))
    with tempfile.TemporaryDirectory() as folder:
        unpacked = Path(folder, path.name.removesuffix(path.suffix))
        _unpack(path, unpacked, limit)
        with unpacked.open("rb") as file:
            head = file.read(_HEAD)
        try:
            return (compressed_ply if compressed_ply.accepts(head, ".ply") else ply).read(unpacked)
        except SceneError as error:
            error.where = error.where.replace(unpacked.name, path.name)
            raise


def _unpack(source: Path, target: Path, limit: int) -> None:
    try:
        with gzip.open(source) as stream, target.open("wb") as file:
            while chunk := stream.read(_CHUNK):
                limit -= len(chunk)
                if limit < 0:
                    raise CorruptScene("it unpacks to more than a scene can have.", where=source.name)
                file.write(chunk)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise CorruptScene(f"its gzip stream is damaged: {error}.", where=source.name) from None
