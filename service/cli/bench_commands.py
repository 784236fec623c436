"""`splatfix bench ...`: accuracy and speed, measured."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.cli.terminal import (
    MatcherOption,
    counter,
    err,
    out,
    parsed_option,
    progress_bar,
    say,
    settings_of,
    short,
    tell_machine,
    write_json,
)
from service.errors import InvalidRequest

if TYPE_CHECKING:
    from rich.table import Table

    from service.bench.paper.runs import Standing

# Everything else is imported where it is used: `splatfix --help` shall not wait for torch and numba.

bench_app = typer.Typer(no_args_is_help=True, help="Measure accuracy and speed.")


@bench_app.command("localize")
def bench_localize(
    folder: Annotated[Path, typer.Argument(help="A scene folder with test photos and their poses, or a scene file.")],
    data: Annotated[Path | None, typer.Option(help="The data set's folder, if it isn't the scene's.")] = None,
    layout: Annotated[
        str, typer.Option(help="auto, nerf_synthetic, llff, mipnerf360, deep_blending, nerfstudio or scene.")
    ] = "auto",
    background: Annotated[Literal["scene", "white", "black"], typer.Option()] = "scene",
    estimator: str = "view_index",
    matcher: MatcherOption = "",
    start: Annotated[str, typer.Option(help="none, near, easy, hard, pnerf, inplace or random.")] = "none",
    trials: Annotated[int, typer.Option(min=1, help="Starts a photo.")] = 1,
    seed: int = 0,
    intrinsics: Annotated[Literal["given", "approximate", "withheld"], typer.Option()] = "given",
    cameras: Annotated[Literal["given", "ignored"], typer.Option()] = "given",
    modify: Annotated[list[str] | None, typer.Option(help="NAME=VALUE; may be repeated.")] = None,
    occluders: Annotated[Path | None, typer.Option(help="Photos of another scene, for `--modify occlusion`.")] = None,
    options: Annotated[str, typer.Option(help="The estimator's, as JSON or a file of it.")] = "",
    budget_s: Annotated[float | None, typer.Option(help="Seconds a query.")] = None,
    budget_renders: Annotated[int | None, typer.Option(help="Renders a query.", min=1)] = None,
    misses: Annotated[Path | None, typer.Option(help="A folder for a picture of each miss at 1 deg, 0.01.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the whole outcome.")] = None,
) -> None:
    """Localize a scene's test photos and compare with the truth."""
    from service.bench import misses as pictures
    from service.bench.localize import Budget, run
    from service.localize import DEFAULT_MATCHER
    from service.web.schemas.parsing import options_from

    tell_machine()
    with progress_bar() as progress:
        outcome = run(
            folder,
            data=data,
            layout=layout,
            background=background,
            estimator=estimator,
            matcher=matcher or DEFAULT_MATCHER,
            start=start,
            trials=trials,
            seed=seed,
            intrinsics=intrinsics,
            cameras=cameras,
            modify=tuple(modify or ()),
            occluders=occluders,
            options=options_from(estimator, parsed_option(options, "options") or {}),
            budget=Budget(budget_s, budget_renders),
            progress=counter(progress, "photos"),
            cache_dir=settings_of({}).cache_dir,
            on_miss=pictures.kept_in(misses) if misses else None,
        )
    write_json(json_file, outcome)
    for name, value in outcome.items():
        if name != "per_query":
            say(f"{name:28} {short(value)}")


@bench_app.command("track")
def bench_track(
    folder: Annotated[Path, typer.Argument(help="A scene folder with training cameras.")],
    frames: Annotated[int, typer.Option(min=2, help="Of the path.")] = 300,
    seed: int = 0,
    intrinsics: Annotated[Literal["given", "withheld"], typer.Option()] = "given",
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the whole outcome.")] = None,
) -> None:
    """Follow a camera along a smooth path through a scene."""
    from service.bench.track import run

    tell_machine()
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
        if name != "per_frame":
            say(f"{name:28} {short(value)}")


