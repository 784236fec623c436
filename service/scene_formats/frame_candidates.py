"""Where a scene's training cameras may be, if their file and the scene file don't share frame or conventions.

A candidate corrects the poses (their axes, or that they are inverse), and moves their world into the scene file's
frame. What other files of the folder state comes first, then the usual confusions, then trainers' normalizations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations, product

import numpy as np
from jaxtyping import Float64

from service.scene_formats.normalizations import (
    COLMAP_TO_Z_UP,
    as_nerfstudio_trained,
    gsplat_normalizations,
    nerfstudio_normalizations,
)
from service.scene_formats.similarity import moved_pose
from service.types import Camera, NamedCamera, Pose

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Between camera axes of OpenCV and OpenGL; of worlds, between PLY's (y down) and SPZ's (y up)."""


def _turns() -> dict[str, Float64[np.ndarray, "4 4"]]:
    """Return the rotations that exchange or negate axes, by name; flips of y and z first, and no identity."""
    found = {}
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.eye(4)
            matrix[:3, :3] = np.array(signs)[:, None] * np.eye(3)[list(order)]
            if np.linalg.det(matrix) > 0:
                axes = (f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for sign, axis in zip(signs, order, strict=True))
                found[f"world axes x, y, z are {', '.join(axes)}"] = matrix
    usual = [FLIP, COLMAP_TO_Z_UP, COLMAP_TO_Z_UP.T]
    by_use = sorted(found.items(), key=lambda named: not any(np.array_equal(named[1], u) for u in usual))
    return {name: matrix for name, matrix in by_use if not np.array_equal(matrix, np.eye(4))}


_TURNS = _turns()


@dataclass(frozen=True, slots=True)
class Stated:
    """What files beside the scene say of its frame."""

    name: str
    file_from_cameras: Float64[np.ndarray, "4 4"]
    is_model_frame: bool = False
    """It was written by the trainer of this very scene (`dataparser_transforms.json`)."""
    is_measured: bool = False
    """It was found by localizing the photos of the cameras in the scene."""


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a camera file, as it is understood without any correction."""

    cameras: tuple[NamedCamera, ...]
    others: tuple[NamedCamera, ...] = ()
    """That were not trained with: trainers normalize with all."""
    stored_from_opencv: Float64[np.ndarray, "4 4"] | None = None
    """Change of camera axes that the reader undid; None: the file has OpenCV's."""
    read_points: Callable[[], Float64[np.ndarray, "p 3"] | None] = lambda: None
    """Of COLMAP's model."""
    stated: tuple[Stated, ...] = ()

    @cached_property
    def all_poses(self) -> Float64[np.ndarray, "n 4 4"]:
        return poses_of((*self.cameras, *self.others))


def poses_of(cameras: Sequence[NamedCamera]) -> Float64[np.ndarray, "n 4 4"]:
    """Return the world_from_camera matrices as one array."""
    return np.array([named.camera.pose.world_from_camera for named in cameras]).reshape(-1, 4, 4)


PLAIN = {
    "given": "",
    "flipped": "camera axes of the other family (OpenGL's for OpenCV's, or the reverse)",
    "inverse": "camera_from_world instead of world_from_camera",
    "inverse flipped": "camera_from_world with OpenGL's axes instead of world_from_camera",
}
"""Corrections of the poses alone, in words."""


@dataclass(frozen=True)
class Candidate:
    """One way to understand a camera file."""

    name: str
    """What differs from how it is usually understood; empty: nothing."""
    axes: str = "given"
    """given, flipped, inverse or inverse flipped: see `corrected`."""
    file_from_cameras: Float64[np.ndarray, "4 4"] | None = None
    """None: the camera file has the scene file's frame."""
    is_model_frame: bool = False
    is_measured: bool = False
    is_normalization: bool = False
    """It follows from the cameras; several that hardly differ from each other, or from no change, do."""

    def then(self, moved_from_file: Float64[np.ndarray, "4 4"]) -> Candidate:
        """Return the same with its cameras moved by a similarity."""
        before = np.eye(4) if self.file_from_cameras is None else self.file_from_cameras
        return replace(self, file_from_cameras=moved_from_file @ before)

    def placed(self, cameras: Sequence[NamedCamera], file: CameraFile) -> list[NamedCamera]:
        """Return the cameras in the scene file's frame."""
        poses = corrected(poses_of(cameras), self.axes, file.stored_from_opencv)
        found = []
        for named, matrix in zip(cameras, poses, strict=True):
            pose = Pose(matrix)
            if self.file_from_cameras is not None:
                pose = moved_pose(pose, self.file_from_cameras)
            found.append(NamedCamera(named.name, Camera(named.camera.intrinsics, pose)))
        return found


def corrected(
    poses: Float64[np.ndarray, "n 4 4"], axes: str, stored_from_opencv: Float64[np.ndarray, "4 4"] | None
) -> Float64[np.ndarray, "n 4 4"]:
    """Return world_from_camera in OpenCV's axes.

    `flipped`: the file has the other family's camera axes. `inverse`: it has camera_from_world, in OpenCV's axes;
    `inverse flipped`: in OpenGL's.
    """
    if axes.startswith("inverse"):
        stored = poses if stored_from_opencv is None else poses @ stored_from_opencv
        poses = np.linalg.inv(stored)
    return poses @ FLIP if axes.endswith("flipped") else poses


def candidates(file: CameraFile) -> Iterator[Candidate]:
    """Yield all ways to understand a camera file, the likelier ones first; the first one changes nothing."""
    yield Candidate("")
    for axes in ("given", "flipped"):
        poses = corrected(file.all_poses, axes, file.stored_from_opencv)
        for stated in file.stated:
            matrix = stated.file_from_cameras
            if stated.is_model_frame and len(poses):
                matrix = as_nerfstudio_trained(poses, matrix)
            yield Candidate(_both(PLAIN[axes], stated.name), axes, matrix, stated.is_model_frame, stated.is_measured)
    for axes, text in PLAIN.items():
        if axes != "given":
            yield Candidate(text, axes)
    for axes, text in PLAIN.items():
        for name, turn in _TURNS.items():
            yield Candidate(_both(text, name), axes, turn)
    if len(file.all_poses) < 2:
        return
    for axes in ("given", "flipped"):
        poses = corrected(file.all_poses, axes, file.stored_from_opencv)
        for name, similarity in _normalizations(poses, file):
            yield Candidate(_both(PLAIN[axes], name), axes, similarity, is_normalization=True)


def _normalizations(
    poses: Float64[np.ndarray, "n 4 4"], file: CameraFile
) -> Iterator[tuple[str, Float64[np.ndarray, "4 4"]]]:
    yield from nerfstudio_normalizations(poses)
    yield from gsplat_normalizations(poses, file.read_points())
    # nerfstudio turns COLMAP's world before it normalizes.
    for name, similarity in nerfstudio_normalizations(COLMAP_TO_Z_UP @ poses):
        yield f"{name} of COLMAP's world", similarity @ COLMAP_TO_Z_UP


def _both(a: str, b: str) -> str:
    return f"{a}; {b}" if a and b else a or b
