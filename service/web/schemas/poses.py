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
    """A rigid motion target_from_source, in three spellings of the same thing."""

    matrix: Matrix
    """4x4, target_from_source."""
    translation: list[float]
    """The last column: where the source's origin lies in the target."""
    quaternion_wxyz: list[float]
    """The rotation, unit, w >= 0."""


class Axes(Model):
    world_from_camera: Transform
    """The pose of the camera; its translation is the camera's position in the world."""
    camera_from_world: Transform
    """The inverse: COLMAP's and OpenCV's extrinsics."""


class PoseOut(Axes):
    """Where the camera is. `world_from_camera` and `camera_from_world` are in OpenCV camera axes."""

    convention: Literal["opencv"] = "opencv"
    position: list[float]
    """The camera's centre in the world, scene units."""
    opengl: Axes
    """The same pose with OpenGL's camera axes (+y up, +z backwards), as Blender and nerfstudio use."""


class IntrinsicsOut(Model):
    """A camera model of the upright image, in pixels."""

    model: str
    """COLMAP's name."""
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: list[float]
    """COLMAP's parameters after focal lengths and principal point."""
    trust: Literal["exact", "approximate"]


class LensOut(Model):
    """How the photo's lens differs from the intrinsics assumed for it."""

    focal_factor: float
    shift_x: float
    """Of the principal point, in long sides of the image."""
    shift_y: float


class CameraOut(Model):
    intrinsics: IntrinsicsOut
    world_from_camera: Matrix


class NamedCameraOut(CameraOut):
    name: str


class Covariance(Model):
    """Of the right perturbation of world_from_camera: true = estimate @ exp(twist)."""

    frame: Literal["camera"] = "camera"
    order: tuple[str, ...] = ("rx_rad", "ry_rad", "rz_rad", "tx_units", "ty_units", "tz_units")
    matrix: Matrix
    """6x6."""
    sigma_deg: float
    """Square root of the trace of the rotation's block, in degrees."""
    sigma_units: float
    """Square root of the trace of the translation's block."""


class RegionOut(Model):
    """A box that holds the camera's centre, or the covariance of a Gaussian about the prior."""

    box: Matrix | None = None
    """Lower and upper corner in the world."""
    covariance: Covariance | None = None


class GeoPosition(Model):
    """On WGS84."""

    lat: float = Field(ge=-90, le=90)
    """Degrees."""
    lon: float = Field(ge=-180, le=180)
    """Degrees."""
    h: float
    """Metres above the ellipsoid."""


class GeoQuaternion(Model):
    x: float
    y: float
    z: float
    w: float


class GeoPose(Model):
    """OGC GeoPose 1.0, Basic-Quaternion: where on Earth the camera is, and how it is turned.

    The quaternion takes camera axes (OpenGL's and WebXR's: +x right, +y up, +z backwards) to the local East-North-Up
    frame at the camera.
    """

    position: GeoPosition
    quaternion: GeoQuaternion
