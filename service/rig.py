"""Several photos, one answer: photos whose poses relative to one another are known are localized as one query.

    each photo: the views of the index most like it -> matches with each
    -> poses of the rig that many matches of all photos agree with (`rig_pose`)
    -> render at each photo's pose, match again, solve together -> the pose with most matches is the answer
    -> refine photometrically: each photo's normal equations, summed in the rig's twist
    -> each photo is verified at its pose, and the verdicts are combined (`rig_gate`)

Photos that can't be localized by themselves, because half is hidden or what they show is repeated, have right matches
among the wrong ones; the wrong ones of different photos don't agree with one pose of the rig.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from service.errors import InvalidRequest
from service.geometry import adjoint, moved, reprojection_error_px
from service.interfaces import RenderTally
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.localize import Cancelled, Clock, Request, asked_of, estimate_of, rasterizer_for
from service.pose.absolute_pose.device_priors import prefers
from service.pose.absolute_pose.pnp import estimate_absolute_pose
from service.pose.absolute_pose.rig_pose import RigMatches, estimate_rig_pose
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import ViewRenderer
from service.pose.matching.correspondences import Correspondences, correspondences
from service.pose.refinement.rig_refinement import match_information, refine_rig
from service.pose.retrieval.image_variant import Retrieval
from service.pose.retrieval.index import ViewIndex
from service.pose.retrieval.scores import top_indices
from service.pose.verification.gate import verify
from service.pose.verification.precision import AskedBounds
from service.pose.verification.rig_gate import rig_verdict
from service.pose.verification.signals import typical_depth
from service.readings_in_scene import contradictions, fused
from service.render.render_counter import Counted
from service.results import IterationRecord, PoseEstimate, StageTiming, Verdict
from service.scene_origin import estimate_in_world, query_in_scene, record_in_world, shifted
from service.types import Camera, Pose, Query


@dataclass(frozen=True, slots=True)
class RigConfig:
    """How a rig is searched for."""

    rounds: tuple[tuple[int, float], ...] = ((5, 1.0), (16, 1.0), (48, 1.0))
    """Index views that each photo is matched with, and the photo's size relative to the usual one; in each round, until
    many fresh matches agree."""
    trials: int = 1000
    """Of RANSAC, of each camera."""
    view_trials: int = 300
    view_inliers: int = 10
    """Of RANSAC with the matches of one view; inliers from which on its pose is tried."""
    hypotheses: int = 3
    """Poses of all matches that are tried in a round, and as many of matches with one view."""
    support: float = 2.0
    """Weight of what the other photos say of a view, relative to its own score."""
    rematch_error_px: float = 3.0
    """Reprojection error of an inlier with a render at the pose, at PHOTO_PX."""
    rematches: int = 5
    settled_gain: float = 0.05
    """Renders, one after the other, that are matched at most; it ends where so small a share more agrees."""
    hopeless_inliers: int = 12
    """With fewer a pose isn't rendered again: they are chance."""
    min_inliers: int = 60
    min_inlier_share: float = 0.15
    """Fresh matches that agree, of all photos, and their share, from which on nothing more is searched: right poses of
    photos that are hidden by two thirds have 300 and 0.3, wrong ones 22 and 0.07."""
    alike_share: float = 0.8
    """Matches that agree with a hypothesis, relative to the best one's, from which on the two explain the photos alike,
    and what the device measured may decide."""
    same_share: float = 0.5
    same_errors: float = 3.0
    """Share of a hypothesis' matches that the best one explains, within so many times the largest error of an inlier,
    from which on the two are the same: it has not settled. What is similar elsewhere has other points."""


RIG = RigConfig()


@dataclass(frozen=True, slots=True)
class RigPhoto:
    """One photo of a rig."""

    query: Query
    """With exact intrinsics."""
    rig_from_camera: Pose
    name: str = ""


