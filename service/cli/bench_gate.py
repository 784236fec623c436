"""`splatfix bench gate`: how well the verification gate separates right poses from wrong ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import JsonFileOption, counter, out, print_machine, progress_bar, settings_of, write_json
from service.errors import InvalidRequest


def bench_gate(
    folders: Annotated[list[Path], typer.Argument(help="Scene folders with test photos: at least two.")],
    seed: int = 0,
    json_file: JsonFileOption = None,
    plot: Annotated[Path | None, typer.Option(help="Write a reliability plot, a .png.")] = None,
) -> None:
    """Test the verification gate on right, wrong and foreign poses, leaving one scene out of its fit in turn."""
    from service.bench.gate import run

    print_machine()
    if len(folders) < 2:
        raise InvalidRequest("needs two scenes or more, to test on another one than it fits on.", where="folders")
    with progress_bar() as progress:
        outcome = run(folders, seed=seed, progress=counter(progress, "photos"), cache_dir=settings_of({}).cache_dir)
    write_json(json_file, outcome)
    if plot:
        from service.bench.paper.figures import reliability

        plot.write_bytes(reliability({name: outcome[name]["reliability"] for name in ("with_matches", "by_pixels")}))
    for name in ("with_matches", "by_pixels", "glance"):
        for key, value in outcome[name].items():
            if key not in ("reliability", "by_kind"):
                out.print(f"{name:13} {key:30} {value}", markup=False, highlight=False, soft_wrap=True)
