"""Gradient descent on the pose, by the renderer's gradient of a photometric loss.

A parametrization describes a pose by six numbers that are zero at its anchor, and carries the renderer's gradient g by
the right twist of the pose over to them:

    Se3      P = exp(xi) anchor, in the world frame about its origin (iNeRF, iComMa): d/dxi = J_l(xi)^T Ad(P^-1)^T g
    So3T3    R = exp(w) R_0, c = c_0 + t (pNeRF): d/dw = J_l(w)^T R g_w, d/dt = R g_t
    descend  rotation about the scene's focus, then a translation (ours), with a new anchor at every step

The world of Se3 and So3T3 is normalized (origin at the scene's focus, whose distance is 4), so that learning rates
have the meaning that they have in the sources.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.errors import InvalidOptions
from service.geometry import hat, se3_exp, se3_log, so3_exp, so3_log
from service.interfaces import Rasterizer
from service.pose.absolute_pose.decoupled import rotate_about, translate_in_camera
from service.pose.descent.adam import Adam
from service.pose.descent.losses import Loss
from service.pose.features.rendered_views import in_batches
from service.pose.features.scene_focus import Focus
from service.types import Camera, Intrinsics, Pose

NORMAL_DISTANCE = 4.0
"""Of the focus, in normalized units."""


@dataclass(frozen=True, slots=True)
class DescentConfig:
    """Adam's rates."""

    rate: float = 2e-3
    """Adam's at the first step: rad, and shares of the focus' distance."""
    end_rate: float = 1e-5
    """At the last step; in between it falls geometrically."""


DESCENT = DescentConfig()


def require_within(options: object, limits: Mapping[str, tuple[float, float]]) -> None:
    """Raise InvalidOptions for the first of the options' fields that lies outside its limits, borders included."""
    for name, (low, high) in limits.items():
        value = getattr(options, name, low)
        if not low <= value <= high:
            raise InvalidOptions(f"must lie in {low}..{high}, is {value}.", where=name)


@dataclass(frozen=True, slots=True)
class DescentStep:
    """One step of a descent."""

    pose: Pose
    loss: float
    """At the pose."""


def loss_and_gradient(
    rasterizer: Rasterizer, intrinsics: Intrinsics, pose: Pose, loss: Loss
) -> tuple[float, Float64[np.ndarray, "6"]]:
    """Render at the pose; return the loss and its gradient by the right twist (rad, scene units)."""
    camera = Camera(intrinsics, pose)
    (frame,) = rasterizer.render([camera])
    value, d_rgb = loss(frame.rgb)
    return value, rasterizer.pose_gradient(camera, d_rgb)


def losses_and_gradients(
    rasterizer: Rasterizer, intrinsics: Intrinsics, poses: Sequence[Pose], loss: Loss
) -> Iterator[tuple[float, Float64[np.ndarray, "6"]]]:
    """Yield `loss_and_gradient` of each pose; as many as the renderer prefers are rendered in one call."""
    for some in in_batches(poses, rasterizer.cameras_at_once):
        cameras = [Camera(intrinsics, pose) for pose in some]
        found = [loss(frame.rgb) for frame in rasterizer.render(cameras)]
        gradients = rasterizer.pose_gradients(cameras, [d_rgb for _, d_rgb in found])
        yield from zip((value for value, _ in found), gradients, strict=True)


def descend(
    rasterizer: Rasterizer,
    intrinsics: Intrinsics,
    start: Pose,
    loss: Loss,
    focus: Focus,
    steps: int,
    config: DescentConfig = DESCENT,
) -> Iterator[DescentStep]:
    """Run Adam on (rotation about the focus, translation) in the camera's axes.

    Yields `steps` + 1 poses with their losses, the start first.
    """
    rotation_adam, translation_adam = Adam(3, config.rate), Adam(3, config.rate)
    pose = start
    for step in range(steps):
        rotation_adam.rate = config.rate * (config.end_rate / config.rate) ** (step / max(steps - 1, 1))
        translation_adam.rate = rotation_adam.rate * focus.distance
        value, gradient = loss_and_gradient(rasterizer, intrinsics, pose, loss)
        yield DescentStep(pose, value)
        # By a rotation about the focus the camera turns in place and moves along with its arm, too.
        arm = pose.camera_from_world[:3, :3] @ (focus.point_in_world - pose.position_in_world)
        rotation = -rotation_adam.step(gradient[:3] + hat(arm).T @ gradient[3:])
        translation = -translation_adam.step(gradient[3:])
        pose = translate_in_camera(rotate_about(pose, focus.point_in_world, rotation), translation)
    # Of the last pose only the loss is needed, a render without gradient.
    value, _ = loss(rasterizer.render([Camera(intrinsics, pose)])[0].rgb)
    yield DescentStep(pose, value)


