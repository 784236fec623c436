"""Runs the planned queries, writes one JSON line for each, and resumes an interrupted run.

A folder of results has `config.json` (what determines a result: seed, matcher, each method's options, each scene's
digest) and `results.jsonl`. A run with other values for any of these is refused; scenes, methods and trials may be
added. A line is written whole, and synced to disk before the next query begins; an incomplete last line, left by a
kill, is dropped and its query run again.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from service.bench.localize import BenchScene, Trial, load_bench_scene, localize_trial, make_trials, trial_result
from service.bench.paper.plan import SLOW, STEP_CURVES, Cell
from service.bench.pose_metrics import Outcome, errors
from service.errors import InvalidRequest
from service.localize import Request
from service.results import PoseEstimate

Key = tuple[str, str, str, int]
"""Scene, cell, photo, number of the trial."""


@dataclass(frozen=True, slots=True)
class RunSpec:
    """What a call of the bench runs, and how."""

    scenes: Mapping[str, tuple[Path, Path | None]]
    """Name -> scene, and its data set where that is elsewhere."""
    cells: Sequence[Cell]
    out: Path
    trials: int = 40
    slow_trials: int = 5
    seed: int = 0
    matcher: str = "xfeat"
    layout: str = "auto"
    background: str = "scene"
    cache_dir: Path | None = None
    waves: tuple[tuple[int | None, int | None], ...] = ((5, 1), (15, 2), (None, None))
    """Trials of every cell and scene, of fast and of slow methods, run before any cell gets more; None: all."""
    curve_points: int = 120
    """Records of a query's trace whose errors are kept, at most."""

    def count(self, cell: Cell, scene_photos: int) -> int:
        """Return the number of trials of a cell on a scene with so many test photos."""
        wanted = self.slow_trials if cell.method.name in SLOW else max(1, round(cell.share * self.trials))
        return wanted if cell.protocol != "none" else min(wanted, scene_photos)


@dataclass(slots=True)
class Progress:
    """Of a run, by scene and cell."""

    done: dict[tuple[str, str], int] = field(default_factory=dict)
    """Queries answered."""
    total: dict[tuple[str, str], int] = field(default_factory=dict)
    within: dict[tuple[str, str], int] = field(default_factory=dict)
    """Answers within 5 degrees and 0.05 units."""
    seconds: dict[str, list[float]] = field(default_factory=dict)
    """Wall times of a cell's queries, in this call."""
    expected_s: float = 10.0
    """Seconds a query, before there is any to go by."""

    @property
    def eta_s(self) -> float:
        """Estimated seconds left: at each cell's mean time a query, or that of all cells where it has none yet."""
        every = [s for each in self.seconds.values() for s in each]
        usual = sum(every) / len(every) if every else self.expected_s
        left = 0.0
        for (scene, cell), total in self.total.items():
            pace = self.seconds.get(cell)
            each = sum(pace) / len(pace) if pace else usual
            left += (total - self.done.get((scene, cell), 0)) * each
        return left


def run(spec: RunSpec, on_progress: Callable[[Progress], None] | None = None) -> list[dict[str, Any]]:
    """Run the queries that have no line yet; return all lines. Raises SceneError, InvalidRequest."""
    spec.out.mkdir(parents=True, exist_ok=True)
    subjects = {name: load(spec, name) for name in spec.scenes}
    _check_config(spec, subjects)
    file = spec.out / "results.jsonl"
    lines = read_lines(file, repair=True)
    progress = _progress_so_far(spec, subjects, lines)
    done, warm = {_key(line) for line in lines}, set[str]()
    with file.open("a", encoding="utf-8") as stream:
        for scene, cell, trial in _todo(spec, subjects):
            if (scene, cell.name, trial.photo, trial.number) in done:
                continue
            # Only scenes that still have queries to run are warmed up.
            if scene not in warm:
                _warm(subjects[scene])
                warm.add(scene)
            began = time.perf_counter()
            line = _answer(scene, subjects[scene], cell, trial, spec)
            stream.write(json.dumps(line) + "\n")
            stream.flush()
            # A power cut may cost the query under way, never one that was reported.
            os.fsync(stream.fileno())
            lines.append(line)
            done.add(_key(line))
            _count(progress, line)
            progress.seconds.setdefault(cell.name, []).append(time.perf_counter() - began)
            if on_progress:
                on_progress(progress)
    return lines


