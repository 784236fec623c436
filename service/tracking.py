"""Tracking: the trajectory of one camera through a scene, from several photos or a video's frames in their order.

    last pose, extrapolated at constant velocity -> refine on the last render -> render there, refine again
    -> photometric verification; in doubt the whole verification gate; if that refuses, too: `localize`, as a photo

A photo costs one small render where the motion is smooth. Each is refined against the scene itself, so that errors
don't accumulate. The photos share one camera: approximate intrinsics become more certain with each.

    from service.tracking import Tracker
    tracker = Tracker(scene)
    for photo in photos:
        print(tracker.track(read_query(photo.read_bytes())).pose.position_in_world)
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from service.geometry import moved, pose_distance, se3_log
from service.interfaces import Rasterizer, RenderTally
from service.loaded_scene import LoadedScene
from service.localize import (
    Cancelled,
    Clock,
    Request,
    asked_of,
    estimate_of,
    localize_in_scene,
    rasterizer_for,
    render_and_verify,
)
from service.photos.intrinsics import undistorted_query
from service.photos.sequence import SequencePhoto
from service.pose.features.image_sizes import sized
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import RenderedView, ViewRenderer
from service.pose.refinement.photometric import refine_photometric
from service.pose.refinement.uncertainty import PoseUncertainty, pose_uncertainty
from service.pose.verification.appearance import appearance
from service.pose.verification.gate import VERIFICATION, VerificationConfig, photometric_suffices, verdict_of
from service.pose.verification.precision import AskedBounds
from service.pose.verification.signals import geometry_signals, typical_depth
from service.render.render_counter import Counted
from service.results import IterationRecord, PoseEstimate, Reason, StageTiming, Status, Verdict
from service.scene_origin import estimate_in_world, query_in_scene
from service.types import NO_CORRECTION, Camera, IntrinsicsCorrection, LensPrior, Pose, Query


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """How a camera is followed."""

    render_px: int = 256
    """Long side of the renders that are refined on."""
    levels: int = 3
    """Of the image pyramid, on the last render."""
    max_renders: int = 3
    """To refine on, for one photo."""
    settled_px: float = 0.5
    """Where a step moved the image by less, another render would be the same."""
    verify_every: int = 30
    """Photos after which the whole gate verifies one, whatever the pixels say."""
    max_intervals: float = 2.0
    """Intervals between photos over which a velocity is extrapolated."""
    new_view_deg: float = 3.0
    new_view_share: float = 0.03
    """The intrinsics are estimated again only after such a rotation, or such a way (share of the distance to what is
    seen): photos that see the scene from nearly the same place err alike."""
    settled_focal_sigma: float = 0.002
    """Standard deviation of the focal length's logarithm from which on the intrinsics are kept."""
    verification: VerificationConfig = VERIFICATION


TRACKING = TrackingConfig()
INTRINSICS_DOUBTS = (Reason.FOCAL_UNCERTAIN, Reason.INTRINSICS_CONTRADICTED)
"""Doubts about the intrinsics, not about the pose: no reason to search elsewhere."""


