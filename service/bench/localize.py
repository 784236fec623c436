"""`splatfix bench localize`: localize a data set's test photos in its scene and compare with the truth.

The test photos' cameras are taken out before the scene is loaded, whatever layout it has, so that no index view
and no unit rests on them. Latency is wall time from the photo's bytes to the result, decoding included, with the
estimator's index ready and one localization done before; CPU time is the whole process's in the same span.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from service.bench.bench_photos import BenchPhoto, sent
from service.bench.datasets import PHOTO_SUFFIXES, DataSet, read_data_set
from service.bench.modifications import require_modifications
from service.bench.pose_metrics import COARSE, FINE, Outcome, Units, errors, nees, summary, units_of
from service.bench.start_poses import require_kind, start_pose
from service.errors import SceneNotFound
from service.estimators import ESTIMATORS
from service.localize import DEFAULT_MATCHER, LoadedScene, Request, localize
from service.photos.images import read_query
from service.pose.features.scene_focus import centre_depth
from service.results import PoseEstimate
from service.scene_formats import load_scene
from service.scene_formats.manifest import read_manifest
from service.types import Camera, GaussianScene, Intrinsics, Pose

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
MAX_OCCLUDERS = 20


@dataclass(frozen=True, slots=True)
class Trial:
    """One thing to send, and its truth."""

    photo: str
    number: int
    data: bytes
    told: Intrinsics
    """Those sent with it."""
    truth: Camera
    start: Pose | None


@dataclass(frozen=True, slots=True)
class Subject:
    """A scene to localize in, the photos to localize, and its units."""

    loaded: LoadedScene
    photos: tuple[BenchPhoto, ...]
    training: tuple[Camera, ...]
    """Never a test photo's."""
    units: Units
    layout: str

    @property
    def background_rgb(self) -> tuple[float, float, float]:
        return self.loaded.scene.info.background_rgb


