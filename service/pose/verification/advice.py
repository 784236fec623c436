"""What would help with a photo that isn't localized, from what was seen: where in the photo the scene was recognised,
how much of it the scene fills, how flat and how near that is, in which direction the covariance is widest, what a wider
picture would show, and how good the photo is as a picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64

from service.geometry import reprojection_error_px
from service.interfaces import Rasterizer
from service.pose.absolute_pose.prior_region import distance_outside
from service.pose.features.image_sizes import RENDER_PX
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import RenderedView, ViewRenderer, camera_of
from service.pose.matching.correspondences import MATCH_ERROR_PX, correspondences
from service.pose.verification.photo_quality import photo_faults
from service.pose.verification.signals import SIGNALS, typical_depth
from service.results import Reason, Status, Verdict
from service.types import BoxPrior, Camera, Pose


@dataclass(frozen=True, slots=True)
class AdviceConfig:
    """From when on something is said. Shares are of the photo, or of the matches that agree with the pose."""

    min_inliers: int = 20
    """Matches from which on the pose counts as the right place, and what is seen there as seen."""
    min_features: int = 30
    side_share: float = 0.85
    """Of the scene's pixels, or of the matches, in one half of the photo, that make it the only half..."""
    whole_coverage: float = 0.75
    """...if less of the photo than this shows the scene, or it was only recognised in that half."""
    small_coverage: float = 0.25
    max_flatness: float = 0.02
    """Deviation of the recognised points from their plane, relative to the distance, up to which they are flat: a wall
    has less than 0.01."""
    near_share: float = 0.25
    """Distance to what is seen, relative to the scene's extent, below which the camera is near..."""
    near_coverage: float = 0.95
    """...if that fills the photo."""
    widest_share: float = 0.7
    """Of the position's variance, along one direction, that makes it the widest."""
    lens_gain: float = 0.5
    """Standard deviation of the position if the lens was known, relative to now, up to which knowing it helps."""
    wide_factor: float = 2.0
    """Of the picture in which places that look alike are compared: its field of view, as the tangent of the half."""
    wide_px: int = 192
    min_difference: float = 0.02
    """Mean difference of colours (0..1) beside the photo, from which on the places differ."""
    most: int = 3
    """Sentences."""


ADVICE = AdviceConfig()
SIDES = ("left", "right", "up", "down")
_TURN = {"left": "turn left", "right": "turn right", "up": "tilt the camera up", "down": "tilt the camera down"}
_BESIDE = {"left": "to the left of it", "right": "to the right of it", "up": "above it", "down": "below it"}
_UNCERTAIN_ALONG = (
    ("sideways", "nearer"),
    ("up and down", "nearer"),
    ("along the viewing direction", "a step to the side"),
)
_HALF = {"left": "left half", "right": "right half", "up": "upper half", "down": "lower half"}


@dataclass(frozen=True, slots=True)
class _Seen:
    """What was seen at the answer."""

    solid: Bool[np.ndarray, "h w"]
    """Where the scene is opaque."""
    inliers_px: Float[np.ndarray, "n 2"]
    """Matches that agree with the pose, relative to the photo's width and height: 0..1."""
    points_in_camera: Float64[np.ndarray, "n 3"]
    features: int
    distance: float


def advice_for(
    images: QueryImages,
    pose: Pose,
    rasterizer: Rasterizer,
    verdict: Verdict,
    alternatives: Sequence[Pose] = (),
    scene_extent: float = np.inf,
    config: AdviceConfig = ADVICE,
) -> tuple[str, ...]:
    """Return what would help, the most helpful first, as sentences; nothing for a pose that is localized.

    `scene_extent` is the size of the scene's content, in scene units, as `content_extent` measures it.
    """
    if verdict.status is Status.LOCALIZED:
        return ()
    rendered = ViewRenderer(rasterizer).at(images.query, pose)
    seen = _seen(images, pose, rendered)
    said = photo_faults(images.query.rgb, rendered.frame.rgb)
    if seen.features < config.min_features and not said:
        said.append("The photo shows hardly any texture: turn to something with more, or step back.")
    if verdict.reason is Reason.OUTSIDE_PRIOR:
        said += _about_prior(images, pose)
    if alternatives:
        said += _what_tells_apart(images, pose, alternatives[0], rasterizer, config)
    if len(seen.inliers_px) >= config.min_inliers:
        said += _about_view(seen, config) + _about_position(seen, verdict, scene_extent, config)
    elif not said:
        said.append("Take a second photo from where the scene was captured.")
    elif not images.query.prior:
        said.append("Take a second photo, of another part of the scene.")
    return tuple(said[: config.most])


