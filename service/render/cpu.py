"""The CPU renderer: one thread per image, several images over one shared pool.

The steps are in `project` (ellipses and colours), `tiles` (depth order, tile lists), `blend` (the image), `slabs` (of
large views), `backward` and `chain` (gradients); `pack` has the memory layout. Semantics are gsplat's (3DGS, Kerbl et
al. 2023), with two additions: the 0.3 px^2 screen-space dilation, right at the resolution the scene was trained at, is
scaled by (f_render / f_train)^2, which removes the bias of small renders; and whole blocks of 256 Gaussians outside 1.3
times the field of view are culled. On request an image ends early (`approximate`) and leaves out what lies beyond
given depths (`occlusion_depths`).
"""

from __future__ import annotations

import copy
import os
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32

from service.interfaces import Frame, Rasterizer, SceneGradients
from service.render.backward import INPUT, WORK, blend_backward
from service.render.blend import BATCH, LIST, LOCAL, STATE, T_MIN, TILE_STATE, begin, blend, blend_further, write
from service.render.pack import LANES, Packed, aligned, fill, mapped_pack, pack
from service.render.project import RECORD, TILE, blocks_in_view, project
from service.render.projection_gradients import ROW, pose_twist, scene_rows, unpack_rows
from service.render.slabs import SLABS, SlabConfig, open_sums, slabs
from service.render.tiles import fill_tiles, sort_by_depth
from service.types import Camera, GaussianScene, SceneInfo


@dataclass(frozen=True, slots=True)
class RenderConfig:
    """How Gaussians become pixels, where 3DGS leaves a choice; gsplat's renderer takes the same values."""

    dilation_px2: float = 0.3
    """Added to the covariance in the image, at the training resolution (3DGS, Kerbl et al. 2023, section 6)."""
    assumed_training_long_side_px: int = 1000
    """Where neither training cameras nor the manifest have the resolution that a scene was trained at."""
    approximate_t_min: float = 0.03
    """Transmittance at which an approximate image ends: walls of trained scenes let 0.01 through, above T_MIN."""


DEFAULTS = RenderConfig()

NO_OCCLUSION, ALL_OPEN = np.empty(0, np.float32), np.empty(0, np.int32)

# One for all scenes: kernels release the GIL, and more threads than cores would only take turns.
_POOL = ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="render")


def create(scene: GaussianScene) -> CpuRasterizer:
    """Pack a scene for rendering: 50 ms per 100,000 Gaussians; the kernels are compiled once per machine."""
    return CpuRasterizer(scene)


def create_mapped(scene: GaussianScene, folder: Path) -> CpuRasterizer:
    """Map the packed scene from a folder, which is filled if it is empty: milliseconds at any size the next time."""
    return CpuRasterizer(scene, mapped_pack(scene, folder))


def dilation_for(camera: Camera, info: SceneInfo) -> float:
    """Return the dilation in px^2 for a render: that of training times (f_render / f_train)^2."""
    if info.training_focal_px:
        ratio = camera.intrinsics.fx / info.training_focal_px
    else:
        ratio = camera.intrinsics.long_side / (info.training_long_side_px or DEFAULTS.assumed_training_long_side_px)
    return DEFAULTS.dilation_px2 * ratio * ratio


