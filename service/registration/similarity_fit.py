"""Generalized least squares of a similarity from observations, directions, lengths and heights.

    position in the target = scale * rotation @ (x_in_world - centre) + shift

Steps and covariance are of (rotation vector in rad and shift in metres along the target's axes, log of the scale), the
rotation vector acting on the left. Noise that isn't stated is estimated by kind, positions, rotations and headings
apart, by the variance components of Foerstner (1979): weighted squares over redundancy. Stated noise is only ever
enlarged, where the residuals contradict it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64

from service.geometry import hat, so3_exp, so3_log
from service.registration.observations import Evidence, Observation
from service.types import frozen

PARAMETERS = 7
Kind = Literal["position", "rotation", "heading", "other"]
KINDS: tuple[Kind, ...] = ("position", "rotation", "heading")
_SHARE_OF_SPREAD = 0.01
"""Noise of positions, relative to their spread, from which the estimate of an unknown one starts."""
_STEPS = 40
_NO_HAT = np.zeros((0, 0))
_DAMPING = 1e-9
"""Relative to the diagonal: keeps what is undetermined where it was."""


@dataclass(frozen=True, slots=True)
class Similarity:
    """A similarity about a centre; see the module."""

    rotation: Float64[np.ndarray, "3 3"]
    scale: float
    shift: Float64[np.ndarray, "3"]
    centre_in_world: Float64[np.ndarray, "3"]

    def __post_init__(self) -> None:
        for name in ("rotation", "shift", "centre_in_world"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64))

    @property
    def matrix(self) -> Float64[np.ndarray, "4 4"]:
        """target_from_world, on homogeneous coordinates."""
        result = np.eye(4)
        result[:3, :3] = self.scale * self.rotation
        result[:3, 3] = self.shift - result[:3, :3] @ self.centre_in_world
        return result

    def about(self, centre_in_world: Float64[np.ndarray, "3"]) -> Similarity:
        """Return the same similarity with another centre."""
        shift = self.shift + self.scale * self.rotation @ (centre_in_world - self.centre_in_world)
        return replace(self, shift=shift, centre_in_world=centre_in_world)

    def moved(self, step: Float64[np.ndarray, "7"]) -> Similarity:
        """Return the similarity after a step of the parameters; see the module for their order."""
        return replace(
            self,
            rotation=so3_exp(step[:3]) @ self.rotation,
            # By the logarithm, so that the scale stays positive; clipped, as a bad step would overflow.
            scale=float(self.scale * np.exp(np.clip(step[6], -1.0, 1.0))),
            shift=self.shift + step[3:6],
        )


@dataclass(frozen=True, slots=True)
class Noise:
    """Factors of the standard deviations by kind, and the deviations that stand for those that aren't stated."""

    position_sigma: float
    """Metres, of positions whose noise isn't stated."""
    rotation_sigma: float = 0.02
    """rad, likewise."""
    factors: dict[Kind, float] = field(default_factory=lambda: dict.fromkeys(KINDS, 1.0))


