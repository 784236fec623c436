"""Two facts about a scene, computed from its view index: does it repeat itself, and is it like its mirror image?

Only where it does has an answer to be compared with other places, only where it is can a mirrored photo pass for a
photo of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from service.interfaces import Frame, Matcher, Rasterizer
from service.pose.absolute_pose.pnp import estimate_absolute_pose
from service.pose.features.image_sizes import scaled_px
from service.pose.features.mirrored_query import mirrored_intrinsics
from service.pose.features.rendered_views import VIEWS, View, to_uint8
from service.pose.matching.correspondences import MATCH_ERROR_PX, correspondences
from service.pose.retrieval.ambiguous_hypotheses import AMBIGUITY, PoseAtDistance, ambiguous_hypotheses
from service.pose.retrieval.scores import retrieval_scores, top_indices


@dataclass(frozen=True, slots=True)
class SymmetryConfig:
    """How much of the index is examined, and how many matches decide."""

    max_views: int = 128
    """A larger scene is taken to repeat itself: examining it takes 10 ms a view, and more the more views there are."""
    every: int = 2
    """Of the views, every second one is compared with the others."""
    min_repeated_inliers: int = 30
    """Matches of a view that agree on another pose, in a scene that repeats itself: chair, materials, templeRing and
    fountain have views with 35 to 124, studio, fox and fern none with more than 24."""
    mirror_probes: int = 4
    mirror_tries: int = 2
    """Views whose mirror images are looked for, and the views that each is matched with."""
    mirror_trials: int = 500
    """Of RANSAC."""
    min_mirror_inliers: int = 60
    """Matches on which the median mirrored view must agree: of the test scenes chair, materials and fountain have 130
    to 250, templeRing has 42, those without a symmetry 10 to 20."""


SYMMETRY = SymmetryConfig()


def repeats_itself(views: Sequence[View], matcher: Matcher, pool: Executor, config: SymmetryConfig = SYMMETRY) -> bool:
    """Return whether what some view of the scene shows is seen from another pose, too."""
    if len(views) > config.max_views:
        return True
    # Repetition is mutual: of two views that look alike at least one is likely among them.
    examined = views[:: config.every]
    return any(pool.map(lambda view: _is_seen_elsewhere(view, views, matcher, config), examined))


def _is_seen_elsewhere(view: View, views: Sequence[View], matcher: Matcher, config: SymmetryConfig) -> bool:
    if len(view.points_in_world) == 0:
        return False
    intrinsics, pose = view.camera.intrinsics, view.camera.pose
    scores = retrieval_scores(view.features.descriptors, [other.features.descriptors for other in views])
    error_px = scaled_px(MATCH_ERROR_PX, intrinsics)
    # The view's own pose is the answer that others are compared with.
    own = PoseAtDistance(pose, view.distance)
    found = ambiguous_hypotheses(
        view.features, intrinsics, own, views, scores, matcher, error_px, AMBIGUITY.min_inliers
    )
    return any(other.num_inliers >= config.min_repeated_inliers for other in found)


def like_its_mirror_image(
    views: Sequence[View],
    rasterizer: Rasterizer,
    matcher: Matcher,
    pool: Executor,
    config: SymmetryConfig = SYMMETRY,
) -> bool:
    """Return whether mirrored renders of the scene are localized in it."""
    if not views:
        return False
    # Spread over the index, whose views are spread over the scene.
    probes = np.unique(np.linspace(0, len(views) - 1, config.mirror_probes).astype(int))
    frames = rasterizer.render([views[i].camera for i in probes])
    inliers = pool.map(lambda i, frame: _mirrored_inliers(views[i], frame, views, matcher, config), probes, frames)
    return float(np.median(list(inliers))) >= config.min_mirror_inliers


def _mirrored_inliers(view: View, frame: Frame, views: Sequence[View], matcher: Matcher, config: SymmetryConfig) -> int:
    """Return how many matches of a mirrored view with one of the others agree on a pose, at most."""
    intrinsics = mirrored_intrinsics(view.camera.intrinsics)
    # Mirroring the image changes its features, so they can't be taken from the index.
    features = matcher.extract(np.ascontiguousarray(to_uint8(frame.rgb)[:, ::-1]), VIEWS.max_features)
    scores = retrieval_scores(features.descriptors, [other.features.descriptors for other in views])
    error_px = scaled_px(MATCH_ERROR_PX, intrinsics)
    most = 0
    for i in top_indices(scores, config.mirror_tries):
        found = correspondences(features, views[i], matcher)
        pose = estimate_absolute_pose(found.photo_px, found.points_in_world, intrinsics, error_px, config.mirror_trials)
        most = max(most, pose.num_inliers if pose else 0)
    return most
