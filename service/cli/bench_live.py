"""`splatfix bench live`: live sessions with a service at a camera's rate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from service.cli.bench_output import measuring, report_figures
from service.cli.terminal import JsonFileOption, say, settings_of, short


def bench_live(
    folder: Annotated[Path, typer.Argument(help="A scene folder with training cameras.")],
    seconds: Annotated[float, typer.Option(min=10, help="Length of the film without its pause.")] = 40,
    sessions: Annotated[int, typer.Option(min=1, max=4, help="Sessions at once.")] = 1,
    cores: Annotated[int, typer.Option(min=1, help="Processors of the service.")] = 1,
    seed: int = 0,
    intrinsics: Annotated[Literal["given", "withheld"], typer.Option()] = "given",
    odometry: Annotated[bool, typer.Option(help="Frames bring the odometry of a device, which drifts.")] = True,
    json_file: JsonFileOption = None,
) -> None:
    """Send a hand-held camera's film to a service as it is taken, and measure what comes back."""
    from service.bench.live import run

    with measuring("frames") as progress:
        outcome = run(
            folder,
            seconds=seconds,
            sessions=sessions,
            cores=cores,
            seed=seed,
            withheld=intrinsics == "withheld",
            odometry=odometry,
            progress=progress,
            cache_dir=settings_of({}).cache_dir,
        )
    report_figures(outcome, json_file, rows="sessions")
    for number, figures in enumerate(outcome["sessions"]):
        for name, value in figures.items():
            say(f"session {number} {name:28} {short(value)}")
