"""Is the photo mirrored? Phones' front cameras mirror, and a symmetric thing's mirror image passes for the thing.

How well such a photo fits does not always tell: of 26 mirrored photos of the test scenes `chair` and `materials` the
gate's tints refuse all but one, and don't say why. But their mirror images fit better still. So where a scene is much
like its mirror image, which is found out once with the index, the photo is looked for both ways, unless it fits so well
that there is no doubt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from service.interfaces import Tools
from service.pose.absolute_pose.pnp import estimate_absolute_pose
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.features.rendered_views import VIEW_FEATURES, View, to_uint8
from service.pose.matching.correspondences import MATCH_ERROR_PX, correspondences
from service.pose.retrieval.scores import top, vote
from service.pose.verification.appearance import APPEARANCE
from service.types import Intrinsics, Query

PROBES, TRIES = 4, 2
"""Views whose mirror images are looked for, and the views each is matched with."""
LIKE = 60
"""Matches on which a mirrored view's median must agree: of the test scenes chair, materials and fountain have 130 to
250, templeRing has 42, those without a symmetry 10 to 20."""
TRIALS = 500
BEYOND_DOUBT = 0.99
"""Agreement of gradients that no mirrored photo reaches (0.985 seen), but of the others, spoilt ones too, 79 % on chair
and 56 % on materials do."""
OUT_OF_REACH = 2.0
"""Times the answer's residual, after one alignment: of mirrored photos the mirror image has 0.6 to 1.6, of half of the
others more than 3."""


def mirrored(query: Query) -> Query:
    """Return the mirror image of the photo, and of its camera."""
    known = None if query.known is None else query.known[:, ::-1]
    lens, whole = _mirrored_lens(query.intrinsics), _mirrored_lens(query.photo_intrinsics)
    return replace(query, rgb=query.rgb[:, ::-1], known=known, intrinsics=lens, photo_intrinsics=whole)


def like_its_mirror_image(views: Sequence[View], tools: Tools, pool: Executor) -> bool:
    """Tell whether mirrored views of the scene are recognised in it."""
    if not views:
        return False
    probes = np.unique(np.linspace(0, len(views) - 1, PROBES).astype(int))
    return float(np.median(list(pool.map(lambda i: _recognised(views[i], views, tools), probes)))) >= LIKE


def unlikeness(signals: Mapping[str, float]) -> float:
    """Return how unlike photo and render are by the gate's signals, 0 (alike) and more."""
    return sum(1.0 - signals[name] for name in (*APPEARANCE, "tints"))


def _recognised(view: View, views: Sequence[View], tools: Tools) -> int:
    """Return on how many matches of a mirrored view with one of the others a pose agrees."""
    (frame,) = tools.rasterizer.render([view.camera])
    lens = _mirrored_lens(view.camera.intrinsics)
    found = tools.matcher.extract(np.ascontiguousarray(to_uint8(frame.rgb)[:, ::-1]), VIEW_FEATURES)
    votes = vote(found.descriptors, [other.features.descriptors for other in views])
    most = 0
    for i in top(votes, TRIES):
        matches = correspondences(found, views[i], tools.matcher)
        error_px = MATCH_ERROR_PX * lens.long_side / PHOTO_PX
        pose = estimate_absolute_pose(matches.photo_px, matches.points_in_world, lens, error_px, TRIALS)
        most = max(most, pose.num_inliers if pose else 0)
    return most


def _mirrored_lens(lens: Intrinsics) -> Intrinsics:
    return replace(lens, cx=lens.width - lens.cx)
