"""The default estimator: recognise the photo among rendered views, resect, align. Needs no prior.

    features of the photo -> views that look like it (VLAD) -> matches, lifted to 3D -> PnP
    -> while few agree: render there, match again -> align photometrically on two renders -> verification gate

Only if the gate doesn't accept the answer the dearer search is tried: a vote of features instead of VLAD, with the
photo turned by quarters. A prior pose is one more candidate view. Sizes and rounds are the research's;
numbers that were measured stand beside the constants.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from service.errors import InvalidOptions
from service.geometry import pose_distance
from service.interfaces import Features, Tools
from service.pose.alignment import align
from service.pose.focal import WIDER, focal_resection, refine
from service.pose.gate import verify
from service.pose.index import ViewIndex, prepared_index
from service.pose.pnp import Resection, resection
from service.pose.retrieval import top, vlad, vote
from service.pose.views import (
    PHOTO_PX,
    Correspondences,
    View,
    correspondences,
    photo_at,
    photo_features,
    rendered_frame,
    rendered_view,
)
from service.types import EXACT, Camera, Candidates, IterationRecord, MatchVectors, Pose, Query, Status

MATCH_ERROR_PX = 4.0
"""At PHOTO_PX; XFeat's points scatter by 1.5 px."""
REMATCH_ERROR_PX = 3.0
GOOD_MATCH = 60
"""Inliers with one view that make further views needless."""
CHANCE = 15
"""Fewer inliers with a render at the pose are chance: photos of other scenes have 6 to 12."""
STRONG = 150
"""Inliers with which alignment needs no further match."""
TURN_BIAS = (1.0, 0.77, 0.77, 0.77)
"""On turned photos the right turn has 1.3 to 6 times the votes of the others, on upright ones at least 0.83."""
SETTLED_PX = 0.3
"""Where alignment moved what is seen by less, another render would be the same."""
SETTLED_DEG, SETTLED_SHARE = 0.3, 0.005
"""A rematch that moves the pose by less (share: of the distance to what is seen) is the last."""


REMATCHES, ALIGNMENTS = 3, 4
"""Rounds of rendering at the pose and matching, or aligning, with that; at most."""


@dataclass(frozen=True, slots=True)
class Options:
    candidates: int = 5
    """Index views that the photo is matched with in one search, 1 to 64."""
    escalate: bool = True
    """Search again by a vote of features, photo turned, where the verification gate doesn't accept the answer."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "use_attribute_docstrings": True}

    def __post_init__(self) -> None:
        if not 1 <= self.candidates <= 64:
            raise InvalidOptions(f"must lie in 1..64, is {self.candidates}.", where="candidates")


def prepare(tools: Tools, cache_dir: Path | None) -> ViewIndex:
    """Make or read the scene's view index: a second or two, once."""
    return prepared_index(tools, cache_dir)


def run(query: Query, tools: Tools, options: Options) -> Iterator[IterationRecord]:
    """Search until the gate accepts an answer; see the module's picture."""
    answer: tuple[IterationRecord, float] | None = None
    for search in _searches(query, tools, options):
        last: IterationRecord | None = None
        for last in search:
            yield last if answer is None else _with_pose_of(answer[0], last)
        if last is None or (answer and last.stage != "align"):
            continue  # the search gave up
        verdict = verify(query.corrected(last.lens), last.pose, tools)
        if answer is None or verdict.score > answer[1]:
            answer = last, verdict.score
        final = IterationRecord("verify", last.pose, loss=1.0 - answer[1], num_inliers=verdict.inliers)
        yield _with_pose_of(answer[0], final)
        if verdict.status is Status.LOCALIZED:
            return


def _with_pose_of(answer: IterationRecord, record: IterationRecord) -> IterationRecord:
    return replace(record, pose=answer.pose, lens=answer.lens)


def _searches(query: Query, tools: Tools, options: Options) -> Iterator[Iterator[IterationRecord]]:
    """The ways to look for the photo in the index, cheapest first."""
    index: ViewIndex = tools.prepared
    photo = photo_features(query, tools)
    upright = index.vectors @ vlad(photo.descriptors, index.words)
    yield _search("retrieve", photo, upright, query, tools, options)
    if not options.escalate:
        return
    features = [photo, *(photo_features(query, tools, quarter_turns) for quarter_turns in (1, 2, 3))]
    votes = [vote(f.descriptors, [view.features.descriptors for view in index.views]) for f in features]
    likeliest = int(np.argmax([v.max() * bias for v, bias in zip(votes, TURN_BIAS, strict=True)]))
    yield _search("turn" if likeliest else "vote", features[likeliest], votes[likeliest], query, tools, options)


