"""`splatfix bench localize`: accuracy and time of localizing a data set's test photos in its scene.

The test photos' cameras are removed before the scene is loaded, whatever its layout, so that neither index views nor
units depend on them. Latency is wall time from the photo's bytes to the result, decoding included, with the estimator's
index ready and one localization done before; CPU time is the whole process's in the same interval.
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

from service.accuracy import DEFAULT_ACCURACY, Accuracy
from service.bench.bench_photos import BenchPhoto, prepare_photo
from service.bench.datasets import PHOTO_SUFFIXES, DataSet, read_data_set
from service.bench.modifications import require_modifications
from service.bench.pose_metrics import COARSE, FINE, Outcome, Units, errors, nees, summary, units_of
from service.bench.scene_modifications import modified_scene, require_scene_modifications
from service.bench.start_poses import require_kind, start_pose
from service.errors import SceneNotFound
from service.estimators import ESTIMATORS
from service.interfaces import Rasterizer
from service.loaded_scene import DEFAULT_MATCHER, LoadedScene
from service.localize import Request, localize
from service.photos.images import read_query
from service.pose.features.image_sizes import RENDER_PX, sized
from service.pose.features.scene_focus import centre_depth
from service.pose.verification.signals import typical_depth
from service.results import PoseEstimate
from service.scene_formats import load_scene
from service.scene_formats.manifest import read_manifest
from service.types import Camera, GaussianScene, Intrinsics, Pose

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
MAX_OCCLUDERS = 20
"""Photos read of a folder of occluders, evenly spaced."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One localization: photo, intrinsics and start pose to send, and the true camera."""

    photo: str
    number: int
    """Among the trials of this photo."""
    data: bytes
    intrinsics: Intrinsics
    """Sent with the photo."""
    truth: Camera
    start: Pose | None


@dataclass(frozen=True, slots=True)
class BenchScene:
    """A scene in memory, its test photos, and its units."""

    loaded: LoadedScene
    photos: tuple[BenchPhoto, ...]
    training: tuple[Camera, ...]
    """Without those of the test photos."""
    units: Units
    layout: str

    @property
    def background_rgb(self) -> tuple[float, float, float]:
        """Colour of rays that meet no Gaussian; 0..1."""
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
    modify_scene: Sequence[str] = (),
    occluders: Path | None = None,
    options: Any = None,
    budget: Budget | None = None,
    accuracy: Accuracy = DEFAULT_ACCURACY,
    progress: Callable[[int, int], None] | None = None,
    cache_dir: Path | None = None,
    on_miss: Callable[[BenchScene, Trial, PoseEstimate], dict[str, Any]] | None = None,
    photos: bool = False,
) -> dict[str, Any]:
    """Return the object that `--json` writes. Raises SceneError, UnknownName, InvalidOptions.

    `folder` has the scene; `data` the photos, if they are in another folder. `occluders` is a folder with photos of
    another scene; `modify_scene` changes the scene's Gaussians. `options` are the estimator's `Options`; None: its
    defaults. With `cameras="ignored"` the scene is used without its training cameras, which still define the units.
    `on_miss` is called for each photo that isn't a success at 1 deg and 0.01 units; what it returns is added to the
    photo's line. `accuracy` is asked for with each photo; its bound of the position is one at the true pose. With
    `photos` a digest of the training photos is made, anew: that beside the scene may hold the test photos.
    """
    require_kind(start)
    require_modifications(modify)
    require_scene_modifications(modify_scene)
    chosen_options, budget = options or ESTIMATORS.load(estimator).Options(), budget or Budget()
    bench_scene = load_bench_scene(
        Path(folder), data, layout=layout, background=background, cameras=cameras, matcher=matcher, cache_dir=cache_dir
    )
    bench_scene = with_modified_scene(bench_scene, modify_scene, seed, matcher, cache_dir)
    digest = digested(bench_scene, data or folder) if photos else {}
    prepare_s = _prepared(bench_scene.loaded, estimator)
    todo = list(make_trials(bench_scene, start, trials * len(bench_scene.photos), seed, tuple(modify), occluders))
    limits = {"budget_s": budget.seconds, "budget_renders": budget.renders}
    info = bench_scene.loaded.scene.info
    accuracy = accuracy.in_units(info.name, info.metres_per_unit)
    request = Request(estimator=estimator, options=chosen_options, seed=seed, accuracy=accuracy, **limits)

    def asked_at(trial: Trial) -> tuple[float, float]:
        return asked_bounds(accuracy, trial.truth, bench_scene.loaded.rasterizer, bench_scene.units)

    def localize_one(trial: Trial) -> PoseEstimate:
        return localize_trial(bench_scene, trial, request, intrinsics)

    def describe_miss(trial: Trial, estimate: PoseEstimate) -> dict[str, Any]:
        return on_miss(bench_scene, trial, estimate) if on_miss else {}

    outcomes, per_query = measure(todo, localize_one, bench_scene.units, progress, describe_miss, asked_at)
    settings = {"estimator": estimator, "matcher": matcher, "start": start, "trials": trials, "seed": seed}
    settings |= {"layout": bench_scene.layout, "background_rgb": list(bench_scene.background_rgb)}
    settings |= {"intrinsics": intrinsics, "cameras": cameras, "modify": list(modify)}
    settings |= {"modify_scene": list(modify_scene)}
    settings |= {"options": dataclasses.asdict(chosen_options), "budget": dataclasses.asdict(budget)}
    settings |= {"accuracy": dataclasses.asdict(accuracy)}
    facts = {"scene": info.name, **settings, **_facts(bench_scene), **digest, "prepare_s": prepare_s}
    return {**facts, **summary(outcomes), "per_query": per_query}


