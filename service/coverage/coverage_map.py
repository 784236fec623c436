"""The coverage map of a scene: the probability that a photo is found, by place in plan view and by heading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from service.coverage.calibration import Calibration, fitted_line
from service.results import Status
from service.types import Pose, frozen

FOUND_AT = 0.9
"""Probability from which on a place is shown as one where photos are found."""
SMOOTHING_CELLS, SMOOTHING_RAD, PRIOR_WEIGHT = 1.2, float(np.radians(25)), 2.0
"""Standard deviations of the kernel over places and headings, and how many trials' worth the prediction by the novelty
has against those nearby."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One photo that was localized: a degraded render, or a held-out real photo."""

    pose: Pose
    """The true one, in the world."""
    status: Status | None
    """None: nothing of the scene is in view, so that there was nothing to localize."""
    found: bool
    """Localized, and as accurate as is asked for by default."""
    rotation_deg: float
    """Errors of the pose that was found; 0 without a status."""
    position_units: float
    novelty: float
    """How far it is from the capture's cameras (`plan.novelty`)."""
    photo: str = ""
    """Name of a real photo."""


@dataclass(frozen=True, slots=True)
class CoverageMap:
    """All arrays are read-only; lengths in scene units."""

    scene_sha256: str
    plan_from_world: Float64[np.ndarray, "3 3"]
    """Rotation; the third axis is up. A heading is the angle of the viewing direction from the first axis to the
    second, counter-clockwise as seen from above."""
    cell: float
    """Distance of neighbouring cells."""
    positions_in_world: Float64[np.ndarray, "c 3"]
    """Middles of the cells, at the height of cameras there."""
    headings_rad: Float64[np.ndarray, "h"]
    sees_scene: Bool[np.ndarray, "c h"]
    """Whether enough of the scene is in view there."""
    novelties: Float64[np.ndarray, "c h"]
    """Of each place and heading (`plan.novelty`)."""
    trials: tuple[Trial, ...]
    """Of degraded renders."""
    real_trials: tuple[Trial, ...]
    """Of held-out real photos, where the scene's folder has some."""
    calibration: Calibration
    seconds: float
    """Wall time of the measurement."""

    def __post_init__(self) -> None:
        for name in ("plan_from_world", "positions_in_world", "headings_rad", "novelties"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64))
        object.__setattr__(self, "sees_scene", frozen(self.sees_scene, np.bool_))

    @property
    def title(self) -> str:
        """What the probabilities are."""
        if self.calibration.photos:
            return f"Coverage, calibrated on {self.calibration.photos} held-out photos"
        return "Coverage, upper bound: not calibrated on photos of this scene"

    @property
    def probabilities(self) -> Float64[np.ndarray, "c h"]:
        """Probability that a photo of each place and heading is found; 0 where nothing of the scene is in view."""
        count = len(self.headings_rad)
        at = np.repeat(self.positions_in_world @ self.plan_from_world.T, count, 0)[:, :2]
        headings = np.tile(self.headings_rad, len(self.positions_in_world))
        rates = self._rates(at, headings, self.novelties.ravel())
        return np.where(self.sees_scene, self.calibration.applied(rates).reshape(self.sees_scene.shape), 0.0)

    def rates_near(self, trials: Sequence[Trial]) -> Float64[np.ndarray, "k"]:
        """Return the probability that a degraded render is found where other photos were taken, before calibration."""
        return self._rates(*self._coordinates(trials), np.array([trial.novelty for trial in trials]))

    def _coordinates(self, trials: Sequence[Trial]) -> tuple[Float64[np.ndarray, "k 2"], Float64[np.ndarray, "k"]]:
        at = np.array([self.plan_from_world @ trial.pose.position_in_world for trial in trials]).reshape(-1, 3)[:, :2]
        return at, np.array([heading_of(trial.pose, self.plan_from_world) for trial in trials])

    def _rates(
        self, at: Float64[np.ndarray, "k 2"], headings: Float64[np.ndarray, "k"], novelties: Float64[np.ndarray, "k"]
    ) -> Float64[np.ndarray, "k"]:
        """Predict by the novelty, and add what the trials nearby were better or worse (Nadaraya-Watson's average)."""
        # A view of nothing fails for want of a scene, and says nothing about places that see it.
        tried = [trial for trial in self.trials if trial.status is not None]
        if not tried:
            return np.zeros(len(at))
        found = np.array([trial.found for trial in tried])
        known = np.array([trial.novelty for trial in tried])
        line = fitted_line(known, found)
        places, directions = self._coordinates(tried)
        apart = np.linalg.norm(at[:, None] - places, axis=2) / (SMOOTHING_CELLS * self.cell)
        turned = np.abs((headings[:, None] - directions + np.pi) % (2 * np.pi) - np.pi) / SMOOTHING_RAD
        weights = np.exp(-0.5 * (apart**2 + turned**2))
        local = (weights @ (found - line(known))) / (weights.sum(1) + PRIOR_WEIGHT)
        return np.clip(line(novelties) + local, 0.0, 1.0)

    def expected_accuracy(self) -> ExpectedAccuracy:
        """Summarize: what to expect of a photo that is taken where the scene was captured."""
        probabilities = self.probabilities[self.sees_scene]
        # A render differs from the scene by nothing but light and lens: its errors are smaller than a photo's.
        found = [trial for trial in (self.real_trials or self.trials) if trial.found]
        errors = np.array([(trial.rotation_deg, trial.position_units) for trial in found]).reshape(-1, 2)
        middle = np.median(errors, 0) if found else np.full(2, np.nan)
        return ExpectedAccuracy(
            float(probabilities.mean()) if len(probabilities) else 0.0,
            float((probabilities >= FOUND_AT).mean()) if len(probabilities) else 0.0,
            *(float(value) for value in middle),
        )


@dataclass(frozen=True, slots=True)
class ExpectedAccuracy:
    """What to expect of a photo that is taken where the scene was captured: shares and probabilities in 0..1."""

    found: float
    """Mean probability over all places and headings that see the scene."""
    sure_share: float
    """Share of these where it is at least FOUND_AT."""
    median_rotation_deg: float
    """Of the photos that were found, real ones where there are some; NaN: none was."""
    median_position_units: float


def heading_of(pose: Pose, plan_from_world: Float64[np.ndarray, "3 3"]) -> float:
    """Return the heading of a camera (rad, -pi..pi, as in `CoverageMap`); of one that looks straight up or down that of
    the image's upper or lower edge, whichever points ahead.
    """
    axis = plan_from_world @ pose.axis_in_world
    # Within 6 degrees of the vertical the axis has no heading but noise.
    if np.hypot(axis[0], axis[1]) < 0.1:
        axis = plan_from_world @ -pose.world_from_camera[:3, 1] * (1 if axis[2] < 0 else -1)
    return float(np.arctan2(axis[1], axis[0]))
