"""What a digest gains: training photos are localized by it, each without its own patches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from service.interfaces import SurfacePoints
from service.pose.features.rendered_views import RenderedView
from service.pose.training_photos.patch_pose import patch_pose
from service.pose.training_photos.surface_points import PosedPhoto, selected
from service.types import Camera, Pose


def distances(
    number: int,
    photos: Sequence[PosedPhoto],
    points: SurfacePoints,
    rendered: RenderedView,
    refined: Pose,
    covariance: Float64[np.ndarray, "6 6"],
) -> tuple[float, float] | None:
    """Return how far from a training photo's pose refinement leads, without patches and with them, in scene units.

    `refined` is the pose by pixels alone, with its covariance, and `rendered` the render that led there. The points of
    other photos were triangulated with this photo, too, so of others the second distance is somewhat greater. None
    where too few patches agree.
    """
    photo = photos[number]
    others = selected(points, np.flatnonzero(points.photo != number))
    found = patch_pose(photo.grey, None, Camera(photo.camera.intrinsics, refined), covariance, rendered, others)
    if found is None:
        return None
    given = photo.camera.pose.position_in_world
    by_pixels, by_both = (float(np.linalg.norm(pose.position_in_world - given)) for pose in (refined, found.pose))
    return by_pixels, by_both
