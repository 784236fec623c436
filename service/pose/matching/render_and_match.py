"""Match the photo with a render of the same size: what every method that renders and matches in turns needs.

Of the same size, because learned features stand little change of scale: on fern and materials, matching 256-px
renders with the 512-px photo found 10 and 18 right matches in the median, with the 256-px photo 42 and 89.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from service.interfaces import Features, Frame, ImageMatcher, Rasterizer
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import View, backprojected, in_batches, to_uint8, views_of
from service.pose.matching.correspondences import Correspondences, correspondences
from service.results import IterationRecord, MatchVectors
from service.types import NO_CORRECTION, Camera, Intrinsics, IntrinsicsCorrection, Pose, Query


def render_and_match(
    cameras: Sequence[Camera], rasterizer: Rasterizer, images: QueryImages, image_matcher: ImageMatcher | None = None
) -> Iterator[tuple[Correspondences, View]]:
    """Render, match with the photo, and backproject; yield what each camera, with the photo's intrinsics, gives.

    Each is rendered when it is asked for, with as many others as the renderer prefers. With an image matcher the two
    images are matched as they are, without features of each.
    """
    for some in in_batches(cameras, rasterizer.cameras_at_once):
        frames = rasterizer.render(some)
        if image_matcher:
            pairs = zip(frames, some, strict=True)
            yield from (_matched_images(frame, camera, image_matcher, images) for frame, camera in pairs)
            continue
        for view in views_of(frames, some, images.matcher):
            features = images.features(view.camera.intrinsics.long_side)
            yield correspondences(features, view, images.matcher), view


def _matched_images(
    frame: Frame, camera: Camera, matcher: ImageMatcher, images: QueryImages
) -> tuple[Correspondences, View]:
    pairs = matcher.match_images(images.resized(camera.intrinsics), to_uint8(frame.rgb))
    # A point of the render carries its partner in the photo where a feature has its description.
    view = backprojected(Features(pairs.b_px, pairs.confidence, pairs.a_px), frame, camera)
    partners = view.features.descriptors * _photo_scale(camera.intrinsics, images.query)
    return Correspondences(partners, view.features.points_px, view.points_in_world), view


def _photo_scale(size: Intrinsics, query: Query) -> Float32[np.ndarray, "2"]:
    return np.array([query.rgb.shape[1] / size.width, query.rgb.shape[0] / size.height], np.float32)


def match_record(
    stage: str,
    pose: Pose,
    matches: Correspondences,
    inlier: np.ndarray,
    camera: Camera,
    loss: float | None = None,
    correction: IntrinsicsCorrection = NO_CORRECTION,
) -> IterationRecord:
    """Return the record of a step that matched the photo with the view of `camera`."""
    return IterationRecord(
        stage,
        pose,
        correction,
        loss,
        num_matches=len(inlier),
        num_inliers=int(inlier.sum()),
        matches=MatchVectors.sample(matches.photo_px, matches.view_px, inlier, camera),
    )


def epipolar_inliers(matches: Correspondences, intrinsics: Intrinsics) -> Bool[np.ndarray, "m"]:
    """Return which matches one fundamental matrix explains; none where none does, or there are fewer than eight."""
    none = np.zeros(len(matches.photo_px), bool)
    if len(none) < 8:
        return none
    # OpenCV's threshold: a pixel of an image whose long side is 256, whatever the photo's size.
    photo, view = (np.asarray(px, np.float64) for px in (matches.photo_px, matches.view_px))
    try:
        _, mask = cv2.findFundamentalMat(photo, view, cv2.USAC_MAGSAC, intrinsics.long_side / 256, 0.999, 2000)
    except cv2.error:  # OpenCV 5.0 asserts that it has a model, now and then when it has none (icomma on chair)
        return none
    return none if mask is None else mask.ravel() > 0
