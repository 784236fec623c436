"""Apply a similarity (rotation, translation, one scale) to a scene: Gaussians with their colours, and cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from service.geometry import quat_from_rotation
from service.scene_formats.gaussians import RawGaussians
from service.types import SH_C0, Pose


def moved_gaussians(raw: RawGaussians, world_from_scene: Float64[np.ndarray, "4 4"]) -> RawGaussians:
    """Return the Gaussians in the world frame, spherical harmonics included; quaternions must be unit."""
    rotation, scale = _parts(world_from_scene)
    means = raw.means.astype(np.float64) @ world_from_scene[:3, :3].T + world_from_scene[:3, 3]
    w, x, y, z = quat_from_rotation(rotation)
    # Left multiplication by the rotation's quaternion, as a matrix on (w, x, y, z).
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return replace(
        raw,
        means=means,
        quats=(raw.quats @ left.T).astype(np.float32),
        scales=(raw.scales * scale).astype(np.float32),
        sh=_rotated_sh(raw.sh, rotation),
    )


def moved_pose(pose: Pose, world_from_scene: Float64[np.ndarray, "4 4"]) -> Pose:
    """Return the camera's pose in the world frame; the scale moves its position only."""
    rotation, _ = _parts(world_from_scene)
    matrix = world_from_scene @ pose.world_from_camera
    matrix[:3, :3] = rotation @ pose.world_from_camera[:3, :3]
    return Pose(matrix)


def _parts(world_from_scene: Float64[np.ndarray, "4 4"]) -> tuple[Float64[np.ndarray, "3 3"], float]:
    """Split into the nearest rotation (by SVD) and the scale."""
    u, singular, vt = np.linalg.svd(world_from_scene[:3, :3])
    return u @ vt, float(singular.mean())


def _rotated_sh(sh: np.ndarray, rotation: Float64[np.ndarray, "3 3"]) -> np.ndarray:
    """Return coefficients c' with sum c'_i Y_i(d) = sum c_i Y_i(R^T d), band by band.

    A band's matrix is solved for from sampled directions by least squares: exact up to rounding, since each band is
    closed under rotation.
    """
    # 64 directions for 7 unknowns in the largest band: any well-spread set will do, so the seed is fixed.
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here, there = sh_basis(directions), sh_basis(directions @ rotation)
    result = sh.copy()
    for degree in range(1, round(np.sqrt(sh.shape[1]))):
        band = slice(degree**2, (degree + 1) ** 2)
        matrix = np.linalg.lstsq(here[:, band], there[:, band], rcond=None)[0]
        result[:, band] = np.einsum("ij,njc->nic", matrix.astype(np.float32), sh[:, band])
    return result


def sh_basis(directions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 16"]:
    """Evaluate the real spherical harmonics of degree 0 to 3 at unit vectors, in the order and signs of 3DGS."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    c1, c2, c3 = (np.sqrt(k / np.pi) for k in (3 / 4, 15 / 4, 35 / 32))
    d3, e3 = np.sqrt(105 / np.pi) / 2, np.sqrt(21 / 32 / np.pi)
    columns = [
        np.full_like(x, SH_C0),
        -c1 * y,
        c1 * z,
        -c1 * x,
        c2 * x * y,
        -c2 * y * z,
        np.sqrt(5 / np.pi) / 4 * (2 * zz - xx - yy),
        -c2 * x * z,
        c2 / 2 * (xx - yy),
        -c3 * y * (3 * xx - yy),
        d3 * x * y * z,
        -e3 * y * (4 * zz - xx - yy),
        np.sqrt(7 / np.pi) / 4 * z * (2 * zz - 3 * xx - 3 * yy),
        -e3 * x * (4 * zz - xx - yy),
        d3 / 2 * z * (xx - yy),
        -c3 * x * (xx - 3 * yy),
    ]
    return np.stack(columns, 1)
