"""A PostgreSQL database that several processes share: connections, migrations, notifications.

The only file with psycopg.
Commits wait until they are on the server's disk (its default). A server that is away for a moment is waited for;
connections that it has closed meanwhile are replaced.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import psycopg  # pyright: ignore[reportMissingImports]
import psycopg_pool  # pyright: ignore[reportMissingImports]
from psycopg.conninfo import conninfo_to_dict  # pyright: ignore[reportMissingImports]

from service.errors import StorageFailed

_CONNECTIONS = 8
"""Of one process at most; threads beyond that wait."""
_WAIT_S = 10.0
"""How long a connection is waited for."""
_CHANNEL = "splatfix_jobs"


class Connection:
    """A psycopg connection that marks values as SQLite does, so that both databases run the same statements."""

    def __init__(self, connection: psycopg.Connection) -> None:
        self._connection = connection

    def execute(self, statement: str, values: Sequence[Any] = ()) -> psycopg.Cursor:
        """Run a statement, in psycopg's spelling; return its rows."""
        return self._connection.execute(statement.replace("?", "%s").encode(), values)

    def executemany(self, statement: str, rows: Sequence[Sequence[Any]]) -> None:
        """Run a statement for each row of values."""
        self._connection.cursor().executemany(statement.replace("?", "%s").encode(), rows)


@dataclass(frozen=True, slots=True)
class Migration:
    """Takes a part of the database one version up; one that was released is never changed."""

    apply: Callable[[Connection], None]
    readable_from: int
    """The oldest version whose programs go on working with the database afterwards: while fronts are replaced one by
    one, those of the last release still run. So a column that a release no longer needs goes one release later."""


class PostgresDatabase:
    """Implements `SqlDatabase`; one for all stores of a process."""

    def __init__(self, address: str) -> None:
        """Connect to `postgresql://user@host/name?sslmode=...`. Raises StorageFailed."""
        try:
            self._pool = psycopg_pool.ConnectionPool(
                address,
                min_size=1,
                max_size=_CONNECTIONS,
                timeout=_WAIT_S,
                # Then the next request tries anew; longer, and the pauses between attempts grow to minutes.
                reconnect_timeout=3.0,
                kwargs={"autocommit": True, "connect_timeout": 5, "application_name": "splatfix"},
                # Connections of a server that was restarted are found out before they are used.
                check=psycopg_pool.ConnectionPool.check_connection,
                open=True,
            )
            self._pool.wait(_WAIT_S)
        except psycopg.Error as error:
            raise StorageFailed(
                f"the database can't be reached: {error}.", where="database", hint="Check SPLATFIX_DATABASE."
            ) from error
        self._address = address

    def close(self) -> None:
        """Close all connections."""
        self._pool.close()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Lend a connection; each statement is a transaction of its own. Raises StorageFailed."""
        with self._storage_errors("read"), self._pool.connection() as connection:
            yield Connection(connection)

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """Lend a connection; commit at the end, or undo all on an error. Raises StorageFailed."""
        with self._storage_errors("write"), self._pool.connection() as connection, connection.transaction():
            yield Connection(connection)

    @contextmanager
    def _storage_errors(self, what: str) -> Iterator[None]:
        try:
            yield
        except psycopg.Error as error:
            raise StorageFailed(f"the service can't {what} its database: {str(error).strip()}.") from error

    def migrate(self, part: str, migrations: Sequence[Migration]) -> None:
        """Bring a part of the database, which has a version of its own, to the present one. Raises StorageFailed."""
        with self.transaction() as writer:
            # Of processes that start at once one migrates.
            self.lock(writer, "splatfix migrations")
            writer.execute(
                "CREATE TABLE IF NOT EXISTS splatfix_versions "
                "(part TEXT PRIMARY KEY, version INTEGER NOT NULL, readable_from INTEGER NOT NULL)"
            )
            row = writer.execute(
                "SELECT version, readable_from FROM splatfix_versions WHERE part = ?", (part,)
            ).fetchone()
            version, readable_from = row or (0, 0)
            if readable_from > len(migrations):
                raise StorageFailed(
                    f"the database has version {version} of its {part}, which programs from version {readable_from} on "
                    f"can use; this one has {len(migrations)}.",
                    where="database",
                    hint="Run the newer program, or name another database.",
                )
            for number, migration in enumerate(migrations[version:], version + 1):
                migration.apply(writer)
                writer.execute(
                    "INSERT INTO splatfix_versions (part, version, readable_from) VALUES (?, ?, ?) ON CONFLICT (part) "
                    "DO UPDATE SET version = excluded.version, readable_from = excluded.readable_from",
                    (part, number, migration.readable_from),
                )

    def lock(self, connection: Connection, name: str) -> None:
        """Let no other transaction that locks the name go on before this one has ended."""
        connection.execute("SELECT pg_advisory_xact_lock(hashtextextended(?, 0))", (name,))

    def announce(self, connection: Connection, job_id: str) -> None:
        """Notify all listeners of a job's change, once the transaction ends."""
        connection.execute("SELECT pg_notify(?, ?)", (_CHANNEL, job_id))

    def now(self) -> float:
        """Return the server's time: the clocks of the fronts' machines may differ."""
        with self.reading() as reader:
            ((seconds,),) = reader.execute("SELECT extract(epoch FROM clock_timestamp())::float8").fetchall()
        return seconds

    def probe(self) -> None:
        """Write the versions that are there. Raises StorageFailed."""
        with self.transaction() as writer:
            writer.execute("UPDATE splatfix_versions SET version = version")

    def give_space_back(self) -> None:
        """Do nothing: the server's autovacuum does."""

    def listen(self) -> PostgresListener:
        """Return what hears of changed jobs."""
        return PostgresListener(self._address)


class PostgresListener:
    """Implements `JobWatch`, on a connection of its own that is replaced when it breaks."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._connection: psycopg.Connection | None = None
        self._closed = False

    def wait(self, seconds: float) -> set[str]:
        """Return the ids of changed jobs, as `JobWatch.wait`. Raises StorageFailed without the server."""
        try:
            connection = self._connection or self._connect()
            # What has come by the first one's time comes with it.
            return {note.payload for note in connection.notifies(timeout=seconds, stop_after=1)}
        except psycopg.Error:
            self._disconnect()
            raise StorageFailed("the service can't listen to its database.") from None

    def close(self) -> None:
        """Close the connection, which ends `wait`."""
        self._closed = True
        self._disconnect()

    def _connect(self) -> psycopg.Connection:
        if self._closed:
            raise psycopg.OperationalError("closed")
        connection = self._connection = psycopg.connect(self._address, autocommit=True, connect_timeout=5)
        connection.execute(f"LISTEN {_CHANNEL}")
        return connection

    def _disconnect(self) -> None:
        if self._connection:
            with suppress(psycopg.Error):
                self._connection.close()
        self._connection = None


def unprotected(address: str) -> str:
    """Return why others may read what goes to a database, as a phrase; empty if they can't."""
    try:
        parts = conninfo_to_dict(address)
    except psycopg.Error:
        return "the address can't be read"
    hosts = str(parts.get("hostaddr") or parts.get("host") or "").split(",")
    if all(_stays_here(host) for host in hosts) or parts.get("sslmode") in ("require", "verify-ca", "verify-full"):
        return ""
    return f"photos and poses may go to {', '.join(hosts)} unencrypted: add sslmode=verify-full to SPLATFIX_DATABASE"


def _stays_here(host: str) -> bool:
    if host in ("", "localhost") or host.startswith("/"):  # a socket in the file system
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
