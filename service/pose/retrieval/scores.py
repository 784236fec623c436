"""Which views is a photo most like? Its features vote for them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int64

VOTERS, CANDIDATES = 150, 150
"""Of the photo and of each view, the strongest features: four times as many find the right view no more often."""
USUAL_RANK, USUAL_SHARE = 3, 0.05
"""What a feature is answered usually: by the view of this rank, or with many views by that of this share of them."""


def vote(
    descriptors: Float32[np.ndarray, "n d"], views: Sequence[Float32[np.ndarray, "_ d"]]
) -> Float64[np.ndarray, "views"]:
    """Return for each view how well the photo's strongest features are found in it; descriptors have unit length.

    Each feature counts by how much a view's best answer to it exceeds the usual one. The usual one is that of the few
    best views, not of the average view: what is seen in every room tells nothing, nor do things that the scene doesn't
    have. (3 million Gaussians, 13 like rooms, 374 views: a right view is among the first five for 10 photos of 16,
    measured by the average for 8, by VLAD with 32 words for 3. In the six test scenes and studio each way finds one
    for all 58.)
    """
    voters = np.ascontiguousarray(descriptors[:VOTERS].T)
    best = np.stack([(view[:CANDIDATES] @ voters).max(0, initial=0.0) for view in views], 1)
    rank = min(max(USUAL_RANK, round(USUAL_SHARE * len(views))), len(views) - 1)
    usual = -np.partition(-best, rank, axis=1)[:, rank, None]
    return np.maximum(best - usual, 0.0).sum(0, dtype=np.float64)


def top(scores: Float64[np.ndarray, "n"], count: int) -> Int64[np.ndarray, "k"]:
    """Return the indices of the highest scores, best first."""
    return np.argsort(-scores, kind="stable")[:count]
