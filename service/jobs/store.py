"""Where jobs are kept, as a protocol; `sqlite_store` implements it for one process, `postgres_store` for several.

A worker owns an attempt from its claim until its lease ends, and renews the lease while it works. `reclaim` takes away
attempts whose lease has ended; records and results of an attempt that was lost are refused. So a job ends once, however
many workers, processes or machines share a store.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from service.errors import Failure, QueueFull
from service.jobs.model import Batch, Ending, JobFilter, JobRecord, JobResult, JobState, NewJob, Retention, StoredJob


class JobWatch(Protocol):
    """Hears of changes that other processes make to jobs of a store."""

    def wait(self, seconds: float) -> set[str]:
        """Return the ids of jobs that have changed, as soon as there are any, none after that time.

        Changes may be merged or missed (a connection was lost): whoever waits looks at the jobs now and then, too.
        """
        ...

    def close(self) -> None:
        """Let `wait` return; called on another thread."""
        ...


@runtime_checkable
class JobStore(Protocol):
    """Jobs with their records and results. Safe to call from several threads.

    A change is durable when its method returns; each raises StorageFailed if it can't be.
    """

    def watch(self) -> JobWatch | None:
        """Return what hears of changes by other processes; None: this process has the store for itself."""
        ...

    def now(self) -> float:
        """Return the time by the clock that leases go by, in seconds since 1970."""
        ...

    def accept(self, job: NewJob, most_queued: int | None = None) -> StoredJob:
        """Store a new job, or return the one that has its idempotency key.

        `most_queued`: how many jobs of the client may wait at once; None: as many as there are. Raises
        IdempotencyConflict, QueueFull.
        """
        ...

    def find_by_key(self, client: str, key: str | None, digest: str) -> StoredJob | None:
        """Return the job that has the client's idempotency key. Raises IdempotencyConflict."""
        ...

    def has_key(self, client: str, key: str) -> bool:
        """Return whether the client has used that idempotency key."""
        ...

    def reassign(self, client: str, to: str) -> None:
        """Give all jobs of a client to another one, with their idempotency keys."""
        ...

    def claim(self, job: StoredJob, lease_until: float) -> int | None:
        """Start the next attempt, whose lease ends then; return its number.

        None if the job has changed since `job` was read, or was cancelled. The records of earlier attempts go.
        """
        ...

    def renew(self, attempts: Sequence[tuple[str, int]], lease_until: float) -> None:
        """Let the leases of running attempts (job, number) end then; without effect on those that are over."""
        ...

    def reclaim(self, before: float, most_lost: int, failure: Failure) -> list[StoredJob]:
        """Take running attempts away whose lease ended before that time; return their jobs.

        The job is queued again; or it is cancelled if that was requested, or interrupted with `failure` if `most_lost`
        of its attempts were lost: it may be what crashes its workers.
        """
        ...

    def append(self, job_id: str, attempt: int, batch: Batch) -> bool:
        """Store some of an attempt's records. False if the attempt is over."""
        ...

    def finish(self, job_id: str, attempt: int, batch: Batch, ending: Ending, photo_until: float | None) -> bool:
        """Store an attempt's last records and its end, once. False if the attempt is over."""
        ...

    def requeue(self, job_id: str, attempt: int) -> bool:
        """Let an attempt that was stopped on purpose be made again; it isn't lost. False if it is over."""
        ...

    def end_queued(self, job: StoredJob, ending: Ending, photo_until: float | None) -> bool:
        """End a job that waits. False if it doesn't."""
        ...

    def request_cancel(self, job_id: str) -> None:
        """Put on record that an unfinished job shall end: it isn't started again."""
        ...

    def get(self, job_id: str) -> StoredJob:
        """Return a job. Raises JobNotFound."""
        ...

    def queued(self) -> list[StoredJob]:
        """Return the jobs that wait, oldest first."""
        ...

    def page(self, wanted: JobFilter, limit: int) -> list[StoredJob]:
        """Return the newest jobs that fit, at most `limit`."""
        ...

    def count(self, state: JobState, client: str | None = None) -> int:
        """Return how many jobs are in that state; of one client, or of all (None)."""
        ...

    def records(self, job_id: str, first: int = 0) -> list[JobRecord]:
        """Return the records of the latest attempt from number `first` on."""
        ...

    def result(self, job_id: str) -> JobResult | None:
        """Return what a job found; None if it has no result."""
        ...

    def expire_photos(self) -> list[str]:
        """Return the ended jobs whose photo is to be deleted now, and record that it is gone."""
        ...

    def prune(self, kept: Retention) -> list[str]:
        """Delete the oldest ended jobs beyond what shall be kept; return their ids."""
        ...

    def delete(self, job_id: str) -> bool:
        """Delete an ended job with its records and result. Return False if it hasn't ended, or is not there."""
        ...

    def ids(self) -> set[str]:
        """Return the ids of all jobs."""
        ...

    def probe(self) -> None:
        """Write something, to find out whether that is possible."""
        ...

    def close(self) -> None:
        """Close files and connections; nothing is called afterwards."""
        ...


def require_share(waiting: int, most: int) -> None:
    """Raise QueueFull if a client has as many jobs waiting as it may."""
    if waiting >= most:
        raise QueueFull(f"the queue is full: {waiting} jobs of this key, its share.", hint="Try again later.")
