"""Jobs on disk (SQLite, WAL): what is accepted here survives a crash. The only file with sqlite3.

Every change of state is a compare-and-set on (state, attempt), so a job can't end twice, whatever threads or
processes believe. Commits are `synchronous=FULL`: when a method returns, its change is on disk.
"""

from __future__ import annotations

import sqlite3
import threading
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path

from service.errors import IdempotencyConflict, JobNotFound, StorageFailed

# One entry takes the file one version up; an entry that was released is never changed.
_MIGRATIONS = (
    """
    CREATE TABLE jobs (
        number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE, client TEXT NOT NULL,
        idempotency_key TEXT, digest TEXT NOT NULL, state TEXT NOT NULL, attempt INTEGER NOT NULL DEFAULT 0,
        cancelled INTEGER NOT NULL DEFAULT 0, crashes INTEGER NOT NULL DEFAULT 0,
        created REAL NOT NULL, started REAL, finished REAL, deadline REAL,
        scene TEXT NOT NULL, estimator TEXT NOT NULL, fields TEXT NOT NULL, photo TEXT NOT NULL,
        photo_sha256 TEXT NOT NULL, photo_bytes INTEGER NOT NULL, photo_until REAL,
        keep_photo INTEGER NOT NULL, records INTEGER NOT NULL DEFAULT 0, stage TEXT, status TEXT, score REAL,
        result TEXT, error TEXT, bytes INTEGER NOT NULL DEFAULT 0
    );
    CREATE UNIQUE INDEX job_by_key ON jobs (client, idempotency_key) WHERE idempotency_key IS NOT NULL;
    CREATE INDEX job_by_state ON jobs (state);
    CREATE INDEX job_by_photo ON jobs (photo_sha256);
    CREATE TABLE events (
        job TEXT NOT NULL, attempt INTEGER NOT NULL, seq INTEGER NOT NULL, record BLOB NOT NULL,
        UNIQUE (job, attempt, seq)
    );
    """,
)
_ENDED = ("succeeded", "failed", "cancelled", "interrupted")
_ENDED_SQL = ", ".join(f"'{state}'" for state in _ENDED)


@dataclass(frozen=True, slots=True)
class NewJob:
    """A job as it is accepted. Nested values are JSON text."""

    id: str
    client: str
    """Whose it is: the scope of idempotency keys."""
    idempotency_key: str | None
    digest: str
    """Of the request's meaning: tells whether a repeated key means the same."""
    created: float
    """Seconds since 1970, like all times here."""
    deadline: float | None
    """After that the job needn't start."""
    scene: str
    estimator: str
    fields: str
    photo: str
    photo_sha256: str
    photo_bytes: int
    keep_photo: bool


@dataclass(frozen=True, slots=True)
class StoredJob(NewJob):
    number: int
    """In the order of acceptance."""
    state: str
    attempt: int
    """How often it was started."""
    cancelled: bool
    """Somebody wants it to end."""
    started: float | None
    finished: float | None
    photo_until: float | None
    """When the photo of an ended job is deleted; None: with the job."""
    records: int
    stage: str | None
    status: str | None
    score: float | None
    result: str | None
    error: str | None

    @property
    def ended(self) -> bool:
        return self.state in _ENDED


@dataclass(frozen=True, slots=True)
class JobFilter:
    """Which jobs to list; None: any."""

    scene: str | None = None
    estimator: str | None = None
    state: str | None = None
    status: str | None = None
    """Of the result."""
    photo_sha256: str | None = None
    before: int | None = None
    """Only jobs accepted before the one with that number."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Successive records of an attempt, as JSON."""

    first: int
    """The first one's number."""
    records: Sequence[str]
    stage: str | None
    """Of the last record."""


@dataclass(frozen=True, slots=True)
class Ending:
    """How an attempt ended. Nested values are JSON text."""

    state: str
    status: str | None = None
    score: float | None = None
    result: str | None = None
    error: str | None = None
    scene: str | None = None
    """The one that the photo shows, where it was looked for in several."""


@dataclass(frozen=True, slots=True)
class Retention:
    """How much is kept of what has ended; whatever is reached first counts."""

    jobs: int
    seconds: float
    bytes: int


