"""Bodies of requests as pydantic models."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from annotated_types import Len
from pydantic import Field

from service.errors import (
    BadInput,
    InvalidAccuracy,
    InvalidIntrinsics,
    InvalidOptions,
    InvalidPrior,
    InvalidRequest,
)
from service.photos.video import MAX_EVERY
from service.web.api_model import Model

Matrix4 = Annotated[list[Annotated[list[float], Len(4, 4)]], Len(4, 4)]
Matrix6 = Annotated[list[Annotated[list[float], Len(6, 6)]], Len(6, 6)]


class PoseIn(Model):
    """A camera pose: exactly one of `world_from_camera`, `camera_from_world`, or `position` with `quaternion_wxyz`."""

    convention: Literal["opencv", "opengl"] = "opencv"
    """Camera axes of the pose: +x right, +y down, +z forward (opencv), or +x right, +y up, +z backwards (opengl)."""
    world_from_camera: Matrix4 | None = None
    """4x4, row-major."""
    camera_from_world: Matrix4 | None = None
    """4x4, row-major: the extrinsics of COLMAP and OpenCV."""
    position: list[float] | None = Field(default=None, min_length=3, max_length=3)
    """Camera centre in the world, in scene units; together with `quaternion_wxyz`."""
    quaternion_wxyz: list[float] | None = Field(default=None, min_length=4, max_length=4)
    """Rotation of world_from_camera, of length 1."""


class PriorIn(PoseIn):
    """Prior knowledge of the photo's pose: an approximate pose, which may be wrong, or a Gaussian, or a box.

    An approximate pose is given by a pose alone. With `sigma_deg` and `sigma_units`, or with `covariance`, the pose is
    the mean of a Gaussian. A `box` may be given alone or with an approximate pose. Poses outside of the Gaussian's
    99.9 % region or of the box are rejected. Of several photos the prior is of the first.
    """

    sigma_deg: float | None = Field(default=None, gt=0, le=180, allow_inf_nan=False)
    """Standard deviation of the rotation, per axis. 180: the rotation is unknown."""
    sigma_units: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Standard deviation of the camera centre, per axis, in scene units."""
    covariance: Matrix6 | None = None
    """In place of the two sigmas: covariance of the twist (rotation in rad, translation in scene units) in the camera
    frame, in OpenCV axes, with true = pose @ exp(twist), as in results."""
    box: Annotated[list[Annotated[list[float], Len(3, 3)]], Len(2, 2)] | None = None
    """Lower and upper corner of an axis-aligned box in the world that contains the camera centre."""


class UpIn(Model):
    """Which way is up, as the device's accelerometer has it. Used in scenes that know their own up."""

    direction: Annotated[list[float], Len(3, 3)]
    """Up in the camera of the upright photo, in OpenCV axes (+x right, +y down, +z forward), of any length; of a level
    camera `[0, -1, 0]`."""
    sigma_deg: float = Field(default=1.0, ge=0.01, le=90, allow_inf_nan=False)
    """Standard deviation."""


class GpsIn(Model):
    """Where the device was on Earth (WGS84). Used in scenes that are registered there, or have a `geo_anchor`."""

    latitude: float = Field(ge=-90, le=90, allow_inf_nan=False)
    """Degrees."""
    longitude: float = Field(ge=-180, le=180, allow_inf_nan=False)
    """Degrees."""
    sigma_m: float = Field(ge=0.001, le=1e5, allow_inf_nan=False)
    """Standard deviation to the east, and to the north, in metres: of a radius that holds 68 %, as phones state it,
    two thirds."""
    height: float | None = Field(default=None, ge=-1e5, le=1e5, allow_inf_nan=False)
    """Metres above the ellipsoid, not above the sea."""
    height_sigma_m: float = Field(default=10.0, ge=0.001, le=1e5, allow_inf_nan=False)
    """Standard deviation of the height."""


class HeadingIn(Model):
    """Which way the camera looked, as the device's compass has it. Used in scenes that know where they are on Earth."""

    degrees: float = Field(ge=-360, le=360, allow_inf_nan=False)
    """Of the camera's axis, clockwise from true north."""
    sigma_deg: float = Field(default=15.0, ge=0.01, le=180, allow_inf_nan=False)
    """Standard deviation, of a level camera."""


class AccuracyIn(Model):
    """How accurate a pose must be to be `localized`: `deg`, and at most one of `units`, `metres` and `share`."""

    deg: float = Field(default=5.0, gt=0, le=180, allow_inf_nan=False)
    """Bound of the rotation's error, in degrees."""
    units: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Bound of the position's error in scene units."""
    metres: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """The same in metres, for scenes whose manifest has `metres_per_unit`."""
    share: float | None = Field(default=None, gt=0, le=1, allow_inf_nan=False)
    """The same relative to the distance to what is seen, the median depth of the scene rendered at the answer. Default,
    if `units` and `metres` are left out, too: 0.02."""


