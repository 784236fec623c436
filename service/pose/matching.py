"""Match the photo with a render of the same size: what every method that renders and matches in turns needs.

Of the same size, because learned features stand little change of scale: on fern and materials, matching 256-px
renders with the 512-px photo found 10 and 18 right matches in the median, with the 256-px photo 42 and 89.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool

from service.interfaces import Features, Rasterizer, Tools
from service.pose.views import (
    PHOTO_FEATURES,
    VIEW_FEATURES,
    Correspondences,
    View,
    correspondences,
    lifted,
    photo_at,
    to_uint8,
)
from service.types import Camera, Intrinsics, IterationRecord, MatchVectors, Pose, Query


def render_and_match(
    camera: Camera, rasterizer: Rasterizer, query: Query, tools: Tools
) -> tuple[Correspondences, View]:
    """Render, find features, lift them and match; `camera` has the photo's lens at any size."""
    (frame,) = rasterizer.render([camera])
    view = lifted(tools.matcher.extract(to_uint8(frame.rgb), VIEW_FEATURES), frame, camera)
    return correspondences(_photo_features(camera, query, tools), view, tools.matcher), view


def match_record(
    stage: str, pose: Pose, matches: Correspondences, inlier: np.ndarray, camera: Camera, loss: float | None = None
) -> IterationRecord:
    """Return the record of a step that matched."""
    return IterationRecord(
        stage,
        pose,
        loss=loss,
        num_matches=len(inlier),
        num_inliers=int(inlier.sum()),
        matches=MatchVectors.sample(matches.photo_px, matches.view_px, inlier, camera),
    )


def _photo_features(camera: Camera, query: Query, tools: Tools) -> Features:
    """Return the features of the photo at the camera's size, in pixels of `Query.rgb`; once a job."""
    size = camera.intrinsics
    key = ("photo_features_at", size.width, size.height)
    if key not in tools.memo:
        found = tools.matcher.extract(photo_at(query, tools, size), PHOTO_FEATURES)
        scale = np.array([query.rgb.shape[1] / size.width, query.rgb.shape[0] / size.height], np.float32)
        tools.memo[key] = Features(found.points_px * scale, found.scores, found.descriptors)
    return tools.memo[key]


def epipolar_inliers(matches: Correspondences, intrinsics: Intrinsics) -> Bool[np.ndarray, "m"]:
    """Return which matches one fundamental matrix explains; none where there are fewer than eight."""
    if len(matches.photo_px) < 8:
        return np.zeros(len(matches.photo_px), bool)
    photo, view = (np.asarray(px, np.float64) for px in (matches.photo_px, matches.view_px))
    _, mask = cv2.findFundamentalMat(photo, view, cv2.USAC_MAGSAC, intrinsics.long_side / 256, 0.999, 2000)
    return np.zeros(len(photo), bool) if mask is None else mask.ravel() > 0
