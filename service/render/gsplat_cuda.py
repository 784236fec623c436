"""The renderer on an NVIDIA GPU: gsplat's CUDA kernels, with the semantics of `cpu`. The only file with gsplat.

Images of one size are rendered in one call; images and gradients are computed on the device, and only they are copied
to the host. Gradients are summed in no fixed order, so their last digits differ from call to call.

gsplat has no median depth. A second pass takes from its kernel the Gaussians that each pixel blends, 256 at a time and
from near to far, and finds the one at which the transmittance falls to one half:

    tile's list, by depth   |  256 Gaussians  |  256 Gaussians  | ...
    transmittance of a ray  1 ......... 0.7   0.7 ... 0.5 <- here: the ray is left out of later passes
"""

from __future__ import annotations

import copy
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from service.errors import BackendMissing
from service.interfaces import Frame, SceneGradients
from service.render.cpu import dilation_for
from service.types import Camera, GaussianScene

TILE = 16
"""Pixels; gsplat's kernels take TILE * TILE Gaussians of a tile's list at a time."""
PROJECTED_AT_ONCE = 4_000_000
"""Gaussians times cameras in one call: some 200 bytes of GPU memory each at SH degree 3."""
RAYS_AT_ONCE = 2**18
"""Pixels of one pass for the median depth: some 100 bytes of GPU memory per Gaussian, at most 256 for each."""


class Kernels(NamedTuple):
    """The functions of gsplat that are used here."""

    rasterization: Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
    rasterize_to_indices_in_range: Callable[..., tuple[Tensor, Tensor, Tensor]]


def missing() -> str | None:
    """Return why it can't run here. The first time with a GPU, gsplat may compile its kernels: some minutes."""
    if find_spec("gsplat") is None:
        return "gsplat is not installed: pip install 'splatfix[gpu]'"
    if torch.version.cuda is None:
        return "this PyTorch was built without CUDA"
    if not torch.cuda.is_available():
        return "PyTorch sees no CUDA device: no NVIDIA GPU, or no driver for it"
    from gsplat.cuda import _backend  # only where there is a GPU: the import searches for a compiler, and prints that

    return None if _backend._C is not None else "gsplat has no CUDA kernels, and finds no nvcc to compile them"


def create(scene: GaussianScene) -> GsplatRasterizer:
    """Copy the scene to the GPU. Raises BackendMissing if its memory is too small."""
    from gsplat import rasterization, rasterize_to_indices_in_range

    kernels = Kernels(rasterization, rasterize_to_indices_in_range)
    return _put(scene, torch.device("cuda"), kernels)


def device_facts() -> dict[str, Any]:
    """Return the GPU's name, compute capability, multiprocessors and bytes of memory, and PyTorch's CUDA version."""
    found = torch.cuda.get_device_properties(0)
    return {
        "name": found.name,
        "compute_capability": f"{found.major}.{found.minor}",
        "multiprocessors": found.multi_processor_count,
        "memory_bytes": found.total_memory,
        "cuda": torch.version.cuda,
    }


def device_memory() -> dict[str, int]:
    """Return bytes of GPU memory: this process's tensors now and at most since the last call, its pool, free ones."""
    found = {
        "allocated_bytes": torch.cuda.memory_allocated(),
        "peak_bytes": torch.cuda.max_memory_allocated(),
        "reserved_bytes": torch.cuda.memory_reserved(),
        "free_bytes": torch.cuda.mem_get_info()[0],
    }
    torch.cuda.reset_peak_memory_stats()
    return found


def limit_device_memory(more_bytes: int | None) -> None:
    """Let this process take no more GPU memory than this beyond what it has now; None: as much as there is."""
    torch.cuda.empty_cache()
    share = 1.0
    if more_bytes is not None:
        total = torch.cuda.get_device_properties(0).total_memory
        share = min(1.0, (torch.cuda.memory_reserved() + more_bytes) / total)
    torch.cuda.set_per_process_memory_fraction(share)


def _put(scene: GaussianScene, device: torch.device, kernels: Kernels) -> GsplatRasterizer:
    try:
        return GsplatRasterizer(scene, device, kernels)
    except torch.OutOfMemoryError as error:
        raise BackendMissing(f"the GPU has no memory left for {scene.nbytes / 1e6:.0f} MB.", where="render") from error


