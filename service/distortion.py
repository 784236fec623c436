"""Radial distortion of COLMAP's camera models, and that of a camera whose intrinsics were corrected.

Distortions map a ray's radius r = |(x, y)| / z to that of its pixel, |pixel - principal point| / focal length.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

_REACH = 1.25
"""Radius up to which distortions are fitted, over that of the image's corner: a photo's corner, distorted, may show a
ray further out."""
_SAMPLES = 256


def radial_radius(r: Float64[np.ndarray, "n"], k: Float64[np.ndarray, "8"]) -> Float64[np.ndarray, "n"]:
    """Return the distorted radius of the rational model (COLMAP's FULL_OPENCV) without its tangential terms."""
    r2 = r * r
    return r * (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))


def fisheye_radius(r: Float64[np.ndarray, "n"], k: Float64[np.ndarray, "4"]) -> Float64[np.ndarray, "n"]:
    """Return the distorted radius of the equidistant model (COLMAP's OPENCV_FISHEYE)."""
    theta = np.arctan(r)
    t2 = theta * theta
    return theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))


def composed(
    model: str, distortion: tuple[float, ...], focal_factor: float, k1: float, corner_radius: float
) -> tuple[str, tuple[float, ...]]:
    """Return model and parameters of the distortion r -> D(s r (1 + k1 r^2)) / s, where D is the given one.

    That is what a photo has, in units of its corrected focal length, if pixels from which D was removed have the focal
    length corrected by the factor s and the distortion `k1`. A fisheye's parameters, and the first two of models that
    have them, are fitted by least squares up to the radius of the image's corner, `corner_radius`; the one of a
    SIMPLE_RADIAL is right to first order. Any fisheye becomes an OPENCV_FISHEYE, for with another focal length it is no
    longer one of fewer parameters.
    """
    is_fisheye = "FISHEYE" in model
    if len(distortion) == 1 and not is_fisheye:
        return model, (distortion[0] * focal_factor**2 + k1,)
    given = np.zeros(4 if is_fisheye else 8)
    given[: len(distortion)] = distortion
    r = np.linspace(0.0, _REACH * corner_radius, _SAMPLES + 1)[1:]
    inner = focal_factor * r * (1 + k1 * r * r)
    with np.errstate(all="ignore"):
        target = (fisheye_radius if is_fisheye else radial_radius)(inner, given) / focal_factor
        # Beyond the radius at which it stops growing the image isn't used.
        usable = np.isfinite(target) & (np.diff(target, prepend=0.0) > 0) & (np.diff(inner, prepend=0.0) > 0)
    # Up to the first radius that is not: beyond it the model may grow again.
    usable = np.logical_and.accumulate(usable)
    r, target = r[usable], target[usable]
    if is_fisheye:
        theta = np.arctan(r)
        return "OPENCV_FISHEYE", tuple(_fitted(theta, target - theta, 4).tolist())
    # Each coefficient belongs to a power of the radius, which the factor scales.
    scaled = given * focal_factor ** np.array([2, 4, 1, 1, 6, 2, 4, 6])
    held = scaled.copy()
    held[:2] = 0.0
    r2 = r * r
    denominator = 1 + r2 * (scaled[5] + r2 * (scaled[6] + r2 * scaled[7]))
    scaled[:2] = _fitted(r, (target - radial_radius(r, held)) * denominator, 2)
    return model, tuple(scaled[: len(distortion)].tolist())


def _fitted(
    radius: Float64[np.ndarray, "n"], values: Float64[np.ndarray, "n"], count: int
) -> Float64[np.ndarray, "count"]:
    """Return the coefficients of radius^3, radius^5, ... whose sum is nearest to the values."""
    powers = radius[:, None] ** (3 + 2 * np.arange(count))
    return np.linalg.lstsq(powers, values, rcond=None)[0]
