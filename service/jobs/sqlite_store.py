"""Jobs on disk (SQLite): what is accepted here survives a crash.

Every change of state is a compare-and-set on (state, attempt), so a job can't end twice, even if several
threads or processes try to end it. When a method returns, its change is on disk.
Specs, photos' data, records and results are JSON text of `codec`.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from service.codec import decode, encode
from service.errors import Failure, IdempotencyConflict, JobNotFound
from service.jobs.migrate_0_1 import old_failure, old_photo, old_result, old_spec
from service.jobs.model import (
    ENDED,
    Batch,
    Ending,
    JobFilter,
    JobRecord,
    JobResult,
    JobSpec,
    JobState,
    NewJob,
    PhotoInfo,
    Retention,
    StoredJob,
)
from service.jobs.sqlite_database import Connection, Database
from service.results import Status

_VERSION_1 = """
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
"""
_ENDED_SQL = ", ".join(f"'{state}'" for state in ENDED)
_CODED = {"spec": JobSpec, "photo": PhotoInfo, "failure": Failure}
"""Columns of JSON text."""
_JOB_COLUMNS = tuple(field.name for field in fields(StoredJob))
_NEW_COLUMNS = tuple(field.name for field in fields(NewJob))


def _make_version_1(writer: Connection) -> None:
    for statement in _VERSION_1.split(";"):
        writer.execute(statement)


def _make_version_2(writer: Connection) -> None:
    """From release 0.1.0: values instead of the API's JSON, and leases. Its records go."""
    writer.execute("ALTER TABLE jobs RENAME COLUMN fields TO spec")
    writer.execute("ALTER TABLE jobs RENAME COLUMN error TO failure")
    writer.execute("ALTER TABLE jobs RENAME COLUMN crashes TO lost")
    writer.execute("ALTER TABLE jobs ADD COLUMN lease_until REAL NOT NULL DEFAULT 0")
    writer.execute("DELETE FROM events")
    writer.execute("UPDATE jobs SET records = 0, stage = NULL")
    rows = writer.execute("SELECT id, estimator, spec, photo, result, failure FROM jobs").fetchall()
    for job_id, estimator, spec, photo, result, failure in rows:
        writer.execute(
            "UPDATE jobs SET spec = ?, photo = ?, result = ?, failure = ? WHERE id = ?",
            (
                *(encode(old_spec(spec, estimator)), encode(old_photo(photo))),
                *(result and encode(old_result(result)), failure and encode(old_failure(failure)), job_id),
            ),
        )
    sizes = "photo_bytes + coalesce(length(result), 0) + coalesce(length(failure), 0)"
    writer.execute(f"UPDATE jobs SET bytes = {sizes} WHERE state IN ({_ENDED_SQL})")


_MIGRATIONS = (_make_version_1, _make_version_2)


