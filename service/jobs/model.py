"""What a job is: the request (JobSpec), the stored job with its records and its result. Plain and picklable values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from service.accuracy import DEFAULT_ACCURACY, Accuracy
from service.device_readings import DeviceReadings
from service.errors import Failure
from service.lenses.lens_memory import RecalledLens
from service.registration.registration import Registration
from service.results import IterationRecord, PoseEstimate, Reason, StageTiming, Status
from service.scene_manager.status import AUTO
from service.types import GeoAnchor, Intrinsics, Pose, PriorRegion, Rig

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled", "interrupted"]
ENDED: tuple[JobState, ...] = ("succeeded", "failed", "cancelled", "interrupted")


@dataclass(frozen=True, slots=True)
class LensUse:
    """What a job has to do with the memory of lenses."""

    owner: str
    """Among whose lenses the photo's is."""
    recalled: RecalledLens | None
    """What was known of it when the job was accepted: its prior, also after a restart."""


@dataclass(frozen=True, slots=True)
class JobSpec:
    """How a photo, or several, are to be localized: a request without its photo. Validated by whoever makes it."""

    estimator: str
    scene: str | tuple[str, ...] | None = None
    """None: the only one. Several, or AUTO for all that are ready: the photo is looked for in each."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the estimator's `Options`, those that were given; JSON values that its constructor takes."""
    intrinsics: Intrinsics | None = None
    """Of the upright photo; None: as estimated from earlier photos of the camera, from EXIF data, or guessed."""
    camera_id: str | None = None
    """What the caller calls the camera."""
    lens: LensUse | None = None
    """Decided when the job is accepted; None: lenses aren't remembered."""
    prior: Pose | None = None
    """A guess, which may be wrong."""
    region: PriorRegion | None = None
    """Poses outside are no answers."""
    readings: DeviceReadings | None = None
    """What the device measured beside the photo, of several beside the first."""
    exif_gps: bool = False
    """Whether EXIF's position and heading of each photo are readings, too, where `readings` has none."""
    truth: Pose | None = None
    """Kept for whoever measures errors; no estimator sees it."""
    every: int = 1
    """Of a sequence: use each Nth photo."""
    times_s: tuple[float, ...] | None = None
    """When each photo of a sequence was taken, ascending."""
    rig: Rig | None = None
    """Of several photos that are one query; None: they are a sequence."""
    seed: int = 0
    budget_s: float | None = None
    """Wall time after which the best pose so far is the answer."""
    deadline_s: float | None = None
    """Seconds after acceptance by which the job must have started."""
    keep_photo: bool = False
    """Keep the upright photo as long as the job."""
    accuracy: Accuracy = DEFAULT_ACCURACY
    """How accurate a pose must be to be localized."""

    @property
    def names_several_scenes(self) -> bool:
        """Whether the photo is looked for in more than one scene."""
        return self.scene == AUTO or isinstance(self.scene, tuple)


@dataclass(frozen=True, slots=True)
class PhotoInfo:
    """The photo as it was decoded for the job; of several, the first."""

    name: str
    """Of the file as it was sent."""
    sha256: str
    """Of the file's bytes."""
    intrinsics: Intrinsics
    """Pinhole, of the decoded photo."""


@dataclass(frozen=True, slots=True)
class SequenceFrame:
    """Where one photo of a sequence, or of a rig, was taken."""

    index: int
    """Among those that were looked at, from 0."""
    name: str
    time_s: float
    status: Status
    reason: Reason
    score: float
    tracked: bool
    """From the photo before, without a search."""
    pose: Pose
    covariance: Float64[np.ndarray, "6 6"] | None
    """As a verdict's."""
    right_place: float | None = None
    precise: float | None = None
    """Both as a verdict's."""


@dataclass(frozen=True, slots=True)
class JobRecord:
    """One step of a job; of a sequence, one photo."""

    step: IterationRecord
    frame: SequenceFrame | None = None
    """Of a sequence: this photo's answer; the step's pose is then the last that was localized."""


@dataclass(frozen=True, slots=True)
class JobResult:
    """The answer of a job that succeeded."""

    estimate: PoseEstimate
    """Without the trace: of its records only the last, without matches and candidates."""
    decode: StageTiming
    """What reading the photo took."""
    geo_anchor: GeoAnchor | None
    """Of the scene that the pose is in."""
    versions: Mapping[str, str]
    """Of the packages that the result depends on."""
    frames: tuple[SequenceFrame, ...] | None = None
    """Of a sequence: each photo's answer; the estimate is the last that was localized. Of a rig likewise; the estimate
    is of the first photo."""
    registration: Registration | None = None
    """Of the scene, without residuals: the revision in force when the attempt began."""


@dataclass(frozen=True, slots=True)
class NewJob:
    """A job as it is accepted."""

    id: str
    client: str
    """Whose it is: the API key's by name and id, or an address's. The scope of idempotency keys, and who may see it."""
    idempotency_key: str | None
    digest: str
    """SHA-256 of the validated request and its photo: decides whether a repeated key means the same."""
    created: float
    """Seconds since 1970, like all times here."""
    deadline: float | None
    """After that the job needn't start."""
    scene: str
    """Of several, one of them until it is known which."""
    estimator: str
    spec: JobSpec
    photo: PhotoInfo
    photo_sha256: str
    photo_bytes: int
    """Of the file as it was sent."""
    keep_photo: bool


@dataclass(frozen=True, slots=True)
class StoredJob(NewJob):
    """A job as the store has it; its records and its result are read separately."""

    number: int
    """In the order of acceptance."""
    state: JobState
    attempt: int
    """How often it was started."""
    lost: int
    """Attempts whose lease expired before they ended."""
    cancelled: bool
    """Cancellation was requested."""
    started: float | None
    finished: float | None
    photo_until: float | None
    """When the photo of an ended job is deleted; None: with the job."""
    records: int
    """How many the latest attempt has."""
    stage: str | None
    """Of the latest record."""
    status: Status | None
    """Of the result."""
    score: float | None
    failure: Failure | None
    """Why it ended without a result."""

    @property
    def ended(self) -> bool:
        """Whether it is in a state that it can't leave."""
        return self.state in ENDED


@dataclass(frozen=True, slots=True)
class JobFilter:
    """Which jobs to list; None: any."""

    scene: str | None = None
    estimator: str | None = None
    state: JobState | None = None
    status: Status | None = None
    """Of the result."""
    photo_sha256: str | None = None
    before: int | None = None
    """Only jobs accepted before the one with that number."""
    client: str | None = None


@dataclass(frozen=True, slots=True)
class Batch:
    """Successive records of an attempt."""

    first: int
    """The first one's number."""
    records: Sequence[JobRecord]


@dataclass(frozen=True, slots=True)
class Ending:
    """How an attempt ended."""

    state: JobState
    result: JobResult | None = None
    failure: Failure | None = None
    scene: str | None = None
    """The one that the photo shows, where it was looked for in several."""


@dataclass(frozen=True, slots=True)
class Retention:
    """How much is kept of what has ended; whatever is reached first counts."""

    jobs: int
    seconds: float
    bytes: int
