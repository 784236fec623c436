"""`splatfix localize`: the poses of photos, or of a sequence's frames, in a scene or in one of several."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import track

from service.cli.terminal import (
    IntrinsicsOption,
    MatcherOption,
    err,
    loaded_scene,
    parsed_option,
    print_json,
    read_file,
    say,
    scene_anchors,
    scene_registrations,
    tell_error,
)
from service.errors import BadInput, InvalidImage, InvalidIntrinsics, InvalidRequest

if TYPE_CHECKING:
    from service.jobs.model import JobRecord
    from service.loaded_scene import LoadedScene
    from service.registration.registration import Registration
    from service.results import Status
    from service.scene_manager.anchor_store import Anchor
    from service.web.schemas.job_results import Result
    from service.web.schemas.request_body import Body
    from service.web.schemas.requests import LocalizeFields


@dataclass(frozen=True, slots=True)
class _Output:
    """Where results go; standard output has one line a photo unless it is to have JSON."""

    as_json: bool
    csv_file: Path | None
    tum_file: Path | None
    smooth: bool = False


@dataclass(frozen=True, slots=True)
class _Scene:
    """A scene in memory, and what is kept beside its file."""

    loaded: LoadedScene
    registration: Registration | None
    anchors: tuple[Anchor, ...]


def localize(
    photos: Annotated[list[Path], typer.Argument(help="JPEG, PNG, WebP or HEIC; or one video.")],
    scene: Annotated[
        list[Path], typer.Option("--scene", help="Scene folder, scene file or folder of scenes; may be repeated.")
    ],
    sequence: Annotated[
        bool, typer.Option("--sequence", help="One camera's photos in their order: follow it. A video always is.")
    ] = False,
    rig: Annotated[
        str,
        typer.Option("--rig", help="Photos of cameras with known relative poses are one query: JSON or a file of it."),
    ] = "",
    intrinsics: IntrinsicsOption = "",
    prior: Annotated[str, typer.Option(help="What is known of the pose, as the API takes it: JSON or a file.")] = "",
    up_in_camera: Annotated[
        str, typer.Option("--up", help='Up by gravity in the camera, OpenCV axes: {"direction": [0, -1, 0]}.')
    ] = "",
    gps: Annotated[
        str, typer.Option(help='{"latitude": 47.3, "longitude": 8.5, "sigma_m": 5}, or exif: of each photo itself.')
    ] = "",
    heading: Annotated[str, typer.Option(help='By a compass, clockwise from north: {"degrees": 120}.')] = "",
    accuracy: Annotated[
        str, typer.Option(help='How accurate a pose must be, as the API takes it: {"deg": 2, "share": 0.01}.')
    ] = "",
    estimator: Annotated[str, typer.Option(help="`splatfix doctor` lists them.")] = "",
    matcher: MatcherOption = "",
    seed: int = 0,
    budget_s: Annotated[float | None, typer.Option(help="Time limit, seconds; returns the best pose so far.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Sequences: use every Nth frame.")] = 1,
    times: Annotated[str, typer.Option(help="Sequences: times of the photos in seconds, a JSON list or a file.")] = "",
    csv_file: Annotated[Path | None, typer.Option("--csv", help="Write a table.")] = None,
    tum_file: Annotated[Path | None, typer.Option("--tum", help="Sequences: write the trajectory.")] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Sequences: filter jitter and join short gaps in --csv and --tum.")
    ] = False,
    learn_lenses: Annotated[
        bool, typer.Option("--learn-lenses", help="Use the lens of earlier photos of the same camera, by EXIF.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print results as the API has them.")] = False,
    fail: Annotated[
        bool, typer.Option("--fail", help="Exit with code 1 unless every photo or frame is localized.")
    ] = False,
) -> None:
    """Find where photos, or a video's frames, were taken in a scene; of several scenes, also in which.

    The exit code is 0 also for photos that are not localized, unless --fail is given; 2 for an error. A photo that
    can't be read doesn't keep the others from being localized.
    """
    from service.photos.sequence import is_sequence
    from service.results import Status
    from service.scene_formats.discovery import find_scenes
    from service.web.schemas.request_body import Body, body_of

    fields = _fields(
        {"estimator": estimator or None, "seed": seed, "budget_s": budget_s, "every": every}
        | ({"gps": "exif"} if gps == "exif" else {}),
        {"intrinsics": intrinsics, "prior": prior, "accuracy": accuracy, "times_s": times, "rig": rig}
        | {"up_in_camera": up_in_camera, "gps": "" if gps == "exif" else gps, "heading": heading},
    )
    files = [(str(photo), read_file(photo)) for photo in photos]
    # A video is a sequence by itself; photos are one only on request.
    track_camera = sequence or any(is_sequence(data) for _, data in files)
    of_sequences = {"--tum": tum_file, "--every": every > 1, "--times": times, "--smooth": smooth}
    _require_consistent(track_camera, bool(rig), learn_lenses, of_sequences)
    paths = [path for given_path in scene for path in find_scenes(given_path)]
    if track_camera or rig:
        _require_one_scene(paths)
    # Last: faults of photos and fields are reported without waiting for it.
    known = _scenes(paths, fields.estimator, matcher)
    output = _Output(as_json, csv_file, tum_file, smooth)
    if track_camera:
        statuses = _localize_sequence(body_of(files, {}), fields, known[0], output)
    else:
        bodies = [body_of(files, {})] if rig else [Body(data, name, {}) for name, data in files]
        statuses = _localize_each(bodies, fields, known, output, learn_lenses=learn_lenses and not rig)
    if fail and any(status != Status.LOCALIZED for status in statuses):
        raise typer.Exit(1)


def _fields(plain: dict[str, Any], nested: dict[str, str]) -> LocalizeFields:
    """Return the request's fields as the API parses them; `nested` options are JSON, or files of it."""
    from service.web.schemas.job_spec import read_fields

    # Through the API's own parser: the same names, limits and error texts.
    given = plain | {name: parsed_option(text, name) for name, text in nested.items() if text}
    return read_fields({name: value for name, value in given.items() if value is not None})


