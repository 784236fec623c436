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


MIRROR = MirrorConfig()


def may_be_mirrored(signals: Mapping[str, float], config: MirrorConfig = MIRROR) -> bool:
    """Return whether a pose with these signals leaves room for the photo to be mirrored."""
    return signals["gradients"] <= config.beyond_doubt


def dissimilarity(signals: Mapping[str, float]) -> float:
    """Return how unlike photo and render are by their appearance signals, 0 (alike) and more."""
    return sum(1.0 - signals[name] for name in (*GLOBAL_SIGNALS, LOCAL_COLOUR))
