"""Follows one live camera: each frame in the time of one small render, the rest beside it.

    extrapolate, by odometry if there is some -> refine on the last render and on one at the pose
    -> the gate by the pixels

Where the pixels alone don't suffice the frame is `uncertain`. Searches, and every second the whole gate, run in the
background. A search that succeeded belongs to a frame of the past: the frames since are followed from there, thinned
out, until the newest one is reached. Where frames alone aren't found, those that odometry relates are searched for
together now and then (`service/rig.py`). With odometry a frame that has no pose of its own is carried from those that
had one (`fusion`).
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from service.device_readings import LEAST_SIGMA_DEG, DeviceReadings, Gravity
from service.errors import InvalidImage
from service.live.background import Background
from service.live.fusion import Fusion
from service.live.live_values import FusedOdometry, LiveAnswer, LiveFrame, LiveTask, Mode
from service.live.odometry_fit import scaled
from service.live.recent_views import RecentViews
from service.loaded_scene import LoadedScene
from service.localize import Cancelled, Request, asked_of, localize_in_scene, rasterizer_for
from service.localize import render_and_verify as verify_whole
from service.photos.images import photo_size, read_query
from service.photos.sequence import PHOTO_LONG_SIDE
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import RenderedView
from service.pose.verification.gate import downgraded
from service.pose.verification.signals import typical_depth
from service.results import PoseEstimate, Reason, Status, Verdict
from service.rig import RIG, RigConfig, RigPhoto, localize_rig_in_scene
from service.scene_origin import query_in_scene, shifted
from service.tracking import (
    TRACKING,
    SharedIntrinsics,
    TrackedPose,
    TrackingConfig,
    extrapolated,
    is_placed,
    photometric_verdict,
    refine_from,
)
from service.types import Intrinsics, Pose, Query, frozen

_log = logging.getLogger(__name__)
LIVE_RIG = replace(RIG, rounds=((5, 1.0), (16, 1.0)), hypotheses=1)


@dataclass(frozen=True, slots=True)
class LiveConfig:
    """When a live camera counts as lost, and what is done about it. Times are those of the frames."""

    tracking: TrackingConfig = TRACKING
    max_pixels: int = 4_200_000
    """Of a frame; it is reduced to 832 pixels anyway, and decoding 4 megapixels takes 20 ms."""
    check_every_s: float = 1.0
    """Time between two verifications by the whole gate."""
    search_after_s: float = 0.15
    """Without a verified frame for so long, a search begins, even if the camera is still followed."""
    unverified_s: float = 1.0
    """A camera that is followed without a verified frame for longer has no pose: refinement may have gone astray."""
    stale_s: float = 0.4
    """A gap between frames after which the velocity is not extrapolated."""
    retry_s: float = 3.0
    """For so long a lost camera is looked for where it was last, too: a hand over the lens goes away."""
    retry_every_s: float = 0.1
    """Time between two such tries."""
    search_s: tuple[float, ...] = (2.0, 6.0)
    """Wall times of one search after another, from the start when they are through. A search takes 0.05 to 0.4 s of a
    core; more where others use the core, too."""
    min_contrast: float = 6.0
    """Standard deviation of a frame's values, 0..255, below which nothing is searched for: a dark or covered lens."""
    kept_every_s: float = 0.06
    """Time between the frames that are kept while a search runs."""
    rig: RigConfig = LIVE_RIG
    """Of the search for frames together: shorter than for photos, for the next search sees something else."""
    most_scale_sigma: float = 0.05
    """Of the scale's logarithm, up to which frames that odometry relates are searched for together."""
    kept: int = 40
    """Frames, as they came, hence about 2 MB; when there are more, every second one is dropped."""


LIVE = LiveConfig()


@dataclass(frozen=True, slots=True)
class _Found:
    """The result of a search, or of a check by the whole gate, in the background."""

    query: Query
    """With the session's intrinsics when it began."""
    time_s: float
    estimate: PoseEstimate | None
    """Of a search."""
    checked: Verdict | None
    """Of the whole gate."""
    loaded: LoadedScene


@dataclass(frozen=True, slots=True)
class _Followed:
    pose: Pose
    verdict: Verdict
    query: Query


