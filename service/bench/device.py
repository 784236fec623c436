"""`splatfix bench device`: what this machine is, how fast and how accurate splatfix is on it, in some two minutes."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from service.bench.localize import BenchScene, Trial, load_bench_scene, localize_trial, make_trials, measure
from service.bench.pose_metrics import summary
from service.loaded_scene import DEFAULT_ESTIMATOR
from service.localize import Request
from service.render import RASTERIZERS
from service.results import PoseEstimate
from service.versions import versions

KINDS = ("given", "withheld")
"""Of intrinsics: the true ones are sent as exact, or none."""


def run(
    folder: Path,
    *,
    processor: str,
    limit_s: float = 60.0,
    emulated: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Return what `--json` writes: facts about the machine, accuracy and latency on a scene's test photos.

    The photos are localized once with and once without their intrinsics; on a slow machine only as many as are
    expected to take `limit_s` seconds in all. `emulated` is recorded: a program can't tell. Raises SceneError.
    """
    began = time.perf_counter()
    bench_scene = load_bench_scene(folder)
    bench_scene.loaded.prepare(DEFAULT_ESTIMATOR)
    prepare_s = time.perf_counter() - began
    trials = list(make_trials(bench_scene, "none", len(bench_scene.photos), 0))
    measured = {}
    for done, kind in enumerate(KINDS):
        measured[kind] = _measured(bench_scene, trials, kind, limit_s / len(KINDS))
        if progress:
            progress(done + 1, len(KINDS))
    return {
        "bench": "device",
        "date": datetime.now(UTC).date().isoformat(),
        "emulated": emulated,
        "system": platform.system(),
        "machine": platform.machine(),
        "release": platform.release(),
        "processor": processor,
        "renderer": bench_scene.loaded.rasterizer.name,
        "gpu": _gpu(bench_scene.loaded.rasterizer.name),
        "versions": versions(),
        "scene": bench_scene.loaded.scene.info.name,
        "prepare_s": prepare_s,
        "photos": measured,
    }


def _gpu(renderer: str) -> str:
    """Return the name of the GPU that the renderer uses; empty if it uses none."""
    describe = getattr(RASTERIZERS.load(renderer), "device_facts", None)
    return describe()["name"] if describe else ""


def _measured(bench_scene: BenchScene, trials: list[Trial], kind: str, limit_s: float) -> dict[str, Any]:
    def localize_one(trial: Trial) -> PoseEstimate:
        return localize_trial(bench_scene, trial, Request(), kind)

    ((first,), _) = measure(trials[:1], localize_one, bench_scene.units)
    count = min(len(trials), max(1, int(1e3 * limit_s / first.latency_ms)))
    outcomes, lines = measure(trials[:count], localize_one, bench_scene.units)
    stages = dict.fromkeys(stage for line in lines for stage in line["stages_ms"])
    spent = {stage: [line["stages_ms"][stage] for line in lines if stage in line["stages_ms"]] for stage in stages}
    medians = {stage: float(np.median(times)) for stage, times in spent.items()}
    return {**summary(outcomes), "stages_ms_p50": medians}


def block(outcome: dict[str, Any]) -> str:
    """Return the lines that a user can send: machine, versions, latency by stage, accuracy."""
    told = outcome["versions"]
    others = ", ".join(f"{name} {version}" for name, version in told.items() if name not in ("splatfix", "python"))
    where = f"{outcome['system']} {outcome['machine']} ({outcome['release']})"
    lines = [
        f"splatfix {told['splatfix']}, {outcome['date']}, {where}, Python {told['python']}",
        outcome["processor"] + (", EMULATED" if outcome["emulated"] else ""),
        f"renderer {outcome['renderer']}{' on ' if outcome['gpu'] else ''}{outcome['gpu']}",
        others,
        f"{outcome['scene']}: loaded and indexed in {outcome['prepare_s']:.1f} s",
    ]
    for kind, found in outcome["photos"].items():
        fine = round(found["success_1deg_0p01"] * found["queries"])
        lines += [
            f"intrinsics {kind}: {found['localized']} of {found['queries']} localized, {found['false_localized']} "
            f"wrongly, {fine} within 1 deg and 0.01 units; median error {found['median_rotation_deg']:.3f} deg, "
            f"{found['median_translation_units']:.4f} units",
            f"  ms a photo: median {found['latency_ms_p50']:.0f}, 95 % {found['latency_ms_p95']:.0f}; by stage: "
            + ", ".join(f"{stage} {ms:.1f}" for stage, ms in found["stages_ms_p50"].items()),
        ]
    return "\n".join(lines)
