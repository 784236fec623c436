"""The memory layout of the scene that the kernels read: chunks of 16 Gaussians, one SIMD vector for each value.

    Morton order, then 16 Gaussians a chunk, structure of arrays inside the chunk; 16 chunks a block:

    geometry  [chunk][ mx | my | mz | Sxx | Sxy | Sxz | Syy | Syz | Szz | log2 opacity ][16 lanes]
    sh        [chunk][ k0 r | k0 g | k0 b | k1 r | ... ][16 lanes]
    spheres   [block][ x, y, z, radius ]     encloses every Gaussian of the block out to its visible edge
    chunk_spheres   [chunk][ x, y, z, radius ]     the same of the chunk

One load brings a value of 16 Gaussians into a register. Morton order puts neighbours into one chunk, so that a block's
sphere is small and is culled as a whole. S is the covariance in the world frame: it depends on no camera and is
computed once. The last chunk is filled up with Gaussians that are never visible.
"""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

from service.jit import kernel
from service.mapped_arrays import open_arrays, write_arrays
from service.types import GaussianScene

LANES = 16
GEOMETRY = 10
"""Values of a Gaussian in `geometry`."""
CHUNKS_PER_BLOCK = 16
"""Small, so that little outside the view is projected: with 64, 3 million Gaussians take a tenth longer."""
VISIBLE_SIGMAS = 3.33
"""exp(-x^2 / 2) = 1/255 at x = 3.33: beyond it even an opaque Gaussian is skipped."""
NEVER = -1e9
"""log2 of the opacity of a Gaussian that is never visible."""
VERSION = 2
"""Of the layout in files."""
_ARRAYS = ("order", "geometry", "sh", "spheres", "chunk_spheres")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Packed:
    """A scene in the layout above."""

    count: int
    sh_degree: int
    order: Int32[np.ndarray, "padded"]
    """The scene's index of each packed Gaussian; padded with the last one's."""
    geometry: Float32[np.ndarray, "g"]
    sh: Float32[np.ndarray, "s"]
    spheres: Float32[np.ndarray, "blocks 4"]
    chunk_spheres: Float32[np.ndarray, "chunks 4"]

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        return sum(getattr(self, name).nbytes for name in _ARRAYS)

    @property
    def chunks(self) -> int:
        """Number of groups of 16 Gaussians."""
        return len(self.order) // LANES


def aligned(count: int, dtype: type = np.float32) -> np.ndarray:
    """Return an uninitialized array that starts at a cache line (64 bytes), so that no vector crosses one."""
    itemsize = np.dtype(dtype).itemsize
    raw = np.empty(count * itemsize + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + count * itemsize].view(dtype)


def pack(scene: GaussianScene) -> Packed:
    """Order the Gaussians along a space-filling curve and write them in the kernels' layout."""
    order = morton_order(scene.means)
    layout = _layout(scene)
    (padded,) = layout["order"][0]
    order = np.concatenate([order, np.full(padded - scene.count, order[-1], np.int32)])
    geometry, sh = (aligned(layout[name][0][0]) for name in ("geometry", "sh"))
    spheres, chunk_spheres = (np.empty(*layout[name]) for name in ("spheres", "chunk_spheres"))
    packed = Packed(scene.count, scene.sh_degree, order, geometry, sh, spheres, chunk_spheres)
    fill(packed, scene)
    return packed


def mapped_pack(scene: GaussianScene, folder: Path) -> Packed:
    """Return the packed scene, mapped from the arrays in a folder; packs it and writes them if they aren't there.

    The folder is of this scene alone (see `service/searched_scene.py`). What is damaged is written again; where it
    can't be written, the packed scene is in memory.
    """
    try:
        return _opened(scene, folder)
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        _log.warning("%s is rebuilt: %s", folder, error)
        shutil.rmtree(folder, ignore_errors=True)
    packed = pack(scene)
    try:
        write_arrays(folder, {name: getattr(packed, name) for name in _ARRAYS})
        return _opened(scene, folder)
    except OSError as error:
        _log.warning("the packed scene is not cached: %s", error)
        return packed


def _opened(scene: GaussianScene, folder: Path) -> Packed:
    # As if writable, so that kernels aren't compiled a second time for read-only arrays; none of them writes.
    arrays = {name: np.asarray(array) for name, array in open_arrays(folder, _ARRAYS, "c").items()}
    packed = Packed(scene.count, scene.sh_degree, **arrays)
    for name, (shape, dtype) in _layout(scene).items():
        if (arrays[name].shape, arrays[name].dtype) != (shape, dtype):
            raise ValueError(f"{name} is {arrays[name].dtype} of {arrays[name].shape}, not {dtype} of {shape}")
    return packed


