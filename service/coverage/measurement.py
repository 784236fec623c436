"""Measures a coverage map: localizes degraded renders spread over the scene, and held-out real photos, on all cores."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from service.coverage.calibration import Calibration, calibrated
from service.coverage.coverage_map import CoverageMap, Trial
from service.coverage.degraded_renders import DEGRADATION, DegradationConfig, degraded_render
from service.coverage.held_out_photos import HeldOutPhoto
from service.coverage.plan import PLAN, Places, PlanConfig, find_places, novelty, spread
from service.geometry import pose_distance
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.localize import Cancelled, Request, localize_in_scene
from service.photos.images import read_query
from service.pose.features.image_sizes import RENDER_PX, sized
from service.pose.features.rendered_views import View
from service.pose.verification.signals import typical_depth
from service.results import Status
from service.scene_origin import shifted
from service.types import Camera, Query


@dataclass(frozen=True, slots=True)
class CoverageConfig:
    """How many photos a map is measured with, and how each is made and searched for."""

    trials: int = 96
    """Degraded renders. 160 move the map of a bare room by 5 % on average (docs/results/coverage.md), in 1.7 times the
    time."""
    budget_renders: int = 60
    """Of each photo: what takes longer is not found in a second or two, and a user has taken the next photo."""
    plan: PlanConfig = PLAN
    degradation: DegradationConfig = DEGRADATION


COVERAGE = CoverageConfig()


@dataclass(frozen=True, slots=True)
class Measurement:
    """What a measurement needs beside the scene."""

    held_out: Sequence[HeldOutPhoto] = ()
    progress: Callable[[int, int], None] | None = None
    """Called with the photos that are done, and all: with 0 before the first, then from several threads."""
    partial: Callable[[CoverageMap], None] | None = None
    """Called, before `progress`, with the map's plan and the photos tried so far; from several threads."""
    cancel: threading.Event = field(default_factory=threading.Event)
    config: CoverageConfig = COVERAGE


def measured_coverage(loaded: LoadedScene, how: Measurement) -> CoverageMap:
    """Return the coverage map of a scene for the default estimator; deterministic but for its `seconds`.

    Raises Cancelled after `how.cancel` was set.
    """
    began, config = time.perf_counter(), how.config
    index = loaded.prepare(DEFAULT_ESTIMATOR)
    # Once for the scene; else the first photo that needs them would spend its budget on them.
    index.free_views.of(loaded.searched, loaded.rasterizer, loaded.matcher, index.views)
    captured = [named.camera for named in loaded.searched.cameras] or [view.camera for view in index.views]
    distance = _distance(index.views)
    # A fixed seed: a scene has the same places whenever its map is measured.
    places = find_places(loaded.searched, loaded.rasterizer, captured, distance, np.random.default_rng(0), config.plan)
    pairs = spread(places, config.trials)
    empty = _without_trials(loaded, places)
    runner = _Runner(loaded, how, captured, distance, empty, len(pairs) + len(how.held_out))
    if how.progress:
        how.progress(0, len(pairs) + len(how.held_out))
    # Threads suffice: most of the time is spent in kernels, which release the GIL.
    with ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="coverage") as pool:
        cameras = [places.cameras[cell][heading] for cell, heading in pairs]
        trials = tuple(pool.map(runner.try_render, cameras, range(len(cameras))))
        real = tuple(pool.map(runner.try_photo, how.held_out))
    found = replace(empty, trials=trials, real_trials=real)
    # The fit needs the probabilities of the map without a calibration, hence two steps.
    calibration = calibrated(found.rates_near(real), np.array([trial.found for trial in real], bool))
    return replace(found, calibration=calibration, seconds=time.perf_counter() - began)


def _without_trials(loaded: LoadedScene, places: Places) -> CoverageMap:
    """Return the map of a measurement that has tried nothing yet."""
    return CoverageMap(
        loaded.scene.info.sha256,
        places.plan_from_world,
        places.cell,
        places.positions + np.array(loaded.scene.info.origin_in_world),
        places.headings_rad,
        places.sees_scene,
        places.novelties,
        (),
        (),
        Calibration(),
        0.0,
    )


def _distance(views: Sequence[View]) -> float:
    """Return the typical distance from the index's views to what they see."""
    far = [view.distance for view in views if len(view.points_in_world)]
    return float(np.median(far)) if far else 1.0


class _Runner:
    """Localizes photos; safe from several threads."""

    def __init__(
        self,
        loaded: LoadedScene,
        how: Measurement,
        captured: Sequence[Camera],
        distance: float,
        empty: CoverageMap,
        total: int,
    ) -> None:
        self._captured, self._distance, self._empty = captured, distance, empty
        self._loaded, self._how, self._total = loaded, how, total
        self._tried_so_far: list[Trial] = []
        self._lock = threading.Lock()

    def try_render(self, camera: Camera, seed: int) -> Trial:
        # By the trial's number: which thread takes which trial depends on the machine's load.
        rng = np.random.default_rng([1, seed])
        return self._tried(degraded_render(camera, self._loaded.rasterizer, rng, self._how.config.degradation), camera)

    def try_photo(self, photo: HeldOutPhoto) -> Trial:
        # As users' photos come: exact intrinsics would promise more than those get.
        sent = replace(photo.camera.intrinsics, trust="approximate")
        query = read_query(
            photo.path.read_bytes(), intrinsics=sent, background_rgb=self._loaded.scene.info.background_rgb
        )
        # Inside of the scene, as the capture's cameras are.
        pose = shifted(photo.camera.pose, -np.array(self._loaded.scene.info.origin_in_world))
        return self._tried(query, Camera(photo.camera.intrinsics, pose), photo.name)

    def _tried(self, query: Query, truth: Camera, name: str = "") -> Trial:
        if self._how.cancel.is_set():
            raise Cancelled
        budget, cancel = self._how.config.budget_renders, self._how.cancel
        request = Request(budget_renders=budget, cancel=cancel, advice=False)
        estimate = localize_in_scene(query, self._loaded, request)
        degrees, units = pose_distance(estimate.pose, truth.pose)
        verdict = estimate.verdict
        (new,) = novelty([truth], self._captured, self._distance, self._how.config.plan)
        right = degrees <= request.accuracy.deg and units <= request.accuracy.bound_units(self._depth(truth))
        found = verdict.status is Status.LOCALIZED and right
        pose = shifted(truth.pose, self._loaded.scene.info.origin_in_world)
        trial = Trial(pose, verdict.status, found, degrees, units, float(new), name)
        self._tell(trial)
        return trial

    def _tell(self, trial: Trial) -> None:
        with self._lock:
            self._tried_so_far.append(trial)
            if self._how.partial:
                self._how.partial(replace(self._empty, trials=tuple(self._tried_so_far)))
            if self._how.progress:
                self._how.progress(len(self._tried_so_far), self._total)

    def _depth(self, truth: Camera) -> float:
        """Return the distance to what is seen at the true pose."""
        camera = Camera(sized(truth.intrinsics, RENDER_PX), truth.pose)
        return typical_depth(self._loaded.rasterizer.render([camera])[0])
