"""Read PlayCanvas' compressed .ply: chunks of 256 Gaussians with bounds, four packed uint32 each, SH as bytes.

Position, scale: 11 + 10 + 11 bits between the chunk's bounds (scales as logarithms); colour: 4 x 8 bits, the last is
the opacity; rotation: 2 bits with the index of the largest component, 3 x 10 bits for the others in +-1/sqrt(2).

Our own decoder: gsply's checks no bounds, and runs on numba's default thread pool, which is documented as not safe
for concurrent callers. A file that gsply wrote is the golden one in the tests.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt32

from service.errors import CorruptScene
from service.scene_formats.gaussians import (
    RawGaussians,
    require_count,
    sh_from_channel_major,
    sh_from_rgb,
)
from service.scene_formats.ply_header import PlyHeader, element_records, read_header

CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
SUFFIXES = (".ply",)


def accepts(head: bytes, suffix: str) -> bool:
    """Whether it is a PLY with chunks in its header."""
    return head.startswith(b"ply") and b"\nelement chunk " in head


def read(path: Path) -> RawGaussians:
    """Return the decoded Gaussians. Raises SceneError, for a wrong layout before anything is allocated."""
    header = read_header(path)
    _check_layout(header, path)
    chunks = element_records(path, header, "chunk")
    vertices = element_records(path, header, "vertex")
    of_vertex = np.arange(len(vertices)) // CHUNK
    packed = [np.ascontiguousarray(vertices[name]).astype(np.uint32) for name in _PACKED]
    rgba = _unpacked(packed[3], (8, 8, 8, 8))
    rgb = rgba[:, :3]
    if "min_r" in (chunks.dtype.names or ()):  # files before 2024 have colours in 0..1 without bounds
        rgb = _between(rgb, chunks, of_vertex, ("r", "g", "b"))
    sh = sh_from_rgb(rgb)
    if header.element("sh") is not None:
        sh = np.concatenate([sh, _rest(path, header)], 1)
    with np.errstate(over="ignore"):  # what overflows is reported with its index by `checked`
        return RawGaussians(
            means=_between(_unpacked(packed[0], (11, 10, 11)), chunks, of_vertex, ("x", "y", "z")),
            quats=_quaternions(packed[1]),
            scales=np.exp(
                _between(_unpacked(packed[2], (11, 10, 11)), chunks, of_vertex, ("scale_x", "scale_y", "scale_z"))
            ),
            opacities=rgba[:, 3],
            sh=sh,
        )


def _check_layout(header: PlyHeader, path: Path) -> None:
    chunk, vertex, sh = (header.element(name) for name in ("chunk", "vertex", "sh"))
    if chunk is None or vertex is None or chunk.dtype is None or vertex.dtype is None:
        raise CorruptScene("a compressed PLY needs the elements 'chunk' and 'vertex'.", where=path.name)
    require_count(vertex.count, path.name)
    bounds = [f"{end}_{p}{axis}" for p in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    if "min_r" in (chunk.dtype.names or ()):
        bounds += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
    for element, names in ((chunk, bounds), (vertex, _PACKED)):
        missing = [n for n in names if n not in ((element.dtype and element.dtype.names) or ())]
        if missing:
            raise CorruptScene(f"element '{element.name}' has no '{missing[0]}'.", where=path.name)
    if any(vertex.dtype[name].kind != "u" or vertex.dtype[name].itemsize != 4 for name in _PACKED):
        raise CorruptScene("the packed properties must be uint.", where=path.name)
    if chunk.count != -(-vertex.count // CHUNK):
        raise CorruptScene(f"{chunk.count} chunks for {vertex.count} Gaussians; a chunk has {CHUNK}.", where=path.name)
    if sh is not None and (sh.count != vertex.count or len((sh.dtype and sh.dtype.names) or ()) not in (9, 24, 45)):
        raise CorruptScene(f"element 'sh' must have {vertex.count} records of 9, 24 or 45 bytes.", where=path.name)


def _unpacked(packed: UInt32[np.ndarray, "n"], bits: tuple[int, ...]) -> Float32[np.ndarray, "n c"]:
    """Split integers into fields of the given widths in bits, the first in the highest bits, each scaled to 0..1."""
    shifts = np.uint32(32) - np.cumsum(bits).astype(np.uint32)
    masks = (np.uint32(1) << np.array(bits, np.uint32)) - np.uint32(1)
    return ((packed[:, None] >> shifts) & masks).astype(np.float32) / masks.astype(np.float32)


def _between(
    share: Float32[np.ndarray, "n 3"], chunks: np.ndarray, of_vertex: np.ndarray, names: tuple[str, str, str]
) -> Float32[np.ndarray, "n 3"]:
    """Interpolate, by `share` in 0..1, between the bounds of each Gaussian's chunk."""
    low = np.stack([chunks[f"min_{name}"] for name in names], 1).astype(np.float32)[of_vertex]
    high = np.stack([chunks[f"max_{name}"] for name in names], 1).astype(np.float32)[of_vertex]
    return low + share * (high - low)


def _quaternions(packed: UInt32[np.ndarray, "n"]) -> Float32[np.ndarray, "n 4"]:
    """Decode the "smallest three" of unit quaternions (wxyz): the largest component follows from the others."""
    largest = (packed >> np.uint32(30)).astype(np.intp)
    others = (_unpacked(packed << np.uint32(2), (10, 10, 10)) - np.float32(0.5)) * np.float32(np.sqrt(2))
    rows = np.arange(len(packed))[:, None]
    # The three stored components go to the columns other than the largest one's, in order.
    columns = np.arange(3) + (np.arange(3) >= largest[:, None])
    quats = np.empty((len(packed), 4), np.float32)
    quats[rows, columns] = others
    # Positive: q and -q are the same rotation. Rounding may bring the sum of squares above 1.
    quats[rows[:, 0], largest] = np.sqrt(np.maximum(0, 1 - (others**2).sum(1)))
    return quats


def _rest(path: Path, header: PlyHeader) -> Float32[np.ndarray, "n k 3"]:
    """Decode the SH of degree 1 to 3: bytes 1..254 are the middles of 256 steps over -4..4, 0 and 255 its ends."""
    records = element_records(path, header, "sh")
    names = [f"f_rest_{i}" for i in range(len(records.dtype.names or ()))]
    if set(names) != set(records.dtype.names or ()):
        raise CorruptScene(f"the properties of element 'sh' must be f_rest_0 to {names[-1]}.", where=path.name)
    byte = np.stack([records[name] for name in names], 1).astype(np.float32)
    share = np.where(byte == 0, 0, np.where(byte == 255, 1, (byte + np.float32(0.5)) / 256))
    return sh_from_channel_major(((share - np.float32(0.5)) * 8).astype(np.float32))