def _prepared(loaded: LoadedScene, estimator: str) -> float:
    """Prepare the scene for the estimator; return the seconds, which are no photo's."""
    began = time.perf_counter()
    loaded.prepare(estimator)
    return time.perf_counter() - began


def digested(bench_scene: BenchScene, data: Path) -> dict[str, float]:
    """Give the scene a digest of its training photos, which lie in the data set's folder; return what it takes.

    The scene has no cameras of test photos, so these are not among them. Raises SceneNotFound.
    """
    loaded = bench_scene.loaded
    loaded.digest_photos(data)  # not counted: its time includes compilation
    began = time.process_time()
    digest = loaded.photo_digest = loaded.digest_photos(data)
    cpu_ms, photos = 1e3 * (time.process_time() - began), len(digest.names)
    return {
        "digest_photos": photos,
        "digest_points": len(digest.points.photo),
        "digest_cpu_ms_a_photo": cpu_ms / photos,
        "digest_bytes_a_photo": digest.nbytes / photos,
    }


def asked_bounds(accuracy: Accuracy, truth: Camera, rasterizer: Rasterizer, units: Units) -> tuple[float, float]:
    """Return the accuracy asked for at the true pose, as bounds: degrees and normalized units."""
    camera = Camera(sized(truth.intrinsics, RENDER_PX), truth.pose)
    distance = typical_depth(rasterizer.render([camera])[0])
    return accuracy.deg, accuracy.bound_units(distance) * units.units_per_scene_unit


def _facts(bench_scene: BenchScene) -> dict[str, Any]:
    return {
        "photos": len(bench_scene.photos),
        "training_cameras": len(bench_scene.training),
        "gaussians": bench_scene.loaded.scene.count,
        "forward_facing": bench_scene.units.forward_facing,
        "units_per_scene_unit": bench_scene.units.units_per_scene_unit,
    }


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits at which an estimator is stopped; its best pose so far is then the estimate."""

    seconds: float | None = None
    renders: int | None = None


def measure(
    todo: Sequence[Trial],
    localize_one: Callable[[Trial], PoseEstimate],
    units: Units,
    progress: Callable[[int, int], None] | None = None,
    on_miss: Callable[[Trial, PoseEstimate], dict[str, Any]] | None = None,
    asked_at: Callable[[Trial], tuple[float, float]] = lambda _: COARSE,
) -> tuple[list[Outcome], list[dict[str, Any]]]:
    """Localize every trial; return errors and times, and the lines of the result file.

    The first trial is localized twice, of which the first time, with compilation and allocation, isn't counted.
    `asked_at` returns the bounds asked for at a trial's true pose: degrees and normalized units.
    """
    outcomes, lines = [], []
    # Not kept: its time would include compilation.
    localize_one(todo[0])
    for done, trial in enumerate(todo, 1):
        wall, cpu = time.perf_counter(), time.process_time()
        estimate = localize_one(trial)
        latency_ms, cpu_ms = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
        found = errors(estimate.pose, trial.truth.pose, units)
        outcome = Outcome(estimate.verdict.status, *found, latency_ms, cpu_ms, asked_at(trial))
        outcomes.append(outcome)
        lines.append(trial_result(trial, estimate, outcome, units))
        # After the times were taken.
        if on_miss and not outcome.success(FINE):
            lines[-1] |= on_miss(trial, estimate)
        if progress:
            progress(done, len(todo))
    return outcomes, lines


def load_bench_scene(
    folder: Path,
    data: Path | None = None,
    *,
    layout: str = "auto",
    background: str = "scene",
    cameras: str = "given",
    matcher: str = DEFAULT_MATCHER,
    cache_dir: Path | None = None,
) -> BenchScene:
    """Return a data set's test photos, and its scene without their cameras. Raises SceneError, UnknownName."""
    # The layout says which photos are for testing.
    data_set = read_data_set(data or folder, layout, folder)
    scene = _load_scene(folder, data_set, background)
    # A scene without training cameras takes its units from the test photos.
    training = [named.camera for named in scene.cameras] or [photo.camera for photo in data_set.test]
    if cameras == "ignored":
        scene = _load_scene(folder, data_set, background, cameras=False)
    loaded = LoadedScene.of(scene, cache_dir=cache_dir, matcher=matcher)
    units = units_of(training, lambda camera: centre_depth(loaded.rasterizer, camera))
    return BenchScene(loaded, data_set.test, tuple(training), units, data_set.layout)


