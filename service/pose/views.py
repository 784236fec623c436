"""Renders with their features lifted to 3D, and the photo's own features: what matching works with.

A job computes each of them once: they are kept in the job's `Tools.memo`, where the gate finds the photo's
features and the last render of the estimator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from service.geometry import transformed, unproject
from service.interfaces import Features, Frame, Matcher, Rasterizer, Tools
from service.pose.pnp import reprojection_error_px
from service.types import Camera, Intrinsics, Pose, Query, frozen

SIZE_MULTIPLE_PX = 32
"""Learned matchers want sides of this multiple; other sizes they would resample once more."""
RENDER_PX = 416
"""Long side of the renders that are matched and aligned: the dilation is scaled, so small is not biased."""
PHOTO_PX = 512
PHOTO_FEATURES = 2048
VIEW_FEATURES = 800
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
    """Matches between the photo and a view, with the scene points behind them."""

    photo_px: Float32[np.ndarray, "m 2"]
    """In pixels of `Query.rgb`."""
    view_px: Float32[np.ndarray, "m 2"]
    points_in_world: Float32[np.ndarray, "m 3"]

    @classmethod
    def pooled(cls, parts: Sequence[Correspondences]) -> Correspondences:
        """Put the matches with several views together; `view_px` then refers to none of them."""
        return cls(
            np.concatenate([part.photo_px for part in parts]),
            np.concatenate([part.view_px for part in parts]),
            np.concatenate([part.points_in_world for part in parts]),
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


def photo_features(query: Query, tools: Tools, quarter_turns: int = 0) -> Features:
    """Return the photo's features, in pixels of `Query.rgb`.

    With `quarter_turns` the photo is turned counter-clockwise before its features are described (learned
    descriptors stand some 40 degrees of roll); their places are still given in the photo as it is.
    """
    key = ("photo_features", quarter_turns)
    if key not in tools.memo:
        size = sized(query.intrinsics, PHOTO_PX)
        rgb = photo_at(query, tools, size)
        found = tools.matcher.extract(np.ascontiguousarray(np.rot90(rgb, quarter_turns)), PHOTO_FEATURES)
        points = _turned_back(found.points_px, quarter_turns, size.width, size.height)
        scale = np.array([query.rgb.shape[1] / size.width, query.rgb.shape[0] / size.height], np.float32)
        tools.memo[key] = Features(points * scale, found.scores, found.descriptors)
    return tools.memo[key]


def _turned_back(
    points: Float32[np.ndarray, "n 2"], quarter_turns: int, width: int, height: int
) -> Float32[np.ndarray, "n 2"]:
    """Return where points of the image turned counter-clockwise lie in the image of width x height."""
    x, y = points[:, 0], points[:, 1]
    match quarter_turns % 4:
        case 1:
            return np.stack([width - y, x], 1)
        case 2:
            return np.stack([width - x, height - y], 1)
        case 3:
            return np.stack([y, height - x], 1)
    return points


def render_views(cameras: Sequence[Camera], rasterizer: Rasterizer, matcher: Matcher) -> list[tuple[View, Frame]]:
    """Render, find features, lift them."""
    frames = rasterizer.render(cameras)
    return [
        (lifted(matcher.extract(to_uint8(frame.rgb), VIEW_FEATURES), frame, camera), frame)
        for camera, frame in zip(cameras, frames, strict=True)
    ]


def rendered_frame(pose: Pose, query: Query, tools: Tools, tolerance_px: float = 1.0) -> tuple[Frame, Camera]:
    """Return the render with the photo's intrinsics; the job's last one if hardly anything moved since."""
    camera = Camera(sized(query.intrinsics, RENDER_PX), pose)
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
        found = tools.matcher.extract(to_uint8(frame.rgb), VIEW_FEATURES)
        last = tools.memo["last_view"] = lifted(found, frame, camera)
    return last, frame


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
    return (np.clip(rgb, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
