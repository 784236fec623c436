"""`splatfix bench gate`: how well the verification gate separates right poses from wrong ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.bench_output import measuring
from service.cli.terminal import JsonFileOption, out, settings_of, write_json


def bench_gate(
    folders: Annotated[list[Path], typer.Argument(help="Scene folders with test photos: one or more.")],
    seed: int = 0,
    json_file: JsonFileOption = None,
    model: Annotated[Path | None, typer.Option(help="Write the fitted model, a .json.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Write a reliability plot, a .png.")] = None,
) -> None:
    """Test the verification gate on right, wrong and foreign poses, leaving one scene out of its fit in turn.

    With --model the model that is fitted on all is written; service/pose/verification/model.json is such a file.
    """
    from service.bench.gate import run
    from service.pose.verification.gate_model import model_from_json, write_model

    with measuring("photos") as progress:
        outcome = run(folders, seed=seed, progress=progress, cache_dir=settings_of({}).cache_dir)
    write_json(json_file, outcome)
    if model:
        write_model(model_from_json(outcome["model"]), model)
    if plot:
        from service.bench.paper.figures import reliability  # loads matplotlib

        plot.write_bytes(reliability({name: outcome[name]["reliability"] for name in ("with_matches", "photometric")}))
    for name in ("with_matches", "photometric", "tracked"):
        for key, value in outcome[name].items():
            if key not in ("reliability", "by_kind"):
                out.print(f"{name:13} {key:30} {value}", markup=False, highlight=False, soft_wrap=True)
