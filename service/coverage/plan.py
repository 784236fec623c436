"""The plan view of a scene, and the places where photos of it may be taken: cells around the capture's cameras.

Height, pitch and lens of each place and heading are those of the nearest of the capture's cameras that looks about
there; without training cameras, of the view index's views. Positions are relative to the scene's origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from service.coverage.coverage_map import heading_of
from service.geometry import look_at
from service.interfaces import Rasterizer
from service.pose.features.image_sizes import sized
from service.pose.retrieval.free_space import Space, free_space_of
from service.pose.retrieval.lod_proxy import lod_proxy
from service.pose.retrieval.view_placement import shows_single_surface
from service.types import Camera, GaussianScene, Pose


@dataclass(frozen=True, slots=True)
class PlanConfig:
    """Sizes of the map. All are this map's own choice."""

    cells: int = 64
    """About so many cover the places around the capture's cameras."""
    headings: int = 12
    reach: float = 0.25
    """How far around the capture's cameras photos are taken, as a share of the distance to what these see."""
    heading_weight: float = 1.0
    """Of the chord between two directions against distances in reaches, where the nearest camera is looked for."""
    novel_position: float = 0.5
    """Distance to the nearest of the capture's cameras, as a share of the distance to what is seen, and chord between
    the viewing directions, that count as 1 in the novelty."""
    novel_chord: float = 0.5
    render_px: int = 64
    """Long side of the renders by which it is decided whether a place sees the scene."""
    min_distance: float = 0.06
    """What is nearer than this share of the distance blocks the view."""
    min_solid_share: float = 0.3
    """A place sees the scene if the share of its view that shows a single surface is this share of the capture's."""


PLAN = PlanConfig()
NEAREST = 4
"""Cameras from which a place must be in sight, one of them."""
FLATTER = 0.8
"""A scene's extent along -y, relative to that along z, below which -y is taken to be up."""


@dataclass(frozen=True, slots=True)
class Places:
    """Cells and headings, each with its camera."""

    plan_from_world: Float64[np.ndarray, "3 3"]
    cell: float
    positions: Float64[np.ndarray, "c 3"]
    headings_rad: Float64[np.ndarray, "h"]
    cameras: tuple[tuple[Camera, ...], ...]
    """By cell and heading."""
    sees_scene: Bool[np.ndarray, "c h"]
    novelties: Float64[np.ndarray, "c h"]


def find_places(
    scene: GaussianScene,
    rasterizer: Rasterizer,
    captured: Sequence[Camera],
    distance: float,
    rng: np.random.Generator,
    config: PlanConfig = PLAN,
) -> Places:
    """Return where photos may be taken; `distance` is the typical one to what `captured`, at least one camera, see."""
    space = free_space_of(scene)
    # Views that were placed without a known up direction are upright by several.
    assumed = None if scene.cameras else assumed_up(space.points)
    plan = plan_axes(captured, scene.info.up_in_world or assumed)
    at = np.array([plan @ camera.pose.position_in_world for camera in captured])
    cell, middles = _cells(at[:, :2], config.reach * distance, config.cells)
    headings = np.arange(config.headings) * 2 * np.pi / config.headings
    rows = [[_camera(m, h, captured, at, plan, config.reach * distance, config) for h in headings] for m in middles]
    heights = np.array([np.median([plan[2] @ c.pose.position_in_world for c in row]) for row in rows])
    positions = np.column_stack([middles, heights]) @ plan
    # At so few pixels the reduced scene shows the same surfaces as the whole one, in less time.
    search = lod_proxy(scene, rasterizer, rng)
    least = config.min_solid_share * float(np.median(_solid_shares(search, captured[:64], distance, config)))
    flat = [camera for row in rows for camera in row]
    solid = _solid_shares(search, flat, distance, config)
    standing = np.array([camera.pose.position_in_world for camera in flat])
    free = ~space.occupied(standing) & _reached(standing, at @ plan, space)
    # Where half of the capture's cameras see nothing solid the median is 0, and everything would pass.
    sees = (free & (solid >= max(least, 1e-9))).reshape(len(middles), config.headings)
    kept = np.flatnonzero(sees.any(1))
    return Places(
        plan, cell, positions[kept], headings, tuple(tuple(rows[i]) for i in kept),
        sees[kept], novelty(flat, captured, distance, config).reshape(sees.shape)[kept],
    )  # fmt: skip


def novelty(
    cameras: Sequence[Camera], captured: Sequence[Camera], distance: float, config: PlanConfig = PLAN
) -> Float64[np.ndarray, "n"]:
    """Return how far cameras are from the nearest of the capture's, over position and viewing direction.

    The root of two squares: distance in shares of `distance`, and the chord between the axes, each relative to what
    the config has; what a photo shows there was seen from about here where it is below 1.
    """
    own = np.array([(c.pose.position_in_world, c.pose.axis_in_world) for c in cameras]).reshape(-1, 2, 3)
    known = np.array([(c.pose.position_in_world, c.pose.axis_in_world) for c in captured])
    scale = np.array([config.novel_position * distance, config.novel_chord])
    apart = np.linalg.norm(own[:, None] - known, axis=3) / scale
    return np.sqrt((apart**2).sum(2)).min(1)


