"""XFeat where the renderer's images are: network, selection and matching on the GPU, of several images in one call.

Of a render only its features come to the host. The same steps as in `xfeat`, by PyTorch instead of numpy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, UInt8
from torch import Tensor

from service.device_memory import DEVICE_MEMORY
from service.errors import DeviceMemoryFull
from service.interfaces import Features, Frame
from service.matchers.xfeat import CELL_PX, SIZE_MULTIPLE_PX, XFeat

PIXEL_BYTES = 300
"""Of an image in the network: counted from its layers' channels, not measured."""


class XFeatOnGpu(XFeat):
    """`RenderMatcher` by XFeat on a device of PyTorch."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self._on = torch.device(device)
        # TF32 has 10 bits: its descriptors would not be the CPU's.
        torch.backends.cudnn.allow_tf32 = False
        self._network = self._network.to(self._on)

    def extract(self, rgb: UInt8[np.ndarray, "h w 3"], limit: int) -> Features:
        """As `XFeat.extract`. Raises DeviceMemoryFull."""
        image = torch.from_numpy(np.array(rgb))
        if self._on.type == "cuda":  # from page-locked memory the copy doesn't keep the host waiting
            image = image.pin_memory()
        (found,) = self._extract([image.to(self._on, non_blocking=True)], limit)
        return found

    def extract_rendered(self, frames: Sequence[Frame], limit: int) -> list[Features]:
        """Return `extract` of each render, of images that have not left the device. Raises DeviceMemoryFull."""
        return list(self._extract([frame.device_rgb for frame in frames], limit))

    def match(self, a: Features, b: Features) -> Int32[np.ndarray, "m 2"]:
        """Return the mutual nearest neighbours."""
        if len(a.scores) == 0 or len(b.scores) == 0:
            return np.zeros((0, 2), np.int32)
        of_a, of_b = (torch.from_numpy(np.array(each.descriptors)).to(self._on) for each in (a, b))
        similarity = of_a @ of_b.T
        value, partner = similarity.max(1)
        keep = (value >= similarity.amax(0)[partner]) & (value >= self._config.min_cosine)
        partner, value, pairs = partner.cpu().numpy(), value.cpu().numpy(), np.flatnonzero(keep.cpu().numpy())
        _, first = np.unique(partner[pairs], return_index=True)  # equal descriptors tie: each index once
        pairs = pairs[np.sort(first)]
        pairs = pairs[np.argsort(-value[pairs], kind="stable")]
        return np.stack([pairs, partner[pairs]], 1).astype(np.int32)

    def _extract(self, images: Sequence[UInt8[Tensor, "h w 3"]], limit: int) -> Iterator[Features]:
        """Yield the features of images of one size; where the memory is too small, of each half by itself."""
        half, (height, width) = len(images) // 2, images[0].shape[:2]
        found, rows = [], None
        try:
            with DEVICE_MEMORY.taken(PIXEL_BYTES * height * width * len(images)), torch.inference_mode():
                found = [self._selected(*each, limit) for each in zip(*self._described(images), strict=True)]
                rows = torch.cat(found).cpu().numpy()
        except torch.OutOfMemoryError as error:
            if not half:
                raise DeviceMemoryFull("the GPU has too little memory left for features.", where="matcher") from error
        if rows is None:
            yield from self._extract(images[:half], limit)
            yield from self._extract(images[half:], limit)
            return
        # The network saw an image with sides that are multiples of 32.
        scale = np.array([side / _padded(side) for side in (width, height)], np.float32)
        for own in np.split(rows, np.cumsum([len(each) for each in found])[:-1]):
            yield Features(own[:, :2] * scale, own[:, 2].copy(), own[:, 3:].copy())

    def _described(
        self, images: Sequence[UInt8[Tensor, "h w 3"]]
    ) -> tuple[Float[Tensor, "n r c d"], Float[Tensor, "n y x"], Float[Tensor, "n r c"]]:
        """Return dense descriptors, the probability of a keypoint at each pixel, and the cells' reliability."""
        gray = torch.stack(list(images)).float().sum(-1)[:, None]
        size = [_padded(side) for side in gray.shape[-2:]]
        if size != list(gray.shape[-2:]):
            gray = torch.nn.functional.interpolate(gray, size, mode="bilinear", align_corners=False)
        dense, logits, reliability = self._network(gray)
        heat = torch.nn.functional.pixel_shuffle(torch.softmax(logits, 1)[:, :-1], CELL_PX)
        return dense.permute(0, 2, 3, 1), heat[:, 0], reliability[:, 0]

    def _selected(
        self, dense: Float[Tensor, "r c d"], heat: Float[Tensor, "h w"], reliability: Float[Tensor, "r c"], limit: int
    ) -> Float32[Tensor, "n _"]:
        """Return the strongest local maxima, best first: position (px), score, descriptor of unit length."""
        reach = self._config.suppression_px
        largest = torch.nn.functional.max_pool2d(heat[None, None], 2 * reach + 1, 1, reach)[0, 0]
        y, x = ((heat > self._config.min_probability) & (heat >= largest)).nonzero(as_tuple=True)
        points = torch.stack([x, y], 1).float() + 0.5
        scores = heat[y, x] * _sampled(reliability[..., None], points / CELL_PX)[:, 0]
        best = torch.argsort(-scores, stable=True)[:limit]
        points, scores = points[best], scores[best]
        descriptors = _sampled(dense, points / CELL_PX)
        descriptors = descriptors / descriptors.norm(dim=1, keepdim=True).clamp(min=1e-9)
        return torch.cat([points, scores[:, None], descriptors], 1)


def _padded(side: int) -> int:
    return max(1, round(side / SIZE_MULTIPLE_PX)) * SIZE_MULTIPLE_PX


def _sampled(grid: Float[Tensor, "rows columns d"], at: Float[Tensor, "n 2"]) -> Float[Tensor, "n d"]:
    """Sample a grid bilinearly; `at` in cells, the centre of the first one at (0.5, 0.5); the border is extended."""
    rows, columns, depth = grid.shape
    x, y = (at[:, 0] - 0.5).clamp(0, columns - 1), (at[:, 1] - 0.5).clamp(0, rows - 1)
    left, top = x.long().clamp(max=columns - 2), y.long().clamp(max=rows - 2)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    flat = grid.reshape(-1, depth)
    corner = top * columns + left
    upper = flat[corner] * (1 - fx) + flat[corner + 1] * fx
    lower = flat[corner + columns] * (1 - fx) + flat[corner + columns + 1] * fx
    return upper * (1 - fy) + lower * fy
