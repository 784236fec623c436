"""`splatfix bench coverage`: do coverage maps hold on held-out photos?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from service.cli.terminal import JsonFileOption, out, print_machine, progress_bar, settings_of, short, write_json


def bench_coverage(
    scenes: Annotated[list[Path], typer.Argument(help="Scene folders with photos that they were not trained on.")],
    json_file: JsonFileOption = None,
) -> None:
    """Measure coverage maps, and count the held-out photos that are found where the map says so."""
    from service.bench.coverage import run

    print_machine()
    with progress_bar() as progress:
        task = progress.add_task("photos", total=None)
        found = run(
            scenes,
            lambda name, done, total: progress.update(task, description=name, completed=done, total=total),
            settings_of({}).cache_dir,
        )
    columns = ("scene", "seconds", "renders_found", "sure_share", "count", "found", "sure", "sure_found", "brier")
    table = Table(*(name.replace("_", " ") for name in columns))
    for row in [*found["scenes"], {"scene": "all", **found["all"]}]:
        table.add_row(*(short(row.get(name, "")) for name in columns))
    out.print(table)
    write_json(json_file, found)
