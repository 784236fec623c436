"""Jobs in a database, SQLite or PostgreSQL: what is accepted here survives a crash.

Every change of state is a compare-and-set on (state, attempt), so a job can't end twice, even if several
threads or processes try to end it. When a method returns, its change is on disk.
Statements are those that both databases understand, and hold where transactions run at once (READ COMMITTED).
Specs, photos' data, records and results are JSON text of `codec`.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from service.codec import decode, encode
from service.errors import Failure, IdempotencyConflict, JobNotFound
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
from service.jobs.sql_database import Connection, SqlDatabase
from service.jobs.store import JobWatch, require_share
from service.results import Status

_ENDED_SQL = ", ".join(f"'{state}'" for state in ENDED)
_UNLESS_KEPT = "CASE WHEN keep_photo THEN NULL ELSE CAST(? AS DOUBLE PRECISION) END"
"""When the photo goes, in a statement that is given a time."""
_CODED = {"spec": JobSpec, "photo": PhotoInfo, "failure": Failure}
"""Columns of JSON text."""
_JOB_COLUMNS = tuple(field.name for field in fields(StoredJob))
_NEW_COLUMNS = tuple(field.name for field in fields(NewJob))


class SqlJobStore:
    """Implements `JobStore`."""

    def __init__(self, database: SqlDatabase) -> None:
        """Use a database whose tables are there already; it is closed with the store."""
        self._database = database

    def watch(self) -> JobWatch | None:
        return None

    def close(self) -> None:
        self._database.close()

    # ------------------------------------------------------------------ the life of a job

    def accept(self, job: NewJob, most_queued: int | None = None) -> StoredJob:
        row = f"INSERT INTO jobs ({', '.join(_NEW_COLUMNS)}, state) VALUES ({_marks(len(_NEW_COLUMNS))}, 'queued') "
        # Where another process has stored the same key since it was looked up.
        row += "ON CONFLICT DO NOTHING"
        with self._database.transaction() as writer:
            if most_queued is not None:
                # Of jobs that are accepted at once, at any front, only one takes the last place.
                self._database.lock(writer, f"share of {job.client}")
            known = _find_by_key(writer, job.client, job.idempotency_key, job.digest)
            if known is None:
                if most_queued is not None:
                    require_share(_count(writer, "queued", job.client), most_queued)
                values = [getattr(job, name) for name in _NEW_COLUMNS]
                coded = zip(_NEW_COLUMNS, values, strict=True)
                writer.execute(row, [encode(value) if name in _CODED else value for name, value in coded])
                known = _find_by_key(writer, job.client, job.idempotency_key, job.digest)
                known = known or _select(writer, "WHERE id = ?", job.id)[0]
                self._database.announce(writer, known.id)
        return known

    def find_by_key(self, client: str, key: str | None, digest: str) -> StoredJob | None:
        with self._database.reading() as reader:
            return _find_by_key(reader, client, key, digest)

    def has_key(self, client: str, key: str) -> bool:
        with self._database.reading() as reader:
            return bool(_select(reader, "WHERE client = ? AND idempotency_key = ?", client, key))

    def reassign(self, client: str, to: str) -> None:
        # An idempotency key that both have used stays with whose it is.
        used = "SELECT 1 FROM jobs AS kept WHERE kept.client = ? AND kept.idempotency_key = jobs.idempotency_key"
        with self._database.transaction() as writer:
            writer.execute(f"UPDATE jobs SET client = ? WHERE client = ? AND NOT EXISTS ({used})", (to, client, to))

    def probe(self) -> None:
        self._database.probe()

    def now(self) -> float:
        return self._database.now()

    def claim(self, job: StoredJob, lease_until: float) -> int | None:
        with self._database.transaction() as writer:
            changed = writer.execute(
                "UPDATE jobs SET state = 'running', attempt = attempt + 1, started = ?, lease_until = ?, records = 0, "
                "stage = NULL WHERE id = ? AND state = 'queued' AND attempt = ? AND NOT cancelled",
                (time.time(), lease_until, job.id, job.attempt),
            ).rowcount
            if changed:  # clients get the records of the latest attempt only
                writer.execute("DELETE FROM events WHERE job = ? AND attempt <= ?", (job.id, job.attempt))
                self._database.announce(writer, job.id)
        return job.attempt + 1 if changed else None

    def renew(self, attempts: Sequence[tuple[str, int]], lease_until: float) -> None:
        with self._database.transaction() as writer:
            writer.executemany(
                "UPDATE jobs SET lease_until = ? WHERE id = ? AND state = 'running' AND attempt = ?",
                [(lease_until, job_id, attempt) for job_id, attempt in attempts],
            )

    def reclaim(self, before: float, most_lost: int, failure: Failure) -> list[StoredJob]:
        now = time.time()
        over = "state = 'running' AND lease_until < ?"
        # Asked often: mostly there is nothing, and a read needs no commit.
        with self._database.reading() as reader:
            if not reader.execute(f"SELECT id FROM jobs WHERE {over}", (before,)).fetchone():
                return []
        with self._database.transaction() as writer:
            # The rows are this transaction's from here on: of two processes one gets a job.
            taken = writer.execute(f"UPDATE jobs SET lost = lost + 1 WHERE {over} RETURNING id", (before,))
            ids = [job_id for (job_id,) in taken.fetchall()]
            if not ids:
                return []
            these = f"state = 'running' AND id IN ({_marks(len(ids))})"
            end = f"finished = ?, bytes = photo_bytes, photo_until = {_UNLESS_KEPT} WHERE {these}"
            # Each statement takes some of the rows out of `running`, the last one takes the rest.
            writer.execute(f"UPDATE jobs SET state = 'cancelled', {end} AND cancelled", (now, now, *ids))
            writer.execute(
                f"UPDATE jobs SET state = 'interrupted', failure = ?, {end} AND lost >= ?",
                (encode(failure), now, now, *ids, most_lost),
            )
            writer.execute(f"UPDATE jobs SET state = 'queued' WHERE {these}", ids)
            for job_id in ids:
                self._database.announce(writer, job_id)
            return _select(writer, f"WHERE id IN ({_marks(len(ids))}) ORDER BY number", *ids)

    def append(self, job_id: str, attempt: int, batch: Batch) -> bool:
        with self._database.transaction() as writer:
            if not _append(writer, job_id, attempt, batch):
                return False
            self._database.announce(writer, job_id)
        return True

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
                f"photo_until = {_UNLESS_KEPT}, bytes = ? + photo_bytes + "
                "(SELECT coalesce(sum(length(record)), 0) FROM events WHERE job = jobs.id) WHERE id = ?",
                (
                    *(ending.state, verdict and str(verdict.status), verdict and float(verdict.score)),
                    *(result, failure, ending.scene, time.time(), photo_until, size, job_id),
                ),
            )
            self._database.announce(writer, job_id)
        return True

    def end_queued(self, job: StoredJob, ending: Ending, photo_until: float | None) -> bool:
        with self._database.transaction() as writer:
            changed = writer.execute(
                "UPDATE jobs SET state = ?, failure = ?, finished = ?, bytes = photo_bytes, "
                f"photo_until = {_UNLESS_KEPT} "
                "WHERE id = ? AND state = 'queued' AND attempt = ?",
                (
                    *(ending.state, ending.failure and encode(ending.failure), time.time()),
                    *(photo_until, job.id, job.attempt),
                ),
            ).rowcount
            if changed:
                self._database.announce(writer, job.id)
        return bool(changed)

    def request_cancel(self, job_id: str) -> None:
        with self._database.transaction() as writer:
            writer.execute(f"UPDATE jobs SET cancelled = TRUE WHERE id = ? AND state NOT IN ({_ENDED_SQL})", (job_id,))
            self._database.announce(writer, job_id)

    def requeue(self, job_id: str, attempt: int) -> bool:
        with self._database.transaction() as writer:
            changed = writer.execute(
                "UPDATE jobs SET state = 'queued' WHERE id = ? AND state = 'running' AND attempt = ?", (job_id, attempt)
            ).rowcount
            if changed:
                self._database.announce(writer, job_id)
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
            "status = ?": wanted.status and str(wanted.status),
            "photo_sha256 = ?": wanted.photo_sha256,
            "number < ?": wanted.before,
            "client = ?": wanted.client,
        }
        given = {test: value for test, value in tests.items() if value is not None}
        where = f"WHERE {' AND '.join(given)} " if given else ""
        with self._database.reading() as reader:
            return _select(reader, f"{where}ORDER BY number DESC LIMIT ?", *given.values(), limit)

    def count(self, state: JobState, client: str | None = None) -> int:
        with self._database.reading() as reader:
            return _count(reader, state, client)

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
                "UPDATE jobs SET photo_until = NULL, keep_photo = FALSE, bytes = bytes - photo_bytes, photo_bytes = 0 "
                f"WHERE photo_until < ? AND state IN ({_ENDED_SQL}) RETURNING id",
                (time.time(),),
            ).fetchall()
        return [job_id for (job_id,) in rows]

    def prune(self, kept: Retention) -> list[str]:
        with self._database.transaction() as writer:
            ended = "SELECT id, finished, row_number() OVER newest AS place, sum(bytes) OVER newest AS total "
            # By number, not by time: clocks may be set back.
            ended += f"FROM jobs WHERE state IN ({_ENDED_SQL}) WINDOW newest AS (ORDER BY number DESC)"
            chosen = f"SELECT id FROM ({ended}) AS ended WHERE place > ? OR total > ? OR finished < ?"
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


def _count(connection: Connection, state: JobState, client: str | None) -> int:
    where, values = ("state = ?", [state]) if client is None else ("state = ? AND client = ?", [state, client])
    return connection.execute(f"SELECT count(*) FROM jobs WHERE {where}", values).fetchone()[0]


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
            "INSERT INTO events (job, attempt, seq, record) VALUES (?, ?, ?, ?)",
            [(job_id, attempt, seq, record) for seq, record in rows],
        )
    return bool(changed)
