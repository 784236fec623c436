"""Which of several scenes does a photo show? The photo is compared with all their indexes, and localized in the best.

    photo's features -> in each scene: the views most like it -> matches -> how many agree on one camera?
    -> the scene with most is searched, and those that have half as many, too; after them the next, until one is right

Only the verification gate says whether the photo shows a scene at all: where it accepts none, the result is the best
of those that were searched, and says `not_localized` or `uncertain`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from service.interfaces import Tools
from service.localize import DEFAULT_ESTIMATOR, LoadedScene, Request, localize
from service.pose.absolute_pose.pnp import estimate_absolute_pose
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.features.views import photo_features
from service.pose.matching.correspondences import correspondences
from service.pose.retrieval.index import ViewIndex
from service.pose.retrieval.scores import top
from service.results import IterationRecord, PoseEstimate, StageTiming, Status
from service.types import Query

VIEWS = 3
"""Of each scene, that the photo is matched with."""
MAX_ERROR_PX, APPROXIMATE_ERROR_PX = 4.0, 12.0
"""At PHOTO_PX; the second with a focal length that is not exact."""
TRIALS = 300
CHANCE = 15
"""With fewer matches that agree in every scene, the photo may be turned."""
SEARCHED = 3
"""Scenes at most."""
RIVAL = 0.5
"""A scene with this share of the best one's matches is searched, too, whatever the best one's result."""


@dataclass(frozen=True, slots=True)
class Found:
    estimate: PoseEstimate
    loaded: LoadedScene
    """The scene of the estimate."""


def localize_anywhere(
    query: Query,
    scenes: Sequence[LoadedScene],
    request: Request | None = None,
    on_record: Callable[[IterationRecord], None] | None = None,
) -> Found:
    """Find the scene that a photo shows, and the pose in it; as `localize` otherwise.

    The records of the scene that is returned are told when it is certain. The budget is one for all scenes; those
    for which it doesn't suffice are not searched.
    """
    request = request or Request()
    wall, cpu = time.perf_counter(), time.thread_time()
    supports = _supports(query, scenes)
    order = np.argsort(-supports, kind="stable")
    looked = StageTiming("scene_ranking", time.perf_counter() - wall, time.thread_time() - cpu)
    found: list[Found] = []
    for i in order[:SEARCHED]:
        right = any(f.estimate.verdict.status is Status.LOCALIZED for f in found)
        if right and supports[i] < RIVAL * supports[order[0]]:
            break
        left = None if request.budget_s is None else request.budget_s - (time.perf_counter() - wall)
        if found and left is not None and left <= 0:
            break
        limited = replace(request, budget_s=None if left is None else max(left, 1e-3))
        found.append(Found(localize(query, scenes[i], limited), scenes[i]))
    best = max(found, key=lambda f: (f.estimate.verdict.status is Status.LOCALIZED, f.estimate.verdict.score))
    considered = tuple((scenes[i].scene.info.id, int(supports[i])) for i in order)
    others = tuple(t for f in found if f is not best for t in f.estimate.timings)
    elsewhere = StageTiming("elsewhere", sum(t.wall_s for t in others), sum(t.cpu_s for t in others))
    timings = (looked, *([elsewhere] if others else []), *best.estimate.timings)
    if on_record:
        for record in best.estimate.records:
            on_record(record)
    return Found(replace(best.estimate, timings=timings, considered=considered), best.loaded)


def _supports(query: Query, scenes: Sequence[LoadedScene]) -> np.ndarray:
    """Return for each scene how many matches with one of its views agree; turned photos are tried if none has many."""
    memo: dict[Any, Any] = {}  # the photo's features are the same for all
    best = np.zeros(len(scenes), int)
    for quarter_turns in range(4):
        counts = [_support(query, loaded, quarter_turns, memo) for loaded in scenes]
        best = np.maximum(best, counts)
        if best.max() >= CHANCE:
            break
    return best


def _support(query: Query, loaded: LoadedScene, quarter_turns: int, memo: dict[Any, Any]) -> int:
    index: ViewIndex = loaded.prepare(DEFAULT_ESTIMATOR)
    tools = Tools(loaded.scene, loaded.rasterizer, loaded.matcher, np.random.default_rng(0), index, memo)
    photo = photo_features(query, tools, eighths=2 * quarter_turns)
    pixels = (APPROXIMATE_ERROR_PX if query.focal_sigma else MAX_ERROR_PX) * query.intrinsics.long_side / PHOTO_PX
    most = 0
    for i in top(index.votes(photo.descriptors), VIEWS):
        matches = correspondences(photo, index.views[i], loaded.matcher)
        agreed = estimate_absolute_pose(matches.photo_px, matches.points_in_world, query.intrinsics, pixels, TRIALS)
        most = max(most, agreed.num_inliers if agreed else 0)
    return most