def _require_consistent(track_camera: bool, rig: bool, learn_lenses: bool, of_sequences: dict[str, Any]) -> None:
    """Raise InvalidRequest for options that don't go together; `of_sequences`: those that single photos don't have."""
    if rig and track_camera:
        raise InvalidRequest("photos are a rig, or a sequence.", where="--rig")
    if track_camera and learn_lenses:
        raise InvalidRequest("the photos of a sequence share a lens anyway.", where="--learn-lenses")
    for option, value in of_sequences.items():
        if value and not track_camera:
            raise InvalidRequest("this is of a sequence: add --sequence.", where=option)


def _scenes(paths: list[Path], estimator: str | None, matcher: str) -> list[_Scene]:
    """Load scenes, and prepare them for the estimator. Raises SceneError, BackendMissing."""
    from service.loaded_scene import DEFAULT_ESTIMATOR

    loaded = [loaded_scene(path, estimator or DEFAULT_ESTIMATOR, matcher) for path in paths]
    parts = zip(loaded, scene_registrations(paths, loaded), scene_anchors(paths), strict=True)
    return [_Scene(*one) for one in parts]


def _require_one_scene(paths: list[Path]) -> None:
    if len(paths) > 1:
        raise InvalidRequest(
            "only single photos are looked for in several scenes; this is a sequence.",
            where="--scene",
            hint="Name one scene; one photo of the sequence, by itself, shows which.",
        )


