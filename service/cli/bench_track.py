"""`splatfix bench track`: a camera on a smooth path through a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from service.cli.terminal import (
    JsonFileOption,
    counter,
    print_machine,
    progress_bar,
    say,
    settings_of,
    short,
    write_json,
)


def bench_track(
    folder: Annotated[Path, typer.Argument(help="A scene folder with training cameras.")],
    frames: Annotated[int, typer.Option(min=2, help="Number of frames.")] = 300,
    seed: int = 0,
    intrinsics: Annotated[Literal["given", "withheld"], typer.Option()] = "given",
    json_file: JsonFileOption = None,
) -> None:
    """Follow a camera along a smooth path through a scene."""
    from service.bench.track import run

    print_machine()
    with progress_bar() as progress:
        outcome = run(
            folder,
            frames=frames,
            seed=seed,
            intrinsics=intrinsics,
            progress=counter(progress, "frames"),
            cache_dir=settings_of({}).cache_dir,
        )
    write_json(json_file, outcome)
    for name, value in outcome.items():
        # Hundreds of rows, for the file.
        if name != "per_frame":
            say(f"{name:28} {short(value)}")
