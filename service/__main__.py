"""The command line: `splatfix serve | localize | render | bench | scenes | doctor`."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn, track

from service.errors import InvalidRequest, SplatfixError

if TYPE_CHECKING:
    from rich.table import Table

    from service.api.intake import Body
    from service.api.requests import LocalizeFields
    from service.api.schemas import Result
    from service.api.settings import Settings
    from service.bench.paper.runs import Standing
    from service.localize import LoadedScene

# Everything else is imported where it is used: `splatfix --help` shall not wait for torch and numba.

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, help="Photo in, pose out.")
bench_app = typer.Typer(no_args_is_help=True, help="Measure accuracy and speed.")
scenes_app = typer.Typer(no_args_is_help=True, help="Look at scenes.")
keys_app = typer.Typer(no_args_is_help=True, help="Who may use the service.")
app.add_typer(bench_app, name="bench")
app.add_typer(keys_app, name="keys")
app.add_typer(scenes_app, name="scenes")
out, err = Console(), Console(stderr=True)

SceneOption = Annotated[Path, typer.Option("--scene", help="Scene folder or scene file.")]
IntrinsicsOption = Annotated[
    str,
    typer.Option("--intrinsics", help="JSON, or a file of it: width, height, fx, fy, cx, cy[, model, distortion]."),
]
MatcherOption = Annotated[str, typer.Option("--matcher", help="Of local features; `splatfix doctor` lists them.")]


def main() -> None:
    """Run the command line; an error that a user can mend is one line and exit code 2."""
    # Before numpy and torch are imported: a job runs on one thread, and several jobs at once.
    for library in ("OMP", "MKL", "OPENBLAS", "VECLIB_MAXIMUM"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")
    handler = RichHandler(console=err, show_path=False) if err.is_terminal else logging.StreamHandler()
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s", handlers=[handler])
    try:
        app()
    except SplatfixError as error:
        err.print(f"error: {error}", style="red", markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(2) from None


@app.command()
def serve(
    scenes: Annotated[
        list[Path] | None, typer.Argument(help="Scene folders, scene files, or folders of scene folders.")
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="0: any free one.", min=0, max=65535)] = None,
    viewer: Annotated[bool | None, typer.Option("--viewer/--no-viewer", help="The viewer under /viewer.")] = None,
    open_to_all: Annotated[bool, typer.Option("--open", help="Listen beyond this machine without keys.")] = False,
) -> None:
    """Serve scenes over HTTP. What isn't given here comes from SPLATFIX_* in the environment, or a file.

    The file is the one that SPLATFIX_CONFIG names, or ~/.config/splatfix/splatfix.toml.
    """
    from service.serve import run

    given = {"scenes": scenes or None, "host": host, "port": port, "viewer": viewer, "open": open_to_all or None}
    run(_settings({name: value for name, value in given.items() if value is not None}), out, err)


def _settings(given: dict[str, Any]) -> Settings:
    from pydantic import ValidationError

    from service.api.problems import described
    from service.api.settings import Settings

    try:
        return Settings(**given)
    except ValidationError as error:
        where, message = described(error.errors())
        raise InvalidRequest(message, where=where) from error


@app.command()
def localize(
    photos: Annotated[list[Path], typer.Argument(help="JPEG, PNG, WebP or HEIC; or one video.")],
    scene: Annotated[
        list[Path], typer.Option("--scene", help="Scene folder, scene file or folder of scenes; may be repeated.")
    ],
    sequence: Annotated[
        bool, typer.Option("--sequence", help="One camera's photos in their order: follow it. A video always is.")
    ] = False,
    intrinsics: IntrinsicsOption = "",
    prior: Annotated[str, typer.Option(help="What is known of the pose, as the API takes it: JSON or a file.")] = "",
    estimator: Annotated[str, typer.Option(help="`splatfix doctor` lists them.")] = "",
    matcher: MatcherOption = "",
    seed: int = 0,
    budget_s: Annotated[float | None, typer.Option(help="Seconds after which the best so far counts.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Of a sequence: use each Nth.")] = 1,
    times: Annotated[str, typer.Option(help="Of a sequence's photos: JSON list of seconds, or a file of it.")] = "",
    csv_file: Annotated[Path | None, typer.Option("--csv", help="Write a table.")] = None,
    tum_file: Annotated[Path | None, typer.Option("--tum", help="Of a sequence: write a trajectory.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print results as the API has them.")] = False,
) -> None:
    """Find where photos, or a video's frames, were taken in a scene; of several scenes, also in which."""
    from service.api.intake import Body, body_of, read_fields
    from service.api.sequence import is_sequence
    from service.localize import DEFAULT_ESTIMATOR
    from service.scene_formats.discovery import find_scenes

    given = {"estimator": estimator or None, "seed": seed, "budget_s": budget_s, "every": every}
    nested = {"intrinsics": intrinsics, "prior": prior, "times_s": times}
    given |= {name: _json(text, name) for name, text in nested.items()}
    fields = read_fields({name: value for name, value in given.items() if value is not None})
    files = [(str(photo), _bytes(photo)) for photo in photos]
    follow = sequence or any(is_sequence(data) for _, data in files)
    for option, given_for_one in (("--tum", tum_file), ("--every", every > 1), ("--times", times)):
        if given_for_one and not follow:
            raise InvalidRequest("this is of a sequence: add --sequence.", where=option)
    paths = [path for given_path in scene for path in find_scenes(given_path)]
    if follow and len(paths) > 1:
        raise InvalidRequest(
            "only single photos are looked for in several scenes; this is a sequence.",
            where="--scene",
            hint="Name one scene; one photo of the sequence, by itself, can tell which.",
        )
    loaded = [_loaded(path, fields.estimator or DEFAULT_ESTIMATOR, matcher) for path in paths]
    if follow:
        _localize_sequence(body_of(files, {}), fields, loaded[0], csv_file, tum_file, as_json)
    else:
        _localize_each([Body(data, name, {}) for name, data in files], fields, loaded, csv_file, as_json)


