"""Registration of a scene by another one: renders of the scene are localized in the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.progress import track

from service.cli.terminal import err, loaded_scene, scene_registrations
from service.errors import RegistrationFailed
from service.loaded_scene import LoadedScene
from service.localize import localize
from service.photos.images import read_query
from service.pose.retrieval.view_placement import find_views
from service.registration.gathering import LocalizedPhoto
from service.registration.known_places.known_place import KnownPlace, KnownPlaces
from service.registration.registration import Registration, by_unit
from service.results import PoseEstimate, Status
from service.scene_manager.scene_images import picture
from service.scene_manager.scene_registrations import registered_info
from service.scene_manager.status import PictureSpec
from service.scene_origin import shifted
from service.types import Camera

_RENDER_PX = 640
"""Long side of the renders."""


def target_of(other: Path, matcher: str) -> tuple[LoadedScene, Registration]:
    """Load another scene; return it with its registration, or one by its unit alone. Raises RegistrationFailed."""
    loaded = loaded_scene(other, "view_index", matcher)
    info = loaded.scene.info
    known = scene_registrations([other], [loaded])[0]
    if known is not None and known.is_complete:
        return loaded, known
    info = registered_info(info, known)
    if info.metres_per_unit is None:
        raise RegistrationFailed(
            "the scene is neither registered, nor is its unit known.",
            where=str(other),
            hint="Register it first, or give its scene.json metres_per_unit.",
        )
    return loaded, by_unit(info.metres_per_unit, info.up_in_world)


def renders_in(
    other: LoadedScene, scene: LoadedScene, count: int
) -> tuple[KnownPlaces, list[LocalizedPhoto], list[str]]:
    """Render a scene from its cameras, and localize the renders in another.

    Returns their places in that one's world, and a line for each render that was not found.
    """
    found, missed = [], []
    cameras = _cameras(scene)
    for number, camera in enumerate(track(cameras[:: max(1, -(-len(cameras) // count))], "renders", console=err)):
        intrinsics = camera.intrinsics.with_long_side(_RENDER_PX)
        image = picture(scene, PictureSpec(camera.pose, intrinsics, "png"))
        background = other.scene.info.background_rgb
        estimate = localize(read_query(image, intrinsics=intrinsics, background_rgb=background), other)
        name = f"render {number}"
        if estimate.verdict.status is Status.LOCALIZED:
            # No covariance: the scene was rendered at this very pose.
            found.append(LocalizedPhoto(name, _place(name, estimate), camera.pose, None))
        else:
            missed.append(f"{name} was not localized: {estimate.verdict.reason}.")
    up = other.scene.info.up_in_world
    return KnownPlaces("scene", tuple(photo.place for photo in found), up=up), found, missed


def _place(name: str, estimate: PoseEstimate) -> KnownPlace:
    rotation, covariance = estimate.pose.world_from_camera[:3, :3], estimate.verdict.covariance
    if covariance is None:
        return KnownPlace(name, estimate.pose.position_in_world, None, rotation)
    place = rotation @ covariance[3:, 3:] @ rotation.T
    sigma = float(np.sqrt(np.trace(covariance[:3, :3]) / 3))
    return KnownPlace(name, estimate.pose.position_in_world, place, rotation, sigma)


def _cameras(scene: LoadedScene) -> list[Camera]:
    """Return cameras in the world that see the scene: those of training, else those that an index would have."""
    within = [named.camera for named in scene.scene.cameras]
    if not within:
        within = list(find_views(scene.scene, scene.rasterizer, np.random.default_rng(0)).cameras)
    origin = scene.scene.info.origin_in_world
    return [Camera(camera.intrinsics, shifted(camera.pose, origin)) for camera in within]
