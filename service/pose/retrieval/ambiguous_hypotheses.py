"""Other poses that may explain a photo as well: of symmetric and repeated things one photo can't decide.

    views like the photo, from elsewhere than the answer -> matches that the answer doesn't explain -> do many agree on
    another pose?

This costs a few matchings of the photo's and the views' strongest features. The poses found are hypotheses: whoever
asks refines and verifies them, and compares their residuals with the answer's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from service.geometry import pose_distance, reprojection_error_px
from service.interfaces import Features, Matcher
from service.pose.absolute_pose.pnp import AbsolutePose, estimate_absolute_pose
from service.pose.features.rendered_views import View
from service.pose.matching.correspondences import Correspondences, correspondences
from service.pose.retrieval.scores import top_indices
from service.types import Intrinsics, Pose


@dataclass(frozen=True, slots=True)
class AmbiguityConfig:
    """How ambiguous hypotheses are searched."""

    views: int = 6
    """Views from elsewhere that the photo is matched with."""
    features: int = 400
    """Of the photo and of a view, the strongest."""
    same_view_deg: float = 25.0
    same_view_share: float = 0.35
    """Views nearer to the answer (degrees; share of the distance to what they see) show what it shows."""
    explained_factor: float = 3.0
    """Times the error of an inlier, within which the answer explains a match."""
    max_hypotheses: int = 3
    min_inliers: int = 15
    """Matches that agree on a hypothesis; by chance up to 9 do."""
    min_inliers_if_explained: int = 40
    """The same where the answer explains the whole photo."""
    trials: int = 200
    """Of RANSAC, for each hypothesis."""
    distinct_deg: float = 5.0
    distinct_share: float = 0.02
    """Poses nearer to each other (degrees; share of the distance to what is seen) are one answer."""


AMBIGUITY = AmbiguityConfig()


@dataclass(frozen=True, slots=True)
class PoseAtDistance:
    """A pose that explains an image at least in part."""

    pose: Pose
    distance: float
    """Median distance to what it sees, scene units."""

    def differs_from(self, other: Pose, config: AmbiguityConfig = AMBIGUITY) -> bool:
        """Return whether the two poses are different answers."""
        angle, way = pose_distance(self.pose, other)
        return angle > config.distinct_deg or way > config.distinct_share * self.distance


def ambiguous_hypotheses(
    image: Features,
    intrinsics: Intrinsics,
    answer: PoseAtDistance,
    views: Sequence[View],
    scores: np.ndarray,
    matcher: Matcher,
    max_error_px: float,
    min_inliers: int,
    config: AmbiguityConfig = AMBIGUITY,
) -> Iterator[AbsolutePose]:
    """Yield poses that differ from the answer and that many matches agree on, most first.

    `scores` are the views' retrieval scores; `image` and `max_error_px` are in pixels of the intrinsics.
    """
    # Views near the answer show the same thing, and would only confirm it.
    elsewhere = (i for i in top_indices(scores, len(scores)) if not _shows_the_same(views[i], answer.pose, config))
    chosen = list(islice(elsewhere, config.views))
    if not chosen:
        return
    strong = _strongest(image, config.features)
    found = [correspondences(strong, _strongest_of(views[i], config.features), matcher) for i in chosen]
    # Wider than an inlier's error: what the answer nearly explains is no evidence for another pose.
    explained_px = config.explained_factor * max_error_px
    left = _unexplained(Correspondences.pooled(found), intrinsics, answer.pose, explained_px)
    for _ in range(config.max_hypotheses):
        other = estimate_absolute_pose(left.photo_px, left.points_in_world, intrinsics, max_error_px, config.trials)
        if other is None or other.num_inliers < min_inliers:
            return
        if answer.differs_from(other.pose, config):
            yield other
        # The next hypothesis has to rest on matches of its own.
        left = _unexplained(left, intrinsics, other.pose, explained_px)


def _shows_the_same(view: View, answer: Pose, config: AmbiguityConfig) -> bool:
    angle, way = pose_distance(view.camera.pose, answer)
    if angle > config.same_view_deg or len(view.points_in_world) == 0:
        return False
    # A sample is enough for a median.
    seen = view.points_in_world[::8] - view.camera.pose.position_in_world
    return way < config.same_view_share * float(np.median(np.linalg.norm(seen, axis=1)))


def _strongest(features: Features, count: int) -> Features:
    keep = np.argsort(-features.scores, kind="stable")[:count]
    return Features(features.points_px[keep], features.scores[keep], features.descriptors[keep])


def _strongest_of(view: View, count: int) -> View:
    keep = np.argsort(-view.features.scores, kind="stable")[:count]
    return View(view.camera, _strongest(view.features, count), view.points_in_world[keep])


def _unexplained(found: Correspondences, intrinsics: Intrinsics, pose: Pose, within_px: float) -> Correspondences:
    """Return the matches that the pose doesn't explain."""
    keep = reprojection_error_px(found.photo_px, found.points_in_world, intrinsics, pose) > within_px
    return Correspondences(found.photo_px[keep], found.view_px[keep], found.points_in_world[keep])
