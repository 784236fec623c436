"""The viewer's colours, sRGB 0..255: of results, cameras, matches and scores, for a dark background."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from viewer.match_geometry import MatchView
from viewer.service_values import JobOutcome

RGB = tuple[int, int, int]
ColourBy = Literal["inlier", "residual"]

STATUS_COLOURS: dict[str, RGB] = {
    "localized": (60, 180, 90),
    "uncertain": (235, 165, 40),
    "not_localized": (215, 65, 65),
    "failed": (215, 65, 65),
    "cancelled": (140, 140, 140),
    "interrupted": (140, 140, 140),
}
PENDING_COLOUR: RGB = (40, 120, 200)
ERROR_COLOUR: RGB = (215, 65, 65)
INITIAL_COLOUR: RGB = (150, 150, 150)
CURRENT_COLOUR: RGB = (255, 140, 0)
TRUTH_COLOUR: RGB = (240, 240, 240)
COVERAGE_LEVELS: tuple[tuple[float, RGB, str], ...] = (
    (0.9, (47, 134, 224), "found: 90 % and more"),
    (0.7, (168, 212, 245), "usually found: 70 to 90 %"),
    (0.4, (242, 180, 92), "sometimes found: 40 to 70 %"),
    (0.0, (212, 90, 23), "rarely found: below 40 %"),
)
"""Of the coverage map: least probability, colour, words."""
BLIND_COLOUR: RGB = (90, 90, 90)
TRAINING_COLOUR: RGB = (70, 105, 160)

INLIER_COLOUR: RGB = (70, 225, 120)
OUTLIER_COLOUR: RGB = (240, 70, 70)
UNKNOWN_COLOUR: RGB = (150, 150, 150)
_RESIDUAL_PX = 0.5, 50.0
"""Ends of the scale of residuals, logarithmic between them."""
_RESIDUAL_SCALE = np.array([INLIER_COLOUR, (225, 225, 80), OUTLIER_COLOUR], np.float64)
# Dull blue to bright yellow, of strictly rising lightness: readable without hue.
_SCORE_SCALE = np.array([(72, 84, 150), (44, 130, 165), (60, 175, 150), (150, 205, 90), (255, 225, 60)], np.float64)


def outcome_colour(outcome: JobOutcome | None) -> RGB:
    """Return the colour of a job's status; None: the job runs."""
    return STATUS_COLOURS[outcome.status] if outcome else PENDING_COLOUR


def coverage_colour(probability: float) -> RGB:
    """Return the colour of a probability that a photo is found."""
    return next(colour for least, colour, _ in COVERAGE_LEVELS if probability >= least)


def match_colours(view: MatchView, by: ColourBy) -> UInt8[np.ndarray, "m 3"]:
    """Return a colour for each match: inlier or outlier, or its residual on a logarithmic scale."""
    if by == "inlier":
        return np.array([OUTLIER_COLOUR, INLIER_COLOUR], np.uint8)[view.inlier.astype(int)]
    low, high = np.log(_RESIDUAL_PX)
    # Any value does for NaN, whose colours are replaced below; the clip keeps the logarithm finite.
    share = (np.log(np.nan_to_num(view.residual_px, nan=1.0).clip(1e-6)) - low) / (high - low)
    colours = _interpolate(_RESIDUAL_SCALE, np.clip(share, 0, 1))
    colours[np.isnan(view.residual_px)] = UNKNOWN_COLOUR
    return colours


def score_colours(scores: Float[np.ndarray, "k"]) -> UInt8[np.ndarray, "k 3"]:
    """Return colours from dull blue (lowest score) to yellow (highest); equal scores are all yellow."""
    spread = np.ptp(scores) if len(scores) else 0.0
    share = (scores - scores.min()) / spread if spread > 0 else np.ones(len(scores))
    return _interpolate(_SCORE_SCALE, share)


def _interpolate(scale: Float[np.ndarray, "s 3"], share: Float[np.ndarray, "k"]) -> UInt8[np.ndarray, "k 3"]:
    stops = np.linspace(0, 1, len(scale))
    return np.stack([np.interp(share, stops, channel) for channel in scale.T], -1).round().astype(np.uint8)
