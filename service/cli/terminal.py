"""Shared by the commands: consoles, progress bars, options that are JSON, and loading a scene."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from service.errors import InvalidRequest, SplatfixError

if TYPE_CHECKING:
    from service.loaded_scene import LoadedScene
    from service.registration.registration import Registration
    from service.scene_manager.anchor_store import Anchor
    from service.web.settings import Settings

out, err = Console(), Console(stderr=True)

MatcherOption = Annotated[str, typer.Option("--matcher", help="Kind of local features; see `splatfix doctor`.")]
IntrinsicsOption = Annotated[
    str,
    typer.Option("--intrinsics", help="JSON, or a file of it: width, height, fx, fy, cx, cy[, model, distortion]."),
]
BrowserOption = Annotated[bool, typer.Option("--browser", help="Open the start page once it is ready.")]
JsonFileOption = Annotated[Path | None, typer.Option("--json", help="Write the whole outcome.")]


def settings_of(given: dict[str, Any]) -> Settings:
    """Return the settings of the environment and the file, overridden by `given`. Raises SplatfixError."""
    # Imports in functions: `--help` and shell completion must not wait for numpy and FastAPI.
    from pydantic import ValidationError

    from service.web.problems import field_and_message
    from service.web.settings import Settings

    try:
        return Settings(**given)
    except ValidationError as error:
        where, message = field_and_message(error.errors())
        raise InvalidRequest(message, where=where) from error


def say(text: str) -> None:
    """Print text without rich's markup and line breaks."""
    out.print(text, markup=False, highlight=False, soft_wrap=True)


def tell_error(error: SplatfixError) -> None:
    """Print an error as one line on the terminal's error stream."""
    err.print(f"error: {error}", style="red", markup=False, highlight=False, soft_wrap=True)


def short(value: Any) -> str:
    """Return a value as text, a number with 4 digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def parsed_option(text: str, where: str) -> Any:
    """Parse an option that is JSON, or names a file of it; None if it is empty."""
    from service.web.schemas.request_body import parsed_json

    if not text:
        return None
    # No file name begins with a bracket in practice, and all options of this kind are objects or lists.
    return parsed_json(text if text.lstrip()[:1] in ("{", "[") else read_file(Path(text)), where)


def read_file(path: Path) -> bytes:
    """Read a file's bytes. Raises InvalidRequest."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidRequest(f"{error.strerror}.", where=str(path)) from error


def loaded_scene(scene: Path, estimator: str | None = None, matcher: str = "") -> LoadedScene:
    """Load a scene, and prepare it for the estimator, if one is given. Raises SceneError, BackendMissing."""
    from service.loaded_scene import LoadedScene

    with err.status(f"reading {scene}") as status:
        settings = settings_of({"matcher": matcher} if matcher else {})
        loaded = LoadedScene.load(scene, cache_dir=settings.cache_dir, matcher=settings.matcher)
        if estimator:
            status.update("preparing")
            loaded.prepare(estimator)
    return loaded


def scene_registrations(paths: Sequence[Path], loaded: Sequence[LoadedScene]) -> list[Registration | None]:
    """Return the registrations in force of loaded scenes."""
    from service.scene_manager.scene_registrations import SceneRegistrations

    known = SceneRegistrations(registrations_folder())
    return [known.of(path, scene.scene.info) for path, scene in zip(paths, loaded, strict=True)]


def scene_anchors(paths: Sequence[Path]) -> list[tuple[Anchor, ...]]:
    """Return the anchors of scenes. Raises CorruptScene."""
    from service.scene_manager.anchor_store import FileAnchorStore
    from service.scene_manager.status import StoredScene

    # By their paths: ids belong to a service.
    stored = {str(path): StoredScene(str(path), path) for path in paths}
    store = FileAnchorStore(stored.get, registrations_folder())
    return [store.anchors(scene_id) for scene_id in map(str, paths)]


def registrations_folder() -> Path:
    """Return the data folder, where registrations are that can't be beside their scenes."""
    from service.web.settings import DATA_HOME

    # Where the service has it by default, so that both find the same registrations.
    return settings_of({}).data_dir or DATA_HOME


def scene_arguments(given: list[str], named_by_photos: bool = False) -> dict[str, tuple[Path, Path | None]]:
    """Parse SCENE or SCENE=DATA arguments to (scene, data) by the scene's name, its stem. Raises InvalidRequest.

    With `named_by_photos` the name of SCENE=DATA is that of both, so that a scene may come with several sets of photos.
    """
    found: dict[str, tuple[Path, Path | None]] = {}
    for text in given:
        scene, _, data = text.partition("=")
        name = Path(scene).resolve().stem
        if data and named_by_photos:
            name += f"-{Path(data).resolve().stem}"
        if name in found:
            raise InvalidRequest(f"two scenes have the name '{name}'.", where="scenes")
        found[name] = Path(scene), Path(data) if data else None
    return found


def print_machine() -> None:
    """Print the processor and its load, without which a benchmark's times mean nothing."""
    from service.cli.diagnostics import processor

    err.print(processor(), markup=False, highlight=False, soft_wrap=True)


def progress_bar() -> Progress:
    """Return a progress display on stderr, which disappears at the end."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=err, transient=True)


def counter(progress: Progress, unit: str) -> Callable[[int, int], None]:
    """Add a bar and return the function that updates it: (done, total)."""
    task = progress.add_task(unit, total=None)
    return lambda done, total: progress.update(task, completed=done, total=total)


def write_json(path: Path | None, value: Any) -> None:
    """Write a value as JSON, if a path is given."""
    if path:
        path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def print_json(value: Any) -> None:
    """Print a value as JSON on standard output."""
    say(json.dumps(value, indent=1))
