"""Retrieval scores: which of the index's views is a photo most like, by its local features?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64


@dataclass(frozen=True, slots=True)
class ScoreConfig:
    """Which features take part, and what a usual similarity is."""

    photo_features: int = 150
    view_features: int = 150
    """The strongest features that are compared: four times as many find the right view no more often."""
    usual_rank: int = 3
    usual_share: float = 0.05
    """A feature's usual similarity is that to the view of this rank; of many views, of this share of them."""


SCORES = ScoreConfig()


def retrieval_scores(
    descriptors: Float32[np.ndarray, "n d"], views: Sequence[Float32[np.ndarray, "_ d"]], config: ScoreConfig = SCORES
) -> Float64[np.ndarray, "views"]:
    """Return for each view how well the photo's strongest features are found in it; descriptors have unit length.

    A feature adds by how much its best similarity in a view exceeds its usual one: that in the few best views, not in
    the average view, because neither what every room shows nor what the scene lacks distinguishes places. (3 million
    Gaussians, 13 similar rooms, 374 views: a right view is among the first five for 10 photos of 16; relative to the
    average for 8, by VLAD with 32 words for 3. In the six test scenes and studio each of them finds one for all 58.)
    """
    best = best_similarities(descriptors[: config.photo_features], views, config)
    rank = usual_rank(len(views), config)
    usual = -np.partition(-best, rank, axis=1)[:, rank, None]
    return np.maximum(best - usual, 0.0).sum(0, dtype=np.float64)


def best_similarities(
    photo: Float32[np.ndarray, "n d"], views: Sequence[Float32[np.ndarray, "_ d"]], config: ScoreConfig = SCORES
) -> Float32[np.ndarray, "n views"]:
    """Return each feature's best similarity in each view, at least 0: the cosine to one of its strongest features."""
    # Unit length: the dot product is the cosine similarity. Extractors return the strongest first.
    columns = np.ascontiguousarray(photo.T)
    return np.stack([(view[: config.view_features] @ columns).max(0, initial=0.0) for view in views], 1)


def usual_rank(views: int, config: ScoreConfig = SCORES) -> int:
    """Return the rank of the view in which a feature has its usual similarity: of few views a fixed one."""
    return min(max(config.usual_rank, round(config.usual_share * views)), views - 1)


def top_indices(scores: Float64[np.ndarray, "n"], count: int) -> Int64[np.ndarray, "k"]:
    """Return the indices of the highest scores, best first."""
    return np.argsort(-scores, kind="stable")[:count]
