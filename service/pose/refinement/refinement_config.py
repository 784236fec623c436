"""Tuning constants of photometric refinement and of its uncertainty. Intensities are 0..1 unless stated otherwise."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from service.pose.features.rendered_views import VIEWS
from service.types import LensPrior


@dataclass(frozen=True, slots=True)
class PyramidConfig:
    """How photo and render are made comparable, and into pyramids."""

    blur_sigma_px: float = 0.7
    """Gaussian blur of both at each level: renders are softer than photos."""
    min_alpha: float = VIEWS.min_alpha
    """Pixels of the render with less show no surface."""
    edge_px: int = 2
    """Reach of an occluding edge on both sides; 0: each pixel has its own depth."""
    edge_jump: float = 0.06
    """Relative change of depth that makes an edge; a surface at 80 degrees from its normal has 0.02 over two pixels."""
    max_depth_ratio: float = 1.1
    """Of four pixels that are averaged into one of the next level; beyond it that has no depth."""
    saturated: int = 252
    """Photo values (0..255) from which on a channel counts as clipped."""
    saturated_share: float = 0.005
    """Of all values of a photo, from which on the render is clipped like the photo."""
    exposure_block_px: int = 16
    """Side of the blocks whose means give the exposure between photo and render."""
    min_exposed: float = 0.05
    """Darker blocks of either have no part in the exposure: a black rim is no measurement."""
    max_exposed: float = 0.9
    """Brighter blocks of the photo neither: they may be clipped."""


@dataclass(frozen=True, slots=True)
class LocalLightConfig:
    """How light that differs within the photo is taken out of photo and render (`evened_light`)."""

    window_share: float = 0.0625
    """Standard deviation of the Gaussian window, as a share of the long side."""
    min_contrast: float = 0.02
    """Added to the standard deviation in the window: flat parts stay flat, whatever their noise."""
    contrast: float = 0.1
    """Standard deviation in the window afterwards; about that of usual photos, whose residuals the values here are of.
    """


@dataclass(frozen=True, slots=True)
class UncertaintyConfig:
    """How residuals become a covariance; fitted on the photos of chair, materials and studio."""

    cell_px: int = 16
    """Side of the cells over which scores are summed: neighbouring residuals are correlated."""
    cuts: int = 4
    """Directions, within a right angle, of the cross that cuts the image into quarters; twice as many cuts."""
    ridge: float = 1e-3
    """Share of the hessian that removing a quarter leaves in any case, so that the rest can be solved."""
    min_variance_scale: float = 0.12
    """Lower bound of the variance scale: a photo whose quarters happen to agree isn't more exact than the model. With
    it the 68 and 95 % ellipsoids of photos and crops with exact intrinsics (nine scenes) hold 71 and 92 % of 79 errors.
    """


@dataclass(frozen=True, slots=True)
class LensErrorConfig:
    """Errors of estimated intrinsics by a scene's model and cameras, which no residual of one photo shows.

    By how far estimates are off whose photos' calibration is known, beyond what their scatter explains.
    """

    log_focal: float = 0.003
    k1: float = 0.006
    principal_point: float = 0.004
    """In focal lengths (rad): an enlarged crop shows the model's errors enlarged. The pose turns along; in
    forward-facing scenes by 0.2 to 0.4 degrees."""
    crop_scale: float = 0.15
    """Standard deviation of the principal point of a photo that may have been cropped off centre, in long sides."""


@dataclass(frozen=True, slots=True)
class LensTestConfig:
    """When intrinsics that were given as exact are tested, and when they are contradicted."""

    log_focal_scale: float = 0.3
    k1_sigma: float = 0.15
    principal_point_scale: float = 0.05
    """Of the prior while they are free: wide, for wrong ones may be off by any amount."""
    suspicious_loss: float = 0.03
    """Mean absolute residual (0..1) from which on matches are asked, too: most right answers with the right intrinsics
    have less."""
    suspicious_loss_ratio: float = 0.98
    """Residual that is left with other intrinsics, up to which matches are asked, too, where these move the pose: of 58
    right answers with the right ones one has less."""
    contradicting_deg: float = 1.25
    contradicting_share: float = 0.0025
    """Motion of the pose beyond which wrong intrinsics matter: about half of what counts as right where the scene is
    two to three times as far away as its training cameras' focus."""
    max_loss_ratio: float = 0.96
    """Residual that is left, at most, if the given intrinsics are wrong..."""
    max_loss_ratio_with_matches: float = 0.99
    """...and if the pixels agree with matches that contradict them."""
    untestable_share: float = 0.005
    """Standard deviation of the position with free intrinsics, as a share of the median depth, from which on the photo
    doesn't tell whether the given ones are right..."""
    untested: LensPrior = field(default_factory=lambda: LensPrior(0.01, 0.01, 0.005))
    """...and how certain they are then."""
    max_steps: int = 24
    settled_px: float = 0.1
    max_pixels: int = 2000
    """Of that refinement."""
    min_cost_drop: float = 6.5
    """Of matches (`LensEvidence`): from which on they contradict the intrinsics. Of 14 answers with the right ones it
    is 4.5 at most, of 41 with wrong ones that put the pose off by more than the limit of what is right 7.5 at least."""
    min_cost_drop_alone: float = 13.0
    """The same where the pixels fit no better with free intrinsics: in poor models right answers have 7.2 at most, and
    one with a wrong focal length 13.4."""

    @property
    def prior(self) -> LensPrior:
        """The prior while the intrinsics are free."""
        return LensPrior(self.log_focal_scale, self.k1_sigma, self.principal_point_scale)


