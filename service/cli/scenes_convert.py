"""`splatfix scenes convert`: a scene of any format that is read, as the .ply that every program reads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import err, say


def convert(
    source: Annotated[Path, typer.Argument(help="Scene folder or scene file, of any format that is read.")],
    target: Annotated[
        Path, typer.Argument(help="A new file NAME.ply, or a new folder: with manifest and training cameras.")
    ],
) -> None:
    """Write a scene as a plain .ply, in the frame of its file."""
    from service.scene_formats.scene_conversion import convert_scene

    with err.status(f"converting {source}"):
        found = convert_scene(source, target)
    say(f"{found.count} Gaussians, SH degree {found.sh_degree}, {found.cameras} training cameras: {target}")
    for warning in found.warnings:
        say(f"warning: {warning}")
