"""Metrics of the benches: pose errors in normalized units, success within bounds, false localizations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.geometry import pose_distance, se3_log
from service.pose.features.scene_focus import focus_of
from service.results import PoseEstimate, Status
from service.types import Camera, Pose

FOCUS_DISTANCE = 4.0
"""Median distance of the training cameras from the focus, in normalized units."""
COARSE = (5.0, 0.05)
"""Bounds of a success: degrees and normalized units. A localized photo outside of these is false."""
FINE = (1.0, 0.01)
"""Bounds of an accurate success."""


@dataclass(frozen=True, slots=True)
class Units:
    """The normalized frame of a scene: origin at its focus, median distance of the training cameras 4."""

    focus_in_world: Float64[np.ndarray, "3"]
    units_per_scene_unit: float
    forward_facing: bool

    def normalized_from_world(self) -> Float64[np.ndarray, "4 4"]:
        """Return the similarity transform into the normalized frame, whose axes are the world's."""
        matrix = np.diag([self.units_per_scene_unit] * 3 + [1.0])
        matrix[:3, 3] = -self.units_per_scene_unit * self.focus_in_world
        return matrix


def units_of(cameras: Sequence[Camera], depth_of: Callable[[Camera], float]) -> Units:
    """Return the units of a scene with these training cameras; `depth_of` as in `focus_of`."""
    focus = focus_of(cameras, depth_of)
    return Units(focus.point_in_world, FOCUS_DISTANCE / focus.distance, focus.forward_facing)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Errors and times of one localized photo."""

    status: Status
    rotation_deg: float
    translation_units: float
    """Normalized."""
    latency_ms: float
    cpu_ms: float
    asked: tuple[float, float] = COARSE
    """The accuracy asked for at the true pose, as bounds: degrees and normalized units."""

    def success(self, bound: tuple[float, float]) -> bool:
        """Whether the status is localized and both errors are within bounds; a correct but uncertain pose is a miss."""
        return self.status is Status.LOCALIZED and self.within(bound)

    def within(self, bound: tuple[float, float]) -> bool:
        """Whether both errors are within bounds, whatever the status."""
        return self.rotation_deg <= bound[0] and self.translation_units <= bound[1]

    @property
    def false(self) -> bool:
        """Whether the status is localized though the pose is wrong."""
        return self.status is Status.LOCALIZED and not self.within(COARSE)


def errors(estimate: Pose, truth: Pose, units: Units) -> tuple[float, float]:
    """Return the rotation error in degrees and the distance in normalized units."""
    # Normalized units make scenes of different units comparable.
    angle, distance = pose_distance(estimate, truth)
    return angle, distance * units.units_per_scene_unit


def nees(estimate: PoseEstimate, truth: Pose) -> float | None:
    """Return the normalized estimation error squared, e^T C^-1 e, of the pose's twist: 6 on average if C is consistent.

    None without a covariance, or where it is singular, which happens when few residuals contribute.
    """
    covariance = estimate.verdict.covariance
    if covariance is None or np.linalg.matrix_rank(covariance, hermitian=True) < len(covariance):
        return None
    # The covariance is of the twist in the camera frame.
    twist = se3_log(estimate.pose.camera_from_world @ truth.world_from_camera)
    return float(twist @ np.linalg.solve(covariance, twist))


def summary(outcomes: Sequence[Outcome]) -> dict[str, float | int]:
    """Return the aggregate figures of `splatfix bench localize`; medians are over all photos, whatever their status."""
    latencies = [o.latency_ms for o in outcomes]
    return {
        "queries": len(outcomes),
        "success_5deg_0p05": float(np.mean([o.success(COARSE) for o in outcomes])),
        "success_1deg_0p01": float(np.mean([o.success(FINE) for o in outcomes])),
        "success_asked": float(np.mean([o.success(o.asked) for o in outcomes])),
        "median_rotation_deg": float(np.median([o.rotation_deg for o in outcomes])),
        "median_translation_units": float(np.median([o.translation_units for o in outcomes])),
        "localized": sum(o.status is Status.LOCALIZED for o in outcomes),
        "false_localized": sum(o.false for o in outcomes),
        "false_asked": sum(o.status is Status.LOCALIZED and not o.within(o.asked) for o in outcomes),
        "latency_ms_p50": float(np.percentile(latencies, 50)),
        "latency_ms_p95": float(np.percentile(latencies, 95)),
        "cpu_ms_p50": float(np.percentile([o.cpu_ms for o in outcomes], 50)),
    }
