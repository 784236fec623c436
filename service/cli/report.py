"""`splatfix report`: what a bug report about a job needs, in one ZIP."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.terminal import err, say

if TYPE_CHECKING:
    from service.client import Client

README = """A report on job {job} by splatfix {version}.

job.json     the job: request without its photo, result, versions, timings
trace.json   every step of the search
scene.json   the scene: counts, frames, training cameras, units; not the scene itself
render.jpg   the scene at the job's last pose
photo.jpg    the photo, only with --photo
doctor.txt   the machine on which `splatfix report` ran, and its settings
missing.txt  what the service did not give, and why

Names of photos and scenes, poses, and the scene's place on Earth are in it: look through it before you send it on.
API keys are not.
"""


def report(
    job: Annotated[str, typer.Argument(help="The job's id, as in the address of its page.")],
    url: Annotated[str, typer.Option(help="The service.")] = "http://127.0.0.1:8000",
    key: Annotated[str, typer.Option(envvar="SPLATFIX_KEY", help="API key, if the service has keys.")] = "",
    out: Annotated[Path | None, typer.Option(help="Default: splatfix-report-JOB.zip")] = None,
    photo: Annotated[bool, typer.Option("--photo", help="Put the photo in, too.")] = False,
) -> None:
    """Write a ZIP for a bug report about a job: its result, trace and scene, the machine and its settings."""
    from service import __version__
    from service.client import Client, ServiceError
    from service.errors import InvalidRequest

    path = out or Path(f"splatfix-report-{job}.zip")
    with Client(url, key or None) as client, err.status("asking the service"):
        try:
            raw = client.job(job).raw
        except ServiceError as error:
            raise InvalidRequest(f"{error}", where=url) from None
        parts, missing = {"job.json": _json(raw)}, []
        for name, read in _parts(client, job, raw["scene"], with_photo=photo):
            try:
                parts[name] = read()
            except ServiceError as error:  # a report with a gap is better than none
                missing.append(f"{name}: {error}")
    parts["README.txt"] = README.format(job=job, version=__version__).encode()
    with err.status("examining this machine"):
        parts["doctor.txt"] = "\n".join(_machine()).encode()
    if missing:
        parts["missing.txt"] = "\n".join(missing).encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(parts):
            archive.writestr(name, parts[name])
    say(f"{path}: {', '.join(sorted(parts))}")


def _parts(client: Client, job: str, scene: str, *, with_photo: bool) -> Iterator[tuple[str, Callable[[], bytes]]]:
    # As functions: one that fails leaves the others.
    yield "trace.json", lambda: _json(client.trace(job))
    yield "scene.json", lambda: _json(client.scene(scene).raw)
    yield "render.jpg", lambda: client.step_render(job)
    if with_photo:
        yield "photo.jpg", lambda: client.photo(job)


def _machine() -> Iterator[str]:
    """Yield what `splatfix doctor` prints, without the home folder's name."""
    from service.cli.diagnostics import findings
    from service.cli.doctor import settings_lines

    for line in chain((finding.line for finding in findings()), settings_lines()):
        # It holds the user's name, which no bug depends on.
        yield line.replace(str(Path.home()), "~")


def _json(value: object) -> bytes:
    return json.dumps(value, indent=1).encode()
