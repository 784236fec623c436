"""Runs what is planned, one JSON line a query, and goes on where it was stopped.

A folder of results has `config.json` (what decides a result: seed, matcher, each method's options, each scene's
digest) and `results.jsonl`. A run with other values for any of these is refused; more scenes, methods or trials
may join. A line is written whole, and on disk before the next query begins: what a kill leaves of a line is
dropped and run again.
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

from service.bench.localize import Subject, Trial, answered, line_of, subject, trials_of
from service.bench.metrics import Outcome, errors
from service.bench.paper.plan import SLOW, STEP_CURVES, Cell
from service.errors import InvalidRequest
from service.localize import Request
from service.results import PoseEstimate

CURVE_POINTS = 120
WAVES = ((5, 1), (15, 2), (None, None))
"""Trials of every cell and scene, of fast and of slow methods, that are run before any cell gets more."""
Key = tuple[str, str, str, int]
"""Scene, cell, photo, number of the trial."""


@dataclass(frozen=True, slots=True)
class Asked:
    """What a call of the bench asks for."""

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

    def count(self, cell: Cell, scene_photos: int) -> int:
        wanted = self.slow_trials if cell.method.name in SLOW else max(1, round(cell.share * self.trials))
        return wanted if cell.protocol != "none" else min(wanted, scene_photos)


@dataclass(slots=True)
class Standing:
    """How far the run is."""

    done: dict[tuple[str, str], int] = field(default_factory=dict)
    """By scene and cell."""
    total: dict[tuple[str, str], int] = field(default_factory=dict)
    within: dict[tuple[str, str], int] = field(default_factory=dict)
    """Answers within 5 degrees and 0.05 units."""
    seconds: dict[str, list[float]] = field(default_factory=dict)
    """What queries of a cell took, in this call."""
    known_s: float = 10.0

    @property
    def eta_s(self) -> float:
        """Seconds to go, at the mean pace of each cell, or of all where it has none yet."""
        every = [s for each in self.seconds.values() for s in each]
        usual = sum(every) / len(every) if every else self.known_s
        left = 0.0
        for (scene, cell), total in self.total.items():
            pace = self.seconds.get(cell)
            each = sum(pace) / len(pace) if pace else usual
            left += (total - self.done.get((scene, cell), 0)) * each
        return left


def run(asked: Asked, on_standing: Callable[[Standing], None] | None = None) -> list[dict[str, Any]]:
    """Run what is not there yet, and return all lines. Raises SceneError, InvalidRequest."""
    asked.out.mkdir(parents=True, exist_ok=True)
    subjects = {name: load(asked, name) for name in asked.scenes}
    _settle_config(asked, subjects)
    file = asked.out / "results.jsonl"
    lines = read_lines(file, mend=True)
    standing = _begun(asked, subjects, lines)
    done, warm = {_key(line) for line in lines}, set[str]()
    with file.open("a", encoding="utf-8") as stream:
        for scene, cell, trial in _todo(asked, subjects):
            if (scene, cell.name, trial.photo, trial.number) in done:
                continue
            if scene not in warm:
                _warm(subjects[scene])
                warm.add(scene)
            began = time.perf_counter()
            line = _answer(scene, subjects[scene], cell, trial, asked.seed)
            stream.write(json.dumps(line) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
            lines.append(line)
            done.add(_key(line))
            _count(standing, line)
            standing.seconds.setdefault(cell.name, []).append(time.perf_counter() - began)
            if on_standing:
                on_standing(standing)
    return lines


def read_lines(file: Path, mend: bool = False) -> list[dict[str, Any]]:
    """Return the results; with `mend`, cut off what a kill left of the last line. Raises InvalidRequest."""
    if not file.is_file():
        return []
    data = file.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if mend and len(whole) < len(data):
        with file.open("r+b") as stream:
            stream.truncate(len(whole))
    try:
        return [json.loads(line) for line in whole.splitlines()]
    except ValueError as error:
        raise InvalidRequest(f"a line is not JSON: {error}", where=str(file)) from None


def load(asked: Asked, name: str) -> Subject:
    """Read a scene and its data set."""
    scene, data = asked.scenes[name]
    settings = {"layout": asked.layout, "background": asked.background, "matcher": asked.matcher}
    return subject(scene, data, **settings, cache_dir=asked.cache_dir)


def _warm(one: Subject) -> None:
    """Answer one query for nothing: the first one loads kernels and networks."""
    for trial in trials_of(one, "none", 1, 0):
        answered(one, trial, Request())


def _settle_config(asked: Asked, subjects: Mapping[str, Subject]) -> None:
    """Write the configuration down, or hold it against the one that is there. Raises InvalidRequest."""
    file = asked.out / "config.json"
    there = json.loads(file.read_text("utf-8")) if file.is_file() else {}
    now = {
        "general": {"seed": asked.seed, "matcher": asked.matcher, "layout": asked.layout},
        "methods": {cell.method.name: cell.method.config() for cell in asked.cells},
        "scenes": {name: _scene_facts(one) for name, one in subjects.items()},
    }
    now = json.loads(json.dumps(now))
    for part, entries in now.items():
        for name, value in entries.items():
            before = there.get(part, {}).get(name, value)
            if before != value:
                raise InvalidRequest(
                    f"the results there were made with another {part}: {name}, {_difference(before, value)}.",
                    where=str(asked.out),
                    hint="Name another folder.",
                )
    merged = {part: there.get(part, {}) | entries for part, entries in now.items()}
    file.write_text(json.dumps(merged, indent=1) + "\n", encoding="utf-8")


def _difference(before: Any, now: Any) -> str:
    if isinstance(before, dict) and isinstance(now, dict):
        for key in sorted(before.keys() | now.keys()):
            if before.get(key) != now.get(key):
                return f"{key}: {_difference(before.get(key), now.get(key))}"
    return f"{before!r} there, {now!r} now"[:300]


def _scene_facts(one: Subject) -> dict[str, Any]:
    scene = one.loaded.scene
    facts = {"sha256": scene.info.sha256, "gaussians": scene.count, "layout": one.layout}
    facts |= {"background_rgb": list(scene.info.background_rgb), "megabytes": scene.nbytes / 1e6}
    facts |= {"test_photos": len(one.photos), "training_cameras": len(one.training)}
    facts |= {"units_per_scene_unit": one.units.units_per_scene_unit}
    return facts | {"trajectory_radius_units": trajectory_radius(one)}


def trajectory_radius(one: Subject) -> float:
    """Return the cameras' mean distance from their own centre, in normalized units."""
    positions = np.stack([camera.pose.position_in_world for camera in one.training])
    return float(np.linalg.norm(positions - positions.mean(0), axis=1).mean() * one.units.units_per_scene_unit)