_JOB_COLUMNS = ", ".join(field.name for field in fields(StoredJob))


class JobStore:
    """One file, one process (a lock file sees to that elsewhere), any number of threads."""

    def __init__(self, path: Path) -> None:
        """Open the file or make it, and bring it to the present version. Raises StorageFailed."""
        self._path = path
        self._writing, self._reading = threading.Lock(), threading.Lock()
        try:
            self._writer = self._connection()
            self._migrate()
            self._reader = self._connection()
        except sqlite3.Error as error:
            raise StorageFailed(f"{path} can't be used: {error}.", where="data_dir") from error

    def close(self) -> None:
        with self._writing, self._reading:
            self._writer.close()
            self._reader.close()

    def _connection(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self._path, timeout=10, isolation_level=None, check_same_thread=False)
        connection.execute("PRAGMA auto_vacuum = INCREMENTAL")  # only in a new file, before its first table
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        return connection

    def _migrate(self) -> None:
        (version,) = self._writer.execute("PRAGMA user_version").fetchone()
        if version > len(_MIGRATIONS):
            raise StorageFailed(
                f"{self._path} has version {version}, this program knows up to {len(_MIGRATIONS)}.",
                where="data_dir",
                hint="Run the newer program, or name another data_dir.",
            )
        for number in range(version, len(_MIGRATIONS)):
            self._writer.executescript(f"BEGIN; {_MIGRATIONS[number]}; PRAGMA user_version = {number + 1}; COMMIT;")

    # ------------------------------------------------------------------ the life of a job

    def accept(self, job: NewJob) -> StoredJob:
        """Store a new job, or return the one that has its key. Raises IdempotencyConflict, StorageFailed."""
        names = [field.name for field in fields(NewJob)]
        row = f"INSERT INTO jobs ({', '.join(names)}, state) VALUES ({', '.join('?' * len(names))}, 'queued')"
        with self._transaction() as writer:
            known = _repeated(writer, job.client, job.idempotency_key, job.digest)
            if known is None:
                writer.execute(row, [getattr(job, name) for name in names])
                known = _job(_select(writer, "WHERE id = ?", job.id)[0])
        return known

    def repeated(self, client: str, key: str | None, digest: str) -> StoredJob | None:
        """Return the job that has the client's idempotency key. Raises IdempotencyConflict."""
        with self._reading:
            return _repeated(self._reader, client, key, digest)

    def knows(self, client: str, key: str) -> bool:
        """Return whether the client has used that idempotency key."""
        with self._reading:
            return bool(_select(self._reader, "WHERE client = ? AND idempotency_key = ?", client, key))

    def probe(self) -> None:
        """Write something. Raises StorageFailed."""
        with self._transaction() as writer:
            writer.execute(f"PRAGMA user_version = {len(_MIGRATIONS)}")

    def claim(self, job: StoredJob) -> int | None:
        """Start the next attempt; return its number, or None if the job isn't what the caller believes."""
        with self._transaction() as writer:
            changed = writer.execute(
                "UPDATE jobs SET state = 'running', attempt = attempt + 1, started = ?, records = 0, stage = NULL "
                "WHERE id = ? AND state = 'queued' AND attempt = ? AND NOT cancelled",
                (time.time(), job.id, job.attempt),
            ).rowcount
            writer.execute("DELETE FROM events WHERE job = ? AND attempt <= ?", (job.id, job.attempt))
        return job.attempt + 1 if changed else None

    def append(self, job_id: str, attempt: int, batch: Batch) -> bool:
        """Store some of an attempt's records. False if the attempt is over."""
        with self._transaction() as writer:
            return _append(writer, job_id, attempt, batch)

    def finish(self, job_id: str, attempt: int, batch: Batch, ending: Ending, photo_until: float | None) -> bool:
        """Store an attempt's last records and its end, once. False if the attempt is over."""
        size = len(ending.result or "") + len(ending.error or "")
        with self._transaction() as writer:
            if not _append(writer, job_id, attempt, batch):
                return False
            writer.execute(
                "UPDATE jobs SET state = ?, status = ?, score = ?, result = ?, error = ?, "
                "scene = coalesce(?, scene), finished = ?, "
                "photo_until = CASE WHEN keep_photo THEN NULL ELSE ? END, bytes = ? + photo_bytes + "
                "(SELECT coalesce(sum(length(record)), 0) FROM events WHERE job = jobs.id) WHERE id = ?",
                (
                    *(ending.state, ending.status, ending.score, ending.result, ending.error),
                    *(ending.scene, time.time(), photo_until, size, job_id),
                ),
            )
        return True

    def end_queued(self, job: StoredJob, ending: Ending, photo_until: float | None) -> bool:
        """End a job that waits. False if it doesn't."""
        with self._transaction() as writer:
            changed = writer.execute(
                "UPDATE jobs SET state = ?, error = ?, finished = ?, bytes = photo_bytes, "
                "photo_until = CASE WHEN keep_photo THEN NULL ELSE ? END "
                "WHERE id = ? AND state = 'queued' AND attempt = ?",
                (ending.state, ending.error, time.time(), photo_until, job.id, job.attempt),
            ).rowcount
        return bool(changed)

    def ask_to_cancel(self, job_id: str) -> None:
        """Put on record that an unfinished job shall end: a restart must not run it again."""
        with self._transaction() as writer:
            writer.execute(f"UPDATE jobs SET cancelled = 1 WHERE id = ? AND state NOT IN ({_ENDED_SQL})", (job_id,))

    def requeue(self, job_id: str, attempt: int) -> bool:
        """Let an attempt that was stopped on purpose be made again."""
        with self._transaction() as writer:
            changed = writer.execute(
                "UPDATE jobs SET state = 'queued' WHERE id = ? AND state = 'running' AND attempt = ?", (job_id, attempt)
            ).rowcount
        return bool(changed)

    def recover(self, crashes: int, interrupted: Ending) -> list[StoredJob]:
        """Sort out what an ended process left: return the jobs that wait, oldest first.

        What was running waits again, unless it was cancelled, or has been running in `crashes` crashes: it may be
        what causes them.
        """
        now = time.time()
        ends = f"finished = {now}, bytes = photo_bytes, photo_until = CASE WHEN keep_photo THEN NULL ELSE {now} END"
        with self._transaction() as writer:
            writer.execute(
                f"UPDATE jobs SET state = 'cancelled', {ends} WHERE cancelled AND state NOT IN ({_ENDED_SQL})"
            )
            writer.execute("UPDATE jobs SET crashes = crashes + 1 WHERE state = 'running'")
            writer.execute(
                f"UPDATE jobs SET state = ?, error = ?, {ends} WHERE state = 'running' AND crashes >= ?",
                (interrupted.state, interrupted.error, crashes),
            )
            writer.execute("UPDATE jobs SET state = 'queued' WHERE state = 'running'")
            return [_job(row) for row in _select(writer, "WHERE state = 'queued' ORDER BY number")]

    # ------------------------------------------------------------------ reading

    def get(self, job_id: str) -> StoredJob:
        """Raises JobNotFound."""
        with self._reading:
            rows = _select(self._reader, "WHERE id = ?", job_id)
        if not rows:
            raise JobNotFound(f"there is no job '{job_id}', or it was forgotten.", where="job")
        return _job(rows[0])

    def page(self, wanted: JobFilter, limit: int) -> list[StoredJob]:
        """Return the newest jobs that fit, at most `limit`."""
        tests = {
            "scene = ?": wanted.scene,
            "estimator = ?": wanted.estimator,
            "state = ?": wanted.state,
            "status = ?": wanted.status,
            "photo_sha256 = ?": wanted.photo_sha256,
            "number < ?": wanted.before,
        }
        given = {test: value for test, value in tests.items() if value is not None}
        where = f"WHERE {' AND '.join(given)} " if given else ""
        with self._reading:
            rows = _select(self._reader, f"{where}ORDER BY number DESC LIMIT ?", *given.values(), limit)
        return [_job(row) for row in rows]

    def count(self, state: str) -> int:
        with self._reading:
            return self._reader.execute("SELECT count(*) FROM jobs WHERE state = ?", (state,)).fetchone()[0]

    def records(self, job_id: str, first: int = 0) -> list[str]:
        """Return the records of the latest attempt that has any, from number `first` on, as JSON."""
        with self._reading:
            rows = self._reader.execute(
                "SELECT record FROM events WHERE job = ? AND seq >= ? "
                "AND attempt = (SELECT attempt FROM jobs WHERE id = ?) ORDER BY seq",
                (job_id, first, job_id),
            ).fetchall()
        return [zlib.decompress(data).decode() for (data,) in rows]

    # ------------------------------------------------------------------ forgetting

    def stale_photos(self) -> list[str]:
        """Return the ended jobs whose photo is due for deletion, and take note that it is gone."""
        with self._transaction() as writer:
            rows = writer.execute(
                f"UPDATE jobs SET photo_until = NULL, keep_photo = 0, bytes = bytes - photo_bytes, photo_bytes = 0 "
                f"WHERE photo_until < ? AND state IN ({_ENDED_SQL}) RETURNING id",
                (time.time(),),
            ).fetchall()
        return [job_id for (job_id,) in rows]

    def forget(self, kept: Retention) -> list[str]:
        """Delete the oldest ended jobs beyond what shall be kept; return their ids."""
        with self._transaction() as writer:
            ended = "SELECT id, finished, row_number() OVER newest AS place, sum(bytes) OVER newest AS total "
            ended += f"FROM jobs WHERE state IN ({_ENDED_SQL}) WINDOW newest AS (ORDER BY number DESC)"
            chosen = f"SELECT id FROM ({ended}) WHERE place > ? OR total > ? OR finished < ?"
            ids = writer.execute(chosen, (kept.jobs, kept.bytes, time.time() - kept.seconds)).fetchall()
            writer.executemany("DELETE FROM jobs WHERE id = ?", ids)
            writer.executemany("DELETE FROM events WHERE job = ?", ids)
        if ids:
            with self._writing:
                self._writer.execute("PRAGMA incremental_vacuum").fetchall()
        return [job_id for (job_id,) in ids]

    def ids(self) -> set[str]:
        with self._reading:
            return {job_id for (job_id,) in self._reader.execute("SELECT id FROM jobs")}

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._writing:
            try:
                self._writer.execute("BEGIN IMMEDIATE")
                yield self._writer
                self._writer.execute("COMMIT")
            except BaseException as error:
                if self._writer.in_transaction:
                    self._writer.execute("ROLLBACK")
                if isinstance(error, sqlite3.Error):
                    raise StorageFailed(f"the service can't write its jobs to disk: {error}.") from error
                raise


