"""From a photo and a scene to a pose with its trace and verdict.

This is the composition root, where names of plug-ins become objects. Its driver runs every estimator: it holds the
clock, the budget and the cancel flag, stamps the records, and applies the same verification gate to every method. Jobs,
CLI, bench and tests call `localize`; nothing else iterates an estimator.

    from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
    from service.localize import localize
    from service.photos.images import read_query
    scene = LoadedScene.load(Path("scenes/studio"))
    estimate = localize(read_query(Path("photo.jpg").read_bytes()), scene)
    print(estimate.verdict.status, estimate.pose.world_from_camera)
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from service.accuracy import DEFAULT_ACCURACY, Accuracy
from service.errors import EstimatorFault, InvalidOptions
from service.estimators import ESTIMATORS
from service.interfaces import Answer, Rasterizer, RenderTally, Tools
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.photos.intrinsics import taken_through
from service.pose.absolute_pose.lens_prior import at_bounds
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import ViewRenderer
from service.pose.retrieval.index import ViewIndex
from service.pose.verification.advice import advice_for, content_extent
from service.pose.verification.captured_volume import is_outside
from service.pose.verification.gate import VERIFICATION, doubted, downgraded, verify
from service.pose.verification.search_summary import search_summary
from service.readings_in_scene import contradictions, fused, scene_priors
from service.registration.registration import Registration
from service.render.render_counter import Counted
from service.result_warnings import cautions, of_unfinished_index
from service.results import IterationRecord, PoseEstimate, Reason, StageTiming, Status, Verdict
from service.scene_formats.manifest import told_by_manifest
from service.scene_origin import estimate_in_world, query_in_scene, record_in_world
from service.types import Pose, Query


class Cancelled(Exception):
    """Raised by `localize` between two records after `Request.cancel` was set; the estimator is closed."""


@dataclass(frozen=True, slots=True)
class Request:
    """How to localize; the photo and the scene are passed beside it."""

    estimator: str = DEFAULT_ESTIMATOR
    options: Any = None
    """The estimator's `Options`; None: its defaults."""
    seed: int = 0
    budget_s: float | None = None
    """Wall time after which the best pose so far is the answer; None: until the estimator ends."""
    budget_renders: int | None = None
    """Renders after which it is; a step that was begun is finished. A measure that no other load disturbs."""
    cancel: threading.Event | None = None
    config: Any = None
    """The estimator's tuning, for benches; None: its default."""
    accuracy: Accuracy = DEFAULT_ACCURACY
    """How accurate a pose must be to be `localized`."""
    advice: bool = True
    """Whether to measure what would help a photo that isn't localized, in 0.1 to 0.2 CPU seconds."""
    registrations: Mapping[str, Registration] = field(default_factory=dict)
    """Those in force, by the sha256 of their scenes: what readings of a device are placed by."""


def localize(
    query: Query,
    loaded: LoadedScene,
    request: Request | None = None,
    on_record: Callable[[IterationRecord], None] | None = None,
) -> PoseEstimate:
    """Run one estimator on one photo and verify its answer.

    Poses are in the world, those of the query and of what is returned and reported. Raises Cancelled, UnknownName,
    BackendMissing; InvalidAccuracy for metres in a scene without a scale.
    """
    origin = loaded.scene.info.origin_in_world
    # Most scenes have none: their records needn't be copied.
    if not any(origin):
        return localize_in_scene(query, loaded, request, on_record)

    def report(record: IterationRecord) -> None:
        if on_record:
            on_record(record_in_world(record, origin))

    return estimate_in_world(localize_in_scene(query_in_scene(query, origin), loaded, request, report), origin)


