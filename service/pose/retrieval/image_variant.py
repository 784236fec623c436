"""How a photo is looked at in a search: in which size, and turned by how much; and which views look like it then."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from service.interfaces import Features, Tools
from service.pose.absolute_pose.prior_region import distance_outside
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.features.in_plane_rotation import turns_to_upright
from service.pose.features.views import images_of, photo_features
from service.pose.matching.correspondences import MATCH_ERROR_PX
from service.pose.retrieval.index import ViewIndex
from service.types import Query

GLIMPSE_SHARE = 0.77
"""Of the photo's size, enough to recognise a whole, sharp one in half the time: each of the 58 clean test photos has 75
or more matches that agree with its likeliest view, where foreign ones have 12."""
SECOND_LOOK = 1.25
"""A photo that isn't found at once is looked at in a size larger by this."""
SAME_SCALE = 1.4
"""Features stand this factor between the photo's pixels and the views' (in rad); beyond it the photo is resized."""
SCALES_PX = (160, 640)
GLANCE_PX = 256
"""Of the photo, enough to see whether it could be elsewhere."""
TURNS = 2
"""That are looked at, of those that the photo's corners may mean."""
TURN_BIAS = 0.77
"""On turned photos the right turn has 1.3 to 6 times the votes of the others, on upright ones at least 0.83."""
ODD_SHRINK = 0.8
"""A photo turned by an eighth needs twice the canvas."""
NEAREST = 16
"""Views that are searched of those outside a prior's region: what is photographed inside may be seen from there."""


@dataclass(frozen=True, slots=True)
class Sight:
    """How the photo is looked at in a search."""

    long_side: int
    eighths: int = 0
    """Of a turn, counter-clockwise, that make it upright."""

    def sized(self, share: float) -> Sight:
        """Return the photo in another size."""
        return replace(self, long_side=round(share * self.long_side))

    def features(self, query: Query, tools: Tools) -> Features:
        """Return the photo's features, looked at like this, in pixels of `Query.rgb`."""
        shrink = ODD_SHRINK if self.eighths % 2 else 1.0
        return photo_features(query, tools, round(self.long_side * shrink), self.eighths)

    def votes(self, query: Query, tools: Tools) -> Float64[np.ndarray, "views"]:
        """Return how much each view is like the photo, looked at like this; those far from its region are last."""
        key = ("votes", self.long_side, self.eighths)
        if key not in tools.memo:
            votes = tools.prepared.votes(self.features(query, tools).descriptors)
            tools.memo[key] = _within_reach(votes, query, tools.prepared)
        return tools.memo[key]

    @property
    def max_error_px(self) -> float:
        """At PHOTO_PX."""
        return MATCH_ERROR_PX * max(1.0, PHOTO_PX / self.long_side)


def first_sight(query: Query, tools: Tools) -> Sight:
    """Return the photo upright, in the size in which its details are as large as the views'."""
    # Views that the scene itself placed stand as near as its detail asks for, whatever their lens.
    return Sight(_same_scale_px(query, tools.prepared) if tools.scene.cameras else PHOTO_PX)


def turned_sight(upright: Sight, query: Query, tools: Tools) -> Sight:
    """Return the photo upright, or turned as its corners say, if the views' votes agree."""
    found = images_of(query, tools).corners()
    best, most = upright, 0.0
    for eighths in [turn for turn in turns_to_upright(found, tools.prepared.corners) if turn][:TURNS]:
        turned = replace(upright, eighths=eighths)
        votes = TURN_BIAS * turned.votes(query, tools).max()
        if votes > max(most, upright.votes(query, tools).max()):
            best, most = turned, votes
    return best


def _same_scale_px(query: Query, index: ViewIndex) -> int:
    """Return the photo's size at which a pixel covers the angle that it covers in the views, if that matters."""
    lenses = [view.camera.intrinsics for view in index.views]
    of_views = float(np.median([max(lens.fx, lens.fy) / lens.long_side for lens in lenses]))
    factor = of_views * query.intrinsics.long_side / max(query.intrinsics.fx, query.intrinsics.fy)
    if 1 / SAME_SCALE < factor < SAME_SCALE or query.intrinsics_source == "guessed":
        return PHOTO_PX
    return int(np.clip(PHOTO_PX * factor, *SCALES_PX))


def _within_reach(votes: Float64[np.ndarray, "views"], query: Query, index: ViewIndex) -> Float64[np.ndarray, "views"]:
    """Return the views' votes, those of views that are far from the photo's region put below all others."""
    if query.region is None:
        return votes
    away = np.array([distance_outside(query.region, view.camera.pose) for view in index.views])
    reach = np.sort(away)[min(NEAREST, len(away)) - 1]
    return np.where(away <= reach, votes, min(0.0, float(votes.min())))
