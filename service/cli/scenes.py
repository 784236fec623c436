"""`splatfix scenes list | inspect | convert | index | align | register | coverage`: what and where scenes are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.scenes_align import align_cameras
from service.cli.scenes_convert import convert
from service.cli.scenes_coverage import scene_coverage
from service.cli.scenes_index import index_scene
from service.cli.scenes_register import register_scene
from service.cli.terminal import err, print_json, say

scenes_app = typer.Typer(no_args_is_help=True, help="Inspect, convert, index, align, register and test scenes.")
scenes_app.command("convert")(convert)
scenes_app.command("index")(index_scene)
scenes_app.command("align")(align_cameras)
scenes_app.command("register")(register_scene)
scenes_app.command("coverage")(scene_coverage)


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
    image: Annotated[Path | None, typer.Option("--image", help="Draw a plan view and two renders: a PNG.")] = None,
) -> None:
    """Read a scene; print what is in it, what is unknown of it, and from where its views would be rendered."""
    from service.cli.scene_facts import as_lines, inspected_scene

    with err.status(f"looking at {scene}"):
        found = inspected_scene(scene)
        drawn = found.drawn() if image else b""
    if image:
        image.write_bytes(drawn)
    if as_json:
        print_json(found.facts)
        return
    for name, value in as_lines(found.facts).items():
        say(f"{name:18} {value}")