@bench_app.command("paper")
def bench_paper(
    scenes: Annotated[list[str], typer.Argument(help="Scene folders; SCENE=DATA where the data set is elsewhere.")],
    folder: Annotated[Path, typer.Option("--out", help="Where results are kept; a run there is gone on with.")],
    trials: Annotated[int, typer.Option(min=1, help="Of fast methods, a scene and protocol.")] = 40,
    slow_trials: Annotated[int, typer.Option(min=0, help="Of the baselines.")] = 5,
    study: Annotated[list[str] | None, typer.Option(help="table1, table2, table5, pnerf, range, resolution.")] = None,
    method: Annotated[list[str] | None, typer.Option(help="Only these.")] = None,
    protocol: Annotated[list[str] | None, typer.Option(help="Only these.")] = None,
    layout: Annotated[str, typer.Option(help="Of the data sets.")] = "auto",
    background: Annotated[Literal["scene", "white", "black"], typer.Option()] = "scene",
    matcher: MatcherOption = "",
    seed: int = 0,
    report: Annotated[Path | None, typer.Option(help="Write tables, figures and page to this folder.")] = None,
    run: Annotated[bool, typer.Option("--run/--report-only", help="Run what is missing first.")] = True,
) -> None:
    """Reproduce the paper: methods x scenes x protocols, then its tables and figures."""
    from service.bench.paper import runs
    from service.bench.paper.plan import chosen
    from service.localize import DEFAULT_MATCHER

    asked = runs.Asked(
        scenes=_scene_arguments(scenes),
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
        tell_machine()
        with _live_table() as show:
            runs.run(asked, show)
    if report:
        from service.bench.paper.report import write

        with err.status("drawing"):
            write(asked, report)
        out.print(str(report / "index.html"), highlight=False, soft_wrap=True)


def _scene_arguments(given: list[str]) -> dict[str, tuple[Path, Path | None]]:
    """SCENE or SCENE=DATA; a scene's name is its folder's."""
    found: dict[str, tuple[Path, Path | None]] = {}
    for text in given:
        scene, _, data = text.partition("=")
        name = Path(scene).resolve().stem
        if name in found:
            raise InvalidRequest(f"there are two scenes '{name}'.", where="scenes")
        found[name] = Path(scene), Path(data) if data else None
    return found


@contextmanager
def _live_table() -> Iterator[Callable[[Standing], None]]:
    """Yield a function that shows how far a run is: a table in a terminal, else a line a minute."""
    from rich.live import Live

    told = time.monotonic()
    with Live(console=err, auto_refresh=False, transient=True) as live:

        def show(standing: Standing) -> None:
            nonlocal told
            if err.is_terminal:
                live.update(_standing_table(standing), refresh=True)
            elif time.monotonic() - told > 60:
                told = time.monotonic()
                done, total = sum(standing.done.values()), sum(standing.total.values())
                err.print(f"{done} of {total} queries, {standing.eta_s / 60:.0f} minutes to go", highlight=False)

        yield show


def _standing_table(standing: Standing) -> Table:
    from rich.table import Table

    scenes = list(dict.fromkeys(scene for scene, _ in standing.total))
    table = Table("study / method / start", *scenes, title="within 5 deg / 0.05, of done, of all")
    for cell in dict.fromkeys(cell for _, cell in standing.total):
        places = [(scene, cell) for scene in scenes]
        if any(standing.done.get(place) for place in places):
            counts = [(standing.within.get(p, 0), standing.done.get(p, 0), standing.total[p]) for p in places]
            table.add_row(cell, *(f"{a} / {b} / {c}" for a, b, c in counts))
    done, total = sum(standing.done.values()), sum(standing.total.values())
    table.caption = f"{done} of {total} queries, {standing.eta_s / 60:.0f} minutes to go"
    return table


@bench_app.command("gate")
def bench_gate(
    folders: Annotated[list[Path], typer.Argument(help="Scene folders with test photos: at least two.")],
    seed: int = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the whole outcome.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Write a reliability plot, a .png.")] = None,
) -> None:
    """Test the verification gate on right, wrong and foreign poses, leaving one scene out of its fit in turn."""
    from service.bench.gate import run

    tell_machine()
    if len(folders) < 2:
        raise InvalidRequest("needs two scenes or more, to test on another one than it fits on.", where="folders")
    with progress_bar() as progress:
        outcome = run(folders, seed=seed, progress=counter(progress, "photos"), cache_dir=settings_of({}).cache_dir)
    write_json(json_file, outcome)
    if plot:
        from service.bench.paper.figures import reliability

        plot.write_bytes(reliability({name: outcome[name]["reliability"] for name in ("with_matches", "by_pixels")}))
    for name in ("with_matches", "by_pixels", "glance"):
        for key, value in outcome[name].items():
            if key not in ("reliability", "by_kind"):
                out.print(f"{name:13} {key:30} {value}", markup=False, highlight=False, soft_wrap=True)


@bench_app.command("render")
def bench_render(
    repeats: Annotated[int, typer.Option(min=1, help="Of each picture; the least time counts.")] = 30,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the whole outcome.")] = None,
) -> None:
    """Time the renderer on the synthetic room."""
    from service.bench.render import run

    tell_machine()
    with progress_bar() as progress:
        outcome = run(repeats=repeats, progress=counter(progress, "cases"))
    write_json(json_file, outcome)
    for row in [outcome[0].keys(), *(row.values() for row in outcome)]:
        out.print(" ".join(f"{short(value):>13}" for value in row), highlight=False, soft_wrap=True)


@bench_app.command("scale")
def bench_scale(
    folder: Annotated[Path, typer.Argument(help="A scene folder with test photos and their poses.")],
    around: Annotated[list[Path] | None, typer.Option(help="Scenes to put around it; else varied copies.")] = None,
    sizes: Annotated[list[int] | None, typer.Option("--size", min=1000, help="Gaussians; may be repeated.")] = None,
    cameras: Annotated[Literal["given", "ignored"], typer.Option()] = "ignored",
    compressed: Annotated[bool, typer.Option("--compressed", help="Write compressed scene files.")] = False,
    work: Annotated[Path | None, typer.Option(help="Where to write the large scenes meanwhile.")] = None,
    plot_file: Annotated[Path | None, typer.Option("--plot", help="Draw the curves, a .png.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the whole outcome.")] = None,
) -> None:
    """Measure loading, indexing, memory and localization of scenes of growing size."""
    from service.bench.scale import SIZES, run

    tell_machine()
    with progress_bar() as progress:
        rows = run(
            folder,
            others=around or (),
            sizes=sizes or SIZES,
            cameras=cameras,
            compressed=compressed,
            work=work,
            progress=counter(progress, "sizes"),
        )
    write_json(json_file, rows)
    if plot_file:
        from service.bench.paper.figures import growth  # loads matplotlib

        plot_file.write_bytes(growth(rows))
    for name in rows[0]:
        out.print(f"{name:20}" + " ".join(f"{short(row[name]):>14}" for row in rows), highlight=False, soft_wrap=True)


@bench_app.command("ablation")
def bench_ablation(
    folders: Annotated[list[Path], typer.Argument(help="Scene folders with test photos: at least two.")],
    parts: Annotated[list[str] | None, typer.Option("--part", help="Remove only this; may be repeated.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the whole outcome.")] = None,
) -> None:
    """Remove each part of the default estimator in turn; print a Markdown table of what is left."""
    from service.bench.ablation import run, table

    tell_machine()
    if len(folders) < 2:
        raise InvalidRequest("needs two scenes or more, to hide the photos of one by another's.", where="folders")
    with progress_bar() as progress:
        bar = counter(progress, "conditions")
        rows = run(folders, parts=parts or (), cache_dir=settings_of({}).cache_dir, progress=bar)
    write_json(json_file, rows)
    out.print(table(rows), markup=False, highlight=False, soft_wrap=True)
