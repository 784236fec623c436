"""Follow one camera through a scene: several photos, or a video's frames, one after the other.

    last pose, carried on at constant velocity -> align with the last render -> render there, align again -> glance
    in doubt: the verification gate -> if that doubts, too: `localize`, as for a single photo

A photo costs one small render where the motion is smooth, and each is aligned with the scene itself: errors don't add
up. What several photos tell of their lens is put together, so that it needn't be known.

    from service.tracking import Tracker
    tracker = Tracker(scene)
    for photo in photos:
        print(tracker.track(read_query(photo.read_bytes())).pose.position_in_world)
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable
from dataclasses import dataclass, replace

import numpy as np

from service.geometry import moved, pose_distance, se3_log
from service.interfaces import Frame, RenderTally, Tools
from service.localize import Cancelled, Clock, LoadedScene, Request, estimate_of, localize, rasterizer_for
from service.photos.sequence import SequencePhoto
from service.pose.features.image_sizes import sized
from service.pose.features.views import known_at, photo_at
from service.pose.refinement.photometric import refine_photometric
from service.pose.refinement.uncertainty import PoseUncertainty, pose_uncertainty
from service.pose.verification.appearance import appearance
from service.pose.verification.gate import clear, geometry_signals, judged, verify
from service.render.counted import Counted
from service.results import IterationRecord, PoseEstimate, Reason, StageTiming, Status, Verdict
from service.types import NO_CORRECTION, Camera, IntrinsicsCorrection, Pose, Query

TRACK_PX = 256
"""Long side of the renders that are aligned with."""
LEVELS = 3
ROUNDS = 3
"""Renders to align with, at most."""
SETTLED_PX = 0.5
"""Where alignment moved what is seen by less, another render would be the same."""
GATE_EVERY = 30
"""Photos after which the gate is asked all the same."""
LONGEST_STEP = 2.0
"""Intervals over which a velocity is believed."""
LENS_TURN_DEG, LENS_SHARE = 3.0, 0.03
"""Photos that see the scene from nearby err alike: the lens is estimated again only after such a turn, or such a way
(share of the distance to what is seen)."""
LENS_SETTLED = 0.002
"""Standard deviation of the focal length's logarithm from which on the lens is left as it is."""
OF_THE_LENS = (Reason.FOCAL_UNCERTAIN, Reason.INTRINSICS_CONTRADICTED)
"""Doubts about the lens, not about the place: no reason to look elsewhere."""


@dataclass(frozen=True, slots=True)
class SequencePose:
    """Where one photo of a sequence was taken."""

    photo: SequencePhoto
    estimate: PoseEstimate
    exhausted: bool
    """The budget is spent: this was the last photo that was looked at."""


def localize_sequence(
    photos: Iterable[SequencePhoto], loaded: LoadedScene, request: Request | None = None
) -> Generator[SequencePose, None, None]:
    """Yield where each photo was taken. The request's budget is the whole sequence's; it ends early when that is spent.

    Raises Cancelled, UnknownName, BackendMissing, and whatever reading the photos raises.
    """
    tracker = Tracker(loaded, request)
    for photo in photos:
        estimate = tracker.track(photo.query, photo.time_s)
        yield SequencePose(photo, estimate, tracker.exhausted)
        if tracker.exhausted:
            return