@dataclass(frozen=True, slots=True)
class Row:
    """One block of residuals with its derivative and covariance."""

    kind: Kind
    owner: int
    """Number of the observation; -1: of no observation."""
    residual: Float64[np.ndarray, "k"]
    jacobian: Float64[np.ndarray, "k 7"]
    covariance: Float64[np.ndarray, "k k"]
    localized_share: float = 0.0
    """Of the covariance, what localization states: the rest may be estimated."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A similarity with what is needed to judge it."""

    similarity: Similarity
    noise: Noise
    rows: tuple[Row, ...]
    whitened: Float64[np.ndarray, "m"]
    """Residuals over their standard deviations, uncorrelated if the model holds; block by block as `rows`."""
    jacobian: Float64[np.ndarray, "m 7"]
    """Whitened likewise."""
    lower: Float64[np.ndarray, "m m"]
    """Cholesky factor of the residuals' covariance, which whitens them."""
    hat: Float64[np.ndarray, "h h"]
    """Projection onto the columns of `jacobian`; empty before the minimum is reached."""

    @property
    def information(self) -> Float64[np.ndarray, "7 7"]:
        """The normal matrix of the parameters, J^T cov^-1 J."""
        return self.jacobian.T @ self.jacobian

    @property
    def cost(self) -> float:
        """The sum of squares of the whitened residuals."""
        return float(self.whitened @ self.whitened)

    def redundancy(self, kind: Kind) -> float:
        """Return how many of a kind's residuals are left over for its noise: their number less the trace of the hat
        matrix.
        """
        mine = self.of_kind(kind)
        return float(mine.sum() - np.trace(self.hat[np.ix_(mine, mine)]))

    def of_kind(self, kind: Kind) -> np.ndarray:
        """Return which of the whitened residuals are of a kind."""
        return np.concatenate(
            [np.full(len(row.residual), row.kind == kind) for row in self.rows] or [np.zeros(0, bool)]
        )


def fit_similarity(
    evidence: Evidence,
    used: Sequence[int],
    start: Similarity,
    noise: Noise,
    *,
    estimate_noise: bool = True,
    steps: int = _STEPS,
) -> Fit:
    """Return the least squares fit to the observations `used` and all of the rest (Levenberg-Marquardt from a start).

    With `steps` of 0 it is only evaluated there.
    """
    if used:
        # About their middle rotation and shift are nearly independent, and the steps well conditioned.
        start = start.about(np.mean([evidence.observations[i].position_in_world for i in used], axis=0))
    fit = _minimize(evidence, used, start, noise, steps)
    # The fit depends on the weights and these on its residuals: both are repeated until neither changes.
    for _ in range(5 if estimate_noise else 0):
        noise, change = _with_estimated_noise(fit, evidence, used)
        if change < 1e-3:
            break
        fit = _minimize(evidence, used, fit.similarity, noise, steps)
    return fit


def unknown_noise(observations: Sequence[Observation]) -> Noise:
    """Return where the estimate of noise starts."""
    places = np.array([o.position for o in observations if o.position is not None]).reshape(-1, 3)
    spread = float(np.sqrt(((places - places.mean(0)) ** 2).sum(1).mean())) if len(places) else 1.0
    return Noise(max(_SHARE_OF_SPREAD * spread, 1e-9))


def is_stated(kind: Kind, observations: Sequence[Observation]) -> bool:
    """Whether the noise of a kind is known for all observations that have it."""
    if kind == "position":
        return all(o.position_covariance is not None for o in observations if o.position is not None)
    if kind == "rotation":
        return all(o.rotation_sigma is not None for o in observations if o.target_from_camera is not None)
    return True


def _minimize(evidence: Evidence, used: Sequence[int], similarity: Similarity, noise: Noise, steps: int) -> Fit:
    fit = _evaluated(evidence, used, similarity, noise)
    damping = _DAMPING
    free = _free(evidence)
    for _ in range(steps):
        normal, gradient = fit.information[np.ix_(free, free)], (fit.jacobian.T @ fit.whitened)[free]
        step = np.zeros(PARAMETERS)
        # A little of the trace, too: a parameter that nothing determines has no diagonal of its own.
        ridge = damping * np.diag(np.diag(normal) + 1e-9 * np.trace(normal) + 1e-300)
        step[free] = -np.linalg.lstsq(normal + ridge, gradient, rcond=1e-14)[0]
        proposed = _evaluated(evidence, used, fit.similarity.moved(step), noise)
        # At the minimum a step changes the cost by rounding only.
        if proposed.cost <= fit.cost * (1 + 1e-12):
            gain, fit = fit.cost - proposed.cost, proposed
            damping = max(damping / 10, _DAMPING)
            if gain <= 1e-10 * (1 + fit.cost):
                break
        else:
            damping = max(10 * damping, 1e-4)
            if damping > 1e6:
                break
    # Not at each step: it costs more than the step.
    projection = fit.jacobian @ np.linalg.pinv(fit.jacobian, rcond=1e-12) if len(fit.jacobian) else _NO_HAT
    return replace(fit, hat=projection)