class CpuRasterizer(Rasterizer):
    """`Rasterizer` on the CPU. Scratch memory is kept per thread and grows to the largest image so far.

    The gradients use the tile lists of the thread's last image if it was of the same camera object; else they
    render first.
    """

    name = "cpu"

    def __init__(self, scene: GaussianScene, packed: Packed | None = None, slab_config: SlabConfig = SLABS) -> None:
        self.scene = scene
        self.slab_config = slab_config
        self.packed = packed or pack(scene)
        self._background = np.asarray(scene.info.background_rgb, np.float32)
        self._local = threading.local()

    @property
    def nbytes(self) -> int:
        """Memory of the packed scene; the threads' scratch is not counted."""
        return self.packed.nbytes

    def of(self, scene: GaussianScene) -> CpuRasterizer:
        """Pack another scene."""
        return CpuRasterizer(scene)

    def trained_at(self, long_side_px: int) -> CpuRasterizer:
        """Return a renderer of the same packed Gaussians whose dilation is right at another training resolution."""
        other = copy.copy(self)
        info = replace(self.scene.info, training_focal_px=None, training_long_side_px=long_side_px)
        other.scene = replace(self.scene, info=info)
        return other

    def over(self, background_rgb: tuple[float, float, float]) -> CpuRasterizer:
        """Return a renderer of the same packed Gaussians over another background."""
        other = copy.copy(self)
        other.scene = replace(self.scene, info=replace(self.scene.info, background_rgb=background_rgb))
        other._background = np.asarray(background_rgb, np.float32)
        return other

    def refresh(self) -> None:
        """Copy the scene's values into the packed arrays again, for a scene under training whose arrays change."""
        fill(self.packed, self.scene)

    def render(
        self,
        cameras: Sequence[Camera],
        approximate: bool = False,
        occlusion_depths: Sequence[Float32[np.ndarray, "_ _"]] | None = None,
    ) -> list[Frame]:
        """Render float32 images, read-only, by front-to-back alpha blending; several cameras on all cores."""
        end_t = np.float32(DEFAULTS.approximate_t_min) if approximate else T_MIN
        if len(cameras) == 1:  # in this thread: a job of one image at a time must not wait for the pool
            return [self._render(cameras[0], end_t, occlusion_depths[0] if occlusion_depths else None)]
        return list(_POOL.map(self._render, cameras, repeat(end_t), occlusion_depths or repeat(None)))

    def pose_gradient(
        self,
        camera: Camera,
        d_rgb: Float32[np.ndarray, "h w 3"],
        d_depth: Float32[np.ndarray, "h w"] | None = None,
        d_alpha: Float32[np.ndarray, "h w"] | None = None,
    ) -> Float64[np.ndarray, "6"]:
        """Return d loss / d twist (rotation, translation in the camera frame) in two passes over the tile lists."""
        s = self._backward(camera, d_rgb, d_depth, d_alpha)
        twist = np.empty(6)
        pose_twist(s.records, s.sums, s.visible, *self._chain_arguments(camera, s), twist)
        return twist

    def scene_gradients(
        self,
        camera: Camera,
        d_rgb: Float32[np.ndarray, "h w 3"],
        d_depth: Float32[np.ndarray, "h w"] | None = None,
        d_alpha: Float32[np.ndarray, "h w"] | None = None,
    ) -> SceneGradients:
        """Return d loss / d parameter of the Gaussians in view."""
        s = self._backward(camera, d_rgb, d_depth, d_alpha)
        n, scene = s.visible, self.scene
        rows = aligned((n + LANES) * ROW)  # the last group of 16 is written whole
        scene_rows(s.records, s.sums, n, *self._chain_arguments(camera, s), rows)
        result = SceneGradients(
            np.empty(n, np.int32),
            np.empty((n, 3), np.float32),
            np.empty((n, 4), np.float32),
            np.empty((n, 3), np.float32),
            np.empty(n, np.float32),
            np.empty((n, *scene.sh.shape[1:]), np.float32),
        )
        unpack_rows(
            rows, s.records, n, self.packed.order, scene.quats, scene.scales, scene.opacities, scene.sh_degree,
            result.index, result.means, result.quats, result.scales, result.opacities, result.sh,
        )  # fmt: skip
        return result

    def _render(
        self,
        camera: Camera,
        end_t: np.float32 = T_MIN,
        occlusion_depth: Float32[np.ndarray, "_ _"] | None = None,
        at_once: bool = False,
    ) -> Frame:
        s, k = self._scratch(), camera.intrinsics
        s.camera = None  # after an error the lists belong to no camera
        frame = Frame(np.empty((k.height, k.width, 3), np.float32), *np.empty((3, k.height, k.width), np.float32))
        images = [image.reshape(-1) for image in (frame.rgb, frame.alpha, frame.depth, frame.median_depth)]
        view = _view_and_intrinsics(camera)
        near = np.float32(self.scene.info.near_plane)
        found = blocks_in_view(self.packed.spheres, *view, k.width, k.height, near, s.blocks, s.extents)
        blocks = s.blocks[:found]
        tile_depths = NO_OCCLUSION if occlusion_depth is None else _tile_maxima(occlusion_depth, k.width, k.height)
        if found > self.slab_config.min_blocks and not at_once:
            self._draw_slabs(camera, s, blocks, s.extents[:found], end_t, tile_depths, images)
        else:
            self._bin(camera, s, blocks, near, np.float32(np.inf), tile_depths, ALL_OPEN)
            blend(
                s.records, s.starts, s.entries, k.width, k.height, self._background, end_t, s.local, s.lists,
                s.lengths, s.state, *images,
            )  # fmt: skip
            if end_t == T_MIN and occlusion_depth is None:  # an approximate image has no gradients
                s.camera, s.info, s.frame = camera, self.scene.info, frame
        # The gradients and other jobs' caches share these arrays.
        for image in (frame.rgb, frame.alpha, frame.depth, frame.median_depth):
            image.flags.writeable = False
        return frame

    def _draw_slabs(
        self,
        camera: Camera,
        s: _Scratch,
        blocks: Int32[np.ndarray, "n"],
        extents: Float32[np.ndarray, "n 2"],
        end_t: np.float32,
        tile_depths: Float32[np.ndarray, "_"],
        images: Sequence[Float32[np.ndarray, "_"]],
    ) -> None:
        """Draw the image slab by slab, until no tile lets light through; see `slabs`."""
        k = camera.intrinsics
        tiles_x, tiles_y = -(-k.width // TILE), -(-k.height // TILE)
        s.states, s.alive = _at_least(s.states, tiles_x * tiles_y * TILE_STATE), np.empty(tiles_x * tiles_y, np.uint32)
        begin(k.width, k.height, s.states, s.alive)
        close_t = max(end_t, np.float32(self.slab_config.close_t))
        for some, near, far in slabs(blocks, extents, self.scene.info.near_plane, self.slab_config):
            self._bin(camera, s, some, near, far, tile_depths, open_sums(s.alive.reshape(tiles_y, tiles_x)))
            blend_further(
                s.records, s.starts, s.entries, k.width, end_t, close_t, s.local, s.lists, s.lengths, s.states, s.alive
            )  # fmt: skip
            if not s.alive.any():
                break
        write(k.width, k.height, self._background, s.states, *images)

    def _backward(self, camera: Camera, d_rgb: Any, d_depth: Any, d_alpha: Any) -> _Scratch:
        """Fill `sums` for the image of this camera, rendered first unless it was this thread's last one."""
        s = self._scratch()
        is_last = s.camera is camera and s.info is self.scene.info  # `trained_at` another size gives another image
        frame = s.frame if is_last and s.frame is not None else self._render(camera, at_once=True)
        width, height = camera.intrinsics.width, camera.intrinsics.height
        zero = np.zeros(width * height, np.float32)  # a gradient that is not given
        s.sums[: s.visible * RECORD] = 0
        blend_backward(
            s.records, s.starts, s.entries, width, height, self._background, frame.rgb.reshape(-1),
            frame.alpha.reshape(-1), frame.depth.reshape(-1), _flat(d_rgb),
            zero if d_depth is None else _flat(d_depth), zero if d_alpha is None else _flat(d_alpha),
            s.local, s.lists, s.lengths, s.inputs, s.work, s.batch_sums, s.sums,
        )  # fmt: skip
        return s

    def _chain_arguments(self, camera: Camera, s: _Scratch) -> tuple:
        packed, k = self.packed, camera.intrinsics
        return (
            packed.geometry, packed.sh, packed.sh_degree, *_view_and_intrinsics(camera), k.width, k.height,
            *self._dilation(camera), s.local,
        )  # fmt: skip

    def _scratch(self) -> _Scratch:
        if not hasattr(self._local, "scratch"):
            self._local.scratch = _Scratch(self.packed)
        return self._local.scratch

    def _dilation(self, camera: Camera) -> tuple[np.float32, bool]:
        info = self.scene.info
        return np.float32(dilation_for(camera, info)), info.render_mode == "antialiased"

    def _bin(
        self,
        camera: Camera,
        s: _Scratch,
        blocks: Int32[np.ndarray, "_"],
        near: np.float32,
        far: np.float32,
        tile_depths: Float32[np.ndarray, "_"],
        is_open: Int32[np.ndarray, "_"],
    ) -> None:
        """Project the Gaussians of the blocks between two depths, sort them by depth and fill the tile lists."""
        packed, k = self.packed, camera.intrinsics
        s.visible, count = project(
            packed.geometry, packed.sh, packed.spheres, packed.chunk_spheres, blocks, packed.sh_degree,
            *_view_and_intrinsics(camera), k.width, k.height, *self._dilation(camera),
            near, far, tile_depths, is_open, s.records, s.depths, s.rects, s.local,
        )  # fmt: skip
        tiles_x, tiles_y = -(-k.width // TILE), -(-k.height // TILE)
        if len(s.entries) < count:
            s.entries = np.empty(count + count // 4, np.int32)  # a quarter more: the next view may need it
        if len(s.starts) != tiles_x * tiles_y + 1:
            s.starts = np.empty(tiles_x * tiles_y + 1, np.int32)
        sort_by_depth(s.depths, s.visible, s.keys, s.swap, s.histogram)
        fill_tiles(s.keys, s.visible, s.rects, tiles_x, tiles_y, s.starts, s.entries)


def _view_and_intrinsics(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    k = camera.intrinsics
    view = np.ascontiguousarray(camera.pose.camera_from_world[:3], np.float32).reshape(-1)
    return view, np.array([k.fx, k.fy, k.cx, k.cy], np.float32)


def _tile_maxima(occlusion_depth: Float32[np.ndarray, "h w"], width: int, height: int) -> Float32[np.ndarray, "_"]:
    """Return the largest occlusion depth in each tile: a tile ends only where all of its pixels do."""
    for axis, side in enumerate((height, width)):
        # Coarse pixels that a tile covers in part count, too: from the floor of its start to the ceiling of its end.
        ends = np.minimum(np.arange(0, side + TILE, TILE), side) * occlusion_depth.shape[axis] / side
        last = np.ceil(ends[1:]).astype(int) - 1
        farthest = np.maximum.reduceat(occlusion_depth, ends[:-1].astype(int), axis)
        occlusion_depth = np.maximum(farthest, np.take(occlusion_depth, last, axis))
    return np.ascontiguousarray(occlusion_depth, np.float32).reshape(-1)


def _at_least(array: np.ndarray, count: int) -> np.ndarray:
    """Return the array, or a new one if it is too short."""
    return array if len(array) >= count else aligned(count)


def _flat(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image, np.float32).reshape(-1)


class _Scratch:
    """A thread's working memory. The system provides pages of the large arrays only once an image uses them."""

    def __init__(self, packed: Packed) -> None:
        room = len(packed.order)
        self.records = aligned(room * RECORD)
        self.depths = np.empty(room, np.float32)
        self.rects = np.empty(room, np.uint64)
        self.keys = np.empty(room, np.uint64)
        self.swap = np.empty(room, np.uint64)
        self.histogram = np.empty(2 * 4096, np.int32)
        self.entries = np.empty(0, np.int32)
        self.starts = np.empty(0, np.int32)
        self.local = aligned(LOCAL + 256)
        self.lists = aligned(16 * LIST, np.int32)
        self.lengths = np.empty(16, np.int32)
        self.state = aligned(16 * STATE)
        self.blocks = np.empty(len(packed.spheres), np.int32)
        self.extents = np.empty((len(packed.spheres), 2), np.float32)
        self.states = aligned(0)
        """Of all tiles, and which of their blocks still let light through: of images that are drawn in slabs."""
        self.alive = np.empty(0, np.uint32)
        self.visible = 0
        self.camera: Camera | None = None
        """Camera of the image that the lists belong to..."""
        self.info: SceneInfo | None = None
        """...and the scene's facts at the time: `trained_at` changes them."""
        self.frame: Frame | None = None
        self.inputs = aligned(16 * INPUT)
        self.work = aligned(WORK)
        self.batch_sums = aligned(BATCH * RECORD)
        self.sums = aligned(room * RECORD)
