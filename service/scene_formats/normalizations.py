"""How trainers move a data set's world before they train: functions of its cameras, from their documentation.

nerfstudio (docs: "Data conventions", data parsers' `orientation_method`, `center_method`, `auto_scale_poses`) turns the
mean up direction of the cameras to z, centres them, and scales them into a cube of side 2. gsplat's `simple_trainer`
turns their mean up direction to -y, centres where their axes pass the origin, and scales their median distance to 1;
with a point cloud its principal axes become the world's.

Each function returns model_from_data: a 4x4 similarity. Poses are world_from_camera with OpenCV's axes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

Poses = Float64[np.ndarray, "n 4 4"]
Similarity = Float64[np.ndarray, "4 4"]

COLMAP_TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""What nerfstudio applies to COLMAP's world, whose -y it takes for up."""
_LEVEL = 0.17
"""The cameras' x axes span a plane if the second singular value is this, times the root of their number."""
_ROUNDS = 20
_UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
_ALIKE = 0.01
"""Of unit vectors: trainers compute in float32."""
_SIGNS = {
    "": np.eye(4),
    ", upside down": _UPSIDE_DOWN,
    ", turned about y": np.diag([-1.0, 1.0, -1.0, 1.0]),
    ", turned about z": np.diag([-1.0, -1.0, 1.0, 1.0]),
}
"""Eigenvectors have no sign: which one a trainer got depends on its linear algebra library and precision."""


def nerfstudio_normalizations(poses: Poses) -> Iterator[tuple[str, Similarity]]:
    """Yield those of every combination of nerfstudio's options, its defaults first; the identity is left out."""
    for scaled in (True, False):
        for turn in ("up", "vertical", "pca", "none"):
            for centre in ("poses", "focus", "none"):
                if not scaled and (turn, centre) == ("none", "none"):
                    continue
                for turned, signs in _SIGNS.items() if turn == "pca" else [("", _SIGNS[""])]:
                    name = f"orientation {turn}{turned}, centre {centre}{', scaled' if scaled else ''}"
                    similarity = nerfstudio_normalization(poses, turn, centre, scaled, signs)
                    yield f"nerfstudio's normalization ({name})", similarity


def nerfstudio_normalization(
    poses: Poses, orientation: str, centre: str, scaled: bool, signs: Similarity = _SIGNS[""]
) -> Similarity:
    """Return nerfstudio's normalization with these options; `orientation` is up, vertical, pca or none.

    `signs` are those of pca's eigenvectors, relative to numpy's.
    """
    positions = poses[:, :3, 3]
    middle = positions.mean(0)
    away = {"poses": middle, "focus": _focus(poses, middle), "none": np.zeros(3)}[centre]
    rotation = _orientation(poses, orientation, signs)
    moved = (positions - away) @ rotation.T
    scale = 1.0 / max(float(np.abs(moved).max()), 1e-12) if scaled else 1.0
    return _similarity(scale, rotation, -scale * rotation @ away)


def as_nerfstudio_trained(poses: Poses, model_from_data: Similarity) -> Similarity:
    """Return nerfstudio's normalization as its model has it, from how `dataparser_transforms.json` has it.

    They differ with orientation pca: cameras that come out upside down are turned about x, which isn't written.
    """
    rotation = model_from_data[:3, :3] / np.cbrt(np.linalg.det(model_from_data[:3, :3]))
    for world in (np.eye(4), COLMAP_TO_Z_UP):
        signs = _main_axes(world @ poses).T @ rotation @ world[:3, :3].T
        is_by_pca = np.abs(np.abs(signs) - np.eye(3)).max() < _ALIKE
        if is_by_pca and _looks_down(poses, rotation):
            return _UPSIDE_DOWN @ model_from_data
    return model_from_data


def _looks_down(poses: Poses, rotation: Float64[np.ndarray, "3 3"]) -> bool:
    return bool((rotation @ -poses[:, :3, 1].mean(0))[2] < 0)


def _main_axes(poses: Poses) -> Float64[np.ndarray, "3 3"]:
    """Return the principal axes of the positions as columns, right-handed, that of the largest spread first."""
    centred = poses[:, :3, 3] - poses[:, :3, 3].mean(0)
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1].copy()
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    return axes


