"""Write Gaussians as the binary .ply of 3DGS trainers: Inria's properties in Inria's order, which all programs read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.scene_formats.gaussians import RawGaussians
from service.scene_formats.ply_header import BLOCK
from service.scene_formats.recentring import extent_of, origin_for

_FINEST = float(np.finfo(np.float32).tiny)
"""The smallest normal float32."""
_BELOW_ONE = 1 - 2.0**-24
"""The largest float32 below 1."""


def write_ply(raw: RawGaussians, path: Path) -> None:
    """Write a new file: logarithms of the scales, logits of the opacities, f_rest channel by channel, normals of zero.

    Numbers are floats; positions are doubles where they are so far from the origin that floats would move them, as in
    UTM coordinates. Up and render mode are comments, in the words of nerfstudio and Brush, where these have words for
    them. Raises FileExistsError, and other OSErrors.
    """
    count, rest = len(raw.means), raw.sh.shape[1] - 1
    dtype = _record(rest, "<f8" if any(origin_for(extent_of(raw))) else "<f4")
    names = {"<f4": "float", "<f8": "double"}
    properties = [f"property {names[dtype[name].str]} {name}" for name in dtype.names or ()]
    comments = [f"comment {text}" for text in _comments(raw)]
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {count}", *properties, "end_header"]
    with path.open("xb") as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        # In blocks: a large scene is never twice in memory.
        for start in range(0, count, BLOCK):
            file.write(_records(raw, slice(start, min(start + BLOCK, count)), dtype).tobytes())


def _record(rest: int, position: str) -> np.dtype:
    floats = ["nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(3 * rest))]
    floats += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return np.dtype([*((axis, position) for axis in "xyz"), *((name, "<f4") for name in floats)])


def _records(raw: RawGaussians, part: slice, dtype: np.dtype) -> np.ndarray:
    records = np.zeros(part.stop - part.start, dtype)
    # Programs don't expect infinite logits and logarithms; what is bounded here looks the same.
    opacities = np.clip(raw.opacities[part].astype(np.float64), _FINEST, _BELOW_ONE)
    records["opacity"] = np.log(opacities / (1 - opacities))
    scales = np.log(np.maximum(raw.scales[part].astype(np.float64), _FINEST))
    rest = raw.sh[part, 1:].transpose(0, 2, 1).reshape(len(records), -1)
    columns = {"scale_": scales, "rot_": raw.quats[part], "f_dc_": raw.sh[part, 0], "f_rest_": rest}
    for i, axis in enumerate("xyz"):
        records[axis] = raw.means[part, i]
    for name, values in columns.items():
        for i in range(values.shape[1]):
            records[f"{name}{i}"] = values[:, i]
    return records


def _comments(raw: RawGaussians) -> list[str]:
    modes = {"default": "default", "antialiased": "mip"}
    found = [f"SplatRenderMode: {modes[raw.render_mode]}"] if raw.render_mode in modes else []
    # nerfstudio's comment has no word for a direction that is no axis.
    found += [f"Vertical Axis: {axis}" for axis, at in zip("xyz", np.eye(3), strict=True) if raw.up == tuple(at)]
    return found
