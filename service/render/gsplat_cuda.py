"""The renderer on an NVIDIA GPU: gsplat's CUDA kernels, with the semantics of `cpu`. The only file with gsplat.

Images of one size are rendered in one call, as many as the memory budget of all jobs has room for; while one call's
images are copied to the host, the next is computed. A call that finds too little memory is made again in parts.
Gradients are summed in no fixed order, so their last digits differ from call to call.
"""

from __future__ import annotations

import copy
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from service.device_memory import DEVICE_MEMORY
from service.errors import BackendMissing, DeviceMemoryFull
from service.interfaces import Frame, Rasterizer, SceneGradients
from service.render.cpu import dilation_for
from service.render.gsplat_median_depth import TILE, median_depth
from service.types import Camera, GaussianScene

CAMERAS_AT_ONCE = 16
"""In one call: so many images of 384 px have 1.8 million pixels, more than a large GPU computes at a time."""
BUDGET_SHARE = 0.25
"""Of the memory budget that one call plans for: others render meanwhile."""
PROJECTED_BYTES, COEFFICIENT_BYTES = 250, 4
"""Of a Gaussian in a call, for each camera: its projection, colour and entries in tiles' lists, and a colour
coefficient. Counted from gsplat's arrays, not measured."""
PIXEL_BYTES = 60
"""Of an image with its sums, and of its copies. Counted likewise."""
RAYS_AT_ONCE, FEWEST_RAYS = 2**18, 2**14
"""Pixels of one pass for the median depth; the second after too little memory."""
RAY_BYTES = 2000
"""Of such a pass: some 100 bytes per Gaussian of a ray, mostly some 20 for each, at most 256."""


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
        made = GsplatRasterizer(scene, device, kernels)
    except torch.OutOfMemoryError as error:
        raise BackendMissing(f"the GPU has no memory left for {scene.nbytes / 1e6:.0f} MB.", where="render") from error
    if device.type == "cuda":
        pooled = torch.cuda.memory_reserved() - torch.cuda.memory_allocated()
        DEVICE_MEMORY.note_free(torch.cuda.mem_get_info()[0] + pooled)
    return made


class _Copies:
    """Images that are being copied to the host, in page-locked memory and on a stream of their own."""

    def __init__(self, parts: Sequence[Tensor], device_rgb: Tensor) -> None:
        self._parts, self._rgb = parts, device_rgb
        self._done: Any = None
        if not parts[0].is_cuda:
            return
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            self._parts = [
                torch.empty(part.shape, dtype=part.dtype, pin_memory=True).copy_(part, non_blocking=True)
                for part in parts
            ]
            for part in parts:  # whose memory must not be used again before the copy has ended
                part.record_stream(stream)
            self._done = stream.record_event()

    def frames(self) -> Iterator[Frame]:
        """Wait for the copies' end; yield the images."""
        if self._done is not None:
            self._done.synchronize()
        for rgb, alpha, depth, median, device_rgb in zip(*(p.numpy() for p in self._parts), self._rgb, strict=True):
            for array in (rgb, alpha, depth, median):
                array.flags.writeable = False
            yield Frame(rgb, alpha, depth, median, device_rgb)


@contextmanager
def _memory(wanted_bytes: float) -> Iterator[None]:
    """Wait until other calls leave room for this one. Raises DeviceMemoryFull."""
    full = ""
    with DEVICE_MEMORY.taken(wanted_bytes):
        try:
            yield
        except torch.OutOfMemoryError as error:
            full = str(error).split(". ")[0]
    if full:
        raise DeviceMemoryFull(
            f"the GPU has too little memory left ({full}).",
            where="render",
            hint="Unload scenes, end what else uses the GPU, render smaller, or set SPLATFIX_RASTERIZER=cpu.",
        )


