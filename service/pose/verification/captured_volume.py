"""Whether a pose shows what was captured: surfaces that views of the scene's index see about as it does.

A scene shows nothing of the back of its surfaces, nor of how they look much finer or coarser than in the photos; what
it renders there is a guess of its trainer. Views of the index stand where photos were taken, or, in a scene without
cameras, where its surfaces look like some.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from service.geometry import project, transformed, unproject
from service.interfaces import Frame, Rasterizer
from service.pose.features.rendered_views import VIEWS, View
from service.types import Camera, Intrinsics, Pose


@dataclass(frozen=True, slots=True)
class CaptureConfig:
    """How like a view's a sight must be to count as captured."""

    render_px: int = 128
    """Long side of the render of which points are taken."""
    spacing_px: int = 5
    """Of those points."""
    max_turn_deg: float = 60.0
    """Between the rays of pose and view to a point. A surface that is seen from its back turns by more than 90."""
    max_finer: float = 8.0
    """Size that a pixel of the view's has on it, relative to one of the pose's (images of the same width): finer, the
    scene looks softer, but like itself..."""
    max_coarser: float = 3.0
    """...and of the pose's, relative to the view's; features match within 2."""
    min_share: float = 0.5
    """Share of the points that are captured, below which the pose is outside."""
    near_share: float = 0.5
    """A pose that is nearer to a view than this share of the view's median distance from its points..."""
    near_turn_deg: float = 45.0
    """...and turned by less than this from it is inside: no render is needed."""


CAPTURE = CaptureConfig()
"""Eleven right poses in two scenes, a box cut out or not, have a share of 1.00; lost ones 0.37 to 0.99."""


def is_outside(
    intrinsics: Intrinsics,
    pose: Pose,
    rasterizer: Rasterizer,
    views: Sequence[View],
    config: CaptureConfig = CAPTURE,
) -> bool:
    """Return whether most of what a pose sees was not captured by any view.

    Where nothing at all is seen, or there are no views, the answer is no: that has reasons of its own.
    """
    if not views or _is_beside_a_view(pose, views, config):
        return False
    camera = Camera(intrinsics.with_long_side(config.render_px), pose)
    (frame,) = rasterizer.render([camera])
    share = captured_share(frame, camera, [view.camera for view in views], config)
    return share is not None and share < config.min_share


def _is_beside_a_view(pose: Pose, views: Sequence[View], config: CaptureConfig) -> bool:
    """Return whether the nearest view that looks the same way is near, by what it sees: the usual case."""
    poses = np.stack([view.camera.pose.world_from_camera for view in views])
    alike = poses[:, :3, 2] @ pose.axis_in_world > _cosine(config.near_turn_deg)
    if not alike.any():
        return False
    away = np.where(alike, np.linalg.norm(poses[:, :3, 3] - pose.position_in_world, axis=1), np.inf)
    nearest = views[int(np.argmin(away))]
    return len(nearest.points_in_world) > 0 and float(away.min()) < config.near_share * nearest.distance


def captured_share(
    frame: Frame, camera: Camera, views: Sequence[Camera], config: CaptureConfig = CAPTURE
) -> float | None:
    """Return the share of a render's surface points that a view sees from a like direction, at a like scale.

    None if it shows no surface. That a nearer surface may hide a point from a view is not examined.
    """
    height, width = frame.alpha.shape
    row, column = (grid.ravel() for grid in np.mgrid[2 : height : config.spacing_px, 2 : width : config.spacing_px])
    opaque = frame.alpha[row, column] > VIEWS.min_alpha
    row, column = row[opaque], column[opaque]
    if not len(row):
        return None
    depth = frame.median_depth[row, column].astype(np.float64)
    points = transformed(
        camera.pose.world_from_camera, unproject(np.stack([column, row], 1) + 0.5, depth, camera.intrinsics)
    )
    own_rays, own_distances = _rays(points, camera.pose)
    captured = np.zeros(len(points), bool)
    for view in views:
        rays, distances = _rays(points, view.pose)
        # A telephoto lens sees from far away what a view shows from near.
        ratio = distances / own_distances * (_relative_focal(camera.intrinsics) / _relative_focal(view.intrinsics))
        alike = (own_rays * rays).sum(1) > _cosine(config.max_turn_deg)
        alike &= (ratio < config.max_finer) & (ratio > 1 / config.max_coarser)
        captured |= alike & _in_image(points, view)
    return float(captured.mean())


def _relative_focal(size: Intrinsics) -> float:
    """Return the focal length in units of the image's long side."""
    return float(np.sqrt(size.fx * size.fy) / max(size.width, size.height))


def _in_image(points: Float64[np.ndarray, "n 3"], view: Camera) -> Bool[np.ndarray, "n"]:
    in_camera, size = transformed(view.pose.camera_from_world, points), view.intrinsics
    front = in_camera[:, 2] > 0
    px = project(np.where(front[:, None], in_camera, [0.0, 0.0, 1.0]), size)
    return front & (px > 0).all(1) & (px < [size.width, size.height]).all(1)


def _cosine(degrees: float) -> float:
    return float(np.cos(np.radians(degrees)))


def _rays(
    points: Float64[np.ndarray, "n 3"], pose: Pose
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n"]]:
    """Return the unit vectors from a camera to the points, and the distances."""
    rays = points - pose.position_in_world
    distances = np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
    return rays / distances[:, None], distances
