"""`splatfix bench scale`: loading, indexing, memory and localization by the size of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from service.cli.bench_output import measuring
from service.cli.terminal import JsonFileOption, out, short, write_json


def bench_scale(
    folder: Annotated[Path | None, typer.Argument(help="A scene folder with test photos and their poses.")] = None,
    street: Annotated[bool, typer.Option("--street", help="A synthetic street of 3 million, without FOLDER.")] = False,
    around: Annotated[list[Path] | None, typer.Option(help="Scenes to place around it, not varied copies.")] = None,
    sizes: Annotated[
        list[int] | None, typer.Option("--size", min=1000, help="How many Gaussians; may be repeated.")
    ] = None,
    cameras: Annotated[Literal["given", "ignored"], typer.Option()] = "ignored",
    compressed: Annotated[bool, typer.Option("--compressed", help="Write compressed scene files.")] = False,
    work: Annotated[Path | None, typer.Option(help="Folder for the large scenes while it runs.")] = None,
    plot_file: Annotated[Path | None, typer.Option("--plot", help="Draw the curves, a .png.")] = None,
    json_file: JsonFileOption = None,
) -> None:
    """Measure loading, indexing, memory and localization of scenes of growing size."""
    from service.bench.scale import SIZES, run, run_street

    if (folder is None) != street:
        raise typer.BadParameter("give either a scene folder or --street.")
    with measuring("sizes") as progress:
        if folder is None:
            rows = run_street(work=work)
        else:
            rows = run(
                folder,
                others=around or (),
                sizes=sizes or SIZES,
                cameras=cameras,
                compressed=compressed,
                work=work,
                progress=progress,
            )
    write_json(json_file, rows)
    if plot_file:
        from service.bench.paper.figures import growth  # loads matplotlib

        plot_file.write_bytes(growth(rows))
    for name in rows[0]:
        out.print(f"{name:20}" + " ".join(f"{short(row[name]):>14}" for row in rows), highlight=False, soft_wrap=True)
