"""`splatfix scenes coverage`: where in a scene a photo would be found, and how well."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.terminal import JsonFileOption, counter, loaded_scene, progress_bar, say, write_json

if TYPE_CHECKING:
    from service.coverage.coverage_map import CoverageMap
    from service.loaded_scene import LoadedScene


def scene_coverage(
    scene: Annotated[Path, typer.Argument(help="Scene folder or scene file.")],
    json_file: JsonFileOption = None,
    image: Annotated[Path | None, typer.Option("--image", help="Draw the plan view: a PNG.")] = None,
    again: Annotated[bool, typer.Option("--again", help="Measure again, even if a map is stored.")] = False,
) -> None:
    """Measure where a photo of a scene would be found: localizes renders made as photos are, and held-out photos."""
    from service.loaded_scene import DEFAULT_ESTIMATOR

    loaded = loaded_scene(scene, DEFAULT_ESTIMATOR)
    found = _coverage(scene, loaded, again)
    for line in coverage_lines(found, loaded.scene.info.metres_per_unit):
        say(line)
    write_json(json_file, _as_json(found))
    if image:
        image.write_bytes(_drawn(found, loaded))


def _coverage(scene: Path, loaded: LoadedScene, again: bool) -> CoverageMap:
    from service.coverage.coverage_cache import coverage_file, read_coverage, write_coverage
    from service.coverage.held_out_photos import held_out_photos
    from service.coverage.measurement import Measurement, measured_coverage

    held_out = held_out_photos(scene)
    names = loaded.rasterizer.name, loaded.matcher.name
    file = loaded.cache_dir and coverage_file(loaded.cache_dir, loaded.searched, *names, held_out)
    stored = read_coverage(file) if file and not again else None
    if stored is not None:
        return stored
    with progress_bar() as progress:
        found = measured_coverage(loaded, Measurement(held_out, counter(progress, "photos")))
    if file:
        write_coverage(found, file)
    return found


def coverage_lines(found: CoverageMap, metres_per_unit: float | None) -> list[str]:
    """Return what a map says, in words."""
    expected, photos = found.expected_accuracy(), found.real_trials
    scale, unit = (metres_per_unit, "m") if metres_per_unit else (1.0, "units")
    lines = [
        found.title,
        f"a photo is found with {expected.found:.0%} on average, where it shows enough of the scene",
        f"at {expected.sure_share:.0%} of these places and headings with 90 % or more",
    ]
    if any(trial.found for trial in (photos or found.trials)):
        accuracy = f"{expected.median_rotation_deg:.2g} degrees, {scale * expected.median_position_units:.2g} {unit}"
        lines.append(f"median error of {'held-out photos' if photos else 'renders'} that are found: {accuracy}")
    if found.calibration.brier is not None:
        hits = sum(trial.found for trial in photos)
        lines.append(f"{hits} of {len(photos)} held-out photos are found; Brier score {found.calibration.brier:.3f}")
    lines.append(f"{len(found.trials)} renders in {len(found.positions_in_world)} cells, {found.seconds:.0f} s")
    return lines


def _as_json(found: CoverageMap) -> dict[str, Any]:
    from service.web.schemas.coverage import coverage_out

    return coverage_out(found).model_dump(mode="json")


def _drawn(found: CoverageMap, loaded: LoadedScene) -> bytes:
    import numpy as np

    from service.coverage.plan_drawing import drawn_plan

    scene, origin = loaded.searched, np.array(loaded.scene.info.origin_in_world)
    # Faint Gaussians are haze and floaters, which in plan view would cover the walls.
    opaque = scene.means[scene.opacities > 0.3].astype(np.float64) + origin
    cameras = [named.camera.pose.position_in_world + origin for named in scene.cameras]
    return drawn_plan(found, opaque, np.array(cameras).reshape(-1, 3), scene.info.metres_per_unit)