class SqliteJobStore:
    """Implements `JobStore`."""

    def __init__(self, path: Path) -> None:
        """Open the file or make it, and bring it to the present version. Raises StorageFailed."""
        self._database = Database(path, _MIGRATIONS, "its jobs")

    def close(self) -> None:
        self._database.close()

    # ------------------------------------------------------------------ the life of a job

    def accept(self, job: NewJob) -> StoredJob:
        row = f"INSERT INTO jobs ({', '.join(_NEW_COLUMNS)}, state) VALUES ({_marks(len(_NEW_COLUMNS))}, 'queued')"
        with self._database.transaction() as writer:
            known = _find_by_key(writer, job.client, job.idempotency_key, job.digest)
            if known is None:
                values = [getattr(job, name) for name in _NEW_COLUMNS]
                coded = zip(_NEW_COLUMNS, values, strict=True)
                writer.execute(row, [encode(value) if name in _CODED else value for name, value in coded])
                known = _select(writer, "WHERE id = ?", job.id)[0]
        return known

    def find_by_key(self, client: str, key: str | None, digest: str) -> StoredJob | None:
        with self._database.reading() as reader:
            return _find_by_key(reader, client, key, digest)

    def has_key(self, client: str, key: str) -> bool:
        with self._database.reading() as reader:
            return bool(_select(reader, "WHERE client = ? AND idempotency_key = ?", client, key))

    def probe(self) -> None:
        with self._database.transaction() as writer:
            writer.execute(f"PRAGMA user_version = {self._database.version}")

    def claim(self, job: StoredJob, lease_until: float) -> int | None:
        with self._database.transaction() as writer:
            changed = writer.execute(
                "UPDATE jobs SET state = 'running', attempt = attempt + 1, started = ?, lease_until = ?, records = 0, "
                "stage = NULL WHERE id = ? AND state = 'queued' AND attempt = ? AND NOT cancelled",
                (time.time(), lease_until, job.id, job.attempt),
            ).rowcount
            # Clients get the records of the latest attempt only.
            writer.execute("DELETE FROM events WHERE job = ? AND attempt <= ?", (job.id, job.attempt))
        return job.attempt + 1 if changed else None

    def renew(self, attempts: Sequence[tuple[str, int]], lease_until: float) -> None:
        with self._database.transaction() as writer:
            writer.executemany(
                "UPDATE jobs SET lease_until = ? WHERE id = ? AND state = 'running' AND attempt = ?",
                [(lease_until, job_id, attempt) for job_id, attempt in attempts],
            )

    def reclaim(self, before: float, most_lost: int, failure: Failure) -> list[StoredJob]:
        now = time.time()
        end = (
            "finished = ?, bytes = photo_bytes, photo_until = CASE WHEN keep_photo THEN NULL ELSE ? END "
            "WHERE state = 'running' AND lease_until < ?"
        )
        # Asked often: mostly there is nothing, and a read needs no commit.
        over = "SELECT id FROM jobs WHERE state = 'running' AND lease_until < ?"
        with self._database.reading() as reader:
            if not reader.execute(over, (before,)).fetchone():
                return []
        with self._database.transaction() as writer:
            ids = [job_id for (job_id,) in writer.execute(over, (before,))]
            writer.execute("UPDATE jobs SET lost = lost + 1 WHERE state = 'running' AND lease_until < ?", (before,))
            # Each statement takes some of the rows out of `running`, the last one takes the rest.
            writer.execute(f"UPDATE jobs SET state = 'cancelled', {end} AND cancelled", (now, now, before))
            writer.execute(
                f"UPDATE jobs SET state = 'interrupted', failure = ?, {end} AND lost >= ?",
                (encode(failure), now, now, before, most_lost),
            )
            writer.execute("UPDATE jobs SET state = 'queued' WHERE state = 'running' AND lease_until < ?", (before,))
            return _select(writer, f"WHERE id IN ({_marks(len(ids))}) ORDER BY number", *ids)

    def append(self, job_id: str, attempt: int, batch: Batch) -> bool:
        with self._database.transaction() as writer:
            return _append(writer, job_id, attempt, batch)

    def finish(self, job_id: str, attempt: int, batch: Batch, ending: Ending, photo_until: float | None) -> bool:
        verdict = ending.result.estimate.verdict if ending.result else None
        result, failure = (value and encode(value) for value in (ending.result, ending.failure))
        size = len(result or "") + len(failure or "")
        with self._database.transaction() as writer:
            # In one transaction: a job that has ended has all of its records.
            if not _append(writer, job_id, attempt, batch):
                return False
            writer.execute(
                "UPDATE jobs SET state = ?, status = ?, score = ?, result = ?, failure = ?, "
                "scene = coalesce(?, scene), finished = ?, "
                "photo_until = CASE WHEN keep_photo THEN NULL ELSE ? END, bytes = ? + photo_bytes + "
                "(SELECT coalesce(sum(length(record)), 0) FROM events WHERE job = jobs.id) WHERE id = ?",
                (
                    *(ending.state, verdict and verdict.status, verdict and verdict.score, result, failure),
                    *(ending.scene, time.time(), photo_until, size, job_id),
                ),
            )
        return True

    def end_queued(self, job: StoredJob, ending: Ending, photo_until: float | None) -> bool:
        with self._database.transaction() as writer:
            changed = writer.execute(
                "UPDATE jobs SET state = ?, failure = ?, finished = ?, bytes = photo_bytes, "
                "photo_until = CASE WHEN keep_photo THEN NULL ELSE ? END "
                "WHERE id = ? AND state = 'queued' AND attempt = ?",
                (
                    *(ending.state, ending.failure and encode(ending.failure), time.time()),
                    *(photo_until, job.id, job.attempt),
                ),
            ).rowcount
        return bool(changed)

    def request_cancel(self, job_id: str) -> None:
        with self._database.transaction() as writer:
            writer.execute(f"UPDATE jobs SET cancelled = 1 WHERE id = ? AND state NOT IN ({_ENDED_SQL})", (job_id,))

    def requeue(self, job_id: str, attempt: int) -> bool:
        with self._database.transaction() as writer:
            changed = writer.execute(
                "UPDATE jobs SET state = 'queued' WHERE id = ? AND state = 'running' AND attempt = ?", (job_id, attempt)
            ).rowcount
        return bool(changed)

    # ------------------------------------------------------------------ reading

    def get(self, job_id: str) -> StoredJob:
        with self._database.reading() as reader:
            found = _select(reader, "WHERE id = ?", job_id)
        if not found:
            raise JobNotFound(f"job '{job_id}' not found or expired.", where="job")
        return found[0]

    def queued(self) -> list[StoredJob]:
        with self._database.reading() as reader:
            return _select(reader, "WHERE state = 'queued' ORDER BY number")

    def page(self, wanted: JobFilter, limit: int) -> list[StoredJob]:
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
        with self._database.reading() as reader:
            return _select(reader, f"{where}ORDER BY number DESC LIMIT ?", *given.values(), limit)

    def count(self, state: JobState) -> int:
        with self._database.reading() as reader:
            return reader.execute("SELECT count(*) FROM jobs WHERE state = ?", (state,)).fetchone()[0]

    def records(self, job_id: str, first: int = 0) -> list[JobRecord]:
        with self._database.reading() as reader:
            rows = reader.execute(
                "SELECT record FROM events WHERE job = ? AND seq >= ? "
                "AND attempt = (SELECT attempt FROM jobs WHERE id = ?) ORDER BY seq",
                (job_id, first, job_id),
            ).fetchall()
        return [decode(JobRecord, zlib.decompress(data).decode()) for (data,) in rows]

    def result(self, job_id: str) -> JobResult | None:
        with self._database.reading() as reader:
            row = reader.execute("SELECT result FROM jobs WHERE id = ?", (job_id,)).fetchone()
        return decode(JobResult, row[0]) if row and row[0] else None

    # ------------------------------------------------------------------ retention

    def expire_photos(self) -> list[str]:
        with self._database.transaction() as writer:
            rows = writer.execute(
                "UPDATE jobs SET photo_until = NULL, keep_photo = 0, bytes = bytes - photo_bytes, photo_bytes = 0 "
                f"WHERE photo_until < ? AND state IN ({_ENDED_SQL}) RETURNING id",
                (time.time(),),
            ).fetchall()
        return [job_id for (job_id,) in rows]

    def prune(self, kept: Retention) -> list[str]:
        with self._database.transaction() as writer:
            ended = "SELECT id, finished, row_number() OVER newest AS place, sum(bytes) OVER newest AS total "
            # By number, not by time: clocks may be set back.
            ended += f"FROM jobs WHERE state IN ({_ENDED_SQL}) WINDOW newest AS (ORDER BY number DESC)"
            chosen = f"SELECT id FROM ({ended}) WHERE place > ? OR total > ? OR finished < ?"
            ids = writer.execute(chosen, (kept.jobs, kept.bytes, time.time() - kept.seconds)).fetchall()
            writer.executemany("DELETE FROM jobs WHERE id = ?", ids)
            writer.executemany("DELETE FROM events WHERE job = ?", ids)
        if ids:
            self._database.give_space_back()
        return [job_id for (job_id,) in ids]

    def delete(self, job_id: str) -> bool:
        with self._database.transaction() as writer:
            ended = f"DELETE FROM jobs WHERE id = ? AND state IN ({_ENDED_SQL})"
            deleted = writer.execute(ended, (job_id,)).rowcount > 0
            if deleted:
                writer.execute("DELETE FROM events WHERE job = ?", (job_id,))
        return deleted

    def ids(self) -> set[str]:
        with self._database.reading() as reader:
            return {job_id for (job_id,) in reader.execute("SELECT id FROM jobs")}


