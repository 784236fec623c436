"""Renders with their features lifted to 3D, and the photo's own features: what matching works with.

A job computes each of them once: they are kept in the job's `Tools.memo`, where the gate finds the photo's
features and the last render of the estimator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from service.geometry import reprojection_error_px, transformed, unproject
from service.interfaces import Features, Frame, Matcher, Rasterizer, Tools
from service.types import Camera, Intrinsics, Pose, Query, frozen

SIZE_MULTIPLE_PX = 32
"""Learned matchers want sides of this multiple; other sizes they would resample once more."""
RENDER_PX = 416
"""Long side of the renders that are matched and aligned: the dilation is scaled, so small is not biased."""
LENS_RENDER_PX = 640
"""The same where the photo's focal length is free: hidden behind the distance, it asks for more pixels (58 photos:
median error 0.14 % with 416, 0.08 % with 640)."""
PHOTO_PX = 416
MATCH_ERROR_PX = 4.0
"""At PHOTO_PX; XFeat's points scatter by 1.5 px."""
PHOTO_FEATURES = 2048
VIEW_FEATURES = 800
MARGIN_PX = 6
"""From what is unknown: features there are of its edge."""
MAX_DEPTH_RANGE = 0.06
"""Relative, over 3x3 pixels: a feature on a depth edge has no certain place."""
MIN_ALPHA = 0.5


@dataclass(frozen=True, slots=True)
class View:
    """A place from which the scene was rendered, and the features that were found and lifted there."""

    camera: Camera
    features: Features
    points_in_world: Float32[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True)
class Correspondences:
    """Matches between the photo and a view, surest first, with the scene points behind them."""

    photo_px: Float32[np.ndarray, "m 2"]
    """In pixels of `Query.rgb`."""
    view_px: Float32[np.ndarray, "m 2"]
    points_in_world: Float32[np.ndarray, "m 3"]

    @classmethod
    def pooled(cls, parts: Sequence[Correspondences]) -> Correspondences:
        """Put the matches with several views together, by their rank; `view_px` then refers to none of the views."""
        by_rank = np.argsort(np.concatenate([np.arange(len(part.photo_px)) for part in parts]), kind="stable")
        return cls(
            np.concatenate([part.photo_px for part in parts])[by_rank],
            np.concatenate([part.view_px for part in parts])[by_rank],
            np.concatenate([part.points_in_world for part in parts])[by_rank],
        )


def sized(intrinsics: Intrinsics, long_side: int) -> Intrinsics:
    """Return the camera at about this size, both sides multiples of 32."""
    factor = long_side / intrinsics.long_side / SIZE_MULTIPLE_PX
    width, height = (SIZE_MULTIPLE_PX * max(1, round(side * factor)) for side in (intrinsics.width, intrinsics.height))
    return intrinsics.resized(width, height)


def photo_at(query: Query, tools: Tools, size: Intrinsics) -> UInt8[np.ndarray, "h w 3"]:
    """Return the photo resampled; area averages when it shrinks, so nothing aliases."""
    key = ("photo", size.width, size.height)
    if key not in tools.memo:
        shrinks = size.width * size.height < query.rgb.shape[0] * query.rgb.shape[1]
        mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        tools.memo[key] = np.asarray(cv2.resize(query.rgb, (size.width, size.height), interpolation=mode))
    return tools.memo[key]


def known_at(query: Query, tools: Tools, size: Intrinsics) -> Bool[np.ndarray, "h w"] | None:
    """Return where the resampled photo is known, pixels that mix with unknown ones left out; None: everywhere."""
    if query.known is None:
        return None
    key = ("known", size.width, size.height)
    if key not in tools.memo:
        share = cv2.resize(query.known.astype(np.float32), (size.width, size.height), interpolation=cv2.INTER_AREA)
        tools.memo[key] = np.asarray(share) > 0.99
    return tools.memo[key]


def photo_features(query: Query, tools: Tools, long_side: int = PHOTO_PX, eighths: int = 0) -> Features:
    """Return the photo's features, found at this size, in pixels of `Query.rgb`.

    The photo is turned counter-clockwise by `eighths` of a turn before its features are described (learned
    descriptors stand some 30 degrees of roll); their places are still given in the photo as it is.
    """
    key = ("photo_features", long_side, eighths)
    if key not in tools.memo:
        size = sized(query.intrinsics, long_side)
        rgb, known = photo_at(query, tools, size), known_at(query, tools, size)
        turned, turned_from_photo = _turned(rgb, eighths)
        found = tools.matcher.extract(turned, PHOTO_FEATURES)
        points = (found.points_px - turned_from_photo[:, 2]) @ turned_from_photo[:, :2]
        keep = _well_inside(points, known, size, bool(eighths % 2))
        scale = np.array([query.rgb.shape[1] / size.width, query.rgb.shape[0] / size.height])
        tools.memo[key] = Features(
            (points[keep] * scale).astype(np.float32), found.scores[keep], found.descriptors[keep]
        )
    return tools.memo[key]


def _turned(
    rgb: UInt8[np.ndarray, "h w 3"], eighths: int
) -> tuple[UInt8[np.ndarray, "_ _ 3"], Float64[np.ndarray, "2 3"]]:
    """Return the image turned about its middle on a canvas that holds it, and where its pixels went."""
    height, width = rgb.shape[:2]
    if eighths % 8 == 0:
        return rgb, np.eye(2, 3)
    cosine, sine = np.cos(eighths * np.pi / 4), np.sin(eighths * np.pi / 4)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    extent = np.abs(rotation) @ [width, height]
    canvas = (np.ceil(extent / SIZE_MULTIPLE_PX - 1e-6) * SIZE_MULTIPLE_PX).astype(int)
    shift = canvas / 2 - rotation @ [width / 2, height / 2]
    # OpenCV counts from the centre of the first pixel.
    shift_cv = shift - 0.5 + rotation @ [0.5, 0.5]
    matrix = np.concatenate([rotation, shift_cv[:, None]], 1)
    turned = cv2.warpAffine(rgb, matrix, (int(canvas[0]), int(canvas[1])), flags=cv2.INTER_LINEAR)
    return np.asarray(turned), np.concatenate([rotation, shift[:, None]], 1)


