"""`splatfix bench track`: a camera on a smooth path through a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from service.cli.bench_output import measuring, report_figures
from service.cli.terminal import JsonFileOption, settings_of


def bench_track(
    folder: Annotated[Path, typer.Argument(help="A scene folder with training cameras.")],
    frames: Annotated[int, typer.Option(min=2, help="Number of frames.")] = 300,
    seed: int = 0,
    intrinsics: Annotated[Literal["given", "withheld"], typer.Option()] = "given",
    json_file: JsonFileOption = None,
) -> None:
    """Follow a camera along a smooth path through a scene."""
    from service.bench.track import run

    with measuring("frames") as progress:
        outcome = run(
            folder,
            frames=frames,
            seed=seed,
            intrinsics=intrinsics,
            progress=progress,
            cache_dir=settings_of({}).cache_dir,
        )
    report_figures(outcome, json_file, rows="per_frame")
