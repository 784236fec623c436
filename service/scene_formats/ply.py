"""Read the .ply of 3DGS trainers (Inria's layout) by property name: any order, any number type, normals or none."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.errors import CorruptScene, UnsupportedFormat
from service.scene_formats.gaussians import RawGaussians, require_count
from service.scene_formats.ply_header import element_blocks, read_header

_REST_COUNTS = {0: 0, 9: 1, 24: 2, 45: 3}
"""Number of f_rest properties -> SH degree."""
_COLUMNS = {
    "means": ["x", "y", "z"],
    "quats": [f"rot_{i}" for i in range(4)],
    "scales": [f"scale_{i}" for i in range(3)],
    "opacities": ["opacity"],
}
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
    degree = _sh_degree(vertex.dtype.names or (), path)
    values = {name: np.empty((vertex.count, len(columns)), np.float32) for name, columns in _COLUMNS.items()}
    sh = np.empty((vertex.count, (degree + 1) ** 2, 3), np.float32)
    with np.errstate(over="ignore"):  # what overflows is reported with its index by `checked`
        # In blocks, straight to where they belong: a large file is never twice in memory.
        for place, records in element_blocks(path, header, "vertex"):
            for name, columns in _COLUMNS.items():
                for i, column in enumerate(columns):
                    values[name][place, i] = records[column]
            # f_rest has all of red, then green, then blue; the renderers read coefficient by coefficient.
            for channel in range(3):
                sh[place, 0, channel] = records[f"f_dc_{channel}"]
                for k in range(1, sh.shape[1]):
                    sh[place, k, channel] = records[f"f_rest_{channel * (sh.shape[1] - 1) + k - 1}"]
        opacities = values["opacities"][:, 0]
        return RawGaussians(
            means=values["means"],
            quats=values["quats"],
            scales=np.exp(values["scales"], out=values["scales"]),
            opacities=1 / (1 + np.exp(-opacities)),
            sh=sh,
            render_mode=_render_mode(header.comments),
        )


def _sh_degree(names: tuple[str, ...], path: Path) -> int:
    """Check the property names and return the degree of the spherical harmonics by their number."""
    if "scale_0" in names and "scale_2" not in names:
        raise UnsupportedFormat("a 2DGS scene (it has no scale_2); only 3DGS scenes can be rendered.", where=path.name)
    rest = [name for name in names if name.startswith("f_rest_")]
    needed = [name for columns in _COLUMNS.values() for name in columns] + ["f_dc_0", "f_dc_1", "f_dc_2"]
    needed += [f"f_rest_{i}" for i in range(len(rest))]
    missing = [name for name in needed if name not in names]
    if missing:
        raise UnsupportedFormat(f"not a 3DGS scene: element 'vertex' has no {', '.join(missing[:5])}.", where=path.name)
    if len(rest) not in _REST_COUNTS:
        raise CorruptScene(f"{len(rest)} f_rest properties; 0, 9, 24 or 45 are SH degree 0 to 3.", where=path.name)
    return _REST_COUNTS[len(rest)]


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
