"""`splatfix openapi` (hidden): the API's description, which the repository keeps as openapi.yaml."""

from __future__ import annotations

import typer


def openapi() -> None:
    """Print the API's description, as openapi.yaml has it."""
    from service.web.app import openapi_yaml

    typer.echo(openapi_yaml(), nl=False)
