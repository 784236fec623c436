"""Lenses in a database, SQLite or PostgreSQL; keys and estimates are JSON text of `codec`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from service.codec import decode, encode
from service.jobs.sql_database import Connection, SqlDatabase
from service.lenses.lens_estimate import LensEstimate
from service.lenses.lens_key import LensKey
from service.lenses.lens_store import StoredLens

_COLUMNS = "key, estimate, updated"


class SqlLensStore:
    """Implements `LensStore`."""

    def __init__(self, database: SqlDatabase, limit: int) -> None:
        """Use a database whose table is there already; what is beyond the limit goes. Raises StorageFailed."""
        self._database, self._limit = database, limit
        with self._database.transaction() as writer:
            self._trim(writer)

    def find(self, lens_id: str) -> StoredLens | None:
        with self._database.reading() as reader:
            row = reader.execute(f"SELECT {_COLUMNS} FROM lenses WHERE id = ?", (lens_id,)).fetchone()
        return row and _lens(row)

    def change(self, key: LensKey, learn: Callable[[LensEstimate | None], LensEstimate]) -> None:
        with self._database.transaction() as writer:
            # By its name: a row that isn't there yet can't be locked.
            self._database.lock(writer, key.id)
            row = writer.execute("SELECT estimate FROM lenses WHERE id = ?", (key.id,)).fetchone()
            estimate = learn(decode(LensEstimate, row[0]) if row else None)
            # Inserted anew: `change`, by which the oldest go, counts insertions.
            writer.execute("DELETE FROM lenses WHERE id = ?", (key.id,))
            writer.execute(
                "INSERT INTO lenses (id, owner, key, estimate, updated) VALUES (?, ?, ?, ?, ?)",
                (key.id, key.owner, encode(key), encode(estimate), time.time()),
            )
            self._trim(writer)

    def lenses(self, owner: str | None = None) -> list[StoredLens]:
        with self._database.reading() as reader:
            rows = reader.execute(
                f"SELECT {_COLUMNS} FROM lenses WHERE owner = coalesce(?, owner) ORDER BY change DESC", (owner,)
            ).fetchall()
        return [_lens(row) for row in rows]

    def delete(self, lens_id: str | None = None, owner: str | None = None) -> int:
        with self._database.transaction() as writer:
            # coalesce: a value that isn't given restricts nothing.
            deleted = writer.execute(
                "DELETE FROM lenses WHERE id = coalesce(?, id) AND owner = coalesce(?, owner)", (lens_id, owner)
            ).rowcount
        self._database.give_space_back()
        return deleted

    def close(self) -> None:
        self._database.close()

    def _trim(self, writer: Connection) -> None:
        writer.execute(
            "DELETE FROM lenses WHERE change <= (SELECT change FROM lenses ORDER BY change DESC LIMIT 1 OFFSET ?)",
            (self._limit,),
        )


def _lens(row: tuple[Any, ...]) -> StoredLens:
    key, estimate, updated = row
    return StoredLens(decode(LensKey, key), decode(LensEstimate, estimate), updated)
