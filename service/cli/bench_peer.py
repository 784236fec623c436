"""`splatfix bench peer`: our estimator beside structure from motion against the training photos."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import JsonFileOption, counter, print_machine, progress_bar, say, short, write_json


def bench_peer(
    folders: Annotated[list[Path], typer.Argument(help="Scene folders with training and test photos.")],
    data: Annotated[Path | None, typer.Option(help="The data set's folder, if it isn't the (only) scene's.")] = None,
    layout: Annotated[str, typer.Option(help="As of `bench localize`.")] = "auto",
    method: Annotated[list[str] | None, typer.Option(help="May be repeated; default: all.")] = None,
    modify: Annotated[list[str] | None, typer.Option(help="NAME=VALUE; may be repeated.")] = None,
    seed: int = 0,
    json_file: JsonFileOption = None,
) -> None:
    """Localize the same photos with ours and with COLMAP's parts, and compare errors, CPU time and memory."""
    from service.bench.peer.comparison import METHODS, Task, run
    from service.errors import InvalidRequest

    if data is not None and len(folders) > 1:
        raise InvalidRequest("one data set can't belong to several scenes.", where="--data", hint="Name one scene.")
    print_machine()
    tasks = [Task(folder, data, layout, tuple(modify or ()), seed) for folder in folders]
    with progress_bar() as progress:
        rows = list(run(tasks, method or METHODS, counter(progress, "methods")))
    write_json(json_file, rows)
    say("scene        method           1 deg/.01  5 deg/.05  false  median deg  units   CPU ms  build CPU s  peak MB")
    for row in rows:
        of = f"/{row['photos']}"
        say(
            f"{row['scene'][:12]:12} {row['method']:16} {str(row['right_1deg_0p01']) + of:>9}  "
            f"{str(row['right_5deg_0p05']) + of:>9}  {row['false_localized']:5}  {row['median_rotation_deg']:10.3f}  "
            f"{short(row['median_translation_units']):>6}  {row['cpu_ms_p50']:6.0f}  {row['build_cpu_s']:11.1f}  "
            f"{row['peak_bytes'] / 1e6:7.0f}"
        )
