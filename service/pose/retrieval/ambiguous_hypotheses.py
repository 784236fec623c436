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
    parts: int = 4
    """Along each side of the photo, of which each is matched with what the answer puts elsewhere: things of a row in
    half a photo lie a third of its width apart."""
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
    yield from _hypotheses(found, intrinsics, answer, max_error_px, min_inliers, config)


def shifted_hypotheses(
    image: Features,
    intrinsics: Intrinsics,
    answer: PoseAtDistance,
    views: Sequence[View],
    scores: np.ndarray,
    matcher: Matcher,
    max_error_px: float,
    config: AmbiguityConfig = AMBIGUITY,
) -> Iterator[AbsolutePose]:
    """Yield poses that show other things in the places of those that the answer shows, most matches first.

    One thing further along a row the camera is near the answer, and the views that show the place show the answer's,
    too: features match there. So each part of the image is matched only with what the answer puts elsewhere.
    """
    strong = _strongest(image, config.features)
    size = np.array([intrinsics.width, intrinsics.height]) / config.parts
    place = np.clip(strong.points_px // size, 0, config.parts - 1)
    parts = [(size * (corner + 0.5), (place == corner).all(1)) for corner in np.unique(place, axis=0)]
    found = []
    for i in top_indices(scores, config.views):
        view = _strongest_of(views[i], config.features)
        for centre, within in parts:
            middle = np.broadcast_to(centre, (len(view.points_in_world), 2))
            distance = reprojection_error_px(middle, view.points_in_world, intrinsics, answer.pose)
            elsewhere = distance > 0.5 * np.linalg.norm(size)
            other = View(view.camera, _selected(view.features, elsewhere), view.points_in_world[elsewhere])
            found.append(correspondences(_selected(strong, within), other, matcher))
    if found:
        yield from _hypotheses(found, intrinsics, answer, max_error_px, config.min_inliers, config)


def _hypotheses(
    found: Sequence[Correspondences],
    intrinsics: Intrinsics,
    answer: PoseAtDistance,
    max_error_px: float,
    min_inliers: int,
    config: AmbiguityConfig,
) -> Iterator[AbsolutePose]:
    """Yield poses that many of the matches agree on which the answer doesn't explain."""
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
    return _selected(features, np.argsort(-features.scores, kind="stable")[:count])


def _selected(features: Features, keep: np.ndarray) -> Features:
    return Features(features.points_px[keep], features.scores[keep], features.descriptors[keep])


def _strongest_of(view: View, count: int) -> View:
    keep = np.argsort(-view.features.scores, kind="stable")[:count]
    return View(view.camera, _strongest(view.features, count), view.points_in_world[keep])


def _unexplained(found: Correspondences, intrinsics: Intrinsics, pose: Pose, within_px: float) -> Correspondences:
    """Return the matches that the pose doesn't explain."""
    keep = reprojection_error_px(found.photo_px, found.points_in_world, intrinsics, pose) > within_px
    return Correspondences(found.photo_px[keep], found.view_px[keep], found.points_in_world[keep])
