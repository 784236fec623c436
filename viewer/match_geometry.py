"""Geometry of matches at a pose: backprojected points, residuals, match vectors and their angles. Pure numpy.

The centre of the top-left pixel is (0.5, 0.5); poses are world_from_camera with OpenCV axes; depth is z-depth in scene
units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from service.results import MatchVectors
from service.types import Camera, Intrinsics, Pose

MIN_VECTOR_PX = 0.1
"""Below this length, which is finer than matches are, a match vector has no direction."""


@dataclass(frozen=True, slots=True)
class BackprojectedMatches:
    """Matches of one record with their points in the scene."""

    matches: MatchVectors
    points_in_world: Float64[np.ndarray, "m 3"]
    """NaN where the render shows nothing opaque."""
    index: int
    """Of the record that the matches belong to."""


@dataclass(frozen=True, slots=True)
class MatchView:
    """Matches relative to the camera of one step; the arrays' rows correspond."""

    photo_px: Float64[np.ndarray, "m 2"]
    render_px: Float64[np.ndarray, "m 2"]
    """In the image of `render_camera`; NaN behind the camera."""
    render_camera: Camera
    photo_camera: Camera
    """The photo's camera as the step estimates it."""
    inlier: Bool[np.ndarray, "m"]
    residual_px: Float64[np.ndarray, "m"]
    """Reprojection error of the scene's point in `photo_camera`, in photo pixels; NaN: unknown."""
    vectors_px: Float64[np.ndarray, "m 2"]
    """Match vectors: from the render's point to the photo's, both in pixels of the photo's intrinsics."""
    segments: Float32[np.ndarray, "s 2 3"]
    """In the world, from the scene's point to the photo's ray at the same depth; only where both are finite."""
    drawn: Bool[np.ndarray, "m"]
    """Which matches have a segment."""
    carried_from: int | None
    """Record whose matches these are, if they aren't the step's own."""


def backproject_matches(matches: MatchVectors, depth: Float32[np.ndarray, "h w"], index: int) -> BackprojectedMatches:
    """Return the matches of record `index` with their points in the scene, by the matched render's depth map."""
    camera = matches.render_camera
    column = np.clip(matches.render_px[:, 0].astype(int), 0, depth.shape[1] - 1)
    row = np.clip(matches.render_px[:, 1].astype(int), 0, depth.shape[0] - 1)
    z = np.asarray(depth[row, column], np.float64)
    # 0 marks pixels without an opaque surface.
    z[z <= 0] = np.nan
    return BackprojectedMatches(matches, backproject(matches.render_px, z, camera), index)


def matches_at_pose(source: BackprojectedMatches, camera: Camera, index: int) -> MatchView:
    """Return matches relative to the photo's camera as step `index` estimates it.

    Where the matches are of an earlier step, the render's points are the scene's points projected into `camera`.
    """
    matches = source.matches
    photo_px = matches.photo_px.astype(np.float64)
    projected_px = project(source.points_in_world, camera)
    carried = source.index != index
    if carried:  # they were matched with the render of another camera
        render_px, render_camera = projected_px, camera
    else:
        render_px, render_camera = matches.render_px.astype(np.float64), matches.render_camera
    segments = _segments(source.points_in_world, photo_px, camera)
    # One sum finds a NaN in any coordinate.
    drawn = np.isfinite(segments.sum((1, 2)))
    return MatchView(
        photo_px=photo_px,
        render_px=render_px,
        render_camera=render_camera,
        photo_camera=camera,
        inlier=matches.inlier,
        residual_px=np.linalg.norm(photo_px - projected_px, axis=1),
        vectors_px=photo_px - _change_intrinsics(render_px, render_camera.intrinsics, camera.intrinsics),
        segments=segments[drawn].astype(np.float32),
        drawn=drawn,
        carried_from=source.index if carried else None,
    )


def backproject(
    px: Float[np.ndarray, "m 2"], depth: Float64[np.ndarray, "m"], camera: Camera
) -> Float64[np.ndarray, "m 3"]:
    """Return the points in the world at pixels and z-depths of a camera."""
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
    """Return the mean angle between all pairs of vectors, the rotation loss of decoupled optimization.

    None if fewer than two vectors are long enough.
    """
    directions = _directions(vectors)
    if len(directions) < 2:
        return None
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    n = len(directions)
    return float((angles.sum() - np.trace(angles)) / (n * (n - 1)))


def direction_histogram(vectors: Float64[np.ndarray, "m 2"], bins: int) -> Float64[np.ndarray, "bins"]:
    """Return the number of vectors by direction; bin 0 is centred on +x, the next ones turn towards +y, downward."""
    directions = _directions(vectors)
    angle = np.arctan2(directions[:, 1], directions[:, 0])
    bin_of = np.rint(angle / (2 * np.pi) * bins).astype(int) % bins
    return np.bincount(bin_of, minlength=bins).astype(np.float64)


def pose_error(pose: Pose, truth: Pose) -> tuple[float, float]:
    """Return the distance between two poses: (rotation angle in degrees, distance of the centres in scene units)."""
    a, b = pose.world_from_camera, truth.world_from_camera
    # By the chord between the rotations: exact for small angles, where the arc cosine of the trace loses its digits.
    chord = np.linalg.norm(a[:3, :3] - b[:3, :3]) / np.sqrt(8)
    return float(np.degrees(2 * np.arcsin(min(1.0, chord)))), float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


def _segments(
    points_in_world: Float64[np.ndarray, "m 3"], photo_px: Float64[np.ndarray, "m 2"], camera: Camera
) -> Float64[np.ndarray, "m 2 3"]:
    """Return segments from each point to the photo's ray at the point's depth; NaN behind the camera."""
    camera_from_world = camera.pose.camera_from_world
    depth = points_in_world @ camera_from_world[2, :3] + camera_from_world[2, 3]
    depth = np.where(depth > 1e-9, depth, np.nan)
    return np.stack([points_in_world, backproject(photo_px, depth, camera)], 1)


def _change_intrinsics(
    px: Float64[np.ndarray, "m 2"], source: Intrinsics, target: Intrinsics
) -> Float64[np.ndarray, "m 2"]:
    """Return the pixels of the same rays in a camera with the intrinsics `target`."""
    rays = (px - [source.cx, source.cy]) / [source.fx, source.fy]
    return rays * [target.fx, target.fy] + [target.cx, target.cy]


def _directions(vectors: Float64[np.ndarray, "m 2"]) -> Float64[np.ndarray, "k 2"]:
    """Return unit vectors, without those too short to have a direction."""
    length = np.linalg.norm(vectors, axis=1)
    long_enough = np.isfinite(length) & (length > MIN_VECTOR_PX)
    return vectors[long_enough] / length[long_enough, None]
