"""The stages of a search that match: the photo with candidate views, and with a render at the pose found so far.

Each is a generator that yields a record a step and returns what the next stage starts from: a pose with the correction
of the intrinsics that belongs to it, and which matches agree with it.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from service.geometry import pose_distance
from service.interfaces import Features
from service.pose.absolute_pose.decoupled import DecoupledConfig, MatchedPoints, least_squares_solve
from service.pose.absolute_pose.pnp import AbsolutePose, estimate_absolute_pose
from service.pose.absolute_pose.prior_region import inside_prior, widened_prior
from service.pose.absolute_pose.unknown_lens import (
    LENS_SEARCH,
    absolute_pose_unknown_lens,
    refine_with_lens,
    without_distortion,
)
from service.pose.features.image_sizes import scaled_px
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import View, ViewRenderer
from service.pose.matching.correspondences import Correspondences, correspondences
from service.pose.matching.render_and_match import match_record
from service.results import IterationRecord
from service.types import NO_CORRECTION, Camera, LensPrior, Pose, Query


@dataclass(frozen=True, slots=True)
class MatchingConfig:
    """How candidate views and renders are matched."""

    sufficient_inliers: int = 60
    """Inliers with one view from which on no further view is matched. Of photos of other scenes 12 agree at most."""
    view_trials: int = 500
    """RANSAC trials for the matches with one view: 98 % certainty where one match in five is right."""
    pooled_trials: int = 2000
    """RANSAC trials for the matches with all views: 98 % certainty where one match in eight is right."""
    pool_views: bool = True
    """Whether the views' matches are solved together where no single view suffices."""
    min_inliers: int = 12
    min_inlier_share: float = 0.055
    """Inliers, and their share of the matches that they are among, from which on a render at the pose is made: of 168
    searches with fewer, 119 of them for photos of other scenes, none led to an answer; with 12 to 30 those have a
    median share of 0.04 to 0.05."""
    rematch_error_px: float = 3.0
    """Reprojection error of an inlier with a render at the pose, at PHOTO_PX."""
    min_rematch_inliers: int = 15
    """Inliers with a render at the pose: fewer are chance, photos of other scenes have 6 to 12."""
    conclusive_share: float = 0.7
    """Share of the matches that agree from which on a rematch is the last, whatever its step."""
    max_rematches: int = 3
    """Renders that are matched, one after the other."""
    settled_deg: float = 0.3
    settled_share: float = 0.005
    """A rematch that moves the pose by less (degrees; share of the distance to what is seen) is the last."""
    solver: Literal["decoupled", "pnp"] = "decoupled"
    """What solves the matches with a render where the focal length is known."""
    decoupled: DecoupledConfig = field(default_factory=lambda: DecoupledConfig(steps=8))
    """From a pose this near, fewer steps are enough."""

    def may_be_chance(self, found: AbsolutePose) -> bool:
        """Return whether as many matches agree by chance: that number grows with all matches, so a share counts."""
        return found.num_inliers < max(self.min_inliers, self.min_inlier_share * len(found.inlier))


MATCHING = MatchingConfig()


def match_candidates(
    features: Features,
    views: Iterable[View],
    images: QueryImages,
    max_error_px: float,
    config: MatchingConfig = MATCHING,
) -> Generator[IterationRecord, None, AbsolutePose | None]:
    """Match the photo with one view after the other until one suffices, else solve all matches together.

    `features` are the photo's, in the size and rotation of the search; `max_error_px` is at PHOTO_PX.
    """
    best: AbsolutePose | None = None
    # Matches with single views may be too few, and those with several agree with one pose.
    pooled: list[Correspondences] = []
    for view in views:
        matches = correspondences(features, view, images.matcher)
        if config.pool_views or not pooled:
            pooled.append(matches)
        found = solve_matches(matches, images.query, max_error_px, config.view_trials)
        if found and (best is None or found.num_inliers > best.num_inliers):
            best = found
        yield record_of(view.camera, matches, found, best, "match")
        if best and best.num_inliers >= config.sufficient_inliers:
            return best
    # No view suffices alone.
    together = Correspondences.pooled(pooled)
    found = solve_matches(together, images.query, max_error_px, config.pooled_trials)
    if found and (best is None or _pooled_is_better(found, best, config)):
        best = found
    if best is None:
        return None
    count = len(together.photo_px)
    yield IterationRecord("match_pooled", best.pose, best.correction, num_matches=count, num_inliers=best.num_inliers)
    return best


def _pooled_is_better(pooled: AbsolutePose, single: AbsolutePose, config: MatchingConfig) -> bool:
    """Return whether the matches of all views lead further than those of the best one, whose share may be greater."""
    if config.may_be_chance(pooled) and not config.may_be_chance(single):
        return False
    return pooled.num_inliers > single.num_inliers


@dataclass(frozen=True, slots=True)
class Rematch:
    """What matching with renders at a pose led to."""

    found: AbsolutePose | None
    """None: too few matches agree with a pose near the last one."""
    rounds: int
    """Renders with which enough matches agreed."""