@dataclass(frozen=True, slots=True)
class RigEstimate:
    """A rig's pose."""

    world_from_rig: Pose
    estimate: PoseEstimate
    """Of the first photo; its verdict is that on the rig."""
    photos: tuple[tuple[Pose, Verdict], ...]
    """Where each photo was taken, and the gate's verdict on it by itself there; its covariance is by all photos."""


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """A pose of the rig, after matching with renders there."""

    world_from_rig: Pose
    inliers: int
    matches: int
    information: Float64[np.ndarray, "6 6"]
    """Of the rig's twist, by the matches that agree."""
    agreeing: tuple[RigMatches, ...] = ()
    """These, of each photo; empty: none agree."""


def localize_rig(
    photos: Sequence[RigPhoto],
    loaded: LoadedScene,
    request: Request | None = None,
    on_record: Callable[[IterationRecord], None] | None = None,
    config: RigConfig = RIG,
    *,
    metric: bool = False,
) -> RigEstimate:
    """Localize several photos together; the API takes 2 to 8.

    `rig_from_camera` is in scene units, or, `metric`, in metres. Poses are in the world. Raises InvalidRequest for a
    rig in metres in a scene without a scale, Cancelled, InvalidAccuracy.
    """
    origin, per_metre = loaded.scene.info.origin_in_world, _units_per_metre(loaded) if metric else 1.0
    own = [
        replace(photo, query=query_in_scene(photo.query, origin), rig_from_camera=_scaled(photo, per_metre))
        for photo in photos
    ]

    def report(record: IterationRecord) -> None:
        if on_record:
            on_record(record_in_world(record, origin))

    found = localize_rig_in_scene(own, loaded, request, report, config)
    return RigEstimate(
        shifted(found.world_from_rig, origin),
        estimate_in_world(found.estimate, origin),
        tuple((shifted(pose, origin), verdict) for pose, verdict in found.photos),
    )


def localize_rig_in_scene(
    photos: Sequence[RigPhoto],
    loaded: LoadedScene,
    request: Request | None = None,
    on_record: Callable[[IterationRecord], None] | None = None,
    config: RigConfig = RIG,
) -> RigEstimate:
    """Localize as `localize_rig` does, in scene units, with all positions relative to the scene's origin."""
    request = request or Request()
    own = [replace(photo, query=asked_of(photo.query, loaded, request)) for photo in photos]
    return _Search(own, loaded, request, on_record or (lambda _: None), config).run()


def _units_per_metre(loaded: LoadedScene) -> float:
    info = loaded.scene.info
    if info.metres_per_unit is None:
        raise InvalidRequest(
            f"the length of a unit of scene '{info.name}' is unknown.",
            where="rig.metric",
            hint="Send the rig in scene units, or register the scene.",
        )
    return 1 / info.metres_per_unit


def _scaled(photo: RigPhoto, factor: float) -> Pose:
    matrix = photo.rig_from_camera.world_from_camera.copy()
    matrix[:3, 3] *= factor
    return Pose(matrix)