def localize_in_scene(
    query: Query,
    loaded: LoadedScene,
    request: Request | None = None,
    on_record: Callable[[IterationRecord], None] | None = None,
) -> PoseEstimate:
    """Localize as `localize` does, with all positions relative to the scene's origin (`service/scene_origin.py`)."""
    request = request or Request()
    query = asked_of(query, loaded, request)
    loaded = loaded.as_seen_by(query)
    plugin = ESTIMATORS.load(request.estimator)
    _require_matching(request.estimator, loaded)
    options = request.options if request.options is not None else plugin.Options()
    tally = RenderTally()
    tools = _tools(query, loaded, request, tally)
    tuning = {} if request.config is None else {"config": request.config}
    clock = Clock()
    trace = _Trace(clock, on_record)
    # Closed also after a cancel, so that the estimator's `finally` runs on this thread.
    with closing(plugin.run(query, tools, options, **tuning)) as steps:
        answer = _drive(steps, trace, request, tally)
    if not trace.records:
        raise EstimatorFault(f"'{request.estimator}' ended without a record.")
    # Before verification: its renders are not the estimator's.
    renders, last = tally.count, trace.records[-1]
    images = _as_estimated(query, loaded, last)
    query = images.query
    verdict = answer.verdict if answer else render_and_verify(images, last.pose, tools.rasterizer)
    verdict = _qualified(verdict, last, trace.exhausted)
    verdict = _if_captured(verdict, query, last.pose, tools)
    query, verdict = _with_readings(query, verdict, last, trace, loaded, request)
    last = trace.records[-1]
    advice = _advice(images, loaded, verdict, last, tools.rasterizer) if request.advice else ()
    timings = _timings(trace.records, clock)
    found = estimate_of(
        query, loaded, request, verdict, trace.records, timings=timings, renders=renders, exhausted=trace.exhausted
    )
    return replace(found, advice=advice, warnings=found.warnings + of_unfinished_index(tools.prepared, trace.records))


def _tools(query: Query, loaded: LoadedScene, request: Request, tally: RenderTally) -> Tools[Any]:
    """Return what the estimator works with; its renders are counted in `tally`."""
    return Tools(
        loaded.searched,
        Counted(rasterizer_for(query, loaded), tally),
        loaded.matcher,
        # Of this job alone: jobs that run beside it must not change its numbers.
        np.random.default_rng(request.seed),
        loaded.usable(request.estimator),
        image_matcher=loaded.image_matcher,
        tally=tally,
        surface_points=loaded.photo_digest and loaded.photo_digest.points,
    )


def _as_estimated(query: Query, loaded: LoadedScene, last: IterationRecord) -> QueryImages:
    """Return the photo with the intrinsics that were estimated with the pose."""
    # They belong to the pose, in the result and in its verification.
    if last.lens:
        return QueryImages(taken_through(query, last.lens), loaded.matcher)
    return QueryImages(query, loaded.matcher).corrected(last.correction)


def _with_readings(
    query: Query, verdict: Verdict, last: IterationRecord, trace: _Trace, loaded: LoadedScene, request: Request
) -> tuple[Query, Verdict]:
    """Add a record of the pose by photo and device together, if the device's readings move it; return the query with
    warnings of readings that contradict the photo, and the verdict with the covariance of both."""
    if query.scene_priors is None:
        return query, verdict
    info = loaded.scene.info
    against = contradictions(query, last.pose, verdict, info, request.registrations.get(info.sha256))
    pose, verdict = fused(query, last.pose, verdict)
    if pose is not last.pose:
        trace.add(replace(last, stage="fuse_readings", pose=pose, matches=None, candidates=None))
    return replace(query, warnings=query.warnings + against), verdict


def _if_captured(verdict: Verdict, query: Query, pose: Pose, tools: Tools[Any]) -> Verdict:
    """Return a verdict for a pose outside of what the index's views saw as `uncertain` for that reason; others as
    they are, also where another reason than that the evidence is poor decided."""
    by_evidence = verdict.status is Status.LOCALIZED or verdict.reason in _REASONS_OF_EVIDENCE
    views = tools.prepared.latest().views if isinstance(tools.prepared, ViewIndex) else ()
    if verdict.status is Status.NOT_LOCALIZED or not by_evidence:
        return verdict
    if not is_outside(query.intrinsics, pose, tools.rasterizer, views):
        return verdict
    return doubted(verdict, Reason.OUTSIDE_CAPTURED_VOLUME)


