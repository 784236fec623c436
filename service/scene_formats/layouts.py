"""Where trainers put the scene file: at the top of a folder, or in folders of their own, a file for each saved step."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from service.errors import CorruptScene, SceneNotFound, UnsupportedFormat
from service.scene_formats.formats import (
    SCENE_FORMATS,
    is_scene_file,
    readable_names,
    readable_suffixes,
    reader_for,
    suffix_of,
)
from service.scene_formats.manifest import MANIFEST, Manifest
from service.scene_formats.unread import refuse_suffix

COLMAP_FOLDER = Path("sparse", "0")
STEPS = {
    "point_cloud/iteration_*/point_cloud.ply": "Inria's trainer",
    "nerfstudio_models/step-*.ckpt": "nerfstudio",
    "exports/splat/splat.ply": "ns-export",
    "ply/point_cloud_*.ply": "gsplat's trainer",
    "ckpts/ckpt_*.pt": "gsplat's trainer",
}
"""Pattern of a trainer's scene files -> who writes them; the newest step is read, of the first pattern that fits."""
_HEAD_BYTES = 4096
_PLY_HEAD_BYTES = 65_536


def scene_file(path: Path, manifest: Manifest) -> tuple[Path, ModuleType]:
    """Find the scene file and its reader. Raises SceneNotFound, UnsupportedFormat, CorruptScene."""
    if path.is_file():
        candidates = [path]
    elif manifest.file:
        candidates = [path / manifest.file]
        if not candidates[0].is_file():
            raise SceneNotFound(f"'{manifest.file}' not found.", where=f"{MANIFEST}: file")
    else:
        candidates = _likely(path)
    if not candidates:
        raise SceneNotFound(f"the folder has no scene file ({', '.join(readable_suffixes())}).", where=str(path))
    if len(candidates) > 1:
        raise CorruptScene(
            f"several scene files: {', '.join(p.name for p in candidates[:5])}.",
            where=str(path),
            hint=f'Name one in {MANIFEST}: {{"file": "{candidates[0].name}"}}.',
        )
    return candidates[0], _reader(candidates[0])


def newest_step(folder: Path) -> Path | None:
    """Return the scene file of the last step that a trainer saved in its output folder, None if it is no such folder.

    Links that lead out of the folder are passed over.
    """
    root = folder.resolve()
    for pattern in STEPS:
        inside = [p for p in folder.glob(pattern) if p.is_file() and p.parent.resolve().is_relative_to(root)]
        if inside:
            # As numbers: step 9000 is before step 30000.
            return max(inside, key=lambda p: [int(n) for n in re.findall(r"\d+", str(p.relative_to(folder)))])
    return None


def is_scene_folder(folder: Path) -> bool:
    """Whether a folder has a manifest, a scene file or a trainer's steps; a broken scene counts."""
    found = (folder / MANIFEST).is_file() or any(is_scene_file(p) for p in folder.iterdir())
    return found or newest_step(folder) is not None


def files_of(path: Path) -> Iterator[Path]:
    """Yield all files that reading the scene may depend on, in no order; folders of photos are left out."""
    if path.is_file():
        yield path
        # Such a file is one of several: the others lie beside it.
        if path.name in readable_names():
            yield from (p for p in path.parent.iterdir() if p.is_file())
        return
    yield from (p for p in path.iterdir() if p.is_file())
    for pattern in ("sparse/*", f"{COLMAP_FOLDER.as_posix()}/*", *STEPS):
        yield from (p for p in path.glob(pattern) if p.is_file())


def _likely(folder: Path) -> list[Path]:
    """Return the files that may be the folder's scene: what only looks like one is left out where there is another."""
    named = sorted(p for p in folder.iterdir() if p.is_file() and is_scene_file(p))
    good = [p for p in named if _holds_gaussians(p)]
    # An export beside its checkpoint is the same scene, without a pickle to be loaded.
    plain = [p for p in good if not getattr(_reader(p), "UNPICKLES", False)]
    step = newest_step(folder)
    return plain or good or ([step] if step else named)


def _holds_gaussians(path: Path) -> bool:
    """Whether a file may hold Gaussians by its head: trainers put point clouds (`input.ply`) beside their scenes."""
    with path.open("rb") as file:
        head = file.read(_PLY_HEAD_BYTES)
    if head.startswith(b"ply"):
        # Without the data, in which any bytes may occur.
        header = head.split(b"end_header", 1)[0]
        return b"scale_0" in header or b"element chunk " in header or b"\nelement vertex" not in header
    return bool(head) and reader_for(head[:_HEAD_BYTES], suffix_of(path)) is not None


def _reader(path: Path) -> ModuleType:
    """Return the reader of a file, by its first bytes. Raises UnsupportedFormat, CorruptScene."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        raise CorruptScene("the file is empty (0 bytes).", where=path.name)
    reader = reader_for(head, suffix_of(path))
    if reader:
        return reader
    refuse_suffix(suffix_of(path), path.name)
    raise UnsupportedFormat(
        f"not a scene file that is read here; known: {', '.join(SCENE_FORMATS.names())}.", where=path.name
    )
