"""`splatfix bench rigs`: photos that fail alone, several with known relative poses as one query.

Each test photo is modified several times; those that are not `localized` by themselves are kept, and rigs of some are
drawn among photos of one kind. Their relative poses are the true ones; the control has them in the wrong order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.bench.bench_photos import SentPhoto, find_photos, prepare_photo
from service.bench.modifications import require_modifications
from service.bench.pose_metrics import COARSE, FINE, Units, errors, units_of
from service.errors import SceneNotFound
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.photos.images import read_query
from service.pose.features.scene_focus import centre_depth
from service.results import Status
from service.rig import RigPhoto, localize_rig
from service.scene_formats import load_scene
from service.types import Pose

MODIFICATIONS = ("occlusion=0.5", "occlusion=0.65", "off_centre=0.5", "off_centre=0.35")
"""Half of the photo and more is hidden by other photos; a quarter of it and less is kept, at a corner."""


@dataclass(frozen=True, slots=True)
class _Failed:
    """A photo that is not localized alone."""

    name: str
    kind: str
    sent: SentPhoto


def run(
    folder: Path,
    occluders: Path,
    *,
    rigs: int = 30,
    photos: int = 4,
    variants: int = 2,
    modify: Sequence[str] = MODIFICATIONS,
    seed: int = 0,
    cache_dir: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Return the object that `--json` writes. Raises SceneError, UnknownName, InvalidOptions.

    `occluders` is another scene's folder, whose photos hide parts. Each photo is modified in each way `variants` times;
    `rigs` queries of so many photos are drawn, and as many of the control.
    """
    require_modifications(modify)
    loaded = LoadedScene.of(load_scene(folder), cache_dir=cache_dir)
    loaded.prepare(Request().estimator)
    training = [named.camera for named in loaded.scene.cameras]
    units = units_of(training, lambda camera: centre_depth(loaded.rasterizer, camera))
    failed, wrong_alone, tried = _failing_alone(folder, occluders, loaded, units, modify, variants, seed)
    kinds = [kind for kind in modify if len({one.name for one in failed if one.kind == kind}) >= photos]
    if not kinds:
        raise SceneNotFound(f"fewer than {photos} photos fail alone.", where=str(folder))
    rng = np.random.default_rng(seed)
    queries, controls = [], []
    for number in range(rigs):
        kind = kinds[number % len(kinds)]
        chosen = _drawn([one for one in failed if one.kind == kind], photos, rng)
        queries.append(_localized(chosen, list(range(photos)), loaded, units))
        controls.append(_localized(chosen, [*range(1, photos), 0], loaded, units))
        if progress:
            progress(number + 1, rigs)
    return {
        "scene": loaded.scene.info.name,
        "seed": seed,
        "photos": photos,
        "alone_tried": tried,
        "alone_failed": len(failed),
        "alone_wrong_localized": wrong_alone,
        **_figures("", queries),
        **_figures("wrong_order_", controls),
        "by_kind": {kind: _figures("", [one for one in queries if one["kind"] == kind]) for kind in kinds},
        "per_query": queries,
    }


def _failing_alone(
    folder: Path, occluders: Path, loaded: LoadedScene, units: Units, modify: Sequence[str], variants: int, seed: int
) -> tuple[list[_Failed], int, int]:
    """Return the modified photos that fail, how many others are localized wrongly, and how many were tried."""
    others = [
        read_query(photo.path.read_bytes(), intrinsics=photo.camera.intrinsics).rgb.astype(np.float32) / 255
        for photo in find_photos(occluders)
    ]
    background, failed, wrong, tried = loaded.scene.info.background_rgb, [], 0, 0
    for kind in modify:
        for variant in range(variants):
            for number, photo in enumerate(find_photos(folder)):
                sent = prepare_photo(photo, (kind,), background, _own_seed(seed, variant, number), others)
                found = localize(read_query(sent.data, intrinsics=sent.intrinsics), loaded, Request(seed=seed))
                tried += 1
                if found.verdict.status is not Status.LOCALIZED:
                    failed.append(_Failed(photo.name, kind, sent))
                else:
                    wrong += not _within(errors(found.pose, sent.truth.pose, units), COARSE)
    return failed, wrong, tried


def _own_seed(*numbers: int) -> int:
    """Return a seed of its own for each photo and variant."""
    return int(np.random.default_rng(list(numbers)).integers(2**31))


def _drawn(failed: Sequence[_Failed], count: int, rng: np.random.Generator) -> list[_Failed]:
    """Return so many of the photos, none twice."""
    chosen: dict[str, _Failed] = {}
    for i in rng.permutation(len(failed)):
        chosen.setdefault(failed[i].name, failed[i])
    return list(chosen.values())[:count]


def _localized(chosen: Sequence[_Failed], mounts: Sequence[int], loaded: LoadedScene, units: Units) -> dict[str, Any]:
    """Localize a rig whose photo i has the true relative pose of photo `mounts[i]`."""
    world_from_rig = chosen[0].sent.truth.pose
    rig_from_camera = [Pose(world_from_rig.camera_from_world @ one.sent.truth.pose.world_from_camera) for one in chosen]
    photos = [
        RigPhoto(read_query(one.sent.data, intrinsics=one.sent.intrinsics), rig_from_camera[mount], one.name)
        for one, mount in zip(chosen, mounts, strict=True)
    ]
    began = time.perf_counter()
    found = localize_rig(photos, loaded)
    wall_s = time.perf_counter() - began
    verdict = found.estimate.verdict
    off_deg, off_units = errors(found.world_from_rig, world_from_rig, units)
    return {
        "kind": chosen[0].kind,
        "photos": [one.name for one in chosen],
        "status": str(verdict.status),
        "reason": str(verdict.reason),
        "error_deg": off_deg,
        "error_units": off_units,
        "signals": dict(verdict.signals),
        "inliers": verdict.inliers,
        "wall_s": wall_s,
    }


def _figures(prefix: str, queries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    localized = [one for one in queries if one["status"] == Status.LOCALIZED]
    off = [(one["error_deg"], one["error_units"]) for one in localized]
    figures = {
        "queries": len(queries),
        "right_and_localized": sum(_within(one, COARSE) for one in off) / max(1, len(queries)),
        "fine_and_localized": sum(_within(one, FINE) for one in off) / max(1, len(queries)),
        "wrong_and_localized": sum(not _within(one, COARSE) for one in off),
        "wall_s_p50": float(np.median([one["wall_s"] for one in queries])) if queries else None,
    }
    return {prefix + name: value for name, value in figures.items()}


def _within(error: tuple[float, float], bounds: tuple[float, float]) -> bool:
    return error[0] <= bounds[0] and error[1] <= bounds[1]
