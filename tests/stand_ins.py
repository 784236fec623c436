"""Small stand-ins for what is slow in an engine, and a scene made of them; everything can be pickled."""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import service.estimators
from service.interfaces import Features, Frame, Matcher, Rasterizer
from service.jobs.embedded_engine import EmbeddedEngine
from service.loaded_scene import LoadedScene
from service.types import Camera, GaussianScene, Intrinsics, NamedCamera, Pose, SceneInfo

PHOTO = Intrinsics(96, 64, 80.0, 80.0, 48.0, 32.0)
HALF = 0.5**0.5
TURNED = np.array([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]])
"""A camera at (1, 2, 3), turned by 90 degrees about z."""


class FileEvent:
    """An event that is set as long as a file is there: for processes that share nothing else."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def set(self) -> None:
        self._path.touch()

    def clear(self) -> None:
        self._path.unlink(missing_ok=True)

    def wait(self, seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while not self._path.exists():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.002)
        return True


class PlannedNumbers:
    """A generator whose uniform numbers lie at this share of their range and whose normal ones so many sigmas away."""

    def __init__(self, share: float = 0.5, sigmas: float = 0.0) -> None:
        self.share, self.sigmas = share, sigmas

    def uniform(self, low=0.0, high=1.0, size=None):
        return np.full(() if size is None else size, low + self.share * (np.asarray(high) - low))[()]

    def normal(self, mean=0.0, sigma=1.0, size=None):
        return np.full(() if size is None else size, mean + self.sigmas * sigma)[()]

    def standard_normal(self, size=None, dtype=np.float64):
        return np.asarray(self.normal(size=size), dtype)[()]

    def choice(self, values, size=None, p=None):
        """Return the last values, or of the numbers below one each in turn."""
        if isinstance(values, int):
            return np.arange(size) % values
        return np.resize(np.asarray(values)[-1:], size)


class FlatRasterizer(Rasterizer):
    """Every picture is mid-grey."""

    name = "flat"
    nbytes = 1000

    def over(self, background_rgb):
        return self

    def trained_at(self, long_side_px):
        return self

    def render(self, cameras, **options):
        sizes = [(c.intrinsics.height, c.intrinsics.width) for c in cameras]
        flat = [np.full(size, 0.5, np.float32) for size in sizes]
        return [Frame(np.stack([f, f, f], 2), f, f, f) for f in flat]


class BlindMatcher(Matcher):
    """Sees nothing."""

    name = "blind"

    def extract(self, rgb, limit):
        return Features(*(np.zeros(s, np.float32) for s in ((0, 2), (0,), (0, 64))))

    def match(self, a, b):
        return np.zeros((0, 2), np.int32)


def make_scene(name: str = "room", count: int = 5) -> LoadedScene:
    rng = np.random.default_rng(0)
    camera = Camera(PHOTO, Pose(TURNED))
    scene = GaussianScene(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        quats=np.tile(np.array([[HALF, 0, 0, HALF]], np.float32), (count, 1)),
        scales=np.tile(np.array([[0.3, 0.2, 0.1]], np.float32), (count, 1)),
        opacities=np.linspace(0.1, 1.0, count, dtype=np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
        info=SceneInfo(name, name.title(), "ab" * 32, "ply"),
        cameras=(NamedCamera("images/a.jpg", camera),),
    )
    return LoadedScene(scene, FlatRasterizer(), BlindMatcher())


Packed = tuple[GaussianScene, Rasterizer | None, Matcher]


def packed(loaded: LoadedScene) -> Packed:
    """Return what another process needs to make the same scene; real rasterizers are made anew there."""
    return loaded.scene, loaded.rasterizer if isinstance(loaded.rasterizer, FlatRasterizer) else None, loaded.matcher


def set_up_engine(scenes: Mapping[str, Packed], go_on: FileEvent, engine: EmbeddedEngine) -> None:
    """Give an engine the tests' scenes, and the process the estimators of tests/fake_estimators."""
    folder = str(Path(__file__).with_name("fake_estimators"))
    if folder not in service.estimators.__path__:
        service.estimators.__path__.append(folder)
    importlib.import_module("service.estimators.stepping").GO_ON = go_on  # type: ignore[attr-defined]
    for scene_id, (scene, rasterizer, matcher) in scenes.items():
        flat = rasterizer is not None
        loaded = LoadedScene(scene, rasterizer, matcher) if flat else LoadedScene.of(scene)
        engine.add_loaded(scene_id, loaded)
