"""`splatfix bench field`: lenses, photos and scenes as people have them, one factor at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import counter, print_machine, progress_bar, say, scene_arguments, settings_of


def bench_field(
    scenes: Annotated[
        list[str] | None, typer.Argument(help="Scene folders; SCENE=PHOTOS where photos and truth are elsewhere.")
    ] = None,
    folder: Annotated[Path, typer.Option("--out", help="Folder of results; an interrupted run is continued.")] = Path(
        "field"
    ),
    rows: Annotated[list[str] | None, typer.Option("--row", help="Only rows like this, e.g. 'lens/k1=*'.")] = None,
    random: Annotated[int, typer.Option(min=0, help="Random combinations per scene; rows only if named, too.")] = 0,
    photos: Annotated[int | None, typer.Option(min=1, help="Limit of test photos per scene.")] = None,
    seed: int = 0,
    occluders: Annotated[Path | None, typer.Option(help="Photos of another scene, to hide parts with.")] = None,
    by_scene: Annotated[bool, typer.Option("--by-scene", help="A line of the table for each scene and row.")] = False,
    table_only: Annotated[bool, typer.Option("--table-only", help="Print the table of existing results.")] = False,
    show_rows: Annotated[bool, typer.Option("--list", help="Print the rows, and end.")] = False,
) -> None:
    """Localize photos with the lenses, defects and scenes that people have; print a Markdown table."""
    from service.bench import field
    from service.bench.field_rows import chosen_rows
    from service.bench.field_table import table

    chosen = chosen_rows(rows or ()) if rows or not random else []
    if show_rows:
        for row in chosen:
            say(row.name)
        return
    spec = field.FieldSpec(
        scenes=scene_arguments(scenes or [], named_by_photos=True),
        rows=chosen,
        random=random,
        out=folder,
        photos=photos,
        seed=seed,
        occluders=occluders,
        cache_dir=settings_of({}).cache_dir,
    )
    if not table_only:
        print_machine()
        with progress_bar() as progress:
            bars = {name: counter(progress, name) for name in spec.scenes}
            field.run(spec, lambda name, done, total: bars[name](done, total))
    lines, names = field.read_results(spec), {row.name for row in chosen}
    if rows or random:
        lines = [one for one in lines if one["row"] in names or (random and one["group"] == "random")]
    say(table(lines, by_scene))
    # A run that was gone on with may mix them.
    if len(versions := sorted({one["code"] for one in lines})) > 1:
        say(f"made by several versions of the code: {', '.join(versions)}")
