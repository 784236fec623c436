"""The registration of a scene from evidence: consensus, least squares, and what of it is determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from service.errors import RegistrationFailed
from service.geometry import so3_exp
from service.registration.consensus import agreeing, free_parameters, umeyama
from service.registration.determinacy import determined
from service.registration.observations import Evidence, Observation
from service.registration.quantiles import chi_square_quantile, f_quantile
from service.registration.registration import Registration, Residual
from service.registration.similarity_fit import KINDS, Fit, Kind, Noise, Similarity, is_stated, observation_rows

_REGION = 0.95
_TURNED = 0.3
"""rad: with larger differences of the rotations, the photos are tried turned."""
_MIRRORED = 0.2
"""A reflection that leaves less than this share of the residuals: the coordinates are left-handed."""


def register(evidence: Evidence, rng: np.random.Generator) -> Registration:
    """Return the scene's registration: what the evidence determines of it, with covariance and residuals.

    Raises RegistrationFailed where it determines nothing, contradicts itself or is in a left-handed frame.
    """
    _check(evidence)
    try:
        evidence, quarter_turns, (fit, used) = _as_turned(evidence, rng)
    except np.linalg.LinAlgError:
        raise RegistrationFailed("the numbers are too far apart to be computed with.", where="registration") from None
    _require_right_handed(evidence, fit, used)
    parts, reason, covariance = determined(fit, evidence, used)
    if not parts:
        raise RegistrationFailed(
            reason, where="registration", hint="Add places elsewhere, photos with poses, a length, or what is up."
        )
    return Registration(
        target_from_world=fit.similarity.matrix,
        centre_in_world=fit.similarity.centre_in_world,
        covariance=covariance * _small_sample_factor(fit, evidence, used),
        determined=parts,
        reason=reason,
        residuals=tuple(_residual(o, i in set(used), fit.similarity) for i, o in enumerate(evidence.observations)),
        up_in_target=evidence.up,
        noise=_noise(fit, evidence),
        warnings=_warnings(evidence, used, reason, quarter_turns),
    )


def _as_turned(evidence: Evidence, rng: np.random.Generator) -> tuple[Evidence, int, tuple[Fit, list[int]]]:
    """Return evidence and fit with the photos turned as fits best: by no or several quarter turns clockwise."""
    best = evidence, 0, agreeing(evidence, rng)
    # Each turn costs a whole fit, and most files need none.
    if not evidence.may_be_turned or _turn_error(best[2][0]) < _TURNED:
        return best
    for quarter_turns in (1, 2, 3):
        angle = quarter_turns * np.pi / 2
        # About the optical axis: the photo was turned, not the camera moved.
        turn = so3_exp(np.array([0.0, 0.0, -angle]))
        seen = [
            o if o.target_from_camera is None else replace(o, target_from_camera=o.target_from_camera @ turn)
            for o in evidence.observations
        ]
        tried = replace(evidence, observations=seen)
        found = tried, quarter_turns, agreeing(tried, rng)
        if _turn_error(found[2][0]) < _turn_error(best[2][0]):
            best = found
    return best


def _turn_error(fit: Fit) -> float:
    """Return the mean angle in rad between the rotations that are given and those of the fit."""
    angles = [float(np.linalg.norm(row.residual)) for row in fit.rows if row.kind == "rotation"]
    return float(np.mean(angles)) if angles else 0.0


def _check(evidence: Evidence) -> None:
    seen = evidence.observations
    if not (seen or evidence.directions or evidence.lengths or evidence.heights):
        raise RegistrationFailed("there are no places to register by.", where="registration")
    for observation in seen:
        numbers = [v for v in (observation.position_in_world, observation.position) if v is not None]
        if not all(np.all(np.isfinite(v)) for v in numbers):
            raise RegistrationFailed("a place must consist of finite numbers.", where=observation.name)
    for length in evidence.lengths:
        if not (length.units > 0 and length.metres > 0):
            raise RegistrationFailed("a length must be positive, between two different points.", where="lengths")


def _require_right_handed(evidence: Evidence, fit: Fit, used: Sequence[int]) -> None:
    """Raise RegistrationFailed if a reflection fits the positions far better than any rotation."""
    seen = [o for o in evidence.observations if o.position is not None]
    # With fewer a reflection may fit as well by chance: points near a plane are their own mirror images.
    if len(seen) < 5:
        return
    world, target = np.array([o.position_in_world for o in seen]), np.array([o.position for o in seen])
    mirrored = umeyama(world, target, mirrored=True)
    left = [_distance(o, mirrored) for o in seen]
    right = [_distance(o, fit.similarity) for o in seen]
    spread = float(np.sqrt(((target - target.mean(0)) ** 2).sum(1).mean()))
    # All of them: a few outliers, which a reflection can't explain, must not hide it, nor cause it.
    if np.max(left) < _MIRRORED * np.max(right) and np.max(left) < 0.1 * spread and len(used) < len(seen):
        raise RegistrationFailed(
            "the coordinates are mirrored: a reflection fits them, no rotation does.",
            where="registration",
            hint="Give them in a right-handed frame: swap two axes, or negate one.",
        )


def _distance(seen: Observation, similarity: Similarity) -> float:
    assert seen.position is not None
    arm = similarity.scale * similarity.rotation @ (seen.position_in_world - similarity.centre_in_world)
    return float(np.linalg.norm(arm + similarity.shift - seen.position))


def _small_sample_factor(fit: Fit, evidence: Evidence, used: Sequence[int]) -> float:
    """Return by how much the covariance grows because noise was estimated: F's 95 % region over the normal's."""
    observations = [evidence.observations[i] for i in used]
    unsure: list[Kind] = [
        k for k in KINDS if fit.of_kind(k).any() and (not is_stated(k, observations) or fit.noise.factors[k] > 1)
    ]
    if not unsure:
        return 1.0
    # A normal distribution's region is too small where the noise was estimated from few residuals.
    unknowns = free_parameters(evidence)
    # Each kind's variance is estimated by itself: the one that is known worst counts.
    freedom = max(min(fit.redundancy(kind) for kind in unsure), 1.0)
    return unknowns * f_quantile(_REGION, unknowns, freedom) / chi_square_quantile(_REGION, unknowns)


def _noise(fit: Fit, evidence: Evidence) -> dict[str, float]:
    found = {}
    if fit.of_kind("position").any() and not is_stated("position", evidence.observations):
        found["position"] = fit.noise.position_sigma * fit.noise.factors["position"]
    if fit.of_kind("rotation").any() and not is_stated("rotation", evidence.observations):
        found["rotation"] = fit.noise.rotation_sigma * fit.noise.factors["rotation"]
    return found


def _residual(seen: Observation, used: bool, similarity: Similarity) -> Residual:
    rows = {row.kind: row.residual for row in observation_rows(seen, 0, similarity, Noise(1.0))}
    angle = rows.get("rotation", rows.get("heading"))
    return Residual(
        seen.name,
        used,
        float(np.linalg.norm(rows["position"])) if "position" in rows else None,
        float(np.degrees(np.linalg.norm(angle))) if angle is not None else None,
    )


def _warnings(evidence: Evidence, used: Sequence[int], reason: str, quarter_turns: int) -> tuple[str, ...]:
    found = [reason] if reason else []
    if quarter_turns:
        found.append(f"the photos are taken to be turned by {90 * quarter_turns} degrees clockwise from their poses.")
    placed = [i for i in used if evidence.observations[i].position is not None]
    if not is_stated("position", evidence.observations) and 0 < len(placed) < 4:
        found.append("with fewer than four places none can be found to be wrong.")
    return tuple(found)
