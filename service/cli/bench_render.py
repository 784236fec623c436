"""`splatfix bench render`: the renderer's times."""

from __future__ import annotations

from typing import Annotated

import typer

from service.cli.bench_output import measuring
from service.cli.terminal import JsonFileOption, out, short, write_json


def bench_render(
    repeats: Annotated[int, typer.Option(min=1, help="Repetitions per image; the shortest time counts.")] = 30,
    json_file: JsonFileOption = None,
) -> None:
    """Time the renderer on the synthetic room."""
    from service.bench.render import run

    with measuring("cases") as progress:
        outcome = run(repeats=repeats, progress=progress)
    write_json(json_file, outcome)
    for row in [outcome[0].keys(), *(row.values() for row in outcome)]:
        out.print(" ".join(f"{short(value):>13}" for value in row), highlight=False, soft_wrap=True)
