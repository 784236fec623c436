"""What the stores need of a database: statements that SQLite and PostgreSQL both understand, within transactions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol


class Cursor(Protocol):
    """The rows of a statement."""

    @property
    def rowcount(self) -> int: ...
    def fetchone(self) -> Any: ...
    def fetchall(self) -> list[Any]: ...
    def __iter__(self) -> Iterator[Any]: ...


class Connection(Protocol):
    """Runs statements whose values are marked by `?`."""

    def execute(self, statement: str, values: Sequence[Any] = (), /) -> Cursor: ...
    def executemany(self, statement: str, rows: Sequence[Sequence[Any]], /) -> object: ...


class SqlDatabase(Protocol):
    """A database with its tables. Safe to use from several threads; what writes raises StorageFailed."""

    def reading(self) -> AbstractContextManager[Any]:
        """Lend a connection for reading."""
        ...

    def transaction(self) -> AbstractContextManager[Any]:
        """Lend a connection for writing; commit at the end, or undo all on an error."""
        ...

    def lock(self, connection: Any, name: str) -> None:
        """Let no other transaction that locks the name go on before this one has ended."""
        ...

    def announce(self, connection: Any, job_id: str) -> None:
        """Notify other processes that use the database of a job's change, once the transaction ends."""
        ...

    def now(self) -> float:
        """Return the time by the clock that all who use the database share, in seconds since 1970."""
        ...

    def probe(self) -> None:
        """Write something, to find out whether that is possible."""
        ...

    def give_space_back(self) -> None:
        """Make files smaller by what was deleted."""
        ...

    def close(self) -> None:
        """Close files and connections; nothing is called afterwards."""
        ...
