"""The curl command that `splatfix serve` prints: a photo from the scene's folder, and the fields that it needs."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path

from service.errors import BadInput
from service.photos.images import read_query
from service.scene_formats.training_files import same_photo
from service.types import NamedCamera

_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".heic")
_MAX_FILES = 2000
"""Searched for a photo: a data set may have more, and the start must not wait for them."""


def curl_line(
    url: str, folder: Path | None, cameras: Sequence[NamedCamera], *, scene_id: str = "", key: str = ""
) -> str:
    """Return a shell command that localizes a photo of the folder, or a placeholder `PHOTO.jpg` if it has none.

    `key` is an API key, or a variable of the shell that has one; empty where the service needs none.
    """
    # A scene that is a single file lies among files that have nothing to do with it.
    photo = example_photo(folder, cameras) if folder and folder.is_dir() else None
    parts = ["curl", "-H", "Prefer: wait=30", "-F", f"photo=@{photo or 'PHOTO.jpg'}"]
    if scene_id:
        parts += ["-F", f"scene={scene_id}"]
    intrinsics = _needed_intrinsics(photo, cameras) if photo else None
    if intrinsics:
        parts += ["-F", f"intrinsics={json.dumps(intrinsics)}"]
    line = shlex.join([*parts, f"{url}/localize"])
    # In double quotes, so that the shell fills in a variable.
    return line.replace("curl ", f'curl -H "Authorization: Bearer {key}" ', 1) if key else line


def example_photo(folder: Path, cameras: Sequence[NamedCamera]) -> Path | None:
    """Return a photo in the folder or below, if possible one that the scene was not trained with."""
    files = [p for p, _ in zip(sorted(folder.rglob("*")), range(_MAX_FILES), strict=False)]
    photos = [p for p in files if p.suffix.lower() in _SUFFIXES and p.is_file()]
    unseen = [p for p in photos if not any(same_photo(str(p), camera.name) for camera in cameras)]
    return next(iter(unseen or photos), None)


def _needed_intrinsics(photo: Path, cameras: Sequence[NamedCamera]) -> dict[str, float] | None:
    """Return the intrinsics of a training photo of the same size, if the photo has no focal length in EXIF."""
    try:
        query = read_query(photo.read_bytes())
    # Any file may have such a suffix; an example that fails is no reason not to start.
    except BadInput:
        return None
    size = (query.photo_intrinsics.width, query.photo_intrinsics.height)
    fitting = [c.camera.intrinsics for c in cameras]
    # Of another size it is another camera, or a resized photo.
    fitting = [i for i in fitting if (i.width, i.height) == size]
    if query.intrinsics_source != "guessed" or not fitting:
        return None
    return {name: getattr(fitting[0], name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
