"""Retrieval scores of many views: their features by words, of which a photo's feature looks up the nearest few.

    words (k-means)    w0          w1       w2 ...
    entries         [e0 e1 e2 | e3 e4 ... |    ]    descriptors of 8 bits, sorted by word; `view_of`: of which view
                     ^ starts[0] ^ starts[1]

The score is that of `scores`, over the features that are found; of the best views it is then computed exactly. So its
cost grows with the length of the words' lists, not with the number of views (an inverted file: Sivic and Zisserman,
"Video Google", ICCV 2003).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int8, Int16, Int32, Int64

from service.jit import kernel
from service.pose.features.rendered_views import View
from service.pose.retrieval.scores import (
    SCORES,
    ScoreConfig,
    best_similarities,
    retrieval_scores,
    usual_rank,
)

UNIT = 180
"""Length of a quantized descriptor, whose components mostly fit into 8 bits."""
PREFIX = "inverted_"
LEVELS = 4096
"""Of similarities in steps of 16: beyond UNIT^2, which rounding exceeds."""


@dataclass(frozen=True, slots=True)
class InvertedConfig:
    """How finely features are divided, and how many of them are compared."""

    min_views: int = 1024
    """From which on words are faster: fewer views are compared one by one, in 0.05 ms each."""
    features_per_word: int = 600
    min_words: int = 16
    max_words: int = 4096
    looked_up: int = 4
    """Words, the nearest to a feature of the photo."""
    samples_per_word: int = 40
    iterations: int = 4
    """Of k-means, on a sample of the features."""
    seed: int = 0
    found_share: float = 0.4
    """Views of the usual rank or better that the words find, of all that there are..."""
    exact_views: int = 32
    """Best views whose scores are computed from the descriptors as they are."""


INVERTED = InvertedConfig()


@dataclass(frozen=True, slots=True)
class InvertedViews:
    """The strongest features of many views, sorted by word."""

    words: Float32[np.ndarray, "w d"]
    starts: Int64[np.ndarray, "w1"]
    """Of each word's entries, and at last their number."""
    entries: Int8[np.ndarray, "n d"]
    """Descriptors, times `UNIT`."""
    view_of: Int32[np.ndarray, "n"]

    @classmethod
    def of_many(cls, views: Sequence[View], config: InvertedConfig = INVERTED) -> InvertedViews | None:
        """Return the features of the views by words; None of views so few that comparing each is faster."""
        if len(views) < config.min_views:
            return None
        return cls.of([view.features.descriptors for view in views], config=config)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays that `from_arrays` takes, by name."""
        return {PREFIX + name: getattr(self, name) for name in self.__slots__}

    @classmethod
    def from_arrays(cls, stored: Mapping[str, np.ndarray]) -> InvertedViews | None:
        """Return the features that are among stored arrays; None: there are none."""
        if not any(name.startswith(PREFIX) for name in stored):
            return None
        # Plain arrays: for a kernel a memory map is another type.
        return cls(*(np.asarray(stored[PREFIX + name]) for name in cls.__slots__))

    @classmethod
    def of(
        cls,
        views: Sequence[Float32[np.ndarray, "_ d"]],
        scores: ScoreConfig = SCORES,
        config: InvertedConfig = INVERTED,
    ) -> InvertedViews:
        """Sort the views' strongest features by words, which are found by k-means; descriptors have unit length."""
        strongest = [view[: scores.view_features] for view in views]
        descriptors = np.concatenate(strongest)
        view_of = np.repeat(np.arange(len(views), dtype=np.int32), [len(view) for view in strongest])
        words = _words(descriptors, config)
        nearest = _nearest(descriptors, words)
        order = np.argsort(nearest, kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(nearest, minlength=len(words)))])
        return cls(words, starts, _quantized(descriptors)[order], view_of[order])

    def scores(
        self,
        descriptors: Float32[np.ndarray, "n d"],
        views: Sequence[Float32[np.ndarray, "_ d"]],
        scores: ScoreConfig = SCORES,
        config: InvertedConfig = INVERTED,
    ) -> Float64[np.ndarray, "views"]:
        """Return what `retrieval_scores` does, of all but the best views from the features that their words find."""
        photo = descriptors[: scores.photo_features]
        found = np.zeros(len(views))
        usual = np.zeros(len(photo), np.int32)
        _vote(
            _quantized(photo).astype(np.int16),
            _highest(photo @ self.words.T, min(config.looked_up, len(self.words))),
            self.starts,
            self.entries,
            self.view_of,
            round(config.found_share * usual_rank(len(views), scores)),
            found,
            usual,
        )
        best = np.argpartition(found, -config.exact_views)[-config.exact_views :]
        exact = best_similarities(photo, [views[i] for i in best], scores) - usual[:, None] / UNIT**2
        found /= UNIT**2
        found[best] = np.maximum(exact, 0.0).sum(0, dtype=np.float64)
        return found


