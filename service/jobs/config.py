"""How jobs are run and kept, and who watches them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from service.jobs.model import StoredJob
from service.jobs.read_photo import MAX_FRAMES


@dataclass(frozen=True, slots=True)
class JobsConfig:
    """How many jobs run and wait, when one is given up, and how much is kept of those that ended."""

    workers: int = 1
    """Jobs that run at once; each has one thread."""
    queue_size: int = 32
    """Jobs that may wait."""
    queue_bytes: int = 500_000_000
    """Decoded photos that may wait in memory."""
    max_job_s: float = 300.0
    """The longest budget of a job; also of one that sets none."""
    max_frames: int = MAX_FRAMES
    """Photos, or frames of a video, in one job."""
    stuck_s: float = 120.0
    """A job without a new record for so long is given up, and its thread replaced."""
    lease_s: float = 30.0
    """A worker that doesn't renew its lease for so long loses the attempt."""
    max_lost: int = 3
    """A job that lost so many attempts is not run again."""
    shutdown_s: float = 10.0
    """What running jobs get to finish when the service ends."""
    keep_jobs: int = 10_000
    """Ended jobs that are remembered."""
    keep_days: float = 30.0
    keep_bytes: int = 2_000_000_000
    """What ended jobs may take on disk, with their records and photos."""
    photo_grace_s: float = 900.0
    """How long after its job a photo can be looked at, unless it is kept; 0: not at all."""


class Observer(Protocol):
    """Receives events of jobs, e.g. for metrics; each method is called on the thread where the event occurs."""

    def started(self, waited_s: float) -> None:
        """A job was started, so long after it was accepted."""
        ...

    def ended(self, job: StoredJob, seconds: float | None) -> None:
        """A job ended, `seconds` after its start; None if it never started."""
        ...

    def stage(self, estimator: str, stage: str, seconds: float) -> None:
        """A job that succeeded spent that time on a stage."""
        ...

    def renders(self, estimator: str, count: int) -> None:
        """A job that succeeded made so many renders."""
        ...
