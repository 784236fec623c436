"""`splatfix keys add | list | remove`: the API keys of the service."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.cli.terminal import say, settings_of
from service.errors import InvalidRequest

if TYPE_CHECKING:
    from service.web.key_file import StoredKey

keys_app = typer.Typer(no_args_is_help=True, help="Manage API keys.")


@keys_app.command("add")
def add_key(
    name: Annotated[str, typer.Argument(help="Name of the key, for your own overview.")],
    role: Annotated[Literal["read", "localize", "admin"], typer.Option()] = "localize",
    scene: Annotated[
        list[str] | None,
        typer.Option(help="A scene that the key may use, or a pattern: 'floor-*'. Repeat it for more; default: all."),
    ] = None,
    rate: Annotated[str | None, typer.Option(help="Its rate limit: 10/second, 600/minute, 1000/day.")] = None,
    queue_share: Annotated[float | None, typer.Option(help="Of the queue, how much its jobs may take: 0.5")] = None,
    expires: Annotated[
        str | None, typer.Option(help="When it ends: after 12h, 30d, 8w, or on a date, 2030-01-31.")
    ] = None,
) -> None:
    """Make an API key and print it; only its hash is kept."""
    from service.web import key_file

    until = None if expires is None else key_file.expiry(expires)
    limits = key_file.KeyLimits(tuple(scene) if scene else None, rate, queue_share, until)
    # Without rich: the key alone, for scripts.
    typer.echo(key_file.add_key(_keys_file(), name, role, limits))


@keys_app.command("list")
def list_keys() -> None:
    """List the keys with their roles and limits."""
    from service.web import key_file

    for key in key_file.read_keys(_keys_file()):
        say(f"{key.role:9} {key.name}{''.join(f'; {limit}' for limit in _limits(key))}")


@keys_app.command("remove")
def remove_key(name: str) -> None:
    """Delete a key; running services refuse it at once."""
    from service.web import key_file

    key_file.remove_key(_keys_file(), name)


def _limits(key: StoredKey) -> Iterator[str]:
    """Yield what narrows a key's role, as phrases."""
    limits = key.limits
    if limits.scenes is not None:
        yield f"scenes {', '.join(limits.scenes)}"
    if limits.rate is not None:
        yield limits.rate
    if limits.queue_share is not None:
        yield f"{limits.queue_share:g} of the queue"
    if limits.expires is not None:
        date = datetime.fromtimestamp(limits.expires, UTC).strftime("%Y-%m-%d %H:%M UTC")
        yield f"until {date}" if key.is_valid() else f"EXPIRED on {date}"


def _keys_file() -> Path:
    path = settings_of({}).keys_file
    if path is None:
        raise InvalidRequest("no keys file is set.", where="SPLATFIX_KEYS_FILE")
    return path
