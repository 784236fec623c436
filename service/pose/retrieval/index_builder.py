"""Building a view index: render the views, extract their features, and compute the scene's symmetries from them.

cameras, well spread from the first on -> batches, one a core -> views, corners of some, pictures of some
-> a part of the index, or, of all views, the whole one
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain

import numpy as np
from jaxtyping import UInt8

from service.interfaces import Tools
from service.pose.features.in_plane_rotation import CORNERS, Corners, detect_corners
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import View, in_batches, to_uint8, views_of
from service.pose.retrieval.index import ViewIndex, WholeIndex
from service.pose.retrieval.inverted_views import InvertedViews
from service.pose.retrieval.lod_proxy import LOD, LodConfig, OccludedRenderer
from service.pose.retrieval.scene_symmetries import find_repetitions, is_examined, like_its_mirror_image
from service.types import Camera, Query

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PartsConfig:
    """In which parts a large index is built."""

    first_views: int = 256
    """With so many, of all over the scene, most photos are found..."""
    min_views: int = 640
    """...and from so many views on building all takes long enough that photos don't wait for it."""
    growth: int = 2
    """Ratio of the views of one part and of the part before."""


PARTS = PartsConfig()


@dataclass(frozen=True, slots=True)
class _Seen:
    """What is kept of one render."""

    view: View
    corners: Corners | None
    picture: QueryImages | None


class IndexBuilder:
    """Builds the index of these cameras, in as many parts as it is asked for."""

    def __init__(self, cameras: Sequence[Camera], tools: Tools[None], lod: LodConfig = LOD) -> None:
        self._cameras, self._tools = cameras, tools
        # Rounded up, so that the corners of all views together stay below the limit.
        self._corners_every = -(-len(cameras) * CORNERS.of_view // CORNERS.of_all_views)
        self._renderer = OccludedRenderer(tools.scene, tools.rasterizer, tools.rng, lod)
        self._seen: list[_Seen] = []

    def first_part(
        self, finish: Callable[[ViewIndex], ViewIndex] = lambda whole: whole, config: PartsConfig = PARTS
    ) -> ViewIndex:
        """Return an index of the first views, which knows the whole one; the whole one itself where views are few.

        `finish` is applied to the whole one.
        """
        count = len(self._cameras)
        if count < config.min_views:
            return finish(self.whole())

        def grown(publish: Callable[[ViewIndex], ViewIndex]) -> ViewIndex:
            views = config.first_views * config.growth
            while views < count:
                publish(self._part(views))
                views *= config.growth
            return finish(self.whole())

        return WholeIndex(count, grown).publish(self._part(config.first_views))

    def whole(self) -> ViewIndex:
        """Return the index of all views, with the scene's symmetries."""
        with _threads() as pool:
            views, words = self._views(len(self._cameras), pool)
            mirrored = self._like_its_mirror_image(views, words, pool)
            pictures = [seen.picture for seen in self._seen]
            rasterizer, matcher = self._tools.rasterizer, self._tools.matcher
            repetitions, repeated = find_repetitions(views, words, pictures, rasterizer, matcher, pool)
        log.info("view index of %s: %d views", self._tools.scene.info.name, len(views))
        return ViewIndex(views, self._corners(), mirrored, repeated, repetitions, words=words)

    def _part(self, count: int) -> ViewIndex:
        """Return the index of so many views. It doesn't say how the scene repeats itself: it is taken to."""
        with _threads() as pool:
            views, words = self._views(count, pool)
            mirrored = self._like_its_mirror_image(views, words, pool)
        log.info("view index of %s: %d of %d views", self._tools.scene.info.name, count, len(self._cameras))
        return ViewIndex(views, self._corners(), mirrored, words=words)

    def _views(self, count: int, pool: Executor) -> tuple[tuple[View, ...], InvertedViews | None]:
        """Render as many of the first cameras as are missing; return their views, and words of many views."""
        missing = range(len(self._seen), count)
        # In order: the index is the same whatever thread is first.
        batches = in_batches(missing, self._tools.rasterizer.cameras_at_once)
        self._seen += chain.from_iterable(pool.map(self._rendered, batches))
        views = tuple(seen.view for seen in self._seen)
        return views, InvertedViews.of_many(views)

    def _rendered(self, numbers: Sequence[int]) -> list[_Seen]:
        some = [self._cameras[number] for number in numbers]
        frames = self._renderer.render(some)
        images = [to_uint8(frame.rgb) for frame in frames]
        corners = [
            detect_corners(image, CORNERS.of_view) if number % self._corners_every == 0 else None
            for number, image in zip(numbers, images, strict=True)
        ]
        pictures = [
            _picture(image, camera, self._tools) if is_examined(number, len(self._cameras)) else None
            for number, image, camera in zip(numbers, images, some, strict=True)
        ]
        views = views_of(frames, some, self._tools.matcher)
        return [_Seen(*each) for each in zip(views, corners, pictures, strict=True)]

    def _like_its_mirror_image(self, views: Sequence[View], words: InvertedViews | None, pool: Executor) -> bool:
        return like_its_mirror_image(views, words, self._tools.rasterizer, self._tools.matcher, pool)

    def _corners(self) -> Corners:
        return Corners.pooled([seen.corners for seen in self._seen if seen.corners])


def _threads() -> ThreadPoolExecutor:
    """One a core. They end with what is built, and with them their working memory, which grows with the scene."""
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="index")


def _picture(rgb: UInt8[np.ndarray, "h w 3"], camera: Camera, tools: Tools[None]) -> QueryImages:
    return QueryImages(Query(rgb, camera.intrinsics, "given", camera.intrinsics), tools.matcher)
