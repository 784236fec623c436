"""Convert a scene of any format that is read to a .ply, or to a folder of .ply, manifest and training cameras."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from service.errors import InvalidRequest
from service.scene_formats.folder import load_scene
from service.scene_formats.formats import all_kinds, suffix_of
from service.scene_formats.gaussians import RawGaussians, checked
from service.scene_formats.layouts import scene_file
from service.scene_formats.manifest import MANIFEST, Manifest, read_json, read_manifest, require_render_mode
from service.scene_formats.nerfstudio import transforms_of
from service.scene_formats.ply_writing import write_ply
from service.scene_formats.similarity import moved_pose
from service.scene_origin import shifted
from service.types import Camera, GaussianScene, NamedCamera, SceneInfo

_SUFFIX = ".ply"


@dataclass(frozen=True, slots=True)
class Conversion:
    """What was written."""

    count: int
    """Gaussians."""
    sh_degree: int
    cameras: int
    warnings: tuple[str, ...]
    """What is not in the target, or not as the source says."""


def convert_scene(source: Path, target: Path) -> Conversion:
    """Write a scene anew in the frame of its file, positions and all: nothing is moved by `world_from_scene`.

    A target that ends in .ply is a bare file. Any other one is a folder: `scene.ply`, a manifest of what the .ply has
    no field for (that of the source, and what was found of up, background and render mode), and `transforms.json` with
    those training cameras that fit the scene, in the frame of the .ply. Nothing that is there is overwritten, and what
    fails leaves nothing. Raises InvalidRequest for the target, SceneError for the source.
    """
    is_file = _is_file(target)
    # Read before anything is written; of a large scene only what is no Gaussian is kept beside the second reading.
    facts = None if is_file else _facts(source)
    raw = _gaussians(source)
    try:
        if facts is None:
            write_ply(raw, target)
        else:
            target.mkdir()
            _write_folder(raw, *facts, source, target)
    except BaseException as error:
        # What others made meanwhile is theirs.
        if not isinstance(error, FileExistsError):
            target.unlink(missing_ok=True) if is_file else shutil.rmtree(target, ignore_errors=True)
        if isinstance(error, OSError):
            raise InvalidRequest(f"can't be written: {error.strerror}.", where=str(target)) from error
        raise
    info, cameras = facts or (None, ())
    warnings = info.warnings if info else raw.warnings
    return Conversion(len(raw.means), round(raw.sh.shape[1] ** 0.5) - 1, len(cameras), warnings)


def _is_file(target: Path) -> bool:
    """Whether a target is a bare .ply. Raises InvalidRequest for one that can't be written."""
    if target.exists() or target.is_symlink():
        raise InvalidRequest("is there already.", where=str(target), hint="Name another target, or remove this one.")
    if not target.parent.is_dir():
        raise InvalidRequest("the folder it would be in doesn't exist.", where=str(target), hint="Make it first.")
    suffix = suffix_of(target)
    if suffix in all_kinds() and (suffix != _SUFFIX or target.name.lower().endswith(".compressed.ply")):
        raise InvalidRequest(
            "only plain .ply is written.", where=str(target), hint="Let it end in .ply, or name a folder."
        )
    return suffix == _SUFFIX


def _gaussians(source: Path) -> RawGaussians:
    """Return a scene's Gaussians in the file's frame, with the manifest's render mode. Raises SceneError."""
    manifest = read_manifest(source) if source.is_dir() else Manifest()
    file, reader = scene_file(source, manifest)
    raw = checked(reader.read(file), file.name)
    mode = manifest.render_mode or raw.render_mode
    return replace(raw, render_mode=mode and require_render_mode(mode, file.name))


def _facts(source: Path) -> tuple[SceneInfo, tuple[NamedCamera, ...]]:
    """Return what loading a scene finds out, and its training cameras in the file's frame. Raises SceneError."""
    scene = load_scene(source)
    return scene.info, tuple(_in_file(named, scene) for named in scene.cameras)


def _in_file(named: NamedCamera, scene: GaussianScene) -> NamedCamera:
    (file_from_world,) = (frame.frame_from_world for frame in scene.info.frames if frame.name == "file")
    pose = shifted(named.camera.pose, scene.info.origin_in_world)
    return NamedCamera(named.name, Camera(named.camera.intrinsics, moved_pose(pose, file_from_world)))


def _write_folder(
    raw: RawGaussians, info: SceneInfo, cameras: tuple[NamedCamera, ...], source: Path, target: Path
) -> None:
    write_ply(raw, target / "scene.ply")
    (target / MANIFEST).write_text(json.dumps(_manifest(info, source), indent=1), "utf-8")
    if cameras:
        (target / "transforms.json").write_text(json.dumps(transforms_of(cameras)), "utf-8")


def _manifest(info: SceneInfo, source: Path) -> dict[str, Any]:
    """Return the source's manifest, less what describes its own files, and what loading found out."""
    given = read_json(source / MANIFEST) if (source / MANIFEST).is_file() else {}
    kept = {key: value for key, value in given.items() if key not in ("file", "convention")}
    kept["render_mode"] = info.render_mode
    if info.background_is_known:
        kept["background"] = list(info.background_rgb)
    if info.up_in_world is not None:
        kept["up"] = list(info.up_in_world)
    return kept