def _layout(scene: GaussianScene) -> dict[str, tuple[tuple[int, ...], type]]:
    """Return shape and type of each packed array."""
    chunks = -(-scene.count // LANES)
    return {
        "order": ((chunks * LANES,), np.int32),
        "geometry": ((chunks * GEOMETRY * LANES,), np.float32),
        "sh": ((chunks * scene.sh.shape[1] * 3 * LANES,), np.float32),
        "spheres": ((-(-chunks // CHUNKS_PER_BLOCK), 4), np.float32),
        "chunk_spheres": ((chunks, 4), np.float32),
    }


def fill(packed: Packed, scene: GaussianScene) -> None:
    """Write the scene's values into the packed arrays in their present order, also of a scene under training."""
    sh = scene.sh.reshape(scene.count, -1)
    _fill(
        scene.means, scene.quats, scene.scales, scene.opacities, sh, packed.count, packed.order,
        packed.geometry, packed.sh,
    )  # fmt: skip
    _enclose(scene.means, scene.scales, packed.order, LANES, packed.chunk_spheres)
    _enclose(scene.means, scene.scales, packed.order, LANES * CHUNKS_PER_BLOCK, packed.spheres)


def morton_order(means: Float32[np.ndarray, "n 3"]) -> Int32[np.ndarray, "n"]:
    """Return the indices that sort points along the Z-order (Morton) curve of 1024^3 cells."""
    # Quantiles, not extremes: a few far floaters must not squeeze the rest into one cell.
    low, high = np.quantile(means[:: max(1, len(means) // 20_000)], [0.01, 0.99], axis=0)
    cells = np.clip((means - low) / np.maximum(high - low, 1e-12) * 1023, 0, 1023).astype(np.uint32)
    code = np.zeros(len(means), np.uint32)
    for axis in range(3):
        # Spread 10 bits to every third place; the axes are then interleaved.
        x = cells[:, axis]
        for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
            x = (x | (x << np.uint32(shift))) & np.uint32(mask)
        code |= x << np.uint32(axis)
    return np.argsort(code, kind="stable").astype(np.int32)


@kernel
def _fill(means, quats, scales, opacities, sh, count, order, geometry, packed_sh):
    """Write covariances and SH; numba, as a Python loop over millions would take minutes."""
    coefficients = sh.shape[1]
    for place in range(order.shape[0]):
        i = order[place]
        g = (place // 16) * 160 + (place & 15)
        w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        s0, s1, s2 = scales[i, 0], scales[i, 1], scales[i, 2]
        # S = M M^T with M = R diag(scale): R by columns times the scales.
        r00, r01, r02 = (1 - 2 * (y * y + z * z)) * s0, 2 * (x * y - w * z) * s1, 2 * (x * z + w * y) * s2
        r10, r11, r12 = 2 * (x * y + w * z) * s0, (1 - 2 * (x * x + z * z)) * s1, 2 * (y * z - w * x) * s2
        r20, r21, r22 = 2 * (x * z - w * y) * s0, 2 * (y * z + w * x) * s1, (1 - 2 * (x * x + y * y)) * s2
        geometry[g], geometry[g + 16], geometry[g + 32] = means[i, 0], means[i, 1], means[i, 2]
        geometry[g + 48] = r00 * r00 + r01 * r01 + r02 * r02
        geometry[g + 64] = r00 * r10 + r01 * r11 + r02 * r12
        geometry[g + 80] = r00 * r20 + r01 * r21 + r02 * r22
        geometry[g + 96] = r10 * r10 + r11 * r11 + r12 * r12
        geometry[g + 112] = r10 * r20 + r11 * r21 + r12 * r22
        geometry[g + 128] = r20 * r20 + r21 * r21 + r22 * r22
        visible = place < count and opacities[i] > 0
        geometry[g + 144] = np.float32(np.log2(opacities[i])) if visible else np.float32(NEVER)
        at = (place // 16) * coefficients * 16 + (place & 15)
        for k in range(coefficients):
            packed_sh[at + k * 16] = sh[i, k]


@kernel
def _enclose(means, scales, order, size, spheres):
    """Write the sphere of every `size` Gaussians in their packed order, around the middle of their box."""
    for group in range(spheres.shape[0]):
        first = group * size
        last = min(first + size, order.shape[0])
        # Not the smallest sphere, but found in two passes.
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for place in range(first, last):
            for axis in range(3):
                low[axis] = min(low[axis], means[order[place], axis])
                high[axis] = max(high[axis], means[order[place], axis])
        radius = 0.0
        for place in range(first, last):
            i = order[place]
            squared = 0.0
            for axis in range(3):
                squared += (means[i, axis] - 0.5 * (low[axis] + high[axis])) ** 2
            extent = VISIBLE_SIGMAS * max(scales[i, 0], scales[i, 1], scales[i, 2])
            radius = max(radius, np.sqrt(squared) + extent)
        for axis in range(3):
            spheres[group, axis] = 0.5 * (low[axis] + high[axis])
        spheres[group, 3] = radius
