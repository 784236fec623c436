"""Do the pixels contradict intrinsics that were given as exact? Refinement with free intrinsics from the answer.

Wrong intrinsics leave a pose that makes up for them as well as it can, and residuals that it can't: with another focal
length, distortion or principal point, the photo fits better at another pose. One step of the normal equations doesn't
tell how far that is: for a fisheye that is said to be a pinhole it is a quarter of the way. Whether the fit is better
is judged by the mean absolute residual. (58 answers with exact intrinsics: 0.97 of it and more is left. 91 with
intrinsics so wrong that the pose is, focal lengths 3 and 5 % off, k1 of 0.08, crops off centre by a tenth: 0.91 at
most.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from service.geometry import se3_log
from service.pose.refinement.gauss_newton import minimize
from service.pose.refinement.pyramid_level import PyramidLevel, RefinementState
from service.pose.refinement.refinement_config import RefinementConfig
from service.types import IntrinsicsCorrection


@dataclass(frozen=True, slots=True)
class LensFit:
    """The intrinsics that fit the photo best, and what they do to the pose."""

    correction: IntrinsicsCorrection
    """Of the intrinsics that were given."""
    motion: Float64[np.ndarray, "6"]
    """The right twist (rad, scene units) from the answer to the pose with these intrinsics."""
    loss_ratio: float
    """Mean absolute residual with these intrinsics over that with the given ones."""
    contradicts: bool
    """Whether pose and residual say that the given intrinsics are wrong."""


def fit_lens(
    level: PyramidLevel,
    state: RefinementState,
    config: RefinementConfig,
) -> LensFit | None:
    """Refine the intrinsics with the pose; `state` is at the answer, and is kept. None: that diverges."""
    test = config.lens_test
    depth = float(np.median(level.points[2]))
    some = level.thinned(test.max_pixels)
    free = replace(state, prior=test.prior, photometric=state.photometric.copy())
    free_loss = minimize(some, free, test.settled_px, replace(config, max_steps=test.max_steps))
    if not np.isfinite(free_loss):
        return None
    motion = se3_log(state.photo_from_render @ np.linalg.inv(free.photo_from_render))
    # Of the same pixels.
    ratio = free_loss / max(some.residuals(state, config)[2], 1e-9)
    moves = moves_pose(motion, depth, test.contradicting_deg, test.contradicting_share)
    return LensFit(free.correction, motion, ratio, moves and ratio < test.max_loss_ratio)


def moves_pose(motion: Float64[np.ndarray, "6"], depth: float, degrees: float, share: float) -> bool:
    """Return whether a twist is greater than this rotation, or this share of the depth."""
    rotation, translation = np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:])
    return bool(np.degrees(rotation) > degrees or translation > share * depth)
