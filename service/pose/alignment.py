"""Photometric alignment: Gauss-Newton with IRLS-L1 against one frozen render with depth.

For the pixels x of a render I (intensity, depth: the point X in the render's camera frame) and the photo P:

    minimize  sum |r|,   r = P(project(T X)) - (gain I(x) + bias),   T = photo_camera_from_render_camera

by inverse compositional steps (Baker and Matthews, IJCV 2004): the render is moved by a small twist, so its
gradients and Jacobians are computed once; each step solves 8 normal equations (twist, gain, bias) with weights
1 / max(|r|, DELTA). Coarse to fine over an image pyramid. The render's own change with the pose (occlusion,
highlights) is ignored: render again at the result and repeat.

Measured in the research: L1 with weights, Tukey, RGB, forward or symmetric gradients are equal on real photos; L2
is worst; two renders are enough; the basin with four levels is some 10 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from service.geometry import moved, se3_exp, se3_log
from service.interfaces import Frame
from service.jit import kernel
from service.types import Camera, Intrinsics, Pose

DELTA = 0.02
"""Residuals (0..1) below it are noise: they weigh like least squares."""
MAX_STEPS = 12
SIGMA_PX = 0.7
"""Blur of photo and render at each level: renders are softer than photos."""
MIN_ALPHA = 0.5
MAX_PIXELS = 30_000
"""A level with more uses every second, third...: one in eight was as exact as all."""
MIN_PIXELS = 200


@dataclass(frozen=True, slots=True)
class Alignment:
    pose: Pose
    loss: float
    """Mean absolute residual (0..1) at the finest level; infinite where too few pixels overlap."""


def align(
    photo: UInt8[np.ndarray, "h w 3"], frame: Frame, camera: Camera, start: Pose, levels: int
) -> Alignment:
    """Move `start` until the photo agrees with the frame, which `camera` rendered.

    The photo has the frame's size and intrinsics. `start` need not be the camera's pose.
    """
    photo_levels = _pyramid(_luma(photo), levels)
    render_levels = _pyramid(_luma(frame.rgb), levels)
    depth_levels = _depth_pyramid(np.where(frame.alpha > MIN_ALPHA, frame.median_depth, 0.0), levels)
    state = _State(start.camera_from_world @ camera.pose.world_from_camera)
    loss = np.inf
    for level in reversed(range(levels)):
        height, width = photo_levels[level].shape
        intrinsics = camera.intrinsics.resized(width, height)
        loss = _align_level(photo_levels[level], render_levels[level], depth_levels[level], intrinsics, state)
    render_from_photo = np.linalg.inv(state.photo_from_render)
    return Alignment(moved(camera.pose, se3_log(render_from_photo)), loss)


@dataclass(slots=True)
class _State:
    photo_from_render: Float64[np.ndarray, "4 4"]
    gain: float = 1.0
    bias: float = 0.0


def _align_level(
    photo: Float32[np.ndarray, "h w"],
    render: Float32[np.ndarray, "h w"],
    depth: Float32[np.ndarray, "h w"],
    intrinsics: Intrinsics,
    state: _State,
) -> float:
    """Run Gauss-Newton at one level, changing `state`; return the mean absolute residual."""
    pixels = np.flatnonzero(depth[1:-1, 1:-1].ravel() > 0)
    pixels = pixels[:: max(1, len(pixels) // MAX_PIXELS)]
    if len(pixels) < MIN_PIXELS:
        return np.inf
    k = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
    points, values, jacobian = _linearize(render, depth, pixels, k)
    typical_depth = float(np.median(points[2]))
    loss = np.inf
    for _ in range(MAX_STEPS):
        hessian, gradient, total, count = _normal_equations(
            photo, points, values, jacobian, state.photo_from_render[:3], k, state.gain, state.bias, DELTA
        )
        if count < MIN_PIXELS:
            return np.inf
        loss = total / count
        step = _solved(hessian, gradient)
        state.photo_from_render = state.photo_from_render @ se3_exp(-step[:6])
        state.gain += step[6]
        state.bias += step[7]
        moved_px = intrinsics.fx * (np.linalg.norm(step[:3]) + np.linalg.norm(step[3:6]) / typical_depth)
        if moved_px < 0.005:
            break
    return loss


def _solved(
    hessian: Float64[np.ndarray, "8 8"], gradient: Float64[np.ndarray, "8"]
) -> Float64[np.ndarray, "8"]:
    """Solve with each unknown scaled to one: rotation, translation and gain differ by orders of magnitude."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    scaled = hessian * scale[:, None] * scale[None, :] + 1e-6 * np.eye(8)
    return scale * np.linalg.solve(scaled, scale * gradient)