_REASONS_OF_EVIDENCE = (Reason.FEW_INLIERS, Reason.RENDER_MISMATCH, Reason.LOW_COVERAGE, Reason.POSITION_UNCERTAIN)


def _advice(
    images: QueryImages, loaded: LoadedScene, verdict: Verdict, last: IterationRecord, rasterizer: Rasterizer
) -> tuple[str, ...]:
    """Return what would help a photo that isn't localized; for one that is, nothing is measured."""
    if verdict.status is Status.LOCALIZED:
        return ()
    others = () if last.alternatives is None else tuple(map(Pose, last.alternatives.world_from_camera))
    extent = content_extent(loaded.scene.means)
    return advice_for(images, last.pose, rasterizer, verdict, others, extent)


def asked_of(query: Query, loaded: LoadedScene, request: Request) -> Query:
    """Return the query, relative to the scene's origin, with the accuracy that the request asks for, and with the
    device's readings as priors in the scene. Raises InvalidAccuracy."""
    info = loaded.scene.info
    priors = query.readings and scene_priors(query.readings, info, request.registrations.get(info.sha256))
    accuracy = request.accuracy.in_units(info.name, info.metres_per_unit)
    return replace(query, accuracy=accuracy, scene_priors=priors)


@dataclass(slots=True)
class _Trace:
    """The records of a job so far."""

    clock: Clock
    on_record: Callable[[IterationRecord], None] | None
    records: list[IterationRecord] = field(default_factory=list)
    exhausted: bool = False
    """The budget ended before the estimator."""

    def add(self, record: IterationRecord) -> None:
        """Number, stamp, keep and report a record."""
        index, wall_s, cpu_s = len(self.records), self.clock.wall_s, self.clock.cpu_s
        self.records.append(replace(record, index=index, elapsed_s=wall_s, cpu_s=cpu_s))
        if self.on_record:
            self.on_record(self.records[-1])


def _drive(
    steps: Generator[IterationRecord, None, Answer | None], trace: _Trace, request: Request, tally: RenderTally
) -> Answer | None:
    """Run an estimator until it ends, or its budget does; return its answer in the first case.

    Raises Cancelled between two records after the request's cancel flag was set.
    """
    while True:
        try:
            record = next(steps)
        except StopIteration as end:
            return end.value
        # Between two records: the estimator isn't interrupted in the middle of a step.
        if request.cancel is not None and request.cancel.is_set():
            raise Cancelled
        trace.add(record)
        trace.exhausted = _exhausted(request, trace.clock, tally)
        if trace.exhausted:
            return None


def render_and_verify(images: QueryImages, pose: Pose, rasterizer: Rasterizer) -> Verdict:
    """Return the gate's verdict on a pose, from a render made for that."""
    return verify(images, pose, ViewRenderer(rasterizer).at(images.query, pose))


def estimate_of(
    query: Query,
    loaded: LoadedScene,
    request: Request,
    verdict: Verdict,
    records: Sequence[IterationRecord],
    *,
    timings: Sequence[StageTiming],
    renders: int,
    exhausted: bool = False,
) -> PoseEstimate:
    """Return the estimate; the last record's pose is the answer, the query has the intrinsics that belong to it."""
    info = loaded.scene.info
    return PoseEstimate(
        pose=records[-1].pose,
        verdict=verdict,
        intrinsics=query.photo_intrinsics,
        intrinsics_source=query.intrinsics_source,
        scene_id=info.id,
        scene_sha256=info.sha256,
        estimator=request.estimator,
        rasterizer=loaded.rasterizer.name,
        matcher=(loaded.image_matcher or loaded.matcher).name,
        seed=request.seed,
        budget_exhausted=exhausted,
        renders=renders,
        timings=tuple(timings),
        warnings=query.warnings
        + (query.scene_priors.warnings if query.scene_priors else ())
        + info.warnings
        + loaded.warnings
        + _assumptions(query, loaded)
        + cautions(query, verdict),
        records=tuple(records),
        frames=info.frames,
        search_summary=search_summary(records, verdict),
    )