@dataclass(frozen=True, slots=True)
class SequencePose:
    """Where one photo of a sequence was taken."""

    photo: SequencePhoto
    estimate: PoseEstimate
    exhausted: bool
    """The budget is spent: this was the last photo that was localized."""


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
    """Follows one camera; its photos come in the order in which they were taken. For one thread."""

    def __init__(self, loaded: LoadedScene, request: Request | None = None, config: TrackingConfig = TRACKING) -> None:
        """The request says how to localize where tracking fails; its budget is for all photos together."""
        self._loaded, self._request, self._config = loaded, request or Request(), config
        self._clock, self._renders, self._unverified = Clock(), 0, 0
        self._intrinsics = SharedIntrinsics(config)
        self._past: deque[tuple[float, Pose]] = deque(maxlen=2)
        """When and where the camera was last; empty while it is lost."""
        self._rendered: RenderedView | None = None
        """The last render."""

    @property
    def exhausted(self) -> bool:
        """Whether the request's budget is spent."""
        return any(left is not None and left <= 0 for left in self._left())

    def track(self, query: Query, time_s: float | None = None) -> PoseEstimate:
        """Return where the next photo was taken; without times, photos come at equal intervals.

        The photos' intrinsics are one camera's: what one of them adds to approximate ones holds for the next. Raises
        what `localize` raises.
        """
        origin = self._loaded.scene.info.origin_in_world
        if not any(origin):
            return self._track(query, time_s)
        return estimate_in_world(self._track(query_in_scene(query, origin), time_s), origin)

    def _track(self, query: Query, time_s: float | None) -> PoseEstimate:
        """Track with positions relative to the scene's origin."""
        if self._request.cancel is not None and self._request.cancel.is_set():
            raise Cancelled
        self._loaded = self._loaded.as_seen_by(query)
        query = asked_of(query, self._loaded, self._request)
        # Equal intervals of 1: only their ratios matter.
        if time_s is None:
            time_s = self._past[-1][0] + 1.0 if self._past else 0.0
        shared, expected = self._intrinsics.applied_to(query), self._expected(time_s)
        estimate = self._followed(shared, expected) if expected else None
        # Tracking failed or is in doubt: the photo is localized like any other.
        if estimate is None or not is_placed(estimate.verdict):
            estimate = self._localized(shared, expected, estimate)
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
        """Return the pose extrapolated to this time; None while the camera is lost."""
        return extrapolated(self._past, time_s, self._config.max_intervals)

    def _followed(self, query: Query, expected: Pose) -> PoseEstimate | None:
        """Refine from the expected pose and verify the result; None where the photo can't be refined."""
        clock, tally = Clock(), RenderTally()
        rasterizer = Counted(rasterizer_for(query, self._loaded), tally)
        images = QueryImages(query, self._loaded.matcher)
        found = refine_from(images, expected, self._rendered, rasterizer, self._config)
        if found is None:
            return None
        self._rendered = found.rendered
        verdict = verify_tracked(images, found, self._config.verification)
        timings = [StageTiming("track", clock.wall_s, clock.cpu_s)]
        renders = tally.count
        self._unverified += 1
        if verdict is None or self._unverified >= self._config.verify_every:
            # The whole gate, on a render in its own size.
            verdict, self._unverified = render_and_verify(images, found.pose, rasterizer), 0
            timings.append(StageTiming("verify", clock.wall_s - timings[0].wall_s, clock.cpu_s - timings[0].cpu_s))
        step_deg, step_units = pose_distance(self._past[-1][1], found.pose)
        correction = self._intrinsics.correction
        record = IterationRecord("track", found.pose, correction, found.loss, step_deg=step_deg, step_units=step_units)
        if is_placed(verdict):
            self._intrinsics.update(images, found)
        return estimate_of(query, self._loaded, self._request, verdict, [record], timings=timings, renders=renders)

    def _localized(self, query: Query, expected: Pose | None, followed: PoseEstimate | None) -> PoseEstimate:
        """Localize the photo like a single one, with the expected pose as prior; return the better answer."""
        seconds, renders = self._left()
        request = replace(self._request, budget_s=seconds, budget_renders=renders)
        found = localize_in_scene(replace(query, prior=expected or query.prior), self._loaded, request)
        if followed is not None:
            spent = {"timings": followed.timings + found.timings, "renders": followed.renders + found.renders}
            # Both were verified by the same gate, so their scores compare.
            if followed.verdict.rank >= found.verdict.rank:
                return replace(followed, budget_exhausted=found.budget_exhausted, **spent)
            found = replace(found, **spent)
        self._past.clear()  # the camera didn't come here at a known velocity
        self._rendered, self._unverified = None, 0
        shared = self._intrinsics.correction
        records = tuple(replace(record, correction=shared.then(record.correction)) for record in found.records)
        # A fisheye's correction isn't one of the pinhole that the next photos are taken for.
        if query.lens_prior and is_placed(found.verdict) and records[-1].lens is None:
            prior = replace(query.lens_prior, log_focal_scale=found.verdict.focal_sigma)
            self._intrinsics.set(found.pose, records[-1].correction, prior)
        return replace(found, records=records)


def extrapolated(past: Sequence[tuple[float, Pose]], time_s: float, max_intervals: float) -> Pose | None:
    """Return the last of some timed poses, moved on at the velocity between the last two; None without a pose.

    The way is no longer than that of so many intervals between those two.
    """
    if len(past) < 2:
        return past[-1][1] if past else None
    (before_s, before), (last_s, last) = past[-2], past[-1]
    intervals = (time_s - last_s) / max(last_s - before_s, 1e-9)
    # In the camera's own frame, so that a steady turn stays one.
    motion = se3_log(before.camera_from_world @ last.world_from_camera)
    return moved(last, motion * float(np.clip(intervals, 0.0, max_intervals)))


def is_placed(verdict: Verdict) -> bool:
    """Return whether there is no reason to search for the photo elsewhere."""
    return verdict.status is Status.LOCALIZED or verdict.reason in INTRINSICS_DOUBTS


@dataclass(frozen=True, slots=True)
class TrackedPose:
    """A pose that refinement from an expected one led to."""

    pose: Pose
    rendered: RenderedView
    """From nearby."""
    loss: float
    uncertainty: PoseUncertainty
    """Before its last step, which is in the pose already."""


