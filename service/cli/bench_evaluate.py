"""`splatfix bench evaluate`: poses of any program against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import JsonFileOption, say, short, write_json


def bench_evaluate(
    poses: Annotated[Path, typer.Option(help="Poses to be judged: a file, or a COLMAP model's folder.")],
    truth: Annotated[Path, typer.Option(help="The true poses: likewise; see docs/benchmarks.md for the formats.")],
    names: Annotated[Path | None, typer.Option(help="A list of the photos that count.")] = None,
    metres_per_unit: Annotated[float, typer.Option(min=1e-9, help="Metres in a unit of the truth.")] = 1.0,
    scene: Annotated[Path | None, typer.Option(help="A scene in the truth's frame, for normalized units.")] = None,
    json_file: JsonFileOption = None,
) -> None:
    """Compare poses of photos with the truth: medians, and the share within the usual bounds."""
    from service.bench.evaluate import evaluated

    units = None if scene is None else _units_per_scene_unit(scene)
    outcome = evaluated(poses, truth, names, metres_per_unit=metres_per_unit, units_per_unit=units)
    write_json(json_file, outcome)
    say(f"{outcome['answered']} of {outcome['photos']} photos of {outcome['photos_of']} have a pose in {poses.name}")
    metres = outcome["median_translation_m"]
    median = "none: more than half have no pose" if metres is None else f"{metres:.4f} m"
    say(f"{'median':12} {median}, {outcome['median_rotation_deg']:.3f} deg")
    for row in outcome["recall"]:
        bound = f"{100 * row['m']:g} cm" if "m" in row else f"{short(row['units'])} units"
        say(f"{bound:>12} {row['deg']:g} deg: {100 * row['share']:.2f} %")


def _units_per_scene_unit(folder: Path) -> float:
    from service.bench.localize import load_bench_scene
    from service.cli.terminal import settings_of

    return load_bench_scene(folder, cache_dir=settings_of({}).cache_dir).units.units_per_scene_unit
