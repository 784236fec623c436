"""The `splatfix` application: the commands by name, threads and logging of the process, errors as exit codes."""

from __future__ import annotations

import io
import logging
import os
import sys

import typer
from rich.logging import RichHandler

from service.cli.bench import bench_app
from service.cli.demo import demo
from service.cli.doctor import doctor
from service.cli.keys import keys_app
from service.cli.localize import localize
from service.cli.openapi import openapi
from service.cli.render import render
from service.cli.report import report
from service.cli.scenes import scenes_app
from service.cli.serve import serve
from service.cli.terminal import err, tell_error
from service.errors import SplatfixError

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Localize photos in 3D Gaussian scenes.",
)
# In the order in which `--help` lists them.
for command in (serve, demo, localize, render, doctor, report):
    app.command()(command)
app.command(hidden=True)(openapi)
app.add_typer(bench_app, name="bench")
app.add_typer(keys_app, name="keys")
app.add_typer(scenes_app, name="scenes")


def main() -> None:
    """Run the command line; an error that a user can correct is one line on stderr and exit code 2."""
    # Before numpy and torch are imported: a job runs on one thread, and several jobs at once.
    for library in ("OMP", "MKL", "OPENBLAS", "VECLIB_MAXIMUM"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")
    for stream in (sys.stdout, sys.stderr):
        # A pipe or file has the system's encoding, on Windows one of 256 characters.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    handler = RichHandler(console=err, show_path=False) if err.is_terminal else logging.StreamHandler()
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s", handlers=[handler])
    try:
        app()
    except SplatfixError as error:
        tell_error(error)
        raise SystemExit(2) from None
