"""Priors of a pose that a device measured: residuals, tests against a photo, and the pose by photo and priors together.

A pose R, p moves by a right twist (w, t): R exp(w), p + R t. Residuals r, their Jacobians J = dr / d(w, t) and noise S:

    up        r = B^T a, J = (B^T, 0), S = sigma^2 I: a is the rotation vector that takes R^T up to the up measured, m;
              the columns of B are two unit vectors across m (rotation about gravity itself isn't measured)
    position  r = A (p - z), J = (0, A R): z is measured, A has metres east, north (and up) for a unit along each axis
    heading   r = atan2(e, n) - z, e = east . R z_axis, n = north . R z_axis, J = (n de - e dn) / (e^2 + n^2),
              S = sigma^2 / (e^2 + n^2): an axis that is steep has a heading that a small tilt changes much

Tests: with C, the covariance of the pose by the photo alone, r has the covariance S + J C J^T if the reading is right,
and d^2 = r^T (S + J C J^T)^-1 r a chi-square distribution: beyond its 99.9 % quantile photo and reading contradict one
another, and the reading is dropped. Between two poses a and b that explain the photo alike, the readings prefer a if
none that agrees with either contradicts a, and sum d_b^2 - sum d_a^2 is 10.83 or more: for normal readings a likelihood
ratio that the wrong one of two places has with a probability of 0.05 % at most, whatever lies between them. Readings
that contradict both count for neither.

Together: the readings that agree add their information, one Gauss-Newton step of the maximum a posteriori estimate
(Barfoot, State Estimation for Robotics, 2017, chapters 3 and 7):

    C' = (C^-1 + sum J^T S^-1 J)^-1,  twist = -C' sum J^T S^-1 r

Where the photo says all, C is small and this changes nothing; along what it leaves open, the readings decide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from service.device_readings import HeadingPrior, PositionPrior, ScenePriors, UpPrior
from service.geometry import hat, moved
from service.types import Pose


@dataclass(frozen=True, slots=True)
class DevicePriorConfig:
    """When readings count, and which views may show what a photo with these readings does."""

    chi_square: tuple[float, float, float] = (10.83, 13.82, 16.27)
    """Beyond which a reading contradicts: 99.9 % quantiles for one, two and three degrees of freedom."""
    preferred: float = 10.83
    """Difference of squared distances from which on readings decide between two poses."""
    least_level: float = 0.2
    """Share of the camera's axis that is level below which it has no heading: steeper than 78 degrees."""
    view_pitch: float = 0.5
    view_turn: float = 0.6
    """Standard deviations, rad, by which the axis of a view that shows the same differs from the photo's, up or down
    and seen from above: half of a phone's field of view,"""
    view_way: float = 0.5
    """and of its place, relative to the distance to what it sees."""


DEVICE_PRIORS = DevicePriorConfig()


@dataclass(frozen=True, slots=True)
class PriorResidual:
    """A reading at one pose."""

    name: str
    """up, position, heading."""
    value: Float64[np.ndarray, "k"]
    jacobian: Float64[np.ndarray, "k 6"]
    noise: Float64[np.ndarray, "k k"]

    def squared_distance(self, covariance: Float64[np.ndarray, "6 6"] | None) -> float:
        """Return d^2 at a pose with this covariance; None: the pose counts as exact."""
        spread = self.noise
        if covariance is not None:
            spread = spread + self.jacobian @ covariance @ self.jacobian.T
        return float(self.value @ np.linalg.solve(spread, self.value))

    def contradicts(
        self, covariance: Float64[np.ndarray, "6 6"] | None, config: DevicePriorConfig = DEVICE_PRIORS
    ) -> bool:
        """Return whether reading and pose can't both be right."""
        return self.squared_distance(covariance) > config.chi_square[len(self.value) - 1]


def residuals(priors: ScenePriors | None, pose: Pose, config: DevicePriorConfig = DEVICE_PRIORS) -> list[PriorResidual]:
    """Return the residual of each prior at a pose, relative to the scene's origin; see the module."""
    return [] if priors is None else [one for one in _residuals(priors, pose, config) if one is not None]


def _residuals(priors: ScenePriors, pose: Pose, config: DevicePriorConfig) -> Iterator[PriorResidual | None]:
    if priors.up is not None:
        yield _of_up(priors.up, pose)
    if priors.position is not None:
        yield _of_position(priors.position, pose)
    if priors.heading is not None:
        yield _of_heading(priors.heading, pose, config)


def _of_up(prior: UpPrior, pose: Pose) -> PriorResidual:
    up, measured = pose.world_from_camera[:3, :3].T @ prior.up_in_world, prior.up_in_camera
    # The last two right singular vectors of a row are across it.
    across = np.linalg.svd(measured[None])[2][1:]
    axis = np.cross(up, measured)
    sine = float(np.linalg.norm(axis))
    # Upside down, any axis across will do.
    direction = axis / sine if sine > 1e-9 else across[0]
    value = across @ direction * np.arctan2(sine, up @ measured)
    jacobian = np.concatenate([across, np.zeros((2, 3))], 1)
    return PriorResidual("up", value, jacobian, prior.sigma**2 * np.eye(2))


def _of_position(prior: PositionPrior, pose: Pose) -> PriorResidual:
    value = prior.metres_from_world @ (pose.position_in_world - prior.position_in_world)
    along = prior.metres_from_world @ pose.world_from_camera[:3, :3]
    return PriorResidual(
        "position", value, np.concatenate([np.zeros((len(value), 3)), along], 1), np.array(prior.covariance)
    )