class Tracker:
    """One camera on its way; its photos come in the order in which they were taken. For one thread."""

    def __init__(self, loaded: LoadedScene, request: Request | None = None) -> None:
        """The request says how to localize what can't be followed; its budget is for all photos together."""
        self._loaded, self._request = loaded, request or Request()
        self._clock, self._renders, self._unverified = Clock(), 0, 0
        self._lens = _SharedLens()
        self._past: deque[tuple[float, Pose]] = deque(maxlen=2)
        """When and where the camera was last; empty while it is lost."""
        self._seen: _Seen | None = None

    @property
    def exhausted(self) -> bool:
        """Whether the request's budget is spent."""
        return any(left is not None and left <= 0 for left in self._left())

    def track(self, query: Query, time_s: float | None = None) -> PoseEstimate:
        """Return where the next photo was taken; without times, photos come at equal intervals.

        The photos' intrinsics are one camera's: what one of them tells of an approximate lens holds for the next.
        Raises what `localize` raises.
        """
        if self._request.cancel is not None and self._request.cancel.is_set():
            raise Cancelled
        if time_s is None:
            time_s = self._past[-1][0] + 1.0 if self._past else 0.0
        told, expected = self._lens.told(query), self._expected(time_s)
        estimate = self._followed(told, expected) if expected else None
        if estimate is None or not _placed(estimate.verdict):
            estimate = self._searched(told, expected, estimate)
        self._renders += estimate.renders
        if estimate.verdict.status is Status.NOT_LOCALIZED or estimate.verdict.reason is Reason.AMBIGUOUS:
            self._past.clear()
        else:
            self._past.append((time_s, estimate.pose))
        return estimate

    def _left(self) -> tuple[float | None, int | None]:
        """Return what is left of the budget: seconds, renders."""
        seconds, renders = self._request.budget_s, self._request.budget_renders
        return (
            None if seconds is None else seconds - self._clock.wall_s,
            None if renders is None else renders - self._renders,
        )

    def _expected(self, time_s: float) -> Pose | None:
        """Return where the camera should be by now; None while it is lost."""
        if len(self._past) < 2:
            return self._past[-1][1] if self._past else None
        (before_s, before), (last_s, last) = self._past
        intervals = (time_s - last_s) / max(last_s - before_s, 1e-9)
        motion = se3_log(before.camera_from_world @ last.world_from_camera)
        return moved(last, motion * float(np.clip(intervals, 0.0, LONGEST_STEP)))

    def _followed(self, query: Query, expected: Pose) -> PoseEstimate | None:
        """Align the photo and judge the answer; None where it can't be aligned."""
        clock, tally = Clock(), RenderTally()
        rng = np.random.default_rng(self._request.seed)
        rasterizer = Counted(rasterizer_for(query, self._loaded), tally)
        tools = Tools(self._loaded.scene, rasterizer, self._loaded.matcher, rng, tally=tally)
        found = aligned_from(query, expected, self._seen, tools)
        if found is None:
            return None
        self._seen = found.seen
        verdict = glance(query, found, tools)
        timings = [StageTiming("track", clock.wall_s, clock.cpu_s)]
        renders = tally.count
        self._unverified += 1
        if verdict is None or self._unverified >= GATE_EVERY:
            verdict, self._unverified = verify(query, found.pose, tools), 0
            timings.append(StageTiming("verify", clock.wall_s - timings[0].wall_s, clock.cpu_s - timings[0].cpu_s))
        step_deg, step_units = pose_distance(self._past[-1][1], found.pose)
        lens = self._lens.lens
        record = IterationRecord("track", found.pose, lens, found.loss, step_deg=step_deg, step_units=step_units)
        if _placed(verdict):
            self._lens.learn(query, found, tools)
        return estimate_of(query, self._loaded, self._request, verdict, [record], timings=timings, renders=renders)

    def _searched(self, query: Query, expected: Pose | None, followed: PoseEstimate | None) -> PoseEstimate:
        """Localize the photo like a single one, beginning where it was expected; return the better answer."""
        seconds, renders = self._left()
        request = replace(self._request, budget_s=seconds, budget_renders=renders)
        found = localize(replace(query, prior=expected or query.prior), self._loaded, request)
        if followed is not None:
            spent = {"timings": followed.timings + found.timings, "renders": followed.renders + found.renders}
            if followed.verdict.score >= found.verdict.score:
                return replace(followed, budget_exhausted=found.budget_exhausted, **spent)
            found = replace(found, **spent)
        self._past.clear()  # it didn't come here at a known velocity
        self._seen, self._unverified = None, 0
        records = tuple(replace(record, lens=self._lens.lens.then(record.lens)) for record in found.records)
        if query.focal_sigma and _placed(found.verdict):
            self._lens.found(found.pose, records[-1].lens, found.verdict.focal_sigma)
        return replace(found, records=records)


def _placed(verdict: Verdict) -> bool:
    """Return whether there is nothing to be looked for elsewhere."""
    return verdict.status is Status.LOCALIZED or verdict.reason in OF_THE_LENS


@dataclass(frozen=True, slots=True)
class _Seen:
    """What the scene looks like from a place."""

    frame: Frame
    camera: Camera

    @classmethod
    def of(cls, camera: Camera, tools: Tools) -> _Seen:
        return cls(tools.rasterizer.render([camera])[0], camera)

    @property
    def size(self) -> tuple[int, int]:
        return self.camera.intrinsics.width, self.camera.intrinsics.height

    @property
    def typical_depth(self) -> float:
        depth = self.frame.median_depth[::8, ::8]
        return float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0


