"""Read this first: from a photo and a scene to a pose with its trace and verdict.

This is the composition root, where names of plug-ins become objects. Its driver runs every estimator: it holds the
clock, the budget and the cancel flag, stamps the records, and applies the same verification gate to every method. Jobs,
CLI, bench and tests call `localize`; nothing else iterates an estimator.

    from service.localize import LoadedScene, localize
    from service.photos.images import read_query
    scene = LoadedScene.load(Path("scenes/studio"))
    estimate = localize(read_query(Path("photo.jpg").read_bytes()), scene)
    print(estimate.verdict.status, estimate.pose.world_from_camera)
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from service.accuracy import DEFAULT_ACCURACY, Accuracy
from service.errors import BackendMissing, EstimatorFault, InvalidOptions
from service.estimators import ESTIMATORS
from service.interfaces import Answer, ImageMatcher, Matcher, Rasterizer, RenderTally, Tools
from service.matchers import MATCHERS
from service.photos.intrinsics import taken_through
from service.pose.absolute_pose.lens_prior import at_bounds
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import ViewRenderer
from service.pose.features.untold_background import WHITE, has_white_border, shows_background
from service.pose.retrieval.floaters import without_floaters
from service.pose.retrieval.index import ViewIndex
from service.pose.verification.advice import advice_for, content_extent
from service.pose.verification.captured_volume import is_outside
from service.pose.verification.gate import VERIFICATION, doubted, downgraded, verify
from service.render import RASTERIZERS
from service.render.render_counter import Counted
from service.results import IterationRecord, PoseEstimate, Reason, StageTiming, Status, Verdict
from service.scene_formats import load_scene
from service.scene_formats.cache import mapped_scene, release
from service.scene_origin import estimate_in_world, query_in_scene, record_in_world
from service.types import GaussianScene, Pose, Query

DEFAULT_ESTIMATOR = "view_index"
RASTERIZER_ORDER = ("gsplat_cuda", "cpu")
"""Where no rasterizer is named, the first one that can run here is used."""
DEFAULT_MATCHER = "xfeat"
WHITE_ASSUMED = (
    "no file says which background the scene was trained on: white is assumed, for the photo's border is white; say "
    '"background" in scene.json.'
)


class Cancelled(Exception):
    """Raised by `localize` between two records after `Request.cancel` was set; the estimator is closed."""


@dataclass(slots=True)
class LoadedScene:
    """A scene in memory with the tools bound to it. Shared by all jobs on it; safe from several threads."""

    scene: GaussianScene
    """As its file has it."""
    rasterizer: Rasterizer
    """Of the scene that photos are localized in: without floaters that veil it."""
    matcher: Matcher
    """The gate's, too; beside an `image_matcher` it is the default one."""
    image_matcher: ImageMatcher | None = None
    cache_dir: Path | None = None
    """Folder in which view indexes and mapped scenes are kept between runs; None: nowhere."""
    skipped_rasterizers: str = ""
    """Why the rasterizer isn't an earlier one of RASTERIZER_ORDER."""
    warnings: tuple[str, ...] = ()
    """For every result."""
    without_floaters: GaussianScene | None = None
    """The scene that photos are localized in; None: it is all of `scene`."""
    _prepared: dict[str, Any] = field(default_factory=dict)
    _whole: Rasterizer | None = None
    _over_white: LoadedScene | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def load(
        cls,
        folder: Path,
        *,
        cache_dir: Path | None = None,
        rasterizer: str | None = None,
        matcher: str = DEFAULT_MATCHER,
    ) -> LoadedScene:
        """Read a scene folder (or a bare scene file) and bind tools to it.

        Raises SceneError, UnknownName, and BackendMissing if the rasterizer that was named can't run.
        """
        scene = mapped_scene(folder, cache_dir) if cache_dir else load_scene(folder)
        loaded = cls.of(scene, cache_dir=cache_dir, rasterizer=rasterizer, matcher=matcher)
        release(scene)  # the rasterizer has its own copy
        return loaded

    @classmethod
    def of(
        cls,
        scene: GaussianScene,
        *,
        cache_dir: Path | None = None,
        rasterizer: str | None = None,
        matcher: str = DEFAULT_MATCHER,
    ) -> LoadedScene:
        """Bind tools to a scene in memory. Raises UnknownName, and BackendMissing as `load`."""
        features = images = MATCHERS.load(matcher).create()
        if isinstance(images, ImageMatcher):
            # Views are retrieved by features of single images, which a matcher of pairs does not have.
            features = MATCHERS.load(DEFAULT_MATCHER).create()
        else:
            # It extracts features, which every method can use.
            images = None
        searched = without_floaters(scene)
        renderer, skipped_rasterizers, warnings = _renderer(searched, rasterizer)
        part = None if searched is scene else searched
        return cls(scene, renderer, features, images, cache_dir, skipped_rasterizers, warnings, part)

    @property
    def searched(self) -> GaussianScene:
        """The scene that photos are localized in."""
        return self.without_floaters or self.scene

    @property
    def nbytes(self) -> int:
        """Memory of the scene and its renderer; a mapped scene's is the kernel's to take back."""
        whole = 0 if self._whole is None else self._whole.nbytes
        return self.scene.nbytes + self.rasterizer.nbytes + whole

    def for_display(self) -> Rasterizer:
        """Return a rasterizer of the whole scene, floaters included, made when it is first needed."""
        if self.without_floaters is None:
            return self.rasterizer
        with self._lock:
            if self._whole is None:
                self._whole = self.rasterizer.of(self.scene)
            return self._whole

    def prepare(self, estimator: str) -> Any:
        """Return what the estimator prepares for this scene (e.g. its view index), made once."""
        make = getattr(ESTIMATORS.load(estimator), "prepare", None)
        if make is None:
            return None
        with self._lock:
            if estimator not in self._prepared:
                # A seed of its own: what a scene has prepared must not depend on the photo that came first.
                tools = Tools(self.searched, self.rasterizer, self.matcher, np.random.default_rng(0), None)
                self._prepared[estimator] = make(tools, self.cache_dir)
                # It was read through for the index; from now on the renderer's copy is used.
                release(self.scene)
            return self._prepared[estimator]

    def as_seen_by(self, query: Query) -> LoadedScene:
        """Return this scene, over white where its background is untold, shows, and is white in the photo.

        The first such photo has the scene's view index made again, over white.
        """
        info = self.scene.info
        if info.background_is_known or info.background_rgb == WHITE:
            return self
        if not has_white_border(query.rgb, query.valid_mask):
            return self
        index = self.prepare(DEFAULT_ESTIMATOR)
        with self._lock:
            # Whether the background shows at all is asked of the views once: a room hides it everywhere.
            if self._over_white is None:
                shown = shows_background(self.rasterizer, [view.camera for view in index.views])
                self._over_white = self._over(WHITE) if shown else self
            return self._over_white

    def _over(self, background_rgb: tuple[float, float, float]) -> LoadedScene:
        """Return the scene over an assumed background, in the same memory."""
        info = replace(self.scene.info, background_rgb=background_rgb)
        said = (*self.warnings, WHITE_ASSUMED)
        return replace(
            self, scene=replace(self.scene, info=info),
            without_floaters=self.without_floaters and replace(self.without_floaters, info=info),
            rasterizer=self.rasterizer.over(background_rgb), warnings=said,
            _prepared={}, _whole=None, _over_white=None, _lock=threading.Lock(),
        )  # fmt: skip


