"""Judging answers against one another: does one explain the whole photo, and how probable is each?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class AnswerConfig:
    """How answers are compared."""

    whole_gradients: float = 0.95
    whole_colours: float = 0.98
    """Signals of a pose that explains the whole photo; of clean photos some have less gradients."""
    decisiveness: float = 10.0
    """Exponent of the ratio of mean residuals: an answer whose residual is 15 % less than another's is four times as
    probable. That much varies, from place to place, how well a scene is modelled."""
    min_probability: float = 0.02
    """Answers less probable than this are not reported."""


ANSWERS = AnswerConfig()


def explains_whole_photo(signals: Mapping[str, float], config: AnswerConfig = ANSWERS) -> bool:
    """Return whether a pose with these signals of the gate explains the whole photo."""
    return signals["gradients"] > config.whole_gradients and signals["colours"] > config.whole_colours


def rank_answers(losses: Sequence[float], config: AnswerConfig = ANSWERS) -> list[tuple[int, float]]:
    """Return the answers' numbers and how probable each is if one of them is right, the most probable one first.

    `losses` are their mean residuals after refinement. Improbable answers are left out, never the first one.
    """
    residuals = np.asarray(losses, np.float64)
    # Relative to the best, so that the photo's own noise cancels.
    weights = (residuals / residuals.min()) ** -config.decisiveness
    probabilities = weights / weights.sum()
    order = np.argsort(residuals, kind="stable")
    kept = [i for rank, i in enumerate(order) if rank == 0 or probabilities[i] > config.min_probability]
    return [(int(i), float(probabilities[i])) for i in kept]