def _todo(asked: Asked, subjects: Mapping[str, Subject]) -> Iterator[tuple[str, Cell, Trial]]:
    """All queries: first a few of everything, then the rest."""
    for fast, slow in WAVES:
        for cell in asked.cells:
            most = slow if cell.method.name in SLOW else fast
            for scene, one in subjects.items():
                few = _of_cell(one, cell)
                count = asked.count(cell, len(few.photos))
                for trial in trials_of(few, cell.protocol, min(count, most or count), asked.seed):
                    yield scene, cell, trial


def _of_cell(one: Subject, cell: Cell) -> Subject:
    if cell.photos is None or cell.photos >= len(one.photos):
        return one
    step = len(one.photos) / cell.photos
    return replace(one, photos=tuple(one.photos[int(i * step)] for i in range(cell.photos)))


def _answer(scene: str, one: Subject, cell: Cell, trial: Trial, seed: int) -> dict[str, Any]:
    method = cell.method
    one.loaded.prepare(method.estimator)
    wall, cpu = time.perf_counter(), time.process_time()
    estimate = answered(one, trial, Request(method.estimator, method.options, seed))
    spent = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
    outcome = Outcome(estimate.verdict.status, *errors(estimate.pose, trial.truth.pose, one.units), *spent)
    line: dict[str, Any] = {
        "scene": scene,
        "cell": cell.name,
        "study": cell.study,
        "method": method.name,
        "protocol": cell.protocol,
    }
    line |= line_of(trial, estimate, outcome, one.units)
    line |= {"profile": method.profile, "within_5deg_0p05": outcome.within((5.0, 0.05))}
    line |= {"within_1deg_0p01": outcome.within((1.0, 0.01))}
    line |= {"stages_cpu_ms": {timing.stage: 1e3 * timing.cpu_s for timing in estimate.timings}}
    line |= {"world_from_camera": estimate.pose.world_from_camera.tolist(), "code": code_digest()}
    if method.name in STEP_CURVES and cell.study == "table2":
        line["curve"] = _curve(estimate, trial, one)
    return line


def _curve(estimate: PoseEstimate, trial: Trial, one: Subject) -> list[tuple[int, float, float]]:
    """Errors after some of the steps: number, degrees, units."""
    records = estimate.records
    stride = max(1, -(-len(records) // CURVE_POINTS))
    kept = sorted({*range(0, len(records), stride), len(records) - 1})
    found = []
    for number in kept:
        degrees, units = errors(records[number].pose, trial.truth.pose, one.units)
        found.append((number, round(degrees, 4), round(units, 5)))
    return found


def _begun(asked: Asked, subjects: Mapping[str, Subject], lines: Sequence[Mapping[str, Any]]) -> Standing:
    standing = Standing()
    for cell in asked.cells:
        for scene, one in subjects.items():
            standing.total[scene, cell.name] = asked.count(cell, len(_of_cell(one, cell).photos))
    for line in lines:  # of an earlier call there may be more than this one asks for
        place = line["scene"], line["cell"]
        if standing.done.get(place, 0) < standing.total.get(place, 0):
            _count(standing, line)
    return standing


def _count(standing: Standing, line: Mapping[str, Any]) -> None:
    place = line["scene"], line["cell"]
    standing.done[place] = standing.done.get(place, 0) + 1
    standing.within[place] = standing.within.get(place, 0) + bool(line["within_5deg_0p05"])


def _key(line: Mapping[str, Any]) -> Key:
    return line["scene"], line["cell"], line["photo"], line["trial"]


@cache
def code_digest() -> str:
    """Return a digest of the source that decides results: a report says how many versions its lines are of."""
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    for folder in ("estimators", "pose", "render", "matchers"):
        for file in sorted((root / folder).glob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]
