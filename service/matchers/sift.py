"""RootSIFT (Arandjelovic and Zisserman, CVPR 2012) by OpenCV: no weights.

More precise than XFeat on clean photos, weaker with blur and wide baselines.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Int32, UInt8

from service.interfaces import Features
from service.matchers.mutual import mutual_nearest


@dataclass(frozen=True, slots=True)
class SiftConfig:
    """What a feature and a match need."""

    min_contrast: float = 0.02
    """Half of OpenCV's threshold: renders are softer than photos."""
    min_cosine: float = 0.8
    """Of matched descriptors. RootSIFT has no negative entries, so that pairs by chance are already similar."""


class Sift:
    """`Matcher` by RootSIFT and mutual nearest neighbours."""

    name = "sift"

    def __init__(self, config: SiftConfig = SiftConfig()) -> None:
        self._config = config

    def extract(self, rgb: UInt8[np.ndarray, "h w 3"], limit: int) -> Features:
        """Return the `limit` features of the strongest response; descriptors are RootSIFT's 128 numbers."""
        # Without the precise upscale all points lie a quarter of a pixel too far right and down.
        detector = cv2.SIFT.create(contrastThreshold=self._config.min_contrast, enable_precise_upscale=True)
        keypoints, descriptors = detector.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
        if len(keypoints) == 0:
            return Features(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros((0, 128), np.float32))
        points = np.array([k.pt for k in keypoints], np.float32)
        scores = np.array([k.response for k in keypoints], np.float32)
        _, first = np.unique(
            points, axis=0, return_index=True
        )  # one orientation for each point: a second one would be the same point twice
        order = first[np.argsort(-scores[first], kind="stable")][:limit]
        root = np.sqrt(descriptors[order] / np.maximum(descriptors[order].sum(1, keepdims=True), 1e-9))
        # OpenCV has the centre of the top-left pixel at (0, 0).
        return Features(points[order] + np.float32(0.5), scores[order], root.astype(np.float32))

    def match(self, a: Features, b: Features) -> Int32[np.ndarray, "m 2"]:
        """Return the mutual nearest neighbours."""
        return mutual_nearest(a.descriptors, b.descriptors, self._config.min_cosine)


def create() -> Sift:
    """Return a matcher; it has no state."""
    cv2.setNumThreads(1)  # a job runs on one thread
    return Sift()
