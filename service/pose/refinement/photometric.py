"""Photometric refinement: robust Gauss-Newton against one rendered frame with depth, coarse to fine.

For the pixels x of a render I (intensity, depth: the point X in the render's camera frame) and the photo P:

    minimize  sum |r|,   r = P(project(T X)) - a(I)(x),   T = photo_camera_from_render_camera
    a(I) = gain I + bias + gamma I (1 - I) + blur laplacian(I)

where a covers exposure, haze, nearly any gamma curve, and a little defocus. Inverse compositional steps (Baker and
Matthews, IJCV 2004): the render is moved by a small twist, so that its gradients and jacobian are computed once. Each
step solves 10 normal equations (twist and photometric parameters; 14 with an approximate camera's intrinsics), with L1
weights that Tukey's cut off: what hides the scene has no influence. A saturated photo is compared with a render that
is clipped like it. How the render itself changes with the pose (occlusion, highlights) is ignored: render again at the
result, and repeat.

Measured: RGB, forward or symmetric gradients are no better on real photos; L2 is worst; two renders are enough; with
four levels it converges from some 10 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from service.geometry import moved, se3_log
from service.interfaces import Frame
from service.pose.refinement.gauss_newton import minimize
from service.pose.refinement.pyramid_level import NEUTRAL, PyramidLevel, RefinementState, linearized_levels
from service.pose.refinement.refinement_config import REFINEMENT, RefinementConfig
from service.types import NO_CORRECTION, Camera, IntrinsicsCorrection, LensPrior, Pose


@dataclass(frozen=True, slots=True)
class FinalLevel:
    """The finest level of a refinement, and where it ended there: enough to estimate the uncertainty."""

    level: PyramidLevel
    photometric: Float64[np.ndarray, "4"]
    """Gain, bias, gamma, blur."""


@dataclass(frozen=True, slots=True)
class RefinementResult:
    """The camera that photometric refinement led to."""

    pose: Pose
    correction: IntrinsicsCorrection
    """Of the intrinsics that were given."""
    loss: float
    """Mean absolute residual (0..1) on the finest level; infinite where too few pixels overlap."""
    final_level: FinalLevel | None = field(default=None, repr=False)
    """None where the loss is infinite."""


def refine_photometric(
    photo: UInt8[np.ndarray, "h w 3"],
    frame: Frame,
    camera: Camera,
    start: Camera,
    levels: int,
    correction: IntrinsicsCorrection = NO_CORRECTION,
    lens_prior: LensPrior | None = None,
    valid_mask: Bool[np.ndarray, "h w"] | None = None,
    coarse: bool = False,
    config: RefinementConfig = REFINEMENT,
) -> RefinementResult:
    """Refine the pose of `start`, so that the photo agrees with the frame, which `camera` rendered nearby.

    Photo and frame have the same size, `valid_mask` is False where the photo has no content. `start` has the photo's
    intrinsics without `correction`, from which their correction starts; it is estimated if there is a `lens_prior`.
    `levels` counts those of the pyramid, the photo's own size included.
    `coarse` ends the finest level, too, at the tolerance of coarse ones: enough where another refinement follows.
    """
    photo_from_render = start.pose.camera_from_world @ camera.pose.world_from_camera
    state = RefinementState(photo_from_render, correction, lens_prior, NEUTRAL.copy())
    loss, level = np.inf, None
    coarse_to_fine = linearized_levels(
        photo, valid_mask, frame, camera.intrinsics, start.intrinsics, levels, bool(lens_prior), config
    )
    for finer, level in zip(reversed(range(levels)), coarse_to_fine, strict=True):
        if finer and len(level.pixels) < config.min_pixels:
            continue  # at this size too little of the scene is left to refine on
        state.photometric[3] = 0.0  # the blur is in pixels of the level
        loss = minimize(level, state, config.settled_coarse_px if finer or coarse else config.settled_px, config)
        if not np.isfinite(loss):
            return RefinementResult(start.pose, correction, loss)
    assert level is not None
    # The unknown is photo_from_render; the photo's camera is at its inverse from the render's.
    pose = moved(camera.pose, se3_log(np.linalg.inv(state.photo_from_render)))
    return RefinementResult(pose, state.correction, loss, FinalLevel(level, state.photometric))
