"""`splatfix bench ablation`: what each part of the default estimator adds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.bench_output import measuring
from service.cli.terminal import JsonFileOption, out, settings_of, write_json
from service.errors import InvalidRequest


def bench_ablation(
    folders: Annotated[list[Path], typer.Argument(help="Scene folders with test photos: at least two.")],
    parts: Annotated[list[str] | None, typer.Option("--part", help="Remove only this; may be repeated.")] = None,
    json_file: JsonFileOption = None,
) -> None:
    """Remove each part of the default estimator in turn; print a Markdown table of what is left."""
    from service.bench.ablation import run, table

    if len(folders) < 2:
        raise InvalidRequest("needs two scenes or more, to hide the photos of one by another's.", where="folders")
    with measuring("conditions") as progress:
        rows = run(folders, parts=parts or (), cache_dir=settings_of({}).cache_dir, progress=progress)
    write_json(json_file, rows)
    out.print(table(rows), markup=False, highlight=False, soft_wrap=True)
