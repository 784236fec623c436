"""The engine of a service that is one process: scenes of this process, jobs on the threads that call `localize`."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from service.device_memory import DEVICE_MEMORY
from service.errors import SceneNotReady, SplatfixError
from service.estimators import ESTIMATORS
from service.jobs.engine import (
    EngineAnswer,
    HeldScenes,
    LocalizeTask,
    NextFrame,
    OnAnswer,
    OnRecord,
    RigSource,
    SequenceSource,
)
from service.jobs.model import JobRecord, JobResult, SequenceFrame
from service.jobs.trajectory import Trajectory
from service.live.live_tracker import LiveTracker
from service.live.live_values import LiveTask
from service.loaded_scene import DEFAULT_ESTIMATOR, DEFAULT_MATCHER, LoadedScene
from service.localize import Request, localize
from service.multi_scene import SceneEstimate, localize_in_scenes
from service.photos.sequence import read_sequence
from service.registration.registration import Registration
from service.results import PoseEstimate
from service.rig import localize_rig
from service.scene_manager import scene_images
from service.scene_manager.entry import Entry
from service.scene_manager.manager import Acquired, Scenes
from service.scene_manager.scene_coverage import SceneCoverages
from service.scene_manager.scene_registrations import SceneRegistrations, registered_info
from service.scene_manager.splat_sample import packed_splats
from service.scene_manager.status import (
    CoverageStatus,
    PictureSpec,
    SceneContents,
    SceneReadiness,
    SceneStatus,
    StoredScene,
)
from service.tracking import localize_sequence
from service.types import Query, SceneInfo
from service.versions import versions


@dataclass(frozen=True, slots=True)
class EngineConfig:
    """What scenes are prepared for, and what they may take."""

    estimator: str = DEFAULT_ESTIMATOR
    matcher: str = DEFAULT_MATCHER
    rasterizer: str | None = None
    """None: the first that can run here."""
    cache_dir: Path | None = None
    """Where view indexes and scenes in mappable form are kept between runs; None: nowhere."""
    cache_bytes: int | None = None
    """Size limit of that folder; None: none."""
    memory_bytes: int | None = None
    """Of all scenes together; None: any number."""
    gpu_memory_bytes: int | None = None
    """Of all calls of the GPU at once, beside the scenes; None: four fifths of what is free."""
    data_folder: Path | None = None
    """Where registrations are that can't be beside their scenes."""


@dataclass(frozen=True, slots=True)
class _Held:
    """Scenes that stay in memory, and the registrations in force when they were asked for."""

    acquired: Acquired
    registrations: tuple[Registration | None, ...]