def _select(connection: sqlite3.Connection, where: str, *values: object) -> list[tuple]:
    return connection.execute(f"SELECT {_JOB_COLUMNS} FROM jobs {where}", values).fetchall()


def _repeated(connection: sqlite3.Connection, client: str, key: str | None, digest: str) -> StoredJob | None:
    rows = _select(connection, "WHERE client = ? AND idempotency_key = ?", client, key) if key is not None else []
    known = _job(rows[0]) if rows else None
    if known and known.digest != digest:
        raise IdempotencyConflict(
            f"the key was used for job {known.id}, which was another request.",
            where="header.idempotency-key",
            hint="Use a new key for a new request.",
        )
    return known


def _job(row: tuple) -> StoredJob:
    return StoredJob(*row)


def _append(writer: sqlite3.Connection, job_id: str, attempt: int, batch: Batch) -> bool:
    changed = writer.execute(
        "UPDATE jobs SET records = ?, stage = ? WHERE id = ? AND state = 'running' AND attempt = ?",
        (batch.first + len(batch.records), batch.stage, job_id, attempt),
    ).rowcount
    if changed:
        rows = enumerate((zlib.compress(text.encode(), 1) for text in batch.records), batch.first)
        writer.executemany(
            "INSERT INTO events VALUES (?, ?, ?, ?)", [(job_id, attempt, seq, record) for seq, record in rows]
        )
    return bool(changed)