class RenderIn(Model):
    """An image to render of a scene."""

    pose: PoseIn
    intrinsics: dict[str, Any] | None = None
    """Pinhole camera: `width, height, fx, fy, cx, cy`. Default: the first training camera's, or 640 x 480."""
    format: Literal["png", "jpeg", "depth"] = "png"
    """`depth` is a NumPy file (.npy): float32 of height x width, z-depth in scene units, 0 where the scene is empty."""
    quality: int = Field(default=90, ge=1, le=100)
    """Quality of a JPEG."""


class RigCameraIn(Model):
    """One camera of a rig."""

    rig_from_camera: Matrix4
    """4x4, row-major: the camera's pose in the rig's frame, which may be any."""
    intrinsics: dict[str, Any]
    """As those of a request; always taken for exact."""


class RigIn(Model):
    """Cameras whose poses relative to one another are known: their photos are one query."""

    cameras: Annotated[list[RigCameraIn], Len(2, 8)]
    """In the order of the photos."""
    convention: Literal["opencv", "opengl"] = "opencv"
    """Camera axes of `rig_from_camera`."""
    metric: bool = False
    """Lengths are metres, for scenes whose manifest has `metres_per_unit`; default: scene units."""


class LocalizeFields(Model):
    """The fields of a request beside the photo."""

    scene: str | Annotated[list[str], Len(1, 100)] | None = None
    """Id of the scene; may be left out if the service has exactly one. With a list of ids, or `auto` for all scenes
    that are ready, the photo is searched in each, and the result names the scene that it shows. In a form, a list is
    JSON text."""
    estimator: str | None = None
    """Name of an estimator of `/capabilities`; default: the one that is marked there."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the estimator, by their schema in `/capabilities`."""
    intrinsics: dict[str, Any] | None = None
    """Camera model of the upright photo: `width, height, fx, fy, cx, cy`, `model` and `distortion` as in COLMAP, and
    `trust`: `exact` (the default), or `approximate`, so that focal length, radial distortion and principal point are
    estimated with the pose. Default: approximate intrinsics from earlier photos of the camera, the EXIF data, or a
    guess."""
    camera_id: str | None = Field(default=None, min_length=1, max_length=64, pattern=r"^[A-Za-z0-9._:@ -]+$")
    """A name of yours for the camera: the lens as estimated from its earlier photos is the prior of this one's, even
    without EXIF data. Of a phone name the phone: EXIF data distinguish its lenses; without these name the lens."""
    prior: PriorIn | None = None
    up_in_camera: UpIn | None = None
    """Gravity, measured beside the photo; of several photos, like `gps` and `heading`, beside the first. Each of the
    three is tested against the photo: one that contradicts it is left out, and a warning of the result names both
    values. Those that agree decide between places that look alike, and take part in pose and covariance."""
    gps: GpsIn | Literal["exif"] | None = None
    """Position of the device. `exif`: position and heading of the photo's EXIF data, which are not used else; of a
    sequence, of each photo that is searched for."""
    heading: HeadingIn | None = None
    """Compass heading of the camera."""
    accuracy: AccuracyIn | None = None
    """Default: within 5 degrees and 2 % of the distance to what is seen."""
    truth: PoseIn | None = None
    """Ground truth of the pose, if known. Stored with the job, to measure errors by; estimators don't get it."""
    every: int = Field(default=1, ge=1, le=MAX_EVERY)
    """Of a video, or several photos: use every Nth frame, beginning with the first."""
    times_s: list[float] | None = Field(default=None, min_length=2)
    """Time of each of several photos in seconds, ascending. A video has its own times."""
    rig: RigIn | None = None
    """Several photos are one query instead of a sequence: of cameras whose poses relative to one another are known. The
    result is of the first photo; `frames` has all."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Seed of the estimator's random numbers."""
    budget_s: float | None = Field(default=None, gt=0, le=3600, allow_inf_nan=False)
    """Wall time after which the search ends with the best pose so far."""
    deadline_s: float | None = Field(default=None, gt=0, le=86_400, allow_inf_nan=False)
    """Seconds from now by which the job must have started; else it fails."""
    keep_photo: bool = False
    """Keep the photo, upright and without EXIF data, as long as the job. Default: delete it after the job."""


FIELD_ERRORS: dict[str, type[BadInput]] = {
    "options": InvalidOptions,
    "intrinsics": InvalidIntrinsics,
    "prior": InvalidPrior,
    "up_in_camera": InvalidPrior,
    "gps": InvalidPrior,
    "heading": InvalidPrior,
    "accuracy": InvalidAccuracy,
    "truth": InvalidPrior,
    "times_s": InvalidRequest,
    "rig": InvalidRequest,
}
"""Fields that are JSON text in a form, and the error that an invalid one raises; other fields raise InvalidRequest."""


class LocalizeIn(LocalizeFields):
    """A request to localize a photo, as a JSON body; a multipart form has the same fields.

    In a form, `options`, `intrinsics`, `prior`, `up_in_camera`, `gps`, `heading`, `accuracy`, `truth`, `times_s` and
    `rig` are JSON text (or `gps` is `exif`), and `photo` is a file, or several of one camera, in the order in which
    they were taken, or of a rig.
    """

    photo: str = Field(json_schema_extra={"contentEncoding": "base64"})
    """JPEG, PNG, WebP or HEIC; or a video (MP4, MOV, WebM, Matroska, AVI), whose frames are localized one by one."""
