"""The facts of `splatfix scenes inspect`: content of a scene, what is unknown of it, and where its views are placed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.cli.scenes_index import digest_facts, digest_line
from service.cli.terminal import registrations_folder, settings_of
from service.coverage.coverage_cache import coverage_file, read_coverage
from service.coverage.held_out_photos import held_out_photos
from service.coverage.scene_drawing import drawn_scene
from service.interfaces import Rasterizer
from service.loaded_scene import choose_rasterizer
from service.localize import ASSUMED_TRAINING_PX
from service.pose.retrieval.floaters import find_floaters, without_floaters
from service.pose.retrieval.view_placement import coverage, find_views
from service.pose.retrieval.viewpoints import index_cameras
from service.pose.training_photos.digest import scene_key
from service.pose.training_photos.digest_file import DIGEST_FILE, read_digest
from service.render import RASTERIZERS
from service.scene_formats import load_scene
from service.scene_formats.manifest import read_manifest
from service.scene_manager.scene_registrations import SceneRegistrations, registered_info
from service.types import Camera, GaussianScene, SceneInfo


@dataclass(frozen=True)
class InspectedScene:
    """A scene that was measured."""

    facts: dict[str, Any]
    """Values that JSON can hold; lengths in scene units."""
    searched: GaussianScene
    """Without its floaters, if these are left out."""
    rasterizer: Rasterizer
    views: tuple[Camera, ...]
    """Of the index; relative to the scene's origin."""
    info: SceneInfo
    """With what its registration tells."""

    def drawn(self) -> bytes:
        """Return a PNG: a plan view and two renders."""
        return drawn_scene(self.searched, self.rasterizer, self.views, self.info)


def inspected_scene(path: Path) -> InspectedScene:
    """Load a scene and measure it. Renders some hundred small views, which takes seconds. Raises SceneError."""
    scene = load_scene(path)
    searched = without_floaters(scene)
    rasterizer = RASTERIZERS.load(choose_rasterizer()[0]).create(searched)
    info, floaters = scene.info, find_floaters(scene)
    registration = SceneRegistrations(registrations_folder()).of(path, info)
    known = registered_info(info, registration)
    # Quantiles: a few stray Gaussians would make the bounds meaningless.
    low, high = np.quantile(scene.means, [0.01, 0.99], axis=0) + info.origin_in_world
    views, index = _index(searched, rasterizer)
    facts: dict[str, Any] = {
        "id": info.id,
        "name": info.name,
        "format": info.format,
        "sha256": info.sha256,
        "gaussians": scene.count,
        "sh_degree": scene.sh_degree,
        "render_mode": info.render_mode,
        "memory_bytes": {"scene": scene.nbytes, "renderer": rasterizer.nbytes},
        "bounds": [(end + np.array(info.origin_in_world)).tolist() for end in (scene.means.min(0), scene.means.max(0))],
        "middle_98_percent": [low.tolist(), high.tolist()],
        "extent": float(np.linalg.norm(high - low)),
        "floaters": {"found": int(floaters.found.sum()), "veil": floaters.veil, "left_out": floaters.left_out},
        "up": list(known.up_in_world) if known.up_in_world else None,
        "metres_per_unit": known.metres_per_unit,
        "background": list(info.background_rgb),
        "on_earth": known.geo_anchor is not None,
        "registration": registration and registration.revision,
        "training_cameras": len(scene.cameras),
        "training_size": _training_size(path, scene),
        "frames": [asdict(frame) | {"frame_from_world": frame.frame_from_world.tolist()} for frame in info.frames],
        "index": index,
        "training_photos": _training_photos(path, scene),
        "expected_accuracy": _expected_accuracy(path, searched, rasterizer.name),
    }
    facts["warnings"] = [*info.warnings, *_unknowns(info, facts["training_size"]["px"])]
    return InspectedScene(facts, searched, rasterizer, views, known)


def _unknowns(info: SceneInfo, training_px: int | None) -> Iterator[str]:
    """Yield what no file says of a scene, and what is assumed instead."""
    if training_px is None:
        yield "the training size is unknown"
    if not info.up_in_world:
        yield "up is unknown: views are placed upright by z and by -y, and shown by z"
    if not info.background_is_known:
        yield "the background is unknown: black is assumed, white for photos with a white border"


def _training_size(path: Path, scene: GaussianScene) -> dict[str, Any]:
    """Return the long side of the training photos in pixels, and its source."""
    given = read_manifest(path).training_size if path.is_dir() else None
    if given:
        return {"px": max(given), "source": "manifest"}
    if scene.info.training_long_side_px:
        return {"px": scene.info.training_long_side_px, "source": "training cameras"}
    low, high = ASSUMED_TRAINING_PX
    return {"px": None, "source": f"unknown: each photo's own, within {low} to {high}"}