def _marks(count: int) -> str:
    return ", ".join("?" * count)


def _select(connection: Connection, where: str, *values: object) -> list[StoredJob]:
    rows = connection.execute(f"SELECT {', '.join(_JOB_COLUMNS)} FROM jobs {where}", values).fetchall()
    return [_job(row) for row in rows]


def _find_by_key(connection: Connection, client: str, key: str | None, digest: str) -> StoredJob | None:
    found = _select(connection, "WHERE client = ? AND idempotency_key = ?", client, key) if key is not None else []
    known = found[0] if found else None
    if known and known.digest != digest:
        raise IdempotencyConflict(
            f"the key was used for job {known.id}, which was another request.",
            where="header.idempotency-key",
            hint="Use a new key for a new request.",
        )
    return known


def _job(row: tuple) -> StoredJob:
    values: dict[str, Any] = dict(zip(_JOB_COLUMNS, row, strict=True))
    for name, kind in _CODED.items():
        values[name] = decode(kind, values[name]) if values[name] else None
    values["status"] = values["status"] and Status(values["status"])
    for name in ("cancelled", "keep_photo"):
        values[name] = bool(values[name])
    return StoredJob(**values)


def _append(writer: Connection, job_id: str, attempt: int, batch: Batch) -> bool:
    stage = batch.records[-1].step.stage if batch.records else None
    changed = writer.execute(
        "UPDATE jobs SET records = ?, stage = coalesce(?, stage) WHERE id = ? AND state = 'running' AND attempt = ?",
        (batch.first + len(batch.records), stage, job_id, attempt),
    ).rowcount
    if changed:
        # Level 1: the search waits for it.
        rows = enumerate((zlib.compress(encode(record).encode(), 1) for record in batch.records), batch.first)
        writer.executemany(
            "INSERT INTO events VALUES (?, ?, ?, ?)", [(job_id, attempt, seq, record) for seq, record in rows]
        )
    return bool(changed)
