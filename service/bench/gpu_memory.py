"""The parts of `splatfix bench gpu` that fill memory: scenes of growing size, too large ones, and many jobs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from service.bench.gpu_runner import Row
from service.bench.gpu_shared import Shared, every
from service.bench.large_scenes import keep_most_contributing, surround_with_copies
from service.bench.scale import process_memory
from service.errors import BackendMissing, DeviceMemoryFull
from service.interfaces import Frame
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene, choose_rasterizer
from service.types import Camera, GaussianScene

JOBS_AT_A_TIME = 4
_REPEATS = 5
"""Of each render that is timed; the median counts."""


def sizes(shared: Shared) -> Iterator[Row]:
    """Yield for each size of a scene its memory on the device, and the times of copying it there and of renders.

    The scene with varied copies around it, or the Gaussians of it that contribute most. A size that the device has no
    memory for is a row with the error, and the last one.
    """
    largest = _of_size(shared, max(shared.work.sizes))
    cameras = [named.camera for named in every(shared.scene.cameras, shared.work.views)]
    for count in shared.work.sizes:
        scene = largest if count == largest.count else _first(largest, count)
        try:
            row = _measure_size(shared, scene, cameras)
        except (BackendMissing, DeviceMemoryFull, RuntimeError) as error:
            # A renderer's own error, or PyTorch's of a full GPU; any other may have made the GPU unusable.
            if isinstance(error, RuntimeError) and type(error).__name__ != "OutOfMemoryError":
                raise
            yield {"gaussians": count, "error": f"{type(error).__name__}: {error}"[:300]}
            return
        yield {"gaussians": count, **row}


def _measure_size(shared: Shared, scene: GaussianScene, cameras: list[Camera]) -> dict[str, Any]:
    shared.device_memory()  # reading it starts a new peak
    began = time.perf_counter()
    rasterizer = shared.module.create(scene)
    seconds = {"create_s": time.perf_counter() - began}
    for width in (shared.work.sizes_px // 4, shared.work.sizes_px):
        small = [Camera(c.intrinsics.with_long_side(width), c.pose) for c in cameras]
        seconds[f"ms_{width}px"] = 1e3 * float(np.median([_seconds(rasterizer, [c]) for c in small * _REPEATS]))
        seconds[f"ms_{width}px_together"] = 1e3 * _seconds(rasterizer, small) / len(small)
    memory = {f"device_{name}": value for name, value in shared.device_memory().items()}
    return {**seconds, "bytes": rasterizer.nbytes, **memory, "resident_bytes": process_memory()["VmRSS"]}


def _seconds(rasterizer: Any, cameras: list[Camera]) -> float:
    began = time.perf_counter()
    rasterizer.render(cameras)  # returns arrays of the host: the device has finished
    return time.perf_counter() - began


def _of_size(shared: Shared, count: int) -> GaussianScene:
    if count < shared.scene.count:
        return keep_most_contributing(shared.scene, count, shared.reference.rasterizer)
    return surround_with_copies(shared.scene, count)


def _first(scene: GaussianScene, count: int) -> GaussianScene:
    """Return the first Gaussians: the scene itself, then as many of its copies as there are."""
    return replace(scene, **{n: getattr(scene, n)[:count] for n in ("means", "quats", "scales", "opacities", "sh")})


def out_of_memory(shared: Shared) -> Iterator[Row]:
    """Yield what happens where the device's memory is too small for a scene, then for a render, and afterwards.

    The device isn't filled: the renderer's module is told to take no more than a limit.
    """
    limit = getattr(shared.module, "limit_device_memory", None)
    if limit is None:
        yield {"case": "none", "happens": f"{shared.renderer} has no limit to its memory"}
        return
    scene, rasterizer = shared.scene, shared.tested.rasterizer
    camera = scene.cameras[0].camera
    camera = Camera(camera.intrinsics.with_long_side(shared.work.sizes_px), camera.pose)
    (before,) = rasterizer.render([camera])
    try:
        limit(scene.nbytes // 2)
        yield {"case": "a scene is loaded", "happens": _outcome(lambda: rasterizer.of(scene))}
        if choose_rasterizer()[0] == shared.renderer:
            loaded = LoadedScene.of(scene)
            yield {"case": "a scene is loaded by default", "happens": f"{loaded.rasterizer.name}: {loaded.warnings}"}
        limit(0)
        yield {"case": "an image is rendered", "happens": _outcome(lambda: rasterizer.render([camera]))}
    finally:
        limit(None)
    (after,) = rasterizer.render([camera])
    yield {"case": "there is memory again", "happens": "the same image" if _same(before, after) else "another image"}


def _outcome(attempt: Any) -> str:
    try:
        attempt()
    except Exception as error:  # which one is the result
        return f"{type(error).__name__}: {error}"[:300]
    return "it succeeds"


def _same(a: Frame, b: Frame) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("rgb", "alpha", "depth", "median_depth"))


def many_jobs(shared: Shared) -> Iterator[Row]:
    """Yield the memory of process and device after every tenth of many jobs, several at a time.

    The first row is taken after a twentieth of them, when everything is allocated that one job needs.
    """
    loaded, jobs = shared.tested, shared.work.jobs
    loaded.prepare(DEFAULT_ESTIMATOR)
    began, done = time.perf_counter(), 0
    marks = sorted({max(1, jobs // 20), *(max(1, jobs * tenth // 10) for tenth in range(1, 11))})
    with ThreadPoolExecutor(JOBS_AT_A_TIME) as threads:
        for mark in marks:
            photos = [shared.photos[number % len(shared.photos)] for number in range(done, mark)]
            list(threads.map(lambda photo: shared.localize(photo, loaded), photos))
            done = mark
            memory = {f"device_{name}": value for name, value in shared.device_memory().items()}
            yield {
                "jobs": done,
                "seconds": time.perf_counter() - began,
                "resident_bytes": process_memory()["VmRSS"],
                **memory,
            }
