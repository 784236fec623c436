"""Seeded start poses for estimators that need one, by the paper's protocols and others.

near, easy, hard: the perturbation of iComMa and the paper, start = T Rz Ry Rx gt, acting in the normalized *world*
frame (origin in the focus), so that its rotations orbit the camera about the scene. Per axis |angle| is in 0..30
degrees and |t| in 0..0.5 units (easy), 30..60 and 0.5..1.0 (hard), signs at random. `near` is for the losses
(Table 1), for which the paper says only "near the truth": 0..2 and 0..0.05, about the error after DO.
pnerf: rotated about the camera's centre, per world axis -15..15 degrees, and translated, per axis -0.25..0.25 units.
inplace: rotated by 15 to 40 degrees about a random axis through the camera's centre.
random: a position in the bounding box of the training cameras, with a uniformly random rotation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from service.bench.pose_metrics import Units
from service.errors import UnknownName
from service.geometry import rotation_from_quat, so3_exp
from service.types import Camera, Pose

_WORLD_PERTURBATIONS = {
    "near": ((0.0, 2.0), (0.0, 0.05)),
    "easy": ((0.0, 30.0), (0.0, 0.5)),
    "hard": ((30.0, 60.0), (0.5, 1.0)),
}
"""Ranges of the angle in degrees and the translation in normalized units, per axis."""
PNERF_DEG, PNERF_UNITS = 15.0, 0.25
INPLACE_DEG = (15.0, 40.0)
KINDS = ("none", *_WORLD_PERTURBATIONS, "pnerf", "inplace", "random")


def require_kind(kind: str) -> None:
    """Raise UnknownName unless `kind` is one of `KINDS`."""
    if kind not in KINDS:
        raise UnknownName(f"unknown start '{kind}'; known: {', '.join(KINDS)}.", where="start")


def start_pose(
    kind: str, truth: Pose, units: Units, cameras: Sequence[Camera], rng: np.random.Generator
) -> Pose | None:
    """Return a start pose in the world frame; None for kind 'none'.

    `cameras` are the training cameras, for kind 'random'. Raises UnknownName.
    """
    require_kind(kind)
    if kind == "none":
        return None
    if kind in _WORLD_PERTURBATIONS:
        return _perturbed_in_world(truth, units, *_WORLD_PERTURBATIONS[kind], rng)
    matrix = truth.world_from_camera.copy()
    if kind == "inplace":
        # A normalized Gaussian 3-vector is a uniformly random direction.
        axis = rng.normal(size=3)
        angle = np.radians(rng.uniform(*INPLACE_DEG))
        matrix[:3, :3] = matrix[:3, :3] @ so3_exp(angle * axis / np.linalg.norm(axis))
    elif kind == "pnerf":
        matrix[:3, :3] = _rotation_xyz(np.radians(rng.uniform(-PNERF_DEG, PNERF_DEG, 3))) @ matrix[:3, :3]
        matrix[:3, 3] += rng.uniform(-PNERF_UNITS, PNERF_UNITS, 3) / units.units_per_scene_unit
    else:
        positions = np.stack([camera.pose.position_in_world for camera in cameras])
        # A normalized Gaussian 4-vector is a uniformly random rotation.
        matrix[:3, :3] = rotation_from_quat(rng.normal(size=4))
        matrix[:3, 3] = rng.uniform(positions.min(0), positions.max(0))
    return Pose(matrix)


def _perturbed_in_world(
    truth: Pose,
    units: Units,
    degrees: tuple[float, float],
    lengths: tuple[float, float],
    rng: np.random.Generator,
) -> Pose:
    signs = rng.choice([-1.0, 1.0], 6)
    angles = np.radians(rng.uniform(*degrees, 3)) * signs[:3]
    rotation = _rotation_xyz(angles)
    shift: Float64[np.ndarray, "3"] = rng.uniform(*lengths, 3) * signs[3:]
    matrix = np.eye(4)
    matrix[:3, :3] = rotation @ truth.world_from_camera[:3, :3]
    # Ranges of the protocol are in normalized units.
    offset = (truth.position_in_world - units.focus_in_world) * units.units_per_scene_unit
    # About the focus, as the protocol rotates in the normalized world frame.
    moved = rotation @ offset + shift
    matrix[:3, 3] = moved / units.units_per_scene_unit + units.focus_in_world
    return Pose(matrix)


def _rotation_xyz(angles: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Return Rz Ry Rx; angles in rad."""
    rotation = np.eye(3)
    for axis in range(3):
        rotation = so3_exp(angles[axis] * np.eye(3)[axis]) @ rotation
    return rotation
