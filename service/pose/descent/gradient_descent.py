"""Photometric descent: first-order steps on the pose by the renderer's gradient.

`Anchored` poses are what the gradient-based methods optimize: a few numbers, zero at the anchor, that Adam moves.
Three parametrizations, and the chain from the renderer's gradient g by the right twist of the pose P = anchor moved:

    se3     P = exp(xi) anchor, in the world frame about its origin (iNeRF, iComMa): d/dxi = J_l(xi)^T Ad(P^-1)^T g
    so3_t3  R = exp(w) R_0, c = c_0 + t (pNeRF): d/dw = J_l(w)^T R g_w, d/dt = R g_t
    about   camera turned about the scene's centre, then shifted (ours, `refine`): re-anchored at every step

The world of se3 and so3_t3 is the normalized one (origin in the scene's focus, its distance 4), so that learning
rates mean what they mean in the sources.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.errors import InvalidOptions
from service.geometry import hat, se3_exp, se3_log, so3_exp, so3_log
from service.interfaces import Rasterizer
from service.pose.absolute_pose.decoupled import rotate_about, translate_in_camera
from service.pose.descent.adam import Adam
from service.pose.descent.losses import Loss
from service.pose.retrieval.scene_focus import Focus
from service.types import Camera, Intrinsics, Pose

NORMAL_DISTANCE = 4.0
"""Of the focus, in the units that the sources' learning rates are for."""


def require_within(options: object, limits: Mapping[str, tuple[float, float]]) -> None:
    """Raise InvalidOptions for the first of the options' fields that lies outside its limits."""
    for name, (low, high) in limits.items():
        value = getattr(options, name, low)
        if not low <= value <= high:
            raise InvalidOptions(f"must lie in {low}..{high}, is {value}.", where=name)


@dataclass(frozen=True, slots=True)
class Refined:
    """The pose after a step, and the loss before it."""

    pose: Pose
    loss: float


def photometric(
    rasterizer: Rasterizer, intrinsics: Intrinsics, pose: Pose, loss: Loss
) -> tuple[float, Float64[np.ndarray, "6"]]:
    """Return the loss at the pose and its gradient by the right twist."""
    camera = Camera(intrinsics, pose)
    (frame,) = rasterizer.render([camera])
    value, d_rgb = loss(frame.rgb)
    return value, rasterizer.pose_gradient(camera, d_rgb)


def refine(
    rasterizer: Rasterizer,
    intrinsics: Intrinsics,
    start: Pose,
    loss: Loss,
    focus: Focus,
    steps: int,
    rate: float,
    end_rate: float,
) -> Iterator[Refined]:
    """Adam on (turn about the focus, shift); the rate (rad, share of the focus' distance) falls geometrically."""
    turner, shifter = Adam(3, rate), Adam(3, rate)
    pose = start
    for step in range(steps):
        turner.rate = rate * (end_rate / rate) ** (step / max(steps - 1, 1))
        shifter.rate = turner.rate * focus.distance
        value, gradient = photometric(rasterizer, intrinsics, pose, loss)
        yield Refined(pose, value)
        arm = pose.camera_from_world[:3, :3] @ (focus.point_in_world - pose.position_in_world)
        turn = -turner.step(gradient[:3] + hat(arm).T @ gradient[3:])
        shift = -shifter.step(gradient[3:])
        pose = translate_in_camera(rotate_about(pose, focus.point_in_world, turn), shift)
    value, _ = loss(rasterizer.render([Camera(intrinsics, pose)])[0].rgb)
    yield Refined(pose, value)


class Se3:
    """Six numbers: a twist in the normalized world, on the left of the anchor."""

    def __init__(self, anchor: Pose, focus: Focus) -> None:
        self._scale, self._focus = NORMAL_DISTANCE / focus.distance, focus
        self._anchor = self._normalized(anchor)

    def _normalized(self, pose: Pose) -> Float64[np.ndarray, "4 4"]:
        matrix = pose.world_from_camera.copy()
        matrix[:3, 3] = self._scale * (matrix[:3, 3] - self._focus.point_in_world)
        return matrix

    def pose(self, xi: Float64[np.ndarray, "6"]) -> Pose:
        matrix = se3_exp(xi) @ self._anchor
        matrix[:3, 3] = matrix[:3, 3] / self._scale + self._focus.point_in_world
        u, _, vt = np.linalg.svd(matrix[:3, :3])
        matrix[:3, :3] = u @ vt
        return Pose(matrix)

    def gradient(self, xi: Float64[np.ndarray, "6"], twist: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "6"]:
        """Carry the renderer's gradient over: by differences of exp and log, exact to 1e-8."""
        matrix = se3_exp(xi) @ self._anchor
        inverse = np.linalg.inv(matrix)
        scaled = np.concatenate([twist[:3], twist[3:] / self._scale])
        result = np.empty(6)
        for i in range(6):
            step = 1e-5 * np.eye(6)[i]
            ahead = se3_log(inverse @ se3_exp(xi + step) @ self._anchor)
            back = se3_log(inverse @ se3_exp(xi - step) @ self._anchor)
            result[i] = scaled @ (ahead - back) / 2e-5
        return result


class So3T3:
    """Six numbers: a rotation vector in the world's axes, in place, and a shift in the normalized world."""

    def __init__(self, anchor: Pose, focus: Focus) -> None:
        self._scale, self._anchor = NORMAL_DISTANCE / focus.distance, anchor

    def pose(self, numbers: Float64[np.ndarray, "6"]) -> Pose:
        matrix = self._anchor.world_from_camera.copy()
        rotation = so3_exp(numbers[:3]) @ matrix[:3, :3]
        u, _, vt = np.linalg.svd(rotation)
        matrix[:3, :3] = u @ vt
        matrix[:3, 3] += numbers[3:] / self._scale
        return Pose(matrix)

    def gradient(self, numbers: Float64[np.ndarray, "6"], twist: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "6"]:
        rotation = self.pose(numbers).world_from_camera[:3, :3]
        inverse = rotation.T
        by_turn = np.empty(3)
        for i in range(3):
            step = 1e-5 * np.eye(3)[i]
            anchor = self._anchor.world_from_camera[:3, :3]
            ahead = so3_log(inverse @ so3_exp(numbers[:3] + step) @ anchor)
            back = so3_log(inverse @ so3_exp(numbers[:3] - step) @ anchor)
            by_turn[i] = twist[:3] @ (ahead - back) / 2e-5
        return np.concatenate([by_turn, rotation @ twist[3:] / self._scale])