def _localize_each(
    bodies: list[Body], fields: LocalizeFields, loaded: list[LoadedScene], csv_file: Path | None, as_json: bool
) -> None:
    from service import answers
    from service.anywhere import Found, localize_anywhere
    from service.api.convert import result_out, timing_out
    from service.api.documents import versions
    from service.api.intake import make_task
    from service.localize import localize as run

    results: list[tuple[str, Result]] = []
    for body in track(bodies, "photos", console=err, transient=True, disable=len(bodies) == 1):
        task, query = make_task(body, fields, loaded[0])
        if len(loaded) > 1:
            found = localize_anywhere(query, loaded, task.request)
        else:
            found = Found(run(query, loaded[0], task.request), loaded[0])
        anchor = found.loaded.scene.info.geo_anchor
        results.append((body.name, result_out(found.estimate, timing_out(task.decode), versions(), anchor)))
        if not as_json:
            _say(answers.photo_line(*results[-1]))
    if as_json:
        _print_json([{"photo": name, **result.model_dump(mode="json")} for name, result in results])
    if csv_file:
        answers.write_photo_table(csv_file, results)


def _localize_sequence(
    body: Body,
    fields: LocalizeFields,
    loaded: LoadedScene,
    csv_file: Path | None,
    tum_file: Path | None,
    as_json: bool,
) -> None:
    from service import answers
    from service.api.exports import trajectory_of
    from service.api.intake import make_task
    from service.api.sequence import read_sequence
    from service.api.trajectory import Trajectory
    from service.track import localize_sequence

    task, _ = make_task(body, fields, loaded, max_frames=sys.maxsize)
    if task.reading is None:
        raise InvalidRequest("a sequence has two photos or more, or is a video.", where="photos")
    trajectory = Trajectory()
    for found in localize_sequence(read_sequence(body.photo, task.reading), loaded, task.request):
        frame = trajectory.add(found).frame
        if frame and not as_json:
            _say(answers.frame_line(frame))
    result = trajectory.result(loaded.scene.info.geo_anchor)
    if as_json:
        _print_json({"photo": body.name, **result.model_dump(mode="json")})
    if csv_file:
        answers.write_frame_table(csv_file, result.frames or [])
    if tum_file:
        tum_file.write_text(trajectory_of(result.frames or []), encoding="utf-8")


