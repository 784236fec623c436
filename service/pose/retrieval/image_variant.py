"""The variants of a photo that a search compares with the index: its sizes and in-plane rotations."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64, Int64

from service.interfaces import Features
from service.pose.absolute_pose.device_priors import agreement
from service.pose.absolute_pose.prior_region import distance_outside
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.features.in_plane_rotation import rolls_to_upright
from service.pose.features.query_images import QueryImages
from service.pose.matching.correspondences import MATCH_ERROR_PX
from service.pose.retrieval.index import ViewIndex
from service.pose.retrieval.scores import SCORES, ScoreConfig, top_indices


@dataclass(frozen=True, slots=True)
class RetrievalConfig:
    """In which variants a photo is compared with the index."""

    scores: ScoreConfig = SCORES
    same_scale: float = 1.4
    """Ratio of the angles that a pixel of photo and views covers, which features tolerate; beyond it the photo is
    resized."""
    lens_views: int = 256
    """Views, at most, whose lenses are asked for that: at 4000, all take 9 ms."""
    min_photo_px: int = 160
    max_photo_px: int = 640
    """Bounds of that size (long side)."""
    max_rotations: int = 2
    """In-plane rotations that are compared, of those that the photo's corners suggest."""
    rotation_bias: float = 0.77
    """A rotation must have more than 1 / this times the score of the upright photo: rotated photos have 1.3 to 6 times
    the others' with the right rotation, upright ones at least 0.83."""
    upright_score: float = 1.5
    """Retrieval score from which on a view is like the photo as it is: of six scenes' clean photos the best one has 1.8
    and more, of those rotated by 90 degrees 1.3 at most."""
    least_level: float = 0.3
    """Share of up by gravity that lies in the image plane from which on it tells the photo's rotation."""
    least_agreement: float = 0.01
    """Of a view with the device's readings below which it isn't compared because of them: three standard deviations."""
    oblique_shrink: float = 0.8
    """Size of a photo rotated by an odd multiple of 45 degrees, which needs twice the canvas."""
    views_outside_prior: int = 16
    """Views nearest to a prior's region that are searched if fewer lie in it: they may see what is photographed."""


RETRIEVAL = RetrievalConfig()


@dataclass(frozen=True, slots=True)
class ImageVariant:
    """A size of the photo, and a rotation that makes it upright."""

    long_side: int
    """Pixels."""
    roll_steps_45deg: int = 0
    """Counter-clockwise."""

    def scaled(self, factor: float) -> ImageVariant:
        """Return the photo in another size."""
        return replace(self, long_side=round(factor * self.long_side))

    @property
    def max_error_px(self) -> float:
        """Reprojection error of an inlier, at PHOTO_PX: a smaller variant's features are less precise."""
        return MATCH_ERROR_PX * max(1.0, PHOTO_PX / self.long_side)


