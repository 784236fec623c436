"""The findings of `splatfix doctor` about what several fronts share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib import metadata

from service.cli.diagnostics import Finding
from service.errors import SplatfixError
from service.object_store import open_objects
from service.web.settings import Settings


def fleet_findings(settings: Settings) -> Iterator[Finding]:
    """Examine the Ray engine, the shared database and the object store, where they are set."""
    if settings.engine == "ray":
        yield from _ray_findings(settings.ray_address)
    if settings.database is not None:
        yield from _database_findings(settings.database.get_secret_value())
    if settings.object_store is not None:
        yield from _object_store_findings(settings.object_store)


def _ray_findings(address: str | None) -> Iterator[Finding]:
    try:
        version = metadata.version("ray")
    except metadata.PackageNotFoundError:
        yield Finding("Ray", False, "it is missing: pip install 'splatfix[ray]'")
        return
    yield Finding("Ray", True, f"{version}, {f'the cluster at {address}' if address else 'a cluster of this process'}")
    if os.environ.get("RAY_AUTH_MODE") == "disabled":
        yield Finding("Ray's access", False, "who reaches its ports can run code: RAY_AUTH_MODE=disabled", needed=False)


def _database_findings(address: str) -> Iterator[Finding]:
    # Not above: the driver is there only where the extra is installed.
    try:
        from service.jobs.postgres_database import PostgresDatabase, unprotected
    except ImportError:
        yield Finding("database", False, "psycopg is missing: pip install 'splatfix[postgres]'")
        return
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


def _object_store_findings(address: str) -> Iterator[Finding]:
    try:
        scenes = open_objects(address).versions("scenes/")
    except SplatfixError as error:
        yield Finding("object store", False, f"{error.message} {error.hint}".strip())
        return
    yield Finding("object store", True, f"{address} answers; it has {len(scenes)} uploaded scenes")
    endpoint = os.environ.get("AWS_ENDPOINT_URL", "https:")
    if address.startswith("s3:") and not endpoint.startswith("https:"):
        told = f"photos and scenes go to {endpoint} unencrypted"
        yield Finding("object store's privacy", False, told, needed=False)
