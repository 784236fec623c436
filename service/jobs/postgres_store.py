"""Jobs, photos and lenses in PostgreSQL, which several fronts of one service share."""

from __future__ import annotations

from service.jobs.photo_store import photo_gone
from service.jobs.postgres_database import Connection, Migration, PostgresDatabase
from service.jobs.sql_lens_store import SqlLensStore
from service.jobs.sql_store import SqlJobStore
from service.jobs.store import JobWatch

_JOBS = """
    CREATE TABLE jobs (
        number BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY, id TEXT NOT NULL UNIQUE, client TEXT NOT NULL,
        idempotency_key TEXT, digest TEXT NOT NULL, state TEXT NOT NULL, attempt INTEGER NOT NULL DEFAULT 0,
        cancelled BOOLEAN NOT NULL DEFAULT FALSE, lost INTEGER NOT NULL DEFAULT 0,
        lease_until DOUBLE PRECISION NOT NULL DEFAULT 0, created DOUBLE PRECISION NOT NULL,
        started DOUBLE PRECISION, finished DOUBLE PRECISION, deadline DOUBLE PRECISION,
        scene TEXT NOT NULL, estimator TEXT NOT NULL, spec TEXT NOT NULL, photo TEXT NOT NULL,
        photo_sha256 TEXT NOT NULL, photo_bytes BIGINT NOT NULL, photo_until DOUBLE PRECISION,
        keep_photo BOOLEAN NOT NULL, records INTEGER NOT NULL DEFAULT 0, stage TEXT, status TEXT,
        score DOUBLE PRECISION, result TEXT, failure TEXT, bytes BIGINT NOT NULL DEFAULT 0
    );
    CREATE UNIQUE INDEX job_by_key ON jobs (client, idempotency_key) WHERE idempotency_key IS NOT NULL;
    CREATE INDEX job_by_state ON jobs (state);
    CREATE INDEX job_by_photo ON jobs (photo_sha256);
    CREATE TABLE events (
        job TEXT NOT NULL, attempt INTEGER NOT NULL, seq INTEGER NOT NULL, record BYTEA NOT NULL,
        PRIMARY KEY (job, attempt, seq)
    )
"""
_CLIENTS = """
    CREATE INDEX job_by_client ON jobs (client, number)
"""
_PHOTOS = """
    CREATE TABLE photos (job TEXT NOT NULL, original BOOLEAN NOT NULL, data BYTEA NOT NULL, PRIMARY KEY (job, original))
"""
_LENSES = """
    CREATE TABLE lenses (
        change BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY, id TEXT NOT NULL UNIQUE, owner TEXT NOT NULL,
        key TEXT NOT NULL, estimate TEXT NOT NULL, updated DOUBLE PRECISION NOT NULL
    );
    CREATE INDEX lens_by_owner ON lenses (owner)
"""


def _first(statements: str) -> tuple[Migration, ...]:
    def apply(writer: Connection) -> None:
        for statement in statements.split(";"):
            writer.execute(statement)

    return (Migration(apply, readable_from=1),)


class PostgresJobStore(SqlJobStore):
    """Jobs of several processes, which hear of each other's changes."""

    def __init__(self, database: PostgresDatabase) -> None:
        """Bring the tables to their present version. Raises StorageFailed."""
        database.migrate("jobs", (*_first(_JOBS), *_first(_CLIENTS)))
        super().__init__(database)
        self._listen = database.listen

    def watch(self) -> JobWatch | None:
        return self._listen()


class PostgresLensStore(SqlLensStore):
    """Lenses that all fronts learn from."""

    def __init__(self, database: PostgresDatabase, limit: int) -> None:
        """Bring the table to its present version; what is beyond the limit goes. Raises StorageFailed."""
        database.migrate("lenses", _first(_LENSES))
        super().__init__(database, limit)


class PostgresPhotoStore:
    """Implements `PhotoStore`: each photo is a value of the database, of less than 1 GB."""

    def __init__(self, database: PostgresDatabase) -> None:
        """Bring the table to its present version. Raises StorageFailed."""
        database.migrate("photos", _first(_PHOTOS))
        self._database = database

    def accept(self, job_id: str, data: bytes) -> None:
        with self._database.transaction() as writer:
            self._put(writer, job_id, True, data)

    def original(self, job_id: str) -> bytes:
        return self._read(job_id, True)

    def discard_original(self, job_id: str, jpeg: bytes | None) -> None:
        with self._database.transaction() as writer:
            if jpeg is not None:
                self._put(writer, job_id, False, jpeg)
            writer.execute("DELETE FROM photos WHERE job = ? AND original", (job_id,))

    def kept(self, job_id: str) -> bytes:
        return self._read(job_id, False)

    def delete(self, job_id: str) -> None:
        with self._database.transaction() as writer:
            writer.execute("DELETE FROM photos WHERE job = ?", (job_id,))

    def with_original(self) -> set[str]:
        with self._database.reading() as reader:
            return {job_id for (job_id,) in reader.execute("SELECT job FROM photos WHERE original")}

    def ids(self) -> set[str]:
        with self._database.reading() as reader:
            return {job_id for (job_id,) in reader.execute("SELECT DISTINCT job FROM photos")}

    def _put(self, writer: Connection, job_id: str, original: bool, data: bytes) -> None:
        writer.execute(
            "INSERT INTO photos (job, original, data) VALUES (?, ?, ?) "
            "ON CONFLICT (job, original) DO UPDATE SET data = excluded.data",
            (job_id, original, data),
        )

    def _read(self, job_id: str, original: bool) -> bytes:
        with self._database.reading() as reader:
            row = reader.execute(
                "SELECT data FROM photos WHERE job = ? AND original = ?", (job_id, original)
            ).fetchone()
        if row is None:
            raise photo_gone()
        return row[0]
