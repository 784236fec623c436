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

from collections.abc import Generator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float64

from service.estimators.inerf import required_prior
from service.geometry import project, transformed
from service.interfaces import Tools
from service.pose.descent.adam import Adam
from service.pose.descent.gradient_descent import Se3, loss_and_gradient, require_within
from service.pose.descent.losses import loss_against, require_loss
from service.pose.features.image_sizes import RENDER_PX, sized
from service.pose.features.query_images import QueryImages
from service.pose.features.scene_focus import Focus, focus_of_scene
from service.pose.matching.correspondences import Correspondences
from service.pose.matching.render_and_match import epipolar_inliers, match_record, render_and_match
from service.results import IterationRecord
from service.types import Camera, Intrinsics, Pose, Query

MATCHES_IMAGES = True
"""The method also works with matchers that match images in pairs, without features of one image."""


@dataclass(frozen=True, slots=True)
class IcommaConfig:
    """Constants of the published method's code."""

    match_weight: float = 0.8
    """Weight of L_match; the photometric loss has the rest."""
    match_until: float = 0.001
    """L_match below which matching is switched off for good."""
    min_matches: int = 5
    """With fewer the photometric loss is alone."""
    decay: float = 0.6
    """Factor of the rate in `decay_steps` steps, from when matching is off."""
    decay_steps: int = 50


ICOMMA = IcommaConfig()


NEEDS_PRIOR = True


@dataclass(frozen=True, slots=True)
class Options:
    steps: int = 500
    rematch_every: int = 1
    """Steps for which the matches of one render are used."""
    rate: float = 0.05
    loss: str = "l2"
    """l1, l2, relative, feature, corner or blur."""
    long_side_px: int = RENDER_PX
    """Long side of the renders, in pixels."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "use_attribute_docstrings": True}

    def __post_init__(self) -> None:
        limits = {"steps": (1, 100_000), "rematch_every": (1, 100_000), "rate": (0, 10), "long_side_px": (32, 4096)}
        require_within(self, limits)
        require_loss(self.loss)


def prepare(tools: Tools[None], cache_dir: Path | None) -> Focus:
    """Return the scene's focus, which defines the normalized units."""
    return focus_of_scene(tools.scene, tools.rasterizer)


def run(
    query: Query, tools: Tools[Focus], options: Options, config: IcommaConfig = ICOMMA
) -> Generator[IterationRecord, None, None]:
    """Descend from the prior; the last record's pose is the answer. Raises InvalidPrior without a prior."""
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
        # Between two matchings the old correspondences stay valid: they are of scene points.
        if off_since is None and step % options.rematch_every == 0:
            matches, record = _rematch(Camera(intrinsics, pose), images, tools, config.min_matches)
        value, by_twist = loss_and_gradient(tools.rasterizer, intrinsics, pose, loss)
        if off_since is None and matches is not None:
            distance, by_match = match_loss(matches, query.intrinsics, pose)
            weight = config.match_weight
            value = weight * distance + (1 - weight) * value
            by_twist = weight * by_match + (1 - weight) * by_twist
            # Near the optimum noise of the matches would dominate, so the photometric loss goes on alone.
            off_since = step if distance < config.match_until else None
        if off_since is not None:
            # The exponent is 1 / decay_steps at the very step that switched matching off.
            adam.rate = options.rate * config.decay ** ((step - off_since + 1) / config.decay_steps)
        numbers = numbers - adam.step(pose_of.gradient(numbers, by_twist))
        reached = pose_of.pose(numbers)
        record = (
            replace(record, pose=reached, loss=value) if record else IterationRecord("compare", reached, loss=value)
        )
        yield record


def _rematch(
    camera: Camera, images: QueryImages, tools: Tools[Focus], min_matches: int
) -> tuple[Correspondences | None, IterationRecord]:
    """Match the photo with a render; return the epipolar inliers, None where they are too few, and the record."""
    found, view = next(render_and_match([camera], tools.rasterizer, images, tools.image_matcher))
    kept = epipolar_inliers(found, images.query.intrinsics)
    record = match_record("match", camera.pose, found, kept, view.camera)
    if int(kept.sum()) < min_matches:
        return None, record
    return Correspondences(found.photo_px[kept], found.view_px[kept], found.points_in_world[kept]), record


def match_loss(matches: Correspondences, intrinsics: Intrinsics, pose: Pose) -> tuple[float, Float64[np.ndarray, "6"]]:
    """Return L_match at a pose and its gradient by the right twist (rad, scene units).

    The mean is over the points ahead of the camera.
    """
    points = transformed(pose.camera_from_world, matches.points_in_world)
    seen = points[:, 2] > 1e-6
    if not np.any(seen):
        return 0.0, np.zeros(6)
    points = points[seen]
    # Relative to the image, so that L_match doesn't depend on the photo's resolution.
    size = np.array([intrinsics.width, intrinsics.height])
    offsets = (project(points, intrinsics) - matches.photo_px[seen]) / size
    # The chain rule through the pinhole projection, u = f x / z.
    x, y, z = points.T
    by_point = 2 * offsets / size / len(points) * np.stack([intrinsics.fx / z, intrinsics.fy / z], 1)
    by_xyz = np.stack([by_point[:, 0], by_point[:, 1], -(by_point[:, 0] * x + by_point[:, 1] * y) / z], 1)
    # The camera moves by exp(twist), its points by exp(-twist): dX = X x w - t.
    by_turn = np.cross(by_xyz, points).sum(0)
    return float(np.sum(offsets**2) / len(points)), np.concatenate([by_turn, -by_xyz.sum(0)])