def _of_heading(prior: HeadingPrior, pose: Pose, config: DevicePriorConfig) -> PriorResidual | None:
    east, north, squared = _level_axis(prior, pose)
    if squared < config.least_level**2:
        return None
    # The axis moves by R (w x z_axis) = -R hat(z_axis) w.
    change = -pose.world_from_camera[:3, :3] @ hat(np.array([0.0, 0.0, 1.0]))
    turn = (north * (prior.east_in_world @ change) - east * (prior.north_in_world @ change)) / squared
    value = _wrapped(np.arctan2(east, north) - prior.radians)
    jacobian = np.concatenate([turn, np.zeros(3)])[None]
    return PriorResidual("heading", np.array([value]), jacobian, np.array([[prior.sigma**2 / squared]]))


def _level_axis(prior: HeadingPrior, pose: Pose) -> tuple[float, float, float]:
    """Return the axis' parts to the east and to the north, and the sum of their squares."""
    east, north = float(prior.east_in_world @ pose.axis_in_world), float(prior.north_in_world @ pose.axis_in_world)
    return east, north, east**2 + north**2


def _wrapped(angle: float) -> float:
    """Return the angle in -pi..pi."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


# ---------------------------------------------------------------------- tests


def contradicts(priors: ScenePriors | None, pose: Pose, covariance: Float64[np.ndarray, "6 6"] | None) -> bool:
    """Return whether any reading contradicts a pose with this covariance."""
    return any(one.contradicts(covariance) for one in residuals(priors, pose))


def prefers(
    priors: ScenePriors | None,
    pose: Pose,
    covariance: Float64[np.ndarray, "6 6"] | None,
    other: Pose,
    covariance_of_other: Float64[np.ndarray, "6 6"] | None,
    config: DevicePriorConfig = DEVICE_PRIORS,
) -> bool:
    """Return whether the readings decide for a pose, of two that explain the photo alike; see the module."""
    there = {one.name: one for one in residuals(priors, other, config)}
    difference = 0.0
    for one in residuals(priors, pose, config):
        if one.name not in there:
            continue
        against_other = there[one.name].contradicts(covariance_of_other, config)
        if one.contradicts(covariance, config):
            if not against_other:
                return False
            continue
        difference += there[one.name].squared_distance(covariance_of_other) - one.squared_distance(covariance)
    return difference >= config.preferred


def agreement(
    priors: ScenePriors | None,
    poses: Float64[np.ndarray, "n 4 4"],
    reaches: Float64[np.ndarray, "n"],
    config: DevicePriorConfig = DEVICE_PRIORS,
) -> Float64[np.ndarray, "n"]:
    """Return how well each view agrees with the readings of a photo, 0 to 1: exp(-d^2 / 2), summed over the readings.

    `poses` are the views' world_from_camera, `reaches` their distances to what they see, in scene units. A view shows
    what the photo does from elsewhere: d^2 is by pitch, heading and place of its camera, with how far these may differ
    (`view_pitch`, `view_turn`, `view_way`) added to the reading's variance.
    """
    squared = np.zeros(len(poses))
    if priors is None:
        return np.exp(squared)
    axes, positions = poses[:, :3, 2], poses[:, :3, 3]
    if priors.up is not None:
        pitch = np.arcsin(np.clip(axes @ priors.up.up_in_world, -1, 1))
        measured = np.arcsin(np.clip(priors.up.up_in_camera[2], -1, 1))
        squared += (pitch - measured) ** 2 / (config.view_pitch**2 + priors.up.sigma**2)
    if priors.heading is not None:
        east, north = axes @ priors.heading.east_in_world, axes @ priors.heading.north_in_world
        turn = (np.arctan2(east, north) - priors.heading.radians + np.pi) % (2 * np.pi) - np.pi
        steep = np.hypot(east, north) < config.least_level
        squared += np.where(steep, 0.0, turn**2 / (config.view_turn**2 + priors.heading.sigma**2))
    if priors.position is not None:
        rows = priors.position.metres_from_world
        metres = (positions - priors.position.position_in_world) @ rows.T
        # Along each axis a unit has as many metres: the scale of a similarity.
        reach = config.view_way * reaches * float(np.linalg.norm(rows[0]))
        spread = priors.position.covariance + (reach**2)[:, None, None] * np.eye(len(rows))
        squared += (metres * np.linalg.solve(spread, metres[..., None])[..., 0]).sum(1)
    return np.exp(-0.5 * squared)


# ---------------------------------------------------------------------- photo and readings together


def with_readings(
    priors: ScenePriors | None, pose: Pose, covariance: Float64[np.ndarray, "6 6"]
) -> tuple[Pose, Float64[np.ndarray, "6 6"]]:
    """Return the pose by photo and readings together, and its covariance; readings that contradict are left out.

    `covariance` is that of the right twist by the photo alone.
    """
    used = [one for one in residuals(priors, pose) if not one.contradicts(covariance)]
    if not used:
        return pose, covariance
    information, pull = np.zeros((6, 6)), np.zeros(6)
    for one in used:
        weighted = np.linalg.solve(one.noise, one.jacobian).T
        information += weighted @ one.jacobian
        pull -= weighted @ one.value
    # C' = C (I + I_readings C)^-1: also where C is nearly singular.
    fused = covariance @ np.linalg.inv(np.eye(6) + information @ covariance)
    fused = 0.5 * (fused + fused.T)
    return moved(pose, fused @ pull), fused