def _free(evidence: Evidence) -> list[int]:
    return list(range(6 if evidence.metres_per_unit is not None else 7))


def _evaluated(evidence: Evidence, used: Sequence[int], similarity: Similarity, noise: Noise) -> Fit:
    rows = list(_rows(evidence, used, similarity, noise))
    size = sum(len(row.residual) for row in rows)
    residual = np.concatenate([row.residual for row in rows]) if rows else np.zeros(0)
    jacobian = np.concatenate([row.jacobian for row in rows]) if rows else np.zeros((0, PARAMETERS))
    jacobian = jacobian * np.isin(np.arange(PARAMETERS), _free(evidence))
    covariance = _drift_covariance(rows, evidence, used, noise, size)
    at = 0
    for row in rows:
        end = at + len(row.residual)
        covariance[at:end, at:end] += row.covariance
        at = end
    # Drift correlates the observations, so they are whitened together, not one by one.
    lower = np.linalg.cholesky(covariance) if size else covariance
    whitened, white_jacobian = np.linalg.solve(lower, residual), np.linalg.solve(lower, jacobian)
    return Fit(similarity, noise, tuple(rows), whitened, white_jacobian, lower, _NO_HAT)


def _rows(evidence: Evidence, used: Sequence[int], similarity: Similarity, noise: Noise):
    for number in used:
        yield from observation_rows(evidence.observations[number], number, similarity, noise)
    rotation, scale = similarity.rotation, similarity.scale
    for direction in evidence.directions:
        turned = rotation @ direction.in_world
        # Two axes across the direction; from its far side the residual must not vanish, so it has the angle's length.
        across = np.linalg.svd(direction.in_target[None])[2][1:]
        sine = across @ turned
        cosine = float(direction.in_target @ turned)
        length = float(np.linalg.norm(sine))
        stretch = np.arctan2(length, cosine) / length if length > 1e-9 else 1.0
        jacobian = np.concatenate([-across @ hat(turned), np.zeros((2, 4))], 1)
        yield Row("other", -1, sine * stretch, jacobian, direction.sigma**2 * np.eye(2))
    for length in evidence.lengths:
        relative = length.sigma / length.metres
        # In the logarithm, in which the scale is a parameter, a length is linear.
        error = np.array([np.log(scale * length.units / length.metres)])
        yield Row("other", -1, error, np.eye(PARAMETERS)[6:], np.array([[relative**2]]))
    for height in evidence.heights:
        up = np.array(evidence.up if evidence.up else (0.0, 0.0, 1.0))
        arm = scale * rotation @ (height.in_world - similarity.centre_in_world)
        error = np.array([up @ (arm + similarity.shift) - height.metres])
        jacobian = np.concatenate([np.cross(arm, up), up, [up @ arm]])[None]
        yield Row("other", -1, error, jacobian, np.array([[height.sigma**2]]))


