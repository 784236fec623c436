"""The command line: `splatfix serve | localize | render | bench | scenes | doctor`."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.logging import RichHandler
from rich.progress import track

from service.cli.bench_commands import bench_app
from service.cli.terminal import (
    MatcherOption,
    err,
    loaded_scene,
    out,
    parsed_option,
    print_json,
    read_file,
    say,
    settings_of,
)
from service.errors import InvalidRequest, SplatfixError

if TYPE_CHECKING:
    from service.localize import LoadedScene
    from service.web.schemas.parsing import Body
    from service.web.schemas.requests import LocalizeFields
    from service.web.schemas.responses import Result

# Everything else is imported where it is used: `splatfix --help` shall not wait for torch and numba.

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, help="Photo in, pose out.")
scenes_app = typer.Typer(no_args_is_help=True, help="Look at scenes.")
keys_app = typer.Typer(no_args_is_help=True, help="Who may use the service.")
app.add_typer(bench_app, name="bench")
app.add_typer(keys_app, name="keys")
app.add_typer(scenes_app, name="scenes")

SceneOption = Annotated[Path, typer.Option("--scene", help="Scene folder or scene file.")]
IntrinsicsOption = Annotated[
    str,
    typer.Option("--intrinsics", help="JSON, or a file of it: width, height, fx, fy, cx, cy[, model, distortion]."),
]


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
    from service.cli.serve import run

    given = {"scenes": scenes or None, "host": host, "port": port, "viewer": viewer, "open": open_to_all or None}
    run(settings_of({name: value for name, value in given.items() if value is not None}), out, err)


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
    from service.localize import DEFAULT_ESTIMATOR
    from service.photos.sequence import is_sequence
    from service.scene_formats.discovery import find_scenes
    from service.web.schemas.parsing import Body, body_of, read_fields

    given = {"estimator": estimator or None, "seed": seed, "budget_s": budget_s, "every": every}
    nested = {"intrinsics": intrinsics, "prior": prior, "times_s": times}
    given |= {name: parsed_option(text, name) for name, text in nested.items()}
    fields = read_fields({name: value for name, value in given.items() if value is not None})
    files = [(str(photo), read_file(photo)) for photo in photos]
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
    loaded = [loaded_scene(path, fields.estimator or DEFAULT_ESTIMATOR, matcher) for path in paths]
    if follow:
        _localize_sequence(body_of(files, {}), fields, loaded[0], csv_file, tum_file, as_json)
    else:
        _localize_each([Body(data, name, {}) for name, data in files], fields, loaded, csv_file, as_json)


def _localize_each(
    bodies: list[Body], fields: LocalizeFields, loaded: list[LoadedScene], csv_file: Path | None, as_json: bool
) -> None:
    from service.cli import result_tables as answers
    from service.localize import localize as run
    from service.multi_scene import Found, localize_anywhere
    from service.web.schemas.conversion import result_out, timing_out
    from service.web.schemas.parsing import make_task
    from service.web.schemas.resources import versions

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
            say(answers.photo_line(*results[-1]))
    if as_json:
        print_json([{"photo": name, **result.model_dump(mode="json")} for name, result in results])
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
    from service.cli import result_tables as answers
    from service.jobs.trajectory import Trajectory
    from service.photos.sequence import read_sequence
    from service.tracking import localize_sequence
    from service.web.schemas.exports import trajectory_of
    from service.web.schemas.parsing import make_task

    task, _ = make_task(body, fields, loaded, max_frames=sys.maxsize)
    if task.reading is None:
        raise InvalidRequest("a sequence has two photos or more, or is a video.", where="photos")
    trajectory = Trajectory()
    for found in localize_sequence(read_sequence(body.photo, task.reading), loaded, task.request):
        frame = trajectory.add(found).frame
        if frame and not as_json:
            say(answers.frame_line(frame))
    result = trajectory.result(loaded.scene.info.geo_anchor)
    if as_json:
        print_json({"photo": body.name, **result.model_dump(mode="json")})
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
    from service.scene_manager.scene_images import picture
    from service.web.schemas.parsing import read_fields
    from service.web.schemas.requests import RenderIn

    fields = read_fields({"truth": parsed_option(pose, "truth")})
    if fields.truth is None:
        raise InvalidRequest("a pose is required.", where="--pose")
    kind = out_file.suffix.lower().removeprefix(".").replace("jpeg", "jpg")
    if kind not in ("png", "jpg"):
        raise InvalidRequest("must end with .png or .jpg.", where="--out")
    wanted = RenderIn(
        pose=fields.truth, intrinsics=parsed_option(intrinsics, "intrinsics"), format="png" if kind == "png" else "jpeg"
    )
    out_file.write_bytes(picture(loaded_scene(scene), wanted))


@scenes_app.command("list")
def list_scenes(
    folder: Annotated[Path, typer.Argument(help="A scene, or a folder of scenes.")] = Path(),
) -> None:
    """List the scenes at a path, without reading them."""
    from service.scene_formats.discovery import find_scenes

    for scene in find_scenes(folder):
        say(str(scene))


@scenes_app.command("inspect")
def inspect_scene(
    scene: Annotated[Path, typer.Argument(help="Scene folder or scene file.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
) -> None:
    """Read a scene and say what is in it, and from where it would be looked at."""
    from service.cli.inspection import inspected, told

    with err.status(f"looking at {scene}"):
        facts = inspected(scene)
    if as_json:
        print_json(facts)
        return
    for name, value in told(facts).items():
        say(f"{name:18} {value}")


@keys_app.command("add")
def add_key(
    name: Annotated[str, typer.Argument(help="Whose it is; for you.")],
    role: Annotated[Literal["read", "localize", "admin"], typer.Option()] = "localize",
) -> None:
    """Make an API key and print it; only its hash is kept."""
    from service.web import api_keys as keys

    print(keys.add_key(_keys_file(), name, role))


@keys_app.command("list")
def list_keys() -> None:
    """List names and roles."""
    from service.web import api_keys as keys

    for key in keys.read_keys(_keys_file()):
        say(f"{key.role:9} {key.name}")


@keys_app.command("remove")
def remove_key(name: str) -> None:
    """Forget a key; running services refuse it within a second."""
    from service.web import api_keys as keys

    keys.remove_key(_keys_file(), name)


def _keys_file() -> Path:
    path = settings_of({}).keys_file
    if path is None:
        raise InvalidRequest("there is no file for keys.", where="SPLATFIX_KEYS_FILE")
    return path


@app.command()
def doctor(
    warm: Annotated[bool, typer.Option("--warm", help="Compile every kernel first: a minute, once.")] = False,
) -> None:
    """Say what runs on this machine, and why the rest doesn't."""
    from service.cli.doctor import findings
    from service.cli.doctor import warm as compile_kernels

    if warm:
        with err.status("compiling"):
            compile_kernels()
    healthy = True
    with err.status("examining"):
        for finding in findings():
            mark = "ok  " if finding.ok else "FAIL" if finding.needed else "no  "
            say(f"{mark} {finding.subject:24} {finding.detail}")
            healthy &= finding.ok or not finding.needed
    for name, value in settings_of({}).model_dump().items():
        say(f"     SPLATFIX_{name.upper():22} {value}")
    if not healthy:
        raise typer.Exit(1)


@app.command(hidden=True)
def openapi() -> None:
    """Print the API's description, as openapi.yaml has it."""
    from service.web.app import openapi_yaml

    print(openapi_yaml(), end="")


if __name__ == "__main__":
    main()
