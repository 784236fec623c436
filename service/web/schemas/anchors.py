"""Anchors of a scene as the API takes and returns them, and as a photo's camera sees them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from service.geodesy import geographic, utm_from_geographic
from service.geometry import transformed
from service.photos.intrinsics import distorted_pixels
from service.scene_manager.anchor_store import Anchor
from service.types import GeoAnchor, Intrinsics, Pose
from service.web.api_model import Model


class AnchorIn(Model):
    """Where an anchor is."""

    position: list[float] = Field(min_length=3, max_length=3)
    """In the scene's world, in scene units."""


class AnchorOut(Model):
    """A named point of a scene."""

    name: str
    position: list[float]
    """In the scene's world, in scene units."""


class AnchorList(Model):
    """The anchors of a scene."""

    anchors: list[AnchorOut]


class GeographicOut(Model):
    """A place on Earth: WGS84, and the same in UTM."""

    latitude: float
    """Degrees."""
    longitude: float
    """Degrees."""
    height: float
    """Metres above the ellipsoid."""
    utm_zone: str
    """E.g. 32N."""
    easting: float
    """Metres."""
    northing: float
    """Metres."""


class SeenAnchor(AnchorOut):
    """An anchor as the photo's camera sees it; whether something stands before it is not known."""

    in_camera: list[float]
    """In the camera's frame (+x right, +y down, +z forward), scene units."""
    pixel: list[float] | None
    """In the whole upright photo, with its lens' distortion; null: behind the camera or outside of the photo."""
    geographic: GeographicOut | None
    """On Earth, for scenes that are registered there, or whose manifest has a `geo_anchor`."""


def anchor_out(anchor: Anchor) -> AnchorOut:
    """Convert an anchor."""
    return AnchorOut(name=anchor.name, position=anchor.position_in_world.tolist())


def seen_anchors(
    anchors: Sequence[Anchor], pose: Pose, intrinsics: Intrinsics, geo_anchor: GeoAnchor | None
) -> list[SeenAnchor]:
    """Convert the anchors of the scene that a photo was localized in."""
    return [_seen(anchor, pose, intrinsics, geo_anchor) for anchor in anchors]


def _seen(anchor: Anchor, pose: Pose, intrinsics: Intrinsics, geo_anchor: GeoAnchor | None) -> SeenAnchor:
    in_camera = transformed(pose.camera_from_world, anchor.position_in_world[None])
    return SeenAnchor(
        **anchor_out(anchor).model_dump(),
        in_camera=in_camera[0].tolist(),
        pixel=_pixel(in_camera, intrinsics),
        geographic=geo_anchor and _on_earth(anchor, geo_anchor),
    )


def _pixel(in_camera: Float64[np.ndarray, "1 3"], intrinsics: Intrinsics) -> list[float] | None:
    if in_camera[0, 2] <= 0:
        return None
    x, y = distorted_pixels(in_camera, intrinsics)[0].tolist()
    return [x, y] if 0 <= x <= intrinsics.width and 0 <= y <= intrinsics.height else None


def _on_earth(anchor: Anchor, geo_anchor: GeoAnchor) -> GeographicOut:
    # A point has no rotation: any will do for its position.
    matrix = np.eye(4)
    matrix[:3, 3] = anchor.position_in_world
    latitude, longitude, height = geographic(geo_anchor, Pose(matrix))[0].tolist()
    zone, easting, northing = utm_from_geographic(latitude, longitude)
    return GeographicOut(
        latitude=latitude, longitude=longitude, height=height, utm_zone=zone, easting=easting, northing=northing
    )
