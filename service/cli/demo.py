"""`splatfix demo`: serve the scene that is part of the package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import BrowserOption, err, out, settings_of
from service.errors import SceneNotFound

_PLACES = (Path("splatfix", "demo", "studio"), Path("scenes", "studio"))
"""Of the scene, beside the package `service`: in a wheel, in the repository."""


def demo(
    port: Annotated[int, typer.Option("--port", help="Port to listen on; 0: any free one.")] = 8000,
    browser: BrowserOption = False,
) -> None:
    """Serve the demo scene on this machine."""
    from service.cli.server import run

    # Whatever the settings say: the demo is for this machine, and needs no key.
    run(settings_of({"scenes": [demo_scene()], "host": "127.0.0.1", "port": port}), out, err, browser)


def demo_scene() -> Path:
    """Return the folder of the demo scene. Raises SceneNotFound."""
    root = Path(__file__).resolve().parents[2]
    found = next((root / place for place in _PLACES if (root / place / "scene.json").is_file()), None)
    if found is None:
        raise SceneNotFound(
            "the demo scene is not installed.", where=str(root), hint="Install splatfix from its wheel."
        )
    return found
