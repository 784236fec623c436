"""`splatfix doctor`: what runs on this machine, and the settings in force."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import chain
from typing import Annotated

import typer

from service.cli.terminal import err, say, settings_of


def doctor(
    warm: Annotated[bool, typer.Option("--warm", help="First compile all kernels; takes a minute, once.")] = False,
) -> None:
    """Print what runs on this machine, and why the rest doesn't. Exit code 1 if localizing can't work."""
    from service.cli.diagnostics import compile_kernels, findings
    from service.cli.fleet_findings import fleet_findings

    if warm:
        with err.status("compiling"):
            compile_kernels()
    healthy = True
    with err.status("examining"):
        # Each is printed as it is made: some take seconds.
        for finding in chain(findings(), fleet_findings(settings_of({}))):
            say(finding.line)
            healthy &= finding.ok or not finding.needed
    for line in settings_lines():
        say(line)
    if not healthy:
        raise typer.Exit(1)


def settings_lines() -> Iterator[str]:
    """Yield the settings in force, and the names of unknown ones."""
    from service.web.settings import unknown_variables

    for name, value in settings_of({}).model_dump().items():
        yield f"     SPLATFIX_{name.upper():22} {value}"
    for line in unknown_variables(os.environ):
        yield f"no   {line}"
