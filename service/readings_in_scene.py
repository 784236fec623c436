"""Readings of a device as priors in a scene: up, metres and north by the scene's registration, else by its files.

    up in the scene       = enu_from_world^T up                       or `up_in_world` of the files
    position in the scene = world_from_enu (enu of the GPS position)  metres east, north and up of the anchor, WGS84
    east, north           = enu_from_world^T (1, 0, 0), (0, 1, 0)     of length 1

At the pose that was found each reading is tested against the photo (`device_priors`): one that agrees takes part in the
final pose and its covariance, one that contradicts is left out and named with both values.

The covariances of device and registration add: both are independent, and what the registration is off moves what is
expected of the device.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from service.device_readings import DeviceReadings, GpsPosition, HeadingPrior, PositionPrior, ScenePriors, UpPrior
from service.geodesy import enu_from_geographic, geographic
from service.pose.absolute_pose.device_priors import PriorResidual, residuals, with_readings
from service.pose.verification.precision import probability_within
from service.registration.gathering import SCENE_UP_SIGMA
from service.registration.registration import Registration
from service.results import Reason, Status, Verdict
from service.scene_origin import shifted
from service.types import GeoAnchor, Pose, Query, SceneInfo

ANCHOR_SIGMA_M = 1.0
"""Of the place of a scene whose file states an anchor without an uncertainty."""
ANCHOR_HEADING_SIGMA = SCENE_UP_SIGMA
"""rad: of its north."""


def scene_priors(readings: DeviceReadings, info: SceneInfo, registration: Registration | None = None) -> ScenePriors:
    """Return the readings as priors of a pose, relative to the scene's origin; see the module.

    `registration`, where there is one, counts instead of what `info` says. Readings that the scene can't use are named
    in the priors' warnings.
    """
    anchor = _anchor(info, registration)
    up = None if registration is None else registration.up_in_world
    if up is None and info.up_in_world is not None:
        up = np.array(info.up_in_world, np.float64)
    if up is None and anchor is not None:
        up = _axis(anchor, 2)
    warnings = []
    if readings.gravity is not None and up is None:
        warnings.append(f"the gravity was not used: the up direction of scene '{info.name}' is unknown.")
    for name, reading in (("GPS position", readings.gps), ("heading", readings.heading)):
        if reading is not None and anchor is None:
            warnings.append(
                f"the {name} was not used: scene '{info.name}' has no geo anchor. Register it, or add "
                "geo_anchor to its scene.json."
            )
    return ScenePriors(
        _up_prior(readings, up, registration),
        None if anchor is None or readings.gps is None else _position_prior(readings.gps, anchor, info, registration),
        _heading_prior(readings, anchor, registration),
        tuple(warnings),
    )


def _up_prior(
    readings: DeviceReadings, up: Float64[np.ndarray, "3"] | None, registration: Registration | None
) -> UpPrior | None:
    gravity = readings.gravity
    if gravity is None or up is None:
        return None
    of_scene = SCENE_UP_SIGMA
    if registration is not None and registration.up_in_world is not None:
        of_scene = _tilt_sigma(registration)
    sigma = float(np.hypot(np.radians(gravity.sigma_deg), of_scene))
    return UpPrior(np.array(gravity.direction), up / np.linalg.norm(up), sigma)


def _tilt_sigma(registration: Registration) -> float:
    """Return the greatest standard deviation (rad) of the registration's up, about any level axis."""
    up = np.array(registration.up_in_target)
    level = np.eye(3) - np.outer(up, up) / (up @ up)
    return float(np.sqrt(np.linalg.eigvalsh(level @ registration.covariance[:3, :3] @ level)[-1]))


def _position_prior(
    gps: GpsPosition, anchor: GeoAnchor, info: SceneInfo, registration: Registration | None
) -> PositionPrior:
    place = np.array([anchor.latitude_deg, anchor.longitude_deg, anchor.height_m])
    # Without a height that of the anchor: the directions east and north depend on it by a millionth a metre.
    there = np.array([gps.latitude_deg, gps.longitude_deg, anchor.height_m if gps.height_m is None else gps.height_m])
    enu = enu_from_geographic(place, there[None])[0]
    linear = anchor.enu_from_world[:3, :3]
    position = np.linalg.solve(linear, enu - anchor.enu_from_world[:3, 3])
    sigmas = np.array([gps.sigma_m, gps.sigma_m, gps.height_sigma_m])
    of_scene = ANCHOR_SIGMA_M**2 * np.eye(3)
    if registration is not None and registration.geo_anchor is not None:
        at_place = np.eye(4)
        at_place[:3, 3] = position
        placed = registration.placed(Pose(at_place), None)
        assert placed is not None
        of_scene = placed.position_covariance
    known = slice(0, 2 if gps.height_m is None else 3)
    covariance = (np.diag(sigmas**2) + of_scene)[known, known]
    return PositionPrior(position - np.array(info.origin_in_world), linear[known], covariance)


