"""A scene's coverage map as the API returns it."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from service.coverage.coverage_map import CoverageMap, Trial, heading_of
from service.scene_manager.status import CoverageStatus
from service.web.api_model import Model
from service.web.problems import Problem, problem_of_failure


class CoverageCellOut(Model):
    """A place in plan view."""

    position: list[float]
    """In the world, at the height of the scene's cameras there; scene units."""
    probabilities: list[float | None]
    """That a photo taken there is found, for each of `headings_deg`; null: nothing of the scene is in view."""


class CoverageTrialOut(Model):
    """A photo that was localized to measure the map."""

    photo: str | None
    """Name of a held-out photo; null: a render made as photos are."""
    position: list[float]
    heading_deg: float
    status: str | None
    found: bool
    """Localized, and within 5 degrees and 2 % of the distance to what is seen."""
    rotation_deg: float
    position_units: float


class CoverageTriedOut(Model):
    """The photos that a measurement has tried so far."""

    plan_from_world: list[list[float]]
    """3x3 rotation; the third axis of the plan is up."""
    trials: list[CoverageTrialOut]


class CoverageMapOut(Model):
    """Where in a scene a photo would be found, by place in plan view and by heading."""

    title: str
    """What the probabilities are: calibrated, or an upper bound."""
    scene_sha256: str
    plan_from_world: list[list[float]]
    """3x3 rotation; the third axis of the plan is up."""
    cell: float
    """Distance of neighbouring cells, scene units."""
    headings_deg: list[float]
    """Of the viewing direction, from the plan's first axis to its second: counter-clockwise as seen from above."""
    cells: list[CoverageCellOut]
    trials: list[CoverageTrialOut]
    found: float
    """Mean probability where the scene is in view."""
    sure_share: float
    """Share of places and headings with a probability of at least 0.9, of those where the scene is in view."""
    median_rotation_deg: float | None
    """Expected accuracy: of the photos that were found, of held-out ones where there are some."""
    median_position_units: float | None
    calibration_photos: int
    """Held-out photos that the probabilities are calibrated on; 0: they are an upper bound."""
    brier: float | None
    """Brier score of these photos, each left out of its own calibration."""
    seconds: float
    """Time that measuring took."""


class CoverageOut(Model):
    """A scene's coverage map, or how far it is measured."""

    state: Literal["none", "running", "ready", "failed"]
    done: int
    """Test renders and held-out photos that were tried so far, of `total`."""
    total: int
    remaining_s: float | None
    """Estimated time until the measurement ends; null: not known, or none runs."""
    map: CoverageMapOut | None
    tried: CoverageTriedOut | None
    """While it is measured, from the first photo on; else null."""
    error: Problem | None
    """Why it could not be measured."""


def coverage_status_out(status: CoverageStatus, instance: str) -> CoverageOut:
    """Convert a map's state."""
    error = status.failure and problem_of_failure(status.failure, instance)
    found = status.found and coverage_out(status.found)
    return CoverageOut(
        state=status.state,
        done=status.done,
        total=status.total,
        remaining_s=status.remaining_s,
        map=found,
        tried=status.partial and tried_out(status.partial),
        error=error,
    )


def tried_out(partial: CoverageMap) -> CoverageTriedOut:
    """Convert what a measurement has tried so far."""
    trials = [_trial_out(trial, partial) for trial in partial.trials]
    return CoverageTriedOut(plan_from_world=partial.plan_from_world.tolist(), trials=trials)


def coverage_out(found: CoverageMap) -> CoverageMapOut:
    """Convert a map."""
    expected, probabilities = found.expected_accuracy(), np.where(found.sees_scene, found.probabilities, np.nan)
    cells = zip(found.positions_in_world.tolist(), probabilities.tolist(), strict=True)
    return CoverageMapOut(
        title=found.title,
        scene_sha256=found.scene_sha256,
        plan_from_world=found.plan_from_world.tolist(),
        cell=found.cell,
        headings_deg=np.degrees(found.headings_rad).tolist(),
        cells=[CoverageCellOut(position=position, probabilities=[_number(p) for p in row]) for position, row in cells],
        trials=[_trial_out(trial, found) for trial in (*found.trials, *found.real_trials)],
        found=expected.found,
        sure_share=expected.sure_share,
        median_rotation_deg=_number(expected.median_rotation_deg),
        median_position_units=_number(expected.median_position_units),
        calibration_photos=found.calibration.photos,
        brier=found.calibration.brier,
        seconds=found.seconds,
    )


def _trial_out(trial: Trial, found: CoverageMap) -> CoverageTrialOut:
    return CoverageTrialOut(
        photo=trial.photo or None,
        position=trial.pose.position_in_world.tolist(),
        heading_deg=math.degrees(heading_of(trial.pose, found.plan_from_world)),
        status=None if trial.status is None else str(trial.status),
        found=trial.found,
        rotation_deg=trial.rotation_deg,
        position_units=trial.position_units,
    )


def _number(value: float) -> float | None:
    # JSON has no NaN.
    return None if math.isnan(value) else value
