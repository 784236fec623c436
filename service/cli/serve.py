"""`splatfix serve`: the HTTP service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import BrowserOption, err, out, settings_of


def serve(
    scenes: Annotated[
        list[Path] | None, typer.Argument(help="Scene folders, scene files, or folders of scene folders.")
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on; 0: any free one.", min=0, max=65535)] = None,
    viewer: Annotated[bool | None, typer.Option("--viewer/--no-viewer", help="The viewer under /viewer.")] = None,
    https: Annotated[bool, typer.Option("--https", help="HTTPS, with a local certificate unless one is set.")] = False,
    open_to_all: Annotated[bool, typer.Option("--open", help="Listen beyond this machine without keys.")] = False,
    engine: Annotated[str | None, typer.Option(help="Where jobs run: embedded, or ray: other processes.")] = None,
    ray_address: Annotated[str | None, typer.Option(help="A Ray cluster's address, e.g. auto.")] = None,
    browser: BrowserOption = False,
) -> None:
    """Serve scenes over HTTP. What isn't given here comes from SPLATFIX_* in the environment, or a file.

    The file is the one that SPLATFIX_CONFIG names, or ~/.config/splatfix/splatfix.toml.
    """
    from service.cli.server import run

    given = {"scenes": scenes or None, "host": host, "port": port, "viewer": viewer, "open": open_to_all or None}
    given |= {"https": https or None, "engine": engine, "ray_address": ray_address}
    # None stands for an option that was not given: the environment's or the file's value holds.
    run(settings_of({name: value for name, value in given.items() if value is not None}), out, err, browser)