def choose_rasterizer() -> tuple[str, str]:
    """Return the rasterizer for scenes that name none, and why it isn't an earlier one of RASTERIZER_ORDER."""
    reasons = []
    for name in RASTERIZER_ORDER:
        reason = RASTERIZERS.missing(name)
        if reason is None:
            return name, "; ".join(reasons)
        reasons.append(f"{name}: {reason}")
    raise BackendMissing("; ".join(reasons), where="render")


def _renderer(scene: GaussianScene, name: str | None) -> tuple[Rasterizer, str, tuple[str, ...]]:
    """Return the rasterizer, why it isn't an earlier one of RASTERIZER_ORDER, and what results should warn of."""
    if name:
        return RASTERIZERS.load(name).create(scene), "", ()
    name, skipped_rasterizers = choose_rasterizer()
    try:
        return RASTERIZERS.load(name).create(scene), skipped_rasterizers, ()
    except BackendMissing as error:  # the GPU's memory may be full
        last = RASTERIZER_ORDER[-1]
        if name == last:
            raise
        return RASTERIZERS.load(last).create(scene), str(error), (f"rendered with {last}: {error}",)


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
    tools = Tools(
        loaded.searched,
        Counted(rasterizer_for(query, loaded), tally),
        loaded.matcher,
        np.random.default_rng(request.seed),
        loaded.prepare(request.estimator),
        image_matcher=loaded.image_matcher,
        tally=tally,
    )
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
    # The intrinsics belong to the pose, in the result and in its verification.
    if last.lens:
        images = QueryImages(taken_through(query, last.lens), loaded.matcher)
    else:
        images = QueryImages(query, loaded.matcher).corrected(last.correction)
    query = images.query
    verdict = answer.verdict if answer else render_and_verify(images, last.pose, tools.rasterizer)
    verdict = _qualified(verdict, last, trace.exhausted)
    verdict = _if_captured(verdict, query, last.pose, tools)
    advice = _advice(images, loaded, verdict, last, tools.rasterizer)
    timings = _timings(trace.records, clock)
    found = estimate_of(
        query, loaded, request, verdict, trace.records, timings=timings, renders=renders, exhausted=trace.exhausted
    )
    return replace(found, advice=advice)


