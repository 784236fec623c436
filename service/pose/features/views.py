"""The photo's pictures and the last render, kept in the job's `Tools.memo`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, UInt8

from service.interfaces import Features, Frame, Tools
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import View, ViewRenderer
from service.types import Camera, Intrinsics, Pose, Query


def images_of(query: Query, tools: Tools) -> QueryImages:
    """Return the job's pictures of the photo."""
    if "images" not in tools.memo:
        tools.memo["images"] = QueryImages(query, tools.matcher)
    return tools.memo["images"]


def photo_at(query: Query, tools: Tools, size: Intrinsics) -> UInt8[np.ndarray, "h w 3"]:
    """Return the resampled photo."""
    return images_of(query, tools).resized(size)


def known_at(query: Query, tools: Tools, size: Intrinsics) -> Bool[np.ndarray, "h w"] | None:
    """Return its valid pixels."""
    return images_of(query, tools).valid_mask(size)


def photo_features(query: Query, tools: Tools, long_side: int = PHOTO_PX, eighths: int = 0) -> Features:
    """Return the photo's features."""
    return images_of(query, tools).features(long_side, eighths)


def rendered_frame(
    pose: Pose, query: Query, tools: Tools, tolerance_px: float = 1.0, long_side: int | None = None
) -> tuple[Frame, Camera]:
    """Return the render at a pose."""
    if "renderer" not in tools.memo:
        tools.memo["renderer"] = ViewRenderer(tools.rasterizer)
    rendered = tools.memo["renderer"].at(query, pose, tolerance_px, long_side)
    return rendered.frame, rendered.camera


def rendered_view(pose: Pose, query: Query, tools: Tools) -> tuple[View, Frame]:
    """Return the render at a pose with its features."""
    frame, _ = rendered_frame(pose, query, tools)
    return tools.memo["renderer"].latest.view(tools.matcher), frame
