"""The CPU renderer: one thread per picture, several pictures over one shared pool.

The steps are in `project` (ellipses and colours), `tiles` (depth order, tile lists), `blend` (the picture) and
`backward` (gradients); `pack` has the memory layout. Semantics are gsplat's, with two additions: the 0.3 px^2
screen-space dilation, right at the resolution the scene was trained at, is scaled by (f_render / f_train)^2, which
takes the bias out of small renders; and whole blocks of 1024 Gaussians outside 1.3 times the field of view are culled.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from service.interfaces import Frame
from service.render.blend import LIST, LOCAL, STATE, blend
from service.render.pack import Packed, aligned, pack
from service.render.project import RECORD, TILE, project
from service.render.tiles import fill_tiles, sort_by_depth
from service.types import Camera, GaussianScene, SceneInfo

DILATION = 0.3
"""px^2, at the training resolution (3DGS, Kerbl et al. 2023, section 6)."""
NEAR = 0.01
"""Scene units; gsplat's default."""
ASSUMED_TRAINING_LONG_SIDE_PX = 1000
"""Where neither training cameras nor the manifest tell the resolution that a scene was trained at."""

_POOL = ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="render")


def create(scene: GaussianScene) -> CpuRasterizer:
    return CpuRasterizer(scene)


def dilation_for(camera: Camera, info: SceneInfo) -> float:
    """Return the dilation in px^2 for a render: DILATION * (f_render / f_train)^2."""
    if info.training_focal_px:
        ratio = camera.intrinsics.fx / info.training_focal_px
    else:
        ratio = camera.intrinsics.long_side / (info.training_long_side_px or ASSUMED_TRAINING_LONG_SIDE_PX)
    return DILATION * ratio * ratio


class CpuRasterizer:
    """`Rasterizer` on the CPU. Scratch memory is kept per thread and grows to the largest picture seen."""

    name = "cpu"

    def __init__(self, scene: GaussianScene) -> None:
        self.scene = scene
        self.packed = pack(scene)
        self._background = np.asarray(scene.info.background_rgb, np.float32)
        self._local = threading.local()

    def render(self, cameras: Sequence[Camera]) -> list[Frame]:
        if len(cameras) == 1:
            return [self._render(cameras[0])]
        return list(_POOL.map(self._render, cameras))

    def _render(self, camera: Camera) -> Frame:
        scratch = self._scratch()
        self._bin(camera, scratch)
        width, height = camera.intrinsics.width, camera.intrinsics.height
        rgb, planes = np.empty((height, width, 3), np.float32), np.empty((3, height, width), np.float32)
        blend(
            scratch.records, scratch.starts, scratch.entries, width, height, self._background, scratch.local,
            scratch.lists, scratch.lengths, scratch.state, rgb.ravel(),
            planes[0].ravel(), planes[1].ravel(), planes[2].ravel(),
        )  # fmt: skip
        return Frame(rgb, planes[0], planes[1], planes[2])

    def _scratch(self) -> _Scratch:
        if not hasattr(self._local, "scratch"):
            self._local.scratch = _Scratch(self.packed)
        return self._local.scratch

    def _bin(self, camera: Camera, s: _Scratch) -> None:
        """Project, sort and fill the tile lists."""
        packed, k = self.packed, camera.intrinsics
        view = np.ascontiguousarray(camera.pose.camera_from_world[:3], np.float32).ravel()
        lens = np.array([k.fx, k.fy, k.cx, k.cy], np.float32)
        s.visible, count = project(
            packed.geometry, packed.sh, packed.spheres, packed.sh_degree, view, lens, k.width, k.height,
            np.float32(dilation_for(camera, self.scene.info)), self.scene.info.render_mode == "antialiased",
            np.float32(NEAR), s.records, s.depths, s.rects, s.local,
        )  # fmt: skip
        tiles_x, tiles_y = -(-k.width // TILE), -(-k.height // TILE)
        if len(s.entries) < count:
            s.entries = np.empty(count + count // 4, np.int32)
        if len(s.starts) != tiles_x * tiles_y + 1:
            s.starts = np.empty(tiles_x * tiles_y + 1, np.int32)
        sort_by_depth(s.depths, s.visible, s.keys, s.swap, s.histogram)
        fill_tiles(s.keys, s.visible, s.rects, tiles_x, tiles_y, s.starts, s.entries)


class _Scratch:
    """A thread's working memory. Large parts are touched, and so exist, only as far as a picture needs them."""

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
        self.visible = 0
