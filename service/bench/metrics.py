"""What the bench counts: errors in normalized units, joint success, and what is falsely called localized."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.geometry import nearest_point_to_axes, pose_distance
from service.types import Camera, Pose, Status

FOCUS_DISTANCE = 4.0
"""Median distance of the training cameras from the focus, in normalized units."""
FORWARD_FACING_DEG = 15.0
"""Below this root-mean-square angle between the optical axes and their common direction, the point nearest to all
of them is not determined. LLFF's fern has 6 degrees; orbits and walks round an object had 33 or more."""
COARSE = (5.0, 0.05)
"""Degrees and normalized units."""
FINE = (1.0, 0.01)


@dataclass(frozen=True, slots=True)
class Units:
    """The normalized frame of a scene: origin in the focus, median camera at distance 4."""

    focus_in_world: Float64[np.ndarray, "3"]
    units_per_scene_unit: float
    forward_facing: bool

    def normalized_from_world(self) -> Float64[np.ndarray, "4 4"]:
        """Shift and even scale; the axes stay the scene's."""
        matrix = np.diag([self.units_per_scene_unit] * 3 + [1.0])
        matrix[:3, 3] = -self.units_per_scene_unit * self.focus_in_world
        return matrix


def units_of(cameras: Sequence[Camera], centre_depth: Callable[[Camera], float]) -> Units:
    """Return the units of a scene with these training cameras.

    The focus is the point nearest to all optical axes. In a forward-facing scene it is the mean of the points
    that the cameras see in their image centre, at the median of their depths: `centre_depth` renders it, in scene
    units, 0 where there is nothing.
    """
    poses = [camera.pose for camera in cameras]
    positions = np.stack([pose.position_in_world for pose in poses])
    forward_facing = is_forward_facing(poses)
    if forward_facing:
        depths = np.array([centre_depth(camera) for camera in cameras])
        depth = float(np.median(depths[depths > 0])) if np.any(depths > 0) else 1.0
        focus = np.mean([p.position_in_world + depth * p.axis_in_world for p in poses], axis=0)
    else:
        focus = nearest_point_to_axes(poses)
    distance = float(np.median(np.linalg.norm(positions - focus, axis=1)))
    return Units(focus, FOCUS_DISTANCE / max(distance, 1e-9), forward_facing)


def is_forward_facing(poses: Sequence[Pose]) -> bool:
    """Whether the optical axes are nearly parallel: see FORWARD_FACING_DEG.

    The common direction is the axes' first principal one; 1 - its eigenvalue is the mean squared sine to it.
    """
    axes = np.stack([pose.axis_in_world for pose in poses])
    along = float(np.linalg.eigvalsh(axes.T @ axes / len(axes))[-1])
    opposed = np.any(axes @ axes[0] < 0)  # a room seen both ways is not forward-facing
    return bool(not opposed and 1.0 - along < np.sin(np.radians(FORWARD_FACING_DEG)) ** 2)


@dataclass(frozen=True, slots=True)
class Outcome:
    """One answered query."""

    status: Status
    rotation_deg: float
    translation_units: float
    """Normalized."""
    latency_ms: float
    cpu_ms: float

    def success(self, bound: tuple[float, float]) -> bool:
        """Called localized, and within both bounds: a right pose that is called uncertain is a miss."""
        return self.status is Status.LOCALIZED and self.within(bound)

    def within(self, bound: tuple[float, float]) -> bool:
        return self.rotation_deg <= bound[0] and self.translation_units <= bound[1]

    @property
    def false(self) -> bool:
        return self.status is Status.LOCALIZED and not self.within(COARSE)


def errors(estimate: Pose, truth: Pose, units: Units) -> tuple[float, float]:
    """Return the rotation error in degrees and the distance in normalized units."""
    angle, distance = pose_distance(estimate, truth)
    return angle, distance * units.units_per_scene_unit


def summary(outcomes: Sequence[Outcome]) -> dict[str, float | int]:
    """Return the aggregate figures of `splatfix bench localize`; medians are over all answers, good and bad."""
    latencies = [o.latency_ms for o in outcomes]
    return {
        "queries": len(outcomes),
        "success_5deg_0p05": float(np.mean([o.success(COARSE) for o in outcomes])),
        "success_1deg_0p01": float(np.mean([o.success(FINE) for o in outcomes])),
        "median_rotation_deg": float(np.median([o.rotation_deg for o in outcomes])),
        "median_translation_units": float(np.median([o.translation_units for o in outcomes])),
        "localized": sum(o.status is Status.LOCALIZED for o in outcomes),
        "false_localized": sum(o.false for o in outcomes),
        "latency_ms_p50": float(np.percentile(latencies, 50)),
        "latency_ms_p95": float(np.percentile(latencies, 95)),
        "cpu_ms_p50": float(np.percentile([o.cpu_ms for o in outcomes], 50)),
    }