def refine_from(
    images: QueryImages,
    expected: Pose,
    rendered: RenderedView | None,
    rasterizer: Rasterizer,
    config: TrackingConfig = TRACKING,
) -> TrackedPose | None:
    """Refine from the expected pose on the last render, then on new ones there; None where too little overlaps."""
    query = images.query
    size = sized(query.intrinsics, config.render_px)
    photo, valid = images.resized(size), images.valid_mask(size)
    renderer = ViewRenderer(rasterizer)
    if rendered is None or _size(rendered) != (size.width, size.height):
        rendered = renderer.render(Camera(size, expected))
    # The last render is at hand, and brings the pose near enough for one Gauss-Newton step a render.
    first = refine_photometric(
        photo, rendered.frame, rendered.camera, Camera(size, expected), config.levels, valid_mask=valid
    )
    if not np.isfinite(first.loss):
        return None
    pose, uncertainty = first.pose, None
    for _ in range(config.max_renders):
        rendered = renderer.render(Camera(size, pose))
        camera = rendered.camera
        uncertainty = pose_uncertainty(photo, rendered.frame, camera, camera, query.lens_prior, valid)
        if uncertainty is None:
            return None
        # Estimating the uncertainty includes a step, which is taken.
        pose = moved(pose, uncertainty.last_step)
        turn, way = np.linalg.norm(uncertainty.last_step[:3]), np.linalg.norm(uncertainty.last_step[3:])
        if size.fx * (turn + way / typical_depth(rendered.frame)) < config.settled_px:
            break
    return None if uncertainty is None else TrackedPose(pose, rendered, first.loss, uncertainty)


def _size(rendered: RenderedView) -> tuple[int, int]:
    return rendered.camera.intrinsics.width, rendered.camera.intrinsics.height


def verify_tracked(
    images: QueryImages, found: TrackedPose, config: VerificationConfig = VERIFICATION
) -> Verdict | None:
    """Return the gate's verdict by the signals of the pixels alone; None where these don't suffice to accept."""
    verdict = photometric_verdict(images, found, config)
    return verdict if photometric_suffices(verdict.signals, config) else None


def photometric_verdict(images: QueryImages, found: TrackedPose, config: VerificationConfig = VERIFICATION) -> Verdict:
    """Return the gate's verdict by the signals of the pixels alone, also where these don't suffice to accept."""
    frame, size = found.rendered.frame, found.rendered.camera.intrinsics
    signals = appearance(images.resized(size), frame, images.valid_mask(size))
    signals |= geometry_signals(frame, size, found.uncertainty)
    lens_prior = images.query.lens_prior
    # A shared focal length is not for one photo to doubt.
    focal_step = 0.0 if lens_prior else found.uncertainty.focal_step
    uncertainty = replace(found.uncertainty, last_step=np.zeros(6), focal_step=focal_step)
    asked = AskedBounds.of(images.query.accuracy, typical_depth(frame))
    return verdict_of(signals, uncertainty, asked, config=config)


@dataclass(slots=True)
class SharedIntrinsics:
    """The intrinsics that the photos so far agree on; each that sees the scene from another place adds to them."""

    config: TrackingConfig
    correction: IntrinsicsCorrection = NO_CORRECTION
    """Of the intrinsics that the photos came with."""
    prior: LensPrior | None = None
    """How certain they are; None: no photo has added anything."""
    photos: int = 0
    seen_from: Pose | None = None

    def applied_to(self, query: Query) -> Query:
        """Return the photo with the intrinsics so far."""
        return replace(undistorted_query(query, self.correction), lens_prior=self.prior or query.lens_prior)

    def set(self, pose: Pose, correction: IntrinsicsCorrection, prior: LensPrior) -> None:
        """Take over an estimate that a photo led to, beginning with the one so far."""
        self.correction, self.prior, self.photos, self.seen_from = correction, prior, self.photos + 1, pose

    def update(self, images: QueryImages, found: TrackedPose) -> None:
        """Estimate the intrinsics with the pose, if they are uncertain and the photo isn't much like the last one."""
        config, prior = self.config, images.query.lens_prior
        if prior is None or prior.log_focal_scale <= config.settled_focal_sigma or self.seen_from is None:
            return
        turn_deg, way = pose_distance(self.seen_from, found.pose)
        frame, camera = found.rendered.frame, found.rendered.camera
        if turn_deg < config.new_view_deg and way < config.new_view_share * typical_depth(frame):
            return
        photo, valid = images.resized(camera.intrinsics), images.valid_mask(camera.intrinsics)
        start = Camera(camera.intrinsics, found.pose)
        result = refine_photometric(photo, frame, camera, start, 1, NO_CORRECTION, prior, valid)
        if not np.isfinite(result.loss):
            return
        share = 1 / (self.photos + 1)  # of principal point and distortion, whose means are taken
        new = result.correction
        step = IntrinsicsCorrection(new.focal_factor, share * new.shift_x, share * new.shift_y, share * new.k1)
        focal_sigma, k1_sigma = np.sqrt(found.uncertainty.covariance.diagonal()[6:8])
        known = replace(prior, log_focal_scale=float(focal_sigma), k1_sigma=float(k1_sigma))
        self.set(result.pose, self.correction.then(step), known)
