"""The findings of `splatfix doctor`: each part of the service is tried on this machine."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from service import __version__
from service.bench.render import room_cameras, synthetic_room
from service.estimators import ESTIMATORS
from service.geometry import look_at
from service.interfaces import SurfacePoints
from service.loaded_scene import DEFAULT_MATCHER, choose_rasterizer
from service.matchers import MATCHERS
from service.operating_system import load_averages, missing_limits
from service.plugins import BUILT_IN, FOLDER, PLUGINS_DIR
from service.pose.absolute_pose.pnp import estimate_absolute_pose
from service.pose.absolute_pose.rig_pose import RigMatches, estimate_rig_pose
from service.pose.absolute_pose.unknown_lens import linearize_reprojection
from service.pose.refinement.photometric import refine_photometric
from service.pose.refinement.uncertainty import pose_uncertainty
from service.pose.retrieval.floaters import find_floaters
from service.pose.retrieval.free_space import free_space_of
from service.pose.retrieval.inverted_views import InvertedConfig, InvertedViews
from service.pose.training_photos.patch_kernels import linearize_places
from service.pose.training_photos.patch_matching import PATCHES, grey, matched, pinhole_vector, predicted
from service.render import RASTERIZERS
from service.render.cpu import CpuRasterizer
from service.render.slabs import SlabConfig
from service.scene_formats import SCENE_FORMATS
from service.types import NO_CORRECTION, Camera, GaussianScene, Intrinsics, NamedCamera, Pose, SceneInfo


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of examining one part."""

    subject: str
    ok: bool
    detail: str
    needed: bool = True
    """Whether localizing depends on it: then `doctor` fails without it."""

    @property
    def line(self) -> str:
        """As it is printed."""
        mark = "ok  " if self.ok else "FAIL" if self.needed else "no  "
        return f"{mark} {self.subject:24} {self.detail}"


def findings() -> Iterator[Finding]:
    """Examine the machine, yielding each finding as it is made: some take seconds."""
    yield Finding("splatfix", True, f"{__version__}, Python {platform.python_version()}, {platform.platform()}")
    yield Finding("processor", True, processor())
    chosen, skipped_rasterizers = choose_rasterizer()
    yield Finding("renders with", True, f"{chosen} ({skipped_rasterizers})" if skipped_rasterizers else chosen)
    # A scene that does not fit into the GPU's memory is rendered on the CPU, so that must work in any case.
    for name in dict.fromkeys((chosen, "cpu")):
        yield _tried(f"renderer {name}", partial(_try_renderer, name))
    yield _tried("matcher", _try_matcher)
    yield _package("pi-heif", "HEIC photos")
    yield Finding("limits of decoders", not missing_limits(), missing_limits() or "memory and CPU time", needed=False)
    yield from plugin_findings()
    yield _package("viser", "the viewer")
    yield _gpu()
    yield _browser()


def compile_kernels() -> None:
    """Run every compiled kernel once, so that later runs find it in the cache: a minute, later seconds."""
    # What they return doesn't matter: each call compiles kernels for the types of arrays that jobs have.
    room, (camera,) = synthetic_room(2000), room_cameras(64)[:1]
    rasterizer = RASTERIZERS.load("cpu").create(room)
    frame = rasterizer.render([camera])[0]
    rasterizer.pose_gradient(camera, frame.rgb)
    rasterizer.scene_gradients(camera, frame.rgb)
    photo = (frame.rgb * 255).clip(0, 255).astype(np.uint8)
    refine_photometric(photo, frame, camera, camera, 2)
    pose_uncertainty(photo, frame, camera, camera, None)
    points = room.means[:8].astype(np.float64)
    estimate_absolute_pose(np.eye(8, 2) * 64.0, points, camera.intrinsics, 4.0, 8)
    seen = np.eye(8, 2) * 64.0
    one = RigMatches(seen, points, camera.intrinsics, Pose(np.eye(4)), 4.0)
    estimate_rig_pose([one, replace(one, photo_px=seen + 8.0)], 8, [camera.pose])
    linearize_reprojection(np.zeros((8, 2)), points, camera.intrinsics, camera.pose, NO_CORRECTION)
    CpuRasterizer(room, slab_config=SlabConfig(min_blocks=0)).render([camera])
    free_space_of(room).enclosures(points)
    views = [np.eye(64, dtype=np.float32)] * 2
    words = InvertedConfig(min_words=2, exact_views=1)
    InvertedViews.of(views, config=words).scores(views[0], views, config=words)
    _match_patches(grey(photo), points, camera)
    find_floaters(replace(room, cameras=(NamedCamera("warm", camera),)))


