"""Ranking photos by bags of visual words (Sivic and Zisserman 2003), with square roots of counts and tf-idf weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64


@dataclass(frozen=True, slots=True)
class WordsConfig:
    """The visual vocabulary."""

    words: int = 1024
    sample: int = 15_000
    """Descriptors that the words are clustered from."""
    rounds: int = 4
    """Of k-means."""
    idf_floor: float = 0.05
    """Weight of a word that every photo has: with few photos all words would vanish."""


@dataclass(frozen=True, slots=True)
class Words:
    """The words of a scene and the weighted counts of its training photos."""

    centres: Float32[np.ndarray, "k d"]
    weights: Float64[np.ndarray, "k"]
    photos: Float64[np.ndarray, "p k"]
    """Of unit length."""

    @classmethod
    def of(cls, descriptors: Sequence[Float32[np.ndarray, "_ d"]], config: WordsConfig | None = None) -> Words:
        """Cluster the photos' unit descriptors by spherical k-means and count each photo's words."""
        config = config or WordsConfig()
        rng = np.random.default_rng(0)
        every = np.concatenate(descriptors)
        sample = every[rng.choice(len(every), min(len(every), config.sample), replace=False)]
        count = max(1, min(config.words, len(sample) // 4))
        centres = sample[rng.choice(len(sample), count, replace=False)]
        for _ in range(config.rounds):
            sums = np.zeros_like(centres)
            np.add.at(sums, _words(sample, centres), sample)
            lengths = np.linalg.norm(sums, axis=1, keepdims=True)
            centres = np.where(lengths > 0, sums / np.maximum(lengths, 1e-9), centres).astype(np.float32)
        counts = np.stack([np.bincount(_words(each, centres), minlength=count) for each in descriptors])
        weights = np.log(len(counts) / np.maximum((counts > 0).sum(axis=0), 1)) + config.idf_floor
        photos = np.sqrt(counts) * weights
        return cls(centres, weights, photos / np.maximum(np.linalg.norm(photos, axis=1, keepdims=True), 1e-9))

    def ranked(self, descriptors: Float32[np.ndarray, "n d"]) -> Int64[np.ndarray, "p"]:
        """Return the numbers of the training photos, the most similar first."""
        counts = np.bincount(_words(descriptors, self.centres), minlength=len(self.centres))
        return np.argsort(-(self.photos @ (np.sqrt(counts) * self.weights)), kind="stable")

    @property
    def nbytes(self) -> int:
        """With two bytes a count of a photo."""
        return self.centres.nbytes + self.weights.nbytes + 2 * self.photos.size


def _words(descriptors: Float32[np.ndarray, "n d"], centres: Float32[np.ndarray, "k d"]) -> Int64[np.ndarray, "n"]:
    return (descriptors @ centres.T).argmax(axis=1)
