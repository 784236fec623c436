"""The findings of `splatfix doctor` about what several fronts share."""

from __future__ import annotations

from collections.abc import Iterator

from service.cli.diagnostics import Finding
from service.errors import SplatfixError
from service.web.settings import Settings


def fleet_findings(settings: Settings) -> Iterator[Finding]:
    """Examine the shared database, where one is set."""
    if settings.database is None:
        return
    try:
        from service.jobs.postgres_database import PostgresDatabase, unprotected
    except ImportError:
        yield Finding("database", False, "psycopg is missing: pip install 'splatfix[postgres]'")
        return
    address = settings.database.get_secret_value()
    try:
        database = PostgresDatabase(address)
        database.now()
        database.close()
    except SplatfixError as error:
        yield Finding("database", False, error.message)
    else:
        yield Finding("database", True, "PostgreSQL answers; jobs, photos and lenses are there")
    if warning := unprotected(address):
        yield Finding("database's privacy", False, warning, needed=False)
