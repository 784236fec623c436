"""What callers send, as pydantic models."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from annotated_types import Len
from pydantic import Field

from service.photos.video import MAX_EVERY
from service.web.api_model import Model

Matrix4 = Annotated[list[Annotated[list[float], Len(4, 4)]], Len(4, 4)]
Matrix6 = Annotated[list[Annotated[list[float], Len(6, 6)]], Len(6, 6)]


class PoseIn(Model):
    """A pose: exactly one of the three spellings."""

    convention: Literal["opencv", "opengl"] = "opencv"
    """The camera axes of what is given."""
    world_from_camera: Matrix4 | None = None
    camera_from_world: Matrix4 | None = None
    position: list[float] | None = Field(default=None, min_length=3, max_length=3)
    """The camera's centre in the world; together with `quaternion_wxyz`."""
    quaternion_wxyz: list[float] | None = Field(default=None, min_length=4, max_length=4)
    """world_from_camera."""


class PriorIn(PoseIn):
    """What is known of the photo's pose: a guess, which may be wrong; or a Gaussian or a box that surely holds it.

    A guess is a pose and no more. With `sigma_deg` and `sigma_units`, or `covariance`, the pose is a Gaussian's mean.
    A `box` may stand alone or with a pose, a guess then. Poses beyond a Gaussian's 99.9 % or outside a box are
    rejected. Of several photos it is about the first.
    """

    sigma_deg: float | None = Field(default=None, gt=0, le=180, allow_inf_nan=False)
    """Standard deviation of the rotation, per axis. With 180 any direction is possible."""
    sigma_units: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Standard deviation of the camera's centre, per axis, in scene units."""
    covariance: Matrix6 | None = None
    """Instead of the two: of (rotation in rad, translation in scene units) in the camera's frame and OpenCV's axes, as
    results have it: true = pose @ exp(twist)."""
    box: Annotated[list[Annotated[list[float], Len(3, 3)]], Len(2, 2)] | None = None
    """Lower and upper corner, in the world, of a box along its axes that the camera's centre is in."""


class RenderIn(Model):
    """A picture of a scene."""

    pose: PoseIn
    intrinsics: dict[str, Any] | None = None
    """Pinhole: `width, height, fx, fy, cx, cy`. Left out: those of the first training camera, or 640 x 480."""
    format: Literal["png", "jpeg", "depth"] = "png"
    """`depth` is a NumPy file (.npy): float32 of height x width, z-depth in scene units, 0 where nothing is."""
    quality: int = Field(default=90, ge=1, le=100)
    """JPEG's."""


class LocalizeFields(Model):
    """What is sent beside the photo."""

    scene: str | Annotated[list[str], Len(1, 100)] | None = None
    """May be left out when the service has exactly one scene. A list, or `auto` for all that are ready: the photo is
    looked for in each, and the result names the one that it shows. In a form, a list is JSON text."""
    estimator: str | None = None
    """See `/capabilities`; left out: the default one."""
    options: dict[str, Any] = Field(default_factory=dict)
    """The estimator's options; `/capabilities` has their schema."""
    intrinsics: dict[str, Any] | None = None
    """Of the upright photo: `width, height, fx, fy, cx, cy`, COLMAP's `model` and `distortion`, and `trust`: `exact`
    (the default), or `approximate`, whose focal length is estimated with the pose. Left out: taken from the EXIF
    data, or guessed; approximate then."""
    prior: PriorIn | None = None
    truth: PoseIn | None = None
    """The true pose, where it is known: kept with the job for whoever measures errors, out of the estimator's sight."""
    every: int = Field(default=1, ge=1, le=MAX_EVERY)
    """Of a video, or several photos: use each Nth, beginning with the first."""
    times_s: list[float] | None = Field(default=None, min_length=2)
    """When each of several photos was taken, in seconds, ascending; a video tells it itself."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    budget_s: float | None = Field(default=None, gt=0, le=3600, allow_inf_nan=False)
    """Wall time after which the best pose so far is the answer."""
    deadline_s: float | None = Field(default=None, gt=0, le=86_400, allow_inf_nan=False)
    """Seconds from now after which an answer is of no use: a job that hasn't started by then fails."""
    keep_photo: bool = False
    """Keep the photo, upright and without EXIF data, as long as the job; else it is deleted after the job."""


class LocalizeIn(LocalizeFields):
    """A request to localize a photo, as a JSON body; a multipart form has the same names.

    In a form, `options`, `intrinsics`, `prior`, `truth` and `times_s` are JSON text, and `photo` is a file, or several
    of one camera, in the order in which they were taken.
    """

    photo: str = Field(json_schema_extra={"contentEncoding": "base64"})
    """JPEG, PNG, WebP or HEIC; or a video (MP4, MOV, WebM, Matroska, AVI), whose frames are localized one by one."""
