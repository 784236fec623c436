"""Which observations agree: a start by least trimmed squares over minimal samples, then a test of each observation.

Minimal samples are three positions (Umeyama 1991), or one pose and a second position, or, where up is known, two
positions. The sample whose best half fits best is refined on that half (Rousseeuw and van Driessen 2006). From there
the set of agreeing observations is the largest of which none is an outlier against the others: its residual, left out
of the fit, is F-distributed. Fits with few observations so keep honest thresholds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float64

from service.geometry import hat, so3_exp
from service.registration.observations import Evidence, Observation
from service.registration.quantiles import f_quantile
from service.registration.similarity_fit import (
    KINDS,
    PARAMETERS,
    Fit,
    Noise,
    Similarity,
    fit_similarity,
    is_stated,
    observation_rows,
    unknown_noise,
)


@dataclass(frozen=True, slots=True)
class ConsensusConfig:
    """How many samples are tried, and when an observation is an outlier."""

    samples: int = 200
    """Minimal samples, at most; all of them where there are fewer."""
    refined: int = 4
    """The best samples, which are refined on their best halves."""
    false_rejection: float = 0.001
    """Probability of calling any observation an outlier where there is none."""
    masked: float = 30.0
    """Ratio of the variance of all to that of the best half above which several outliers hide one another."""


CONSENSUS = ConsensusConfig()


def agreeing(
    evidence: Evidence, rng: np.random.Generator, config: ConsensusConfig = CONSENSUS
) -> tuple[Fit, list[int]]:
    """Return the fit to the largest set of observations without an outlier, and their numbers; see the module.

    Needs at least one observation or direction.
    """
    count, noise = len(evidence.observations), unknown_noise(evidence.observations)
    half = count if count < 4 else max((count + 3) // 2, min(count - 1, 4))
    starts = list(_starts(evidence, rng, config))
    trimmed = [_trimmed(evidence, start, noise, half) for start in starts]
    refined = [_concentrated(evidence, starts[i], noise, half) for i in np.argsort(trimmed)[: config.refined]]
    core = min(refined, key=lambda fit: fit.cost)
    if count < 4:
        everyone = list(range(count))
        return fit_similarity(evidence, everyone, core.similarity, noise), everyone
    order = np.argsort(_distances(evidence, core.similarity, noise), kind="stable").tolist()
    # Half: as long as most observations are right, those that agree best are.
    core = fit_similarity(evidence, sorted(order[:half]), core.similarity, noise)
    core_variance = max(_variance(core), _floor(evidence))
    # From all downwards: the largest set without an outlier wastes no right observation.
    for size in range(count, half, -1):
        used = sorted(order[:size])
        fit = fit_similarity(evidence, used, core.similarity, noise)
        if _variance(fit) <= config.masked * core_variance and not _outliers(fit, evidence, used, config):
            return fit, used
    return core, sorted(order[:half])


def _distances(evidence: Evidence, similarity: Similarity, noise: Noise) -> Float64[np.ndarray, "n"]:
    """Return each observation's squared residual over its covariance."""
    total = []
    for number, seen in enumerate(evidence.observations):
        rows = observation_rows(seen, number, similarity, noise)
        total.append(sum(float(r.residual @ np.linalg.solve(r.covariance, r.residual)) for r in rows))
    return np.array(total)


def _trimmed(evidence: Evidence, similarity: Similarity, noise: Noise, half: int) -> float:
    return float(np.sort(_distances(evidence, similarity, noise))[:half].sum())


def _concentrated(evidence: Evidence, start: Similarity, noise: Noise, half: int) -> Fit:
    """Fit to the best half, and again to the half that then is best, until that stays."""
    chosen = _best(evidence, start, noise, half)
    # As in fast LTS: the trimmed sum never grows, and a few rounds settle it.
    for _ in range(4):
        start = fit_similarity(evidence, chosen, start, noise, estimate_noise=False).similarity
        before, chosen = chosen, _best(evidence, start, noise, half)
        if chosen == before:
            break
    return fit_similarity(evidence, chosen, start, noise, estimate_noise=False)


def _best(evidence: Evidence, similarity: Similarity, noise: Noise, half: int) -> list[int]:
    """Return the observations with the smallest residuals, in their own order."""
    return sorted(np.argsort(_distances(evidence, similarity, noise), kind="stable")[:half].tolist())


def _floor(evidence: Evidence) -> float:
    """Return the least variance of whitened residuals that means anything: 1 where all noise is stated."""
    return float(all(is_stated(kind, evidence.observations) for kind in KINDS))


