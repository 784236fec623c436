"""Requests and responses of Open AR Cloud's GeoPoseProtocol, by which AR clients are localized on Earth.

The first camera reading of a request is used: its image, and its camera's parameters (in COLMAP's models). The scene is
the only one with a geo_anchor, or the nearest to the request's geolocation. The last of the prior poses is the job's
prior; with an accuracy it is a Gaussian. Readings of other sensors are accepted and ignored.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from service.errors import InvalidIntrinsics, InvalidPrior, InvalidRequest, NoGeoAnchor
from service.geodesy import pose_on_earth
from service.photos.intrinsics import DISTORTION_COUNTS, ONE_FOCAL
from service.scene_manager.status import SceneStatus
from service.types import GeoAnchor
from service.web.api_model import Model
from service.web.schemas.job_results import Result
from service.web.schemas.poses import GeoPose
from service.web.schemas.request_body import decoded_base64
from service.web.schemas.requests import PriorIn

_EARTH_M = 6_371_000.0


class _Foreign(BaseModel):
    """A model of the protocol; unknown fields are ignored."""

    model_config = ConfigDict(use_attribute_docstrings=True, extra="ignore")


class CameraParams(_Foreign):
    """The protocol's camera model, in COLMAP's terms."""

    model: str | None = None
    """Name of the camera model in COLMAP."""
    modelParams: list[float] = Field(default_factory=list)


class CameraReading(_Foreign):
    """A photo with its camera."""

    imageBytes: str
    """base64 of a JPEG, PNG, WebP or HEIC file."""
    size: list[int] = Field(default_factory=list)
    """Width and height, for `params`."""
    params: CameraParams | None = None
    sensorId: str = ""


class GeolocationReading(_Foreign):
    """A position on WGS84 by the device, degrees."""

    latitude: float = Field(ge=-90, le=90)
    longitude: float = Field(ge=-180, le=180)


class SensorReadings(_Foreign):
    """The readings that are used; those of other sensors are ignored."""

    cameraReadings: list[CameraReading] = Field(default_factory=list, max_length=16)
    geolocationReadings: list[GeolocationReading] = Field(default_factory=list, max_length=1000)


class PriorPosition(_Foreign):
    """A position on WGS84, degrees."""

    lat: float = Field(ge=-90, le=90)
    lon: float = Field(ge=-180, le=180)
    h: float = Field(allow_inf_nan=False)
    """Metres above the ellipsoid."""


class PriorQuaternion(_Foreign):
    """A unit quaternion that rotates the camera's axes to East-North-Up."""

    x: float
    y: float
    z: float
    w: float


class PriorGeoPose(_Foreign):
    """OGC GeoPose 1.0, Basic-Quaternion."""

    position: PriorPosition
    quaternion: PriorQuaternion


class PriorAccuracy(_Foreign):
    """Standard deviations of a prior pose."""

    position: float = Field(gt=0, allow_inf_nan=False)
    """Metres."""
    orientation: float = Field(gt=0, le=180, allow_inf_nan=False)
    """Degrees."""


class PriorPose(_Foreign):
    """An earlier response, or what a device knows by itself."""

    geopose: PriorGeoPose
    accuracy: PriorAccuracy | None = None
    """Standard deviations. With them, poses outside of the Gaussian's 99.9 % region are rejected."""


class GeoPoseRequest(_Foreign):
    """A request of the protocol: photos, and where the device may be."""

    id: str = Field(default="", max_length=200)
    timestamp: float = 0.0
    """Milliseconds since 1970."""
    type: str = "geopose"
    sensorReadings: SensorReadings
    priorPoses: list[PriorPose] = Field(default_factory=list, max_length=1000)
    """In the order of time: the last one is used."""


class GeoPoseAccuracy(Model):
    """Standard deviations of the pose."""

    position: float
    """Metres, mean of the components."""
    orientation: float
    """Degrees, mean of the three angles."""


class GeoPoseResponse(Model):
    """The protocol's answer: the camera's pose on Earth."""

    id: str
    """The request's."""
    timestamp: int
    """Milliseconds since 1970."""
    accuracy: GeoPoseAccuracy | None
    type: str = "geopose"
    geopose: GeoPose


def image_of(request: GeoPoseRequest) -> tuple[bytes, dict[str, Any] | None]:
    """Return the image file, and the intrinsics if they were sent. Raises InvalidRequest, InvalidIntrinsics."""
    if not request.sensorReadings.cameraReadings:
        raise InvalidRequest("at least one is required.", where="sensorReadings.cameraReadings")
    reading = request.sensorReadings.cameraReadings[0]
    return decoded_base64(reading.imageBytes, "cameraReadings.0.imageBytes"), _intrinsics(reading)