def _reached(
    positions: Float64[np.ndarray, "n 3"], captured: Float64[np.ndarray, "k 3"], space: Space
) -> Bool[np.ndarray, "n"]:
    """Return which positions are in sight of one of the nearest cameras: others lie behind walls."""
    rays = positions[:, None] - captured
    apart = np.linalg.norm(rays, axis=2)
    near = np.argsort(apart, 1)[:, :NEAREST]
    rays, apart = (np.take_along_axis(a, b, 1) for a, b in ((rays, near[..., None]), (apart, near)))
    starts = captured[near].reshape(-1, 3)
    directions = (rays / np.maximum(apart, 1e-12)[..., None]).reshape(-1, 3)
    clear = space.free_distance(starts, directions, float(apart.max())).reshape(apart.shape)
    # A surface occupies whole cells, so free space ends up to a cell before it.
    return np.asarray((clear >= apart - space.cell).any(1))


def assumed_up(points: Float64[np.ndarray, "n 3"]) -> tuple[float, float, float]:
    """Return the up direction of a scene of which nothing tells it: z, or -y (COLMAP's) if it is much flatter by that.

    Rooms, buildings and streets are wider than high.
    """
    _, y, z = np.subtract(*np.quantile(points, [0.95, 0.05], axis=0))
    return (0.0, -1.0, 0.0) if y < FLATTER * z else (0.0, 0.0, 1.0)


def plan_axes(captured: Sequence[Camera], up_in_world: tuple[float, float, float] | None) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation from the world to the plan: up is the third axis, the first is nearest to a world axis.

    Without a known up direction it is the mean of the cameras' own.
    """
    up = np.array(up_in_world) if up_in_world else -np.sum([c.pose.world_from_camera[:3, 1] for c in captured], 0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-6 else np.array([0.0, 0.0, 1.0])
    # The world axis that is least parallel to up: its projection into the plan can't vanish.
    first = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def _cells(at: Float64[np.ndarray, "n 2"], reach: float, count: int) -> tuple[float, Float64[np.ndarray, "c 2"]]:
    """Return the side and the middles of about `count` square cells that lie within reach of points."""
    low, high = at.min(0) - reach, at.max(0) + reach
    cell = float(np.sqrt(np.prod(high - low) / count))
    middles = _middles_near(at, low, high, cell, reach)
    # Cells away from the cameras are left out: smaller ones, until there are enough.
    for _ in range(8):
        if len(middles) >= 0.9 * count:
            break
        cell *= 0.85
        middles = _middles_near(at, low, high, cell, reach)
    return cell, middles


def _middles_near(
    at: Float64[np.ndarray, "n 2"],
    low: Float64[np.ndarray, "2"],
    high: Float64[np.ndarray, "2"],
    cell: float,
    reach: float,
) -> Float64[np.ndarray, "c 2"]:
    across = [np.arange(a + 0.5 * cell, b + 0.5 * cell, cell) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*across, indexing="ij"), -1).reshape(-1, 2)
    return grid[np.linalg.norm(grid[:, None] - at, axis=2).min(1) <= reach]


def _camera(
    middle: Float64[np.ndarray, "2"],
    heading: float,
    captured: Sequence[Camera],
    at: Float64[np.ndarray, "n 3"],
    plan: Float64[np.ndarray, "3 3"],
    reach: float,
    config: PlanConfig,
) -> Camera:
    """Return a camera at a place that looks along a heading (rad), otherwise like the nearest camera of the capture."""
    directions = np.array([heading_of(camera.pose, plan) for camera in captured])
    chords = 2 * np.abs(np.sin(0.5 * (directions - heading)))
    apart = np.linalg.norm(at[:, :2] - middle, axis=1) / reach
    like = int(np.argmin(apart**2 + (config.heading_weight * chords) ** 2))
    pitch = float(np.arcsin(np.clip(plan[2] @ captured[like].pose.axis_in_world, -1, 1)))
    return Camera(captured[like].intrinsics, pose_at(np.array([*middle, at[like, 2]]), heading, pitch, plan))


def pose_at(at: Float64[np.ndarray, "3"], heading: float, pitch: float, plan: Float64[np.ndarray, "3 3"]) -> Pose:
    """Return an upright camera at a position of the plan with this heading and pitch (rad, above the horizon)."""
    # An axis parallel to up has no upright camera.
    pitch = float(np.clip(pitch, np.radians(-85), np.radians(85)))
    axis = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)])
    return look_at(at @ plan, (at + axis) @ plan, plan[2])


def _solid_shares(
    search: Rasterizer, cameras: Sequence[Camera], distance: float, config: PlanConfig
) -> Float64[np.ndarray, "n"]:
    small = [Camera(sized(camera.intrinsics, config.render_px), camera.pose) for camera in cameras]
    frames = search.render(small, approximate=True)
    return np.array([float(shows_single_surface(f, config.min_distance * distance).mean()) for f in frames])


def spread(places: Places, count: int) -> Int64[np.ndarray, "k 2"]:
    """Return at most `count` pairs of cell and heading that see the scene, spread evenly: farthest points first."""
    pairs = np.argwhere(places.sees_scene)
    if not len(pairs):
        return pairs
    angles = places.headings_rad[pairs[:, 1]]
    at = (places.positions[pairs[:, 0]] @ places.plan_from_world.T)[:, :2] / places.cell
    # Opposite headings at one place count as far apart as places at a distance of four cells.
    coordinates = np.column_stack([at, 2 * np.cos(angles), 2 * np.sin(angles)])
    chosen, apart = [0], np.linalg.norm(coordinates - coordinates[0], axis=1)
    while len(chosen) < min(count, len(pairs)):
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.linalg.norm(coordinates - coordinates[chosen[-1]], axis=1))
    return pairs[chosen]