def _luma(rgb: Float32[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Return the mean of the channels, 0..1."""
    scale = np.float32(1 / 765 if rgb.dtype == np.uint8 else 1 / 3)
    return (rgb[..., 0].astype(np.float32) + rgb[..., 1] + rgb[..., 2]) * scale


def _pyramid(image: Float32[np.ndarray, "h w"], levels: int) -> list[Float32[np.ndarray, "_ _"]]:
    """Return the blurred levels, finest first; each has half the size of the one before."""
    raw = [image]
    for _ in range(levels - 1):
        height, width = raw[-1].shape
        raw.append(np.asarray(cv2.resize(raw[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)))
    return [np.asarray(cv2.GaussianBlur(level, (0, 0), SIGMA_PX)) for level in raw]


def _depth_pyramid(depth: Float32[np.ndarray, "h w"], levels: int) -> list[Float32[np.ndarray, "_ _"]]:
    """Average 2x2 depths on smooth surface; 0 where a depth edge runs through them or there is none."""
    result = [depth]
    for _ in range(levels - 1):
        fine = result[-1]
        height, width = fine.shape[0] // 2 * 2, fine.shape[1] // 2 * 2
        quads = np.stack([fine[y:height:2, x:width:2] for y in (0, 1) for x in (0, 1)])
        nearest, farthest = quads.min(0), quads.max(0)
        smooth = (nearest > 0) & (farthest < 1.1 * nearest)
        result.append(np.where(smooth, quads.mean(0), np.float32(0)).astype(np.float32))
    return result


@kernel
def _linearize(render, depth, pixels, k):
    """Return the points in the render's camera frame, the render's values, and d value / d twist of the points."""
    fx, fy, cx, cy = k[0], k[1], k[2], k[3]
    columns = render.shape[1] - 2
    n = len(pixels)
    points = np.empty((3, n), np.float32)
    values = np.empty(n, np.float32)
    jacobian = np.empty((6, n), np.float32)
    for i in range(n):
        row, column = pixels[i] // columns + 1, pixels[i] % columns + 1
        z = depth[row, column]
        x, y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
        # d value / d (x/z, y/z)
        du = 0.5 * (render[row, column + 1] - render[row, column - 1]) * fx
        dv = 0.5 * (render[row + 1, column] - render[row - 1, column]) * fy
        points[0, i], points[1, i], points[2, i] = x * z, y * z, z
        values[i] = render[row, column]
        along = du * x + dv * y
        jacobian[0, i] = -dv - along * y
        jacobian[1, i] = du + along * x
        jacobian[2, i] = dv * x - du * y
        jacobian[3, i] = du / z
        jacobian[4, i] = dv / z
        jacobian[5, i] = -along / z
    return points, values, jacobian


@kernel
def _normal_equations(photo, points, values, jacobian, transform, k, gain, bias, delta):
    """Return H, g of the weighted least-squares step (twist, gain, bias), the sum of |r|, and the pixels used."""
    fx, fy, cx, cy = k[0], k[1], k[2], k[3]
    height, width = photo.shape
    hessian, gradient = np.zeros((8, 8)), np.zeros(8)
    row = np.empty(8)
    total, count = 0.0, 0
    for i in range(points.shape[1]):
        x, y, z = points[0, i], points[1, i], points[2, i]
        px = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3]
        py = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3]
        pz = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3]
        if pz <= 1e-9:
            continue
        u, v = fx * px / pz + cx - 0.5, fy * py / pz + cy - 0.5
        if not (u >= 0 and v >= 0 and u < width - 1 and v < height - 1):
            continue
        left, above = int(u), int(v)
        a, b = u - left, v - above
        upper = photo[above, left] * (1 - a) + photo[above, left + 1] * a
        lower = photo[above + 1, left] * (1 - a) + photo[above + 1, left + 1] * a
        residual = upper * (1 - b) + lower * b - gain * values[i] - bias
        weight = 1.0 / max(abs(residual), delta)
        for j in range(6):
            row[j] = gain * jacobian[j, i]
        row[6], row[7] = values[i], 1.0
        for j in range(8):
            scaled = weight * row[j]
            gradient[j] += scaled * residual
            for m in range(j + 1):
                hessian[j, m] += scaled * row[m]
        total += abs(residual)
        count += 1
    for j in range(8):
        for m in range(j):
            hessian[m, j] = hessian[j, m]
    return hessian, gradient, total, count