def _match_patches(photo: UInt8[np.ndarray, "h w"], points: Float64[np.ndarray, "n 3"], camera: Camera) -> None:
    tangents = np.tile(np.eye(3, 2, dtype=np.float32), (len(points), 1, 1))
    patches = np.zeros((len(points), PATCHES.side_px, PATCHES.side_px), np.uint8)
    covariances, photos = np.zeros((len(points), 3, 3), np.float32), np.zeros(len(points), np.int32)
    surface = SurfacePoints(points, covariances, tangents, patches, photos, np.zeros((1, 3)))
    places = matched(photo, patches, predicted(surface, camera), 1.0)
    whitened, rows = np.empty((len(points), 2)), np.empty((len(points), 2, 6))
    k = pinhole_vector(camera.intrinsics)
    linearize_places(points, covariances, places, camera.pose.camera_from_world, k, 0.5, rows, whitened)


def processor() -> str:
    """Return the processor's name, cores, SIMD extensions and load, on which every timing depends."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text("utf-8").splitlines() if info.exists() else []
    # One block for each core: of the same keys, the last core's value stays.
    values = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    flags = set(values.get("flags", values.get("Features", "")).split())
    simd = [name for name in ("avx512f", "avx512bw", "avx2", "fma", "asimd", "sve") if name in flags]
    model = values.get("model name", platform.processor() or platform.machine())
    load = ", ".join(f"{value:.1f}" for value in load_averages()) or "unknown"
    return f"{model}, {os.cpu_count()} cores ({' '.join(simd) or 'no SIMD known'}), load {load}"


def _tried(subject: str, attempt: Callable[[], str]) -> Finding:
    began = time.perf_counter()
    try:
        detail = attempt()
    except Exception as error:  # any error is the finding
        return Finding(subject, False, f"{type(error).__name__}: {error}")
    return Finding(subject, True, f"{detail} ({time.perf_counter() - began:.1f} s)")


def _try_renderer(name: str) -> str:
    """Render one opaque red Gaussian, which shows that the kernels compile and compute here."""
    scene = GaussianScene(
        means=np.zeros((1, 3), np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.full((1, 3), 0.3, np.float32),
        opacities=np.ones(1, np.float32),
        # Degree 0: colour = 0.5 + 0.2821 sh.
        sh=np.array([[[1.7725, -1.7725, -1.7725]]], np.float32),
        info=SceneInfo("doctor", "doctor", "", "none"),
    )
    pose = look_at(np.array([0.0, 0.0, 3.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    camera = Camera(Intrinsics(64, 64, 64.0, 64.0, 32.0, 32.0), pose)
    middle = RASTERIZERS.load(name).create(scene).render([camera])[0].rgb[32, 32]
    if np.abs(middle - [1, 0, 0]).max() > 0.05:
        raise ArithmeticError(f"a red Gaussian came out as {middle}")
    return "a test image is right"


def _try_matcher() -> str:
    """Match a noise image with itself, which shows that the weights are installed."""
    # Blocks of 4 pixels: finer noise has no corners at the scale of the features.
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8).repeat(4, 0).repeat(4, 1)
    matcher = MATCHERS.load(DEFAULT_MATCHER).create()
    features = matcher.extract(image, 200)
    matches = matcher.match(features, features)
    if len(matches) < 20:
        raise ArithmeticError(f"an image matches itself at {len(matches)} points only")
    return f"{matcher.name} has its weights, torch {metadata.version('torch')}"


def _package(name: str, purpose: str) -> Finding:
    found = importlib.util.find_spec(name.replace("-", "_")) is not None
    return Finding(purpose, found, f"{name} {metadata.version(name)}" if found else f"{name} is not installed")


def plugin_findings() -> Iterator[Finding]:
    """Import every plug-in; yield whether it can run here, and where it comes from unless it is built in."""
    registries = {"estimator": ESTIMATORS, "matcher": MATCHERS, "renderer": RASTERIZERS, "format": SCENE_FORMATS}
    for kind, registry in registries.items():
        for name in registry.names():
            reason = registry.missing(name)
            source = registry.source(name)
            origin = "" if source == BUILT_IN else f" (from {PLUGINS_DIR})" if source == FOLDER else f" (from {source})"
            yield Finding(f"{kind} {name}", reason is None, (reason or "available") + origin, needed=False)


def _gpu() -> Finding:
    tool = shutil.which("nvidia-smi")
    if not tool:
        return Finding("GPU", False, "no NVIDIA driver; rendering is on the CPU", needed=False)
    # Not PyTorch: it may be built without CUDA on a machine that has a GPU.
    listed = subprocess.run([tool, "-L"], capture_output=True, text=True, timeout=20, check=False).stdout.strip()
    if importlib.util.find_spec("gsplat") is None:
        return Finding("GPU", False, f"{listed or 'none'}; gsplat is not installed", needed=False)
    return Finding("GPU", bool(listed), listed or "none", needed=False)


def _browser() -> Finding:
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    return Finding("browser", found is not None, found or "no Chromium: browser tests are skipped", needed=False)
