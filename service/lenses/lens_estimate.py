"""The estimate of a lens from photos that were localized, one after the other.

A lens has a focal length, a distortion and a principal point about which those of its photos scatter: autofocus and
stabilization move it. Its estimate is updated as by a Kalman filter of constant state,

    gain = V / (V + R + Q),   mean += gain * (measured - mean),   V *= 1 - gain

with V the variance of the estimate, R that of the photo's measurement, Q that of the photos about the lens; components
are independent of each other. The next photo's prior has variance V + Q.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from service.geometry import pose_distance
from service.types import Pose

Components = tuple[float, float, float, float]
"""Of a lens: the logarithm of the focal length over the image's long side; k1 of COLMAP's SIMPLE_RADIAL; the principal
point's distance from the image's centre, right and down, in long sides. Of the image as the camera stores it."""


@dataclass(frozen=True, slots=True)
class LensMemoryConfig:
    """What is learnt from a photo, and how much."""

    min_score: float = 0.95
    """Of a localized answer that is learnt from."""
    max_focal_sigma: float = 0.015
    """Of the photo's own evidence, beyond the prior's: with more the photo doesn't determine the focal length."""
    photo_sigma: Components = (0.007, 0.003, 0.005, 0.005)
    """Standard deviations of photos about their lens: a phone's focal length moves by about 1 % within a session."""
    min_share: float = 1 / 16
    """Least share of Q that V falls to: later photos keep a weight, so that a lens may change."""
    outlier_sigmas: float = 4.0
    """Of focal length or distortion, from which on a photo contradicts the estimate."""
    min_viewpoints: int = 2
    """Before that the prior is `untested`: what one view suggests, another one may not confirm."""
    untested_factor: float = 2.0
    untested_sigma: Components = (0.03, 0.02, 0.01, 0.01)
    """The least standard deviations of an untested prior."""
    new_view_deg: float = 5.0
    new_view_share: float = 0.05
    """A viewpoint is another one after such a rotation, or such a way (share of the distance to what is seen)."""


LENS_MEMORY = LensMemoryConfig()


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """Where a photo was taken."""

    scene_sha256: str
    pose: Pose
    distance: float
    """To what is seen there, in scene units; infinite where it is unknown."""

    def differs(self, other: Viewpoint, config: LensMemoryConfig = LENS_MEMORY) -> bool:
        """Whether photos from both see a scene from different places, so that their errors are not the same."""
        if self.scene_sha256 != other.scene_sha256:
            return True
        turn_deg, way = pose_distance(self.pose, other.pose)
        return turn_deg > config.new_view_deg or way > config.new_view_share * min(self.distance, other.distance)


@dataclass(frozen=True, slots=True)
class LensMeasurement:
    """The estimate of a lens from one photo alone, without the prior that the photo was localized with."""

    value: Components
    sigma: Components
    """Standard deviations; infinite where nothing was measured."""
    viewpoint: Viewpoint


@dataclass(frozen=True, slots=True)
class LensEstimate:
    """The estimate of a lens from all its photos so far."""

    mean: Components
    sigma: Components
    """Of the mean."""
    photos: int
    """That were learnt from."""
    viewpoints: int
    """That agreed, since the last contradiction."""
    viewpoint: Viewpoint
    """Of the last photo that was learnt from."""

    def is_tested(self, config: LensMemoryConfig = LENS_MEMORY) -> bool:
        """Whether enough viewpoints agreed for a tight prior."""
        return self.viewpoints >= config.min_viewpoints

    def prior_sigma(self, config: LensMemoryConfig = LENS_MEMORY) -> Components:
        """Return the standard deviations of the next photo's lens about the mean."""
        sigma = np.hypot(self.sigma, config.photo_sigma)
        if not self.is_tested(config):
            sigma = np.maximum(config.untested_factor * sigma, config.untested_sigma)
        return _components(sigma)


def updated(
    estimate: LensEstimate | None, found: LensMeasurement, config: LensMemoryConfig = LENS_MEMORY
) -> LensEstimate:
    """Return the estimate after another photo.

    A photo from the last one's viewpoint changes nothing: its errors are the same, and would look like certainty. One
    that contradicts is not averaged: the contradicted components become as uncertain as the contradiction is large, so
    that the next photo decides, and the estimate has to be tested again.
    """
    noise = np.hypot(found.sigma, config.photo_sigma)
    if estimate is None:
        # An infinite variance would make the next gain infinity over infinity; 1 is far beyond any lens.
        return LensEstimate(found.value, _components(np.minimum(noise, 1.0)), 1, 1, found.viewpoint)
    if not found.viewpoint.differs(estimate.viewpoint, config):
        return estimate
    mean, sigma = np.array(estimate.mean), np.array(estimate.sigma)
    innovation = np.array(found.value) - mean
    off = np.abs(innovation) > config.outlier_sigmas * np.hypot(sigma, noise)
    photos = estimate.photos + 1
    # The principal point alone is no contradiction: its prior is wide, and few poses depend on it.
    if off[:2].any():
        widened = _components(np.where(off, np.hypot(sigma, innovation), sigma))
        return replace(estimate, sigma=widened, photos=photos, viewpoints=0, viewpoint=found.viewpoint)
    gain = sigma**2 / (sigma**2 + noise**2)
    least = config.min_share**0.5 * np.array(config.photo_sigma)
    # Where nothing was measured the gain is 0, but infinity times 0 is not.
    step = np.where(gain > 0, gain * innovation, 0.0)
    return LensEstimate(
        _components(mean + step),
        _components(np.maximum(sigma * np.sqrt(1 - gain), np.minimum(least, sigma))),
        photos,
        estimate.viewpoints + 1,
        found.viewpoint,
    )


def _components(values: Float64[np.ndarray, "4"]) -> Components:
    log_focal, k1, shift_x, shift_y = map(float, values)
    return log_focal, k1, shift_x, shift_y
