"""`splatfix bench peer`: our estimator and structure from motion against the training photos, on the same photos.

Test photos, their modifications and the cameras that are left for training are those of `bench localize`. Each method
runs in a process of its own, so that its peak of memory is its own; CPU time is the process's, decoding included.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.bench.localize import BenchScene, Trial, digested, load_bench_scene, localize_trial, make_trials
from service.bench.modifications import require_modifications
from service.bench.peer.photo_map import Peer, PhotoMap, PosedPhoto
from service.bench.pose_metrics import COARSE, FINE, Outcome, errors
from service.bench.scale import process_memory
from service.errors import InvalidImage, SceneNotFound, UnknownName
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.localize import Request
from service.photos.images import photo_size, read_query
from service.pose.training_photos.patch_matching import grey
from service.results import Status
from service.scene_formats.training_files import training_photo_path
from service.types import Camera, Intrinsics, Pose

FULL_SIZE_PX = 100_000
"""Photos are decoded as they are: detail is what structure from motion is exact by."""
MIN_INLIERS = 12
"""From which on an answer of the peer counts as localized; hloc and COLMAP have no verdict of their own."""


@dataclass(frozen=True, slots=True)
class PeerMethod:
    """Structure from motion with these features."""

    sift: dict[str, Any]
    best_photos: int | None
    """A photo is matched with so many training photos; None: with all points directly."""


OURS = ("splatfix", "splatfix_photos")
"""Without and with the training photos' digest."""
PEERS = {
    "sift_best10": PeerMethod({}, 10),
    "dog_direct": PeerMethod({"first_octave": 0, "peak_threshold": 0.01}, None),
}
"""COLMAP's default SIFT and the ten best photos; hloc's DoG configuration against all points (the cheap one)."""
METHODS = (*OURS, *PEERS)


@dataclass(frozen=True, slots=True)
class Task:
    """What one method is to localize; passed to its process."""

    folder: Path
    data: Path | None = None
    layout: str = "auto"
    modify: tuple[str, ...] = ()
    seed: int = 0