def _variance(fit: Fit) -> float:
    """Return the variance of the residuals relative to the noise that the fit began with."""
    # Over the rank, not over the number of parameters: some may be undetermined.
    redundancy = max(len(fit.whitened) - np.linalg.matrix_rank(fit.jacobian), 1)
    total = 0.0
    for kind in KINDS:
        mine = fit.of_kind(kind)
        total += fit.noise.factors[kind] ** 2 * float(fit.whitened[mine] @ fit.whitened[mine])
    return total / redundancy


def _outliers(fit: Fit, evidence: Evidence, used: Sequence[int], config: ConsensusConfig) -> list[int]:
    """Return the observations that the others contradict: externally studentized residuals, by kind.

    Of correlated residuals, too: the test of a shift of one observation's mean (Baarda 1968).
    """
    observations = [evidence.observations[i] for i in used]
    owners = np.concatenate([np.full(len(row.residual), row.owner) for row in fit.rows])
    shares = {(row.owner, row.kind): row.localized_share for row in fit.rows}
    inverse = np.linalg.inv(fit.lower)
    alone, weighted = inverse.T @ inverse, inverse.T @ fit.whitened
    weight = inverse.T @ (np.eye(len(fit.hat)) - fit.hat) @ inverse
    found = []
    for kind in KINDS:
        mine = fit.of_kind(kind)
        square, redundancy = float(fit.whitened[mine] @ fit.whitened[mine]), fit.redundancy(kind)
        for number in used:
            block = mine & (owners == number)
            size = int(block.sum())
            freedom = redundancy - size
            # Without it the others would have nothing left to judge it by.
            if not size or freedom < 0.9:
                continue
            # What the sum of squares loses if this observation may be anywhere.
            kept = weight[np.ix_(block, block)]
            if np.linalg.eigvalsh(kept).min() < 1e-9 * np.trace(alone[np.ix_(block, block)]):
                continue
            explained = float(weighted[block] @ np.linalg.solve(kept, weighted[block]))
            variance = max(square - explained, 0.0) / freedom
            limit = f_quantile(1 - config.false_rejection / len(used), size, freedom)
            # Noise that is stated, in the target or by localization, is there even where the others agree better.
            stated = 1 / fit.noise.factors[kind] ** 2 if is_stated(kind, observations) else shares[number, kind]
            if variance < stated:
                variance, limit = stated, f_quantile(1 - config.false_rejection / len(used), size, 1e7)
            if explained / size > limit * variance:
                found.append(number)
    return found


def _starts(evidence: Evidence, rng: np.random.Generator, config: ConsensusConfig) -> Iterator[Similarity]:
    """Yield similarities through minimal samples; at least one, that of everything there is."""
    seen = evidence.observations
    placed = [i for i, o in enumerate(seen) if o.position is not None]
    turned = [i for i, o in enumerate(seen) if o.target_from_camera is not None]
    starting = _of_all(evidence, placed, turned)
    yield starting
    fixed = evidence.metres_per_unit
    for i, j in _subsets(placed, 2, rng, config.samples):
        a, b = seen[i], seen[j]
        yield from (_scaled(_rotation(o), a, b, fixed) for o in (a, b) if o.target_from_camera is not None)
        if evidence.directions:
            yield _upright(evidence, a, b)
    if not turned:
        for triple in _subsets(placed, 3, rng, config.samples):
            yield umeyama(*_pairs(seen, triple), fixed)
    if evidence.directions:
        yield from (_facing(evidence, o, starting) for o in seen if o.heading is not None)
    # Rotations alone leave scale and place open: any will do to start from.
    for i in turned[: config.samples] if len(placed) < 2 else ():
        yield Similarity(_rotation(seen[i]), fixed or 1.0, np.zeros(3), np.zeros(3))


def _subsets(numbers: Sequence[int], size: int, rng: np.random.Generator, most: int) -> Iterator[tuple[int, ...]]:
    total = np.prod([len(numbers) - k for k in range(size)]) / (1, 1, 2, 6)[size]
    if total <= most:
        yield from combinations(numbers, size)
        return
    for _ in range(most):
        yield tuple(int(i) for i in rng.choice(numbers, size, replace=False))


