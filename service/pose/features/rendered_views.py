"""Renders of the scene, and their local features backprojected to scene points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from service.geometry import reprojection_error_px, transformed, unproject
from service.interfaces import Features, Frame, Matcher, Rasterizer, RenderMatcher
from service.pose.features.image_sizes import RENDER_PX, sized
from service.types import Camera, Pose, Query, frozen


@dataclass(frozen=True, slots=True)
class ViewConfig:
    """What is taken from a render."""

    max_features: int = 800
    max_depth_range: float = 0.06
    """Relative, over 3x3 pixels: beyond it a feature lies on a depth edge, and its scene point is uncertain."""
    min_alpha: float = 0.5
    """Opacity from which on a pixel counts as surface."""
    grid_px: int = 16
    """Spacing of the pixels at which two cameras' images are compared."""
    max_motion_px: float = 1.0
    """Motion of the image within which a render is used again."""
    min_unmoved_share: float = 0.9
    """Share of those pixels that move by less than the tolerance if the images are the same."""


VIEWS = ViewConfig()
Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class View:
    """A camera from which the scene was rendered, and the features found there with their scene points."""

    camera: Camera
    features: Features
    points_in_world: Float32[np.ndarray, "n 3"]

    @property
    def distance(self) -> float:
        """Median distance from the camera to the features' scene points, scene units; needs one point."""
        return float(np.median(np.linalg.norm(self.points_in_world - self.camera.pose.position_in_world, axis=1)))


@dataclass(slots=True)
class RenderedView:
    """A render and its camera; its features are extracted when they are first needed."""

    frame: Frame
    camera: Camera
    _view: View | None = field(default=None, repr=False)

    def view(self, matcher: Matcher) -> View:
        """Return the render's features with their scene points, extracted once."""
        if self._view is None:
            (self._view,) = views_of([self.frame], [self.camera], matcher)
        return self._view

    def shows_the_same_as(self, camera: Camera, tolerance_px: float) -> bool:
        """Return whether nine in ten of the surface points seen here are within this distance in `camera`'s image."""
        own, size = self.camera, camera.intrinsics
        # The common case: nothing moved at all.
        if _is_same(camera, own):
            return True
        height, width = self.frame.alpha.shape
        if (width, height) != (size.width, size.height):
            return False
        # A coarse grid, away from the border, is enough to measure how far the image moves.
        row, column = (grid.ravel() for grid in np.mgrid[4 : height : VIEWS.grid_px, 4 : width : VIEWS.grid_px])
        depth = self.frame.median_depth[row, column]
        px = np.stack([column, row], 1)[depth > 0] + 0.5
        # Where nothing is seen there is nothing to compare.
        if len(px) == 0:
            return False
        points = transformed(own.pose.world_from_camera, unproject(px, depth[depth > 0], own.intrinsics))
        error = reprojection_error_px(px, points, size, camera.pose)
        return bool((error < tolerance_px).mean() > VIEWS.min_unmoved_share)


def _is_same(a: Camera, b: Camera) -> bool:
    return a.intrinsics == b.intrinsics and np.array_equal(a.pose.world_from_camera, b.pose.world_from_camera)


@dataclass(slots=True)
class ViewRenderer:
    """Renders the scene as a query's camera sees it; its latest render is used again where the camera hardly moved."""

    rasterizer: Rasterizer
    latest: RenderedView | None = None
    _ahead: list[RenderedView] = field(default_factory=list, repr=False)

    def render(self, camera: Camera) -> RenderedView:
        """Return a render of the scene at full detail from this camera, and keep it as the latest."""
        same = [rendered for rendered in self._ahead if _is_same(rendered.camera, camera)]
        self.latest = same[0] if same else RenderedView(self.rasterizer.render([camera])[0], camera)
        return self.latest

    def render_ahead(self, cameras: Sequence[Camera]) -> None:
        """Render in one call, if the renderer prefers that, what `render` is going to be asked for; forget the last."""
        if self.rasterizer.cameras_at_once > 1:
            self._ahead = list(map(RenderedView, self.rasterizer.render(cameras), cameras))

    def at(self, query: Query, pose: Pose) -> RenderedView:
        """Return a render with the query's intrinsics, within a pixel of what the pose shows (`near`)."""
        return self.near(camera_of(query, pose))

    def near(self, camera: Camera) -> RenderedView:
        """Return the latest render if it shows the same within `max_motion_px`, else a new one."""
        if self.latest is not None and self.latest.shows_the_same_as(camera, VIEWS.max_motion_px):
            return self.latest
        return self.render(camera)


def camera_of(query: Query, pose: Pose, long_side: int | None = None) -> Camera:
    """Return the query's camera at the pose, at the size for renders unless a long side (px) is given."""
    return Camera(sized(query.intrinsics, long_side or RENDER_PX), pose)


def in_batches(items: Iterable[Item], size: int) -> Iterator[list[Item]]:
    """Yield the items in lists of this size, the last one shorter; no item is asked for before its list is."""
    left = iter(items)
    while batch := list(islice(left, size)):
        yield batch


def views_from(cameras: Iterable[Camera], rasterizer: Rasterizer, matcher: Matcher) -> Iterator[View]:
    """Yield a view from each camera, rendered when it is asked for, with as many others as the renderer prefers."""
    for some in in_batches(cameras, rasterizer.cameras_at_once):
        yield from views_of(rasterizer.render(some), some, matcher)


def views_of(frames: Sequence[Frame], cameras: Sequence[Camera], matcher: Matcher) -> list[View]:
    """Extract features of renders, at their own size, and backproject them."""
    sizes = {frame.alpha.shape for frame in frames}
    if isinstance(matcher, RenderMatcher) and len(sizes) == 1 and frames[0].device_rgb is not None:
        found = matcher.extract_rendered(frames, VIEWS.max_features)
    else:
        found = [matcher.extract(to_uint8(frame.rgb), VIEWS.max_features) for frame in frames]
    return [backprojected(*each) for each in zip(found, frames, cameras, strict=True)]


def backprojected(features: Features, frame: Frame, camera: Camera) -> View:
    """Keep the features on opaque, smooth surface, and compute the scene point of each from the median depth."""
    height, width = frame.alpha.shape
    # One pixel from the border, so that each has its eight neighbours.
    column = np.clip(features.points_px[:, 0].astype(int), 1, width - 2)
    row = np.clip(features.points_px[:, 1].astype(int), 1, height - 2)
    around = np.stack([frame.median_depth[row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)], 1)
    # Across a depth edge the median depth would be that of either side.
    nearest, farthest = around.min(1, initial=np.inf), around.max(1, initial=0.0)
    smooth = (nearest > 0) & (farthest - nearest < VIEWS.max_depth_range * nearest)
    keep = np.flatnonzero(smooth & (frame.alpha[row, column] > VIEWS.min_alpha))
    points = unproject(features.points_px[keep], np.median(around[keep], axis=1), camera.intrinsics)
    return View(
        camera,
        Features(features.points_px[keep], features.scores[keep], features.descriptors[keep]),
        frozen(transformed(camera.pose.world_from_camera, points), np.float32),
    )


def to_uint8(rgb: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return a render (0..1) in a photo's 8 bits."""
    # Bright scenes exceed 1; convertScaleAbs saturates, and would mirror negative values.
    return np.asarray(cv2.convertScaleAbs(np.maximum(rgb, 0), alpha=255.0))