def _if_captured(verdict: Verdict, query: Query, pose: Pose, tools: Tools[Any]) -> Verdict:
    """Return a verdict for a pose outside of what the index's views saw as `uncertain` for that reason; others as
    they are, also where another reason than that the evidence is poor decided."""
    by_evidence = verdict.status is Status.LOCALIZED or verdict.reason in _REASONS_OF_EVIDENCE
    views = tools.prepared.views if isinstance(tools.prepared, ViewIndex) else ()
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
    """Return the query with the accuracy that the request asks for. Raises InvalidAccuracy."""
    info = loaded.scene.info
    return replace(query, accuracy=request.accuracy.in_units(info.name, info.metres_per_unit))


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
        + info.warnings
        + loaded.warnings
        + _assumptions(query, loaded)
        + _cautions(query, verdict),
        records=tuple(records),
        frames=info.frames,
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
        'the pose a little; say "training_size" in scene.json.',
    )


def _cautions(query: Query, verdict: Verdict) -> tuple[str, ...]:
    """Return warnings of what the photo shows of its camera."""
    cautions = []
    if query.intrinsics_source == "fisheye":
        cautions.append(
            "the photo's lens is a fisheye, not what was sent or assumed: its intrinsics were estimated with the pose. "
            "Send them with `model` and `distortion` for an exact pose."
        )
    if verdict.intrinsics_untested:
        cautions.append(
            "the photo can't confirm its intrinsics: a focal length that is 1 % off moves the camera by about 1 % of "
            "its distance, which the covariance allows for."
        )
    if verdict.shutter_motion:
        shear, stretch = verdict.shutter_motion
        cautions.append(
            f"the camera turned while the photo was read row by row (rolling shutter: shear {shear:+.3f}, stretch "
            f"{stretch:+.3f}); the pose is that of the middle row. Hold the camera still for a more exact one."
        )
    return tuple(cautions)


def _exhausted(request: Request, clock: Clock, tally: RenderTally) -> bool:
    late = request.budget_s is not None and clock.wall_s > request.budget_s
    return late or (request.budget_renders is not None and tally.count >= request.budget_renders)


def _qualified(verdict: Verdict, last: IterationRecord, exhausted: bool) -> Verdict:
    """Return the verdict with what a render doesn't show: a mirrored photo, a lens beyond what is estimated, other
    answers, too small a budget."""
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