def with_modified_scene(
    one: BenchScene,
    specs: Sequence[str],
    seed: int,
    matcher: str = DEFAULT_MATCHER,
    cache_dir: Path | None = None,
) -> BenchScene:
    """Return the scene after modifications of its Gaussians; photos, cameras and units remain."""
    if not specs:
        return one
    scene = modified_scene(one.loaded.scene, specs, one.units, seed)
    return replace(one, loaded=LoadedScene.of(scene, cache_dir=cache_dir, matcher=matcher))


def _load_scene(folder: Path, data_set: DataSet, background: str, cameras: bool = True) -> GaussianScene:
    scene = load_scene(folder, without_photos=data_set.test_names, cameras=cameras, training=data_set.training)
    rgb = BACKGROUNDS.get(background)
    # The manifest of the scene knows better than the layout of the data set.
    if rgb is None and not (folder.is_dir() and read_manifest(folder).background):
        rgb = data_set.background_rgb
    if rgb is None:
        return scene
    return replace(scene, info=replace(scene.info, background_rgb=rgb, background_is_known=True))


def make_trials(
    bench_scene: BenchScene,
    start: str,
    count: int,
    seed: int,
    modifications: tuple[str, ...] = (),
    occluders: Path | None = None,
) -> Iterator[Trial]:
    """Yield `count` trials, distributed evenly over the photos, photo by photo, each with a start pose of its own.

    A trial depends only on the seed, the photo and its number, not on `count`.
    """
    others = read_occluders(occluders) if occluders else ()
    for index, photo in enumerate(bench_scene.photos):
        numbers = range(len(range(index, count, len(bench_scene.photos))))
        # With fewer trials than photos the last photos have none.
        if not numbers:
            continue
        sent = prepare_photo(photo, modifications, bench_scene.background_rgb, seed, others)
        for number in numbers:
            # One generator a trial: none depends on how many there are.
            rng = np.random.default_rng([seed, index, number])
            begin = start_pose(start, sent.truth.pose, bench_scene.units, bench_scene.training, rng)
            yield Trial(photo.name, number, sent.data, sent.intrinsics, sent.truth, begin)


def read_occluders(folder: Path) -> list[Float32[np.ndarray, "_ _ 3"]]:
    """Return at most MAX_OCCLUDERS photos of a folder; 0..1. Raises SceneNotFound."""
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in PHOTO_SUFFIXES) if folder.is_dir() else []
    if not files:
        raise SceneNotFound("there are no photos to cut occluders from.", where=str(folder))
    # Spread over the folder: neighbouring photos show the same.
    step = -(-len(files) // MAX_OCCLUDERS)
    return [read_query(file.read_bytes()).rgb.astype(np.float32) / 255 for file in files[::step]]


def localize_trial(bench_scene: BenchScene, trial: Trial, request: Request, intrinsics: str = "given") -> PoseEstimate:
    """Localize one trial as the service does; `intrinsics`: given, approximate or withheld."""
    sent = None if intrinsics == "withheld" else trial.intrinsics
    if sent and intrinsics == "approximate":
        sent = replace(sent, trust="approximate")
    background = bench_scene.background_rgb
    query = read_query(trial.data, intrinsics=sent, prior=trial.start, background_rgb=background)
    return localize(query, bench_scene.loaded, request)


def trial_result(trial: Trial, estimate: PoseEstimate, outcome: Outcome, units: Units) -> dict[str, Any]:
    """Return one trial's line of the result file."""
    verdict = estimate.verdict
    start_errors = errors(trial.start, trial.truth.pose, units) if trial.start else (None, None)
    return {
        "photo": trial.photo,
        "trial": trial.number,
        "status": str(verdict.status),
        "reason": str(verdict.reason),
        "score": verdict.score,
        "right_place": verdict.right_place,
        "precise": verdict.precise,
        "inliers": verdict.inliers,
        "success_5deg_0p05": outcome.success(COARSE),
        "success_1deg_0p01": outcome.success(FINE),
        "success_asked": outcome.success(outcome.asked),
        "asked_units": outcome.asked[1],
        "rotation_deg": outcome.rotation_deg,
        "translation_units": outcome.translation_units,
        "start_world_from_camera": trial.start.world_from_camera.tolist() if trial.start else None,
        "start_rotation_deg": start_errors[0],
        "start_translation_units": start_errors[1],
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
