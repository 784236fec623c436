"""Read the .ply of 3DGS trainers (Inria's layout) by property name: any order, any number type, normals or none.

nerfstudio's colours without SH (red, green, blue) are read, SH of degree 4 are cut, and the 3D filter of
Mip-Splatting and GOF is applied as their authors fuse it (create_fused_ply.py).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from service.errors import CorruptScene, UnsupportedFormat
from service.scene_formats.gaussians import SH_CUT, RawGaussians, require_count
from service.scene_formats.ply_header import PlyHeader, element_blocks, read_header
from service.scene_formats.unread import refuse_properties
from service.types import SH_C0

_REST_COUNTS = {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}
"""Number of f_rest properties -> SH degree."""
_COLUMNS = {
    "means": ["x", "y", "z"],
    "quats": [f"rot_{i}" for i in range(4)],
    "scales": [f"scale_{i}" for i in range(3)],
    "opacities": ["opacity"],
}
_RGB = ("red", "green", "blue")
_FILTER = "filter_3D"
SUFFIXES = (".ply",)


def accepts(head: bytes, suffix: str) -> bool:
    """Whether it is a PLY without the chunks of the compressed kind."""
    return head.startswith(b"ply") and b"\nelement chunk " not in head


def read(path: Path) -> RawGaussians:
    """Return the activated Gaussians; stored are logarithms of scales, logits of opacities, f_rest channel by channel.

    Raises UnsupportedFormat, CorruptScene.
    """
    header = read_header(path)
    vertex = header.element("vertex")
    if vertex is None or vertex.dtype is None:
        raise UnsupportedFormat("no element 'vertex' of plain properties: not a 3DGS scene.", where=path.name)
    require_count(vertex.count, path.name)
    names = vertex.dtype.names or ()
    refuse_properties(names, path.name)
    degree = _sh_degree(names, path)
    _require_numbers(vertex.dtype, path)
    raw = _activated(path, header, vertex.count, min(degree, 3), sum(name.startswith("f_rest_") for name in names) // 3)
    up, mode = _up(header.comments), _render_mode(header.comments)
    return replace(raw, render_mode=mode, up=up, warnings=(SH_CUT,) if degree > 3 else ())


def _activated(path: Path, header: PlyHeader, count: int, degree: int, per_channel: int) -> RawGaussians:
    """Read and activate the Gaussians; `per_channel` coefficients of f_rest are stored."""
    names = set(_names(header))
    columns = _COLUMNS | ({"filter": [_FILTER]} if _FILTER in names else {})
    values: dict[str, Float[np.ndarray, "_ _"]] = {
        name: np.empty((count, len(listed)), np.float32) for name, listed in columns.items()
    }
    if header.has_doubles("vertex", _COLUMNS["means"]):
        values["means"] = np.empty((count, 3), np.float64)
    sh = np.empty((count, (degree + 1) ** 2, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is left out by `checked`
        # In blocks, straight to where they belong: a large file is never twice in memory.
        for place, records in element_blocks(path, header, "vertex"):
            for name, listed in columns.items():
                for i, column in enumerate(listed):
                    values[name][place, i] = records[column]
            # f_rest has all of red, then green, then blue; the renderers read coefficient by coefficient.
            for channel in range(3):
                sh[place, 0, channel] = _constant(records, channel, names)
                for k in range(1, sh.shape[1]):
                    sh[place, k, channel] = records[f"f_rest_{channel * per_channel + k - 1}"]
        scales = np.exp(values["scales"], out=values["scales"])
        opacities = 1 / (1 + np.exp(-values["opacities"][:, 0]))
        if "filter" in values:
            scales, opacities = _filtered(scales, opacities, values["filter"])
    return RawGaussians(values["means"], values["quats"], scales, opacities, sh)


def _names(header: PlyHeader) -> tuple[str, ...]:
    vertex = header.element("vertex")
    return () if vertex is None or vertex.dtype is None else vertex.dtype.names or ()


def _constant(records: np.ndarray, channel: int, names: set[str]) -> np.ndarray:
    """Return the SH of degree 0, of colours as bytes where there is none."""
    if f"f_dc_{channel}" in names:
        return records[f"f_dc_{channel}"]
    return (records[_RGB[channel]].astype(np.float32) / 255 - 0.5) / SH_C0


def _filtered(
    scales: Float32[np.ndarray, "n 3"], opacities: Float32[np.ndarray, "n"], filter_3d: Float32[np.ndarray, "n 1"]
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n"]]:
    """Convolve each Gaussian with an isotropic one of the filter's size; its integral stays (Mip-Splatting, eq. 7)."""
    squares = scales.astype(np.float64) ** 2
    wider = squares + filter_3d.astype(np.float64) ** 2
    ratio = np.sqrt(np.prod(np.divide(squares, wider, out=np.ones_like(wider), where=wider > 0), 1))
    return np.sqrt(wider).astype(np.float32), (opacities * ratio).astype(np.float32)


def _sh_degree(names: tuple[str, ...], path: Path) -> int:
    """Check the property names and return the degree of the spherical harmonics by their number."""
    rest = [name for name in names if name.startswith("f_rest_")]
    needed = [name for columns in _COLUMNS.values() for name in columns]
    needed += [] if set(_RGB) <= set(names) and not rest else ["f_dc_0", "f_dc_1", "f_dc_2"]
    needed += [f"f_rest_{i}" for i in range(len(rest))]
    missing = [name for name in needed if name not in names]
    if missing:
        raise UnsupportedFormat(f"not a 3DGS scene: element 'vertex' has no {', '.join(missing[:5])}.", where=path.name)
    if len(rest) not in _REST_COUNTS:
        raise CorruptScene(f"{len(rest)} f_rest properties; 0, 9, 24, 45 or 72 are SH degree 0 to 4.", where=path.name)
    return _REST_COUNTS[len(rest)]


def _require_numbers(dtype: np.dtype, path: Path) -> None:
    """Raise UnsupportedFormat where shapes are integers: they would be read as if they were logarithms."""
    narrow = [name for name in (*_COLUMNS["scales"], "opacity") if dtype[name].kind in "iu"]
    if len(narrow) == 4:
        raise UnsupportedFormat(
            f"its scales and opacities are {8 * dtype[narrow[0]].itemsize}-bit integers, not floats.",
            where=path.name,
            hint="Export it with float properties; half floats have no type in a PLY.",
        )


def _up(comments: tuple[str, ...]) -> tuple[float, float, float] | None:
    """Return the up axis of nerfstudio's comment 'Vertical Axis: z'."""
    for comment in comments:
        words = comment.lower().replace(":", " ").split()
        if words[:2] == ["vertical", "axis"] and words[2:] in (["x"], ["y"], ["z"]):
            x, y, z = (float(axis == words[2]) for axis in "xyz")
            return x, y, z
    return None


def _render_mode(comments: tuple[str, ...]) -> str | None:
    """Return the last render mode: Brush writes 'SplatRenderMode: default|mip|2dgs', Postshot 'antialiased 0|1'."""
    mode = None
    for comment in comments:
        words = comment.lower().replace(":", " ").split()
        if len(words) == 2 and words[0] == "splatrendermode":
            mode = {"mip": "antialiased"}.get(words[1], words[1])
        elif len(words) == 2 and words[0] == "antialiased":
            mode = {"0": "default", "1": "antialiased"}.get(words[1], mode)
    return mode