class GsplatRasterizer:
    """`Rasterizer` by gsplat."""

    name = "gsplat_cuda"

    def __init__(self, scene: GaussianScene, device: torch.device, kernels: Kernels) -> None:
        self.scene = scene
        self.device = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
        self._on, self._kernels = device, kernels
        arrays = scene.means, scene.quats, scene.scales, scene.opacities, scene.sh
        self._parameters = tuple(self._tensor(array) for array in arrays)
        self._background = self._tensor(scene.info.background_rgb)

    @property
    def nbytes(self) -> int:
        """GPU memory of the scene."""
        return sum(tensor.nbytes for tensor in self._parameters)

    def of(self, scene: GaussianScene) -> GsplatRasterizer:
        """Copy another scene to the same GPU. Raises BackendMissing."""
        return _put(scene, self._on, self._kernels)

    def trained_at(self, long_side_px: int) -> GsplatRasterizer:
        """Return a renderer of the same tensors whose dilation is right at another training resolution."""
        other = copy.copy(self)
        info = replace(self.scene.info, training_focal_px=None, training_long_side_px=long_side_px)
        other.scene = replace(self.scene, info=info)
        return other

    def over(self, background_rgb: tuple[float, float, float]) -> GsplatRasterizer:
        """Return a renderer of the same tensors over another background."""
        other = copy.copy(self)
        other.scene = replace(self.scene, info=replace(self.scene.info, background_rgb=background_rgb))
        other._background = self._tensor(background_rgb)
        return other

    def render(
        self,
        cameras: Sequence[Camera],
        approximate: bool = False,
        occlusion_depths: Sequence[Float32[np.ndarray, "_ _"]] | None = None,
    ) -> list[Frame]:
        """Render the cameras, in one call for each image size; the options only permit omissions, and are not used."""
        groups: dict[tuple, list[int]] = defaultdict(list)
        for index, camera in enumerate(cameras):
            k = camera.intrinsics
            groups[k.width, k.height, dilation_for(camera, self.scene.info)].append(index)
        # gsplat allocates for all cameras of a call at once.
        at_once = max(1, PROJECTED_AT_ONCE // max(1, self.scene.count))
        frames: dict[int, Frame] = {}
        for members in groups.values():
            for first in range(0, len(members), at_once):
                some = members[first : first + at_once]
                frames.update(zip(some, self._render([cameras[i] for i in some]), strict=True))
        return [frames[index] for index in range(len(cameras))]

    def pose_gradient(
        self,
        camera: Camera,
        d_rgb: Float32[np.ndarray, "h w 3"],
        d_depth: Float32[np.ndarray, "h w"] | None = None,
        d_alpha: Float32[np.ndarray, "h w"] | None = None,
    ) -> Float64[np.ndarray, "6"]:
        """Return d loss / d twist by automatic differentiation of the view matrix."""
        views = self._views([camera]).requires_grad_()
        image, alpha, _ = self._rasterize([camera], views, self._parameters)
        (d_view,) = torch.autograd.grad(self._loss(image, alpha, d_rgb, d_depth, d_alpha), views)
        # camera_from_world becomes exp(-twist) @ camera_from_world; a matrix gradient D there contributes D V^T, whose
        # antisymmetric part belongs to the rotation and whose last column to the translation.
        d_view, view = d_view[0].double().cpu().numpy(), camera.pose.camera_from_world
        m = d_view @ view.T
        rotation = [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]
        return -np.array([*rotation, *m[:3, 3]])

    def scene_gradients(
        self,
        camera: Camera,
        d_rgb: Float32[np.ndarray, "h w 3"],
        d_depth: Float32[np.ndarray, "h w"] | None = None,
        d_alpha: Float32[np.ndarray, "h w"] | None = None,
    ) -> SceneGradients:
        """Return d loss / d parameter of the Gaussians in view by automatic differentiation."""
        leaves = tuple(tensor.detach().requires_grad_() for tensor in self._parameters)
        image, alpha, meta = self._rasterize([camera], self._views([camera]), leaves)
        gradients = torch.autograd.grad(self._loss(image, alpha, d_rgb, d_depth, d_alpha), leaves)
        # The CPU renderer, too, has rows for the Gaussians in view only.
        seen = (meta["radii"][0] > 0).all(-1).nonzero()[:, 0]
        return SceneGradients(
            seen.int().cpu().numpy(), *(gradient[seen].float().cpu().numpy() for gradient in gradients)
        )

    def _render(self, cameras: Sequence[Camera]) -> Iterator[Frame]:
        """Render cameras of one image size and dilation."""
        with torch.no_grad():
            image, alpha, meta = self._rasterize(cameras, self._views(cameras), self._parameters)
            median = self._median_depth(meta, alpha[..., 0].shape)
        parts = image[..., :3], alpha[..., 0], image[..., 3], median
        for each in zip(*(part.float().contiguous().cpu().numpy() for part in parts), strict=True):
            for array in each:
                array.flags.writeable = False
            yield Frame(*each)

    def _rasterize(
        self, cameras: Sequence[Camera], views: Float[Tensor, "c 4 4"], parameters: tuple[Tensor, ...]
    ) -> tuple[Float[Tensor, "c h w 4"], Float[Tensor, "c h w 1"], dict[str, Any]]:
        """Return colours with the expected depth, alpha, and gsplat's intermediate results."""
        k, info = cameras[0].intrinsics, self.scene.info
        lenses = [[[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]] for c in (camera.intrinsics for camera in cameras)]
        return self._kernels.rasterization(
            *parameters,
            viewmats=views,
            Ks=self._tensor(lenses),
            width=k.width,
            height=k.height,
            near_plane=info.near_plane,
            eps2d=dilation_for(cameras[0], info),
            sh_degree=self.scene.sh_degree,
            packed=False,  # the median depth indexes the unpacked form
            tile_size=TILE,
            backgrounds=self._background.expand(len(cameras), 3),
            render_mode="RGB+ED",
            rasterize_mode="antialiased" if info.render_mode == "antialiased" else "classic",
        )

    def _median_depth(self, meta: dict[str, Any], shape: Sequence[int]) -> Float[Tensor, "c h w"]:
        """Return the z-depth of the Gaussian at which each ray's transmittance falls to one half; 0: it never does."""
        total = int(np.prod(shape))
        median = torch.zeros(total, device=self._on)
        offsets = meta["isect_offsets"].flatten()
        longest = int(torch.diff(offsets, append=offsets.new_tensor([len(meta["flatten_ids"])])).max())
        for first in range(0, total, RAYS_AT_ONCE):
            rays = slice(first, first + RAYS_AT_ONCE)
            through = torch.zeros(total, device=self._on)  # a ray of transmittance 0 blends nothing
            through[rays] = 1
            for step in range(-(-longest // TILE**2)):
                self._advance(meta, shape, step, through, median)
                if not through[rays].any():
                    break
        return median.reshape(*shape)

    def _advance(
        self,
        meta: dict[str, Any],
        shape: Sequence[int],
        step: int,
        through: Float[Tensor, "r"],
        median: Float[Tensor, "r"],
    ) -> None:
        """Blend the next 256 Gaussians of the tiles' lists; a ray whose transmittance falls to one half ends there."""
        _, height, width = shape
        centres, conics, opacities = meta["means2d"], meta["conics"], meta["opacities"]
        gaussian, pixel, image = self._kernels.rasterize_to_indices_in_range(
            step, step + 1, through.reshape(*shape), centres, conics, opacities, width, height, TILE,
            meta["isect_offsets"], meta["flatten_ids"],
        )  # fmt: skip
        if not len(gaussian):
            return
        ray = image * (height * width) + pixel
        dx, dy = (centres[image, gaussian] - torch.stack([pixel % width, pixel // width], -1) - 0.5).unbind(-1)
        a, b, c = conics[image, gaussian].unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacities[image, gaussian] * torch.exp(-sigma)).clamp(max=0.999)
        # The entries are sorted by ray, then depth: transmittance is a running product that restarts with each ray,
        # computed as a sum of logarithms minus the sum at the ray's start, in float64, as thousands are added up.
        starts = torch.ones_like(ray, dtype=torch.bool)
        starts[1:] = ray[1:] != ray[:-1]
        kept = torch.log1p(-alpha.double())
        sums = kept.cumsum(0)
        after = through[ray] * torch.exp(sums - (sums - kept)[starts][starts.cumsum(0) - 1])
        below_half = after <= 0.5
        crossing = below_half.clone()
        crossing[1:] &= starts[1:] | ~below_half[:-1]
        last = starts.roll(-1)
        through[ray[last]] = after[last].to(through.dtype)
        through[ray[crossing]] = 0
        median[ray[crossing]] = meta["depths"][image, gaussian][crossing].to(median.dtype)

    def _loss(self, image: Tensor, alpha: Tensor, d_rgb: Any, d_depth: Any, d_alpha: Any) -> Float[Tensor, ""]:
        """Return the scalar with the requested gradient: the sum of each output times its gradient."""
        loss = (image[0, ..., :3] * self._tensor(d_rgb)).sum()
        if d_depth is not None:
            loss = loss + (image[0, ..., 3] * self._tensor(d_depth)).sum()
        if d_alpha is not None:
            loss = loss + (alpha[0, ..., 0] * self._tensor(d_alpha)).sum()
        return loss

    def _views(self, cameras: Sequence[Camera]) -> Float32[Tensor, "c 4 4"]:
        return self._tensor(np.stack([camera.pose.camera_from_world for camera in cameras]))

    def _tensor(self, values: Any) -> Float32[Tensor, "..."]:
        return torch.tensor(np.asarray(values, np.float32), device=self._on)
