"""Large scenes made of small ones: a scene with its photos in the middle of a grid of varied copies.

    . . .        o  the scene: its photos and their true poses stay valid
    . o .        .  a copy, or another scene: mirrored, rotated, with other colours and exposure
    . . .

A mirrored room has the same kind of content, as neighbouring rooms of a building have, but no part of it is the same
place, since no rotation maps one to the other. Each copy has its training cameras.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
from jaxtyping import Float64

from service.geometry import so3_exp
from service.interfaces import Rasterizer
from service.pose.descent.contribution_pruning import contributions
from service.scene_formats.gaussians import RawGaussians
from service.scene_formats.manifest import MANIFEST
from service.scene_formats.nerfstudio import transforms_of
from service.scene_formats.similarity import moved_gaussians, moved_pose
from service.types import SH_C0, Camera, GaussianScene, NamedCamera

GAP = 0.1
"""Between two scenes of the grid, as a share of a scene's size."""
MIRROR_X = np.diag([-1.0, 1.0, 1.0, 1.0])
ODD_IN_X = (3, 4, 7, 10, 13, 15)
"""Indices of SH coefficients whose basis functions are odd in x."""


def surround_with_copies(
    scene: GaussianScene, count: int, others: Sequence[GaussianScene] = (), seed: int = 0
) -> GaussianScene:
    """Return a scene of `count` Gaussians: `scene`, and around it copies of it or, in turn, the scenes `others`.

    The last copy is cut to the count. Raises ValueError if the scene alone has more Gaussians.
    """
    if count < scene.count:
        raise ValueError(f"the scene has {scene.count} Gaussians, more than {count}.")
    rng = np.random.default_rng(seed)
    parts, cameras = [_raw(scene)], list(scene.cameras)
    total = scene.count
    for number, cell in enumerate(_cells_by_ring()):
        if total >= count:
            break
        source = others[number % len(others)] if others else scene
        part, cameras_of_part = _place_in_cell(source, scene, cell, rng)
        if len(part.means) > count - total:
            part = _cut(part, count - total)
        parts.append(part)
        cameras += [replace(named, name=f"tile{number}/{named.name}") for named in cameras_of_part]
        total += len(part.means)
    # Scenes of different SH degrees are reduced to the lowest.
    degree = min(part.sh.shape[1] for part in parts)
    arrays = {n: np.concatenate([getattr(p, n) for p in parts]) for n in ("means", "quats", "scales", "opacities")}
    sh = np.concatenate([part.sh[:, :degree] for part in parts])
    return replace(scene, **arrays, sh=sh, cameras=tuple(cameras))


def keep_most_contributing(scene: GaussianScene, count: int, rasterizer: Rasterizer) -> GaussianScene:
    """Return the scene with the `count` Gaussians that contribute most to renders from its training cameras.

    Contribution: the sum of blending weights over the pixels of renders at 200 px.
    """
    views = [Camera(n.camera.intrinsics.with_long_side(200), n.camera.pose) for n in scene.cameras]
    chosen = np.sort(np.argsort(-contributions(scene, rasterizer, views), kind="stable")[:count])
    arrays = {name: getattr(scene, name)[chosen] for name in ("means", "quats", "scales", "opacities", "sh")}
    return replace(scene, **arrays)


