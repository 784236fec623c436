"""The stages of a search for a photo's pose: match it with views, render and match again, align.

Each is a generator that yields its records and returns what the next one begins with: the pose, the lens that goes with
it, and which matches agree.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from dataclasses import replace

import numpy as np

from service.geometry import pose_distance
from service.interfaces import Tools
from service.pose.absolute_pose.decoupled import DecoupledConfig, MatchedPoints, least_squares_solve
from service.pose.absolute_pose.pnp import AbsolutePose, estimate_absolute_pose
from service.pose.absolute_pose.prior_region import inside_prior, widened_prior
from service.pose.absolute_pose.unknown_focal import FOCAL_SEARCH, absolute_pose_unknown_focal, refine_with_intrinsics
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.features.rendered_views import View
from service.pose.features.views import known_at, photo_at, photo_features, rendered_frame, rendered_view
from service.pose.matching.correspondences import Correspondences, correspondences
from service.pose.refinement.photometric import refine_photometric
from service.pose.retrieval.image_variant import Sight
from service.results import IterationRecord, MatchVectors
from service.types import NO_CORRECTION, Camera, Pose, Query

REMATCH_ERROR_PX = 3.0
GOOD_MATCH = 60
"""Inliers with one view that make further views needless."""
CHANCE = 15
"""Fewer inliers with a render at the pose are chance: photos of other scenes have 6 to 12."""
SETTLED_PX = 0.3
"""Where alignment moved what is seen by less, another render would be the same."""
LENS_SETTLED_PX = 0.05
"""The same while the focal length is free: it hides behind the distance, and hardly moves what is seen."""
SETTLED_DEG, SETTLED_SHARE = 0.3, 0.005
"""A rematch that moves the pose by less (share: of the distance to what is seen) is the last."""
FIRST_ALIGNED_PX = 256
"""Long side of the first render that is aligned: it is as good as the big one at bringing the pose near."""
ASTRAY_DEG = 10.0
"""An alignment that turns the camera by more, away from a pose with many matches, is wrong."""
REMATCHES, ALIGNMENTS = 3, 4
"""Rounds of rendering at the pose and matching, or aligning, with that; at most."""
REMATCH_SOLVER = DecoupledConfig(steps=8)


def matched(
    sight: Sight, views: Iterable[View], query: Query, tools: Tools
) -> Generator[IterationRecord, None, AbsolutePose | None]:
    """Match the photo with one view after the other until one explains it; else with all of them together."""
    photo = sight.features(query, tools)
    best: AbsolutePose | None = None
    seen: list[Correspondences] = []
    for view in views:
        seen.append(correspondences(photo, view, tools.matcher))
        found = resected(seen[-1], query, sight.max_error_px, 500)
        if found and (best is None or found.num_inliers > best.num_inliers):
            best = found
        yield match_record("match", best or view.camera.pose, seen[-1], found, view.camera)
        if best and best.num_inliers >= GOOD_MATCH:
            return best
    pooled = Correspondences.pooled(seen)
    together = resected(pooled, query, sight.max_error_px, 2000)
    if together and (best is None or together.num_inliers > best.num_inliers):
        best = together
    if best is None:
        return None
    count = len(pooled.photo_px)
    yield IterationRecord("match_pooled", best.pose, best.correction, num_matches=count, num_inliers=best.num_inliers)
    return best


def refined(found: AbsolutePose, query: Query, tools: Tools) -> Iterator[IterationRecord]:
    """Match again, and align; where that goes astray the matches have the last word."""
    again = yield from rematched(found, query, tools)
    unsettled = (yield from aligned(again, query, tools)) if again else None
    if again and unsettled is again:
        yield IterationRecord("refine", again.pose, again.correction, num_inliers=again.num_inliers)


def rematched(found: AbsolutePose, query: Query, tools: Tools) -> Generator[IterationRecord, None, AbsolutePose | None]:
    """Render at the pose and match with that: a right pose gains matches, a chance one has none there."""
    photo = photo_features(query, tools)
    for _ in range(REMATCHES):
        view, _ = rendered_view(found.pose, query.corrected(found.correction), tools)
        matches = correspondences(photo, view, tools.matcher)
        again = solved_near(found, matches, query)
        if again is None or again.num_inliers < CHANCE:
            return None
        step_deg, step_units = pose_distance(found.pose, again.pose)
        distance = np.median(np.linalg.norm(view.points_in_world - again.pose.position_in_world, axis=1))
        found = again
        record = match_record("rematch", found, matches, found, view.camera)
        yield replace(record, step_deg=step_deg, step_units=step_units)
        if step_deg < SETTLED_DEG and step_units < SETTLED_SHARE * distance:
            break
    return found


def aligned(found: AbsolutePose, query: Query, tools: Tools) -> Generator[IterationRecord, None, AbsolutePose | None]:
    """Align on a render, render at the result, align again, until a new render would be the same.

    Returns where to match again: where a free lens and the distance have come to if they creep along together for too
    long, where it began if it goes astray.
    """
    pose, camera, lens = found.pose, None, found.correction
    for round_number in range(ALIGNMENTS + bool(query.focal_sigma)):
        settled = LENS_SETTLED_PX if query.focal_sigma else SETTLED_PX
        size_px = FIRST_ALIGNED_PX if camera is None and not query.focal_sigma else None
        frame, new_camera = rendered_frame(pose, query.corrected(lens), tools, settled if camera else 1.0, size_px)
        if new_camera is camera:
            return None
        if round_number == ALIGNMENTS:
            return replace(found, pose=pose, correction=lens)
        camera = new_camera
        size = camera.intrinsics
        start = Camera(query.intrinsics.resized(size.width, size.height), pose)
        levels = 2 if round_number or found.num_inliers >= GOOD_MATCH else 4
        photo = photo_at(query, tools, size)
        known = known_at(query, tools, size)
        result = refine_photometric(
            photo, frame, camera, start, levels, lens, query.focal_sigma, known, coarse=bool(size_px)
        )
        tools.memo["aligned"] = result  # for the gate
        astray = found.num_inliers >= GOOD_MATCH and pose_distance(found.pose, result.pose)[0] > ASTRAY_DEG
        if astray or not np.isfinite(result.loss):
            return found if found.num_inliers >= GOOD_MATCH else None
        step_deg, step_units = pose_distance(pose, result.pose)
        pose, lens = result.pose, result.correction
        yield IterationRecord(
            "refine",
            pose,
            lens,
            result.loss,
            num_inliers=found.num_inliers,
            step_deg=step_deg,
            step_units=step_units,
        )


def resected(matches: Correspondences, query: Query, max_error_px: float, max_trials: int) -> AbsolutePose | None:
    """Resect with the photo's focal length, or with the best one if that is approximate."""
    pixels = max_error_px * query.intrinsics.long_side / PHOTO_PX
    given = (matches.photo_px, matches.points_in_world)
    if query.focal_sigma:
        found = absolute_pose_unknown_focal(*given, query.intrinsics, query.focal_sigma, pixels)
    else:
        found = estimate_absolute_pose(*given, query.intrinsics, pixels, max_trials)
    return found if found and _possible(found.pose, matches, query) else None