def read_lines(file: Path, repair: bool = False) -> list[dict[str, Any]]:
    """Return the results in a file; with `repair`, cut off an incomplete last line. Raises InvalidRequest."""
    if not file.is_file():
        return []
    data = file.read_bytes()
    # An incomplete last line has no newline yet.
    whole = data[: data.rfind(b"\n") + 1]
    if repair and len(whole) < len(data):
        with file.open("r+b") as stream:
            stream.truncate(len(whole))
    try:
        return [json.loads(line) for line in whole.splitlines()]
    except ValueError as error:
        raise InvalidRequest(f"a line is not JSON: {error}", where=str(file)) from None


def load(spec: RunSpec, name: str) -> BenchScene:
    """Load a scene of the run with its test photos and truth. Raises SceneError."""
    scene, data = spec.scenes[name]
    settings = {"layout": spec.layout, "background": spec.background, "matcher": spec.matcher}
    return load_bench_scene(scene, data, **settings, cache_dir=spec.cache_dir)


def _warm(one: BenchScene) -> None:
    """Answer one query untimed: the first one loads kernels and networks."""
    for trial in make_trials(one, "none", 1, 0):
        localize_trial(one, trial, Request())


def _check_config(spec: RunSpec, subjects: Mapping[str, BenchScene]) -> None:
    """Write the configuration, merged with the folder's. Raises InvalidRequest if the two contradict each other."""
    file = spec.out / "config.json"
    stored = json.loads(file.read_text("utf-8")) if file.is_file() else {}
    now = {
        "general": {"seed": spec.seed, "matcher": spec.matcher, "layout": spec.layout},
        "methods": {cell.method.name: cell.method.config() for cell in spec.cells},
        "scenes": {name: _scene_facts(one) for name, one in subjects.items()},
    }
    # Tuples become lists, as they are in the stored file.
    now = json.loads(json.dumps(now))
    for part, entries in now.items():
        for name, value in entries.items():
            before = stored.get(part, {}).get(name, value)
            if before != value:
                raise InvalidRequest(
                    f"the results there were made with another {part}: {name}, {_difference(before, value)}.",
                    where=str(spec.out),
                    hint="Name another folder.",
                )
    # A later call may add methods and scenes to the folder, but not change those it has.
    merged = {part: stored.get(part, {}) | entries for part, entries in now.items()}
    file.write_text(json.dumps(merged, indent=1) + "\n", encoding="utf-8")


def _difference(before: Any, now: Any) -> str:
    if isinstance(before, dict) and isinstance(now, dict):
        for key in sorted(before.keys() | now.keys()):
            if before.get(key) != now.get(key):
                return f"{key}: {_difference(before.get(key), now.get(key))}"
    return f"{before!r} there, {now!r} now"[:300]


def _scene_facts(one: BenchScene) -> dict[str, Any]:
    scene = one.loaded.scene
    facts = {"sha256": scene.info.sha256, "gaussians": scene.count, "layout": one.layout}
    facts |= {"background_rgb": list(scene.info.background_rgb), "megabytes": scene.nbytes / 1e6}
    facts |= {"test_photos": len(one.photos), "training_cameras": len(one.training)}
    facts |= {"units_per_scene_unit": one.units.units_per_scene_unit}
    return facts | {"trajectory_radius_units": trajectory_radius(one)}


def trajectory_radius(one: BenchScene) -> float:
    """Return the training cameras' mean distance from their centroid, in normalized units."""
    positions = np.stack([camera.pose.position_in_world for camera in one.training])
    return float(np.linalg.norm(positions - positions.mean(0), axis=1).mean() * one.units.units_per_scene_unit)


