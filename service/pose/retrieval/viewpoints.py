"""Where to render the index from: a spread choice of the training cameras, or places found in the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from service.interfaces import Rasterizer
from service.pose.features.image_sizes import sized
from service.pose.features.scene_focus import centre_depth
from service.pose.retrieval.view_placement import PLACEMENT, PlacementConfig, find_views
from service.types import Camera, GaussianScene, Pose


@dataclass(frozen=True, slots=True)
class ViewpointConfig:
    """How many views the index has, and how large they are."""

    render_px: int = 384
    """Long side."""
    min_views: int = 64
    max_views: int = 20_000
    """A building of 12 million Gaussians and 6000 cameras needs 4439, which take 1 GB while the index is made."""
    spacing: float = 0.35
    """A wide scene gets more than `min_views`, until each training camera has one within this distance
    (`choose_spread_poses`)."""
    depth_cameras: int = 24
    """Training cameras, about, from whose renders the typical depth is taken."""
    placement: PlacementConfig = PLACEMENT
    """How views are found in a scene without cameras."""

    def cuts(self, views: int, cameras: int) -> bool:
        """Return whether so many views of a scene with so many training cameras are fewer than it needs."""
        return views >= (self.max_views if cameras else self.placement.max_views) and views != cameras


VIEWPOINTS = ViewpointConfig()


def index_cameras(
    scene: GaussianScene, rasterizer: Rasterizer, rng: np.random.Generator, config: ViewpointConfig = VIEWPOINTS
) -> list[Camera]:
    """Return the cameras that the view index is rendered with.

    They are a spread choice of the training cameras, or, without any, places found in the scene (`view_placement`);
    both where the cameras' frame is in doubt.
    """
    placed = []
    if not scene.cameras or scene.info.cameras_doubtful:
        found = find_views(scene, rasterizer, rng, config.placement)
        placed = [Camera(sized(camera.intrinsics, config.render_px), camera.pose) for camera in found.cameras]
    if not scene.cameras:
        return placed
    cameras = [named.camera for named in scene.cameras]
    # Rendering all of many cameras would take longer than the index itself.
    depths = [centre_depth(rasterizer, camera) for camera in cameras[:: -(-len(cameras) // config.depth_cameras)]]
    seen = [depth for depth in depths if depth > 0]
    chosen = choose_spread_poses([camera.pose for camera in cameras], float(np.median(seen)) if seen else 1.0, config)
    return [Camera(sized(cameras[i].intrinsics, config.render_px), cameras[i].pose) for i in chosen] + placed


def choose_spread_poses(
    poses: Sequence[Pose], depth: float, config: ViewpointConfig = VIEWPOINTS
) -> Int64[np.ndarray, "k"]:
    """Return a choice of the poses, by farthest-point sampling over position and viewing direction.

    Distances are |difference of positions| / `depth` (the typical one of what is seen) and the chord between the axes,
    added as squares: 0.35 is some 14 degrees on an orbit.
    """
    positions = np.stack([pose.position_in_world for pose in poses])
    axes = np.stack([pose.axis_in_world for pose in poses])
    # Both parts are without unit: the chord between two axes is at most 2.
    places = np.concatenate([positions / max(depth, 1e-9), axes], 1)
    return farthest_points(places, config.min_views, config.max_views, config.spacing)


def farthest_points(
    places: Float64[np.ndarray, "n d"], at_least: int, at_most: int, spacing: float
) -> Int64[np.ndarray, "k"]:
    """Return indices: first the place nearest to the median, then always the place farthest from those chosen.

    The choice ends with `at_most`, or once it has `at_least` and none is farther than `spacing` from it.
    """
    # The first is central, so that the choice doesn't depend on the cameras' order.
    chosen = [int(np.argmin(np.linalg.norm(places - np.median(places, axis=0), axis=1)))]
    distance = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < min(at_most, len(places)):
        farthest = int(np.argmax(distance))
        # Only duplicates of chosen places are left.
        if distance[farthest] == 0 or (len(chosen) >= at_least and distance[farthest] < spacing):
            break
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(places - places[farthest], axis=1))
    return np.array(chosen)
