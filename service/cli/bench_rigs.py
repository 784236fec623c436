"""`splatfix bench rigs`: photos that fail alone, as rigs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.bench_output import measuring, report_figures
from service.cli.terminal import JsonFileOption, settings_of


def bench_rigs(
    folder: Annotated[Path, typer.Argument(help="A scene folder with test photos and their poses.")],
    occluders: Annotated[Path, typer.Option(help="Another one, whose photos hide parts.")],
    rigs: Annotated[int, typer.Option(min=1, help="Queries.")] = 30,
    photos: Annotated[int, typer.Option(min=2, max=8, help="Of a query.")] = 4,
    variants: Annotated[int, typer.Option(min=1, help="How often each photo is modified in each way.")] = 2,
    modify: Annotated[list[str] | None, typer.Option(help="NAME=VALUE; may be repeated.")] = None,
    seed: int = 0,
    json_file: JsonFileOption = None,
) -> None:
    """Localize photos that fail alone together, with their true relative poses, and with wrong ones."""
    from service.bench.rigs import MODIFICATIONS, run

    with measuring("rigs") as progress:
        outcome = run(
            folder,
            occluders,
            rigs=rigs,
            photos=photos,
            variants=variants,
            modify=tuple(modify or MODIFICATIONS),
            seed=seed,
            cache_dir=settings_of({}).cache_dir,
            progress=progress,
        )
    report_figures(outcome, json_file, rows="per_query", width=36)
