"""`splatfix bench gpu`: the GPU's renderer beside the CPU's."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import JsonFileOption, counter, progress_bar, read_file, say
from service.errors import BackendMissing, InvalidRequest


def bench_gpu(
    folder: Annotated[Path, typer.Argument(help="A scene folder with test photos.")] = Path("scenes/studio"),
    renderer: Annotated[str, typer.Option(help="Renderer to compare with the CPU's.")] = "gsplat_cuda",
    small: Annotated[bool, typer.Option("--small", help="Few and small images, to try it without a GPU.")] = False,
    part: Annotated[list[str] | None, typer.Option(help="Only this part; may be repeated.")] = None,
    limit_s: Annotated[float, typer.Option(min=1, help="Time limit of all parts together, seconds.")] = 470.0,
    table_of: Annotated[Path | None, typer.Option(help="Run nothing; print the table of this result file.")] = None,
    json_file: JsonFileOption = None,
) -> None:
    """Compare a GPU's renderer with the CPU's: images, gradients, poses, times, memory. Prints a Markdown table.

    The file of --json is written after every row, so that a run that is cut short leaves its rows. Exit code 1 if a
    part didn't come to its end.
    """
    from service.bench.gpu_table import markdown

    if table_of:
        try:
            say(markdown(json.loads(read_file(table_of))))
        except (ValueError, KeyError, TypeError) as error:
            raise InvalidRequest(f"not a result of `bench gpu`: {error!r}.", where=str(table_of)) from None
        return
    from service.bench.gpu import run
    from service.cli.diagnostics import processor

    with progress_bar() as progress:
        outcome = run(
            folder,
            renderer=renderer,
            small=small,
            names=part or (),
            limit_s=limit_s,
            facts={"started": datetime.now(UTC).isoformat(timespec="seconds"), "processor": processor()},
            file=json_file,
            progress=counter(progress, "parts"),
        )
    say(markdown(outcome))
    first = outcome["parts"][0]
    # Without its first part, which loads the renderer, no other can run: that is why, and not one failure of many.
    if first["state"] != "done":
        raise BackendMissing(first.get("error", "the first part wasn't run."), where=renderer)
    if any(each["state"] != "done" for each in outcome["parts"]):
        raise typer.Exit(1)
