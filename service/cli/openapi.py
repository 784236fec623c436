"""`splatfix openapi` (hidden): the API's description, which the repository keeps as openapi.yaml."""

from __future__ import annotations

from typing import Annotated

import typer


def openapi(
    live: Annotated[
        bool, typer.Option("--live", help="The JSON Schema of live sessions, docs/live.schema.json.")
    ] = False,
) -> None:
    """Print the API's description, as openapi.yaml has it, or docs/live.schema.json."""
    from service.web.app import openapi_yaml
    from service.web.schemas.live import live_schema

    # The texts end with a line break of their own: files of the repository are compared with them to the byte.
    typer.echo(live_schema() if live else openapi_yaml(), nl=False)