@app.command()
def render(
    scene: SceneOption,
    pose: Annotated[str, typer.Option(help="As the API takes a prior: JSON or a file.")],
    out_file: Annotated[Path, typer.Option("--out", help="A .png or .jpg to write.")],
    intrinsics: IntrinsicsOption = "",
) -> None:
    """Render a scene; without intrinsics as its first training camera sees, or 640 x 480."""
    from service.api.intake import read_fields
    from service.api.pictures import picture
    from service.api.requests import RenderIn

    fields = read_fields({"truth": _json(pose, "truth")})
    if fields.truth is None:
        raise InvalidRequest("a pose is required.", where="--pose")
    kind = out_file.suffix.lower().removeprefix(".").replace("jpeg", "jpg")
    if kind not in ("png", "jpg"):
        raise InvalidRequest("must end with .png or .jpg.", where="--out")
    wanted = RenderIn(
        pose=fields.truth, intrinsics=_json(intrinsics, "intrinsics"), format="png" if kind == "png" else "jpeg"
    )
    out_file.write_bytes(picture(_loaded(scene), wanted))


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
    from service.api.intake import options_from
    from service.bench import misses as pictures
    from service.bench.localize import Budget, run
    from service.localize import DEFAULT_MATCHER

    _tell_machine()
    with _progress() as progress:
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
            options=options_from(estimator, _json(options, "options") or {}),
            budget=Budget(budget_s, budget_renders),
            progress=_counter(progress, "photos"),
            cache_dir=_settings({}).cache_dir,
            on_miss=pictures.kept_in(misses) if misses else None,
        )
    _write_json(json_file, outcome)
    for name, value in outcome.items():
        if name != "per_query":
            _say(f"{name:28} {_short(value)}")


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

    _tell_machine()
    with _progress() as progress:
        outcome = run(
            folder,
            frames=frames,
            seed=seed,
            intrinsics=intrinsics,
            progress=_counter(progress, "frames"),
            cache_dir=_settings({}).cache_dir,
        )
    _write_json(json_file, outcome)
    for name, value in outcome.items():
        if name != "per_frame":
            _say(f"{name:28} {_short(value)}")


def _say(text: str) -> None:
    out.print(text, markup=False, highlight=False, soft_wrap=True)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


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
        cache_dir=_settings({}).cache_dir,
    )
    if run:
        _tell_machine()
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

    _tell_machine()
    if len(folders) < 2:
        raise InvalidRequest("needs two scenes or more, to test on another one than it fits on.", where="folders")
    with _progress() as progress:
        outcome = run(folders, seed=seed, progress=_counter(progress, "photos"), cache_dir=_settings({}).cache_dir)
    _write_json(json_file, outcome)
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

    _tell_machine()
    with _progress() as progress:
        outcome = run(repeats=repeats, progress=_counter(progress, "cases"))
    _write_json(json_file, outcome)
    for row in [outcome[0].keys(), *(row.values() for row in outcome)]:
        out.print(" ".join(f"{_short(value):>13}" for value in row), highlight=False, soft_wrap=True)


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

    _tell_machine()
    with _progress() as progress:
        rows = run(
            folder,
            others=around or (),
            sizes=sizes or SIZES,
            cameras=cameras,
            compressed=compressed,
            work=work,
            progress=_counter(progress, "sizes"),
        )
    _write_json(json_file, rows)
    if plot_file:
        from service.bench.paper.figures import growth  # loads matplotlib

        plot_file.write_bytes(growth(rows))
    for name in rows[0]:
        out.print(f"{name:20}" + " ".join(f"{_short(row[name]):>14}" for row in rows), highlight=False, soft_wrap=True)


@bench_app.command("ablation")
def bench_ablation(
    folders: Annotated[list[Path], typer.Argument(help="Scene folders with test photos: at least two.")],
    parts: Annotated[list[str] | None, typer.Option("--part", help="Remove only this; may be repeated.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the whole outcome.")] = None,
) -> None:
    """Remove each part of the default estimator in turn; print a Markdown table of what is left."""
    from service.bench.ablation import run, table

    _tell_machine()
    if len(folders) < 2:
        raise InvalidRequest("needs two scenes or more, to hide the photos of one by another's.", where="folders")
    with _progress() as progress:
        counter = _counter(progress, "conditions")
        rows = run(folders, parts=parts or (), cache_dir=_settings({}).cache_dir, progress=counter)
    _write_json(json_file, rows)
    out.print(table(rows), markup=False, highlight=False, soft_wrap=True)