def run(
    folder: Path,
    *,
    data: Path | None = None,
    layout: str = "auto",
    background: Literal["scene", "white", "black"] = "scene",
    estimator: str = "view_index",
    matcher: str = DEFAULT_MATCHER,
    start: str = "none",
    trials: int = 1,
    seed: int = 0,
    intrinsics: Literal["given", "approximate", "withheld"] = "given",
    cameras: Literal["given", "ignored"] = "given",
    modify: Sequence[str] = (),
    occluders: Path | None = None,
    options: Any = None,
    budget: Budget | None = None,
    progress: Callable[[int, int], None] | None = None,
    cache_dir: Path | None = None,
    on_miss: Callable[[Subject, Trial, PoseEstimate], dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Return the object that `--json` writes. Raises SceneError, UnknownName, InvalidOptions.

    `folder` has the scene; `data` the photos, if they are elsewhere. `occluders` is a folder with photos of another
    scene. `options` are the estimator's `Options`; None: its defaults. With `cameras="ignored"` the scene is used
    without its training cameras; they still define the units. What `on_miss` tells of a query that isn't a success at
    1 deg and 0.01 units is added to its line.
    """
    require_kind(start)
    require_modifications(modify)
    chosen, budget = options or ESTIMATORS.load(estimator).Options(), budget or Budget()
    one = subject(
        Path(folder), data, layout=layout, background=background, cameras=cameras, matcher=matcher, cache_dir=cache_dir
    )
    began = time.perf_counter()
    one.loaded.prepare(estimator)
    prepare_s = time.perf_counter() - began
    todo = list(trials_of(one, start, trials * len(one.photos), seed, tuple(modify), occluders))
    limits = {"budget_s": budget.seconds, "budget_renders": budget.renders}
    request = Request(estimator=estimator, options=chosen, seed=seed, **limits)

    def answer(trial: Trial) -> PoseEstimate:
        return answered(one, trial, request, intrinsics)

    def told_of(trial: Trial, estimate: PoseEstimate) -> dict[str, Any]:
        return on_miss(one, trial, estimate) if on_miss else {}

    outcomes, per_query = measure(todo, answer, one.units, progress, told_of)
    asked = {"estimator": estimator, "matcher": matcher, "start": start, "trials": trials, "seed": seed}
    asked |= {"layout": one.layout, "background_rgb": list(one.background_rgb)}
    asked |= {"intrinsics": intrinsics, "cameras": cameras, "modify": list(modify)}
    asked |= {"options": dataclasses.asdict(chosen), "budget": dataclasses.asdict(budget)}
    facts = {"photos": len(one.photos), "training_cameras": len(one.training), "gaussians": one.loaded.scene.count}
    facts |= {"forward_facing": one.units.forward_facing, "units_per_scene_unit": one.units.units_per_scene_unit}
    facts |= {"prepare_s": prepare_s}
    return {"scene": one.loaded.scene.info.name, **asked, **facts, **summary(outcomes), "per_query": per_query}


@dataclass(frozen=True, slots=True)
class Budget:
    """When an estimator is stopped; its best so far is then the answer."""

    seconds: float | None = None
    renders: int | None = None


def measure(
    todo: Sequence[Trial],
    answer: Callable[[Trial], PoseEstimate],
    units: Units,
    progress: Callable[[int, int], None] | None = None,
    on_miss: Callable[[Trial, PoseEstimate], dict[str, Any]] | None = None,
) -> tuple[list[Outcome], list[dict[str, Any]]]:
    """Answer every trial and compare; the first one is answered twice, and only the second time counts."""
    outcomes, lines = [], []
    answer(todo[0])
    for done, trial in enumerate(todo, 1):
        wall, cpu = time.perf_counter(), time.process_time()
        estimate = answer(trial)
        latency_ms, cpu_ms = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
        outcome = Outcome(estimate.verdict.status, *errors(estimate.pose, trial.truth.pose, units), latency_ms, cpu_ms)
        outcomes.append(outcome)
        lines.append(line_of(trial, estimate, outcome, units))
        if on_miss and not outcome.success(FINE):
            lines[-1] |= on_miss(trial, estimate)
        if progress:
            progress(done, len(todo))
    return outcomes, lines


def subject(
    folder: Path,
    data: Path | None = None,
    *,
    layout: str = "auto",
    background: str = "scene",
    cameras: str = "given",
    matcher: str = DEFAULT_MATCHER,
    cache_dir: Path | None = None,
) -> Subject:
    """Read a data set and its scene without the test photos. Raises SceneError, UnknownName."""
    found = read_data_set(data or folder, layout, folder)
    scene = _scene(folder, found, background)
    training = [named.camera for named in scene.cameras] or [photo.camera for photo in found.test]
    if cameras == "ignored":
        scene = _scene(folder, found, background, cameras=False)
    loaded = LoadedScene.of(scene, cache_dir=cache_dir, matcher=matcher)
    units = units_of(training, lambda camera: centre_depth(loaded.rasterizer, camera))
    return Subject(loaded, found.test, tuple(training), units, found.layout)


def _scene(folder: Path, found: DataSet, background: str, cameras: bool = True) -> GaussianScene:
    scene = load_scene(folder, without_photos=found.held_back, cameras=cameras, training=found.training)
    rgb = BACKGROUNDS.get(background)
    if rgb is None and not (folder.is_dir() and read_manifest(folder).background):
        rgb = found.background_rgb
    if rgb is None or rgb == scene.info.background_rgb:
        return scene
    # The digest is the key of cached view indexes: a render over another background is another one.
    return replace(scene, info=replace(scene.info, background_rgb=rgb, sha256=f"{scene.info.sha256}-{rgb}"))


def trials_of(
    one: Subject,
    start: str,
    count: int,
    seed: int,
    modify: tuple[str, ...] = (),
    occluders: Path | None = None,
) -> Iterator[Trial]:
    """Yield `count` trials, photo after photo: as many for each as go round, each with its own start.

    They are the same in every run with this seed, and the first ones also for a larger count.
    """
    cut = _pictures(occluders) if occluders else ()
    for index, photo in enumerate(one.photos):
        numbers = range(len(range(index, count, len(one.photos))))
        one_sent = sent(photo, modify, one.background_rgb, seed, cut) if numbers else None
        for number in numbers:
            assert one_sent is not None
            rng = np.random.default_rng([seed, index, number])
            begin = start_pose(start, one_sent.truth.pose, one.units, one.training, rng)
            yield Trial(photo.name, number, one_sent.data, one_sent.told, one_sent.truth, begin)


def _pictures(folder: Path) -> list[Float32[np.ndarray, "_ _ 3"]]:
    """Return photos of a folder, at most MAX_OCCLUDERS. Raises SceneNotFound."""
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in PHOTO_SUFFIXES) if folder.is_dir() else []
    if not files:
        raise SceneNotFound("there are no photos to cut occluders from.", where=str(folder))
    step = -(-len(files) // MAX_OCCLUDERS)
    return [read_query(file.read_bytes()).rgb.astype(np.float32) / 255 for file in files[::step]]


def answered(one: Subject, trial: Trial, request: Request, intrinsics: str = "given") -> PoseEstimate:
    """Localize one trial as the service would."""
    told = None if intrinsics == "withheld" else trial.told
    if told and intrinsics == "approximate":
        told = replace(told, trust="approximate")
    query = read_query(trial.data, intrinsics=told, prior=trial.start, background_rgb=one.background_rgb)
    return localize(query, one.loaded, request)


def line_of(trial: Trial, estimate: PoseEstimate, outcome: Outcome, units: Units) -> dict[str, Any]:
    """Return what the result file has of one trial."""
    verdict = estimate.verdict
    begun = errors(trial.start, trial.truth.pose, units) if trial.start else (None, None)
    return {
        "photo": trial.photo,
        "trial": trial.number,
        "status": str(verdict.status),
        "reason": str(verdict.reason),
        "score": verdict.score,
        "inliers": verdict.inliers,
        "success_5deg_0p05": outcome.success(COARSE),
        "success_1deg_0p01": outcome.success(FINE),
        "rotation_deg": outcome.rotation_deg,
        "translation_units": outcome.translation_units,
        "start_world_from_camera": trial.start.world_from_camera.tolist() if trial.start else None,
        "start_rotation_deg": begun[0],
        "start_translation_units": begun[1],
        "intrinsics_source": estimate.intrinsics_source,
        "renders": estimate.renders,
        "latency_ms": outcome.latency_ms,
        "cpu_ms": outcome.cpu_ms,
        "nees": nees(estimate, trial.truth.pose),
        "covariance": None if verdict.covariance is None else verdict.covariance.tolist(),
        "focal_error": estimate.intrinsics.fx / trial.truth.intrinsics.fx - 1.0,
        "focal_sigma": verdict.focal_sigma,
        "stages_ms": {timing.stage: 1e3 * timing.wall_s for timing in estimate.timings},
    }
