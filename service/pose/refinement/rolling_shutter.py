"""Was the camera turning while the image was read row by row? Two more unknowns at the answer: shear and stretch.

A rolling shutter reads the rows one after the other. A camera that turns sideways meanwhile takes a sheared image, one
that turns up or down a stretched or compressed one. Neither can be said by a pose and a lens, and both move the pose
that fits best, with a covariance that knows nothing of it. To first order a point at the normalized height y is shifted
by (shear y, stretch y). (20 ms and 30 degrees/s: 0.004 to 0.03 on 38 photos; 0.003 at most on 21 taken at once.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from service.pose.refinement.covariance import inverse_spd
from service.pose.refinement.pyramid_level import CORRECTION, TWIST, PyramidLevel
from service.pose.refinement.refinement_config import ShutterConfig

SHUTTER = slice(14, 16)
"""Places of shear and stretch, after the unknowns of refinement."""


@dataclass(frozen=True, slots=True)
class ShutterMotion:
    """The motion of the camera while its rows were read, as a shear and a stretch of the image, and what it means for
    the pose.
    """

    shear: float
    """Normalized units right per normalized unit down."""
    stretch: float
    """Normalized units down per normalized unit down."""
    motion: Float64[np.ndarray, "6"]
    """Twist (rad, scene units) by which the pose moves if they are estimated."""
    covariance: Float64[np.ndarray, "6 6"]
    """What is added to that of the twist if they are unknown."""


def with_shutter_rows(level: PyramidLevel, jacobian: Float32[np.ndarray, "14 n"]) -> Float32[np.ndarray, "16 n"]:
    """Return the jacobian with the rows of shear and stretch, those of the principal point times the height."""
    long_side_over_focal = level.photo_intrinsics.long_side / level.photo_intrinsics.fx
    height = level.points[1] / (level.points[2] * np.float32(long_side_over_focal))
    return np.concatenate([jacobian, jacobian[CORRECTION.stop - 2 : CORRECTION.stop] * height])


def shutter_motion(
    information: Float64[np.ndarray, "16 16"],
    score: Float64[np.ndarray, "16"],
    scale: float,
    estimates_lens: bool,
    config: ShutterConfig,
) -> ShutterMotion | None:
    """Return shear and stretch by one step of the normal equations; None where neither is significant.

    `information` includes the prior on the intrinsics; `scale` is that of the variances.
    """
    known = np.r_[0 : CORRECTION.stop] if estimates_lens else np.r_[0 : CORRECTION.start]
    keep = np.r_[known, SHUTTER]
    inverse, if_known = (inverse_spd(information[np.ix_(kept, kept)]) for kept in (keep, known))
    if inverse is None or if_known is None:
        return None
    step, sigma = (inverse @ score[keep])[-2:], np.sqrt(scale * inverse.diagonal()[-2:])
    if not np.any((np.abs(step) > config.min_motion) & (np.abs(step) > config.min_sigmas * sigma)):
        return None
    # The step of refinement moves the render, as everywhere; its size is what matters here.
    added = scale * (inverse[TWIST, TWIST] - if_known[TWIST, TWIST])
    return ShutterMotion(float(step[0]), float(step[1]), (inverse @ score[keep])[TWIST], added)
