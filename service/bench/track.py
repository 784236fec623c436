"""`splatfix bench track`: tracking of a camera along a smooth path through a scene.

The path is a spline through the training cameras, from each to the nearest not yet visited, at a constant speed. Its
frames are rendered from the scene, with noise and a changing exposure, and compressed as JPEG. The true poses are
therefore exact and the scene has no errors; `bench localize` measures real photos.
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
from service.loaded_scene import LoadedScene
from service.localize import Request
from service.photos.images import encode_image, read_query
from service.photos.sequence import PHOTO_LONG_SIDE
from service.pose.features.scene_focus import centre_depth
from service.results import PoseEstimate, Status
from service.scene_formats import load_scene
from service.tracking import Tracker
from service.types import Camera, Intrinsics, Pose


@dataclass(frozen=True, slots=True)
class SequenceConfig:
    """The synthetic image sequence; the defaults resemble a phone carried by a walking person at 30 frames a second."""

    step_deg: float = 0.7
    """Largest rotation per frame."""
    step_units: float = 0.02
    """Largest translation per frame, normalized units."""
    long_side_px: int = 800
    noise_sigma: float = 0.03
    """Standard deviation of the noise, of values 0..1."""
    gain: float = 1.35
    """Largest exposure gain; the smallest is its inverse."""
    gain_period: int = 90
    """Frames of one cycle of the exposure."""
    jpeg_quality: int = 90
    samples_per_knot: int = 64
    """Points of the spline between two training cameras at which its length is measured."""


SEQUENCE = SequenceConfig()


def run(
    folder: Path,
    *,
    frames: int = 300,
    seed: int = 0,
    intrinsics: Literal["given", "withheld"] = "given",
    progress: Callable[[int, int], None] | None = None,
    cache_dir: Path | None = None,
    config: SequenceConfig = SEQUENCE,
) -> dict[str, Any]:
    """Return the object that `--json` writes: aggregate figures, and a line per frame. Raises SceneError."""
    loaded = LoadedScene.of(load_scene(Path(folder)), cache_dir=cache_dir)
    training = [named.camera for named in loaded.scene.cameras]
    if len(training) < 2:
        raise SceneNotFound("a path needs a scene with two training cameras or more.", where=str(folder))
    request = Request(seed=seed)
    units = units_of(training, lambda camera: centre_depth(loaded.rasterizer, camera))
    path = smooth_path([camera.pose for camera in training], units, frames, config)
    camera = replace(training[0].intrinsics.with_long_side(config.long_side_px), model="PINHOLE", distortion=())
    given = camera if intrinsics == "given" else None
    tracker = Tracker(loaded, request)
    steps = []
    # The first localization compiles, allocates and makes the index; its time isn't counted.
    first = next(_render_frames(path, camera, loaded.rasterizer, seed, config))
    Tracker(loaded, request).track(read_query(first, intrinsics=given, long_side=PHOTO_LONG_SIDE))
    for number, data in enumerate(_render_frames(path, camera, loaded.rasterizer, seed, config)):
        steps.append(_track_frame(tracker, data, given, path[number], units))
        if progress:
            progress(number + 1, len(path))
    facts = {"scene": loaded.scene.info.name, "gaussians": loaded.scene.count, "seed": seed, "intrinsics": intrinsics}
    facts |= {"width": camera.width, "height": camera.height}
    facts |= {"noise": config.noise_sigma, "gain": config.gain, "jpeg": config.jpeg_quality}
    moves = [errors(a, b, units) for a, b in pairwise(path)]
    facts |= {"step_deg_p50": _median(m[0] for m in moves), "step_units_p50": _median(m[1] for m in moves)}
    return facts | summary(steps) | {"per_frame": [_frame_result(step, camera) for step in steps]}


@dataclass(frozen=True, slots=True)
class Step:
    """Estimate and errors of one frame."""

    estimate: PoseEstimate
    outcome: Outcome
    """With the latency from the JPEG's bytes to the estimate."""
    decode_ms: float
    nees: float | None

    @property
    def followed(self) -> bool:
        """Whether the pose was tracked from the frames before, without a search in the whole scene."""
        return self.estimate.records[-1].stage == "track"


def _track_frame(tracker: Tracker, data: bytes, given: Intrinsics | None, truth: Pose, units: Units) -> Step:
    wall, cpu = time.perf_counter(), time.process_time()
    query = read_query(data, intrinsics=given, long_side=PHOTO_LONG_SIDE)
    decode_ms = 1e3 * (time.perf_counter() - wall)
    estimate = tracker.track(query)
    latency_ms, cpu_ms = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
    outcome = Outcome(estimate.verdict.status, *errors(estimate.pose, truth, units), latency_ms, cpu_ms)
    return Step(estimate, outcome, decode_ms, nees(estimate, truth))


