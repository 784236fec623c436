"""Find the scenes at a path by file names, without reading them."""

from __future__ import annotations

from pathlib import Path

from service.errors import SceneNotFound
from service.scene_formats.layouts import is_scene_folder


def find_scenes(path: Path) -> list[Path]:
    """Return the path itself if it is a scene file or a scene folder, else the scene folders in it.

    Raises SceneNotFound if there are none.
    """
    if path.is_file() or (path.is_dir() and is_scene_folder(path)):
        return [path]
    # One level only: a scene folder may hold photos and other files in folders of its own.
    found = sorted(p for p in path.iterdir() if p.is_dir() and is_scene_folder(p)) if path.is_dir() else []
    if not found:
        raise SceneNotFound("no scene found.", where=str(path))
    return found