def _well_inside(
    points: Float64[np.ndarray, "n 2"], known: Bool[np.ndarray, "h w"] | None, size: Intrinsics, cut: bool
) -> Bool[np.ndarray, "n"]:
    """Return which points lie away from what is unknown and, if the image's edges became lines in it, from those."""
    keep = np.ones(len(points), bool)
    if cut:
        keep &= ((points > MARGIN_PX) & (points < np.array([size.width, size.height]) - MARGIN_PX)).all(1)
    if known is not None:
        around = np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8)
        safe = cv2.erode(known.astype(np.uint8), around, borderType=cv2.BORDER_REPLICATE) > 0
        column, row = np.clip(points.astype(int), 0, [size.width - 1, size.height - 1]).T
        keep &= safe[row, column]
    return keep


def view_from(camera: Camera, rasterizer: Rasterizer, matcher: Matcher) -> View:
    """Render, find features, lift them."""
    (frame,) = rasterizer.render([camera])
    return lifted(matcher.extract(to_uint8(frame.rgb), VIEW_FEATURES), frame, camera)


def rendered_frame(
    pose: Pose, query: Query, tools: Tools, tolerance_px: float = 1.0, long_side: int | None = None
) -> tuple[Frame, Camera]:
    """Return the render with the photo's intrinsics; the job's last one if hardly anything moved since."""
    long_side = long_side or (LENS_RENDER_PX if query.focal_sigma else RENDER_PX)
    camera = Camera(sized(query.intrinsics, long_side), pose)
    last: tuple[Frame, Camera] | None = tools.memo.get("last_frame")
    if last and _nearly_seen(*last, camera, tolerance_px):
        return last
    tools.memo["last_frame"] = tools.rasterizer.render([camera])[0], camera
    return tools.memo["last_frame"]


def rendered_view(pose: Pose, query: Query, tools: Tools) -> tuple[View, Frame]:
    """Return `rendered_frame` with its features."""
    frame, camera = rendered_frame(pose, query, tools)
    last: View | None = tools.memo.get("last_view")
    if last is None or last.camera is not camera:
        found = _features_of(frame, camera.intrinsics, tools.matcher)
        last = tools.memo["last_view"] = lifted(found, frame, camera)
    return last, frame


def _features_of(frame: Frame, lens: Intrinsics, matcher: Matcher) -> Features:
    """Return a render's features, found at RENDER_PX: in a larger one they would be finer than the photo's."""
    rgb, size = to_uint8(frame.rgb), sized(lens, RENDER_PX)
    if size.width * size.height >= lens.width * lens.height:
        return matcher.extract(rgb, VIEW_FEATURES)
    found = matcher.extract(
        np.asarray(cv2.resize(rgb, (size.width, size.height), interpolation=cv2.INTER_AREA)), VIEW_FEATURES
    )
    scale = np.array([lens.width / size.width, lens.height / size.height], np.float32)
    return replace(found, points_px=found.points_px * scale)


def _nearly_seen(frame: Frame, camera: Camera, now: Camera, tolerance_px: float) -> bool:
    """Would what the frame shows be seen by the camera of now within the tolerance of where it is?"""
    if now.pose is camera.pose and now.intrinsics == camera.intrinsics:
        return True
    height, width = frame.alpha.shape
    if (width, height) != (now.intrinsics.width, now.intrinsics.height):
        return False
    row, column = (grid.ravel() for grid in np.mgrid[4:height:16, 4:width:16])
    depth = frame.median_depth[row, column]
    px = np.stack([column, row], 1)[depth > 0] + 0.5
    if len(px) == 0:
        return False
    points = transformed(camera.pose.world_from_camera, unproject(px, depth[depth > 0], camera.intrinsics))
    error = reprojection_error_px(px, points, now.intrinsics, now.pose)
    return bool((error < tolerance_px).mean() > 0.9)


def lifted(features: Features, frame: Frame, camera: Camera) -> View:
    """Keep the features on opaque, smooth surface and give each its place in the world."""
    height, width = frame.alpha.shape
    column = np.clip(features.points_px[:, 0].astype(int), 1, width - 2)
    row = np.clip(features.points_px[:, 1].astype(int), 1, height - 2)
    around = np.stack([frame.median_depth[row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)], 1)
    nearest, farthest = around.min(1, initial=np.inf), around.max(1, initial=0.0)
    smooth = (nearest > 0) & (farthest - nearest < MAX_DEPTH_RANGE * nearest)
    keep = np.flatnonzero(smooth & (frame.alpha[row, column] > MIN_ALPHA))
    points = unproject(features.points_px[keep], np.median(around[keep], axis=1), camera.intrinsics)
    return View(
        camera,
        Features(features.points_px[keep], features.scores[keep], features.descriptors[keep]),
        frozen(transformed(camera.pose.world_from_camera, points), np.float32),
    )


def correspondences(photo: Features, view: View, matcher: Matcher) -> Correspondences:
    """Match the photo with a view."""
    pairs = matcher.match(photo, view.features)
    a, b = pairs[:, 0], pairs[:, 1]
    return Correspondences(photo.points_px[a], view.features.points_px[b], view.points_in_world[b])


def to_uint8(rgb: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return a render as a photo has it."""
    return np.asarray(cv2.convertScaleAbs(np.maximum(rgb, 0), alpha=255.0))
