"""`splatfix bench localize`: localize a scene's test photos and compare with the truth.

The test photos' cameras are taken out before the scene is loaded, whatever layout it has, so that no index view
and no unit rests on them. Latency is wall time from the photo's bytes to the result, decoding included, with the
estimator's index ready and one localization done before; CPU time is the whole process's in the same span.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from service.bench.metrics import COARSE, FINE, Outcome, Units, errors, nees, summary, units_of
from service.bench.queries import BenchPhoto, find_photos, photo_bytes
from service.bench.starts import require_kind, start_pose
from service.estimators import ESTIMATORS
from service.images import read_query
from service.localize import DEFAULT_MATCHER, LoadedScene, Request, localize
from service.pose.focus import centre_depth
from service.scene_formats import load_scene
from service.types import Camera, Pose, PoseEstimate


@dataclass(frozen=True, slots=True)
class Trial:
    """One thing to send, and its truth."""

    photo: str
    number: int
    data: bytes
    truth: Camera
    start: Pose | None


def run(
    folder: Path,
    *,
    estimator: str = "view_index",
    matcher: str = DEFAULT_MATCHER,
    start: str = "none",
    trials: int = 1,
    seed: int = 0,
    intrinsics: Literal["given", "withheld"] = "given",
    cameras: Literal["given", "ignored"] = "given",
    modify: Sequence[str] = (),
    options: Any = None,
    budget: Budget | None = None,
    progress: Callable[[int, int], None] | None = None,
    cache_dir: Path | None = None,
) -> dict[str, Any]:
    """Return the object that `--json` writes. Raises SceneError, UnknownName, InvalidOptions.

    `options` are the estimator's `Options`; None: its defaults. With `cameras="ignored"` the scene is used without
    its training cameras; they still define the units.
    """
    require_kind(start)
    chosen, budget = options or ESTIMATORS.load(estimator).Options(), budget or Budget()
    folder = Path(folder)
    photos = find_photos(folder)
    loaded, training = _loaded(folder, photos, cameras, matcher, cache_dir)
    began = time.perf_counter()
    loaded.prepare(estimator)
    prepare_s = time.perf_counter() - began
    units = units_of(training, lambda camera: centre_depth(loaded.rasterizer, camera))
    background = loaded.scene.info.background_rgb
    todo = list(_trials(photos, start, trials, seed, tuple(modify), background, units, training))

    def answer(trial: Trial) -> PoseEstimate:
        given = trial.truth.intrinsics if intrinsics == "given" else None
        query = read_query(trial.data, intrinsics=given, prior=trial.start, background_rgb=background)
        limits = {"budget_s": budget.seconds, "budget_renders": budget.renders}
        return localize(query, loaded, Request(estimator=estimator, options=chosen, seed=seed, **limits))

    outcomes, per_query = measure(todo, answer, units, progress)
    asked = {"estimator": estimator, "matcher": matcher, "start": start, "trials": trials, "seed": seed}
    asked |= {"intrinsics": intrinsics, "cameras": cameras, "modify": list(modify)}
    asked |= {"options": dataclasses.asdict(chosen), "budget": dataclasses.asdict(budget)}
    facts = {"photos": len(photos), "training_cameras": len(training), "gaussians": loaded.scene.count}
    facts |= {"forward_facing": units.forward_facing, "units_per_scene_unit": units.units_per_scene_unit}
    facts |= {"prepare_s": prepare_s}
    return {"scene": loaded.scene.info.name, **asked, **facts, **summary(outcomes), "per_query": per_query}


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
        lines.append(_line(trial, estimate, outcome, units))
        if progress:
            progress(done, len(todo))
    return outcomes, lines


def _loaded(
    folder: Path, photos: Sequence[BenchPhoto], cameras: str, matcher: str, cache_dir: Path | None
) -> tuple[LoadedScene, list[Camera]]:
    """Return the scene without the test photos, and its training cameras; the truth's if there are none."""
    held_back = [name for photo in photos for name in photo.names]
    scene = load_scene(folder, without_photos=held_back)
    training = [named.camera for named in scene.cameras] or [photo.camera for photo in photos]
    if cameras == "ignored":
        scene = load_scene(folder, without_photos=held_back, cameras=False)
    return LoadedScene.of(scene, cache_dir=cache_dir, matcher=matcher), training


def _trials(
    photos: Sequence[BenchPhoto],
    start: str,
    trials: int,
    seed: int,
    modify: tuple[str, ...],
    background_rgb: tuple[float, float, float],
    units: Units,
    training: Sequence[Camera],
) -> Iterator[Trial]:
    """Each trial of a photo has its own start, the same in every run with this seed."""
    for index, photo in enumerate(photos):
        data, truth = photo_bytes(photo, modify, background_rgb, seed)
        for number in range(trials):
            rng = np.random.default_rng([seed, index, number])
            yield Trial(photo.name, number, data, truth, start_pose(start, truth.pose, units, training, rng))


def _line(trial: Trial, estimate: PoseEstimate, outcome: Outcome, units: Units) -> dict[str, Any]:
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