def write_folder(scene: GaussianScene, folder: Path, source: Path, *, cameras: bool, compressed: bool) -> Path:
    """Write a scene folder with the photos and the true poses of the folder `source`; return its scene file."""
    folder.mkdir(parents=True)
    file = folder / ("scene.compressed.ply" if compressed else "scene.ply")
    # The file has logits, which are infinite at 0 and 1.
    opacities = np.clip(scene.opacities, 1e-6, 1 - 1e-6)
    arrays = (
        scene.means, np.log(scene.scales), scene.quats, np.log(opacities / (1 - opacities)), scene.sh[:, 0],
        scene.sh[:, 1:],
    )  # fmt: skip
    gsply.plywrite(str(file), *(np.ascontiguousarray(a, np.float32) for a in arrays), compressed=compressed)
    manifest = {"background": scene.info.background_rgb, "render_mode": scene.info.render_mode}
    if scene.info.up_in_world:
        manifest["up"] = scene.info.up_in_world
    # Without cameras the renderer couldn't know at which resolution the scene was trained.
    if scene.info.training_long_side_px:
        manifest["training_size"] = [scene.info.training_long_side_px, scene.info.training_long_side_px * 3 // 4]
    (folder / MANIFEST).write_text(json.dumps(manifest), "utf-8")
    if cameras:
        (folder / "transforms.json").write_text(json.dumps(transforms_of(scene.cameras)), "utf-8")
    for name in ("truth.json", "photos"):
        if (source / name).is_dir():
            shutil.copytree(source / name, folder / name)
        elif (source / name).is_file():
            shutil.copy(source / name, folder / name)
    return file


def _raw(scene: GaussianScene) -> RawGaussians:
    return RawGaussians(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)


def _cells_by_ring() -> Iterator[tuple[int, int]]:
    """Yield the cells around (0, 0), ring by ring."""
    ring = 1
    while True:
        cells = [(x, y) for x in range(-ring, ring + 1) for y in range(-ring, ring + 1)]
        yield from (cell for cell in cells if max(map(abs, cell)) == ring)
        ring += 1


def _place_in_cell(
    source: GaussianScene, scene: GaussianScene, cell: tuple[int, int], rng: np.random.Generator
) -> tuple[RawGaussians, list[NamedCamera]]:
    """Return a mirrored, recoloured and rotated copy in a cell of the grid, with its training cameras."""
    raw = _recolour(_mirror(_raw(source)), rng)
    up = np.array(scene.info.up_in_world or (0.0, 0.0, 1.0))
    low, high = _extent(scene)
    size = (high - low) * (1 + GAP)
    low, high = _extent(replace(source, means=raw.means))
    matrix = np.eye(4)
    quarter = int(rng.integers(4)) // 2 * 2  # half turns only, so that a room that is not square fits its cell
    matrix[:3, :3] = so3_exp(up * (quarter * np.pi / 2))
    # Another scene may have another unit of length.
    matrix[:3, :3] *= np.max(size / (1 + GAP)) / np.max(high - low) if source is not scene else 1.0
    across = _horizontal_axes(up)
    centre = np.mean(_extent(scene), axis=0) + sum(c * (a @ size) * a for c, a in zip(cell, across, strict=True))
    matrix[:3, 3] = centre - matrix[:3, :3] @ (0.5 * (low + high))
    cameras = [replace(n, camera=_mirror_camera(n.camera)) for n in source.cameras]
    moved = [replace(n, camera=replace(n.camera, pose=moved_pose(n.camera.pose, matrix))) for n in cameras]
    return moved_gaussians(raw, matrix), moved


def _horizontal_axes(up: Float64[np.ndarray, "3"]) -> list[Float64[np.ndarray, "3"]]:
    """Return the two world axes that are most nearly horizontal, as unit vectors."""
    return [np.eye(3)[axis] for axis in np.sort(np.argsort(np.abs(up), kind="stable")[:2])]


def _extent(scene: GaussianScene) -> Float64[np.ndarray, "2 3"]:
    # Floaters, which are translucent or far away, don't count.
    return np.quantile(scene.means[scene.opacities > 0.3].astype(np.float64), [0.005, 0.995], axis=0)


def _mirror(raw: RawGaussians) -> RawGaussians:
    """Return the reflection at the plane x = 0."""
    sh = raw.sh.copy()
    odd = [k for k in ODD_IN_X if k < sh.shape[1]]
    sh[:, odd] *= -1
    # A reflection at x = 0 keeps the rotation's component about x, and reverses those about y and z.
    signs = np.array([1, 1, -1, -1], np.float32)
    return replace(raw, means=raw.means * np.array([-1, 1, 1], np.float32), quats=raw.quats * signs, sh=sh)


def _mirror_camera(camera: Camera) -> Camera:
    """Return the camera whose image of the mirrored scene is the mirror image of the camera's of the scene."""
    pose = replace(camera.pose, world_from_camera=MIRROR_X @ camera.pose.world_from_camera @ MIRROR_X)
    k = camera.intrinsics
    # The principal point is mirrored, too.
    return Camera(replace(k, cx=k.width - k.cx), pose)


def _recolour(raw: RawGaussians, rng: np.random.Generator) -> RawGaussians:
    """Permute the colour channels, and change the gain of each."""
    gains = rng.uniform(0.7, 1.3, 3).astype(np.float32)
    sh = raw.sh[:, :, rng.permutation(3)] * gains
    sh[:, 0] += (gains - 1) * np.float32(0.5 / SH_C0)  # a colour is 0.5 + the SH sum, and the gain applies to both
    return replace(raw, sh=sh)


def _cut(raw: RawGaussians, count: int) -> RawGaussians:
    """Keep the first Gaussians along x: a part of the room in its full density."""
    chosen = np.argsort(raw.means[:, 0], kind="stable")[:count]
    arrays = {n: getattr(raw, n)[chosen] for n in ("means", "quats", "scales", "opacities", "sh")}
    return replace(raw, **arrays)