def content_extent(means: Float[np.ndarray, "n 3"]) -> float:
    """Return the size of a scene's content: twice the median distance of Gaussians from their median; inf of none."""
    if len(means) == 0:
        return np.inf
    some = means[:: max(1, len(means) // 10_000)]
    return 2.0 * float(np.median(np.linalg.norm(some - np.median(some, axis=0), axis=1)))


def _seen(images: QueryImages, pose: Pose, rendered: RenderedView) -> _Seen:
    query, features = images.query, images.features()
    found = correspondences(features, rendered.view(images.matcher), images.matcher)
    scale = RENDER_PX / query.intrinsics.long_side
    error = scale * reprojection_error_px(found.photo_px, found.points_in_world, query.intrinsics, pose)
    inlier = error < MATCH_ERROR_PX
    size = np.array([query.intrinsics.width, query.intrinsics.height])
    from_world = pose.camera_from_world
    return _Seen(
        rendered.frame.alpha > SIGNALS.min_alpha,
        found.photo_px[inlier] / size,
        found.points_in_world[inlier] @ from_world[:3, :3].T + from_world[:3, 3],
        len(features.scores),
        typical_depth(rendered.frame),
    )


def _about_view(seen: _Seen, config: AdviceConfig) -> list[str]:
    """Return where to point the camera: to the side on which the scene is, or nearer to it."""
    coverage = float(seen.solid.mean())
    rows, columns = np.nonzero(seen.solid)
    height, width = seen.solid.shape
    filled = np.stack([(columns + 0.5) / width, (rows + 0.5) / height], 1)
    side = _only_side(filled, config)
    if coverage < config.whole_coverage and side:
        return [f"The scene fills only the {_HALF[side]} of the photo: {_TURN[side]}."]
    side = _only_side(seen.inliers_px, config)
    if side:
        return [f"Only the {_HALF[side]} of the photo was recognised: {_TURN[side]}."]
    if coverage < config.small_coverage:
        return [f"The scene fills only {100 * coverage:.0f} % of the photo: step nearer."]
    return []


def _only_side(points: Float[np.ndarray, "n 2"], config: AdviceConfig) -> str:
    """Return the side whose half has nearly all of the points (x, y in 0..1); empty if none has."""
    if len(points) == 0:
        return ""
    x, y = (points < 0.5).mean(0)
    shares = dict(zip(SIDES, (x, 1.0 - x, y, 1.0 - y), strict=True))
    side = max(shares, key=lambda name: shares[name])
    return side if shares[side] >= config.side_share else ""


def _about_position(seen: _Seen, verdict: Verdict, scene_extent: float, config: AdviceConfig) -> list[str]:
    """Return what would make the position more certain: another lens or stand, or depth in the picture."""
    said = []
    if verdict.covariance is None:
        return said
    known, covariance = verdict.covariance_given_lens, verdict.covariance[3:, 3:]
    sigma = float(np.sqrt(np.trace(covariance)))
    if known is not None and (certain := float(np.sqrt(np.trace(known[3:, 3:])))) < config.lens_gain * sigma:
        said.append(
            f"With the exact intrinsics of the lens the position is certain to {certain:.3g} units, not {sigma:.3g}: "
            "send them."
        )
    near = seen.distance < config.near_share * scene_extent
    if near and seen.solid.mean() > config.near_coverage:
        said.append("The camera is near what fills the photo: step back, so that more of the scene is in the picture.")
    elif _flatness(seen) < config.max_flatness:
        said.append(
            "All that was recognised lies in one plane: turn so that nearer or farther things are in the picture."
        )
    if verdict.reason in (Reason.POSITION_UNCERTAIN, Reason.FOCAL_UNCERTAIN):
        said += _about_direction(covariance, config)
    return said


def _about_direction(covariance: Float64[np.ndarray, "3 3"], config: AdviceConfig) -> list[str]:
    """Return from where another photo would tell what this one leaves open, by where the covariance is widest."""
    variances, axes = np.linalg.eigh(covariance)
    if variances[-1] < config.widest_share * variances.sum():
        return []
    along = int(np.argmax(np.abs(axes[:, -1])))
    direction, stand = _UNCERTAIN_ALONG[along]
    return [f"The position is least certain {direction}: take a second photo from {stand}."]


def _flatness(seen: _Seen) -> float:
    """Return the standard deviation of the recognised points from their plane, relative to their distance."""
    points = seen.points_in_camera
    # A few wrong matches mustn't make a wall thick.
    centred = points - np.median(points, axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    return 1.4826 * float(np.median(np.abs(centred @ axes[-1]))) / seen.distance


def _about_prior(images: QueryImages, pose: Pose) -> list[str]:
    region = images.query.region
    if region is None:
        return []
    beyond = distance_outside(region, pose)
    unit = "units outside the prior's box" if isinstance(region, BoxPrior) else "standard deviations outside the prior"
    return [f"The photo fits {beyond:.3g} {unit}: check the prior, or widen it."]


def _what_tells_apart(
    images: QueryImages, pose: Pose, other: Pose, rasterizer: Rasterizer, config: AdviceConfig
) -> list[str]:
    """Return on which side, outside of the photo, two places that look alike differ most."""
    camera = camera_of(images.query, pose, config.wide_px).intrinsics
    wide = replace(camera, fx=camera.fx / config.wide_factor, fy=camera.fy / config.wide_factor)
    one, two = (frame.rgb for frame in rasterizer.render([Camera(wide, pose), Camera(wide, other)]))
    difference = np.abs(one - two).mean(2)
    # The photo is in the middle.
    x, y = (round(side * 0.5 * (1 - 1 / config.wide_factor)) for side in (wide.width, wide.height))
    strips = (difference[:, :x], difference[:, -x:], difference[:y], difference[-y:])
    means = [float(strip.mean()) for strip in strips]
    side = SIDES[int(np.argmax(means))]
    if max(means) < config.min_difference:
        return ["The surroundings of these places look alike, too: take a second photo, farther away."]
    return [f"The places that the photo fits differ most {_BESIDE[side]}: {_TURN[side]}, or step back."]
