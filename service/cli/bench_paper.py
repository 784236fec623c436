"""`splatfix bench paper`: the paper's tables and figures."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.cli.terminal import MatcherOption, err, out, print_machine, scene_arguments, settings_of

if TYPE_CHECKING:
    from rich.table import Table

    from service.bench.paper.runs import Progress


def bench_paper(
    scenes: Annotated[list[str], typer.Argument(help="Scene folders; SCENE=DATA where the data set is elsewhere.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder of results; an interrupted run is continued.")],
    trials: Annotated[int, typer.Option(min=1, help="Trials of fast methods per scene and protocol.")] = 40,
    slow_trials: Annotated[int, typer.Option(min=0, help="Trials of the baselines.")] = 5,
    study: Annotated[list[str] | None, typer.Option(help="table1, table2, table5, pnerf, range, resolution.")] = None,
    method: Annotated[list[str] | None, typer.Option(help="Only this method; may be repeated.")] = None,
    protocol: Annotated[list[str] | None, typer.Option(help="Only this protocol; may be repeated.")] = None,
    layout: Annotated[str, typer.Option(help="Layout of the data sets.")] = "auto",
    background: Annotated[Literal["scene", "white", "black"], typer.Option()] = "scene",
    matcher: MatcherOption = "",
    seed: int = 0,
    report: Annotated[Path | None, typer.Option(help="Write tables, figures and page to this folder.")] = None,
    run: Annotated[bool, typer.Option("--run/--report-only", help="Run what is missing first.")] = True,
) -> None:
    """Reproduce the paper: methods x scenes x protocols, then its tables and figures."""
    from service.bench.paper import runs
    from service.bench.paper.plan import chosen
    from service.loaded_scene import DEFAULT_MATCHER

    spec = runs.RunSpec(
        scenes=scene_arguments(scenes),
        cells=chosen(study or (), method or (), protocol or ()),
        out=folder,
        trials=trials,
        slow_trials=slow_trials,
        seed=seed,
        matcher=matcher or DEFAULT_MATCHER,
        layout=layout,
        background=background,
        cache_dir=settings_of({}).cache_dir,
    )
    if run:
        print_machine()
        with _live_table() as show:
            runs.run(spec, show)
    if report:
        from service.bench.paper.report import write

        with err.status("drawing"):
            write(spec, report)
        out.print(str(report / "index.html"), highlight=False, soft_wrap=True)


@contextmanager
def _live_table() -> Iterator[Callable[[Progress], None]]:
    """Yield a function that shows the progress of a run: a table in a terminal, else a line a minute."""
    from rich.live import Live

    printed_s = time.monotonic()
    with Live(console=err, auto_refresh=False, transient=True) as live:

        def show(progress: Progress) -> None:
            nonlocal printed_s
            # A table that is drawn again would fill a log file.
            if err.is_terminal:
                live.update(_progress_table(progress), refresh=True)
            elif time.monotonic() - printed_s > 60:
                printed_s = time.monotonic()
                done, total = sum(progress.done.values()), sum(progress.total.values())
                err.print(f"{done} of {total} queries, {progress.eta_s / 60:.0f} minutes to go", highlight=False)

        yield show


def _progress_table(progress: Progress) -> Table:
    from rich.table import Table

    scenes = list(dict.fromkeys(scene for scene, _ in progress.total))
    table = Table("study / method / start", *scenes, title="within 5 deg / 0.05, of done, of all")
    for cell in dict.fromkeys(cell for _, cell in progress.total):
        places = [(scene, cell) for scene in scenes]
        if any(progress.done.get(place) for place in places):
            counts = [(progress.within.get(p, 0), progress.done.get(p, 0), progress.total[p]) for p in places]
            table.add_row(cell, *(f"{a} / {b} / {c}" for a, b, c in counts))
    done, total = sum(progress.done.values()), sum(progress.total.values())
    table.caption = f"{done} of {total} queries, {progress.eta_s / 60:.0f} minutes to go"
    return table
