"""`splatfix keys add | list | remove`: the API keys of the service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from service.cli.terminal import say, settings_of
from service.errors import InvalidRequest

keys_app = typer.Typer(no_args_is_help=True, help="Manage API keys.")


@keys_app.command("add")
def add_key(
    name: Annotated[str, typer.Argument(help="Name of the key, for your own overview.")],
    role: Annotated[Literal["read", "localize", "admin"], typer.Option()] = "localize",
) -> None:
    """Make an API key and print it; only its hash is kept."""
    from service.web import api_keys

    # Without rich: the key alone, for scripts.
    typer.echo(api_keys.add_key(_keys_file(), name, role))


@keys_app.command("list")
def list_keys() -> None:
    """List names and roles."""
    from service.web import api_keys

    for key in api_keys.read_keys(_keys_file()):
        say(f"{key.role:9} {key.name}")


@keys_app.command("remove")
def remove_key(name: str) -> None:
    """Delete a key; running services refuse it within a second."""
    from service.web import api_keys

    api_keys.remove_key(_keys_file(), name)


def _keys_file() -> Path:
    path = settings_of({}).keys_file
    if path is None:
        raise InvalidRequest("no keys file is set.", where="SPLATFIX_KEYS_FILE")
    return path
