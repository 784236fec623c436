"""`splatfix doctor`: what runs on this machine, and the settings in force."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from service.cli.terminal import err, say, settings_of


def doctor(
    warm: Annotated[bool, typer.Option("--warm", help="First compile all kernels; takes a minute, once.")] = False,
) -> None:
    """Print what runs on this machine, and why the rest doesn't. Exit code 1 if localizing can't work."""
    from service.cli.diagnostics import compile_kernels, findings
    from service.web.settings import unknown_variables

    if warm:
        with err.status("compiling"):
            compile_kernels()
    healthy = True
    with err.status("examining"):
        for finding in findings():
            mark = "ok  " if finding.ok else "FAIL" if finding.needed else "no  "
            say(f"{mark} {finding.subject:24} {finding.detail}")
            healthy &= finding.ok or not finding.needed
    for name, value in settings_of({}).model_dump().items():
        say(f"     SPLATFIX_{name.upper():22} {value}")
    for line in unknown_variables(os.environ):
        say(f"no   {line}")
    if not healthy:
        raise typer.Exit(1)