def observation_rows(seen: Observation, number: int, similarity: Similarity, noise: Noise):
    """Yield the blocks of one observation: position, rotation, heading, as far as it has them."""
    rotation, scale = similarity.rotation, similarity.scale
    if seen.position is not None:
        arm = scale * rotation @ (seen.position_in_world - similarity.centre_in_world)
        stated = seen.position_covariance
        target = noise.position_sigma**2 * np.eye(3) if stated is None else stated
        covariance = target * noise.factors["position"] ** 2
        # Localization's own uncertainty is in scene units and axes.
        own = scale**2 * rotation @ seen.world_covariance @ rotation.T
        jacobian = np.concatenate([-hat(arm), np.eye(3), arm[:, None]], 1)
        error = arm + similarity.shift - seen.position
        yield Row("position", number, error, jacobian, covariance + own, _share(own, covariance))
    if seen.world_from_camera is None:
        return
    turned = rotation @ seen.world_from_camera
    if seen.target_from_camera is not None:
        sigma = (seen.rotation_sigma or noise.rotation_sigma) * noise.factors["rotation"]
        error = so3_log(turned @ seen.target_from_camera.T)
        jacobian = np.concatenate([np.eye(3), np.zeros((3, 4))], 1)
        covariance, own = sigma**2 * np.eye(3), turned @ seen.turn_covariance @ turned.T
        yield Row("rotation", number, error, jacobian, covariance + own, _share(own, covariance))
    if seen.heading is not None:
        x, y, _ = turned[:, 2]
        # A camera that looks straight up or down has no azimuth to divide by.
        level = max(float(np.hypot(x, y)), 1e-3)
        error = (np.arctan2(x, y) - seen.heading + np.pi) % (2 * np.pi) - np.pi
        gradient = np.array([y, -x, 0.0]) / level**2
        jacobian = np.concatenate([np.cross(turned[:, 2], gradient), np.zeros(4)])[None]
        # The nearer to straight up or down, the less its azimuth means.
        sigma = seen.heading_sigma * noise.factors["heading"] / level
        yield Row("heading", number, np.array([error]), jacobian, np.array([[sigma**2]]))


def _share(own: Float64[np.ndarray, "3 3"], other: Float64[np.ndarray, "3 3"]) -> float:
    return float(np.trace(own) / (np.trace(own) + np.trace(other)))


def _drift_covariance(
    rows: Sequence[Row], evidence: Evidence, used: Sequence[int], noise: Noise, size: int
) -> Float64[np.ndarray, "m m"]:
    """Return the covariance of residuals by drift: a random walk along the path, of positions and of rotations.

    Its standard deviation at the end of a path of length L is `drift * L`; that of rotations is the one by which a
    constant rate of turning would displace the end as far: sqrt(3) * drift.
    """
    result = np.zeros((size, size))
    if not evidence.drift or len(used) < 2:
        return result
    places = np.array([p for i in used if (p := evidence.observations[i].position) is not None])
    if len(places) != len(used):
        return result
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    along = dict(zip(used, path, strict=True))
    length = max(float(path[-1]), 1e-12)
    deviations = {"position": evidence.drift * length, "rotation": np.sqrt(3) * evidence.drift}
    starts = np.cumsum([0, *(len(row.residual) for row in rows)])
    for kind, deviation in deviations.items():
        mine = [(start, along[row.owner]) for start, row in zip(starts, rows, strict=False) if row.kind == kind]
        if not mine:
            continue
        variance = (deviation * noise.factors[kind]) ** 2  # type: ignore[index]
        # Of a random walk two places share the drift up to the nearer one.
        shared = variance * np.minimum.outer([at for _, at in mine], [at for _, at in mine]) / length
        index = np.add.outer([start for start, _ in mine], np.arange(3))
        for axis in range(3):
            result[np.ix_(index[:, axis], index[:, axis])] += shared
    return result


def _with_estimated_noise(fit: Fit, evidence: Evidence, used: Sequence[int]) -> tuple[Noise, float]:
    observations = [evidence.observations[i] for i in used]
    factors, change = dict(fit.noise.factors), 0.0
    for kind in KINDS:
        redundancy = fit.redundancy(kind)
        if redundancy < 0.5:  # as many unknowns as numbers: they say nothing of the noise
            continue
        mine = fit.of_kind(kind)
        estimate = factors[kind] * float(np.sqrt(fit.whitened[mine] @ fit.whitened[mine] / redundancy))
        # Stated noise may prove too small, but a lucky fit makes nothing more exact than it is stated.
        estimate = max(estimate, 1.0 if is_stated(kind, observations) else 1e-9)
        change = max(change, abs(np.log(estimate / factors[kind])))
        factors[kind] = estimate
    return replace(fit.noise, factors=factors), float(change)