def _todo(spec: RunSpec, subjects: Mapping[str, BenchScene]) -> Iterator[tuple[str, Cell, Trial]]:
    """Yield all queries: a few of every cell and scene first, then more (see `waves`)."""
    for fast, slow in spec.waves:
        for cell in spec.cells:
            # Slow methods would hold up the first results of all others.
            most = slow if cell.method.name in SLOW else fast
            for scene, one in subjects.items():
                chosen = _photos_of_cell(one, cell)
                count = spec.count(cell, len(chosen.photos))
                for trial in make_trials(chosen, cell.protocol, min(count, most or count), spec.seed):
                    yield scene, cell, trial


def _photos_of_cell(one: BenchScene, cell: Cell) -> BenchScene:
    if cell.photos is None or cell.photos >= len(one.photos):
        return one
    # Evenly spread over the sequence, for neighbouring photos are alike.
    step = len(one.photos) / cell.photos
    return replace(one, photos=tuple(one.photos[int(i * step)] for i in range(cell.photos)))


def _answer(scene: str, one: BenchScene, cell: Cell, trial: Trial, spec: RunSpec) -> dict[str, Any]:
    """Answer one query; return its line."""
    method = cell.method
    # Indexes are made before the clock starts: their time is a scene's, not a query's.
    one.loaded.prepare(method.estimator)
    wall, cpu = time.perf_counter(), time.process_time()
    estimate = localize_trial(one, trial, Request(method.estimator, method.options, spec.seed))
    spent = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
    outcome = Outcome(estimate.verdict.status, *errors(estimate.pose, trial.truth.pose, one.units), *spent)
    line: dict[str, Any] = {
        "scene": scene,
        "cell": cell.name,
        "study": cell.study,
        "method": method.name,
        "protocol": cell.protocol,
    }
    line |= trial_result(trial, estimate, outcome, one.units)
    line |= {"profile": method.profile, "within_5deg_0p05": outcome.within((5.0, 0.05))}
    line |= {"within_1deg_0p01": outcome.within((1.0, 0.01))}
    line |= {"stages_cpu_ms": {timing.stage: 1e3 * timing.cpu_s for timing in estimate.timings}}
    line |= {"world_from_camera": estimate.pose.world_from_camera.tolist(), "code": code_digest()}
    # Curves are only drawn of these, and fill the file.
    if method.name in STEP_CURVES and cell.study == "table2":
        line["curve"] = _curve(estimate, trial, one, spec.curve_points)
    return line


def _curve(estimate: PoseEstimate, trial: Trial, one: BenchScene, points: int) -> list[tuple[int, float, float]]:
    """Return errors at evenly spread records of the trace: number, degrees, normalized units."""
    records = estimate.records
    stride = max(1, -(-len(records) // points))
    # The last record is the answer, and always belongs to the curve.
    kept = sorted({*range(0, len(records), stride), len(records) - 1})
    found = []
    for number in kept:
        degrees, units = errors(records[number].pose, trial.truth.pose, one.units)
        found.append((number, round(degrees, 4), round(units, 5)))
    return found


def _progress_so_far(spec: RunSpec, subjects: Mapping[str, BenchScene], lines: Sequence[Mapping[str, Any]]) -> Progress:
    progress = Progress()
    for cell in spec.cells:
        for scene, one in subjects.items():
            progress.total[scene, cell.name] = spec.count(cell, len(_photos_of_cell(one, cell).photos))
    for line in lines:  # an earlier call may have run more trials
        place = line["scene"], line["cell"]
        if progress.done.get(place, 0) < progress.total.get(place, 0):
            _count(progress, line)
    return progress


def _count(progress: Progress, line: Mapping[str, Any]) -> None:
    place = line["scene"], line["cell"]
    progress.done[place] = progress.done.get(place, 0) + 1
    progress.within[place] = progress.within.get(place, 0) + bool(line["within_5deg_0p05"])


def _key(line: Mapping[str, Any]) -> Key:
    return line["scene"], line["cell"], line["photo"], line["trial"]


@cache
def code_digest() -> str:
    """Return a digest of the source that determines results; a report lists the versions of its lines."""
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    # Web, jobs and viewer don't change a pose.
    for folder in ("estimators", "pose", "render", "matchers"):
        for file in sorted((root / folder).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]
