"""Rigid motions, projection, and the distances between poses. Pure numpy, float64.

Twists are (rotation vector in rad, translation) and act on the right: world_from_camera @ se3_exp(twist) moves a
camera in its own frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64

from service.types import Intrinsics, Pose


def hat(v: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The matrix of the cross product: hat(v) @ x = v x x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def so3_exp(rotation_vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Rodrigues' formula."""
    first, second, _ = _rodrigues(math.sqrt(rotation_vector @ rotation_vector))
    k = hat(rotation_vector)
    return np.eye(3) + first * k + second * (k @ k)


def _rodrigues(angle: float) -> tuple[float, float, float]:
    """Return sin a / a, (1 - cos a) / a^2 and (a - sin a) / a^3; Taylor where these lose digits."""
    if angle < 1e-4:
        return 1.0 - angle**2 / 6.0, 0.5, 1.0 / 6.0
    sine, cosine = math.sin(angle), math.cos(angle)
    return sine / angle, (1.0 - cosine) / angle**2, (angle - sine) / angle**3


def so3_log(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3"]:
    """Return the rotation vector, of length 0..pi."""
    w, x, y, z = quat_from_rotation(rotation)
    sine = np.sqrt(x * x + y * y + z * z)
    # For w >= 0 the half angle lies in 0..pi/2, where atan2 keeps its precision; 2 is the limit of angle / sine.
    factor = 2.0 * np.arctan2(sine, w) / sine if sine > 1e-12 else 2.0
    return factor * np.array([x, y, z])


def se3_exp(twist: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "4 4"]:
    """The motion of a twist."""
    # By scalars: refinement calls it at each step, and numpy takes microseconds for each of so small arrays.
    x, y, z, *rho = (float(component) for component in twist)
    first, second, third = _rodrigues(math.sqrt(x * x + y * y + z * z))
    once = _cross((x, y, z), rho)
    twice = _cross((x, y, z), once)
    # The left Jacobian times rho.
    at = [r + second * a + third * b for r, a, b in zip(rho, once, twice, strict=True)]
    return np.array(
        [
            [1 - second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y, at[0]],
            [second * x * y + first * z, 1 - second * (x * x + z * z), second * y * z - first * x, at[1]],
            [second * x * z - first * y, second * y * z + first * x, 1 - second * (x * x + y * y), at[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def se3_log(transform: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "6"]:
    """The twist of a motion; its rotation vector has length 0..pi."""
    phi = so3_log(transform[:3, :3])
    angle = float(np.linalg.norm(phi))
    k = hat(phi)
    if angle < 1e-4:
        inverse_jacobian = np.eye(3) - 0.5 * k + k @ k / 12.0
    else:
        half = angle / 2
        inverse_jacobian = np.eye(3) - 0.5 * k + (1 - half / np.tan(half)) / angle**2 * k @ k
    return np.concatenate([phi, inverse_jacobian @ transform[:3, 3]])


def adjoint(motion: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "6 6"]:
    """Return the matrix that takes a twist through a motion: motion @ exp(x) = exp(adjoint @ x) @ motion."""
    rotation, result = motion[:3, :3], np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = rotation
    result[3:, :3] = hat(motion[:3, 3]) @ rotation
    return result


def moved(pose: Pose, twist: Float64[np.ndarray, "6"]) -> Pose:
    """Return world_from_camera @ exp(twist), re-orthonormalized so that long chains of steps stay rigid."""
    matrix = pose.world_from_camera @ se3_exp(twist)
    # The nearest rotation in the Frobenius norm.
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = u @ vt
    return Pose(matrix)


def quat_from_rotation(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "4"]:
    """Return the unit quaternion wxyz with w >= 0.

    The eigenvector form (Bar-Itzhack 2000): stable at every angle, and the nearest rotation for a noisy matrix.
    """
    r = np.asarray(rotation, np.float64)
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    quat = np.linalg.eigh(k)[1][:, -1]
    return quat if quat[0] >= 0 else -quat


def rotation_from_quat(wxyz: Float[np.ndarray, "*batch 4"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """Accepts quaternions of any length but zero."""
    q = np.asarray(wxyz, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def project(points_in_camera: Float[np.ndarray, "n 3"], intrinsics: Intrinsics) -> Float64[np.ndarray, "n 2"]:
    """Pinhole projection to pixels. Points at or behind the camera give inf or nan, without a warning."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = points_in_camera[:, :2] / points_in_camera[:, 2:]
    return xy * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]


def unproject(
    px: Float[np.ndarray, "n 2"], depth: Float[np.ndarray, "n"], intrinsics: Intrinsics
) -> Float64[np.ndarray, "n 3"]:
    """Return the points in the camera frame at the given z-depths."""
    xy = (np.asarray(px, np.float64) - [intrinsics.cx, intrinsics.cy]) / [intrinsics.fx, intrinsics.fy]
    return np.concatenate([xy, np.ones((len(xy), 1))], 1) * np.asarray(depth, np.float64)[:, None]


def transformed(
    target_from_source: Float64[np.ndarray, "4 4"], points_in_source: Float[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return the points in the target frame."""
    return points_in_source @ target_from_source[:3, :3].T + target_from_source[:3, 3]


def reprojection_error_px(
    photo_px: Float[np.ndarray, "m 2"],
    points_in_world: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
    pose: Pose,
) -> Float[np.ndarray, "m"]:
    """Return the distances in pixels between observations and projected points; infinite behind the camera."""
    points = transformed(pose.camera_from_world, points_in_world)
    distance = np.linalg.norm(project(points, intrinsics) - photo_px, axis=1)
    # Points behind the camera project, too, but are not seen.
    return np.where(points[:, 2] > 1e-9, distance, np.inf)


def pose_distance(a: Pose, b: Pose) -> tuple[float, float]:
    """Return the angle in degrees and the distance of the camera centres in scene units."""
    rotation = a.world_from_camera[:3, :3].T @ b.world_from_camera[:3, :3]
    angle = float(np.degrees(np.linalg.norm(so3_log(rotation))))
    return angle, float(np.linalg.norm(a.position_in_world - b.position_in_world))


def look_at(position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> Pose:
    """Return the pose of a camera at `position` whose axis points at `target` and whose -y is near `up`."""
    forward = np.asarray(target, np.float64) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:  # looking along up: any right will do
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :4] = np.stack([right, np.cross(forward, right), forward, position], 1)
    return Pose(matrix)


def nearest_point_to_axes(poses: Sequence[Pose]) -> Float64[np.ndarray, "3"]:
    """Return the point with the least sum of squared distances to the cameras' optical axes."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for pose in poses:
        across = np.eye(3) - np.outer(pose.axis_in_world, pose.axis_in_world)
        normal += across
        right += across @ pose.position_in_world
    return np.linalg.lstsq(normal, right, rcond=1e-9)[0]
