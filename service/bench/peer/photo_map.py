"""A map of training photos: their features and the points that these triangulate to; localizes photos by it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from service.bench.peer.photo_matching import (
    MATCHING,
    MatchingConfig,
    PhotoFeatures,
    matched,
    near_epipolar_lines,
    pairs_of_cameras,
)
from service.bench.peer.words import Words
from service.errors import SceneNotFound
from service.types import Camera, Intrinsics, Pose

_MIN_MATCHES = 4
"""Fewer determine no pose."""


@dataclass(frozen=True, slots=True)
class PosedPhoto:
    """A decoded photo; of a training photo with its camera."""

    grey: UInt8[np.ndarray, "h w"]
    valid_mask: Bool[np.ndarray, "h w"] | None
    camera: Camera


@dataclass(frozen=True, slots=True)
class Points:
    """Triangulated points."""

    in_world: Float64[np.ndarray, "n 3"]
    of_features: tuple[Int64[np.ndarray, "_"], ...]
    """For each photo and feature the number of its point, -1 if it has none."""


class Peer(Protocol):
    """The parts that a library of structure from motion brings."""

    def features(self, grey: UInt8[np.ndarray, "h w"]) -> PhotoFeatures:
        """Return the local features of a photo."""
        ...

    def points(
        self,
        cameras: Sequence[Camera],
        px: Sequence[Float64[np.ndarray, "_ 2"]],
        matches: dict[tuple[int, int], Int64[np.ndarray, "_ 2"]],
    ) -> Points:
        """Triangulate matched features with the photos' known cameras."""
        ...

    def pose(
        self, px: Float64[np.ndarray, "m 2"], in_world: Float64[np.ndarray, "m 3"], intrinsics: Intrinsics
    ) -> tuple[Pose, int] | None:
        """Return the absolute pose and its number of inliers; None if there is none."""
        ...


@dataclass(frozen=True, slots=True)
class MapFacts:
    """What making a map took; CPU seconds of the process."""

    photos: int
    features: int
    points: int
    build_cpu_s: float


@dataclass(frozen=True, slots=True)
class PhotoMap:
    """What is kept of the training photos to localize others."""

    features: tuple[PhotoFeatures, ...]
    points: Points
    descriptors: Float32[np.ndarray, "n d"]
    """Of each point the mean of its features', of unit length."""
    words: Words | None
    """None: photos are matched with the points directly."""
    facts: MapFacts

    @classmethod
    def of(
        cls,
        photos: Sequence[PosedPhoto],
        peer: Peer,
        ranks_photos: bool,
        config: MatchingConfig = MATCHING,
        progress: Callable[[int, int], None] | None = None,
    ) -> PhotoMap:
        """Extract, match and triangulate the training photos' features. Raises SceneNotFound: there are no points."""
        began = time.process_time()
        features = []
        for number, photo in enumerate(photos, 1):
            features.append(valid_features(photo, peer))
            if progress:
                progress(number, len(photos))
        cameras = [photo.camera for photo in photos]
        matches = {}
        for i, j in pairs_of_cameras(cameras, config):
            pairs = matched(features[i], features[j], config)
            a_px, b_px = features[i].px[pairs[:, 0]], features[j].px[pairs[:, 1]]
            matches[i, j] = pairs[near_epipolar_lines(cameras[i], cameras[j], a_px, b_px, config.epipolar_px)]
        points = peer.points(cameras, [one.px for one in features], matches)
        if not len(points.in_world):
            raise SceneNotFound("the training photos have no point in common.", where="photos")
        words = Words.of([one.descriptors for one in features]) if ranks_photos else None
        descriptors = _means(features, points)
        count = sum(len(one.px) for one in features)
        facts = MapFacts(len(photos), count, len(points.in_world), time.process_time() - began)
        return cls(tuple(features), points, descriptors, words, facts)

    @property
    def nbytes(self) -> int:
        """What localizing needs, in the sizes in which COLMAP keeps it: a byte a dimension of a descriptor."""
        dimensions = self.descriptors.shape[1]
        if self.words is None:
            return len(self.points.in_world) * (dimensions + 3 * 4)
        return self.facts.features * (dimensions + 4) + len(self.points.in_world) * 3 * 4 + self.words.nbytes

    def localize(self, photo: PosedPhoto, peer: Peer, best_photos: int) -> tuple[Pose, int] | None:
        """Return a photo's pose in the world and its number of inliers; None if there is none.

        Matched with the features of the `best_photos` most similar training photos, or with all points directly where
        the map has no words. The photo's camera gives intrinsics only.
        """
        query = valid_features(photo, peer)
        if self.words is None:
            found = matched(query, PhotoFeatures(np.zeros((len(self.descriptors), 2)), self.descriptors))
        else:
            found = self._of_photos(query, self.words.ranked(query.descriptors)[:best_photos])
        if len(found) < _MIN_MATCHES:
            return None
        return peer.pose(query.px[found[:, 0]], self.points.in_world[found[:, 1]], photo.camera.intrinsics)

    def _of_photos(self, query: PhotoFeatures, photos: Int64[np.ndarray, "_"]) -> Int64[np.ndarray, "_ 2"]:
        """Return pairs of a feature of the query and a point, each pair once."""
        found = [np.zeros((0, 2), np.int64)]
        for number in photos:
            pairs = matched(query, self.features[number])
            points = self.points.of_features[number][pairs[:, 1]]
            found.append(np.stack([pairs[:, 0], points], axis=1)[points >= 0])
        return np.unique(np.concatenate(found), axis=0)


def valid_features(photo: PosedPhoto, peer: Peer) -> PhotoFeatures:
    """Return a photo's features where its pixels show something."""
    found = peer.features(photo.grey)
    if photo.valid_mask is None:
        return found
    height, width = photo.valid_mask.shape
    column, row = np.clip(found.px.astype(int), 0, (width - 1, height - 1)).T
    return found.kept(photo.valid_mask[row, column])


def _means(features: Sequence[PhotoFeatures], points: Points) -> Float32[np.ndarray, "n d"]:
    sums = np.zeros((len(points.in_world), features[0].descriptors.shape[1]), np.float32)
    for one, of in zip(features, points.of_features, strict=True):
        np.add.at(sums, of[of >= 0], one.descriptors[of >= 0])
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