class EmbeddedEngine:
    """Implements `Engine`."""

    def __init__(self, config: EngineConfig) -> None:
        DEVICE_MEMORY.set_budget(config.gpu_memory_bytes)
        self._manager = Scenes(
            config.estimator,
            config.cache_dir,
            matcher=config.matcher,
            rasterizer=config.rasterizer,
            memory_bytes=config.memory_bytes,
            cache_bytes=config.cache_bytes,
        )
        self._registrations = SceneRegistrations(config.data_folder)
        self._coverages = SceneCoverages(self._manager)
        self._held: dict[str, _Held] = {}
        self._cancels: dict[str, threading.Event] = {}
        """By the id of the attempt that runs."""

    def start(self) -> None:
        self._manager.start()

    def close(self) -> None:
        self._coverages.close()
        self._manager.close()

    # ------------------------------------------------------------------ scenes

    def add(self, scene: StoredScene, *, required: bool = False) -> None:
        self._manager.add(Entry(scene.id, scene.path, required=required, remote=scene.remote, uploaded=scene.uploaded))

    def add_loaded(self, scene_id: str, loaded: LoadedScene) -> None:
        """Add a scene that is in memory already and has no file; it is required."""
        self._manager.add(Entry(scene_id, None, loaded=loaded, required=True))

    def remove(self, scene_id: str) -> None:
        self._manager.remove(scene_id)

    def scenes(self) -> list[SceneStatus]:
        return [self._status(entry) for entry in self._manager.entries()]

    def scene(self, scene_id: str | None) -> SceneStatus:
        return self._status(self._manager.entry(scene_id))

    def contents(self, scene_id: str) -> SceneContents | None:
        return self._manager.contents(scene_id)

    def require(self, scene_id: str) -> SceneInfo:
        info = self._manager.get(scene_id).scene.info
        return registered_info(info, self._registration(self._manager.entry(scene_id), info))

    def readiness(self) -> SceneReadiness:
        return self._manager.readiness()

    def load(self, scene_id: str) -> SceneStatus:
        entry = self._manager.entry(scene_id)
        self._manager.load(entry)
        return self._status(entry)

    def unload(self, scene_id: str) -> SceneStatus:
        entry = self._manager.entry(scene_id)
        self._manager.unload(entry)
        return self._status(entry)

    def hold(self, asked: str | Sequence[str] | None) -> HeldScenes:
        return self._held_scenes(self._manager.acquire(asked))

    def hold_later(
        self, asked: str | Sequence[str] | None, take: Callable[[HeldScenes | SplatfixError], object]
    ) -> None:
        def held(found: Acquired | SplatfixError) -> None:
            try:
                answer = found if isinstance(found, SplatfixError) else self._held_scenes(found)
            except SplatfixError as error:
                answer = error
            take(answer)

        self._manager.acquire_later(asked, held)

    def _held_scenes(self, acquired: Acquired) -> HeldScenes:
        # A token instead of the scenes, so that an engine in another process can have the same interface.
        token, scenes = secrets.token_hex(8), acquired.scenes
        try:
            entries = [self._manager.entry(scene_id) for scene_id in acquired.ids]
            pairs = zip(entries, scenes, strict=True)
            registrations = tuple(self._registration(entry, loaded.scene.info) for entry, loaded in pairs)
        except BaseException:
            self._manager.release(scenes)
            raise
        self._held[token] = _Held(acquired, registrations)
        return HeldScenes(token, acquired.ids, scenes[0].scene.info.background_rgb, acquired.left_out)

    def release(self, token: str) -> None:
        held = self._held.pop(token, None)
        self._manager.release(held.acquired.scenes if held else ())

    # ------------------------------------------------------------------ work

    def localize(self, task: LocalizeTask, on_record: OnRecord) -> EngineAnswer:
        held = self._held.get(task.held)
        if held is None:
            raise SceneNotReady("the job's scenes were unloaded.", where="scene")
        cancel = self._cancels[task.id] = threading.Event()
        try:
            result, loaded = run_task(task, held.acquired.scenes, on_record, cancel, held.registrations)
        finally:
            # Also after an error: a later attempt has another id, so the entry would stay for ever.
            del self._cancels[task.id]
        return EngineAnswer(with_left_out(result, held.acquired.left_out), self._manager.id_of(loaded))

    def _status(self, entry: Entry) -> SceneStatus:
        status = entry.status()
        if status.info is None:
            return status
        return replace(status, info=registered_info(status.info, self._registration(entry, status.info)))

    def _registration(self, entry: Entry, info: SceneInfo) -> Registration | None:
        return self._registrations.of(entry.path, info, entry.remote)

    def cancel(self, task_id: str) -> None:
        if cancel := self._cancels.get(task_id):
            cancel.set()

    def live(self, task: LiveTask, next_frame: NextFrame, on_answer: OnAnswer) -> None:
        held = self._held.get(task.held)
        if held is None:
            raise SceneNotReady("the session's scene was unloaded.", where="scene")
        # Closed also after an error: a search in the background uses the scene.
        with closing(LiveTracker(task, held.acquired.scenes[0])) as tracker:
            while (frame := next_frame()) is not None:
                on_answer(tracker.use(frame))

    def render(self, scene_id: str, picture: PictureSpec) -> bytes:
        return scene_images.picture(self._manager.get(scene_id), picture)

    def thumbnail(self, scene_id: str) -> bytes:
        return scene_images.thumbnail(self._manager.get(scene_id))

    def splats(self, scene_id: str, limit: int) -> bytes:
        return packed_splats(self._manager.get(scene_id).scene, limit)

    def coverage(self, scene_id: str) -> CoverageStatus:
        return self._coverages.of(scene_id)

    def measure_coverage(self, scene_id: str) -> CoverageStatus:
        return self._coverages.measure(scene_id)

    def cancel_coverage(self, scene_id: str) -> CoverageStatus:
        return self._coverages.cancel(scene_id)