def _heading_prior(
    readings: DeviceReadings, anchor: GeoAnchor | None, registration: Registration | None
) -> HeadingPrior | None:
    heading = readings.heading
    if heading is None or anchor is None:
        return None
    of_scene = ANCHOR_HEADING_SIGMA
    if registration is not None and registration.geo_anchor is not None:
        of_scene = float(np.sqrt(registration.covariance[2, 2]))
    sigma = float(np.hypot(np.radians(heading.sigma_deg), of_scene))
    return HeadingPrior(_axis(anchor, 0), _axis(anchor, 1), float(np.radians(heading.degrees)), sigma)


def _axis(anchor: GeoAnchor, number: int) -> Float64[np.ndarray, "3"]:
    """Return east (0), north (1) or up (2) at the anchor as a unit vector in the world."""
    row = anchor.enu_from_world[number, :3]
    return row / np.linalg.norm(row)


def _anchor(info: SceneInfo, registration: Registration | None) -> GeoAnchor | None:
    return (registration and registration.geo_anchor) or info.geo_anchor


# ---------------------------------------------------------------------- at the pose that was found

PLACED = (Reason.VERIFIED, Reason.POSITION_UNCERTAIN)
"""Of a verdict whose place is sure: readings may say more of the position there."""


def fused(query: Query, pose: Pose, verdict: Verdict) -> tuple[Pose, Verdict]:
    """Return pose and verdict by the photo and the readings that agree with it; as they are where the place isn't sure.

    `precise` and score follow from the covariance; status and reason are the photo's alone.
    """
    if query.scene_priors is None or verdict.covariance is None or verdict.reason not in PLACED:
        return pose, verdict
    pose, covariance = with_readings(query.scene_priors, pose, verdict.covariance)
    precise = verdict.precise
    if verdict.asked is not None and precise is not None:
        precise = max(precise, probability_within(covariance, *verdict.asked))
    score = verdict.place_probability * (1.0 if precise is None else precise)
    return pose, replace(verdict, covariance=covariance, precise=precise, score=score)


def contradictions(
    query: Query, pose: Pose, verdict: Verdict, info: SceneInfo, registration: Registration | None = None
) -> tuple[str, ...]:
    """Return a warning for each reading that contradicts the pose by the photo, with both values."""
    if verdict.covariance is None or verdict.status is Status.NOT_LOCALIZED:
        return ()
    against = [one for one in residuals(query.scene_priors, pose) if one.contradicts(verdict.covariance)]
    sure = "" if verdict.status is Status.LOCALIZED else " Its pose isn't confirmed: either may be wrong."
    in_world = shifted(pose, info.origin_in_world)
    return tuple(
        f"the {_values(one, query, in_world, _anchor(info, registration))}: not used.{sure}" for one in against
    )


def _values(residual: PriorResidual, query: Query, in_world: Pose, anchor: GeoAnchor | None) -> str:
    """Return what device and photo say, in words."""
    readings, priors = query.readings, query.scene_priors
    assert readings is not None
    assert priors is not None
    if residual.name == "up":
        assert priors.up is not None
        photo = in_world.world_from_camera[:3, :3].T @ priors.up.up_in_world
        off = np.degrees(np.linalg.norm(residual.value))
        by_device, by_photo = (", ".join(f"{x:.3f}" for x in up) for up in (priors.up.up_in_camera, photo))
        sigma = np.degrees(priors.up.sigma)
        return (
            f"gravity has up at ({by_device}) in the camera, the photo at ({by_photo}), {off:.1f} degrees away, with a "
            f"standard deviation of {sigma:.1f}"
        )
    if residual.name == "heading":
        assert readings.heading is not None
        device, off = readings.heading.degrees % 360, float(np.degrees(residual.value[0]))
        sigma = float(np.degrees(np.sqrt(residual.noise[0, 0])))
        return (
            f"heading is {device:.1f} degrees by the compass and {(device + off) % 360:.1f} by the photo, with a "
            f"standard deviation of {sigma:.1f}"
        )
    assert readings.gps is not None
    assert anchor is not None
    place, _ = geographic(anchor, in_world)
    sigma = float(np.sqrt(np.linalg.eigvalsh(residual.noise)[-1]))
    return (
        f"position is {readings.gps.latitude_deg:.6f}, {readings.gps.longitude_deg:.6f} by GPS and {place[0]:.6f}, "
        f"{place[1]:.6f} by the photo, {np.linalg.norm(residual.value):.1f} m away, with a standard deviation of "
        f"{sigma:.1f} m"
    )
