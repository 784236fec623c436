"""Where to render the index from: a spread choice of the training cameras, or places found in the scene.

Without training cameras, candidates on shells around the scene's middle and in its volume are rendered small and
judged by one measure, `solidity`: the share of the image where one opaque surface is seen at a fair distance. Seen
from where the photos were taken, surfaces are solid; from behind walls, inside floaters and towards parts never
photographed, the depths along a ray disagree. On the test scenes: 0.8 to 0.94 near the training cameras of a room's
corner, 0.05 to 0.3 elsewhere. Objects that were photographed all around are solid from everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from service.geometry import look_at, nearest_point_to_axes
from service.interfaces import Frame, Rasterizer
from service.pose.views import sized
from service.types import Camera, GaussianScene, Intrinsics, Pose

INDEX_PX = 384
INDEX_VIEWS = 64
MAX_INDEX_VIEWS = 256
MAX_FOUND_VIEWS = 128
SPREAD = 0.35
"""A wide scene gets more views, until each training camera has one within this distance (see `spread`)."""
SEARCH_PX = 64
SEARCH_FOV_DEG = 60.0
SHELLS = (1.2, 2.0, 3.4)
"""Radii, in units of the radius that holds half of the opaque Gaussians."""
SHELL_CANDIDATES = 60
VOLUME_CANDIDATES = 150
BEST, OFFSPRING = 50, 4
MIN_OPACITY = 0.3


def index_cameras(scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator) -> list[Camera]:
    """Return the cameras that the view index is rendered with."""
    if not scene.cameras:
        return found_cameras(scene, rasterizer, rng)
    cameras = [named.camera for named in scene.cameras]
    chosen = spread([camera.pose for camera in cameras])
    return [Camera(sized(cameras[i].intrinsics, INDEX_PX), cameras[i].pose) for i in chosen]


def spread(poses: Sequence[Pose]) -> Int64[np.ndarray, "k"]:
    """Choose poses by farthest point over position and viewing direction.

    Distances are |difference of positions| / (median distance from the focus) and the chord between the axes,
    added as squares: 0.35 is some 14 degrees on an orbit.
    """
    focus = nearest_point_to_axes(poses)
    distances = [np.linalg.norm(pose.position_in_world - focus) for pose in poses]
    places = _places(poses, float(np.median(distances)))
    return farthest_points(places, INDEX_VIEWS, MAX_INDEX_VIEWS, SPREAD)


def farthest_points(
    places: Float64[np.ndarray, "n d"], at_least: int, at_most: int, spacing: float
) -> Int64[np.ndarray, "k"]:
    """Take the place farthest from those taken, until `at_least` are and none is farther than `spacing`."""
    chosen = [int(np.argmin(np.linalg.norm(places - np.median(places, axis=0), axis=1)))]
    distance = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < min(at_most, len(places)):
        farthest = int(np.argmax(distance))
        if distance[farthest] == 0 or (len(chosen) >= at_least and distance[farthest] < spacing):
            break
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(places - places[farthest], axis=1))
    return np.array(chosen)


def found_cameras(scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator) -> list[Camera]:
    """Find places from which the scene looks as it did to the cameras that it was trained with."""
    opaque = scene.means[scene.opacities > MIN_OPACITY].astype(np.float64)
    opaque = opaque if len(opaque) else scene.means.astype(np.float64)
    middle = np.median(opaque, axis=0)
    radius = float(np.median(np.linalg.norm(opaque - middle, axis=1)))
    up = np.array(scene.info.up_in_world or (0.0, 0.0, 1.0))
    search = _intrinsics(SEARCH_PX)

    def judged(poses: list[Pose]) -> Float64[np.ndarray, "n"]:
        frames = rasterizer.render([Camera(search, pose) for pose in poses])
        return np.array([solidity(frame, 0.1 * radius) for frame in frames])

    poses = _shell_poses(middle, radius, up) + _volume_poses(opaque, up, rng)
    scores = judged(poses)
    best = np.argsort(-scores, kind="stable")[:BEST]
    more = [_jittered(poses[i], 0.3 * radius, up, rng) for i in best for _ in range(OFFSPRING)]
    poses, scores = poses + more, np.concatenate([scores, judged(more)])
    good = [poses[i] for i in np.flatnonzero(scores >= 0.5 * np.quantile(scores, 0.9))]
    chosen = farthest_points(_places(good, radius), INDEX_VIEWS, MAX_FOUND_VIEWS, SPREAD)
    return [Camera(sized(_intrinsics(INDEX_PX), INDEX_PX), good[i]) for i in chosen]


def solidity(frame: Frame, min_distance: float) -> float:
    """Return the share of the image that shows one opaque surface, not nearer than `min_distance`."""
    apart = np.abs(frame.depth - frame.median_depth)
    solid = (frame.alpha > 0.9) & (frame.median_depth > min_distance) & (apart < 0.05 * frame.median_depth)
    return float(solid.mean())


def _intrinsics(long_side: int) -> Intrinsics:
    focal = 0.5 * long_side / np.tan(np.radians(0.5 * SEARCH_FOV_DEG))
    height = long_side * 3 // 4
    return Intrinsics(long_side, height, focal, focal, 0.5 * long_side, 0.5 * height)


def _places(poses: Sequence[Pose], unit: float) -> Float64[np.ndarray, "n 6"]:
    positions = np.stack([pose.position_in_world for pose in poses])
    return np.concatenate([positions / max(unit, 1e-9), np.stack([pose.axis_in_world for pose in poses])], 1)


def _shell_poses(middle: Float64[np.ndarray, "3"], radius: float, up: Float64[np.ndarray, "3"]) -> list[Pose]:
    """Look at the middle from evenly spread directions (a Fibonacci lattice)."""
    i = np.arange(SHELL_CANDIDATES) + 0.5
    z, angle = 1 - 2 * i / SHELL_CANDIDATES, np.pi * (1 + np.sqrt(5.0)) * i
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)
    return [look_at(middle + factor * radius * d, middle, up) for factor in SHELLS for d in directions]


def _volume_poses(
    opaque: Float64[np.ndarray, "n 3"], up: Float64[np.ndarray, "3"], rng: np.random.Generator
) -> list[Pose]:
    """Look from random places in the volume towards random opaque Gaussians: what rooms need."""
    low, high = np.quantile(opaque, [0.05, 0.95], axis=0)
    positions = rng.uniform(low, high, (VOLUME_CANDIDATES, 3))
    targets = opaque[rng.integers(len(opaque), size=VOLUME_CANDIDATES)]
    return [look_at(p, t, up) for p, t in zip(positions, targets, strict=True) if np.any(p != t)]


def _jittered(pose: Pose, reach: float, up: Float64[np.ndarray, "3"], rng: np.random.Generator) -> Pose:
    """Move a pose a little and turn it by some 15 degrees, upright again."""
    position = pose.position_in_world + reach * rng.uniform(-1, 1, 3)
    axis = pose.axis_in_world + 0.25 * rng.standard_normal(3)
    return look_at(position, position + axis, up)