def _search(
    stage: str, photo: Features, scores: np.ndarray, query: Query, tools: Tools, options: Options
) -> Iterator[IterationRecord]:
    """Go from scored views to an aligned pose; end early where too few matches agree."""
    index: ViewIndex = tools.prepared
    chosen = top(scores, options.candidates)
    views = [index.views[i] for i in chosen]
    poses = np.stack([view.camera.pose.world_from_camera for view in views])
    candidates = Candidates(poses, scores[chosen].astype(np.float64))
    yield IterationRecord(stage, query.prior or views[0].camera.pose, candidates=candidates)
    if query.prior and stage == "retrieve":
        views.insert(0, rendered_view(query.prior, query, tools)[0])
    found = yield from _matched(photo, views, query, tools)
    if found and found.num_inliers < STRONG:
        found = yield from _rematched(found, query, tools)
    if found:
        yield from _aligned(found, query, tools)


def _matched(
    photo: Features, views: Sequence[View], query: Query, tools: Tools
) -> Generator[IterationRecord, None, Resection | None]:
    """Match the photo with one view after the other until one explains it; else with all of them together."""
    best: Resection | None = None
    seen: list[Correspondences] = []
    for view in views:
        seen.append(correspondences(photo, view, tools.matcher))
        found = _resected(seen[-1], query, MATCH_ERROR_PX, 500)
        if found and (best is None or found.num_inliers > best.num_inliers):
            best = found
        yield _match_record("match", best or views[0].camera.pose, seen[-1], found, view.camera)
        if best and best.num_inliers >= GOOD_MATCH:
            return best
    pooled = Correspondences.pooled(seen)
    together = _resected(pooled, query, MATCH_ERROR_PX, 2000)
    if together and (best is None or together.num_inliers > best.num_inliers):
        best = together
    if best is None:
        return None
    count = len(pooled.photo_px)
    yield IterationRecord("pool", best.pose, best.lens, num_matches=count, num_inliers=best.num_inliers)
    return best


def _rematched(found: Resection, query: Query, tools: Tools) -> Generator[IterationRecord, None, Resection | None]:
    """Render at the pose and match with that: a right pose gains matches, a chance one has none there."""
    photo = photo_features(query, tools)
    for _ in range(REMATCHES):
        view, _ = rendered_view(found.pose, query.corrected(found.lens), tools)
        matches = correspondences(photo, view, tools.matcher)
        again = _resected(matches, query, REMATCH_ERROR_PX, 500, near=found)
        if again is None or again.num_inliers < CHANCE:
            return None
        step_deg, step_units = pose_distance(found.pose, again.pose)
        distance = np.median(np.linalg.norm(view.points_in_world - again.pose.position_in_world, axis=1))
        found = again
        record = _match_record("rematch", found, matches, found, view.camera)
        yield replace(record, step_deg=step_deg, step_units=step_units)
        if step_deg < SETTLED_DEG and step_units < SETTLED_SHARE * distance:
            break
    return found


def _aligned(found: Resection, query: Query, tools: Tools) -> Iterator[IterationRecord]:
    """Align on a render, render at the result, align again, until a new render would be the same."""
    pose, camera, lens = found.pose, None, found.lens
    for round_number in range(ALIGNMENTS):
        frame, new_camera = rendered_frame(pose, query.corrected(lens), tools, SETTLED_PX if camera else 1.0)
        if new_camera is camera:
            return
        camera = new_camera
        size = camera.intrinsics
        start = Camera(query.intrinsics.resized(size.width, size.height), pose)
        levels = 2 if round_number or found.num_inliers >= GOOD_MATCH else 4
        photo = photo_at(query, tools, size)
        result = align(photo, frame, camera, start, levels, lens, query.focal_sigma)
        if not np.isfinite(result.loss):
            return
        step_deg, step_units = pose_distance(pose, result.pose)
        pose, lens = result.pose, result.lens
        yield IterationRecord(
            "align",
            pose,
            lens,
            result.loss,
            num_inliers=found.num_inliers,
            step_deg=step_deg,
            step_units=step_units,
        )


def _resected(
    matches: Correspondences, query: Query, max_error_px: float, max_trials: int, near: Resection | None = None
) -> Resection | None:
    """Resect with the photo's focal length, or with the best one if that is approximate; `near` saves the search."""
    pixels = max_error_px * query.intrinsics.long_side / PHOTO_PX
    given = (matches.photo_px, matches.points_in_world)
    if not query.focal_sigma:
        return resection(*given, query.intrinsics, pixels, max_trials)
    if near is None:
        return focal_resection(*given, query.intrinsics, query.focal_sigma, pixels)
    found = resection(*given, query.intrinsics.corrected(near.lens), WIDER * pixels, max_trials)
    if found is None:
        return None
    return refine(*given, query.intrinsics, replace(found, lens=near.lens), query.focal_sigma, pixels)


def _match_record(
    stage: str, best: Resection | Pose, matches: Correspondences, found: Resection | None, camera: Camera
) -> IterationRecord:
    inlier = found.inlier if found else np.zeros(len(matches.photo_px), bool)
    return IterationRecord(
        stage,
        best if isinstance(best, Pose) else best.pose,
        EXACT if isinstance(best, Pose) else best.lens,
        num_matches=len(inlier),
        num_inliers=int(inlier.sum()),
        matches=MatchVectors.sample(matches.photo_px, matches.view_px, inlier, camera),
    )
