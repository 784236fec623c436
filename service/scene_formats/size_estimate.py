"""How much memory a scene will take, by the header of its file: before anything of it is read."""

from __future__ import annotations

from pathlib import Path

from service.errors import SplatfixError
from service.scene_formats.layouts import scene_file
from service.scene_formats.manifest import Manifest, read_manifest
from service.scene_formats.ply_header import read_header

_GEOMETRY_BYTES = 44
"""Of a Gaussian: mean, rotation, scales and opacity, as float32."""
_COLOUR_BYTES = 12
"""Of each spherical harmonic."""
_COPIES = 2
"""The scene's arrays, and the renderer's."""
_SPLAT_RECORD_BYTES = 32


def estimated_bytes(path: Path) -> int | None:
    """Return the memory of a scene folder or file once it is loaded, within some per cent.

    None where the header doesn't have it: of compressed formats, and of files that loading will refuse.
    """
    try:
        file, _ = scene_file(path, read_manifest(path) if path.is_dir() else Manifest())
        if file.suffix == ".splat":
            return _of(file.stat().st_size // _SPLAT_RECORD_BYTES, 1)
        if file.suffix != ".ply":
            return None
        vertices = read_header(file).element("vertex")
        if vertices is None or vertices.dtype is None:
            return None
        rest = sum(name.startswith("f_rest_") for name in vertices.dtype.names or ())
        return _of(vertices.count, 1 + rest // 3)
    except (OSError, SplatfixError):
        return None


def _of(gaussians: int, harmonics: int) -> int:
    return gaussians * _COPIES * (_GEOMETRY_BYTES + _COLOUR_BYTES * harmonics)
