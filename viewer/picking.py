"""Which point of a scene a click hits. Pure numpy."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from viewer.service_values import Splats

_NEAR_SIGMAS = 3.0
"""Splats whose centre is further from the ray, in their largest standard deviations, don't count."""
_SURFACE = 0.5
"""Transmittance at which the surface lies, as in the depth that the service renders."""


def first_surface(
    origin: Float64[np.ndarray, "3"], direction: Float64[np.ndarray, "3"], splats: Splats
) -> Float64[np.ndarray, "3"] | None:
    """Return where a ray has lost half of its light to the splats; None if it passes.

    Each splat counts by its opacity at the point of the ray at which it is densest, from the nearest to the furthest.
    """
    direction = direction / np.linalg.norm(direction)
    offsets = splats.centres - origin
    along = offsets @ direction
    across = np.linalg.norm(offsets - along[:, None] * direction, axis=1)
    # The trace bounds the largest eigenvalue of a covariance.
    sigma = np.sqrt(splats.covariances[:, [0, 3, 5]].sum(1))
    near = np.flatnonzero((along > 0) & (across < _NEAR_SIGMAS * sigma))
    if not len(near):
        return None
    covariances = splats.covariances[near][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3).astype(np.float64)
    floor = 1e-6 * np.trace(covariances, axis1=1, axis2=2)  # flat splats have next to no thickness
    inverse = np.linalg.inv(covariances + floor[:, None, None] * np.eye(3))
    to_ray = inverse @ direction
    along_ray = np.einsum("ni,ni->n", to_ray, offsets[near]) / (to_ray @ direction)
    missed = offsets[near] - along_ray[:, None] * direction
    density = np.exp(-0.5 * np.einsum("ni,nij,nj->n", missed, inverse, missed))
    alpha = np.clip(splats.rgba[near, 3] / 255 * density, 0, 0.999)
    order = np.argsort(along_ray, kind="stable")
    passed = np.cumprod(1 - alpha[order])
    if passed[-1] > _SURFACE:
        return None
    return origin + along_ray[order[np.argmax(passed <= _SURFACE)]] * direction
