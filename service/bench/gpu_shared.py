"""What the parts of `splatfix bench gpu` share: the scene with both renderers, and how much is measured."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from service import __version__
from service.bench.bench_photos import BenchPhoto, find_photos
from service.bench.gpu_runner import Row
from service.bench.pose_metrics import Units, units_of
from service.loaded_scene import LoadedScene
from service.localize import localize
from service.photos.images import read_query
from service.pose.features.scene_focus import centre_depth
from service.render import RASTERIZERS
from service.results import PoseEstimate
from service.scene_formats import load_scene
from service.types import GaussianScene

REFERENCE = "cpu"
_PACKAGES = ("numpy", "numba", "llvmlite", "torch", "gsplat", "opencv-python-headless")


@dataclass(frozen=True, slots=True)
class Workload:
    """How much is measured."""

    compared: int | None
    """Gaussians of the scene whose images and gradients are compared: those that contribute most; None: all."""
    widths: tuple[int, ...]
    """Long sides of compared images, px."""
    views: int
    """Cameras for comparisons and times of renders."""
    photos: int
    """Of the scene's test photos."""
    degraded: int
    """Rendered and degraded photos."""
    degraded_px: int
    repeats: int
    """Localizations of each photo for latencies."""
    at_a_time: tuple[int, ...]
    """Jobs."""
    throughput_s: float
    """For each number of jobs at a time."""
    sizes: tuple[int, ...]
    """Gaussians of generated scenes."""
    sizes_px: int
    jobs: int


FULL = Workload(
    None, (200, 800), 6, 16, 60, 800, 3, (1, 4, 16), 6.0,
    (250_000, 500_000, 1_000_000, 2_000_000, 4_000_000, 8_000_000, 12_000_000), 800, 1000,
)  # fmt: skip
SMALL = Workload(300, (40,), 1, 1, 1, 320, 1, (1, 2), 0.1, (20_000, 30_000), 160, 4)
"""For a stand-in that compares every Gaussian with every pixel, or renders on the CPU."""


class Shared:
    """Made once in the parts' process; what takes time is made when it is first used."""

    def __init__(self, folder: Path, renderer: str, small: bool) -> None:
        self.folder, self.renderer = folder, renderer
        self.work = SMALL if small else FULL

    @cached_property
    def module(self) -> Any:
        """The plug-in of the tested renderer. Raises BackendMissing, UnknownName."""
        return RASTERIZERS.load(self.renderer)

    @cached_property
    def photos(self) -> list[BenchPhoto]:
        """The test photos, as many as the run takes."""
        return find_photos(self.folder)[: self.work.photos]

    @cached_property
    def scene(self) -> GaussianScene:
        """The scene without cameras of its test photos."""
        # As in `bench localize`: no index view may rest on a test photo's pose.
        return load_scene(self.folder, without_photos=[name for p in find_photos(self.folder) for name in p.names])

    @cached_property
    def reference(self) -> LoadedScene:
        """The scene with the CPU's renderer."""
        return LoadedScene.of(self.scene, rasterizer=REFERENCE)

    @cached_property
    def tested(self) -> LoadedScene:
        """The scene with the renderer that is measured."""
        return LoadedScene.of(self.scene, rasterizer=self.renderer)

    @property
    def both(self) -> tuple[tuple[str, LoadedScene], ...]:
        """Both, the tested one first: its figures are what a run that is cut short must have told."""
        return (self.renderer, self.tested), (REFERENCE, self.reference)

    @cached_property
    def units(self) -> Units:
        """The scene's normalized units."""
        rasterizer = self.reference.rasterizer
        return units_of([n.camera for n in self.scene.cameras], lambda camera: centre_depth(rasterizer, camera))

    def localize(self, photo: BenchPhoto, loaded: LoadedScene) -> PoseEstimate:
        """Localize a test photo as the service would, its file's decoding included; its intrinsics are given."""
        background = loaded.scene.info.background_rgb
        return localize(
            read_query(photo.path.read_bytes(), intrinsics=photo.camera.intrinsics, background_rgb=background), loaded
        )

    def device_memory(self) -> dict[str, int]:
        """Return bytes of the device's memory by name, empty if the renderer has no device of its own."""
        read = getattr(self.module, "device_memory", None)
        return read() if read else {}


def machine(shared: Shared) -> Iterator[Row]:
    """Yield versions, the device and its memory. Raises BackendMissing if the tested renderer can't run here."""
    versions = {"python": platform.python_version(), "splatfix": __version__}
    for name in _PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # OpenCV has several distributions
            versions[name] = "unknown"
    yield {"versions": versions}
    describe = getattr(shared.module, "device_facts", None)
    yield {"device": describe() if describe else {"name": shared.renderer}, "memory": shared.device_memory()}
    yield {
        "gaussians": shared.scene.count,
        "sh_degree": shared.scene.sh_degree,
        "cameras": len(shared.scene.cameras),
        "photos": len(shared.photos),
    }


def every(items: Sequence[Any], count: int) -> list[Any]:
    """Return `count` items, evenly spaced over all; all of them if there are fewer."""
    # Evenly, since neighbouring cameras of a capture see nearly the same.
    chosen = np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int))
    return [items[i] for i in chosen]


def finite(value: float) -> float | None:
    """Return the value as JSON has it: None if it isn't finite."""
    return float(value) if np.isfinite(value) else None
