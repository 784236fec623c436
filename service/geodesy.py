"""Converts a pose in a scene to a pose on Earth (OGC GeoPose 1.0).

    enu_from_camera = enu_from_world @ world_from_camera      at the anchor, metres
    ecef = anchor_ecef + ecef_from_enu(anchor) @ enu          WGS84
    quaternion: enu_from_camera at the camera's own position, where up differs from the anchor's

GeoPose defines the quaternion's outer frame (East-North-Up), not the axes of a camera; here they are those of
OpenGL and WebXR: +x right, +y up, +z backwards.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from pyproj import Transformer

from service.geometry import quat_from_rotation, rotation_from_quat
from service.types import GeoAnchor, Pose

_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])


def geographic(anchor: GeoAnchor, pose: Pose) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "4"]]:
    """Return a pose on WGS84: (latitude in degrees, longitude in degrees, height in metres), and a quaternion wxyz."""
    # EPSG:4979 is latitude, longitude and height on WGS84, EPSG:4978 Earth-centred coordinates.
    ecef_from_geodetic = Transformer.from_crs("EPSG:4979", "EPSG:4978")
    origin = np.array(ecef_from_geodetic.transform(anchor.latitude_deg, anchor.longitude_deg, anchor.height_m))
    ecef_from_enu = _ecef_from_enu(anchor.latitude_deg, anchor.longitude_deg)
    # The anchor's matrix scales, too: metres per scene unit.
    scaled = anchor.enu_from_world[:3, :3]
    enu_from_world = scaled / np.cbrt(np.linalg.det(scaled))
    enu = scaled @ pose.position_in_world + anchor.enu_from_world[:3, 3]
    latitude, longitude, height = ecef_from_geodetic.transform(*(origin + ecef_from_enu @ enu), direction="INVERSE")
    ecef_from_camera = ecef_from_enu @ enu_from_world @ pose.world_from_camera[:3, :3] @ _OPENCV_FROM_OPENGL
    # Of the camera's own place: east and north there differ from those at the anchor.
    rotation = quat_from_rotation(_ecef_from_enu(latitude, longitude).T @ ecef_from_camera)
    return np.array([latitude, longitude, height]), rotation


def pose_on_earth(
    anchor: GeoAnchor, position: Float64[np.ndarray, "3"], quaternion_wxyz: Float64[np.ndarray, "4"]
) -> Pose:
    """Return the pose in the scene of one on WGS84, as `geographic` returns it: its inverse. Raises InvalidPrior."""
    ecef_from_geodetic = Transformer.from_crs("EPSG:4979", "EPSG:4978")
    origin = np.array(ecef_from_geodetic.transform(anchor.latitude_deg, anchor.longitude_deg, anchor.height_m))
    ecef_from_enu = _ecef_from_enu(anchor.latitude_deg, anchor.longitude_deg)
    scaled = anchor.enu_from_world[:3, :3]
    enu_from_world = scaled / np.cbrt(np.linalg.det(scaled))
    latitude, longitude, _ = position
    enu = ecef_from_enu.T @ (np.array(ecef_from_geodetic.transform(*position)) - origin)
    ecef_from_camera = _ecef_from_enu(latitude, longitude) @ rotation_from_quat(quaternion_wxyz)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = enu_from_world.T @ ecef_from_enu.T @ ecef_from_camera @ _OPENCV_FROM_OPENGL
    world_from_camera[:3, 3] = np.linalg.solve(scaled, enu - anchor.enu_from_world[:3, 3])
    return Pose(world_from_camera)


def enu_from_geographic(
    origin: Float64[np.ndarray, "3"], positions: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return metres east, north and up of an origin; all on WGS84: latitude and longitude in degrees, height in metres
    above the ellipsoid."""
    ecef_from_geodetic = Transformer.from_crs("EPSG:4979", "EPSG:4978")
    there = np.stack(ecef_from_geodetic.transform(*positions.T), -1)
    here = np.array(ecef_from_geodetic.transform(*origin))
    return (there - here) @ _ecef_from_enu(origin[0], origin[1])


def utm_from_geographic(latitude_deg: float, longitude_deg: float) -> tuple[str, float, float]:
    """Return a place on WGS84 in UTM: the zone with its hemisphere, e.g. 32N, easting and northing in metres.

    Zones are six degrees wide everywhere: the exceptions of Norway and Svalbard are left out.
    """
    zone = int((longitude_deg + 180) % 360 // 6) + 1
    north = latitude_deg >= 0
    # EPSG:326zz and 327zz are the zones of the northern and the southern hemisphere.
    to_utm = Transformer.from_crs("EPSG:4326", f"EPSG:{326 if north else 327}{zone:02}")
    easting, northing = to_utm.transform(latitude_deg, longitude_deg)
    return f"{zone}{'N' if north else 'S'}", float(easting), float(northing)


def _ecef_from_enu(latitude_deg: float, longitude_deg: float) -> Float64[np.ndarray, "3 3"]:
    """Return the unit vectors east, north and up at a position, as columns, in the Earth-centred frame."""
    (sin_lat, sin_lon), (cos_lat, cos_lon) = (f(np.radians([latitude_deg, longitude_deg])) for f in (np.sin, np.cos))
    return np.array(
        [
            [-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
            [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
            [0.0, cos_lat, sin_lat],
        ]
    )
