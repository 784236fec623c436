"""Judging whether a photo is mirrored: front cameras mirror, and the mirror image of a symmetric thing looks like it.

The residual alone does not show it: of 26 mirrored photos of the test scenes `chair` and `materials` the gate's local
colour correlation refuses all but one, without saying why. But their mirror images fit better still. So where a scene
is like its mirror image, the photo is localized both ways, unless it fits beyond doubt.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from service.pose.verification.appearance import GLOBAL_SIGNALS, LOCAL_COLOUR


@dataclass(frozen=True, slots=True)
class MirrorConfig:
    """When a photo's mirror image is localized, too."""

    beyond_doubt: float = 0.99
    """Correlation of gradients that no mirrored photo reaches (0.985 seen), but of others, degraded ones too, 79 % on
    chair and 56 % on materials do."""
    max_loss_ratio: float = 2.0
    """Times the answer's residual, after one refinement: of mirrored photos the mirror image has 0.6 to 1.6, of half of
    the others more than 3."""
    same_place: float = 2.0
    """Distance between the two positions, relative to that of what is seen, up to which both show the same place, which
    is like its own mirror image: an object has 2 at most, from opposite sides."""
    max_ratio_elsewhere: float = 0.25
    """Dissimilarity of the mirror image relative to the answer's, below which it fits better though it shows another
    place. Many buildings have rooms that are mirror images of others: in one of 12 million Gaussians photos have 0.29
    and more, since their own room is not modelled best, and few photos are mirrored."""


MIRROR = MirrorConfig()


def may_be_mirrored(signals: Mapping[str, float], config: MirrorConfig = MIRROR) -> bool:
    """Return whether a pose with these signals leaves room for the photo to be mirrored."""
    return signals["gradients"] <= config.beyond_doubt


def dissimilarity(signals: Mapping[str, float]) -> float:
    """Return how unlike photo and render are by their appearance signals, 0 (alike) and more."""
    return sum(1.0 - signals[name] for name in (*GLOBAL_SIGNALS, LOCAL_COLOUR))
