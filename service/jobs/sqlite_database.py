"""A SQLite file (WAL) with its migrations, one connection for writing and one for reading. The only file with sqlite3.

Commits are `synchronous=FULL`: when a transaction ends, its changes are on disk. One process uses a file (a lock file
sees to that elsewhere), with any number of threads.
"""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from service.errors import StorageFailed

Connection = sqlite3.Connection


class Database:
    """One file; implements `SqlDatabase`."""

    def __init__(self, path: Path, migrations: Sequence[Callable[[Connection], None]], what: str) -> None:
        """Open the file or make it, and bring it to the present version. Raises StorageFailed.

        Each migration takes the file one version up; one that was released is never changed. `what` names in errors
        what can't be written, as "its jobs".
        """
        self._path, self._what, self.version = path, what, len(migrations)
        self._writing, self._reading = threading.Lock(), threading.Lock()
        try:
            self._writer = self._connection()
            self._migrate(migrations)
            # A second connection: with WAL, readers do not wait for a commit to reach the disk.
            self._reader = self._connection()
        except sqlite3.Error as error:
            raise StorageFailed(f"{path} can't be used: {error}.", where="data_dir") from error

    def close(self) -> None:
        """Close both connections, each once nothing uses it any more."""
        with self._writing, self._reading:
            self._writer.close()
            self._reader.close()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Lend the connection for reading."""
        with self._reading:
            yield self._reader

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """Lend the connection for writing; commit at the end, or undo all on an error. Raises StorageFailed."""
        with self._writing:
            try:
                self._writer.execute("BEGIN IMMEDIATE")
                yield self._writer
                self._writer.execute("COMMIT")
            except BaseException as error:
                if self._writer.in_transaction:
                    self._writer.execute("ROLLBACK")
                if isinstance(error, sqlite3.Error):
                    raise StorageFailed(f"the service can't write {self._what} to disk: {error}.") from error
                raise

    def lock(self, connection: Connection, name: str) -> None:
        """Do nothing: one transaction at a time has the whole file."""

    def announce(self, connection: Connection, job_id: str) -> None:
        """Do nothing: one process uses the file."""

    def now(self) -> float:
        """Return the time of this machine."""
        return time.time()

    def probe(self) -> None:
        """Write the version that is there. Raises StorageFailed."""
        with self.transaction() as writer:
            writer.execute(f"PRAGMA user_version = {self.version}")

    def give_space_back(self) -> None:
        """Make the file smaller by what was deleted."""
        with self._writing:
            self._writer.execute("PRAGMA incremental_vacuum").fetchall()

    def _connection(self) -> Connection:
        connection = sqlite3.connect(self._path, timeout=10, isolation_level=None, check_same_thread=False)
        connection.execute("PRAGMA auto_vacuum = INCREMENTAL")  # only in a new file, before its first table
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        return connection

    def _migrate(self, migrations: Sequence[Callable[[Connection], None]]) -> None:
        (version,) = self._writer.execute("PRAGMA user_version").fetchone()
        if version > len(migrations):
            raise StorageFailed(
                f"{self._path} has version {version}, this program knows up to {len(migrations)}.",
                where="data_dir",
                hint="Run the newer program, or name another data_dir.",
            )
        for number, migrate in enumerate(migrations[version:], version + 1):
            with self.transaction() as writer:
                migrate(writer)
                writer.execute(f"PRAGMA user_version = {number}")
