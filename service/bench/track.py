"""`splatfix bench track`: follow a camera along a smooth path through a scene, frame by frame.

The path goes through the training cameras, from one to the nearest that wasn't visited yet, on splines, at a steady
pace: per frame at most STEP_DEG and STEP_UNITS, which at 30 frames a second is a walk with a phone. Its frames are
rendered in the training cameras' size and stored as JPEG, with noise, and with an exposure that goes up and down. The
truth is exact then, and the scene is as good as it can be: real photos are `bench localize`'s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from service.bench.pose_metrics import COARSE, FINE, Outcome, Units, errors, nees, units_of
from service.errors import SceneNotFound
from service.geometry import pose_distance, quat_from_rotation, rotation_from_quat
from service.interfaces import Rasterizer
from service.localize import LoadedScene, Request
from service.photos.images import encode_image, read_query
from service.photos.sequence import PHOTO_LONG_SIDE
from service.pose.features.scene_focus import centre_depth
from service.results import PoseEstimate, Status
from service.scene_formats import load_scene
from service.tracking import Tracker
from service.types import Camera, Intrinsics, Pose

STEP_DEG, STEP_UNITS = 0.7, 0.02
LONG_SIDE = 800
NOISE = 0.03
"""Standard deviation, of values 0..1."""
GAIN = 1.35
"""The exposure swings by this factor up and down..."""
GAIN_PERIOD = 90
"""...once in so many frames."""
QUALITY = 90
KNOTS_DENSITY = 64
"""Places looked at between two cameras, to keep the pace."""


def run(
    folder: Path,
    *,
    frames: int = 300,
    seed: int = 0,
    intrinsics: Literal["given", "withheld"] = "given",
    progress: Callable[[int, int], None] | None = None,
    cache_dir: Path | None = None,
) -> dict[str, Any]:
    """Return the object that `--json` writes. Raises SceneError."""
    loaded = LoadedScene.of(load_scene(Path(folder)), cache_dir=cache_dir)
    training = [named.camera for named in loaded.scene.cameras]
    if len(training) < 2:
        raise SceneNotFound("a path needs a scene with two training cameras or more.", where=str(folder))
    request = Request(seed=seed)
    loaded.prepare(request.estimator)
    units = units_of(training, lambda camera: centre_depth(loaded.rasterizer, camera))
    path = smooth_path([camera.pose for camera in training], units, frames)
    lens = replace(training[0].intrinsics.with_long_side(LONG_SIDE), model="PINHOLE", distortion=())
    given = lens if intrinsics == "given" else None
    tracker = Tracker(loaded, request)
    steps = []
    warm = next(_photos(path, lens, loaded.rasterizer, seed))
    Tracker(loaded, request).track(read_query(warm, intrinsics=given, long_side=PHOTO_LONG_SIDE))
    for number, data in enumerate(_photos(path, lens, loaded.rasterizer, seed)):
        steps.append(_step(tracker, data, given, path[number], units))
        if progress:
            progress(number + 1, len(path))
    facts = {"scene": loaded.scene.info.name, "gaussians": loaded.scene.count, "seed": seed, "intrinsics": intrinsics}
    facts |= {"width": lens.width, "height": lens.height, "noise": NOISE, "gain": GAIN, "jpeg": QUALITY}
    moves = [errors(a, b, units) for a, b in pairwise(path)]
    facts |= {"step_deg_p50": _median(m[0] for m in moves), "step_units_p50": _median(m[1] for m in moves)}
    return facts | summary(steps) | {"per_frame": [_line(step, lens) for step in steps]}


@dataclass(frozen=True, slots=True)
class Step:
    """One frame's answer."""

    estimate: PoseEstimate
    outcome: Outcome
    """Its latency is from the JPEG's bytes on."""
    decode_ms: float
    nees: float | None

    @property
    def followed(self) -> bool:
        return self.estimate.records[-1].stage == "track"


def _step(tracker: Tracker, data: bytes, given: Intrinsics | None, truth: Pose, units: Units) -> Step:
    wall, cpu = time.perf_counter(), time.process_time()
    query = read_query(data, intrinsics=given, long_side=PHOTO_LONG_SIDE)
    decode_ms = 1e3 * (time.perf_counter() - wall)
    estimate = tracker.track(query)
    latency_ms, cpu_ms = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
    outcome = Outcome(estimate.verdict.status, *errors(estimate.pose, truth, units), latency_ms, cpu_ms)
    return Step(estimate, outcome, decode_ms, nees(estimate, truth))