def _require_matching(estimator: str, loaded: LoadedScene) -> None:
    """Raise InvalidOptions where the method can't use the image matcher that was requested."""
    if loaded.image_matcher and not getattr(ESTIMATORS.load(estimator), "MATCHES_IMAGES", False):
        raise InvalidOptions(
            f"'{loaded.image_matcher.name}' has no features of one image, which '{estimator}' needs.",
            where="matcher",
            hint="Take mc_do or icomma, or another matcher.",
        )


ASSUMED_TRAINING_PX = (800, 1600)
"""Bounds of the training photos' long side, where it is taken from the photo to localize."""


def rasterizer_for(query: Query, loaded: LoadedScene) -> Rasterizer:
    """Return the scene's rasterizer; where the size of training is unknown, as if it was the photo's."""
    assumed = _assumed_training_px(query, loaded)
    return loaded.rasterizer if assumed is None else loaded.rasterizer.trained_at(assumed)


def _assumed_training_px(query: Query, loaded: LoadedScene) -> int | None:
    """Return the long side that training photos are taken to have; None: it is known."""
    info = loaded.scene.info
    if info.training_focal_px or info.training_long_side_px:
        return None
    # Photos are often trained on at a smaller size than they are sent in.
    low, high = ASSUMED_TRAINING_PX
    return min(max(query.photo_intrinsics.long_side, low), high)


def _assumptions(query: Query, loaded: LoadedScene) -> tuple[str, ...]:
    assumed = _assumed_training_px(query, loaded)
    if assumed is None:
        return ()
    return (
        f"the size of the photos that the scene was trained with is unknown: {assumed} px is assumed, which can shift "
        "the pose a little; " + told_by_manifest('"training_size": [width, height]') + ".",
    )


def _exhausted(request: Request, clock: Clock, tally: RenderTally) -> bool:
    late = request.budget_s is not None and clock.wall_s > request.budget_s
    return late or (request.budget_renders is not None and tally.count >= request.budget_renders)


def _qualified(verdict: Verdict, last: IterationRecord, exhausted: bool) -> Verdict:
    """Return the verdict lowered by what a render doesn't show: a mirrored photo, a lens beyond what is estimated,
    other answers, too small a budget."""
    # First: a mirrored photo fits no pose, whatever else is wrong with it.
    if last.mirrored:
        return replace(downgraded(verdict, Reason.MIRRORED), reason=Reason.MIRRORED)
    if at_bounds(last.correction):
        return downgraded(verdict, Reason.FOCAL_UNCERTAIN)
    # What other poses have of the probability, this one hasn't, however well it fits.
    share = 1.0 if last.alternatives is None else 1.0 - float(last.alternatives.scores.sum())
    if share < VERIFICATION.min_localized:
        return downgraded(verdict, Reason.AMBIGUOUS, share * verdict.place_probability)
    # A pose that was found and verified in time counts, however the search would have gone on.
    if exhausted and verdict.status is not Status.LOCALIZED:
        return replace(verdict, reason=Reason.BUDGET_EXHAUSTED)
    return verdict


class Clock:
    """Wall time, and CPU time of the calling thread: a job runs on one thread."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.thread_time()

    @property
    def wall_s(self) -> float:
        """Seconds since it was made."""
        return time.perf_counter() - self._wall

    @property
    def cpu_s(self) -> float:
        """Seconds of CPU time of this thread since it was made."""
        return time.thread_time() - self._cpu


def _timings(records: list[IterationRecord], clock: Clock) -> tuple[StageTiming, ...]:
    """Time by stage: a record's stage is charged with the time since the record before; the rest is verification's."""
    spent: dict[str, list[float]] = {}
    wall = cpu = 0.0
    for record in records:
        entry = spent.setdefault(record.stage, [0.0, 0.0])
        entry[0] += record.elapsed_s - wall
        entry[1] += record.cpu_s - cpu
        wall, cpu = record.elapsed_s, record.cpu_s
    entry = spent.setdefault("verify", [0.0, 0.0])
    entry[0] += clock.wall_s - wall
    entry[1] += clock.cpu_s - cpu
    return tuple(StageTiming(stage, *times) for stage, times in spent.items())
