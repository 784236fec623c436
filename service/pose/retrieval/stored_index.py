"""The view index of a scene, read from the cache or built and kept there."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from service.interfaces import Tools
from service.pose.features.in_plane_rotation import CORNERS, Corners
from service.pose.features.rendered_views import VIEWS
from service.pose.retrieval.ambiguous_hypotheses import AMBIGUITY
from service.pose.retrieval.floaters import FLOATERS
from service.pose.retrieval.free_space import SPACE
from service.pose.retrieval.free_views import FREE_VIEWS, FreeViews
from service.pose.retrieval.index import ViewIndex
from service.pose.retrieval.index_builder import IndexBuilder
from service.pose.retrieval.inverted_views import INVERTED, InvertedViews
from service.pose.retrieval.lod_proxy import LOD
from service.pose.retrieval.outer_planes import PLANES
from service.pose.retrieval.scene_symmetries import SYMMETRY, Repetitions
from service.pose.retrieval.scores import SCORES
from service.pose.retrieval.view_files import read_views, write_views
from service.pose.retrieval.viewpoints import VIEWPOINTS, ViewpointConfig, index_cameras

VERSION = 13
"""Raise it with any change of the code that makes stored indexes differ from fresh ones; `_key` covers the configs."""
log = logging.getLogger(__name__)


def prepared_index(tools: Tools[None], cache_dir: Path | None, viewpoints: ViewpointConfig = VIEWPOINTS) -> ViewIndex:
    """Read the scene's index from the cache, or build it, of many views at first a part; the whole one is stored."""
    # The names are hashes of all that their content depends on, so one of other values is never read.
    path = cache_dir / f"view-index-{_key(tools, viewpoints)}" if cache_dir else None
    free_views = FreeViews(cache_dir / f"free-views-{_key(tools, viewpoints, FREE_VIEWS)}" if cache_dir else None)

    def stored(index: ViewIndex) -> ViewIndex:
        if path:
            try:
                _write(index, path)
            except OSError as error:  # a full disk
                log.warning("the view index stays in memory: %s", error)
            # What is mapped takes no memory of this process's own.
            index = _read(path, free_views) or index
        return finished(replace(index, free_views=free_views))

    def finished(index: ViewIndex) -> ViewIndex:
        return replace(index, is_cut=viewpoints.cuts(len(index.views), len(tools.scene.cameras)))

    if found := _read(path, free_views):
        return finished(found)
    cameras = index_cameras(tools.scene, tools.rasterizer, tools.rng, viewpoints)
    return IndexBuilder(cameras, tools).first_part(stored)


def _key(tools: Tools[None], *more: object) -> str:
    """Return a hash of what views depend on: code, scene, matcher, rasterizer, and all values of these configs."""
    # The scene's digest covers the training cameras, but photos may be left out; the background may be assumed.
    visible = int(np.count_nonzero(tools.scene.opacities))  # floaters are left out
    scene = (tools.scene.info.sha256, visible, len(tools.scene.cameras), tools.scene.info.background_rgb)
    # Dataclasses of numbers: their repr names each value.
    configs = (*more, SPACE, PLANES, FLOATERS, LOD, VIEWS, CORNERS, SYMMETRY, AMBIGUITY, SCORES, INVERTED)
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
