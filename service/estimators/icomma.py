"""iComMa (Sun et al., 2023), "comparing and matching", as the supplement's section B runs it.

    loss = 0.8 L_match + 0.2 L_2,   L_match = mean over matches of (dx / w)^2 + (dy / h)^2

SE(3), Adam, 500 steps, the last pose is the answer. Once L_match < 0.001, matching is switched off for good, and the
rate, 0.05 until then, falls: 0.05 * 0.6^((k - k_off + 1) / 50). Fewer than 5 matches: L_2 alone in that step. From
the supplement: SE(3), 500 steps, matching by feature points, L2; the rest from the published method's code.

Deviations: L_match's gradient goes through the rendered depth of the matches (there: through the matcher's network);
the scene's own matcher, XFeat by default, in place of LoFTR. XFeat's pairs have no confidence to choose by: those
that one epipolar geometry explains are taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float64

from service.estimators.inerf import required_prior
from service.geometry import project, transformed
from service.interfaces import Tools
from service.pose.descent.adam import Adam
from service.pose.descent.gradient_descent import Se3, photometric, require_within
from service.pose.descent.losses import loss_against, require_loss
from service.pose.features.image_sizes import RENDER_PX, sized
from service.pose.features.query_images import QueryImages
from service.pose.matching.correspondences import Correspondences
from service.pose.matching.render_and_match import epipolar_inliers, match_record, render_and_match
from service.pose.retrieval.scene_focus import Focus, focus_of_scene
from service.results import IterationRecord
from service.types import Camera, Intrinsics, Pose, Query

MATCHES_IMAGES = True
"""It works with matchers that have no features of one image."""
MATCH_SHARE = 0.8
OFF_BELOW = 0.001
MIN_MATCHES = 5
DECAY, DECAY_STEPS = 0.6, 50


@dataclass(frozen=True, slots=True)
class Options:
    steps: int = 500
    rematch_every: int = 1
    """Steps for which the matches of one render are used."""
    rate: float = 0.05
    loss: str = "l2"
    """l1, l2, relative, feature, corner or blur."""
    long_side_px: int = RENDER_PX
    """Of the renders."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "use_attribute_docstrings": True}

    def __post_init__(self) -> None:
        limits = {"steps": (1, 100_000), "rematch_every": (1, 100_000), "rate": (0, 10), "long_side_px": (32, 4096)}
        require_within(self, limits)
        require_loss(self.loss)


def prepare(tools: Tools, cache_dir: Path | None) -> Focus:
    """Find the scene's focus: it defines the units."""
    return focus_of_scene(tools.scene, tools.rasterizer)


def run(query: Query, tools: Tools, options: Options) -> Iterator[IterationRecord]:
    """Descend from the prior. Raises InvalidPrior without one."""
    start = required_prior(query, "icomma")
    intrinsics = sized(query.intrinsics, options.long_side_px)
    images = QueryImages(query, tools.matcher)
    loss = loss_against(options.loss, images.resized(intrinsics), images.valid_mask(intrinsics))
    pose_of = Se3(start, tools.prepared)
    numbers, adam = np.zeros(6), Adam(6, options.rate)
    matches: Correspondences | None = None
    off_since: int | None = None
    yield IterationRecord("start", start)
    for step in range(options.steps):
        pose, record = pose_of.pose(numbers), None
        if off_since is None and step % options.rematch_every == 0:
            matches, record = _rematched(Camera(intrinsics, pose), images, tools)
        value, by_twist = photometric(tools.rasterizer, intrinsics, pose, loss)
        if off_since is None and matches is not None:
            apart, by_match = match_loss(matches, query.intrinsics, pose)
            value = MATCH_SHARE * apart + (1 - MATCH_SHARE) * value
            by_twist = MATCH_SHARE * by_match + (1 - MATCH_SHARE) * by_twist
            off_since = step if apart < OFF_BELOW else None
        if off_since is not None:
            adam.rate = options.rate * DECAY ** ((step - off_since + 1) / DECAY_STEPS)
        numbers = numbers - adam.step(pose_of.gradient(numbers, by_twist))
        reached = pose_of.pose(numbers)
        record = (
            replace(record, pose=reached, loss=value) if record else IterationRecord("compare", reached, loss=value)
        )
        yield record


def _rematched(camera: Camera, images: QueryImages, tools: Tools) -> tuple[Correspondences | None, IterationRecord]:
    """Match with a render; None where there is too little to go by."""
    found, view = render_and_match(camera, tools.rasterizer, images, tools.image_matcher)
    kept = epipolar_inliers(found, images.query.intrinsics)
    record = match_record("match", camera.pose, found, kept, view.camera)
    if int(kept.sum()) < MIN_MATCHES:
        return None, record
    return Correspondences(found.photo_px[kept], found.view_px[kept], found.points_in_world[kept]), record


def match_loss(matches: Correspondences, intrinsics: Intrinsics, pose: Pose) -> tuple[float, Float64[np.ndarray, "6"]]:
    """Return L_match at a pose and its gradient by the right twist; points behind the camera have no part."""
    points = transformed(pose.camera_from_world, matches.points_in_world)
    seen = points[:, 2] > 1e-6
    if not np.any(seen):
        return 0.0, np.zeros(6)
    points = points[seen]
    size = np.array([intrinsics.width, intrinsics.height])
    apart = (project(points, intrinsics) - matches.photo_px[seen]) / size
    x, y, z = points.T
    by_point = 2 * apart / size / len(points) * np.stack([intrinsics.fx / z, intrinsics.fy / z], 1)
    by_xyz = np.stack([by_point[:, 0], by_point[:, 1], -(by_point[:, 0] * x + by_point[:, 1] * y) / z], 1)
    # The camera moves by exp(twist), its points by exp(-twist): dX = X x w - t.
    by_turn = np.cross(by_xyz, points).sum(0)
    return float(np.sum(apart**2) / len(points)), np.concatenate([by_turn, -by_xyz.sum(0)])