def _localize_each(
    bodies: list[Body],
    fields: LocalizeFields,
    known: list[_Scene],
    output: _Output,
    *,
    learn_lenses: bool,
) -> list[Status]:
    """Localize every photo by itself, in the one scene or in each of several; return their statuses.

    Of several photos those that can't be read are told in the end, by exit code 2. Of one it raises BadInput.
    """
    from service.cli import result_tables
    from service.jobs.embedded_engine import run_task
    from service.jobs.read_photo import read_photo
    from service.lenses.lens_memory import LensMemory
    from service.lenses.lens_store import MemoryLensStore
    from service.web.schemas.conversion import result_out
    from service.web.schemas.job_spec import job_spec

    loaded, registrations = [scene.loaded for scene in known], [scene.registration for scene in known]
    lenses = LensMemory(MemoryLensStore(len(bodies))) if learn_lenses else None
    results: list[tuple[str, Result | BadInput]] = []
    for body in track(bodies, "photos", console=err, transient=True, disable=len(bodies) == 1):
        spec = job_spec(fields)
        recall = partial(lenses.recall, "", None) if lenses else None
        try:
            photo = read_photo(body.photo, spec, loaded[0].scene.info.background_rgb, recall=recall)
        except (InvalidImage, InvalidIntrinsics) as error:
            results.append((body.name, _of_file(error, body.name)))
            if len(bodies) == 1:
                raise
            tell_error(error)
            continue
        answer, shown = run_task(photo.task(spec), loaded, registrations=registrations)
        if lenses:
            lenses.learn("", None, photo.camera, photo.recalled, answer.estimate)
        # By identity: comparing scenes would compare their arrays.
        anchors = next((scene.anchors for scene in known if scene.loaded is shown), ())
        shown_result = result_out(answer, anchors)
        results.append((body.name, shown_result))
        if not output.as_json:
            # At once, not in the end: a photo may take seconds.
            say(result_tables.photo_line(body.name, shown_result))
    if output.as_json:
        # One document, so that it can be parsed as a whole.
        print_json([{"photo": name, **_json_of(result)} for name, result in results])
    if output.csv_file:
        result_tables.write_photo_table(output.csv_file, results)
    found = [result for _, result in results if not isinstance(result, BadInput)]
    if len(found) < len(results):
        raise typer.Exit(2)
    return [result.status for result in found]


def _json_of(result: Result | BadInput) -> dict[str, Any]:
    if isinstance(result, BadInput):
        return {"error": {"code": result.code, "message": str(result)}}
    return result.model_dump(mode="json")


def _of_file(error: BadInput, name: str) -> BadInput:
    """Name the file where an error names the request's field."""
    error.where = name if error.where == "photo" else f"{name}: {error.where}"
    return error


def _localize_sequence(
    body: Body,
    fields: LocalizeFields,
    scene: _Scene,
    output: _Output,
) -> list[Status]:
    """Track the camera of a video, or of photos in their order, through a scene; return the frames' statuses."""
    from service.cli import result_tables
    from service.jobs.embedded_engine import run_task
    from service.jobs.engine import SequenceSource
    from service.jobs.read_photo import read_photo
    from service.web.schemas.conversion import frame_out, result_out
    from service.web.schemas.exports import trajectory_of
    from service.web.schemas.job_spec import job_spec

    spec = job_spec(fields)
    # The service limits the frames of a job; the command line doesn't.
    photo = read_photo(body.photo, spec, scene.loaded.scene.info.background_rgb, max_frames=sys.maxsize)
    if not isinstance(photo.source, SequenceSource):
        raise InvalidRequest("a sequence has two photos or more, or is a video.", where="photos")

    def show(record: JobRecord, _: object) -> None:
        if record.frame and not output.as_json:
            say(result_tables.frame_line(frame_out(record.frame)))

    found, _ = run_task(photo.task(spec), [scene.loaded], show, registrations=[scene.registration])
    result = result_out(found, scene.anchors)
    if output.as_json:
        print_json({"photo": body.name, **result.model_dump(mode="json")})
    if output.csv_file:
        result_tables.write_frame_table(output.csv_file, result.frames or [], smooth=output.smooth)
    if output.tum_file:
        output.tum_file.write_text(trajectory_of(result.frames or [], smooth=output.smooth), encoding="utf-8")
    return [frame.status for frame in result.frames or []]