def solved_near(near: AbsolutePose, matches: Correspondences, query: Query) -> AbsolutePose | None:
    """Solve the matches with a render at a pose: decoupled from there; by PnP, and refined, if the lens is free."""
    if query.focal_sigma:
        pixels = REMATCH_ERROR_PX * query.intrinsics.long_side / PHOTO_PX
        lens = query.intrinsics.corrected(near.correction)
        found = estimate_absolute_pose(
            matches.photo_px, matches.points_in_world, lens, FOCAL_SEARCH.error_factor * pixels, 500
        )
        if found:
            found = replace(found, correction=near.correction)
            given = (matches.photo_px, matches.points_in_world)
            found = refine_with_intrinsics(*given, query.intrinsics, found, query.focal_sigma, pixels)
    elif len(matches.photo_px) < REMATCH_SOLVER.min_points:
        return None
    else:
        points = matches.points_in_world.astype(np.float64)
        centre = np.median(points, axis=0)
        given = MatchedPoints(matches.photo_px.astype(np.float64), points, query.intrinsics, centre)
        solved = least_squares_solve(given, near.pose, REMATCH_SOLVER)
        found = AbsolutePose(solved.pose, solved.inlier, near.correction)
    return found if found and _possible(found.pose, matches, query) else None


def _possible(pose: Pose, matches: Correspondences, query: Query) -> bool:
    """Tell whether the photo's region may hold what the pose leads to."""
    if query.region is None:
        return True
    distance = np.median(np.linalg.norm(matches.points_in_world - pose.position_in_world, axis=1))
    return inside_prior(widened_prior(query.region, float(distance)), pose)


def match_record(
    stage: str, best: AbsolutePose | Pose, matches: Correspondences, found: AbsolutePose | None, camera: Camera
) -> IterationRecord:
    """Return what is told of a matching; `best` is the answer so far, `found` what these matches agree on."""
    inlier = found.inlier if found else np.zeros(len(matches.photo_px), bool)
    return IterationRecord(
        stage,
        best if isinstance(best, Pose) else best.pose,
        NO_CORRECTION if isinstance(best, Pose) else best.correction,
        num_matches=len(inlier),
        num_inliers=int(inlier.sum()),
        matches=MatchVectors.sample(matches.photo_px, matches.view_px, inlier, camera),
    )
