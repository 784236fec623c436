"""The functions of gsplat that the GPU renderer calls, on the CPU: pictures by the reference renderer, in float64.

The calls are checked against gsplat's own signatures; projection is gsplat's PyTorch one; lists and blending order are
written from what its documentation and its kernel `rasterize_to_indices_3dgs` say.
"""

from __future__ import annotations

import inspect
import warnings
from functools import cache
from typing import Any

import reference_renderer as reference
import torch
from torch import Tensor

from service.render.gsplat_cuda import Kernels


@cache
def gsplat() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its import warns about the absence of CUDA
        import gsplat
        import gsplat.cuda._torch_impl
    return gsplat


def kernels() -> Kernels:
    gsplat()
    return Kernels(rasterization, rasterize_to_indices_in_range)


def bound(function: Any, args: tuple, kwargs: dict) -> dict[str, Any]:
    """Arguments by name, defaults filled in, as the true function would take them. Raises TypeError."""
    call = inspect.signature(function).bind(*args, **kwargs)
    call.apply_defaults()
    return call.arguments


def rasterization(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    a = bound(gsplat().rasterization, args, kwargs)
    assert (a["render_mode"], a["packed"], a["near_plane"]) == ("RGB+ED", False, reference.NEAR)
    assert a["colors"].shape[1] == (a["sh_degree"] + 1) ** 2
    antialiased = a["rasterize_mode"] == "antialiased"
    values = [a[name].double() for name in ("means", "quats", "scales", "opacities", "colors")]
    views, lenses, width, height = a["viewmats"].double(), a["Ks"].double(), a["width"], a["height"]
    pictures = []
    for view, lens, background in zip(views, lenses, a["backgrounds"].double(), strict=True):
        fx, fy, cx, cy = (float(lens[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        if ((values[0] @ view[:3, :3].T + view[:3, 3])[:, 2] <= reference.NEAR).all():
            pictures.append(empty(values, view, background, height, width))
            continue
        pictures.append(
            reference.render(*values, view, (fx, fy, cx, cy), width, height, a["eps2d"], background, antialiased)
        )
    image = torch.stack([torch.cat([p.rgb, p.depth[..., None]], -1) for p in pictures])
    alpha = torch.stack([p.alpha[..., None] for p in pictures])
    with torch.no_grad():
        return image, alpha, projected(a, values, views, lenses)


def empty(values: list[Tensor], view: Tensor, background: Tensor, height: int, width: int) -> reference.Picture:
    """Background alone; it depends on everything, with gradients of 0, as gsplat's graph does."""
    nothing = 0 * (view.sum() + torch.stack([value.sum() for value in values]).sum()) + torch.zeros(height, width)
    return reference.Picture(nothing[..., None] + background, nothing, nothing, nothing)


def projected(a: dict[str, Any], values: list[Tensor], views: Tensor, lenses: Tensor) -> dict[str, Any]:
    own = gsplat().cuda._torch_impl
    means, quats, scales, opacities, _ = values
    covariances, _ = own._quat_scale_to_covar_preci(quats, scales, True, False)
    antialiased = a["rasterize_mode"] == "antialiased"
    radii, centres, depths, conics, compensation = own._fully_fused_projection(
        means, covariances, views, lenses, a["width"], a["height"], eps2d=a["eps2d"], near_plane=a["near_plane"],
        calc_compensations=antialiased,
    )  # fmt: skip
    opacities = opacities.expand(len(views), -1)
    lists = tile_lists(radii, depths, -(-a["width"] // a["tile_size"]) * -(-a["height"] // a["tile_size"]))
    offsets = torch.tensor([0, *(len(each) for each in lists)]).cumsum(0)[:-1]
    tiles = -(-a["height"] // a["tile_size"]), -(-a["width"] // a["tile_size"])
    return {
        "radii": radii,
        "means2d": centres,
        "depths": depths,
        "conics": conics,
        "opacities": opacities * compensation if antialiased else opacities,
        "isect_offsets": offsets.int().reshape(len(views), *tiles),
        "flatten_ids": torch.cat(lists).int(),
    }


def tile_lists(radii: Tensor, depths: Tensor, tiles: int) -> list[Tensor]:
    """For each camera and tile the visible Gaussians, near to far, numbered over all cameras. No tile is spared one."""
    lists = []
    for camera, (radius, depth) in enumerate(zip(radii, depths, strict=True)):
        order = torch.argsort(depth)
        order = order[(radius[order] > 0).all(-1)]
        lists += [order + camera * len(depth)] * tiles
    return lists


def rasterize_to_indices_in_range(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, Tensor]:
    a = bound(gsplat().rasterize_to_indices_in_range, args, kwargs)
    size, width, height = a["tile_size"], a["image_width"], a["image_height"]
    offsets = [*a["isect_offsets"].flatten().tolist(), len(a["flatten_ids"])]
    cameras, rows, columns = a["isect_offsets"].shape
    found = []
    for tile in range(cameras * rows * columns):
        camera, row, column = tile // (rows * columns), tile // columns % rows, tile % columns
        first, end = offsets[tile], offsets[tile + 1]
        ids = a["flatten_ids"][first:end][a["range_start"] * size**2 : a["range_end"] * size**2].long()
        y, x = torch.meshgrid(
            torch.arange(row * size, min((row + 1) * size, height)),
            torch.arange(column * size, min((column + 1) * size, width)),
            indexing="ij",
        )
        pixel = (y * width + x).flatten()
        through = a["transmittances"][camera].flatten()[pixel].double()
        hit = blended(a, ids, x.flatten() + 0.5, y.flatten() + 0.5, through)
        at, which = hit.nonzero(as_tuple=True)
        found.append(torch.stack([ids[which] % a["means2d"].shape[1], pixel[at], torch.full_like(at, camera)]))
    gaussian, pixel, image = torch.cat(found, 1)
    order = torch.argsort(image * width * height + pixel, stable=True)
    return gaussian[order], pixel[order], image[order]


def blended(a: dict[str, Any], ids: Tensor, x: Tensor, y: Tensor, through: Tensor) -> Tensor:
    """Whether each pixel (rows) blends each Gaussian (columns, near to far): before its light is used up."""
    centres, conics = a["means2d"].reshape(-1, 2)[ids], a["conics"].reshape(-1, 3)[ids]
    dx, dy = centres[:, 0] - x[:, None], centres[:, 1] - y[:, None]
    sigma = 0.5 * (conics[:, 0] * dx**2 + conics[:, 2] * dy**2) + conics[:, 1] * dx * dy
    alpha = torch.clamp(a["opacities"].reshape(-1)[ids] * torch.exp(-sigma), max=reference.ALPHA_MAX)
    seen = alpha >= reference.ALPHA_MIN
    after = through[:, None] * torch.cumprod(1 - torch.where(seen, alpha, 0.0), 1)
    return seen & (after > reference.T_MIN)
