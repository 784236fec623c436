"""The verification gate for several photos of a rig at one pose: each is measured by itself, the evidence is combined.

The wrong matches of different cameras don't agree with one pose of a rig. So matches count more than for a photo by
itself, and how much of it is hidden counts less: a photo *agrees* where many fresh matches with a render at its pose
agree with the pose that all photos gave, and colours agree where gradients do; it *contradicts* where the matches agree
and the colours don't, as for one of a row of like things seen one further; else it *can't tell*: it may be hidden. The
rig is accepted if several photos agree, more than contradict, and no other pose of the rig has nearly as many matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from service.pose.verification.appearance import LOCAL_COLOUR
from service.pose.verification.gate import VERIFICATION, VerificationConfig
from service.pose.verification.precision import AskedBounds, probability_within
from service.results import Reason, Status, Verdict


@dataclass(frozen=True, slots=True)
class RigGateConfig:
    """Set by hand: right poses of rigs of the test scenes and wrong ones are far apart. See docs/results/rigs.md."""

    min_inliers: int = 25
    min_share: float = 0.2
    """Fresh matches that agree, and their share, of a photo that agrees: photos at right poses, two thirds hidden, have
    65 and 0.3 and more; at wrong ones 20 and 0.1 at most."""
    min_colour: float = 0.97
    """Local colour correlation of a photo that agrees; with less its matches contradict."""
    least_place: float = 0.6
    """Probability of the right place by a photo that agrees, at least: the model takes what is hidden for wrong."""
    min_agreeing: int = 2
    min_total_inliers: int = 80
    max_rival_share: float = 0.5
    """Matches of another pose of the rig, relative to those of the answer, from which on it is ambiguous."""


RIG_GATE = RigGateConfig()


def rig_verdict(
    photos: Sequence[Verdict],
    covariance: Float64[np.ndarray, "6 6"] | None,
    asked: AskedBounds,
    rival_share: float,
    config: RigGateConfig = RIG_GATE,
    gate: VerificationConfig = VERIFICATION,
) -> Verdict:
    """Return the verdict on a rig's pose from those on its photos there.

    `covariance` is of the pose of the camera that the verdict is on, from all photos; `asked` are the bounds
    there. `rival_share`: matches that agree with another pose of the rig, relative to those that agree with this one.
    """
    agree = [one for one in photos if _matches(one, config) and one.signals[LOCAL_COLOUR] >= config.min_colour]
    contradict = [one for one in photos if _matches(one, config) and one.signals[LOCAL_COLOUR] < config.min_colour]
    total = sum(one.inliers for one in photos)
    # As if each photo that agrees were evidence by itself: by the model, without its floors.
    alone = [max(gate.model.probability(one.signals), config.least_place) for one in agree]
    place = 1.0 - float(np.prod([1.0 - one for one in alone]))
    precise = 0.0 if covariance is None else probability_within(covariance, asked.deg, asked.units)
    reason = Reason.VERIFIED
    if len(agree) < config.min_agreeing or total < config.min_total_inliers:
        reason = Reason.FEW_INLIERS if total else Reason.NO_MATCHING_VIEW
        place = min(place, gate.doubtful_score)
    elif len(contradict) >= len(agree):
        reason, place = Reason.RENDER_MISMATCH, min(place, gate.doubtful_score)
    elif rival_share > config.max_rival_share:
        reason, place = Reason.AMBIGUOUS, min(place, gate.doubtful_score)
    elif precise < gate.min_precise:
        reason = Reason.POSITION_UNCERTAIN
    status = Status.LOCALIZED if reason is Reason.VERIFIED else Status.UNCERTAIN
    if not agree or covariance is None:
        status = Status.NOT_LOCALIZED
    signals = {"agreeing": len(agree), "contradicting": len(contradict), "rival_share": rival_share}
    return replace(
        photos[0], status=status, reason=reason, score=place * precise, inliers=total, covariance=covariance,
        signals={name: float(value) for name, value in signals.items()}, right_place=place, precise=precise,
        asked=(asked.deg, asked.units), intrinsics_untested=False, fitting_correction=None, shutter_motion=None,
    )  # fmt: skip


def _matches(photo: Verdict, config: RigGateConfig) -> bool:
    signals = photo.signals
    return signals.get("inliers", 0.0) >= config.min_inliers and signals["inlier_share"] >= config.min_share
