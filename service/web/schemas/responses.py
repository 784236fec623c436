"""The JSON that the service answers with, as pydantic models; `requests` has what it is sent.

Matrices are row-major nested lists. Every pose is in OpenCV camera axes (+x right, +y down, +z forward)
unless its field says `opengl`. The world is the scene's own frame; lengths are scene units. The centre of
the top-left pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from service.results import Reason, Status

Matrix = list[list[float]]
JobState = Literal["queued", "running", "succeeded", "failed", "cancelled", "interrupted"]
SceneState = Literal["unloaded", "loading", "preparing", "ready", "unloading", "failed"]


class Model(BaseModel):
    model_config = ConfigDict(use_attribute_docstrings=True, extra="forbid")


class Problem(Model):
    """What went wrong, as RFC 9457 has it: the body of every error, `application/problem+json`."""

    type: str
    """`urn:splatfix:error:<code>`, or `about:blank` where the status says it all."""
    title: str
    status: int
    detail: str
    instance: str
    """The path that was asked for."""
    code: str
    """Stable, for programs."""
    where: str = ""
    """The field, file or element concerned; empty if there is none."""
    hint: str = ""
    """What to do about it."""


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


class MatchesOut(Model):
    """Matches between the photo and a render: row i of each list belongs together."""

    photo_px: list[list[float]]
    """x, y in pixels of the image that `/jobs/{id}/photo` returns."""
    render_px: list[list[float]]
    """x, y in pixels of `render_camera`, which need not have the photo's size."""
    inlier: list[bool]
    render_camera: CameraOut


class CandidatesOut(Model):
    """Poses that were weighed against one another."""

    world_from_camera: list[Matrix]
    scores: list[float]
    """Higher is better; comparable within this record only."""


class Covariance(Model):
    """Of the right perturbation of world_from_camera: true = estimate @ exp(twist)."""

    frame: Literal["camera"] = "camera"
    order: list[str] = ["rx_rad", "ry_rad", "rz_rad", "tx_units", "ty_units", "tz_units"]
    matrix: Matrix
    """6x6."""
    sigma_deg: float
    """Square root of the trace of the rotation's block, in degrees."""
    sigma_units: float
    """Square root of the trace of the translation's block."""


class FrameOut(Model):
    """Where one photo of a sequence, or one frame of a video, was taken."""

    index: int
    """Among those that were looked at, from 0."""
    name: str
    """Of the file, or `frame N`: its number in the video, from 0."""
    time_s: float
    """As it was sent, or since the video's beginning."""
    status: Status
    reason: Reason
    score: float
    followed: bool
    """From the photo before, without a search."""
    world_from_camera: Transform
    """The best pose found, in OpenCV camera axes. Don't use it unless `status` is `localized`."""
    covariance: Covariance | None


class Record(Model):
    """One step of a job; of a job with several photos, one photo."""

    index: int
    stage: str
    world_from_camera: Matrix
    """4x4: the best pose so far, which would be the answer if the job were stopped here."""
    lens: LensOut
    """What goes with the pose where the photo's intrinsics are approximate."""
    elapsed_s: float
    """Wall time since the job's start."""
    cpu_s: float
    """CPU time since then."""
    loss: float | None
    """The stage's own objective; comparable within a stage only."""
    num_matches: int | None
    num_inliers: int | None
    step_deg: float | None
    step_units: float | None
    matches: MatchesOut | None
    candidates: CandidatesOut | None
    frame: FrameOut | None = None
    """Of a job with several photos: this one's answer. `world_from_camera` is then the last that was localized."""


class Trace(Model):
    """Everything that a job has told of itself so far."""

    job: str
    state: JobState
    attempt: int
    """The one whose records these are."""
    records: list[Record]


class Timing(Model):
    stage: str
    wall_s: float
    cpu_s: float


class SceneRef(Model):
    id: str
    sha256: str


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


class Considered(Model):
    """A scene that a photo was compared with."""

    id: str
    matches: int
    """With one of its views, that agree on one camera."""


class Alternative(Model):
    """Another answer."""

    probability: float
    """0..1, if one of the answers is right; the result's `pose` has what is left."""
    pose: PoseOut


class Result(Model):
    """The answer, what it rests on, and how it came about. "Not localized" is an answer, too."""

    status: Status
    reason: Reason
    hint: str
    """What to do about the reason; empty if all is well."""
    score: float
    """Probability, 0..1, that the pose is right (within 5 degrees and 1/80 of the distance to the scene); at least 0.8
    is `localized`."""
    pose: PoseOut
    """The best pose found. Don't use it unless `status` is `localized`."""
    alternatives: list[Alternative] = []
    """Other poses that explain the photo, too, most probable first. With a `pose` that isn't far more probable than
    these the result is `uncertain`, and its reason `ambiguous`."""
    geopose: GeoPose | None
    """The same on Earth, for scenes whose manifest has a `geo_anchor`."""
    intrinsics: IntrinsicsOut
    """Used for the whole upright photo."""
    intrinsics_source: Literal["given", "exif", "guessed"]
    """Unless they are `exact`, focal length and principal point were estimated from there."""
    focal_sigma_px: float | None
    """Standard deviation of the estimated focal length; null where it was given as exact."""
    inliers: int
    agreement: float
    """Correlation of the gradients of photo and render, -1..1."""
    coverage: float
    """Share of the photo in which the scene is rendered opaque."""
    signals: dict[str, float]
    """All that the gate measured at the pose, by name."""
    covariance: Covariance | None
    timings: list[Timing]
    """By stage, in order; `decode` is the photo's."""
    budget_exhausted: bool
    seed: int
    estimator: str
    matcher: str
    rasterizer: str
    scene: SceneRef
    """The one that the pose is in."""
    considered: list[Considered] = []
    """Where several scenes were asked for: how well each fits, best first."""
    versions: dict[str, str]
    warnings: list[str]
    frames: list[FrameOut] | None = None
    """Of a job with several photos or a video: each one's answer. All else in the result is of the last photo that was
    localized, but for `timings`, which are all photos' together; `/jobs/{id}/photo` shows it, too."""