def _orientation(poses: Poses, method: str, signs: Similarity = _SIGNS[""]) -> Float64[np.ndarray, "3 3"]:
    if method == "none":
        return np.eye(3)
    if method == "pca":
        # Applied as they are, not transposed.
        axes = _main_axes(poses) @ signs[:3, :3]
        return _UPSIDE_DOWN[:3, :3] @ axes if _looks_down(poses, axes) else axes
    up = _unit(-poses[:, :3, 1].mean(0))
    if method == "vertical":
        # Photos are held level: their x axes lie in the horizontal plane.
        _, singular, axes = np.linalg.svd(poses[:, :3, 0], full_matrices=False)
        if len(singular) > 2 and singular[1] > _LEVEL * np.sqrt(len(poses)):
            up = axes[2] if axes[2] @ up > 0 else -axes[2]
        else:
            up = _unit(up - axes[0] * (axes[0] @ up))
    return rotation_between(up, np.array([0.0, 0.0, 1.0]))


def _focus(poses: Poses, start: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """Return the point nearest to the optical axes, of those cameras that look towards it."""
    positions, axes, point = poses[:, :3, 3], poses[:, :3, 2], start
    for _ in range(_ROUNDS):
        across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
        try:
            point = np.linalg.solve(across.mean(0), (across @ positions[:, :, None]).mean(0)[:, 0])
        except np.linalg.LinAlgError:  # parallel axes
            return point
        ahead = ((point - positions) * axes).sum(1) > 0
        if ahead.all() or ahead.sum() < 2:
            break
        positions, axes = positions[ahead], axes[ahead]
    return point


def gsplat_normalizations(poses: Poses, points: Float64[np.ndarray, "p 3"] | None) -> Iterator[tuple[str, Similarity]]:
    """Yield those of gsplat's trainer: by the cameras, and with a point cloud by its principal axes, too."""
    for centre in ("focus", "poses"):
        for farthest in (False, True):
            by_cameras = gsplat_normalization(poses, centre, farthest)
            name = f"gsplat's normalization (centre {centre}{', strict scaling' if farthest else ''}"
            if points is not None and len(points) > 3:
                turned = _principal_axes(points @ by_cameras[:3, :3].T + by_cameras[:3, 3])
                for about, signs in _SIGNS.items():
                    yield f"{name}, principal axes{about})", signs @ turned @ by_cameras
            yield f"{name})", by_cameras


def gsplat_normalization(poses: Poses, centre: str, strict: bool) -> Similarity:
    """Return gsplat's normalization by the cameras; `strict` scales the farthest camera to 1, not the median one."""
    up = _unit(-poses[:, :3, 1].mean(0))
    rotation = rotation_between(up, np.array([0.0, -1.0, 0.0]), opposite=np.diag([-1.0, -1.0, 1.0]))
    positions, axes = poses[:, :3, 3] @ rotation.T, poses[:, :3, 2] @ rotation.T
    nearest = positions + (axes * -positions).sum(1, keepdims=True) * axes
    away = np.median(nearest if centre == "focus" else positions, axis=0)
    distances = np.linalg.norm(positions - away, axis=1)
    scale = 1.0 / max(float(distances.max() if strict else np.median(distances)), 1e-12)
    return _similarity(scale, rotation, -scale * away)


def _principal_axes(points: Float64[np.ndarray, "p 3"]) -> Similarity:
    middle = np.median(points, axis=0)
    axes = np.linalg.eigh(np.cov(points - middle, rowvar=False))[1][:, ::-1].copy()
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    return _similarity(1.0, axes.T, -axes.T @ middle)


def rotation_between(
    source: Float64[np.ndarray, "3"],
    target: Float64[np.ndarray, "3"],
    opposite: Float64[np.ndarray, "3 3"] | None = None,
) -> Float64[np.ndarray, "3 3"]:
    """Return the least rotation that takes one unit vector to another; `opposite` where they are each other's."""
    cosine = float(source @ target)
    if cosine < -1 + 1e-9:
        if opposite is not None:
            return opposite
        side = _unit(np.cross(source, np.eye(3)[np.argmin(np.abs(source))]))
        return 2 * np.outer(side, side) - np.eye(3)
    x, y, z = np.cross(source, target)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def _unit(vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _similarity(scale: float, rotation: Float64[np.ndarray, "3 3"], offset: Float64[np.ndarray, "3"]) -> Similarity:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * rotation, offset
    return matrix