@dataclass(frozen=True, slots=True)
class _Aligned:
    pose: Pose
    seen: _Seen
    """From nearby."""
    loss: float
    uncertainty: PoseUncertainty


def aligned_from(query: Query, expected: Pose, seen: _Seen | None, tools: Tools) -> _Aligned | None:
    """Align with what was seen last, then with the scene as it looks from there; None where too little overlaps."""
    size = sized(query.intrinsics, TRACK_PX)
    photo = photo_at(query, tools, size)
    if seen is None or seen.size != (size.width, size.height):
        seen = _Seen.of(Camera(size, expected), tools)
    known = known_at(query, tools, size)
    first = refine_photometric(photo, seen.frame, seen.camera, Camera(size, expected), LEVELS, valid_mask=known)
    if not np.isfinite(first.loss):
        return None
    pose, weighed = first.pose, None
    for _ in range(ROUNDS):
        seen = _Seen.of(Camera(size, pose), tools)
        weighed = pose_uncertainty(photo, seen.frame, seen.camera, seen.camera, query.focal_sigma, known)
        if weighed is None:
            return None
        pose = moved(pose, weighed.last_step)
        turn, way = np.linalg.norm(weighed.last_step[:3]), np.linalg.norm(weighed.last_step[3:])
        if size.fx * (turn + way / seen.typical_depth) < SETTLED_PX:
            break
    return None if weighed is None else _Aligned(pose, seen, first.loss, weighed)


def glance(query: Query, found: _Aligned, tools: Tools) -> Verdict | None:
    """Judge a pose as the gate does, by the pixels alone: matches cost most; None where these don't make it clear."""
    size = found.seen.camera.intrinsics
    photo, known = photo_at(query, tools, size), known_at(query, tools, size)
    signals = appearance(photo, found.seen.frame, known) | geometry_signals(found.seen.frame, size, found.uncertainty)
    if not clear(signals):
        return None
    # The last pull is in the pose already. A shared lens is not one photo's to doubt.
    focal_step = 0.0 if query.focal_sigma else found.uncertainty.focal_step
    return judged(signals, replace(found.uncertainty, last_step=np.zeros(6), focal_step=focal_step), query.focal_sigma)


@dataclass(slots=True)
class _SharedLens:
    """What the photos have told of their lens so far: each that sees the scene from elsewhere adds to it."""

    lens: IntrinsicsCorrection = NO_CORRECTION
    """Beside the intrinsics that the photos came with."""
    sigma: float | None = None
    """Standard deviation of the focal length's logarithm; None: no photo has told anything."""
    photos: int = 0
    seen_from: Pose | None = None

    def told(self, query: Query) -> Query:
        """Return the photo with what is known of the lens."""
        return replace(query.corrected(self.lens), told_focal_sigma=self.sigma)

    def found(self, pose: Pose, lens: IntrinsicsCorrection, sigma: float) -> None:
        """Take over what a photo by itself has told, beginning with what was known."""
        self.lens, self.sigma, self.photos, self.seen_from = lens, sigma, self.photos + 1, pose

    def learn(self, query: Query, seen: _Aligned, tools: Tools) -> None:
        """Estimate the lens with the pose, if that is of use and the photo isn't much like the last one."""
        if query.focal_sigma <= LENS_SETTLED or self.seen_from is None:
            return
        turn_deg, way = pose_distance(self.seen_from, seen.pose)
        if turn_deg < LENS_TURN_DEG and way < LENS_SHARE * seen.seen.typical_depth:
            return
        camera = seen.seen.camera
        photo = photo_at(query, tools, camera.intrinsics)
        start = Camera(camera.intrinsics, seen.pose)
        known = known_at(query, tools, camera.intrinsics)
        found = refine_photometric(photo, seen.seen.frame, camera, start, 1, NO_CORRECTION, query.focal_sigma, known)
        if not np.isfinite(found.loss):
            return
        share = 1 / (self.photos + 1)  # of the principal point, whose mean is taken
        step = IntrinsicsCorrection(
            found.correction.focal_factor, share * found.correction.shift_x, share * found.correction.shift_y
        )
        sigma = float(np.sqrt(seen.uncertainty.covariance[6, 6]))
        self.found(found.pose, self.lens.then(step), sigma)