def render_and_rematch(
    found: AbsolutePose, images: QueryImages, renderer: ViewRenderer, config: MatchingConfig = MATCHING
) -> Generator[IterationRecord, None, Rematch]:
    """Render at the pose, match with that, solve, and repeat until the pose settles.

    At a right pose more matches agree than with the view that led there, at a wrong one hardly any.
    """
    # In the photo's usual size: a render has its scale, whatever variant led to the pose.
    features = images.features()
    for rounds in range(config.max_rematches):
        view = renderer.at(images.query.corrected(found.correction), found.pose).view(images.matcher)
        matches = correspondences(features, view, images.matcher)
        again = solve_matches_near(found, matches, images.query, config)
        if again is None or again.num_inliers < config.min_rematch_inliers:
            return Rematch(None, rounds)
        step_deg, step_units = pose_distance(found.pose, again.pose)
        # Translation is judged relative to what is seen: scenes have any unit.
        distance = np.median(np.linalg.norm(view.points_in_world - again.pose.position_in_world, axis=1))
        found = again
        record = record_of(view.camera, matches, found, found, "rematch")
        yield replace(record, step_deg=step_deg, step_units=step_units)
        settled = step_deg < config.settled_deg and step_units < config.settled_share * distance
        # Where most matches agree refinement converges, whatever the last step was.
        if settled or found.num_inliers > config.conclusive_share * len(found.inlier):
            return Rematch(found, rounds + 1)
    return Rematch(found, config.max_rematches)


def solve_matches(matches: Correspondences, query: Query, max_error_px: float, max_trials: int) -> AbsolutePose | None:
    """Return the pose that most matches agree with, by PnP-RANSAC; with approximate intrinsics also their correction.

    `max_error_px` is at PHOTO_PX. None if there is no such pose, or the query's prior region excludes it.
    """
    pixels = scaled_px(max_error_px, query.intrinsics)
    given = (matches.photo_px, matches.points_in_world)
    if query.lens_prior:
        found = absolute_pose_unknown_lens(*given, query.intrinsics, query.lens_prior, pixels)
    else:
        found = estimate_absolute_pose(*given, query.intrinsics, pixels, max_trials)
    return found if found and _allowed_by_prior(found.pose, matches, query) else None


def solve_matches_near(
    near: AbsolutePose, matches: Correspondences, query: Query, config: MatchingConfig = MATCHING
) -> AbsolutePose | None:
    """Return the pose of the matches with a render at `near`: decoupled steps from there, or PnP.

    With approximate intrinsics PnP with those of `near`, refined together with the intrinsics.
    """
    if query.lens_prior:
        found = _solve_with_lens(near, matches, query, query.lens_prior, config)
    elif config.solver == "pnp":
        return solve_matches(matches, query, config.rematch_error_px, config.view_trials)
    elif len(matches.photo_px) < config.decoupled.min_points:
        return None
    else:
        points = matches.points_in_world.astype(np.float64)
        # Rotation about what is seen is independent of translation, about the camera it isn't.
        centre = np.median(points, axis=0)
        given = MatchedPoints(matches.photo_px.astype(np.float64), points, query.intrinsics, centre)
        solved = least_squares_solve(given, near.pose, config.decoupled)
        found = AbsolutePose(solved.pose, solved.inlier, near.correction)
    return found if found and _allowed_by_prior(found.pose, matches, query) else None


def _solve_with_lens(
    near: AbsolutePose, matches: Correspondences, query: Query, prior: LensPrior, config: MatchingConfig
) -> AbsolutePose | None:
    pixels = scaled_px(config.rematch_error_px, query.intrinsics)
    camera = query.intrinsics.corrected(near.correction)
    straight = without_distortion(matches.photo_px, query.intrinsics, near.correction)
    found = estimate_absolute_pose(
        straight, matches.points_in_world, camera, LENS_SEARCH.error_factor * pixels, config.view_trials
    )
    if found is None:
        return None
    found = replace(found, correction=near.correction)
    return refine_with_lens(matches.photo_px, matches.points_in_world, query.intrinsics, found, prior, pixels)


def _allowed_by_prior(pose: Pose, matches: Correspondences, query: Query) -> bool:
    """Return whether refinement from the pose may end inside the query's prior region."""
    if query.region is None:
        return True
    distance = np.median(np.linalg.norm(matches.points_in_world - pose.position_in_world, axis=1))
    return inside_prior(widened_prior(query.region, float(distance)), pose)


def record_of(
    camera: Camera, matches: Correspondences, found: AbsolutePose | None, best: AbsolutePose | None, stage: str
) -> IterationRecord:
    """Return the record of a matching step with the view of `camera`.

    `found` is what these matches agree on, `best` the best pose so far; without one the view's own is recorded.
    """
    inlier = found.inlier if found else np.zeros(len(matches.photo_px), bool)
    pose, correction = (best.pose, best.correction) if best else (camera.pose, NO_CORRECTION)
    return match_record(stage, pose, matches, inlier, camera, correction=correction)