def run(
    tasks: Sequence[Task], methods: Sequence[str] = METHODS, progress: Callable[[int, int], None] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield one row for each scene and method. Raises SceneError, UnknownName, BackendMissing."""
    for name in methods:
        if name not in METHODS:
            raise UnknownName(f"unknown method '{name}'; known: {', '.join(METHODS)}.", where="method")
    for task in tasks:
        require_modifications(task.modify)
    done = 0
    # Spawned: a fork would share, and hide, the memory of what was loaded before.
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, max_tasks_per_child=1) as processes:
        for task in tasks:
            for method in methods:
                yield processes.submit(row, task, method).result()
                done += 1
                if progress:
                    progress(done, len(tasks) * len(methods))


def row(task: Task, method: str) -> dict[str, Any]:
    """Return one method's figures on one scene, in this process. Raises SceneError, BackendMissing."""
    scene = load_bench_scene(task.folder, task.data, layout=task.layout)
    trials = list(make_trials(scene, "none", len(scene.photos), task.seed, task.modify))
    if method in OURS:
        facts, localize_one = _ours(scene, task, method == "splatfix_photos")
    else:
        facts, localize_one = _peer(scene, task, PEERS[method])
    outcomes = measured(scene, trials, localize_one)
    return {
        "scene": scene.loaded.scene.info.name,
        "method": method,
        "modify": list(task.modify),
        "training_cameras": len(scene.training),
        **facts,
        **figures(outcomes, method in OURS),
        "peak_bytes": process_memory()["VmHWM"],
        "per_query": [
            {
                "photo": trial.photo,
                "status": str(outcome.status),
                "rotation_deg": outcome.rotation_deg,
                "translation_units": outcome.translation_units,
                "cpu_ms": outcome.cpu_ms,
            }
            for trial, outcome in zip(trials, outcomes, strict=True)
        ],
    }


def figures(outcomes: Sequence[Outcome], has_verdict: bool) -> dict[str, Any]:
    """Return the sums of a method's answers; without a verdict each one within bounds counts as a success."""

    def successes(bound: tuple[float, float]) -> int:
        return sum(o.success(bound) if has_verdict else o.within(bound) for o in outcomes)

    return {
        "photos": len(outcomes),
        "right_1deg_0p01": successes(FINE),
        "right_5deg_0p05": successes(COARSE),
        "localized": sum(o.status is Status.LOCALIZED for o in outcomes),
        "false_localized": sum(o.false for o in outcomes),
        "median_rotation_deg": float(np.median([o.rotation_deg for o in outcomes])),
        "median_translation_units": float(np.median([o.translation_units for o in outcomes])),
        "cpu_ms_p50": float(np.median([o.cpu_ms for o in outcomes])),
    }


Answer = tuple[Pose | None, Status]


def measured(scene: BenchScene, trials: Sequence[Trial], localize_one: Callable[[Trial], Answer]) -> list[Outcome]:
    """Localize every trial; the first one once before, not counted: that time includes compilation."""
    localize_one(trials[0])
    outcomes = []
    for trial in trials:
        wall, cpu = time.perf_counter(), time.process_time()
        pose, status = localize_one(trial)
        latency_ms, cpu_ms = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
        found = (180.0, np.inf) if pose is None else errors(pose, trial.truth.pose, scene.units)
        outcomes.append(Outcome(status, *found, latency_ms, cpu_ms))
    return outcomes


def _ours(scene: BenchScene, task: Task, photos: bool) -> tuple[dict[str, Any], Callable[[Trial], Answer]]:
    scene.loaded.prepare(DEFAULT_ESTIMATOR)  # not counted: its time includes compilation
    began = time.process_time()
    loaded = LoadedScene.of(scene.loaded.scene)
    loaded.prepare(DEFAULT_ESTIMATOR)
    facts: dict[str, Any] = {"build_cpu_s": time.process_time() - began}
    scene = BenchScene(loaded, scene.photos, scene.training, scene.units, scene.layout)
    if photos:
        digest = digested(scene, task.data or task.folder)
        facts["build_cpu_s"] += 1e-3 * digest["digest_cpu_ms_a_photo"] * digest["digest_photos"]
        facts["map_bytes"] = int(digest["digest_bytes_a_photo"] * digest["digest_photos"])
    request = Request(seed=task.seed)

    def localize_one(trial: Trial) -> Answer:
        estimate = localize_trial(scene, trial, request)
        return estimate.pose, estimate.verdict.status

    return facts, localize_one


def _peer(scene: BenchScene, task: Task, method: PeerMethod) -> tuple[dict[str, Any], Callable[[Trial], Answer]]:
    from service.bench.peer.colmap import Colmap

    peer: Peer = Colmap(method.sift)
    background = scene.background_rgb
    photos = training_photos(scene, task.data or task.folder)
    photo_map = PhotoMap.of(photos, peer, ranks_photos=method.best_photos is not None)

    def localize_one(trial: Trial) -> Answer:
        photo = _decoded(trial.data, trial.intrinsics, background, trial.truth.pose)
        found = photo_map.localize(photo, peer, method.best_photos or 0)
        if found is None:
            return None, Status.NOT_LOCALIZED
        pose, inliers = found
        return pose, Status.LOCALIZED if inliers >= MIN_INLIERS else Status.UNCERTAIN

    facts = {"build_cpu_s": photo_map.facts.build_cpu_s, "map_bytes": photo_map.nbytes}
    return {**facts, "points": photo_map.facts.points}, localize_one


def training_photos(scene: BenchScene, folder: Path) -> list[PosedPhoto]:
    """Return the training photos that lie in the data set's folder, in full size. Raises SceneNotFound."""
    origin = np.array(scene.loaded.scene.info.origin_in_world)
    photos = []
    for named in scene.loaded.scene.cameras:
        path = training_photo_path(folder, named.name)
        if path is None:
            continue
        data, given = path.read_bytes(), named.camera.intrinsics
        try:
            width, height = photo_size(data)
            # Photos are often stored smaller than the camera file says, but have their camera's shape.
            if abs(width * given.height - height * given.width) > 0.01 * width * given.height:
                continue
            world_from_camera = named.camera.pose.world_from_camera.copy()
            world_from_camera[:3, 3] += origin
            intrinsics = given.resized(width, height)
            photos.append(_decoded(data, intrinsics, scene.background_rgb, Pose(world_from_camera)))
        except InvalidImage:
            continue
    if len(photos) < 2:
        raise SceneNotFound(
            "fewer than two photos of training cameras lie there.",
            where=str(folder),
            hint="Put them where the camera file says, or in a folder 'images' beside it.",
        )
    return photos


def _decoded(data: bytes, intrinsics: Intrinsics, background: tuple[float, float, float], pose: Pose) -> PosedPhoto:
    query = read_query(data, intrinsics=intrinsics, background_rgb=background, long_side=FULL_SIZE_PX)
    return PosedPhoto(grey(query.rgb), query.valid_mask, Camera(query.intrinsics, pose))
