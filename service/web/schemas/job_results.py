"""What a job reports and finds, as the API returns it: the record of each step, and the result."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from service.results import Reason, Status
from service.web.api_model import Model
from service.web.schemas.poses import CameraOut, Covariance, GeoPose, IntrinsicsOut, LensOut, Matrix, PoseOut, Transform


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


class Timing(Model):
    stage: str
    wall_s: float
    cpu_s: float


class SceneRef(Model):
    id: str
    sha256: str


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
    alternatives: list[Alternative] = Field(default_factory=list)
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
    considered: list[Considered] = Field(default_factory=list)
    """Where several scenes were asked for: how well each fits, best first."""
    versions: dict[str, str]
    warnings: list[str]
    frames: list[FrameOut] | None = None
    """Of a job with several photos or a video: each one's answer. All else in the result is of the last photo that was
    localized, but for `timings`, which are all photos' together; `/jobs/{id}/photo` shows it, too."""
