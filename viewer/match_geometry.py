"""What matches say of a pose: points, residuals, vectors and their angles. Pure numpy.

Pixels have the centre of the top-left one at (0.5, 0.5); poses are world_from_camera with OpenCV axes; depth is
z-depth in scene units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from service.results import MatchVectors
from service.types import Camera, Intrinsics, Pose


@dataclass(frozen=True, slots=True)
class BackprojectedMatches:
    """Matches with the points of the scene that they mean."""

    matches: MatchVectors
    points_in_world: Float64[np.ndarray, "m 3"]
    """NaN where the render shows nothing opaque."""
    index: int
    """Of the record that the matches are of."""


@dataclass(frozen=True, slots=True)
class MatchView:
    """Matches as one step sees them; rows belong together."""

    photo_px: Float64[np.ndarray, "m 2"]
    render_px: Float64[np.ndarray, "m 2"]
    """In the picture of `render_camera`; NaN behind the camera."""
    render_camera: Camera
    photo_camera: Camera
    """The photo's, as the step has it."""
    inlier: Bool[np.ndarray, "m"]
    residual_px: Float64[np.ndarray, "m"]
    """Between the photo's point and the scene's point seen from the step's pose, in photo pixels; NaN: unknown."""
    vectors_px: Float64[np.ndarray, "m 2"]
    """From the render's point to the photo's, as if both had the photo's camera."""
    segments: Float32[np.ndarray, "s 2 3"]
    """In the world, from the scene's point to the photo's ray at the same depth: where both are known."""
    drawn: Bool[np.ndarray, "m"]
    """Which matches have a segment."""
    carried_from: int | None
    """Record that the matches were made for, if it isn't the step's own."""


def backproject_matches(matches: MatchVectors, depth: Float32[np.ndarray, "h w"], index: int) -> BackprojectedMatches:
    """Find the scene's point of each match by the depth of the render that was matched."""
    camera = matches.render_camera
    column = np.clip(matches.render_px[:, 0].astype(int), 0, depth.shape[1] - 1)
    row = np.clip(matches.render_px[:, 1].astype(int), 0, depth.shape[0] - 1)
    z = np.asarray(depth[row, column], np.float64)
    z[z <= 0] = np.nan
    return BackprojectedMatches(matches, backproject(matches.render_px, z, camera), index)


def matches_at_pose(source: BackprojectedMatches, at_pose: Camera, index: int) -> MatchView:
    """Return the matches as the step `index`, which gives the photo this camera, sees them."""
    matches = source.matches
    photo_px = matches.photo_px.astype(np.float64)
    seen_px = project(source.points_in_world, at_pose)
    carried = source.index != index
    if carried:  # matched with another picture: where the points are in this one
        render_px, render_camera = seen_px, at_pose
    else:
        render_px, render_camera = matches.render_px.astype(np.float64), matches.render_camera
    segments = _segments(source.points_in_world, photo_px, at_pose)
    drawn = np.isfinite(segments.sum((1, 2)))
    return MatchView(
        photo_px=photo_px,
        render_px=render_px,
        render_camera=render_camera,
        photo_camera=at_pose,
        inlier=matches.inlier,
        residual_px=np.linalg.norm(photo_px - seen_px, axis=1),
        vectors_px=photo_px - _as_if(at_pose.intrinsics, render_px, render_camera.intrinsics),
        segments=segments[drawn].astype(np.float32),
        drawn=drawn,
        carried_from=source.index if carried else None,
    )


def backproject(
    px: Float[np.ndarray, "m 2"], depth: Float64[np.ndarray, "m"], camera: Camera
) -> Float64[np.ndarray, "m 3"]:
    """Return the points of the world at pixels and z-depths."""
    k, world_from_camera = camera.intrinsics, camera.pose.world_from_camera
    rays = np.column_stack([(np.asarray(px, np.float64) - [k.cx, k.cy]) / [k.fx, k.fy], np.ones(len(px))])
    return (depth[:, None] * rays) @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]


def project(points_in_world: Float64[np.ndarray, "m 3"], camera: Camera) -> Float64[np.ndarray, "m 2"]:
    """Return the pixels of points; NaN behind the camera."""
    k, camera_from_world = camera.intrinsics, camera.pose.camera_from_world
    points = points_in_world @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    z = np.where(points[:, 2] > 1e-9, points[:, 2], np.nan)
    return points[:, :2] / z[:, None] * [k.fx, k.fy] + [k.cx, k.cy]


def mean_angle_deg(vectors: Float64[np.ndarray, "m 2"]) -> float | None:
    """Return the mean angle between any two vectors: what decoupled optimization turns the camera to lessen."""
    directions = _directions(vectors)
    if len(directions) < 2:
        return None
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    n = len(directions)
    return float((angles.sum() - np.trace(angles)) / (n * (n - 1)))


def angle_counts(vectors: Float64[np.ndarray, "m 2"], bins: int) -> Float64[np.ndarray, "bins"]:
    """Count vectors by direction; bin 0 is centred on +x, and they go on towards +y, which is down."""
    directions = _directions(vectors)
    angle = np.arctan2(directions[:, 1], directions[:, 0])
    bin_of = np.rint(angle / (2 * np.pi) * bins).astype(int) % bins
    return np.bincount(bin_of, minlength=bins).astype(np.float64)


def pose_error(found: Pose, truth: Pose) -> tuple[float, float]:
    """Return how far two poses are apart: (degrees, scene units)."""
    a, b = found.world_from_camera, truth.world_from_camera
    # The chord between the rotations, exact for small angles, where the arc cosine of the trace is not.
    chord = np.linalg.norm(a[:3, :3] - b[:3, :3]) / np.sqrt(8)
    return float(np.degrees(2 * np.arcsin(min(1.0, chord)))), float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


def _segments(
    points_in_world: Float64[np.ndarray, "m 3"], photo_px: Float64[np.ndarray, "m 2"], camera: Camera
) -> Float64[np.ndarray, "m 2 3"]:
    """From each point to the place on the photo's ray at the same depth."""
    camera_from_world = camera.pose.camera_from_world
    depth = points_in_world @ camera_from_world[2, :3] + camera_from_world[2, 3]
    depth = np.where(depth > 1e-9, depth, np.nan)
    return np.stack([points_in_world, backproject(photo_px, depth, camera)], 1)


def _as_if(target: Intrinsics, px: Float64[np.ndarray, "m 2"], source: Intrinsics) -> Float64[np.ndarray, "m 2"]:
    """Move pixels of one camera to where another one in the same place would have them."""
    rays = (px - [source.cx, source.cy]) / [source.fx, source.fy]
    return rays * [target.fx, target.fy] + [target.cx, target.cy]


SHORTEST_PX = 0.1
"""Matches are no finer: what is shorter has no direction that means anything."""


def _directions(vectors: Float64[np.ndarray, "m 2"]) -> Float64[np.ndarray, "k 2"]:
    """Unit vectors of those that have a direction."""
    length = np.linalg.norm(vectors, axis=1)
    has_one = np.isfinite(length) & (length > SHORTEST_PX)
    return vectors[has_one] / length[has_one, None]
