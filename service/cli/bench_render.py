"""`splatfix bench render`: the renderer's times."""

from __future__ import annotations

from typing import Annotated

import typer

from service.cli.terminal import JsonFileOption, counter, out, print_machine, progress_bar, short, write_json


def bench_render(
    repeats: Annotated[int, typer.Option(min=1, help="Repetitions per image; the shortest time counts.")] = 30,
    json_file: JsonFileOption = None,
) -> None:
    """Time the renderer on the synthetic room."""
    from service.bench.render import run

    print_machine()
    with progress_bar() as progress:
        outcome = run(repeats=repeats, progress=counter(progress, "cases"))
    write_json(json_file, outcome)
    for row in [outcome[0].keys(), *(row.values() for row in outcome)]:
        out.print(" ".join(f"{short(value):>13}" for value in row), highlight=False, soft_wrap=True)