def run_task(
    task: LocalizeTask,
    scenes: Sequence[LoadedScene],
    on_record: OnRecord | None = None,
    cancel: threading.Event | None = None,
    registrations: Sequence[Registration | None] = (),
) -> tuple[JobResult, LoadedScene]:
    """Localize on this thread, in one scene or in the one of several that the photo shows; return that scene, too.

    A sequence, or a rig, is localized in the first scene. `registrations` are the scenes': they place the result's
    pose, and what the device measured.
    """
    options = ESTIMATORS.load(task.estimator).Options(**task.options)
    known = {one.scene_sha256: one for one in registrations if one is not None}
    request = Request(
        *(task.estimator, options),
        seed=task.seed,
        budget_s=task.budget_s,
        cancel=cancel,
        accuracy=task.accuracy,
        registrations=known,
    )
    if isinstance(task.source, SequenceSource):
        sequence = _run_sequence(task.source, request, scenes[0], on_record)
        return _registered(sequence, scenes, scenes[0], registrations), scenes[0]
    if isinstance(task.source, RigSource):
        rig = _run_rig(task, task.source, request, scenes[0], on_record)
        return _registered(rig, scenes, scenes[0], registrations), scenes[0]
    step = (lambda record: on_record(JobRecord(record), None)) if on_record else None
    if len(scenes) > 1:
        found = localize_in_scenes(task.source, scenes, request, step)
    else:
        found = SceneEstimate(localize(task.source, scenes[0], request, step), scenes[0])
    anchor = found.loaded.scene.info.geo_anchor
    result = JobResult(with_last_record_only(found.estimate), task.decode, anchor, versions())
    return _registered(result, scenes, found.loaded, registrations), found.loaded


def _registered(
    result: JobResult, scenes: Sequence[LoadedScene], shown: LoadedScene, registrations: Sequence[Registration | None]
) -> JobResult:
    """Return the result with the registration of the scene that the photo shows, whose place on Earth counts."""
    # By identity: comparing scenes would compare their arrays.
    found = next((r for loaded, r in zip(scenes, registrations, strict=False) if loaded is shown), None)
    if found is None:
        return result
    return replace(result, registration=replace(found, residuals=()), geo_anchor=found.geo_anchor or result.geo_anchor)


def _run_sequence(
    source: SequenceSource, request: Request, loaded: LoadedScene, on_record: OnRecord | None
) -> JobResult:
    trajectory = Trajectory()
    photos = read_sequence(source.data, source.options)
    # Closed also after an error or a cancel: the video decoder is a process that would stay.
    with closing(photos), closing(localize_sequence(photos, loaded, request)) as poses:
        for found in poses:
            record = trajectory.add(found)
            shown: Query | None = found.photo.query if trajectory.shown is found.estimate else None
            if on_record:
                on_record(record, shown)
    result = trajectory.result(loaded.scene.info.geo_anchor)
    return replace(result, estimate=with_last_record_only(result.estimate))


def _run_rig(
    task: LocalizeTask, source: RigSource, request: Request, loaded: LoadedScene, on_record: OnRecord | None
) -> JobResult:
    step = (lambda record: on_record(JobRecord(record), None)) if on_record else None
    found = localize_rig(source.photos, loaded, request, step, metric=source.metric)
    verdict = found.estimate.verdict
    # The photos were verified together: each has the verdict of all, and a covariance of its own.
    frames = tuple(
        SequenceFrame(
            index=index,
            name=photo.name,
            time_s=0.0,
            status=verdict.status,
            reason=verdict.reason,
            score=verdict.score,
            tracked=False,
            pose=pose,
            covariance=own.covariance,
            right_place=verdict.right_place,
            precise=verdict.precise,
        )
        for index, (photo, (pose, own)) in enumerate(zip(source.photos, found.photos, strict=True))
    )
    estimate = with_last_record_only(found.estimate)
    return JobResult(estimate, task.decode, loaded.scene.info.geo_anchor, versions(), frames)


def with_left_out(result: JobResult, left_out: Sequence[str]) -> JobResult:
    """Return the result with a warning that names the scenes that were not searched, if there are any."""
    if not left_out:
        return result
    warning = f"not searched, for they are not in memory: {', '.join(left_out)}"
    estimate = result.estimate
    return replace(result, estimate=replace(estimate, warnings=(*estimate.warnings, warning)))


def with_last_record_only(estimate: PoseEstimate) -> PoseEstimate:
    """Return the estimate with its last record only, of which nothing but the answer is left."""
    return replace(estimate, records=(replace(estimate.records[-1], matches=None, candidates=None),))