class LiveTracker:
    """Answers one camera's frames in their order. For one thread; `close` it when it isn't used any more."""

    def __init__(self, task: LiveTask, loaded: LoadedScene, config: LiveConfig = LIVE) -> None:
        self._task, self._loaded, self._config = task, loaded, config
        self._origin = loaded.scene.info.origin_in_world
        self._lens = SharedIntrinsics(config.tracking)
        self._past: deque[tuple[float, Pose]] = deque(maxlen=2)
        """When and where the camera was last, relative to the scene's origin."""
        self._rendered: RenderedView | None = None
        self._verified_s = -1e9
        """Time of the newest frame that was verified."""
        self._checked_s = -1e9
        """Time of the last frame that the whole gate verified."""
        self._doubt: Reason | None = None
        """What the whole gate had against the last frame that it saw."""
        self._searches = 0
        """That ended without an answer since the camera was verified last."""
        self._kept: list[LiveFrame] = []
        self._kept_every_s = config.kept_every_s
        self._tried_s = -1e9
        self._fusion = Fusion(task.odometry, loaded.scene.info)
        self._run = 0
        """How often a search found the camera."""
        self._views = RecentViews()
        self._background: Background[_Found | None] = Background()

    def close(self) -> None:
        """End what runs in the background. Takes as long as one step of a search."""
        self._background.close()

    def use(self, frame: LiveFrame) -> LiveAnswer:
        """Return where the camera was at this frame.

        Raises InvalidImage, InvalidIntrinsics for what can't be a frame, and what `localize` raises.
        """
        began = time.perf_counter()
        size = self._checked_size(frame)
        if frame.odom_from_camera is not None:
            self._fusion.move(frame.time_s, frame.odom_from_camera, frame.up_in_camera)
            self._views.add(frame, frame.odom_from_camera, self._fusion.resets)
        # First: the background may have found where to look for this frame.
        self._take_over()
        followed = None
        if self._past and self._is_due(frame):
            query = self._query(frame, size)
            # In the dark nothing is found, near or far.
            followed = None if self._is_dark(query) else self._followed(query, frame.time_s)
            self._begin_in_background(query, frame.time_s, followed)
        elif self._background.idle:
            self._begin_in_background(self._query(frame, size), frame.time_s, None)
        self._keep(frame)
        answer = self._answer(frame, size, followed)
        return replace(answer, used_s=time.perf_counter() - began)

    # ------------------------------------------------------------------ frames

    def _checked_size(self, frame: LiveFrame) -> tuple[int, int]:
        if not frame.data.startswith(b"\xff\xd8\xff"):
            raise InvalidImage("a frame is a JPEG.", where="frame")
        # By the header: a picture that is too large must not be decoded.
        width, height = photo_size(frame.data)
        if width * height > self._config.max_pixels:
            raise InvalidImage(
                f"a frame has at most {self._config.max_pixels} pixels, not {width} x {height}.", where="frame"
            )
        return width, height

    def _query(self, frame: LiveFrame, size: tuple[int, int]) -> Query:
        """Decode a frame; with its own intrinsics, or the session's for its size."""
        intrinsics = frame.intrinsics or self._task.intrinsics
        if intrinsics is not None and (intrinsics.width, intrinsics.height) != size:
            intrinsics = _resized(intrinsics, size)
        query = read_query(frame.data, intrinsics=intrinsics, prior=self._task.prior, long_side=PHOTO_LONG_SIDE)
        up, facts = frame.up_in_camera, self._task.odometry
        gravity = None if up is None else DeviceReadings(Gravity(up, max(facts.up_sigma_deg, LEAST_SIGMA_DEG)))
        query = replace(query, region=self._task.region, readings=gravity)
        if any(self._origin):
            query = query_in_scene(query, self._origin)
        return asked_of(query, self._loaded, Request(accuracy=self._task.accuracy))

    def _through_lens(self, query: Query) -> Query:
        """Return a frame with what is known of the session's lens; one with exact intrinsics as it is."""
        return self._lens.applied_to(query) if query.lens_prior else query

    def _answer(self, frame: LiveFrame, size: tuple[int, int], followed: _Followed | None) -> LiveAnswer:
        mode: Mode = "lost" if self._searches else "relocalizing"
        astray = frame.time_s - self._verified_s > self._config.unverified_s
        odometry = self._reported(frame)
        if followed is None or astray:
            carried = None if frame.odom_from_camera is None else self._fusion.carried()
            if carried is None:
                return LiveAnswer(frame.id, frame.time_s, mode, size, odometry=odometry)
            pose = shifted(carried[0], self._origin)
            return LiveAnswer(frame.id, frame.time_s, "carried", size, pose, covariance=carried[1], odometry=odometry)
        verdict = followed.verdict
        if self._doubt is not None:
            verdict = downgraded(verdict, self._doubt)
        pose = shifted(followed.pose, self._origin) if any(self._origin) else followed.pose
        return LiveAnswer(
            frame.id, frame.time_s, "tracking", size, pose, verdict, followed.query.photo_intrinsics, odometry=odometry
        )

    def _reported(self, frame: LiveFrame) -> FusedOdometry | None:
        reported = None if frame.odom_from_camera is None else self._fusion.reported()
        if reported is None or not any(self._origin):
            return reported
        matrix = reported.world_from_odom.copy()
        matrix[:3, 3] += self._origin
        return replace(reported, world_from_odom=frozen(matrix))

    def _keep(self, frame: LiveFrame) -> None:
        """Keep some frames while a search runs, to follow the camera from its answer to now."""
        if self._background.idle:
            self._kept.clear()
            self._kept_every_s = self._config.kept_every_s
        elif not self._kept or frame.time_s - self._kept[-1].time_s >= self._kept_every_s:
            self._kept.append(frame)
        if len(self._kept) > self._config.kept:
            # The chain from the search's frame on must not break.
            del self._kept[1::2]
            self._kept_every_s *= 2

    # ------------------------------------------------------------------ following

    def _is_due(self, frame: LiveFrame) -> bool:
        """Return whether to look for the camera near where it was: always while it is followed, else now and then."""
        unseen_s, unverified_s = frame.time_s - self._past[-1][0], frame.time_s - self._verified_s
        if unseen_s <= self._config.stale_s and unverified_s <= self._config.unverified_s:
            return True
        untried = self._tried_s <= self._verified_s
        near = unverified_s <= self._config.retry_s or self._fusion.carried() is not None
        return untried or (near and frame.time_s - self._tried_s >= self._config.retry_every_s)

    def _followed(self, query: Query, time_s: float) -> _Followed | None:
        """Refine near the expected pose; None where the gate refuses what that led to."""
        self._tried_s = time_s
        query = self._through_lens(query)
        images = QueryImages(query, self._loaded.matcher)
        found = self._refined(images, self._expected(time_s))
        if found is None:
            return None
        verdict = photometric_verdict(images, found, self._config.tracking.verification)
        if verdict.status is Status.NOT_LOCALIZED:
            return None
        self._rendered = found.rendered
        self._past.append((time_s, found.pose))
        if is_placed(verdict):
            self._verified_s = time_s
            self._lens.update(images, found)
            if self._doubt is None:
                self._searches = 0
                if verdict.covariance is not None:
                    depth = typical_depth(found.rendered.frame)
                    self._fusion.fix(time_s, found.pose, verdict.covariance, depth, self._run)
        return _Followed(found.pose, verdict, query)

    def _expected(self, time_s: float) -> Pose:
        last_s, last = self._past[-1]
        fresh = time_s - last_s <= self._config.stale_s
        moving = extrapolated(self._past, time_s, self._config.tracking.max_intervals) if fresh else None
        return self._fusion.predicted(last_s, last, time_s, moving or last)

    def _refined(self, images: QueryImages, expected: Pose) -> TrackedPose | None:
        rasterizer = rasterizer_for(images.query, self._loaded)
        return refine_from(images, expected, self._rendered, rasterizer, self._config.tracking)

    # ------------------------------------------------------------------ the background

    def _begin_in_background(self, query: Query, time_s: float, followed: _Followed | None) -> None:
        """Begin a search or a check by the whole gate if one is due and nothing runs."""
        if not self._background.idle:
            return
        unverified_s = time_s - self._verified_s
        if followed is None or unverified_s > self._config.search_after_s or self._doubt is not None:
            if self._is_dark(query):
                return
            # Most lost cameras are found by a single frame, in less time.
            rig = self._rig(query) if self._searches % 3 == 2 else []
            if rig:
                self._background.start(lambda cancel: self._searched_together(rig, query, time_s, cancel))
            else:
                self._background.start(lambda cancel: self._searched(query, time_s, cancel))
        elif time_s - self._checked_s > self._config.check_every_s:
            self._background.start(lambda cancel: self._checked(followed, time_s))

    def _is_dark(self, query: Query) -> bool:
        return float(query.rgb[::8, ::8].std()) < self._config.min_contrast

    def _searched(self, query: Query, time_s: float, cancel: threading.Event) -> _Found | None:
        query = self._through_lens(query)
        loaded = self._loaded.as_seen_by(query)
        seconds = self._config.search_s[self._searches % len(self._config.search_s)]
        task = self._task
        request = Request(task.estimator, seed=task.seed, budget_s=seconds, cancel=cancel, accuracy=task.accuracy)
        # Without the last pose as a prior: there tracking looks for the camera itself.
        try:
            estimate = localize_in_scene(query, loaded, request)
        except Cancelled:
            return None
        return _Found(query, time_s, estimate, None, loaded)

    def _rig(self, query: Query) -> list[RigPhoto]:
        """Return the newest frame and those before it that odometry relates to it, the newest first; none where a frame
        has nothing to go with it, or lengths aren't known."""
        scale, views = self._fusion.scale, self._views.before_newest()
        if scale is None or scale[1] > self._config.most_scale_sigma or not views:
            return []
        newest = self._views.newest
        photos = [RigPhoto(self._alone(query), Pose(np.eye(4)))]
        for frame, odom in views:
            step = newest.camera_from_world @ odom.world_from_camera
            own = self._query(frame, self._checked_size(frame))
            photos.append(RigPhoto(self._alone(own), Pose(scaled(step, scale[0]))))
        return photos

    def _alone(self, query: Query) -> Query:
        """Return a frame with the session's lens for exact, and without what is known of its own pose."""
        return replace(self._through_lens(query), lens_prior=None, prior=None)

    def _searched_together(
        self, photos: Sequence[RigPhoto], query: Query, time_s: float, cancel: threading.Event
    ) -> _Found | None:
        config = self._config
        request = Request(
            seed=self._task.seed, cancel=cancel, accuracy=self._task.accuracy, budget_s=config.search_s[0]
        )
        loaded = self._loaded.as_seen_by(query)
        try:
            found = localize_rig_in_scene(photos, loaded, request, config=config.rig)
        except Cancelled:
            return None
        return _Found(self._through_lens(query), time_s, found.estimate, None, loaded)

    def _checked(self, followed: _Followed, time_s: float) -> _Found:
        images = QueryImages(followed.query, self._loaded.matcher)
        verdict = verify_whole(images, followed.pose, rasterizer_for(followed.query, self._loaded))
        return _Found(followed.query, time_s, None, verdict, self._loaded)

    def _take_over(self) -> None:
        """Take over the result of the background since the last frame."""
        found = self._background.result()
        if found is None:
            return
        if found.checked is not None:
            self._checked_s = found.time_s
            self._doubt = None if is_placed(found.checked) else found.checked.reason
        elif found.estimate is not None:
            self._take_search(found, found.estimate)

    def _take_search(self, found: _Found, estimate: PoseEstimate) -> None:
        if not is_placed(estimate.verdict):
            self._searches += 1
            return
        if self._doubt is None and self._verified_s > found.time_s:
            return  # it was found meanwhile where it was last
        record = estimate.records[-1]
        # A fisheye's correction isn't one of the pinhole that the next frames are taken for.
        if found.query.lens_prior and record.lens is None and estimate.verdict.focal_sigma:
            prior = replace(found.query.lens_prior, log_focal_scale=estimate.verdict.focal_sigma)
            self._lens.set(record.pose, self._lens.correction.then(record.correction), prior)
        self._loaded, self._rendered, self._doubt, self._searches = found.loaded, None, None, 0
        self._run += 1
        self._past.clear()
        self._past.append((found.time_s, record.pose))
        self._verified_s = self._checked_s = found.time_s
        for frame in tuple(self._kept):
            if frame.time_s > found.time_s:
                self._followed(self._query(frame, self._checked_size(frame)), frame.time_s)
        _log.info("live: found again, %d frames later", len(self._kept))


def _resized(intrinsics: Intrinsics, size: tuple[int, int]) -> Intrinsics:
    """Return intrinsics for a frame of another size, if that has the same shape; else as they are."""
    scales = size[0] / intrinsics.width, size[1] / intrinsics.height
    return intrinsics.resized(*size) if abs(scales[0] / scales[1] - 1) < 0.01 else intrinsics
