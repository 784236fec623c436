"""Signals of a pose besides appearance: what is seen there, how well that determines the pose, and fresh matches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from service.geometry import reprojection_error_px
from service.interfaces import Frame
from service.pose.features.rendered_views import VIEWS
from service.pose.matching.correspondences import MATCH_ERROR_PX, Correspondences
from service.pose.refinement.uncertainty import PoseUncertainty
from service.types import Intrinsics, Pose, Query


@dataclass(frozen=True, slots=True)
class SignalConfig:
    """How the signals are measured."""

    max_error_px: float = MATCH_ERROR_PX
    """Reprojection error of an inlier, at the render's size."""
    cells: int = 6
    """Cells along each side of the photo, in which the spread of the inliers is counted."""
    min_alpha: float = VIEWS.min_alpha
    """Opacity from which on a pixel counts as surface."""
    undetermined: float = 1.0
    """Standard deviation of the position, relative to the distance to what is seen, from which on the last step of
    refinement is no evidence: an image without structure gives no step, whatever the pose."""
    max_signal: float = 1e3
    """What an infinite signal is cut off at."""


SIGNALS = SignalConfig()
NO_MATCHES = {"inliers": 0.0, "inlier_share": 0.0, "inlier_spread": 0.0}
"""The signals of matches where none were made."""


def typical_depth(frame: Frame) -> float:
    """Return the distance to what is seen, in scene units: the median depth; 1 where nothing is."""
    # A sample is enough for a median.
    depth = frame.median_depth[::4, ::4]
    return float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0


def geometry_signals(frame: Frame, size: Intrinsics, uncertainty: PoseUncertainty | None) -> dict[str, float]:
    """Return the signals of what is seen and how well it determines the pose.

    `coverage`: share of the image that is opaque; `drift_px`: by how much another step of refinement on this frame
    would move the image; `sigma_share`: standard deviation of the position over the median depth.
    """
    depth = typical_depth(frame)
    drift = spread = np.inf
    if uncertainty is not None:
        spread = float(np.sqrt(np.trace(uncertainty.covariance[3:6, 3:6]))) / depth
        if spread < SIGNALS.undetermined:
            # Both as pixels: an angle times the focal length, a translation over the depth times it.
            rotation, translation = np.linalg.norm(uncertainty.last_step.reshape(2, 3), axis=1)
            drift = size.fx * float(rotation + translation / depth)
    return {
        "coverage": float((frame.alpha > SIGNALS.min_alpha).mean()),
        "drift_px": min(drift, SIGNALS.max_signal),
        "sigma_share": min(spread, SIGNALS.max_signal),
    }


def match_signals(
    found: Correspondences, alpha: Float32[np.ndarray, "h w"], query: Query, size: Intrinsics, pose: Pose
) -> dict[str, float]:
    """Return how many matches with the render agree with the pose as it is, their share, and how far they spread.

    `alpha` is the render's opacity where the photo is valid; `inlier_spread` is the share of its opaque cells that
    have an inlier.
    """
    scale, cells = size.long_side / query.intrinsics.long_side, SIGNALS.cells
    error = scale * reprojection_error_px(found.photo_px, found.points_in_world, query.intrinsics, pose)
    inlier = error < SIGNALS.max_error_px
    # Cells that show nothing of the scene can't have inliers.
    opaque = cv2.resize(alpha, (cells, cells), interpolation=cv2.INTER_AREA) > 0.5 * SIGNALS.min_alpha
    cell = (found.photo_px[inlier] * (cells / np.array([query.intrinsics.width, query.intrinsics.height]))).astype(int)
    held = np.zeros((cells, cells), bool)
    held[tuple(np.clip(cell[:, ::-1], 0, cells - 1).T)] = True
    return {
        "inliers": float(inlier.sum()),
        "inlier_share": float(inlier.mean()) if len(inlier) else 0.0,
        "inlier_spread": float((held & opaque).sum() / max(opaque.sum(), 1)),
    }