@dataclass(frozen=True, slots=True)
class Retrieval:
    """Compares the variants of one photo with the views of one index, each variant once."""

    images: QueryImages
    index: ViewIndex
    config: RetrievalConfig = RETRIEVAL
    _scores: dict[ImageVariant, Float64[np.ndarray, "views"]] = field(default_factory=dict, repr=False)
    _suggested: list[int] = field(default_factory=list, repr=False)
    """Rotations that the photo's corners suggest, in steps of 45 degrees; empty: not yet known."""

    def features(self, variant: ImageVariant) -> Features:
        """Return the variant's features, in pixels of `Query.rgb`."""
        shrink = self.config.oblique_shrink if variant.roll_steps_45deg % 2 else 1.0
        return self.images.features(round(variant.long_side * shrink), variant.roll_steps_45deg)

    def scores(self, variant: ImageVariant) -> Float64[np.ndarray, "views"]:
        """Return how much each view is like the photo; views far from its prior's region are below all others."""
        if variant not in self._scores:
            scores = self.index.scores(self.features(variant).descriptors, self.config.scores)
            self._scores[variant] = self._demoted_outside_prior(scores)
        return self._scores[variant]

    def upright_variant(self) -> ImageVariant:
        """Return the upright photo in the size at which a pixel covers the angle that it covers in the views.

        PHOTO_PX where the angles differ little, or the focal length is a guess.
        """
        query = self.images.query
        views = self.index.views
        lenses = [view.camera.intrinsics for view in views[:: -(-len(views) // self.config.lens_views)]]
        # Focal lengths relative to the long side: the angle of a pixel at equal sizes.
        of_views = float(np.median([max(lens.fx, lens.fy) / lens.long_side for lens in lenses]))
        factor = of_views * query.intrinsics.long_side / max(query.intrinsics.fx, query.intrinsics.fy)
        # Resizing costs detail, and a guessed focal length may be off by more than the tolerance.
        if 1 / self.config.same_scale < factor < self.config.same_scale or query.intrinsics_source == "guessed":
            return ImageVariant(PHOTO_PX)
        return ImageVariant(int(np.clip(PHOTO_PX * factor, self.config.min_photo_px, self.config.max_photo_px)))

    def rotated_variant(self, upright: ImageVariant, *, likeliest_only: bool = False) -> ImageVariant:
        """Return the rotation that the photo's corners suggest, if its scores exceed those of the upright photo.

        `likeliest_only`: the rotation that most corners suggest, and none if that is upright.
        """
        by_gravity = self.roll_by_gravity()
        if not self._suggested:
            self._suggested.extend(rolls_to_upright(self.images.corners(), self.index.corners))
        suggested = self._suggested[:1] if likeliest_only else self._suggested
        # Beside those of the corners: the reading may be wrong.
        suggested = suggested if by_gravity is None else list(dict.fromkeys([by_gravity, *suggested]))
        best, most = upright, 0.0
        # Extracting the features of a rotation is costly, so only the likeliest are compared.
        most_rotations = self.config.max_rotations + (by_gravity is not None)
        for steps in [steps for steps in suggested if steps][:most_rotations]:
            rotated = replace(upright, roll_steps_45deg=steps)
            score = self.config.rotation_bias * self.scores(rotated).max()
            if score > max(most, self.scores(upright).max()):
                best, most = rotated, score
        return best

    def is_upright(self, variant: ImageVariant) -> bool:
        """Return whether some view is so much like the variant that no other rotation has to be compared."""
        return bool(self.scores(variant).max() >= self.config.upright_score)

    def ranked(
        self,
        variant: ImageVariant,
        count: int,
        *,
        support: Float64[np.ndarray, "views"] | float = 0.0,
        only_agreeing: bool = False,
    ) -> Int64[np.ndarray, "k"]:
        """Return the views most like the variant, best first; `support` is added to their scores.

        Of a photo with readings of the device those come first, `count` of them, whose scores are best with the weight
        that their agreement with the readings gives them, then the others of the `count` best, unless it is
        `only_agreeing`: the readings may be wrong.
        """
        scores, weights = self.scores(variant) + support, self._agreement()
        best = top_indices(scores, count)
        if weights is None:
            return best
        agree = weights >= self.config.least_agreement
        first = top_indices(np.where(agree, weights * scores, -np.inf), min(count, int(agree.sum())))
        return first if only_agreeing else np.concatenate([first, best[~np.isin(best, first)]])

    def roll_by_gravity(self) -> int | None:
        """Return the rotation that makes the photo upright by gravity, in counter-clockwise steps of 45 degrees; None
        where gravity wasn't measured, or the camera looked nearly straight up or down."""
        priors = self.images.query.scene_priors
        if priors is None or priors.up is None:
            return None
        x, y, _ = priors.up.up_in_camera
        if np.hypot(x, y) < self.config.least_level:
            return None
        return round(np.degrees(np.arctan2(x, -y)) / 45) % 8

    def _agreement(self) -> Float64[np.ndarray, "views"] | None:
        """Return how well the views agree with the device's readings, 0 to 1; None: it has none."""
        priors, views = self.images.query.scene_priors, self.index.views
        if priors is None:
            return None
        poses = np.stack([view.camera.pose.world_from_camera for view in views])
        # A sample is enough for a median; a view without points sees nothing.
        away = [np.linalg.norm(v.points_in_world[::8] - v.camera.pose.position_in_world, axis=1) for v in views]
        return agreement(priors, poses, np.array([np.median(d) if len(d) else 0.0 for d in away]))

    def _demoted_outside_prior(self, scores: Float64[np.ndarray, "views"]) -> Float64[np.ndarray, "views"]:
        region = self.images.query.region
        if region is None:
            return scores
        away = np.array([distance_outside(region, view.camera.pose) for view in self.index.views])
        # Views in the region have a distance of 0, so at least those are within reach.
        reach = np.sort(away)[min(self.config.views_outside_prior, len(away)) - 1]
        return np.where(away <= reach, scores, min(0.0, float(scores.min())))
