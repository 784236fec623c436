"""Jobs as the API returns them."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from service.results import Status
from service.web.api_model import Model
from service.web.problems import Problem
from service.web.schemas.job_results import Record, Result
from service.web.schemas.poses import IntrinsicsOut, PoseOut, RegionOut

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled", "interrupted"]


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


class Trace(Model):
    """Everything that a job has told of itself so far."""

    job: str
    state: JobState
    attempt: int
    """The one whose records these are."""
    records: list[Record]
