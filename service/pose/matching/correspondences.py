"""Correspondences between a photo and scene points, by matching its features with those of a rendered view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from service.interfaces import Features, Matcher
from service.pose.features.rendered_views import View

MATCH_ERROR_PX = 4.0
"""Reprojection error of an inlier, at most, at PHOTO_PX; XFeat's points scatter by 1.5 px."""


@dataclass(frozen=True, slots=True)
class Correspondences:
    """Matches between the photo and a view, most certain first, with the scene points behind them."""

    photo_px: Float32[np.ndarray, "m 2"]
    """In pixels of `Query.rgb`."""
    view_px: Float32[np.ndarray, "m 2"]
    points_in_world: Float32[np.ndarray, "m 3"]

    @classmethod
    def pooled(cls, parts: Sequence[Correspondences]) -> Correspondences:
        """Put the matches with several views together, by their rank; `view_px` then refers to none of the views."""
        # PROSAC draws from the front, where each view's best matches should be.
        by_rank = np.argsort(np.concatenate([np.arange(len(part.photo_px)) for part in parts]), kind="stable")
        return cls(
            np.concatenate([part.photo_px for part in parts])[by_rank],
            np.concatenate([part.view_px for part in parts])[by_rank],
            np.concatenate([part.points_in_world for part in parts])[by_rank],
        )


def correspondences(photo: Features, view: View, matcher: Matcher) -> Correspondences:
    """Match the photo's features with a view's."""
    pairs = matcher.match(photo, view.features)
    a, b = pairs[:, 0], pairs[:, 1]
    return Correspondences(photo.points_px[a], view.features.points_px[b], view.points_in_world[b])