class Se3:
    """Poses by a twist (rad, normalized units) on the left of the anchor, in the normalized world frame."""

    def __init__(self, anchor: Pose, focus: Focus) -> None:
        self._scale, self._focus = NORMAL_DISTANCE / focus.distance, focus
        self._anchor = self._normalized(anchor)

    def _normalized(self, pose: Pose) -> Float64[np.ndarray, "4 4"]:
        matrix = pose.world_from_camera.copy()
        matrix[:3, 3] = self._scale * (matrix[:3, 3] - self._focus.point_in_world)
        return matrix

    def pose(self, xi: Float64[np.ndarray, "6"]) -> Pose:
        """Return the pose exp(xi) anchor, in the scene's own world frame."""
        matrix = se3_exp(xi) @ self._anchor
        matrix[:3, 3] = matrix[:3, 3] / self._scale + self._focus.point_in_world
        u, _, vt = np.linalg.svd(matrix[:3, :3])
        matrix[:3, :3] = u @ vt
        return Pose(matrix)

    def gradient(self, xi: Float64[np.ndarray, "6"], twist: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "6"]:
        """Return the gradient by xi, given that by the right twist of its pose.

        By central differences of exp and log, exact to 1e-8.
        """
        matrix = se3_exp(xi) @ self._anchor
        inverse = np.linalg.inv(matrix)
        # A translation of one normalized unit is 1 / scale scene units.
        scaled = np.concatenate([twist[:3], twist[3:] / self._scale])
        result = np.empty(6)
        for i in range(6):
            step = 1e-5 * np.eye(6)[i]
            ahead = se3_log(inverse @ se3_exp(xi + step) @ self._anchor)
            back = se3_log(inverse @ se3_exp(xi - step) @ self._anchor)
            result[i] = scaled @ (ahead - back) / 2e-5
        return result


class So3T3:
    """Poses by a rotation vector (rad, world axes) in place, and a translation (normalized units, world axes)."""

    def __init__(self, anchor: Pose, focus: Focus) -> None:
        self._scale, self._anchor = NORMAL_DISTANCE / focus.distance, anchor

    def pose(self, numbers: Float64[np.ndarray, "6"]) -> Pose:
        """Return the pose that the numbers (rotation, translation) lead to from the anchor."""
        matrix = self._anchor.world_from_camera.copy()
        rotation = so3_exp(numbers[:3]) @ matrix[:3, :3]
        u, _, vt = np.linalg.svd(rotation)
        matrix[:3, :3] = u @ vt
        matrix[:3, 3] += numbers[3:] / self._scale
        return Pose(matrix)

    def gradient(self, numbers: Float64[np.ndarray, "6"], twist: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "6"]:
        """Return the gradient by the numbers, given that by the right twist of their pose."""
        rotation = self.pose(numbers).world_from_camera[:3, :3]
        inverse = rotation.T
        by_rotation = np.empty(3)
        for i in range(3):
            step = 1e-5 * np.eye(3)[i]
            anchor = self._anchor.world_from_camera[:3, :3]
            ahead = so3_log(inverse @ so3_exp(numbers[:3] + step) @ anchor)
            back = so3_log(inverse @ so3_exp(numbers[:3] - step) @ anchor)
            by_rotation[i] = twist[:3] @ (ahead - back) / 2e-5
        return np.concatenate([by_rotation, rotation @ twist[3:] / self._scale])
