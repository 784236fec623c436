"""Poses, cameras and their uncertainty as the API returns them.

Matrices are row-major nested lists. Every pose is in OpenCV camera axes (+x right, +y down, +z forward)
unless its field says `opengl`. The world is the scene's own frame; lengths are scene units. The centre of
the top-left pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from service.web.api_model import Model

Matrix = list[list[float]]


class Transform(Model):
    """A rigid transform target_from_source, in two representations: a matrix, and translation with quaternion."""

    matrix: Matrix
    """4x4, target_from_source."""
    translation: list[float]
    """Last column of the matrix: the origin of the source frame in the target frame."""
    quaternion_wxyz: list[float]
    """Rotation as a unit quaternion with w >= 0."""


class Axes(Model):
    """A camera pose in both directions."""

    world_from_camera: Transform
    """The pose of the camera; its translation is the camera's position in the world."""
    camera_from_world: Transform
    """The inverse: the extrinsics of COLMAP and OpenCV."""


class PoseOut(Axes):
    """A camera pose. `world_from_camera` and `camera_from_world` are in OpenCV camera axes."""

    convention: Literal["opencv"] = "opencv"
    position: list[float]
    """Camera centre in the world, in scene units."""
    opengl: Axes
    """The same pose with OpenGL's camera axes (+y up, +z backwards), as Blender and nerfstudio use."""


class SceneFrameOut(Model):
    """Another frame than the world, that the scene's user knows."""

    name: str
    """`file`: the scene file's. `cameras`: that of the camera file (`transforms.json`, `sparse/0`, `cameras.json`)."""
    frame_from_world: Matrix
    """4x4: rotation, translation and one scale."""
    decided_by: str
    """In words: what the transform follows from."""
    verified: bool
    """Whether photos or geometry exclude other transforms; else take it as a guess."""


class PoseInFrame(PoseOut):
    """The same camera pose in another frame: its world axes, origin and unit."""

    frame: SceneFrameOut


class ResultPose(PoseOut):
    """The result's camera pose, in the world and in each of the scene's other frames."""

    frames: list[PoseInFrame] = Field(default_factory=list)
    """A photo that the scene was trained with has, in the frame `cameras`, the pose that its own file has."""


class IntrinsicsOut(Model):
    """A camera model of the upright image, in pixels."""

    model: str
    """Name of the camera model in COLMAP, e.g. PINHOLE."""
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: list[float]
    """Parameters of the COLMAP model after focal lengths and principal point."""
    trust: Literal["exact", "approximate"]
    """`approximate`: focal length and principal point are estimated together with the pose."""


class IntrinsicsCorrectionOut(Model):
    """Difference between the estimated and the assumed intrinsics of the photo."""

    focal_factor: float
    """Estimated over assumed focal length."""
    shift_x: float
    """Of the principal point to the right, as a share of the image's longer side."""
    shift_y: float
    """Of the principal point downwards, as a share of the image's longer side."""
    k1: float
    """Radial distortion beside that of the assumed intrinsics, as in COLMAP's SIMPLE_RADIAL."""


class CameraOut(Model):
    """Intrinsics and pose of a camera, in OpenCV camera axes."""

    intrinsics: IntrinsicsOut
    world_from_camera: Matrix


class NamedCameraOut(CameraOut):
    """A training camera."""

    name: str
    """Of its image file."""


class Covariance(Model):
    """Covariance of a pose: of the right perturbation of world_from_camera, true = estimate @ exp(twist)."""

    frame: Literal["camera"] = "camera"
    order: tuple[str, ...] = ("rx_rad", "ry_rad", "rz_rad", "tx_units", "ty_units", "tz_units")
    matrix: Matrix
    """6x6, in the units of `order`."""
    sigma_deg: float
    """Square root of the trace of the rotation block, in degrees."""
    sigma_units: float
    """Square root of the trace of the translation block, in scene units."""


class RegionOut(Model):
    """Where a prior admits poses: a box around the camera centre, or a Gaussian around the prior pose."""

    box: Matrix | None = None
    """Lower and upper corner of an axis-aligned box in the world."""
    covariance: Covariance | None = None


class GeoPosition(Model):
    """A position on WGS84."""

    lat: float = Field(ge=-90, le=90)
    """Degrees."""
    lon: float = Field(ge=-180, le=180)
    """Degrees."""
    h: float
    """Metres above the ellipsoid."""


class GeoQuaternion(Model):
    """A unit quaternion."""

    x: float
    y: float
    z: float
    w: float


class GeoPose(Model):
    """OGC GeoPose 1.0, Basic-Quaternion: position and orientation of the camera on Earth.

    The quaternion rotates camera axes (of OpenGL and WebXR: +x right, +y up, +z backwards) to the local East-North-Up
    frame at the camera.
    """

    position: GeoPosition
    quaternion: GeoQuaternion