@scenes_app.command("list")
def list_scenes(
    folder: Annotated[Path, typer.Argument(help="A scene, or a folder of scenes.")] = Path(),
) -> None:
    """List the scenes at a path, without reading them."""
    from service.scene_formats.discovery import find_scenes

    for scene in find_scenes(folder):
        _say(str(scene))


@scenes_app.command("inspect")
def inspect_scene(
    scene: Annotated[Path, typer.Argument(help="Scene folder or scene file.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
) -> None:
    """Read a scene and say what is in it, and from where it would be looked at."""
    from service.inspection import inspected, told

    with err.status(f"looking at {scene}"):
        facts = inspected(scene)
    if as_json:
        _print_json(facts)
        return
    for name, value in told(facts).items():
        _say(f"{name:18} {value}")


@keys_app.command("add")
def add_key(
    name: Annotated[str, typer.Argument(help="Whose it is; for you.")],
    role: Annotated[Literal["read", "localize", "admin"], typer.Option()] = "localize",
) -> None:
    """Make an API key and print it; only its hash is kept."""
    from service.api import keys

    print(keys.add_key(_keys_file(), name, role))


@keys_app.command("list")
def list_keys() -> None:
    """List names and roles."""
    from service.api import keys

    for key in keys.read_keys(_keys_file()):
        _say(f"{key.role:9} {key.name}")


@keys_app.command("remove")
def remove_key(name: str) -> None:
    """Forget a key; running services refuse it within a second."""
    from service.api import keys

    keys.remove_key(_keys_file(), name)


def _keys_file() -> Path:
    path = _settings({}).keys_file
    if path is None:
        raise InvalidRequest("there is no file for keys.", where="SPLATFIX_KEYS_FILE")
    return path


@app.command()
def doctor(
    warm: Annotated[bool, typer.Option("--warm", help="Compile every kernel first: a minute, once.")] = False,
) -> None:
    """Say what runs on this machine, and why the rest doesn't."""
    from service.doctor import findings
    from service.doctor import warm as compile_kernels

    if warm:
        with err.status("compiling"):
            compile_kernels()
    healthy = True
    with err.status("examining"):
        for finding in findings():
            mark = "ok  " if finding.ok else "FAIL" if finding.needed else "no  "
            _say(f"{mark} {finding.subject:24} {finding.detail}")
            healthy &= finding.ok or not finding.needed
    for name, value in _settings({}).model_dump().items():
        _say(f"     SPLATFIX_{name.upper():22} {value}")
    if not healthy:
        raise typer.Exit(1)


@app.command(hidden=True)
def openapi() -> None:
    """Print the API's description, as openapi.yaml has it."""
    from service.api.app import openapi_yaml

    print(openapi_yaml(), end="")


def _json(text: str, where: str) -> Any:
    """Parse an option that is JSON, or names a file of it; None if it is empty."""
    from service.api.intake import parsed_json

    if not text:
        return None
    return parsed_json(text if text.lstrip()[:1] in ("{", "[") else _bytes(Path(text)), where)


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidRequest(f"{error.strerror}.", where=str(path)) from error


def _loaded(scene: Path, estimator: str | None = None, matcher: str = "") -> LoadedScene:
    """Load a scene and, if an estimator is to use it, make what that prepares for it."""
    from service.localize import LoadedScene

    with err.status(f"reading {scene}") as status:
        settings = _settings({"matcher": matcher} if matcher else {})
        loaded = LoadedScene.load(scene, cache_dir=settings.cache_dir, matcher=settings.matcher)
        if estimator:
            status.update("preparing")
            loaded.prepare(estimator)
    return loaded


def _tell_machine() -> None:
    from service.doctor import processor

    err.print(processor(), markup=False, highlight=False, soft_wrap=True)


def _progress() -> Progress:
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=err, transient=True)


def _counter(progress: Progress, unit: str) -> Callable[[int, int], None]:
    """Return a function that shows (done, of how many) as a bar."""
    task = progress.add_task(unit, total=None)
    return lambda done, total: progress.update(task, completed=done, total=total)


def _write_json(path: Path | None, value: Any) -> None:
    if path:
        path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=1))


if __name__ == "__main__":
    main()