def _intrinsics(reading: CameraReading) -> dict[str, Any] | None:
    params = reading.params
    if params is None or not params.modelParams or params.model in (None, "UNKNOWN", "UNKNOWN_CAMERA"):
        return None
    where = "cameraReadings.0.params"
    if params.model not in DISTORTION_COUNTS:
        raise InvalidIntrinsics(f"unknown camera model {str(params.model)[:40]!r}.", where=f"{where}.model")
    # COLMAP's models have one focal length or two, by their name.
    focals = 1 if params.model in ONE_FOCAL else 2
    expected = focals + 2 + DISTORTION_COUNTS[params.model]
    if len(params.modelParams) != expected or len(reading.size) != 2:
        raise InvalidIntrinsics(
            f"{params.model} has {expected} parameters, and needs `size`.", where=f"{where}.modelParams"
        )
    # COLMAP's order: focal lengths, principal point, distortion.
    values, (width, height) = params.modelParams, reading.size
    return {
        **{"model": params.model, "width": width, "height": height, "fx": values[0], "fy": values[focals - 1]},
        **{"cx": values[focals], "cy": values[focals + 1], "distortion": values[focals + 2 :]},
    }


def prior_of(request: GeoPoseRequest, anchor: GeoAnchor) -> PriorIn | None:
    """Return the last prior pose as the prior of a request to localize in a scene; None without any.

    Raises InvalidPrior.
    """
    if not request.priorPoses:
        return None
    where = f"priorPoses.{len(request.priorPoses) - 1}"
    given, accuracy = request.priorPoses[-1].geopose, request.priorPoses[-1].accuracy
    place, q = given.position, given.quaternion
    quaternion = np.array([q.w, q.x, q.y, q.z])
    # NaN fails the comparison; 1e-3, as for other poses.
    if not abs(np.linalg.norm(quaternion) - 1) < 1e-3:
        raise InvalidPrior(
            "must have length 1.", where=f"{where}.geopose.quaternion", hint='Example: {"x": 0, "y": 0, "z": 0, "w": 1}'
        )
    pose = pose_on_earth(anchor, np.array([place.lat, place.lon, place.h]), quaternion)
    matrix = pose.world_from_camera.tolist()
    if not accuracy:
        return PriorIn(world_from_camera=matrix)
    sigma_units = accuracy.position / _metres_per_unit(anchor)
    return PriorIn(world_from_camera=matrix, sigma_deg=accuracy.orientation, sigma_units=sigma_units)


def _metres_per_unit(anchor: GeoAnchor) -> float:
    # The determinant of a similarity is its scale cubed.
    return float(np.cbrt(np.linalg.det(anchor.enu_from_world[:3, :3])))


def nearest_scene(scenes: Sequence[SceneStatus], request: GeoPoseRequest) -> str:
    """Return the id of the scene to localize in. Raises NoGeoAnchor."""
    places = {s.id: s.info.geo_anchor for s in scenes if s.info and s.info.geo_anchor}
    readings = request.sensorReadings.geolocationReadings
    # One scene needs no geolocation: indoors, phones often have none.
    if len(places) == 1:
        return next(iter(places))
    if not places or not readings:
        reason = "no scene in memory has a geo_anchor" if not places else "several scenes have a geo_anchor"
        raise NoGeoAnchor(f"{reason}.", where="scene", hint="Name one (?scene=ID), or send a geolocation reading.")
    return min(places, key=lambda scene_id: _distance_m(places[scene_id], readings[-1]))


def _distance_m(anchor: GeoAnchor, reading: GeolocationReading) -> float:
    """Return the great-circle distance (haversine formula, on a sphere)."""
    lat_a, lon_a, lat_b, lon_b = map(
        math.radians, (anchor.latitude_deg, anchor.longitude_deg, reading.latitude, reading.longitude)
    )
    half = math.sin((lat_b - lat_a) / 2) ** 2
    half += math.cos(lat_a) * math.cos(lat_b) * math.sin((lon_b - lon_a) / 2) ** 2
    return 2 * _EARTH_M * math.asin(math.sqrt(min(1.0, half)))


def response_of(request: GeoPoseRequest, result: Result, anchor: GeoAnchor) -> GeoPoseResponse:
    """Return the protocol's response to a result with a geopose."""
    assert result.geopose
    accuracy = None
    registered = result.registered
    if registered and registered.sigma_m is not None and registered.sigma_deg is not None:
        # Of three components each.
        accuracy = GeoPoseAccuracy(position=registered.sigma_m / 3**0.5, orientation=registered.sigma_deg / 3**0.5)
    elif result.covariance is not None:
        variance = np.diag(np.array(result.covariance.matrix))
        metres = _metres_per_unit(anchor)
        accuracy = GeoPoseAccuracy(
            position=metres * float(np.sqrt(variance[3:].mean())),
            orientation=float(np.degrees(np.sqrt(variance[:3].mean()))),
        )
    now = int(1000 * time.time())
    return GeoPoseResponse(id=request.id, timestamp=now, accuracy=accuracy, geopose=result.geopose)
