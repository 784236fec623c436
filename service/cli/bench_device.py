"""`splatfix bench device`: a block of figures about this machine, to be sent to whoever asks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.demo import demo_scene
from service.cli.terminal import JsonFileOption, counter, progress_bar, say, write_json


def bench_device(
    folder: Annotated[Path | None, typer.Argument(help="A scene folder with test photos; the demo scene's.")] = None,
    limit_s: Annotated[float, typer.Option(min=1, help="Seconds for localizing photos.")] = 60.0,
    emulated: Annotated[bool, typer.Option("--emulated", help="Note that the processor is emulated.")] = False,
    json_file: JsonFileOption = None,
) -> None:
    """Print what this machine is, how fast splatfix is on it and how accurate: some two minutes."""
    from service.bench.device import block, run
    from service.cli.diagnostics import processor

    scene = folder or demo_scene()
    with progress_bar() as progress:
        done = counter(progress, "with and without intrinsics")
        outcome = run(scene, processor=processor(), limit_s=limit_s, emulated=emulated, progress=done)
    write_json(json_file, outcome)
    say(block(outcome))
