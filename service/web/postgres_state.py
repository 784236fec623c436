"""The shared state of several fronts, in PostgreSQL. Times are those of the database's clock."""

from __future__ import annotations

import logging
import secrets
import time

from service.errors import StorageFailed
from service.jobs.postgres_database import Connection, Migration, PostgresDatabase
from service.web.shared_state import RENEW_S, SECRET_BYTES, LocalState, Rate, SessionLimits

_log = logging.getLogger(__name__)

_LEASE_S = 3 * RENEW_S
"""A live session that isn't renewed for so long is that of a front that ended."""
_PRUNE_S = 60.0
_ALONE_S = 5.0
"""For so long a front counts by itself when the database did not answer."""

# Unlogged: not written ahead, and empty after a crash of the server, which frees everybody once.
_TABLES = """
    CREATE TABLE secrets (name TEXT PRIMARY KEY, value BYTEA NOT NULL);
    CREATE UNLOGGED TABLE rates (
        client TEXT NOT NULL, seconds INTEGER NOT NULL, period BIGINT NOT NULL, hits INTEGER NOT NULL,
        hits_before INTEGER NOT NULL, at DOUBLE PRECISION NOT NULL, PRIMARY KEY (client, seconds)
    );
    CREATE UNLOGGED TABLE live_sessions (id TEXT PRIMARY KEY, client TEXT NOT NULL, until DOUBLE PRECISION NOT NULL)
"""
_NOW = "extract(epoch FROM clock_timestamp())::float8"

# Of the last full period, as the row has it, and of the present one so far. A request that waited for another's row
# may come with the older time: it counts into the period that is there.
_HITS_BEFORE = """
    CASE WHEN excluded.period <= r.period THEN r.hits_before WHEN excluded.period = r.period + 1 THEN r.hits ELSE 0 END
"""
_HITS = "CASE WHEN excluded.period <= r.period THEN r.hits ELSE 0 END"
_HIT = f"""
    INSERT INTO rates AS r (client, seconds, period, hits, hits_before, at)
    SELECT ?, seconds, floor(now / seconds), 1, 0, now FROM (SELECT {_NOW} AS now, ?::integer AS seconds) AS asked
    ON CONFLICT (client, seconds) DO UPDATE SET
        hits_before = {_HITS_BEFORE}, hits = {_HITS} + 1,
        period = greatest(r.period, excluded.period), at = excluded.at
    WHERE floor(({_HITS_BEFORE}) * least(1, greatest(r.period, excluded.period) + 1 - excluded.at / r.seconds))
        + {_HITS} + 1 <= ?
    RETURNING 1
"""
"""One statement, so that of requests at several fronts none is counted twice or not at all."""


def _make_tables(writer: Connection) -> None:
    for statement in _TABLES.split(";"):
        writer.execute(statement)


class PostgresState:
    """Implements `SharedState`. While the database doesn't answer, each front limits the rates of its own clients."""

    def __init__(self, database: PostgresDatabase, alone: LocalState) -> None:
        """Bring the tables to their present version. Raises StorageFailed. `alone` counts while nothing is shared."""
        database.migrate("shared state", (Migration(_make_tables, readable_from=1),))
        self._database, self._alone = database, alone
        self._alone_until = 0.0
        self._prune_at = 0.0

    def secret(self) -> bytes:
        with self._database.transaction() as writer:
            writer.execute(
                "INSERT INTO secrets (name, value) VALUES ('sessions', ?) ON CONFLICT DO NOTHING",
                (secrets.token_bytes(SECRET_BYTES),),
            )
            ((secret,),) = writer.execute("SELECT value FROM secrets WHERE name = 'sessions'").fetchall()
        return bytes(secret)

    def hit(self, client: str, rate: Rate) -> float | None:
        # Who has only asked too often must not wait for a database that is away, nor pass for want of it.
        if time.monotonic() < self._alone_until:
            return self._alone.hit(client, rate)
        try:
            return self._hit(client, rate)
        except StorageFailed as error:
            _log.warning("rates are limited by this front alone: %s", error.message)
            self._alone_until = time.monotonic() + _ALONE_S
            return self._alone.hit(client, rate)

    def _hit(self, client: str, rate: Rate) -> float | None:
        if time.monotonic() > self._prune_at:
            self._prune_at = time.monotonic() + _PRUNE_S
            with self._database.transaction() as writer:
                writer.execute(f"DELETE FROM rates WHERE (period + 2) * seconds < {_NOW}")
        with self._database.transaction() as writer:
            if writer.execute(_HIT, (client, rate.seconds, rate.amount)).fetchone():
                return None
            row = writer.execute(
                f"SELECT hits_before, (period + 1) * seconds - {_NOW} FROM rates WHERE client = ? AND seconds = ?",
                (client, rate.seconds),
            ).fetchone()
        before, left = row or (0, 0.0)
        # One of the last period's requests is forgotten each time this much of the present one has passed.
        return left % (rate.seconds / before) if before else left

    def begin_session(self, client: str, limits: SessionLimits) -> str:
        session = secrets.token_hex(8)
        with self._database.transaction() as writer:
            # No other front counts between this one's count and its insertion.
            self._database.lock(writer, "splatfix live sessions")
            writer.execute(f"DELETE FROM live_sessions WHERE until < {_NOW}")
            counts = "SELECT count(*), count(*) FILTER (WHERE client = ?) FROM live_sessions"
            ((all_sessions, of_client),) = writer.execute(counts, (client,)).fetchall()
            limits.require_room(all_sessions, of_client)
            self._keep(writer, client, session)
        return session

    def renew_session(self, client: str, session: str) -> None:
        with self._database.transaction() as writer:
            self._keep(writer, client, session)

    def end_session(self, session: str) -> None:
        with self._database.transaction() as writer:
            writer.execute("DELETE FROM live_sessions WHERE id = ?", (session,))

    def _keep(self, writer: Connection, client: str, session: str) -> None:
        writer.execute(
            f"INSERT INTO live_sessions (id, client, until) VALUES (?, ?, {_NOW} + ?) "
            "ON CONFLICT (id) DO UPDATE SET until = excluded.until",
            (session, client, _LEASE_S),
        )
