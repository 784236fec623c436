"""The GPU's renderer without a GPU, as a plug-in: `splatfix bench gpu --renderer stand_in_gpu --small` runs with it.

It is `GsplatRasterizer` with stand-ins for gsplat's kernels. Small images are by the tests' reference renderer, in
float64 and with gradients. Larger ones, which that can't render in time, are by the CPU's renderer: there both
renderers of the bench are one, and their agreement means nothing.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import gsplat_on_cpu
import numpy as np
import torch
from torch import Tensor

from service.render.cpu import DEFAULTS, CpuRasterizer
from service.render.gsplat_cuda import TILE, GsplatRasterizer, Kernels, _put
from service.types import Camera, GaussianScene, Intrinsics, Pose, SceneInfo

MAX_PAIRS = 2_000_000
"""Gaussians times pixels, up to which the reference renders."""
TENSOR = GsplatRasterizer._tensor
PACKED: dict[int, tuple[Tensor, CpuRasterizer]] = {}
"""The last few scenes, by the address of their means, which are kept so that no other tensor comes to lie there."""


def create(scene: GaussianScene) -> GsplatRasterizer:
    return _put(scene, torch.device("cpu"), Kernels(rasterization, rasterize_to_indices_in_range))


def device_memory() -> dict[str, int]:
    return {"allocated_bytes": sum(renderer.nbytes for _, renderer in PACKED.values())}


def limit_device_memory(more_bytes: int | None) -> None:
    left = more_bytes or 0

    def limited(self: GsplatRasterizer, values: Any) -> Tensor:
        nonlocal left
        left -= np.asarray(values, np.float32).nbytes
        if left < 0:
            raise torch.OutOfMemoryError("the stand-in's memory is full")
        return TENSOR(self, values)

    GsplatRasterizer._tensor = TENSOR if more_bytes is None else limited


def rasterization(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    a = gsplat_on_cpu.bound(gsplat_on_cpu.gsplat().rasterization, args, kwargs)
    if len(a["means"]) * a["width"] * a["height"] <= MAX_PAIRS:
        return gsplat_on_cpu.rasterization(*args, **kwargs)
    return by_cpu_renderer(a)


def by_cpu_renderer(a: dict[str, Any]) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Images without gradients. The one Gaussian of each pixel's list lies at the median depth, if there is one."""
    width, height = a["width"], a["height"]
    renderer = packed(a)
    cameras = []
    for view, lens in zip(a["viewmats"].double().numpy(), a["Ks"].numpy().astype(float), strict=True):
        intrinsics = Intrinsics(width, height, lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2])
        cameras.append(Camera(intrinsics, Pose(np.linalg.inv(view))))
    frames = renderer.render(cameras)
    rgb, depth, alpha, median = (
        torch.from_numpy(np.stack([getattr(frame, name) for frame in frames]))
        for name in ("rgb", "depth", "alpha", "median_depth")
    )
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    centres = torch.stack([x, y], -1).reshape(1, -1, 2).expand(len(frames), -1, -1) + 0.5
    tiles = len(frames), -(-height // TILE), -(-width // TILE)
    count = int(np.prod(tiles))
    return torch.cat([rgb, depth[..., None]], -1), alpha[..., None], {
        "means2d": centres,
        "conics": torch.ones(*centres.shape[:2], 3),
        "opacities": torch.where(median.flatten(1) > 0, 0.9, 0.0),
        "depths": median.flatten(1),
        "isect_offsets": torch.arange(count).int().reshape(tiles),
        "flatten_ids": torch.zeros(count).int(),
    }  # fmt: skip


def packed(a: dict[str, Any]) -> CpuRasterizer:
    """The CPU's renderer of the tensors, with the background, antialiasing and dilation that are asked for."""
    key = a["means"].data_ptr()
    if key not in PACKED:
        arrays = {n: a[n].numpy() for n in ("means", "quats", "scales", "opacities")}
        scene = GaussianScene(**arrays, sh=a["colors"].numpy(), info=SceneInfo("", "", "", ""))
        for old in list(PACKED)[:-1]:
            del PACKED[old]
        PACKED[key] = a["means"], CpuRasterizer(scene)
    renderer = copy.copy(PACKED[key][1])
    info = replace(
        renderer.scene.info,
        background_rgb=tuple(a["backgrounds"][0].tolist()),
        render_mode="antialiased" if a["rasterize_mode"] == "antialiased" else "default",
        training_focal_px=float(a["Ks"][0, 0, 0]) * (DEFAULTS.dilation_px2 / a["eps2d"]) ** 0.5,
    )
    renderer.scene = replace(renderer.scene, info=info)
    renderer._background = np.asarray(info.background_rgb, np.float32)
    return renderer


def rasterize_to_indices_in_range(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, Tensor]:
    a = gsplat_on_cpu.bound(gsplat_on_cpu.gsplat().rasterize_to_indices_in_range, args, kwargs)
    # Of `by_cpu_renderer`: no list of the true lists is that short everywhere.
    if len(a["flatten_ids"]) != a["isect_offsets"].numel() or a["flatten_ids"].any():
        return gsplat_on_cpu.rasterize_to_indices_in_range(*args, **kwargs)
    if a["range_start"] > 0:
        return (torch.zeros(0, dtype=torch.long),) * 3
    image, pixel = ((a["opacities"] > 0) & (a["transmittances"].flatten(1) > 0)).nonzero(as_tuple=True)
    return pixel, pixel, image
