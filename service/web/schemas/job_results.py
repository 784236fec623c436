"""The record of each step of a job, and the result, as the API returns them."""

from __future__ import annotations

from pydantic import Field

from service.results import Reason, Status
from service.types import IntrinsicsSource
from service.web.api_model import Model
from service.web.schemas.anchors import SeenAnchor
from service.web.schemas.poses import (
    CameraOut,
    Covariance,
    GeoPose,
    IntrinsicsCorrectionOut,
    IntrinsicsOut,
    Matrix,
    PoseOut,
    ResultPose,
    Transform,
)
from service.web.schemas.registrations import RegisteredOut


class MatchesOut(Model):
    """Point matches between the photo and a render; entry i of each list belongs to match i. At most 300."""

    photo_px: list[list[float]]
    """x, y in pixels of the image that `/jobs/{id}/photo` returns."""
    render_px: list[list[float]]
    """x, y in pixels of `render_camera`, whose size may differ from the photo's."""
    inlier: list[bool]
    """Whether the match agrees with the camera that was estimated from all of them."""
    render_camera: CameraOut


class CandidatesOut(Model):
    """Candidate poses of a step, and their scores."""

    world_from_camera: list[Matrix]
    scores: list[float]
    """Higher is better; comparable within this record only."""


class FrameOut(Model):
    """The pose of one photo of a sequence, or of one frame of a video."""

    index: int
    """Number among the frames that were localized, from 0."""
    name: str
    """Name of the file, or `frame N` with its number in the video, from 0."""
    time_s: float
    """The time that was sent for it, or since the beginning of the video."""
    status: Status
    reason: Reason
    score: float
    """Probability that the pose is as accurate as was asked for, as the result's."""
    right_place: float | None = None
    precise: float | None = None
    tracked: bool
    """Whether the pose was found by tracking from the previous frame; else the whole scene was searched."""
    world_from_camera: Transform
    """Best pose found, in OpenCV camera axes. Use it only if `status` is `localized`."""
    covariance: Covariance | None


class Record(Model):
    """One step of a job; of a job with several photos, one photo."""

    index: int
    """Number of the record, from 0 in each attempt."""
    stage: str
    """Name of the estimator's stage that made the step."""
    world_from_camera: Matrix
    """4x4. Best pose so far: the answer if the job ended here."""
    intrinsics_correction: IntrinsicsCorrectionOut
    """Estimated with the pose where the photo's intrinsics are approximate; else no correction."""
    elapsed_s: float
    """Wall time since the start of the job."""
    cpu_s: float
    """CPU time since the start of the job."""
    loss: float | None
    """Value of the stage's objective function; comparable within a stage only."""
    num_matches: int | None
    num_inliers: int | None
    """How many of the matches agree with the pose."""
    step_deg: float | None
    """Rotation of the pose in this step."""
    step_units: float | None
    """Translation of the pose in this step, in scene units."""
    matches: MatchesOut | None
    candidates: CandidatesOut | None
    frame: FrameOut | None = None
    """Of a job with several photos: this photo's answer. `world_from_camera` is then the last pose that was
    localized."""


class Timing(Model):
    """Time that a stage took."""

    stage: str
    wall_s: float
    cpu_s: float


class SceneRef(Model):
    """A scene, and the version of its file."""

    id: str
    sha256: str
    """Of the scene file."""


class RankedScene(Model):
    """How well a photo fits one of several scenes."""

    id: str
    inliers: int
    """Matches with one of the scene's views that agree with one camera."""


class Alternative(Model):
    """Another pose that explains the photo."""

    probability: float
    """0..1, given that one of the poses is right; the result's `pose` has the remaining probability."""
    pose: PoseOut


class AskedOut(Model):
    """The accuracy that was asked for, at this pose."""

    deg: float
    units: float
    """In scene units; of a share of the distance to what is seen, at this pose."""


