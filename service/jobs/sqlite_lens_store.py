"""Lenses in a SQLite file."""

from __future__ import annotations

from pathlib import Path

from service.jobs.sql_lens_store import SqlLensStore
from service.jobs.sqlite_database import Connection, Database


def _make_version_1(writer: Connection) -> None:
    # `change` is in the order of changes: clocks may be set back.
    writer.execute(
        "CREATE TABLE lenses (change INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE, owner TEXT NOT NULL, "
        "key TEXT NOT NULL, estimate TEXT NOT NULL, updated REAL NOT NULL)"
    )
    writer.execute("CREATE INDEX lens_by_owner ON lenses (owner)")


class SqliteLensStore(SqlLensStore):
    """Lenses of one process."""

    def __init__(self, path: Path, limit: int) -> None:
        """Open the file or make it; what is beyond the limit goes. Raises StorageFailed."""
        super().__init__(Database(path, (_make_version_1,), "its lenses"), limit)