def summary(steps: Sequence[Step]) -> dict[str, Any]:
    """Return the aggregate figures; latencies are of the frames after the first, which nothing precedes.

    `drift`: how much larger the median error of the last tenth of the frames is than that of the first.
    """
    outcomes = [step.outcome for step in steps]
    later = outcomes[1:] or outcomes
    turned, shifted = (np.array([getattr(o, n) for o in outcomes]) for n in ("rotation_deg", "translation_units"))
    tenth = max(1, len(steps) // 10)
    squares = [step.nees for step in steps if step.nees is not None]
    return {
        "frames": len(steps),
        "followed": sum(step.followed for step in steps),
        "localized": sum(o.status is Status.LOCALIZED for o in outcomes),
        "false_localized": sum(o.false for o in outcomes),
        "success_5deg_0p05": float(np.mean([o.success(COARSE) for o in outcomes])),
        "success_1deg_0p01": float(np.mean([o.success(FINE) for o in outcomes])),
        **{f"rotation_deg_p{q}": float(np.percentile(turned, q)) for q in (50, 95, 100)},
        **{f"translation_units_p{q}": float(np.percentile(shifted, q)) for q in (50, 95, 100)},
        "drift_deg": float(np.median(turned[-tenth:]) - np.median(turned[:tenth])),
        "drift_units": float(np.median(shifted[-tenth:]) - np.median(shifted[:tenth])),
        "nees_mean": float(np.mean(squares)) if squares else None,
        "decode_ms_p50": _median(step.decode_ms for step in steps),
        **{f"latency_ms_p{q}": float(np.percentile([o.latency_ms for o in later], q)) for q in (50, 95, 100)},
        "cpu_ms_p50": _median(o.cpu_ms for o in later),
        "first_ms": outcomes[0].latency_ms,
    }


def smooth_path(stations: Sequence[Pose], units: Units, frames: int) -> list[Pose]:
    """Return poses on a spline through the stations, nearest first, at a steady pace; back and forth if need be."""
    tour = _tour(stations, units)
    knots = np.stack([_vector(pose) for pose in tour])
    for i in range(1, len(knots)):  # a quaternion and its negative are one rotation
        if knots[i, 3:] @ knots[i - 1, 3:] < 0:
            knots[i, 3:] *= -1
    at = np.linspace(0, len(knots) - 1, KNOTS_DENSITY * (len(knots) - 1) + 1)
    dense = [_pose(_spline(knots, t)) for t in at]
    ways = [_pace(a, b, units) for a, b in pairwise(dense)]
    along = np.concatenate([[0.0], np.cumsum(ways)])
    there = np.arange(frames) % max(1.0, 2 * along[-1])
    there = np.where(there > along[-1], 2 * along[-1] - there, there)
    return [_pose(_spline(knots, t)) for t in np.interp(there, along, at)]


def _tour(stations: Sequence[Pose], units: Units) -> list[Pose]:
    left = list(stations)
    tour = [left.pop(0)]
    while left:
        nearest = min(range(len(left)), key=lambda i: _pace(tour[-1], left[i], units))
        tour.append(left.pop(nearest))
    return tour


def _pace(a: Pose, b: Pose, units: Units) -> float:
    """Return in how many frames one gets from one pose to the other."""
    degrees, way = pose_distance(a, b)
    return max(degrees / STEP_DEG, way * units.units_per_scene_unit / STEP_UNITS)


def _vector(pose: Pose) -> Float64[np.ndarray, "7"]:
    return np.concatenate([pose.position_in_world, quat_from_rotation(pose.world_from_camera[:3, :3])])


def _pose(vector: Float64[np.ndarray, "7"]) -> Pose:
    matrix = np.eye(4)
    matrix[:3, 3], matrix[:3, :3] = vector[:3], rotation_from_quat(vector[3:])
    return Pose(matrix)


def _spline(knots: Float64[np.ndarray, "n 7"], t: float) -> Float64[np.ndarray, "7"]:
    """Catmull and Rom's: through all knots, with a steady direction; `t` counts knots."""
    i = min(int(t), len(knots) - 2)
    u = t - i
    a, b, c, d = (knots[min(max(j, 0), len(knots) - 1)] for j in range(i - 1, i + 3))
    return 0.5 * (2 * b + u * (c - a + u * (2 * a - 5 * b + 4 * c - d + u * (3 * b - 3 * c + d - a))))


def _photos(path: Sequence[Pose], lens: Intrinsics, rasterizer: Rasterizer, seed: int) -> Iterator[bytes]:
    rng = np.random.default_rng(seed)
    for number, pose in enumerate(path):
        rgb = rasterizer.render([Camera(lens, pose)])[0].rgb
        gain = np.float32(GAIN ** np.sin(2 * np.pi * number / GAIN_PERIOD))
        noise = rng.standard_normal(rgb.shape, np.float32) * np.float32(NOISE)
        yield encode_image(rgb * gain + noise, quality=QUALITY)


def _line(step: Step, lens: Intrinsics) -> dict[str, Any]:
    verdict, outcome = step.estimate.verdict, step.outcome
    return {
        "status": str(verdict.status),
        "reason": str(verdict.reason),
        "score": verdict.score,
        "followed": step.followed,
        "rotation_deg": outcome.rotation_deg,
        "translation_units": outcome.translation_units,
        "focal_error": step.estimate.intrinsics.fx / lens.fx - 1.0,
        "focal_sigma": verdict.focal_sigma,
        "nees": step.nees,
        "latency_ms": outcome.latency_ms,
        "cpu_ms": outcome.cpu_ms,
        "stages_ms": {timing.stage: 1e3 * timing.wall_s for timing in step.estimate.timings},
    }


def _median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))