class Result(Model):
    """The pose with its verification and provenance. `not_localized` is a result, not an error."""

    status: Status
    """`localized`: use the pose. `uncertain`: check it. `not_localized`: don't use it."""
    reason: Reason
    """What decided the status."""
    search_summary: str = ""
    """What the search found, in a sentence: how many matches, and how many of them agree on a pose. Empty for a pose
    that is localized, and where the method matches nothing."""
    hint: str
    """What to do about the reason; empty for a pose that is localized."""
    advice: list[str] = Field(default_factory=list)
    """What would help this photo, by what was seen in it and at the pose, the most helpful first: where to turn,
    whether to step back, what is wrong with the picture. At most three sentences; empty for a pose that is
    localized."""
    score: float
    """Probability, 0..1, that the pose is as accurate as was asked for: `right_place` times `precise`."""
    right_place: float | None = None
    """Probability, 0..1, that the pose is in the right place (within 5 degrees and 1/80 of the distance to the scene),
    by how photo and scene agree there. `localized` needs 0.8. Null in results of version 0.1.0, as the next two."""
    precise: float | None = None
    """Probability, 0..1, that a pose in the right place is within the bounds asked for, by its covariance. `localized`
    needs 0.91."""
    asked: AskedOut | None = None
    pose: ResultPose
    """Best pose found. Use it only if `status` is `localized`."""
    alternatives: list[Alternative] = Field(default_factory=list)
    """Other poses that explain the photo, most probable first. If one of them is nearly as probable as `pose`, the
    result is `uncertain` and its reason `ambiguous`."""
    geopose: GeoPose | None
    """The pose on Earth, for scenes that are registered there, or whose manifest has a `geo_anchor`."""
    registered: RegisteredOut | None = None
    """The pose in metres, for scenes that are registered."""
    anchors: list[SeenAnchor] = Field(default_factory=list)
    """The scene's anchors as the photo's camera sees them; none if the photo is not localized."""
    intrinsics: IntrinsicsOut
    """Camera model used for the whole upright photo."""
    intrinsics_source: IntrinsicsSource
    """Where the intrinsics come from. Unless the request gave them as exact, focal length, radial distortion and
    principal point were then estimated together with the pose. `memory`: earlier photos of the same camera. `fisheye`:
    the photo's matches, by which its lens is a fisheye instead of what was sent or assumed; `warnings` says so."""
    fitting_intrinsics: IntrinsicsOut | None = None
    """Of exact intrinsics that the photo contradicts (`reason` is `intrinsics_contradicted`): those that fit it."""
    focal_sigma_px: float | None
    """Standard deviation of the estimated focal length; null if it was given as exact."""
    inliers: int
    """Matches between the photo and the scene rendered at the pose that agree with the pose."""
    gradient_correlation: float
    """Normalized cross-correlation of the gradients of photo and render, -1..1, over the best three quarters."""
    coverage: float
    """Share of the photo, 0..1, in which the rendered scene is opaque."""
    signals: dict[str, float]
    """Inputs of the verification's probability model, by name."""
    covariance: Covariance | None
    """Uncertainty of the pose; null if the photo does not determine it, which an `uncertain` one always does."""
    covariance_given_lens: Covariance | None = None
    """Uncertainty of the pose if the estimated intrinsics were the true ones; null if they were given as exact."""
    timings: list[Timing]
    """Time by stage, in order of the stages; `decode` is reading the photo."""
    budget_exhausted: bool
    """Whether `budget_s` ended the search."""
    seed: int
    estimator: str
    matcher: str
    rasterizer: str
    scene: SceneRef
    """The scene whose frame the pose is in."""
    scene_ranking: list[RankedScene] = Field(default_factory=list)
    """If several scenes were requested: how well the photo fits each, best first."""
    versions: dict[str, str]
    """Versions of the packages that the result depends on."""
    warnings: list[str]
    frames: list[FrameOut] | None = None
    """Of a job with several photos or a video: the answer for each. The other fields are then of the last photo that
    was localized, except `timings`, which are sums over all; `/jobs/{id}/photo` returns the same photo."""