class JobLinks(Model):
    """Paths on this service, with its sub-path if it has one."""

    self: str
    events: str
    photo: str
    trace: str
    render: str
    """The scene rendered at the latest pose."""
    export: str
    """Followed by `/colmap`, `/nerfstudio`, `/tum` or `/geopose`."""
    viewer: str


class PhotoOut(Model):
    """The photo as it was decoded for the job: upright, undistorted, perhaps reduced."""

    name: str
    sha256: str
    """Of the file as it was sent: jobs on the same photo share it."""
    intrinsics: IntrinsicsOut
    """Pinhole, of the image that `/jobs/{id}/photo` returns."""


class JobSummary(Model):
    id: str
    state: JobState
    scene: str
    """Where several were asked for, one of them until it is known which."""
    estimator: str
    photo: PhotoOut
    attempt: int
    """How often it was started: again after a crash of the service."""
    created: datetime
    started: datetime | None
    finished: datetime | None
    records: int
    """How many steps it has told of."""
    stage: str | None
    """Of the latest record."""
    status: Status | None
    """Of the result, when there is one."""
    score: float | None
    links: JobLinks


class RegionOut(Model):
    """A box that holds the camera's centre, or the covariance of a Gaussian about the prior."""

    box: Matrix | None = None
    """Lower and upper corner in the world."""
    covariance: Covariance | None = None


class JobOut(JobSummary):
    """A job with its result (state `succeeded`), or the error for which it has none (`failed`, `interrupted`)."""

    scene_asked: str | list[str] | None
    """As it was sent."""
    seed: int
    budget_s: float | None
    deadline: datetime | None
    """When the answer was of no use any more, if that was said."""
    options: dict[str, Any]
    prior: PoseOut | None
    """The guess, or a Gaussian's mean."""
    region: RegionOut | None
    """Where the prior says that the camera is for certain."""
    truth: PoseOut | None
    """As it was sent; no part of the search."""
    result: Result | None
    error: Problem | None
    """`code`: `deadline_exceeded`, `estimator_fault` or `internal_error` of a failed job; of an interrupted one
    `interrupted` or what is wrong with the scene."""


class JobList(Model):
    jobs: list[JobSummary]
    """Newest first."""
    next: str | None
    """The path of the next page; None: this is the last."""
    queued: int
    """Of all jobs, whatever the filter; so is `running`."""
    running: int


class SceneLinks(Model):
    self: str
    splats: str
    thumbnail: str


class SceneSummary(Model):
    id: str
    name: str
    state: SceneState
    gaussians: int | None
    """None until it is loaded; so are the other counts."""
    sh_degree: int | None
    cameras: int | None
    memory_bytes: int | None
    jobs: int
    """That use it, waiting or running."""
    error: Problem | None
    """Why it failed to load."""
    links: SceneLinks


class NamedCameraOut(CameraOut):
    name: str


class SceneOut(SceneSummary):
    sha256: str | None
    format: str | None
    background_rgb: list[float] | None
    up_in_world: list[float] | None
    metres_per_unit: float | None
    render_mode: str | None
    bounds_in_world: list[list[float]] | None
    """Lower and upper corner of the box that holds the middle 98 % of the Gaussians along each axis."""
    warnings: list[str]
    training_cameras: list[NamedCameraOut]


class SceneList(Model):
    scenes: list[SceneSummary]


class Capability(Model):
    name: str
    available: bool
    reason: str | None
    """Why it can't run here."""
    default: bool = False
    source: str
    """Where it comes from: `built-in`, `plug-in folder`, or an installed package with its version."""


class EstimatorCapability(Capability):
    options_schema: dict[str, Any] | None
    """JSON Schema of the form field `options`."""


class Capabilities(Model):
    estimators: list[EstimatorCapability]
    matchers: list[Capability]
    rasterizers: list[Capability]
    scene_formats: list[Capability]
    max_upload_bytes: int
    max_wait_s: float


class Readiness(Model):
    ready: bool
    awaited: list[str]
    """What is not done yet; empty when ready."""
    failed: list[str]
    """Scenes that could not be loaded, a disk that can't be written to, workers that are stuck; with the reason."""
    rasterizers: list[str]
    """What the scenes in memory are rendered with: `cpu`, `gsplat_cuda`."""
    passed_over: list[str]
    """Why no GPU is used, where the operator left the choice."""


class Token(Model):
    token: str
    """Stands for the key that it was made with: in `?token=` of a page, or as Bearer."""
    seconds: float
    """How long it is valid."""


class Liveness(Model):
    alive: Literal[True] = True
