"""`splatfix bench scale`: time and memory by the size of a scene, from its file to its localized photos.

Each size is a scene folder of its own (see `large_scenes`), measured in a process of its own. Loading is timed twice:
from the file, which writes the cached memory-mapped form, and from that form. Memory is the process's: `peak` up to the
end of loading and indexing; `resident` after the photos, of which `anonymous` is not backed by a file, so that the
kernel can't drop it.
"""

from __future__ import annotations

import multiprocessing
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from service.bench.bench_photos import find_photos
from service.bench.pose_metrics import COARSE, FINE, Outcome, Units, errors, units_of
from service.bench.street import STREET, StreetConfig, make_street, write_photos
from service.errors import BackendMissing, InvalidRequest
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.localize import localize
from service.photos.images import read_query
from service.pose.features.scene_focus import centre_depth
from service.scene_formats import load_scene
from service.types import Camera, GaussianScene

SIZES = (100_000, 300_000, 1_000_000, 3_000_000)
"""Numbers of Gaussians."""
_STATUS = Path("/proc/self/status")


def run(
    folder: Path,
    *,
    others: Sequence[Path] = (),
    sizes: Sequence[int] = SIZES,
    cameras: Literal["given", "ignored"] = "ignored",
    compressed: bool = False,
    work: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[dict[str, Any]]:
    """Return the list that `--json` writes, a row per size in Gaussians. Raises SceneError, InvalidRequest.

    `others` are put around the scene whose photos are localized; without any, varied copies of it. `cameras` as in
    `bench localize`. The large scenes are written to a temporary folder, in `work` if it is given.
    """
    _check_tools()
    from service.bench.large_scenes import write_folder  # loads gsply

    # As in `bench localize`: no index view may rest on a test photo's pose.
    test_names = [name for photo in find_photos(folder) for name in photo.names]
    scene = load_scene(folder, without_photos=test_names)
    if not scene.cameras:
        raise InvalidRequest("the scene needs training cameras, from which its units and its small sizes are computed.")
    around = [load_scene(other) for other in others]
    units = units_of([n.camera for n in scene.cameras], _depth_of(scene))
    rows = []
    for done, count in enumerate(sizes, 1):
        with tempfile.TemporaryDirectory(dir=work) as temporary:
            at = Path(temporary, f"{count}")
            large = _resize(scene, count, around)
            file = write_folder(large, at, folder, cameras=cameras == "given", compressed=compressed)
            facts = {"gaussians": large.count, "sh_degree": large.sh_degree, "file": file.name}
            facts |= {"cameras": cameras, "file_bytes": file.stat().st_size}
            # The file on disk is all that the measurement needs.
            del large
            rows.append(facts | _measured_apart(at, units))
        if progress:
            progress(done, len(sizes))
    return rows


def run_street(config: StreetConfig = STREET, *, work: Path | None = None) -> list[dict[str, Any]]:
    """Return the list that `--json` writes for the synthetic street (see `street`): one row. Raises SceneError.

    It is given with its training cameras, in a temporary folder, in `work` if it is given.
    """
    _check_tools()
    from service.bench.large_scenes import write_folder  # loads gsply

    with tempfile.TemporaryDirectory(dir=work) as temporary:
        photos, at = Path(temporary, "photos"), Path(temporary, "street")
        street = make_street(config)
        write_photos(street, photos, config.seed)
        units = units_of([n.camera for n in street.clean.cameras], _depth_of(street.clean))
        file = write_folder(street.trained, at, photos, cameras=True, compressed=False)
        facts = {"gaussians": street.trained.count, "sh_degree": street.trained.sh_degree, "file": file.name}
        facts |= {"cameras": "given", "file_bytes": file.stat().st_size}
        del street
        return [facts | _measured_apart(at, units)]


def _check_tools() -> None:
    if find_spec("gsply") is None:
        raise BackendMissing("large scenes are written by gsply; install splatfix[bench].", where="bench scale")
    if not _STATUS.exists():
        raise InvalidRequest("memory is read from /proc, which this system doesn't have.", where="bench scale")


def _measured_apart(folder: Path, units: Units) -> dict[str, Any]:
    """Measure in a new process, whose peak of memory is this scene's alone."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        return process.submit(measure_folder, folder, units).result()


def _depth_of(scene: GaussianScene) -> Callable[[Camera], float]:
    rasterizer = LoadedScene.of(scene).rasterizer
    return lambda camera: centre_depth(rasterizer, camera)


def _resize(scene: GaussianScene, count: int, others: Sequence[GaussianScene]) -> GaussianScene:
    from service.bench.large_scenes import keep_most_contributing, surround_with_copies

    # Smaller than the scene itself: the Gaussians that matter least are left out.
    if count < scene.count:
        return keep_most_contributing(scene, count, LoadedScene.of(scene).rasterizer)
    return surround_with_copies(scene, count, others)


def measure_folder(folder: Path, units: Units) -> dict[str, Any]:
    """Return times, memory and accuracy of loading, indexing and localizing in a scene folder.

    To be called in a new process. The first localization isn't counted.
    """
    cache = folder / "cache"
    seconds: dict[str, float] = {}

    def timed(name: str, call: Callable[[], Any]) -> Any:
        wall, cpu = time.perf_counter(), time.process_time()
        result = call()
        seconds[f"{name}_s"], seconds[f"{name}_cpu_s"] = time.perf_counter() - wall, time.process_time() - cpu
        return result

    timed("warm_up", _warm_up)
    before = process_memory()
    loaded = timed("load", lambda: LoadedScene.load(folder, cache_dir=cache))
    timed("first_views", lambda: loaded.usable(DEFAULT_ESTIMATOR))
    index = timed("index", lambda: loaded.prepare(DEFAULT_ESTIMATOR))
    # All of it: photos can be localized after the first views.
    for unit in ("s", "cpu_s"):
        seconds[f"index_{unit}"] += seconds[f"first_views_{unit}"]
    # Read before the queries: it is the peak of loading and indexing.
    peak = process_memory()["VmHWM"]
    outcomes = _outcomes(folder, loaded, units)
    after = process_memory()
    # One copy of the scene in memory at a time.
    del loaded
    again = timed("load_again", lambda: LoadedScene.load(folder, cache_dir=cache))
    timed("index_again", lambda: again.prepare(DEFAULT_ESTIMATOR))
    return {
        **seconds,
        "views": len(index.views),
        "bytes_before": before["VmRSS"],
        "peak_bytes": peak,
        "resident_bytes": after["VmRSS"],
        "anonymous_bytes": after["RssAnon"],
        "photos": len(outcomes),
        "success_5deg_0p05": sum(o.success(COARSE) for o in outcomes),
        "success_1deg_0p01": sum(o.success(FINE) for o in outcomes),
        "false_localized": sum(o.false for o in outcomes),
        "latency_ms_p50": float(np.median([o.latency_ms for o in outcomes])),
        "cpu_ms_p50": float(np.median([o.cpu_ms for o in outcomes])),
    }


def _warm_up() -> None:
    """Load the libraries and compile the kernels, with a small scene."""
    from service.bench.render import room_cameras, synthetic_room

    loaded = LoadedScene.of(synthetic_room(2000))
    loaded.rasterizer.render(room_cameras(64))
    loaded.matcher.extract(np.zeros((96, 128, 3), np.uint8), 10)


def _outcomes(folder: Path, loaded: LoadedScene, units: Units) -> list[Outcome]:
    outcomes = []
    photos = find_photos(folder)
    # The first photo twice: its first time includes allocation, and isn't counted.
    for photo in [photos[0], *photos]:
        data = photo.path.read_bytes()
        wall, cpu = time.perf_counter(), time.process_time()
        background = loaded.scene.info.background_rgb
        query = read_query(data, intrinsics=photo.camera.intrinsics, background_rgb=background)
        estimate = localize(query, loaded)
        spent = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
        error = errors(estimate.pose, photo.camera.pose, units)
        outcomes.append(Outcome(estimate.verdict.status, *error, *spent))
    return outcomes[1:]


def process_memory() -> dict[str, int]:
    """Return the counters of /proc/self/status for this process, in bytes."""
    found = re.findall(r"(\w+):\s+(\d+) kB", _STATUS.read_text("ascii"))
    return {name: 1024 * int(value) for name, value in found}
