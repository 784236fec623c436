"""Localization in several scenes: rank them by how many matches with the photo agree, then localize in the best.

    photo's features -> in each scene: the views most like it -> matches -> how many agree with one camera?
    -> the scene with most is searched, and those with half as many, too; then the next, until one is localized

Only the verification gate decides whether the photo shows a scene at all: where it accepts none, the result is the best
of those that were searched, and its status is `not_localized` or `uncertain`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int64

from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.localize import Request, localize
from service.pose.absolute_pose.pnp import estimate_absolute_pose
from service.pose.features.image_sizes import scaled_px
from service.pose.features.query_images import QueryImages
from service.pose.matching.correspondences import MATCH_ERROR_PX, correspondences
from service.pose.retrieval.index import ViewIndex
from service.pose.retrieval.scores import top_indices
from service.results import IterationRecord, PoseEstimate, StageTiming, Status
from service.types import Query


@dataclass(frozen=True, slots=True)
class SceneRankingConfig:
    """How scenes are ranked, and which are searched."""

    views: int = 3
    """Of each scene, that the photo is matched with."""
    max_error_px: float = MATCH_ERROR_PX
    approximate_max_error_px: float = 12.0
    """Reprojection error of an inlier at PHOTO_PX; the second with approximate intrinsics."""
    trials: int = 300
    """Of RANSAC."""
    min_inliers: int = 15
    """With fewer in every scene the photo may be rotated; fewer agree by chance."""
    max_searched: int = 3
    """Scenes that are searched."""
    similar_share: float = 0.5
    """A scene with this share of the best one's inliers is searched, too, whatever the best one's result."""


SCENE_RANKING = SceneRankingConfig()


@dataclass(frozen=True, slots=True)
class SceneEstimate:
    """A photo's pose in one of the scenes."""

    estimate: PoseEstimate
    loaded: LoadedScene


def localize_in_scenes(
    query: Query,
    scenes: Sequence[LoadedScene],
    request: Request | None = None,
    on_record: Callable[[IterationRecord], None] | None = None,
    config: SceneRankingConfig = SCENE_RANKING,
) -> SceneEstimate:
    """Find the scene that a photo shows, and the pose in it; otherwise as `localize`.

    The records of the scene that is returned are reported once it is certain. The budget in seconds is one for all
    scenes, and those for which it doesn't suffice are not searched; a budget in renders holds for each scene.
    """
    request = request or Request()
    wall, cpu = time.perf_counter(), time.thread_time()
    inliers = _inliers_by_scene(query, scenes, config)
    order = np.argsort(-inliers, kind="stable")
    ranking = StageTiming("scene_ranking", time.perf_counter() - wall, time.thread_time() - cpu)
    found: list[SceneEstimate] = []
    for i in order[: config.max_searched]:
        localized = any(f.estimate.verdict.status is Status.LOCALIZED for f in found)
        # Similar rooms are distinguished by verification, not by the number of matches.
        if localized and inliers[i] < config.similar_share * inliers[order[0]]:
            break
        left = None if request.budget_s is None else request.budget_s - (time.perf_counter() - wall)
        if found and left is not None and left <= 0:
            break
        # A budget of 0 would end before the first record.
        limited = replace(request, budget_s=None if left is None else max(left, 1e-3))
        found.append(SceneEstimate(localize(query, scenes[i], limited), scenes[i]))
    # Every localized answer ranks before those that aren't, whatever their scores.
    best = max(found, key=lambda f: (f.estimate.verdict.status is Status.LOCALIZED, f.estimate.verdict.score))
    scene_ranking = tuple((scenes[i].scene.info.id, int(inliers[i])) for i in order)
    others = tuple(t for f in found if f is not best for t in f.estimate.timings)
    rest = [StageTiming("other_scenes", sum(t.wall_s for t in others), sum(t.cpu_s for t in others))] if others else []
    timings = (ranking, *rest, *best.estimate.timings)
    if on_record:
        for record in best.estimate.records:
            on_record(record)
    return SceneEstimate(replace(best.estimate, timings=timings, scene_ranking=scene_ranking), best.loaded)


def _inliers_by_scene(
    query: Query, scenes: Sequence[LoadedScene], config: SceneRankingConfig
) -> Int64[np.ndarray, "scenes"]:
    """Return how many matches with a view of each scene agree; rotated photos are tried if none has enough."""
    # Features depend on the matcher, and are the same for all scenes that share one.
    images: dict[str, QueryImages] = {}
    for loaded in scenes:
        images.setdefault(loaded.matcher.name, QueryImages(query, loaded.matcher))
    best = np.zeros(len(scenes), np.int64)
    for quarter_turns in range(4):
        counts = [_inliers(images[loaded.matcher.name], loaded, 2 * quarter_turns, config) for loaded in scenes]
        best = np.maximum(best, counts)
        if best.max() >= config.min_inliers:
            break
    return best


def _inliers(images: QueryImages, loaded: LoadedScene, roll_steps_45deg: int, config: SceneRankingConfig) -> int:
    """Return how many matches with the most similar views agree with one camera, at most."""
    index: ViewIndex = loaded.prepare(DEFAULT_ESTIMATOR)
    features, query = images.features(roll_steps_45deg=roll_steps_45deg), images.query
    max_error_px = config.approximate_max_error_px if query.lens_prior else config.max_error_px
    pixels = scaled_px(max_error_px, query.intrinsics)
    scores = index.scores(features.descriptors)
    most = 0
    for i in top_indices(scores, config.views):
        matches = correspondences(features, index.views[i], loaded.matcher)
        found = estimate_absolute_pose(
            matches.photo_px, matches.points_in_world, query.intrinsics, pixels, config.trials
        )
        most = max(most, found.num_inliers if found else 0)
    return most
