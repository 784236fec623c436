"""Jobs as the API returns them."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from service.jobs.model import JobState
from service.results import Status
from service.web.api_model import Model
from service.web.problems import Problem
from service.web.schemas.job_results import Record, Result
from service.web.schemas.poses import IntrinsicsOut, PoseOut, RegionOut


class JobLinks(Model):
    """Paths on this service, with its sub-path if it has one."""

    self: str
    events: str
    photo: str
    trace: str
    render: str
    """The scene rendered at the latest pose."""
    export: str
    """To be followed by `/colmap`, `/nerfstudio`, `/tum` or `/geopose`."""
    viewer: str


class PhotoOut(Model):
    """The photo as it was decoded for the job: upright, undistorted, reduced if it was large."""

    name: str
    """Name of the file that was sent."""
    sha256: str
    """Of the file that was sent; equal for all jobs on the same photo."""
    intrinsics: IntrinsicsOut
    """Pinhole camera of the image that `/jobs/{id}/photo` returns."""


class JobSummary(Model):
    """A job as in the list of jobs."""

    id: str
    state: JobState
    scene: str
    """Id of the scene. If several were requested: one of them, until it is known which one the photo shows."""
    estimator: str
    photo: PhotoOut
    attempt: int
    """How many times the job was started; a crash of the service starts it again."""
    created: datetime
    started: datetime | None
    finished: datetime | None
    records: int
    """Number of records of the latest attempt so far."""
    stage: str | None
    """Stage of the latest record."""
    status: Status | None
    """Status of the result; null as long as there is none."""
    score: float | None
    """Score of the result."""
    links: JobLinks


class JobLensOut(Model):
    """The estimate of a job's lens from earlier photos, as it was when the job was accepted."""

    id: str
    """Of the lens in `/lenses`."""
    intrinsics: IntrinsicsOut
    """Of the upright photo; the search begins with them."""
    focal_sigma: float
    """Relative; the scale of a distribution with heavy tails."""
    k1_sigma: float
    principal_point_sigma: float
    """In long sides of the photo."""
    photos: int
    """How many photos it was learnt from."""


class JobOut(JobSummary):
    """A job with its result (state `succeeded`), or with the error of a job that has none (`failed`,
    `interrupted`)."""

    requested_scene: str | list[str] | None
    """`scene` of the request."""
    seed: int
    budget_s: float | None
    deadline: datetime | None
    """`deadline_s` of the request as a point in time."""
    options: dict[str, Any]
    camera_id: str | None = None
    """`camera_id` of the request."""
    lens: JobLensOut | None = None
    """Prior of the intrinsics by earlier photos of the same camera; null if there were none, or the request had
    intrinsics."""
    prior: PoseOut | None
    """The approximate pose of the request, or the mean of its Gaussian."""
    prior_region: RegionOut | None
    """Box or Gaussian of the request's prior; poses outside are rejected."""
    truth: PoseOut | None
    """`truth` of the request; not used by the search."""
    result: Result | None
    error: Problem | None
    """`code` is `deadline_exceeded`, `estimator_fault`, `device_memory_full` or `internal_error` for a failed job;
    for an interrupted one `interrupted` or the code of the scene's error."""


class JobList(Model):
    """One page of jobs."""

    jobs: list[JobSummary]
    """Newest first."""
    next: str | None
    """Path of the next page; null on the last one."""
    queued: int
    """Number of all queued jobs, whatever the filter."""
    running: int
    """Number of all running jobs, whatever the filter."""


class Restarted(Model):
    """A job was started again: the records of earlier attempts are void."""

    attempt: int
    """Number of the attempt whose records follow."""


class Trace(Model):
    """All records of a job's latest attempt so far."""

    job: str
    state: JobState
    attempt: int
    records: list[Record]
