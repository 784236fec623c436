"""The view index: renders of the scene from well spread places, made once, with which photos are compared.

Each view keeps its local features with their scene points. The index also says how the scene repeats itself and
whether it is like its mirror image (`scene_symmetries`). `index_builder` makes it, `stored_index` keeps it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float32, Float64

from service.pose.features.in_plane_rotation import Corners
from service.pose.features.rendered_views import View
from service.pose.retrieval.free_views import FreeViews
from service.pose.retrieval.inverted_views import InvertedViews, view_scores
from service.pose.retrieval.scene_symmetries import NO_REPETITIONS, Repetitions
from service.pose.retrieval.scores import SCORES, ScoreConfig


@dataclass(frozen=True, slots=True)
class ViewIndex:
    """The views of one scene, and what is known of it from them."""

    views: tuple[View, ...]
    corners: Corners
    """Corners of some of the views; see pose/features/in_plane_rotation.py."""
    like_its_mirror_image: bool = False
    """Whether a mirrored photo of the scene may pass for one of the scene."""
    repeats_itself: bool = True
    """Whether a photo that fits one pose may fit another one."""
    repetitions: Repetitions = field(default_factory=lambda: NO_REPETITIONS, compare=False)
    """Motions that lead from the one to the other."""
    free_views: FreeViews = field(default_factory=FreeViews, compare=False)
    """Views beside these, for photos that are like none of them."""
    words: InvertedViews | None = field(default=None, compare=False)
    """The views' features by words; None: there are few views."""
    is_cut: bool = False
    """Whether the scene needs more views than the index may have."""
    whole: WholeIndex | None = field(default=None, compare=False)
    """Of a first part of the views: the index that has all of them. None: this is it."""

    def scores(
        self, descriptors: Float32[np.ndarray, "n d"], config: ScoreConfig = SCORES
    ) -> Float64[np.ndarray, "views"]:
        """Return the views' retrieval scores for an image's features, strongest first."""
        return view_scores(descriptors, self.views, self.words, config)

    def latest(self) -> ViewIndex:
        """Return this index with the views that are built by now."""
        return (self.whole and self.whole.so_far()) or self


class WholeIndex:
    """An index that is built while its first views are in use. Safe to use from several threads."""

    def __init__(self, planned_views: int, build: Callable[[Callable[[ViewIndex], ViewIndex]], ViewIndex]) -> None:
        """`build` returns the index; it passes ever larger parts of it to the function that it is given."""
        self.planned_views = planned_views
        self._build: Callable[[Callable[[ViewIndex], ViewIndex]], ViewIndex] | None = build
        self._building = threading.Lock()
        self._so_far: ViewIndex | None = None

    def publish(self, part: ViewIndex) -> ViewIndex:
        """Return a part of the views as a part of this index; from now on it is what is built so far."""
        self._so_far = replace(part, whole=self)
        return self._so_far

    def so_far(self) -> ViewIndex | None:
        """Return what is built by now: a part of the views, or all; None: nothing yet."""
        return self._so_far

    def result(self, timeout_s: float = -1.0) -> ViewIndex | None:
        """Return the index: build it, or wait until the thread that does has; None if it still does after the timeout.

        Where that thread fails, the next caller builds.
        """
        if not self._building.acquire(timeout=timeout_s):
            return None
        try:
            if self._build:
                self._so_far = self._build(self.publish)
                self._build = None  # and with it what was only needed for building
            return self._so_far
        finally:
            self._building.release()