class _Search:
    """One rig's search; positions are relative to the scene's origin."""

    def __init__(
        self,
        photos: Sequence[RigPhoto],
        loaded: LoadedScene,
        request: Request,
        report: Callable[[IterationRecord], None],
        config: RigConfig,
    ) -> None:
        self._photos, self._request, self._report, self._config = photos, request, report, config
        self._loaded = loaded.as_seen_by(photos[0].query)
        self._index: ViewIndex = self._loaded.prepare(DEFAULT_ESTIMATOR)
        self._images = [QueryImages(photo.query, self._loaded.matcher) for photo in photos]
        self._retrievals = [Retrieval(images, self._index) for images in self._images]
        self._clock, self._tally = Clock(), RenderTally()
        self._renderer = ViewRenderer(Counted(rasterizer_for(photos[0].query, self._loaded), self._tally))
        self._records: list[IterationRecord] = []
        self._supported: Float64[np.ndarray, "photos views"] | None = None
        self._reach = float(np.median([view.distance for view in self._index.views if len(view.points_in_world)]))

    def run(self) -> RigEstimate:
        best, rivals = self._searched()
        cameras = [(one, photo.rig_from_camera) for one, photo in zip(self._images, self._photos, strict=True)]
        pose, covariance = refine_rig(cameras, best.world_from_rig, best.information, self._renderer)
        self._check()
        self._add("refine_rig", pose, None)
        found, depth = [], 1.0
        for photo, images in zip(self._photos, self._images, strict=True):
            own = _pose_of(pose, photo)
            rendered = self._renderer.at(photo.query, own)
            # Of the first photo, whose pose is the answer.
            depth = depth if found else typical_depth(rendered.frame)
            found.append((own, verify(images, own, rendered)))
        first = self._photos[0]
        if covariance is not None:
            # The same small motion of the rig is another twist in each camera's frame.
            to_cameras = [adjoint(photo.rig_from_camera.camera_from_world) for photo in self._photos]
            covariances = [one @ covariance @ one.T for one in to_cameras]
            found = [(own, replace(one, covariance=c)) for (own, one), c in zip(found, covariances, strict=True)]
            covariance = covariances[0]
        rival = max((one.inliers for one in rivals), default=0) / max(best.inliers, 1)
        verdicts = [verdict for _, verdict in found]
        verdict = rig_verdict(verdicts, covariance, AskedBounds.of(first.query.accuracy, depth), rival)
        query, verdict, pose, found = self._with_readings(verdict, pose, found)
        self._add("verify_rig", pose, verdict.inliers)
        timings = [StageTiming("rig", self._clock.wall_s, self._clock.cpu_s)]
        estimate = estimate_of(
            query, self._loaded, self._request, verdict, self._records, timings=timings, renders=self._tally.count
        )
        return RigEstimate(pose, estimate, tuple(found))

    def _with_readings(
        self, verdict: Verdict, pose: Pose, found: list[tuple[Pose, Verdict]]
    ) -> tuple[Query, Verdict, Pose, list[tuple[Pose, Verdict]]]:
        """Return query and verdict of the first photo, the rig's pose, and that of each photo, by the photos and what a
        device measured beside the first one together."""
        first, info = self._photos[0], self._loaded.scene.info
        registration = self._request.registrations.get(info.sha256)
        against = contradictions(first.query, found[0][0], verdict, info, registration)
        query = replace(first.query, warnings=first.query.warnings + against)
        own, told = fused(first.query, found[0][0], verdict)
        if own is found[0][0] or told.covariance is None:
            return query, verdict, pose, found
        pose = Pose(own.world_from_camera @ first.rig_from_camera.camera_from_world)
        together = []
        for photo, (_, verdict_of_photo) in zip(self._photos, found, strict=True):
            between = photo.rig_from_camera.camera_from_world @ first.rig_from_camera.world_from_camera
            covariance = adjoint(between) @ told.covariance @ adjoint(between).T
            together.append((_pose_of(pose, photo), replace(verdict_of_photo, covariance=covariance)))
        return query, told, pose, together

    # ------------------------------------------------------------------ search

    def _searched(self) -> tuple[_Hypothesis, list[_Hypothesis]]:
        """Return the hypothesis with most fresh matches, and the others that are elsewhere."""
        tried: list[_Hypothesis] = []
        for views, factor in self._config.rounds:
            for pose, inliers in self._hypotheses(views, factor):
                self._add("match_rig", pose, inliers)
                tried.append(self._rematched(pose))
            if any(map(self._is_sure, tried)):
                break
            if self._request.budget_s is not None and self._clock.wall_s > self._request.budget_s:
                break
        if not tried:
            tried.append(_Hypothesis(self._likeliest(), 0, 0, np.zeros((6, 6))))
        if any(map(self._is_sure, tried)):
            tried += map(self._rematched, self._twins(max(tried, key=lambda one: one.inliers)))
        best = max(tried, key=lambda one: one.inliers)
        alike = [one for one in tried if one.inliers >= self._config.alike_share * best.inliers]
        best = next((one for one in alike if self._readings_prefer(one, best)), best)
        others = [one for one in tried if one is not best and not self._is_same(one, best)]
        return best, [one for one in others if not self._readings_prefer(best, one)]

    def _twins(self, found: _Hypothesis) -> list[Pose]:
        """Return where else the rig may be, by the motions that repeat what its first photo shows there."""
        first = self._photos[0]
        camera = Camera(first.query.intrinsics, _pose_of(found.world_from_rig, first))
        twins = self._index.repetitions.twins(camera, self._reach)
        return [Pose(twin.world_from_camera @ first.rig_from_camera.camera_from_world) for twin in twins]

    def _readings_prefer(self, one: _Hypothesis, other: _Hypothesis) -> bool:
        """Return whether what a device measured beside the first photo decides for the first of two hypotheses."""
        first = self._photos[0]
        poses = [_pose_of(found.world_from_rig, first) for found in (one, other)]
        return prefers(first.query.scene_priors, poses[0], None, poses[1], None)

    def _is_sure(self, found: _Hypothesis) -> bool:
        config = self._config
        return found.inliers >= max(config.min_inliers, config.min_inlier_share * found.matches)

    def _is_same(self, one: _Hypothesis, best: _Hypothesis) -> bool:
        """Return whether the best pose explains most matches of another one, which then has only not settled."""
        if not one.agreeing:
            return False
        explained = 0
        for photo, matches in zip(self._photos, one.agreeing, strict=True):
            pose = _pose_of(best.world_from_rig, photo)
            error_px = reprojection_error_px(matches.photo_px, matches.points_in_world, matches.intrinsics, pose)
            explained += int((error_px < self._config.same_errors * matches.max_error_px).sum())
        return explained >= self._config.same_share * one.inliers

    def _likeliest(self) -> Pose:
        """Return the rig's pose with its first photo at the view most like it: an answer where nothing matches."""
        retrieval, photo = self._retrievals[0], self._photos[0]
        view = self._index.views[top_indices(retrieval.scores(retrieval.upright_variant()), 1)[0]]
        return Pose(view.camera.pose.world_from_camera @ photo.rig_from_camera.camera_from_world)

    def _hypotheses(self, views: int, factor: float) -> Iterator[tuple[Pose, int]]:
        """Match each photo with views; yield poses of the rig and how many matches agree with each.

        First that which most matches of all agree with, then those which many matches with one view led to, then the
        best ones of the matches that agree with none before.
        """
        matches, starts = [], []
        for photo, retrieval, support in zip(self._photos, self._retrievals, self._support(), strict=True):
            self._check()
            variant = retrieval.rotated_variant(retrieval.upright_variant()).scaled(factor)
            features = retrieval.features(variant)
            chosen = retrieval.ranked(variant, views, support=self._config.support * support)
            parts = [correspondences(features, self._index.views[i], self._loaded.matcher) for i in chosen]
            matches.append(_matches(photo, Correspondences.pooled(parts), variant.max_error_px))
            starts += self._starts(photo, parts, variant.max_error_px)
        # By chance more of all matches agree with any pose than of those with one view with the right one.
        starts.sort(key=lambda start: -start[1])
        for number in range(self._config.hypotheses):
            found = estimate_rig_pose(matches, self._config.trials, [] if number else [pose for pose, _ in starts])
            if found is None:
                return
            yield found.world_from_rig, found.num_inliers
            if not number:
                yield from starts[: self._config.hypotheses]
            matches = [_chosen(one, ~agree) for one, agree in zip(matches, found.inliers, strict=True)]

    def _starts(self, photo: RigPhoto, parts: Sequence[Correspondences], error_px: float) -> list[tuple[Pose, int]]:
        """Return poses of the rig that the matches of a photo with one view lead to, and how many of them agree."""
        found = []
        for part in parts:
            one = _matches(photo, part, error_px)
            alone = estimate_absolute_pose(
                one.photo_px, one.points_in_world, one.intrinsics, one.max_error_px, self._config.view_trials
            )
            if alone is not None and alone.num_inliers >= self._config.view_inliers:
                pose = Pose(alone.pose.world_from_camera @ photo.rig_from_camera.camera_from_world)
                found.append((pose, alone.num_inliers))
        return found

    def _support(self) -> Float64[np.ndarray, "photos views"]:
        """Return for each photo how much the other photos speak for each view: a view of another photo that puts this
        one's camera near it counts with its score, the best of each."""
        if self._supported is None:
            views = np.stack([view.camera.pose.world_from_camera for view in self._index.views])
            scores = [one.scores(one.upright_variant()) for one in self._retrievals]
            found = np.zeros((len(scores), len(views)))
            for own, photo in zip(found, self._photos, strict=True):
                for other, given in zip(self._photos, scores, strict=True):
                    if other is photo:
                        continue
                    between = other.rig_from_camera.camera_from_world @ photo.rig_from_camera.world_from_camera
                    own += (_nearness(views @ between, views, self._reach) * given[:, None]).max(0)
            self._supported = found
        return self._supported

    def _rematched(self, pose: Pose) -> _Hypothesis:
        """Render each photo at the pose, match, and solve all again; no matches agree where that fails."""
        inliers, count, information, agreeing = 0, 0, np.zeros((6, 6)), ()
        for _ in range(self._config.rematches):
            matches = []
            for photo, images in zip(self._photos, self._images, strict=True):
                self._check()
                view = self._renderer.at(photo.query, _pose_of(pose, photo)).view(images.matcher)
                fresh = correspondences(images.features(), view, images.matcher)
                matches.append(_matches(photo, fresh, self._config.rematch_error_px))
            count = sum(len(one.photo_px) for one in matches)
            # The pose that the renders were made at is tried, too: RANSAC may draw none as good.
            again = estimate_rig_pose(matches, self._config.trials, [pose])
            if again is None:
                return _Hypothesis(pose, 0, count, np.zeros((6, 6)))
            settled = again.num_inliers < (1 + self._config.settled_gain) * inliers
            pose, inliers = again.world_from_rig, again.num_inliers
            self._add("rematch_rig", pose, inliers)
            agreeing = tuple(_chosen(one, agree) for one, agree in zip(matches, again.inliers, strict=True))
            information = match_information(matches, again)
            if settled or inliers < self._config.hopeless_inliers:
                break
        return _Hypothesis(pose, inliers, count, information, agreeing)

    # ------------------------------------------------------------------ records

    def _check(self) -> None:
        """Raise Cancelled if the request is."""
        if self._request.cancel is not None and self._request.cancel.is_set():
            raise Cancelled

    def _add(self, stage: str, world_from_rig: Pose, inliers: int | None) -> None:
        record = IterationRecord(
            stage,
            _pose_of(world_from_rig, self._photos[0]),
            num_inliers=inliers,
            index=len(self._records),
            elapsed_s=self._clock.wall_s,
            cpu_s=self._clock.cpu_s,
        )
        self._records.append(record)
        self._report(record)