def summary(steps: Sequence[Step]) -> dict[str, Any]:
    """Return the aggregate figures; latencies are of the frames after the first, which can't be tracked.

    drift: median error of the last tenth of the frames minus that of the first tenth.
    """
    outcomes = [step.outcome for step in steps]
    # The first frame needs a search in the whole scene.
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


def smooth_path(stations: Sequence[Pose], units: Units, frames: int, config: SequenceConfig = SEQUENCE) -> list[Pose]:
    """Return poses at a constant speed on a Catmull-Rom spline through the stations, in nearest-neighbour order.

    A path of more frames than the spline's length goes back and forth.
    """
    tour = _nearest_neighbour_order(stations, units, config)
    knots = np.stack([_vector(pose) for pose in tour])
    for i in range(1, len(knots)):  # a quaternion and its negative are one rotation
        if knots[i, 3:] @ knots[i - 1, 3:] < 0:
            knots[i, 3:] *= -1
    # Densely, since the spline's parameter isn't proportional to the distance.
    at = np.linspace(0, len(knots) - 1, config.samples_per_knot * (len(knots) - 1) + 1)
    dense = [_pose(_spline(knots, t)) for t in at]
    lengths = [_frames_between(a, b, units, config) for a, b in pairwise(dense)]
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    position = np.arange(frames) % max(1.0, 2 * along[-1])
    # The second half of the way goes back.
    position = np.where(position > along[-1], 2 * along[-1] - position, position)
    return [_pose(_spline(knots, t)) for t in np.interp(position, along, at)]


def _nearest_neighbour_order(stations: Sequence[Pose], units: Units, config: SequenceConfig) -> list[Pose]:
    # Training cameras have any order; a path through them in it would jump to and fro.
    left = list(stations)
    tour = [left.pop(0)]
    while left:
        nearest = min(range(len(left)), key=lambda i: _frames_between(tour[-1], left[i], units, config))
        tour.append(left.pop(nearest))
    return tour


def _frames_between(a: Pose, b: Pose, units: Units, config: SequenceConfig) -> float:
    """Return the number of frames between two poses at the largest steps."""
    degrees, distance = pose_distance(a, b)
    return max(degrees / config.step_deg, distance * units.units_per_scene_unit / config.step_units)


def _vector(pose: Pose) -> Float64[np.ndarray, "7"]:
    return np.concatenate([pose.position_in_world, quat_from_rotation(pose.world_from_camera[:3, :3])])


def _pose(vector: Float64[np.ndarray, "7"]) -> Pose:
    matrix = np.eye(4)
    matrix[:3, 3], matrix[:3, :3] = vector[:3], rotation_from_quat(vector[3:])
    return Pose(matrix)


def _spline(knots: Float64[np.ndarray, "n 7"], t: float) -> Float64[np.ndarray, "7"]:
    """Return the Catmull-Rom spline through the knots at `t`, in knots."""
    # The last knot belongs to the last segment.
    i = min(int(t), len(knots) - 2)
    u = t - i
    a, b, c, d = (knots[min(max(j, 0), len(knots) - 1)] for j in range(i - 1, i + 3))
    return 0.5 * (2 * b + u * (c - a + u * (2 * a - 5 * b + 4 * c - d + u * (3 * b - 3 * c + d - a))))


def _render_frames(
    path: Sequence[Pose], intrinsics: Intrinsics, rasterizer: Rasterizer, seed: int, config: SequenceConfig
) -> Iterator[bytes]:
    rng = np.random.default_rng(seed)
    for number, pose in enumerate(path):
        rgb = rasterizer.render([Camera(intrinsics, pose)])[0].rgb
        # A camera's exposure changes slowly along a video.
        gain = np.float32(config.gain ** np.sin(2 * np.pi * number / config.gain_period))
        noise = rng.standard_normal(rgb.shape, np.float32) * np.float32(config.noise_sigma)
        yield encode_image(rgb * gain + noise, quality=config.jpeg_quality)


def _frame_result(step: Step, camera: Intrinsics) -> dict[str, Any]:
    verdict, outcome = step.estimate.verdict, step.outcome
    return {
        "status": str(verdict.status),
        "reason": str(verdict.reason),
        "score": verdict.score,
        "followed": step.followed,
        "rotation_deg": outcome.rotation_deg,
        "translation_units": outcome.translation_units,
        "focal_error": step.estimate.intrinsics.fx / camera.fx - 1.0,
        "focal_sigma": verdict.focal_sigma,
        "nees": step.nees,
        "latency_ms": outcome.latency_ms,
        "cpu_ms": outcome.cpu_ms,
        "stages_ms": {timing.stage: 1e3 * timing.wall_s for timing in step.estimate.timings},
    }


def _median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))
