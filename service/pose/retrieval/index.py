"""The view index: renders of the scene from well spread places, made once, with which photos are compared.

Each view keeps its local features with their scene points. The index also says how the scene repeats itself and
whether it is like its mirror image (`scene_symmetries`).
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from service.interfaces import Tools
from service.pose.features.in_plane_rotation import CORNERS, Corners, detect_corners
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import VIEWS, View, in_batches, to_uint8, views_of
from service.pose.retrieval.ambiguous_hypotheses import AMBIGUITY
from service.pose.retrieval.floaters import FLOATERS
from service.pose.retrieval.free_space import SPACE
from service.pose.retrieval.free_views import FREE_VIEWS, FreeViews
from service.pose.retrieval.inverted_views import INVERTED, InvertedViews, view_scores
from service.pose.retrieval.lod_proxy import LOD, LodConfig, OccludedRenderer
from service.pose.retrieval.scene_symmetries import (
    NO_REPETITIONS,
    SYMMETRY,
    Repetitions,
    find_repetitions,
    is_examined,
    like_its_mirror_image,
)
from service.pose.retrieval.scores import SCORES, ScoreConfig
from service.pose.retrieval.view_files import read_views, write_views
from service.pose.retrieval.viewpoints import VIEWPOINTS, ViewpointConfig, index_cameras
from service.types import Camera, Query

VERSION = 12
"""Raise it with any change of the code that makes stored indexes differ from fresh ones; `_key` covers the configs."""
log = logging.getLogger(__name__)


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

    def scores(
        self, descriptors: Float32[np.ndarray, "n d"], config: ScoreConfig = SCORES
    ) -> Float64[np.ndarray, "views"]:
        """Return the views' retrieval scores for an image's features, strongest first."""
        return view_scores(descriptors, self.views, self.words, config)


def prepared_index(tools: Tools[None], cache_dir: Path | None, viewpoints: ViewpointConfig = VIEWPOINTS) -> ViewIndex:
    """Read the scene's index from the cache, or build it and store it there."""
    # The names are hashes of all that their content depends on, so one of other values is never read.
    path = cache_dir / f"view-index-{_key(tools, viewpoints)}" if cache_dir else None
    free_views = FreeViews(cache_dir / f"free-views-{_key(tools, viewpoints, FREE_VIEWS)}" if cache_dir else None)

    def is_cut(index: ViewIndex) -> bool:
        return viewpoints.cuts(len(index.views), len(tools.scene.cameras))

    if found := _read(path, free_views):
        return replace(found, is_cut=is_cut(found))
    index = built_index(index_cameras(tools.scene, tools.rasterizer, tools.rng, viewpoints), tools)
    if path:
        try:
            _write(index, path)
        except OSError as error:  # a full disk
            log.warning("the view index stays in memory: %s", error)
        # What is mapped takes no memory of this process's own.
        index = _read(path, free_views) or index
    return replace(index, free_views=free_views, is_cut=is_cut(index))


def built_index(cameras: Sequence[Camera], tools: Tools[None], lod: LodConfig = LOD) -> ViewIndex:
    """Render the views and extract their features, one batch a core, then compute the scene's symmetries.

    The threads end with the building, and with them their working memory, which grows with the scene.
    """
    with ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="index") as pool:
        # Rounded up, so that the corners of all views together stay below the limit.
        every = -(-len(cameras) * CORNERS.of_view // CORNERS.of_all_views)
        renderer = OccludedRenderer(tools.scene, tools.rasterizer, tools.rng, lod)

        def seen(numbers: list[int]) -> list[tuple[View, Corners | None, QueryImages | None]]:
            some = [cameras[number] for number in numbers]
            frames = renderer.render(some)
            images = [to_uint8(frame.rgb) for frame in frames]
            corners = [
                detect_corners(image, CORNERS.of_view) if number % every == 0 else None
                for number, image in zip(numbers, images, strict=True)
            ]
            pictures = [
                _picture(image, camera, tools) if is_examined(number, len(cameras)) else None
                for number, image, camera in zip(numbers, images, some, strict=True)
            ]
            return list(zip(views_of(frames, some, tools.matcher), corners, pictures, strict=True))

        # In order: the index is the same whatever thread is first.
        batches = in_batches(range(len(cameras)), tools.rasterizer.cameras_at_once)
        found = list(chain.from_iterable(pool.map(seen, batches)))
        views = tuple(view for view, _, _ in found)
        words = InvertedViews.of_many(views)
        mirrored = like_its_mirror_image(views, words, tools.rasterizer, tools.matcher, pool)
        pictures = [picture for *_, picture in found]
        repetitions, repeated = find_repetitions(views, words, pictures, tools.rasterizer, tools.matcher, pool)
    log.info("view index of %s: %d views", tools.scene.info.name, len(views))
    corners = Corners.pooled([own for _, own, _ in found if own])
    return ViewIndex(views, corners, mirrored, repeated, repetitions, words=words)


def _picture(rgb: UInt8[np.ndarray, "h w 3"], camera: Camera, tools: Tools[None]) -> QueryImages:
    return QueryImages(Query(rgb, camera.intrinsics, "given", camera.intrinsics), tools.matcher)


def _key(tools: Tools[None], *more: object) -> str:
    """Return a hash of what views depend on: code, scene, matcher, rasterizer, and all values of these configs."""
    # The scene's digest covers the training cameras, but photos may be left out; the background may be assumed.
    visible = int(np.count_nonzero(tools.scene.opacities))  # floaters are left out
    scene = (tools.scene.info.sha256, visible, len(tools.scene.cameras), tools.scene.info.background_rgb)
    # Dataclasses of numbers: their repr names each value.
    configs = (*more, SPACE, FLOATERS, LOD, VIEWS, CORNERS, SYMMETRY, AMBIGUITY, SCORES, INVERTED)
    parts = (VERSION, *scene, tools.matcher.name, tools.rasterizer.name, *configs)
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:24]


def _write(index: ViewIndex, path: Path) -> None:
    others = {
        "like_its_mirror_image": np.array(index.like_its_mirror_image),
        "repeats_itself": np.array(index.repeats_itself),
        "repetition_motions": index.repetitions.motions,
        "repetition_points": index.repetitions.points_in_world,
        "corner_directions_deg": index.corners.directions_deg,
        "corner_descriptors": index.corners.descriptors,
    }
    if index.words:
        others |= index.words.arrays()
    write_views(path, index.views, others)


def _read(path: Path | None, free_views: FreeViews) -> ViewIndex | None:
    if not (found := read_views(path)):
        return None
    views, stored = found
    try:
        pooled = Corners(stored["corner_directions_deg"], stored["corner_descriptors"])
        mirrored, repeated = bool(stored["like_its_mirror_image"]), bool(stored["repeats_itself"])
        repetitions = Repetitions(stored["repetition_motions"], stored["repetition_points"])
    except KeyError:  # a whole file with other arrays
        return None
    return ViewIndex(views, pooled, mirrored, repeated, repetitions, free_views, InvertedViews.from_arrays(stored))
