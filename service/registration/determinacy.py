"""What the observations determine of a similarity, and why they don't determine the rest.

The spectrum of the normal matrix decides: with a wide prior, the standard deviations of scale, up, heading and position
must be small. Its derivatives are taken at positions without the spread that is mere noise: a line of photos must not
seem to determine a rotation about itself by the noise of their positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from service.registration.observations import Evidence
from service.registration.registration import PARTS, Part
from service.registration.similarity_fit import PARAMETERS, Fit, fit_similarity


@dataclass(frozen=True, slots=True)
class DeterminacyConfig:
    """Standard deviations below which a part counts as determined, and those of the wide prior."""

    log_scale: float = 0.25
    rotation: float = 0.26
    """rad: 15 degrees, up to which the linear covariance means something."""
    prior_rotation: float = 6.0
    prior_log_scale: float = 3.0
    prior_position: float = 1e3
    """In spreads of the observations."""


DETERMINACY = DeterminacyConfig()
_ROUNDING = 1e-9


def determined(
    fit: Fit, evidence: Evidence, used: Sequence[int], config: DeterminacyConfig = DETERMINACY
) -> tuple[tuple[Part, ...], str, Float64[np.ndarray, "7 7"]]:
    """Return the parts that are determined, the reason where some aren't (empty if all are), and the covariance of the
    fit's parameters, that of the wide prior in what isn't determined."""
    axes = principal_extents(fit, evidence, used)
    information = _information_without_noise(fit, evidence, used)
    stated = [o.position_covariance for o in evidence.observations if o.position_covariance is not None]
    noise = float(np.sqrt(np.max([np.trace(c) for c in stated]))) if stated else fit.noise.position_sigma
    spread = max(axes[0] * fit.similarity.scale, noise, 1e-12)
    prior = np.array(
        [*3 * [config.prior_rotation], *3 * [config.prior_position * spread], config.prior_log_scale], np.float64
    )
    # Scaled by the prior, the matrix is well conditioned: nothing is lost by its inverse.
    covariance = np.linalg.inv(information * np.outer(prior, prior) + np.eye(PARAMETERS)) * np.outer(prior, prior)
    if evidence.metres_per_unit is not None:
        # A scale that was given has no uncertainty, whatever the prior says.
        covariance[6], covariance[:, 6] = 0.0, 0.0
    parts: list[Part] = []
    if np.sqrt(covariance[6, 6]) < config.log_scale:
        parts.append("scale")
    up = np.array(evidence.up if evidence.up else (0.0, 0.0, 1.0))
    across = np.eye(3) - np.outer(up, up)
    tilt = across @ covariance[:3, :3] @ across
    tilt_sigma = float(np.sqrt(np.linalg.eigvalsh(tilt).max()))
    heading_sigma = float(np.sqrt(up @ covariance[:3, :3] @ up))
    # A heading is an angle about up: it means nothing where up is open.
    if tilt_sigma < config.rotation:
        parts.append("up")
        if heading_sigma < config.rotation:
            parts.append("heading")
    place_sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6]).max()))
    # Coordinates of a point follow from the place only with the scale and all of the rotation.
    if place_sigma < 0.01 * prior[3] and {"scale", "heading"} <= set(parts):
        parts.append("position")
    reason = "" if len(parts) == len(PARTS) else _reason(parts, axes, evidence, used, tilt_sigma, heading_sigma)
    return tuple(parts), reason, covariance


def principal_extents(fit: Fit, evidence: Evidence, used: Sequence[int]) -> Float64[np.ndarray, "3"]:
    """Return the spread (standard deviation, units) of the observations' positions along their principal axes, largest
    first, without that of noise."""
    return _denoised(fit, evidence, used)[1]


def _denoised(fit: Fit, evidence: Evidence, used: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions in the world without their noise, and their spread along principal axes."""
    numbers = [i for i in used if evidence.observations[i].position is not None]
    if not numbers:
        return np.zeros((0, 3)), np.zeros(3)
    places = np.array([evidence.observations[i].position_in_world for i in numbers])
    centre = places.mean(0)
    _, singular, vt = np.linalg.svd(places - centre)
    power = np.zeros(3)
    power[: len(singular)] = singular**2
    # Below: rounding of the positions themselves.
    power[power < len(places) * (_ROUNDING * np.abs(places).max()) ** 2] = 0.0
    noise = len(places) * _noise_variance(fit, evidence, numbers)
    left = np.maximum(power - noise, 0.0)
    shrink = np.sqrt(left / np.maximum(power, 1e-300))
    return (places - centre) @ vt.T @ np.diag(shrink) @ vt + centre, np.sqrt(left / len(places))


def _noise_variance(fit: Fit, evidence: Evidence, numbers: Sequence[int]) -> float:
    """Return the variance, in units, that the positions in the world may owe to noise.

    Where localization doesn't state it, all of the residuals' is assumed to be theirs if none is stated in the target.
    """
    scale, factor = fit.similarity.scale, fit.noise.factors["position"]
    each = []
    for i in numbers:
        seen = evidence.observations[i]
        own = float(np.trace(seen.world_covariance)) / 3
        unstated = (fit.noise.position_sigma * factor / scale) ** 2 if seen.position_covariance is None else 0.0
        each.append(max(own, unstated))
    return float(np.mean(each))


def _information_without_noise(fit: Fit, evidence: Evidence, used: Sequence[int]) -> Float64[np.ndarray, "7 7"]:
    places, _ = _denoised(fit, evidence, used)
    numbers = [i for i in used if evidence.observations[i].position is not None]
    observations = list(evidence.observations)
    for i, place in zip(numbers, places, strict=True):
        observations[i] = replace(observations[i], position_in_world=place)
    # One evaluation at the fit: nothing moves, since only its derivatives are wanted.
    return fit_similarity(
        replace(evidence, observations=observations), used, fit.similarity, fit.noise, estimate_noise=False, steps=0
    ).information


def _reason(
    parts: Sequence[Part],
    axes: np.ndarray,
    evidence: Evidence,
    used: Sequence[int],
    tilt_sigma: float,
    heading_sigma: float,
) -> str:
    placed = [i for i in used if evidence.observations[i].position is not None]
    missing = ", ".join(p for p in PARTS if p not in parts)
    if not placed:
        why = "no observation has a position in the target frame"
    elif axes[0] == 0:
        why = f"all {len(placed)} places coincide within their noise"
    elif axes[1] == 0 and "heading" not in parts:
        why = f"all {len(placed)} places lie on one line, about which the scene may turn"
    else:
        why = f"up is uncertain by {np.degrees(min(tilt_sigma, np.pi)):.0f} degrees"
        why += f", the heading by {np.degrees(min(heading_sigma, np.pi)):.0f}"
    return f"{missing} can't be determined: {why}."