class GsplatRasterizer(Rasterizer):
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

    @property
    def cameras_at_once(self) -> int:
        """As many as a call has room for at the size of an index view, at most CAMERAS_AT_ONCE."""
        return self._at_once(384 * 288)

    @property
    def tensor_device(self) -> str:
        """The GPU; the CPU where a test has put the scene there."""
        return self._on.type

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
        order = [index for members in groups.values() for index in members]
        calls = (call for members in groups.values() for call in self._calls([cameras[i] for i in members]))
        frames = []
        copied = next(calls, None)
        while copied is not None:
            # The next call is computed while the images of this one are copied.
            following = next(calls, None)
            frames += copied.frames()
            copied = following
        by_index = dict(zip(order, frames, strict=True))
        return [by_index[index] for index in range(len(cameras))]

    def pose_gradient(
        self,
        camera: Camera,
        d_rgb: Float32[np.ndarray, "h w 3"],
        d_depth: Float32[np.ndarray, "h w"] | None = None,
        d_alpha: Float32[np.ndarray, "h w"] | None = None,
    ) -> Float64[np.ndarray, "6"]:
        """Return d loss / d twist by automatic differentiation of the view matrix."""
        d_image = d_rgb if d_depth is None else np.concatenate([d_rgb, d_depth[..., None]], -1)
        return self._pose_gradients([camera], [d_image], None if d_alpha is None else [d_alpha])[0]

    def pose_gradients(
        self, cameras: Sequence[Camera], d_rgb: Sequence[Float32[np.ndarray, "_ _ 3"]]
    ) -> Float64[np.ndarray, "n 6"]:
        """Return the gradients, those of cameras of one image size in one call."""
        sizes = {(c.intrinsics.width, c.intrinsics.height, dilation_for(c, self.scene.info)) for c in cameras}
        if len(sizes) != 1:
            return super().pose_gradients(cameras, d_rgb)
        found = []
        at_once = self._at_once(cameras[0].intrinsics.width * cameras[0].intrinsics.height)
        for first in range(0, len(cameras), at_once):
            some = slice(first, first + at_once)
            found.append(self._pose_gradients(cameras[some], d_rgb[some], None))
        return np.concatenate(found)

    def _pose_gradients(
        self,
        cameras: Sequence[Camera],
        d_image: Sequence[Float32[np.ndarray, "_ _ _"]],
        d_alpha: Sequence[Float32[np.ndarray, "_ _"]] | None,
    ) -> Float64[np.ndarray, "n 6"]:
        """`d_image` has 3 channels, or 4 with that of the depth."""
        with _memory(self._bytes_of(cameras, 0)):
            views = self._views(cameras).requires_grad_()
            image, alpha, _ = self._rasterize(cameras, views, self._parameters)
            # Of an image each camera's own view matrix has a part, and no other's.
            loss = (image[..., : d_image[0].shape[-1]] * self._tensor(np.stack(d_image))).sum()
            if d_alpha is not None:
                loss = loss + (alpha[..., 0] * self._tensor(np.stack(d_alpha))).sum()
            (d_views,) = torch.autograd.grad(loss, views)
            d_views = d_views.double().cpu().numpy()
        # camera_from_world becomes exp(-twist) @ camera_from_world; a matrix gradient D there contributes D V^T, whose
        # antisymmetric part belongs to the rotation and whose last column to the translation.
        m = d_views @ np.stack([camera.pose.camera_from_world.T for camera in cameras])
        rotation = [m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]]
        return -np.concatenate([np.stack(rotation, 1), m[:, :3, 3]], 1)

    def scene_gradients(
        self,
        camera: Camera,
        d_rgb: Float32[np.ndarray, "h w 3"],
        d_depth: Float32[np.ndarray, "h w"] | None = None,
        d_alpha: Float32[np.ndarray, "h w"] | None = None,
    ) -> SceneGradients:
        """Return d loss / d parameter of the Gaussians in view by automatic differentiation."""
        leaves = tuple(tensor.detach().requires_grad_() for tensor in self._parameters)
        with _memory(self._bytes_of([camera], 0) + self.nbytes):
            image, alpha, meta = self._rasterize([camera], self._views([camera]), leaves)
            gradients = torch.autograd.grad(self._loss(image, alpha, d_rgb, d_depth, d_alpha), leaves)
            # The CPU renderer, too, has rows for the Gaussians in view only.
            seen = (meta["radii"][0] > 0).all(-1).nonzero()[:, 0]
            rows = [gradient[seen].float().cpu().numpy() for gradient in gradients]
        return SceneGradients(seen.int().cpu().numpy(), *rows)

    def _at_once(self, pixels: int) -> int:
        """Return how many images of so many pixels one call is planned for."""
        one, passes = self._bytes_per_camera(pixels), RAY_BYTES * RAYS_AT_ONCE
        room = (BUDGET_SHARE * DEVICE_MEMORY.budget_bytes - passes) / one
        return CAMERAS_AT_ONCE if math.isinf(room) else int(np.clip(room, 1, CAMERAS_AT_ONCE))

    def _bytes_per_camera(self, pixels: int) -> int:
        projected = PROJECTED_BYTES + 3 * COEFFICIENT_BYTES * self.scene.sh.shape[1]
        return projected * self.scene.count + PIXEL_BYTES * pixels

    def _bytes_of(self, cameras: Sequence[Camera], rays: int) -> float:
        """Return an estimate of the memory that a call takes."""
        pixels = cameras[0].intrinsics.width * cameras[0].intrinsics.height
        return len(cameras) * self._bytes_per_camera(pixels) + RAY_BYTES * min(rays, len(cameras) * pixels)

    def _calls(self, cameras: Sequence[Camera]) -> Iterator[_Copies]:
        """Render cameras of one image size and dilation, as many in a call as there is room for."""
        at_once = self._at_once(cameras[0].intrinsics.width * cameras[0].intrinsics.height)
        for first in range(0, len(cameras), at_once):
            yield from self._call(cameras[first : first + at_once])

    def _call(self, cameras: Sequence[Camera]) -> Iterator[_Copies]:
        """Render in one call; where the memory is too small, each half by itself. Raises DeviceMemoryFull."""
        try:
            yield self._render(cameras, RAYS_AT_ONCE, self._bytes_of(cameras, RAYS_AT_ONCE))
        except DeviceMemoryFull:
            half = len(cameras) // 2
        else:
            return
        if half:
            yield from self._call(cameras[:half])
            yield from self._call(cameras[half:])
        else:  # when no other job renders, and in smaller passes
            yield self._render(cameras, FEWEST_RAYS, math.inf)

    def _render(self, cameras: Sequence[Camera], rays: int, wanted_bytes: float) -> _Copies:
        with torch.no_grad(), _memory(wanted_bytes):
            image, alpha, meta = self._rasterize(cameras, self._views(cameras), self._parameters)
            median = median_depth(self._kernels.rasterize_to_indices_in_range, meta, alpha[..., 0].shape, rays)
            parts = [p.float().contiguous() for p in (image[..., :3], alpha[..., 0], image[..., 3], median)]
            # As `to_uint8` rounds and saturates.
            return _Copies(parts, (255 * parts[0].clamp(min=0)).round().clamp(max=255).byte())

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