def view_scores(
    descriptors: Float32[np.ndarray, "n d"],
    views: Sequence[View],
    words: InvertedViews | None,
    scores: ScoreConfig = SCORES,
) -> Float64[np.ndarray, "views"]:
    """Return the views' retrieval scores, by words where there are some; descriptors: the strongest first."""
    of_views = [view.features.descriptors for view in views]
    return (
        retrieval_scores(descriptors, of_views, scores)
        if words is None
        else words.scores(descriptors, of_views, scores)
    )


def _words(descriptors: Float32[np.ndarray, "n d"], config: InvertedConfig) -> Float32[np.ndarray, "w d"]:
    """Return words of unit length: spherical k-means (Dhillon and Modha, 2001) on a sample, started at some of it."""
    rng = np.random.default_rng(config.seed)
    count = int(np.clip(len(descriptors) // config.features_per_word, config.min_words, config.max_words))
    sample = descriptors[rng.permutation(len(descriptors))[: config.samples_per_word * count]]
    words = sample[:count].copy()
    for _ in range(config.iterations):
        nearest = _nearest(sample, words)
        order = np.argsort(nearest, kind="stable")
        present, first = np.unique(nearest[order], return_index=True)
        sums = np.add.reduceat(sample[order], first)
        # A word that is nearest to nothing stays where it is.
        words[present] = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    return words


def _nearest(descriptors: Float32[np.ndarray, "n d"], words: Float32[np.ndarray, "w d"]) -> Int64[np.ndarray, "n"]:
    # In parts: the similarities of all would fill the memory.
    parts = range(0, len(descriptors), 4096)
    return np.concatenate([(descriptors[i : i + 4096] @ words.T).argmax(1) for i in parts])


def _quantized(descriptors: Float32[np.ndarray, "n d"]) -> Int8[np.ndarray, "n d"]:
    return np.clip(np.rint(UNIT * descriptors), -127, 127).astype(np.int8)


@kernel
def _highest(values: Float32[np.ndarray, "n w"], count: int) -> Int64[np.ndarray, "n k"]:
    """Return the places of each row's highest values, in no order."""
    places = np.empty((len(values), count), np.int64)
    for i in range(len(values)):
        row, place = values[i], places[i]
        place[:] = np.arange(count)
        lowest = np.argmin(row[:count])
        for j in range(count, len(row)):
            if row[j] > row[place[lowest]]:
                place[lowest] = j
                for k in range(count):
                    if row[place[k]] < row[place[lowest]]:
                        lowest = k
    return places


@kernel
def _vote(
    photo: Int16[np.ndarray, "n d"],
    words: Int64[np.ndarray, "n k"],
    starts: Int64[np.ndarray, "w1"],
    entries: Int8[np.ndarray, "e d"],
    view_of: Int32[np.ndarray, "e"],
    rank: int,
    scores: Float64[np.ndarray, "views"],
    usual: Int32[np.ndarray, "n"],
) -> None:
    """Add to each view by how much each feature's best similarity in it exceeds that of the view of this rank.

    Similarities are times UNIT^2; `usual` becomes those of the rank, rounded down to a multiple of 16.
    """
    best = np.zeros(len(scores), np.int32)
    found = np.empty(len(scores) + 1, np.int32)
    histogram = np.zeros(LEVELS, np.int32)
    similarities = np.empty(np.diff(starts).max(), np.int32)
    for f in range(len(photo)):
        count = 0
        query = photo[f]
        for word in words[f]:
            first, last = starts[word], starts[word + 1]
            # On its own this loop is vectorized: 16-bit products, summed in 32.
            for e in range(first, last):
                entry, total = entries[e], np.int32(0)
                for d in range(len(query)):
                    total = np.int32(total + np.int32(query[d]) * np.int32(entry[d]))
                similarities[e - first] = total
            for e in range(first, last):
                view, similarity = view_of[e], similarities[e - first]
                # Without a branch, which would be predicted badly.
                found[count] = view
                count += (best[view] == 0) & (similarity > 0)
                best[view] = max(best[view], similarity)
        for i in range(count):
            histogram[best[found[i]] >> 4] += 1
        above, level = 0, LEVELS
        while level > 0 and above <= rank:
            level -= 1
            above += histogram[level]
        histogram[:] = 0
        usual[f] = level << 4
        for i in range(count):
            view = found[i]
            scores[view] += max(best[view] - usual[f], 0)
            best[view] = 0