@dataclass(frozen=True, slots=True)
class ShutterConfig:
    """When a photo shows that the camera was turning while it was taken."""

    min_motion: float = 0.004
    """Shear or stretch, normalized units by normalized units..."""
    min_sigmas: float = 2.15
    """...and in standard deviations."""
    uncertainty_factor: float = 2.5
    """Standard deviation of the pose, times the motion that one step predicts, which is less than the whole."""


@dataclass(frozen=True, slots=True)
class RefinementConfig:
    """Gauss-Newton on each level of the pyramid."""

    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    uncertainty: UncertaintyConfig = field(default_factory=UncertaintyConfig)
    shutter: ShutterConfig = field(default_factory=ShutterConfig)
    lens_error: LensErrorConfig = field(default_factory=LensErrorConfig)
    lens_test: LensTestConfig = field(default_factory=LensTestConfig)
    local_light: LocalLightConfig | None = None
    """Take out light that differs within the photo first; None: compare intensities, which is more exact in the same
    light."""
    weighting: Literal["l1", "least_squares"] = "l1"
    """IRLS weights 1 / max(|r|, l1_floor), or the same weight 1 / l1_floor for all."""
    l1_floor: float = 0.02
    """Residuals below it are noise, and weigh like least squares."""
    cutoff_medians: float = 9.0
    """Residual, in median absolute residuals, at which Tukey's weight reaches 0; infinite: no cut-off. With a third of
    the photo hidden it halves the median error, and on clean photos of poor models, too; blurred ones lose a little."""
    min_median: float = 0.01
    """Lower bound of that median."""
    estimate_photometric: bool = True
    """Whether gain, bias, gamma and blur are estimated with the pose."""
    max_steps: int = 12
    """Gauss-Newton steps on a level."""
    max_pixels: int = 8_000
    """A level with more uses every second, third...: 6000 were as exact as 30000 on the test scenes..."""
    max_pixels_intrinsics: int = 12_000
    """...but for the focal length."""
    min_pixels: int = 200
    """Fewest pixels, of a level and of its overlap with the photo, that are refined on."""
    settled_px: float = 0.005
    """A step that moves the image by less (pixels of the level) is the last, on the finest level..."""
    settled_coarse_px: float = 0.05
    """...and on those that a finer one, or another refinement, follows."""
    correlated_pixels: float = 50.0
    """Neighbouring residuals err together: so many count as one observation against the prior on the intrinsics."""


REFINEMENT = RefinementConfig()
OTHER_LIGHT = replace(REFINEMENT, local_light=LocalLightConfig())
"""For a photo in other light than the scene's."""
