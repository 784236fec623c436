"""How well coverage maps hold: on held-out real photos, each left out of the calibration of its scene's map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from service.coverage.calibration import brier_score, left_out
from service.coverage.coverage_map import FOUND_AT, CoverageMap
from service.coverage.held_out_photos import held_out_photos
from service.coverage.measurement import Measurement, measured_coverage
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene

Progress = Callable[[str, int, int], None]


def run(folders: Sequence[Path], progress: Progress | None = None, cache_dir: Path | None = None) -> dict[str, Any]:
    """Measure the maps of scene folders; return the object that `--json` writes. Raises SceneError."""
    rows = []
    for folder in folders:
        loaded = LoadedScene.load(folder, cache_dir=cache_dir)
        loaded.prepare(DEFAULT_ESTIMATOR)

        def report(done: int, total: int, name: str = folder.name) -> None:
            if progress:
                progress(name, done, total)

        found = measured_coverage(loaded, Measurement(held_out_photos(folder), report))
        rows.append(scene_row(folder.name, found))
    photos = [photo for row in rows for photo in row["photos"]]
    return {"scenes": rows, "all": figures(photos)}


def scene_row(name: str, found: CoverageMap) -> dict[str, Any]:
    """Return one scene's line: its map's summary, and what was predicted of each held-out photo and became of it."""
    real = np.array([trial.found for trial in found.real_trials], bool)
    rates = found.rates_near(found.real_trials)
    predicted = left_out(rates, real) if found.calibration.photos else rates
    photos = [
        {"photo": trial.photo, "predicted": float(p), "uncalibrated": float(rate), "found": trial.found}
        for trial, p, rate in zip(found.real_trials, predicted, rates, strict=True)
    ]
    expected = found.expected_accuracy()
    return {
        "scene": name,
        "title": found.title,
        "seconds": found.seconds,
        "renders_found": float(np.mean([trial.found for trial in found.trials])) if found.trials else None,
        "sure_share": expected.sure_share,
        **figures(photos),
        "photos": photos,
    }


def figures(photos: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the counts and scores of predictions: of photos shown sure, how many are found; Brier scores."""
    found = np.array([photo["found"] for photo in photos], bool)
    sure = np.array([photo["predicted"] >= FOUND_AT for photo in photos], bool)
    result: dict[str, Any] = {"count": len(photos), "found": int(found.sum())}
    result |= {"sure": int(sure.sum()), "sure_found": int((sure & found).sum())}
    for name, key in (("brier", "predicted"), ("brier_uncalibrated", "uncalibrated")):
        values = np.array([photo[key] for photo in photos], np.float64)
        result[name] = brier_score(values, found) if len(photos) else None
    return result
