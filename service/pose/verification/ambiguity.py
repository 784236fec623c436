"""Does another place explain the photo as well? Of symmetric and repeated things one photo can't tell.

    views that look like the photo, seen from elsewhere than the answer -> matches that the answer doesn't explain
    -> do many agree on another pose?

Costs a few small matchings, for which the photo's and the views' strongest features are enough. What is found are
suspicions: whoever asks aligns them, has the gate judge them, and compares what remains unexplained.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from itertools import islice

import numpy as np

from service.geometry import pose_distance, reprojection_error_px
from service.interfaces import Features, Matcher
from service.pose.absolute_pose.pnp import AbsolutePose, estimate_absolute_pose
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.features.rendered_views import View
from service.pose.matching.correspondences import MATCH_ERROR_PX, Correspondences, correspondences
from service.pose.retrieval.scores import top, vote
from service.results import Candidates, IterationRecord
from service.types import Intrinsics, Pose

VIEWS = 6
FEATURES = 400
"""Of the photo and of a view, the strongest."""
ALIKE_DEG, ALIKE_SHARE = 25.0, 0.35
"""Views so near to the answer (share: of the distance to what they see) show what it shows."""
EXPLAINED = 3.0
"""Times the error of an inlier, within which the answer explains a match."""
MOST = 3
LEAST, MANY = 15, 40
"""Matches on which a suspicion rests: by chance up to 9 agree. A pose that explains the whole photo has no rival with
less than many."""
REPEATED = 30
"""Matches of a view that agree on another pose, in a scene that repeats itself: chair,
materials, templeRing and fountain have views with 35 to 124, studio, fox and fern none with more than 24."""
MOST_VIEWS, EVERY = 128, 2
"""Views of a scene that are looked through for that, every second one: 10 ms each, and more the more there are."""
WHOLE = {"gradients": 0.95, "colours": 0.98}
"""Signals of a pose that explains the whole photo; of clean photos some have less gradients."""
TRIALS = 200
APART_DEG, APART_SHARE = 5.0, 0.02
"""Answers nearer to one another (share: of the distance to what is seen) are one answer."""
DECISIVE = 10.0
"""An answer whose mean residual is 15 % less than another's is four times as probable: that much varies, from place to
place, how well a scene is modelled."""
NEGLIGIBLE = 0.02


def rivals(
    photo: Features,
    intrinsics: Intrinsics,
    answer: Pose,
    distance: float,
    signals: Mapping[str, float],
    views: Sequence[View],
    scores: np.ndarray,
    matcher: Matcher,
    max_error_px: float,
) -> Iterator[AbsolutePose]:
    """Yield poses apart from the answer on which matches agree, most first.

    `distance` is that from the answer to what it sees, `signals` are the gate's of it; `scores` say which views are
    like the photo. `photo` and `max_error_px` are in pixels of the intrinsics.
    """
    elsewhere = (i for i in top(scores, len(scores)) if not _alike(views[i], answer))
    chosen = list(islice(elsewhere, VIEWS))
    if not chosen:
        return
    strong = _strongest(photo)
    found = [correspondences(strong, _with_strongest(views[i]), matcher) for i in chosen]
    left = _unexplained(Correspondences.pooled(found), intrinsics, answer, EXPLAINED * max_error_px)
    least = MANY if whole(signals) else LEAST
    for _ in range(MOST):
        rival = estimate_absolute_pose(left.photo_px, left.points_in_world, intrinsics, max_error_px, TRIALS)
        if rival is None or rival.num_inliers < least:
            return
        if apart(rival.pose, answer, distance):
            yield rival
        left = _unexplained(left, intrinsics, rival.pose, EXPLAINED * max_error_px)


def whole(signals: Mapping[str, float]) -> bool:
    """Tell whether a pose with these signals of the gate explains the whole photo."""
    return all(signals[name] > value for name, value in WHOLE.items())


def repeats_itself(views: Sequence[View], matcher: Matcher, pool: Executor) -> bool:
    """Tell whether what a view of the scene shows is seen elsewhere; of a large scene that is taken for granted."""
    if len(views) > MOST_VIEWS:
        return True
    return any(pool.map(lambda view: _is_seen_elsewhere(view, views, matcher), views[::EVERY]))


def _is_seen_elsewhere(view: View, views: Sequence[View], matcher: Matcher) -> bool:
    if len(view.points_in_world) == 0:
        return False
    lens, pose = view.camera.intrinsics, view.camera.pose
    distance = float(np.median(np.linalg.norm(view.points_in_world - pose.position_in_world, axis=1)))
    votes = vote(view.features.descriptors, [other.features.descriptors for other in views])
    error_px = MATCH_ERROR_PX * lens.long_side / PHOTO_PX
    suspicious = dict.fromkeys(WHOLE, 0.0)  # then few matches are enough
    found = rivals(view.features, lens, pose, distance, suspicious, views, votes, matcher, error_px)
    return any(rival.num_inliers >= REPEATED for rival in found)


def apart(one: Pose, other: Pose, distance: float) -> bool:
    """Tell whether two poses are two answers; `distance` (scene units) is that to what they see."""
    angle, way = pose_distance(one, other)
    return angle > APART_DEG or way > APART_SHARE * distance


def ranked(answers: Sequence[IterationRecord]) -> tuple[IterationRecord, Candidates | None]:
    """Return the answer that leaves least unexplained, and the others with their probabilities if one of all is right.

    The records are alignments', whose loss is the mean residual. Others that are out of the question are left out.
    """
    ordered = sorted(answers, key=lambda record: record.loss or np.inf)
    losses = np.array([record.loss for record in ordered], np.float64)
    weights = (losses / losses[0]) ** -DECISIVE
    share = weights / weights.sum()
    kept = [i for i in range(1, len(ordered)) if share[i] > NEGLIGIBLE]
    if not kept:
        return ordered[0], None
    return ordered[0], Candidates(np.stack([ordered[i].pose.world_from_camera for i in kept]), share[kept])


def _alike(view: View, answer: Pose) -> bool:
    angle, way = pose_distance(view.camera.pose, answer)
    if angle > ALIKE_DEG or len(view.points_in_world) == 0:
        return False
    seen = view.points_in_world[::8] - view.camera.pose.position_in_world
    return way < ALIKE_SHARE * float(np.median(np.linalg.norm(seen, axis=1)))


def _strongest(features: Features) -> Features:
    keep = np.argsort(-features.scores, kind="stable")[:FEATURES]
    return Features(features.points_px[keep], features.scores[keep], features.descriptors[keep])


def _with_strongest(view: View) -> View:
    keep = np.argsort(-view.features.scores, kind="stable")[:FEATURES]
    features = view.features
    kept = Features(features.points_px[keep], features.scores[keep], features.descriptors[keep])
    return View(view.camera, kept, view.points_in_world[keep])


def _unexplained(found: Correspondences, intrinsics: Intrinsics, pose: Pose, within_px: float) -> Correspondences:
    """Return the matches that the pose doesn't explain."""
    keep = reprojection_error_px(found.photo_px, found.points_in_world, intrinsics, pose) > within_px
    return Correspondences(found.photo_px[keep], found.view_px[keep], found.points_in_world[keep])