def _pairs(seen: Sequence[Observation], numbers: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([seen[i].position_in_world for i in numbers]), np.array([seen[i].position for i in numbers])


def _of_all(evidence: Evidence, placed: Sequence[int], turned: Sequence[int]) -> Similarity:
    """Return a start from everything at once; where nothing determines a part, the scene's own axes and unit."""
    seen, fixed = evidence.observations, evidence.metres_per_unit
    metric = fixed or (evidence.lengths[0].metres / evidence.lengths[0].units if evidence.lengths else None)
    rotation = np.eye(3)
    if evidence.directions:
        rotation = turning(evidence.directions[0].in_world, evidence.directions[0].in_target)
    if turned:
        rotation = _mean_rotation([_rotation(seen[i]) for i in turned])
    if len(placed) >= 3 and not turned and not evidence.directions:
        return umeyama(*_pairs(seen, placed), metric)
    world, target = _pairs(seen, placed) if placed else (np.zeros((1, 3)), np.zeros((1, 3)))
    spread = np.sqrt(((world - world.mean(0)) ** 2).sum()), np.sqrt(((target - target.mean(0)) ** 2).sum())
    # Rotations cancel in the ratio of spreads, so the scale needs no rotation.
    scale = metric or (spread[1] / spread[0] if spread[0] > 1e-9 and spread[1] > 1e-9 else 1.0)
    return Similarity(rotation, float(scale), target.mean(0), world.mean(0))


def _rotation(seen: Observation) -> Float64[np.ndarray, "3 3"]:
    assert seen.target_from_camera is not None
    assert seen.world_from_camera is not None
    return seen.target_from_camera @ seen.world_from_camera.T


def _mean_rotation(rotations: Sequence[np.ndarray]) -> Float64[np.ndarray, "3 3"]:
    u, _, vt = np.linalg.svd(np.sum(rotations, axis=0))
    # The nearest orthogonal matrix may be a reflection, which the last sign undoes.
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _upright(evidence: Evidence, a: Observation, b: Observation) -> Similarity:
    """Return the similarity by a known direction, about which it turns one position onto another."""
    direction = evidence.directions[0]
    first, up = turning(direction.in_world, direction.in_target), direction.in_target
    assert a.position is not None
    assert b.position is not None
    # Both across the direction.
    level = np.eye(3) - np.outer(up, up)
    here, there = level @ first @ (b.position_in_world - a.position_in_world), level @ (b.position - a.position)
    angle = float(np.arctan2(up @ np.cross(here, there), here @ there))
    return _scaled(so3_exp(angle * up) @ first, a, b, evidence.metres_per_unit)


def _facing(evidence: Evidence, seen: Observation, similarity: Similarity) -> Similarity:
    """Return the similarity turned about a known direction so that a photo has its heading."""
    direction = evidence.directions[0]
    first = turning(direction.in_world, direction.in_target)
    assert seen.world_from_camera is not None
    assert seen.heading is not None
    x, y, _ = first @ seen.world_from_camera[:, 2]
    # Azimuths run clockwise, rotations the other way.
    return replace(similarity, rotation=so3_exp((np.arctan2(x, y) - seen.heading) * direction.in_target) @ first)


def _scaled(rotation: np.ndarray, a: Observation, b: Observation, fixed: float | None) -> Similarity:
    """Return the similarity by a rotation and two positions."""
    assert a.position is not None
    assert b.position is not None
    here = float(np.linalg.norm(a.position_in_world - b.position_in_world))
    scale = fixed or max(float(np.linalg.norm(a.position - b.position)), 1e-12) / max(here, 1e-12)
    centre, target = (a.position_in_world + b.position_in_world) / 2, (a.position + b.position) / 2
    return Similarity(rotation, scale, target, centre)


def turning(source: Float64[np.ndarray, "3"], target: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the smallest rotation that turns one unit vector to another."""
    cosine = float(source @ target)
    if cosine < -1 + 1e-9:  # opposite: half a turn about any axis across
        axis = np.linalg.svd(source[None])[2][1]
        return 2 * np.outer(axis, axis) - np.eye(3)
    cross = hat(np.cross(source, target))
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def umeyama(
    world: Float64[np.ndarray, "n 3"],
    target: Float64[np.ndarray, "n 3"],
    scale: float | None = None,
    *,
    mirrored: bool = False,
) -> Similarity:
    """Return the least squares similarity of points (Umeyama 1991), with a scale that may be given.

    `mirrored` returns the best one that reflects instead.
    """
    centre, shift = world.mean(0), target.mean(0)
    u, singular, vt = np.linalg.svd((target - shift).T @ (world - centre))
    wanted = -1.0 if mirrored else 1.0
    signs = np.array([1.0, 1.0, wanted * np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    power = float(((world - centre) ** 2).sum())
    found = float((signs * singular).sum() / power) if power > 1e-24 else 1.0
    return Similarity(u @ np.diag(signs) @ vt, scale or max(found, 1e-12), shift, centre)


def free_parameters(evidence: Evidence) -> int:
    """Return how many of the similarity's seven parameters are estimated: a given scale isn't."""
    return PARAMETERS - (evidence.metres_per_unit is not None)
