"""What the commands share on a terminal: consoles, progress bars, options that are JSON, and loading a scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from service.errors import InvalidRequest

if TYPE_CHECKING:
    from service.localize import LoadedScene
    from service.web.settings import Settings

out, err = Console(), Console(stderr=True)

MatcherOption = Annotated[str, typer.Option("--matcher", help="Of local features; `splatfix doctor` lists them.")]
IntrinsicsOption = Annotated[
    str,
    typer.Option("--intrinsics", help="JSON, or a file of it: width, height, fx, fy, cx, cy[, model, distortion]."),
]
JsonFileOption = Annotated[Path | None, typer.Option("--json", help="Write the whole outcome.")]


def settings_of(given: dict[str, Any]) -> Settings:
    """Return the settings, some of them given on the command line. Raises SplatfixError."""
    from pydantic import ValidationError

    from service.web.problems import described
    from service.web.settings import Settings

    try:
        return Settings(**given)
    except ValidationError as error:
        where, message = described(error.errors())
        raise InvalidRequest(message, where=where) from error


def say(text: str) -> None:
    """Print a line as it is."""
    out.print(text, markup=False, highlight=False, soft_wrap=True)


def short(value: Any) -> str:
    """Return a figure as people read it."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def parsed_option(text: str, where: str) -> Any:
    """Parse an option that is JSON, or names a file of it; None if it is empty."""
    from service.web.schemas.parsing import parsed_json

    if not text:
        return None
    return parsed_json(text if text.lstrip()[:1] in ("{", "[") else read_file(Path(text)), where)


def read_file(path: Path) -> bytes:
    """Return what a file holds. Raises InvalidRequest."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidRequest(f"{error.strerror}.", where=str(path)) from error


def loaded_scene(scene: Path, estimator: str | None = None, matcher: str = "") -> LoadedScene:
    """Load a scene and, if an estimator is to use it, make what that prepares for it."""
    from service.localize import LoadedScene

    with err.status(f"reading {scene}") as status:
        settings = settings_of({"matcher": matcher} if matcher else {})
        loaded = LoadedScene.load(scene, cache_dir=settings.cache_dir, matcher=settings.matcher)
        if estimator:
            status.update("preparing")
            loaded.prepare(estimator)
    return loaded


def print_machine() -> None:
    """Say on what a benchmark runs, and what else runs there."""
    from service.cli.diagnostics import processor

    err.print(processor(), markup=False, highlight=False, soft_wrap=True)


def progress_bar() -> Progress:
    """Return bars for what takes more than a second; they disappear when it is done."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=err, transient=True)


def counter(progress: Progress, unit: str) -> Callable[[int, int], None]:
    """Return a function that shows (done, of how many) as a bar."""
    task = progress.add_task(unit, total=None)
    return lambda done, total: progress.update(task, completed=done, total=total)


def write_json(path: Path | None, value: Any) -> None:
    """Write a file, if one is asked for."""
    if path:
        path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def print_json(value: Any) -> None:
    """Print for other programs."""
    say(json.dumps(value, indent=1))