def _index(scene: GaussianScene, rasterizer: Rasterizer) -> tuple[tuple[Camera, ...], dict[str, Any]]:
    """Return the cameras of the default estimator's view index, how they are placed, and how much they cover."""
    rng = np.random.default_rng(0)  # the seed of `LoadedScene.prepare`
    if scene.cameras:
        cameras = index_cameras(scene, rasterizer, rng)
        seen = coverage(scene, rasterizer, cameras)
        return tuple(cameras), {"placed_by": "training cameras", "views": len(cameras), "coverage": seen}
    # Without training cameras the index places its views itself, which depends on the seed.
    found = find_views(scene, rasterizer, rng)
    return tuple(found.cameras), {
        "placed_by": "the scene itself",
        "views": len(found.cameras),
        "coverage": found.coverage,
        "candidates": found.candidates,
        "good_candidates": found.good,
        "typical_distance": found.typical_distance,
        "interior": found.interior,
    }


def _training_photos(path: Path, scene: GaussianScene) -> dict[str, Any] | None:
    """Return the facts of the digest in the scene's folder; None: there is none for this scene."""
    if not (path / DIGEST_FILE).is_file():
        return None
    digest = read_digest(path / DIGEST_FILE, scene_key(scene))
    return None if digest is None else digest_facts(digest)


def _expected_accuracy(path: Path, searched: GaussianScene, rasterizer: str) -> dict[str, Any] | None:
    """Return what the scene's coverage map says, None if none was measured."""
    settings = settings_of({})
    if settings.cache_dir is None:
        return None
    file = coverage_file(settings.cache_dir, searched, rasterizer, settings.matcher, held_out_photos(path))
    found = read_coverage(file)
    if found is None:
        return None
    expected = found.expected_accuracy()
    return {
        "title": found.title,
        "found": expected.found,
        "sure_share": expected.sure_share,
        "median_rotation_deg": expected.median_rotation_deg,
        "median_position_units": expected.median_position_units,
        "brier": found.calibration.brier,
    }


def as_lines(facts: dict[str, Any]) -> dict[str, str]:
    """Return the facts as text, by label."""
    index, size, memory = facts["index"], facts["training_size"], facts["memory_bytes"]
    placed = f"{index['views']} views, placed by {index['placed_by']}"
    if "candidates" in index:
        kind = "an interior" if index["interior"] else "seen from outside or open"
        placed += f" ({kind}; {index['good_candidates']} good ones of {index['candidates']} tried; "
        placed += f"typical distance {index['typical_distance']:.3g})"
    lines = {
        "name": f"{facts['name']} (id {facts['id']})",
        "format": facts["format"] + ("" if facts["render_mode"] == "default" else f", {facts['render_mode']}"),
        "gaussians": f"{facts['gaussians']:,}, SH degree {facts['sh_degree']}",
        "memory": f"{memory['scene'] / 1e6:.0f} MB, and {memory['renderer'] / 1e6:.0f} MB for the renderer",
        "bounds": " to ".join(_point(p) for p in facts["bounds"]),
        "middle 98 %": " to ".join(_point(p) for p in facts["middle_98_percent"]) + f"; diagonal {facts['extent']:.3g}",
        "floaters": _floaters(facts),
        "up": _point(facts["up"]) if facts["up"] else "unknown",
        "metres per unit": str(facts["metres_per_unit"] or "unknown"),
        "geo anchor": "yes" if facts["on_earth"] else "no",
        "registration": f"revision {facts['registration']}" if facts["registration"] else "none",
        "training cameras": str(facts["training_cameras"]),
        "training size": f"{size['px']} px (from the {size['source']})" if size["px"] else size["source"],
        **{
            f"frame '{frame['name']}'": f"{frame['decided_by']}{'' if frame['verified'] else ' (unverified)'}"
            for frame in facts["frames"]
        },
        "index": placed,
        "coverage": f"{index['coverage']:.1%} of the opaque Gaussians are seen by these views",
        "training photos": _photos(facts["training_photos"]),
        "expected accuracy": _accuracy(facts),
        "sha256": facts["sha256"],
    }
    return lines | {f"warning {i}": text for i, text in enumerate(facts["warnings"], 1)}


def _accuracy(facts: dict[str, Any]) -> str:
    expected, scale = facts["expected_accuracy"], facts["metres_per_unit"]
    if expected is None:
        return "not measured: splatfix scenes coverage"
    position = f"{expected['median_position_units'] * (scale or 1.0):.2g} {'m' if scale else 'units'}"
    accuracy = f"median {expected['median_rotation_deg']:.2g} degrees, {position}"
    return f"{accuracy}; {expected['found']:.0%} of photos are found ({expected['title']})"


def _photos(facts: dict[str, Any] | None) -> str:
    return "no digest of them: splatfix scenes index --photos" if facts is None else digest_line(facts)


def _floaters(facts: dict[str, Any]) -> str:
    found, veil, left_out = (facts["floaters"][name] for name in ("found", "veil", "left_out"))
    if not facts["training_cameras"]:
        return "not looked for without training cameras"
    consequence = "left out when photos are localized" if left_out else "too thin a veil to be left out"
    return f"{found:,}, of optical depth {veil:.2f} before the content: {consequence}" if found else "none"


def _point(values: list[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