def _nearness(
    a: Float64[np.ndarray, "n 4 4"], b: Float64[np.ndarray, "m 4 4"], reach: float
) -> Float64[np.ndarray, "n m"]:
    """Return how near poses are, 1 to 0: by half a radian, or half of the distance to what is seen, 0.4."""
    turn = np.arccos(np.clip((np.einsum("iab,jab->ij", a[:, :3, :3], b[:, :3, :3]) - 1) / 2, -1, 1))
    way = np.linalg.norm(a[:, None, :3, 3] - b[None, :, :3, 3], axis=2)
    return np.exp(-((turn / 0.5) ** 2) - (way / (0.5 * reach)) ** 2)


def _pose_of(world_from_rig: Pose, photo: RigPhoto) -> Pose:
    return moved(Pose(world_from_rig.world_from_camera @ photo.rig_from_camera.world_from_camera), np.zeros(6))


def _matches(photo: RigPhoto, found: Correspondences, error_px: float) -> RigMatches:
    """Return matches for the solver; `error_px` is at PHOTO_PX."""
    lens = photo.query.intrinsics
    return RigMatches(
        found.photo_px, found.points_in_world, lens, photo.rig_from_camera, error_px * lens.long_side / PHOTO_PX
    )


def _chosen(matches: RigMatches, keep: Bool[np.ndarray, "m"]) -> RigMatches:
    return replace(matches, photo_px=matches.photo_px[keep], points_in_world=matches.points_in_world[keep])
