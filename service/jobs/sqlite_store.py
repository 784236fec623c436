"""Jobs in a SQLite file: its tables and their migrations."""

from __future__ import annotations

from pathlib import Path

from service.codec import encode
from service.jobs.migrate_0_1 import old_failure, old_photo, old_result, old_spec
from service.jobs.model import ENDED
from service.jobs.sql_store import SqlJobStore
from service.jobs.sqlite_database import Connection, Database

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


def _make_version_3(writer: Connection) -> None:
    """Jobs are listed and counted by client."""
    writer.execute("CREATE INDEX job_by_client ON jobs (client, number)")


_MIGRATIONS = (_make_version_1, _make_version_2, _make_version_3)


class SqliteJobStore(SqlJobStore):
    """Jobs of one process."""

    def __init__(self, path: Path) -> None:
        """Open the file or make it, and bring it to the present version. Raises StorageFailed."""
        super().__init__(Database(path, _MIGRATIONS, "its jobs"))
