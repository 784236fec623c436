"""The numbers of a scene: an origin near its Gaussians where coordinates are large, and a near plane of its size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from service.scene_formats.gaussians import RawGaussians


@dataclass(frozen=True, slots=True)
class NumbersConfig:
    """When coordinates are moved, and which sizes of a scene are usual."""

    far: float = 200.0
    """Distance of the scene's middle from the origin, in its radii: float32 then holds 1e-5 radii, which a refined
    pose resolves."""
    near: float = 0.01
    """Units: gsplat's near plane, of scenes of a usual size."""
    smallest: float = 0.1
    largest: float = 100.0
    """Radii in units of usual scenes: beyond them the near plane grows and shrinks with the radius."""
    sampled: int = 100_000
    """Gaussians from which middle and radius are computed."""


NUMBERS = NumbersConfig()


@dataclass(frozen=True, slots=True)
class Extent:
    """Where a scene is, and how large."""

    middle: Float64[np.ndarray, "3"]
    """Median of the opaque Gaussians' means along each axis."""
    radius: float
    """Median of their distances from it."""


def extent_of(raw: RawGaussians, config: NumbersConfig = NUMBERS) -> Extent:
    """Return middle and radius of the Gaussians; of all of them if none is opaque."""
    step = max(1, len(raw.means) // config.sampled)
    means, opaque = raw.means[::step].astype(np.float64), raw.opacities[::step] > 0.5
    means = means[opaque] if opaque.any() else means
    middle = np.median(means, axis=0)
    return Extent(middle, float(np.median(np.linalg.norm(means - middle, axis=1))))


def origin_for(extent: Extent, config: NumbersConfig = NUMBERS) -> tuple[float, float, float]:
    """Return the origin that the scene's coordinates should be relative to: zero unless they are far from it.

    Gaussians in one place have no size that rounding could be compared with: they stay.
    """
    if extent.radius == 0 or np.linalg.norm(extent.middle) <= config.far * extent.radius:
        return 0.0, 0.0, 0.0
    x, y, z = (float(v) for v in extent.middle)
    return x, y, z


def near_plane_for(extent: Extent, config: NumbersConfig = NUMBERS) -> float:
    """Return the near plane in units."""
    usual = float(np.clip(extent.radius, config.smallest, config.largest))
    return config.near * extent.radius / usual if extent.radius > 0 else config.near


def recentred(raw: RawGaussians, origin: tuple[float, float, float]) -> RawGaussians:
    """Return the Gaussians relative to the origin, as float32; subtracted in float64."""
    if any(origin):
        return replace(raw, means=(raw.means.astype(np.float64) - origin).astype(np.float32))
    return replace(raw, means=raw.means.astype(np.float32, copy=False))
