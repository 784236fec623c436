"""The odometry of `splatfix bench live`: what a device would say of its own motion, and how well it is placed.

Made from the film's true motion in metres, in a frame of its own: its position drifts by a share of the way, in a
direction that changes slowly, its heading at random. It begins anew in the middle of the occluded part, and where the
camera is elsewhere at once or sent nothing for a while.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64

from service.bench.live_film import Shot
from service.bench.pose_metrics import Units
from service.geometry import moved, project, se3_exp, se3_log, so3_exp, transformed, unproject
from service.live_client import LiveAnswer
from service.types import Intrinsics, Pose


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """The device."""

    metres_per_unit: float = 0.6
    """Of a normalized unit: what is seen, four units away, is 2.4 m from a phone."""
    drift: float = 0.01
    """Of the position, as a share of the way."""
    drift_changes_m: float = 2.0
    """Way over which the direction of the drift changes."""
    turn_deg: float = 0.1
    """Standard deviation of the heading's drift after one metre; it grows with the root of the way."""


ODOMETRY = OdometryConfig()
_CHI_SQUARE_7 = 14.07
"""95 % of seven degrees of freedom."""


def with_odometry(
    film: Sequence[Shot], units: Units, up_in_world: Float64[np.ndarray, "3"], seed: int = 0,
    config: OdometryConfig = ODOMETRY,
) -> list[Shot]:  # fmt: skip
    """Return the shots with what the device's odometry says at each."""
    rng = np.random.default_rng([seed, 26])
    scale = units_per_metre(units, config)
    halfway = [n for n, shot in enumerate(film) if shot.part == "occluded"]
    anew = {halfway[len(halfway) // 2]} if halfway else set()
    anew |= {n for n, (a, b) in enumerate(pairwise(film), 1) if a.part != b.part and b.part in ("jumped", "unlocked")}
    heading = _unit(rng)
    odom, shots = _start(rng), []
    for number, shot in enumerate(film):
        if number in anew:
            odom = _start(rng)
        elif number:
            step = film[number - 1].pose.camera_from_world @ shot.pose.world_from_camera
            step[:3, 3] /= scale
            way = float(np.linalg.norm(step[:3, 3]))
            heading = heading + np.sqrt(2 * way / config.drift_changes_m) * _unit(rng)
            heading /= np.linalg.norm(heading)
            up = shot.pose.world_from_camera[:3, :3].T @ up_in_world
            turn = np.radians(config.turn_deg) * np.sqrt(way) * rng.normal() * up
            error = se3_exp(np.append(turn, config.drift * way * (odom[:3, :3] @ step[:3, :3]).T @ heading))
            odom = odom @ step @ error
        shots.append(replace(shot, odom=moved(Pose(odom), np.zeros(6))))
    return shots


def units_per_metre(units: Units, config: OdometryConfig = ODOMETRY) -> float:
    """Return the true scale of the odometry: scene units per metre."""
    return 1 / (config.metres_per_unit * units.units_per_scene_unit)


def _start(rng: np.random.Generator) -> Float64[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = so3_exp(rng.uniform(0, np.pi) * _unit(rng)), rng.normal(size=3)
    return pose


def _unit(rng: np.random.Generator) -> Float64[np.ndarray, "3"]:
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


# ------------------------------------------------------------------ figures


def displayed(
    shots: Sequence[Shot], answers: Mapping[int, LiveAnswer], heard_at: Mapping[int, float]
) -> list[Pose | None]:
    """Return where a client believes to be when it shows each frame, as it is taken: by the newest answer that it has
    heard and its odometry now. None before the first such answer, and after a reset until one is heard."""
    order = sorted(answers, key=lambda number: heard_at[number])
    begins = _segments(shots)
    by_time = {shot.time_s: number for number, shot in enumerate(shots)}
    shown: list[Pose | None] = []
    heard, newest = 0, None
    for number, shot in enumerate(shots):
        while heard < len(order) and heard_at[order[heard]] <= shot.time_s:
            newest, heard = answers[order[heard]], heard + 1
        current = newest is not None and begins[by_time[newest.time_s]] == begins[number]
        shown.append(_camera(newest, shot) if newest is not None and current else None)
    return shown


def _segments(shots: Sequence[Shot]) -> list[int]:
    """Return for each shot how often the odometry began anew before, as a device knows by itself."""
    segments = [0]
    for a, b in pairwise(shots):
        assert a.odom is not None
        assert b.odom is not None
        step = se3_log(a.odom.camera_from_world @ b.odom.world_from_camera)
        segments.append(segments[-1] + bool(np.linalg.norm(step[:3]) > 0.5 or np.linalg.norm(step[3:]) > 0.5))
    return segments


def _camera(answer: LiveAnswer, shot: Shot) -> Pose | None:
    if answer.world_from_odom is None or answer.units_per_odom is None or shot.odom is None:
        return None
    matrix = np.array(answer.world_from_odom) @ shot.odom.world_from_camera
    matrix[:3, :3] /= answer.units_per_odom
    return moved(Pose(matrix), np.zeros(6))


def odometry_figures(
    shots: Sequence[Shot], answers: Mapping[int, LiveAnswer], shot_of: Mapping[int, int], shown: Sequence[Pose | None],
    camera: Intrinsics, units: Units, config: OdometryConfig = ODOMETRY,
) -> dict[str, Any]:  # fmt: skip
    """Return how well the odometry is placed.

    overlay_px: mean distance of points of the true view, four normalized units away, from where the client shows them.
    in_region: share of answers whose 95 % region has the truth. scale_*: of answers after a baseline of a metre, the
    distance of two places of the camera since the start.
    """
    seen = [(pose, shot.truth) for pose, shot in zip(shown, shots, strict=True) if shot.truth is not None]
    overlay = [_overlay_px(pose, truth, camera, units) for pose, truth in seen if pose is not None]
    scale = units_per_metre(units, config)
    told = [(shots[shot_of[number]], answer) for number, answer in sorted(answers.items())]
    placed = [(shot, answer) for shot, answer in told if answer.world_from_odom is not None]
    begin = shots[0].pose.position_in_world
    far = next((n for n, s in enumerate(shots) if np.linalg.norm(s.pose.position_in_world - begin) > scale), len(shots))
    late = [answer for number, answer in sorted(answers.items()) if shot_of[number] >= far and answer.units_per_odom]
    off = [abs(float(answer.units_per_odom or np.nan) / scale - 1) for answer in late]
    return {
        "overlay_share": len(overlay) / max(1, len(seen)),
        "overlay_px_p50": float(np.percentile(overlay, 50)) if overlay else None,
        "overlay_px_p95": float(np.percentile(overlay, 95)) if overlay else None,
        "in_region": float(np.mean([_in_region(shot, answer, scale) for shot, answer in placed])) if placed else None,
        "scale_off_after_a_metre": off[0] if off else None,
        "scale_off_p95": float(np.percentile(off, 95)) if off else None,
        "resets": max((answer.odom_resets or 0 for answer in answers.values()), default=0),
        "carried": sum(answer.mode == "carried" for answer in answers.values()),
    }


def _overlay_px(pose: Pose, truth: Pose, camera: Intrinsics, units: Units) -> float:
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 5) * camera.width, np.linspace(0.1, 0.9, 5) * camera.height)
    px = np.stack([x.ravel(), y.ravel()], 1)
    points = unproject(px, np.full(len(px), 4 / units.units_per_scene_unit), camera)
    shown = project(transformed(pose.camera_from_world @ truth.world_from_camera, points), camera)
    return float(np.mean(np.linalg.norm(shown - px, axis=1)))


def _in_region(shot: Shot, answer: LiveAnswer, scale: float) -> bool:
    pose = _camera(answer, shot)
    assert pose is not None
    gap = np.append(
        se3_log(pose.camera_from_world @ shot.pose.world_from_camera), np.log(scale / float(answer.units_per_odom or 0))
    )
    return bool(gap @ np.linalg.solve(np.array(answer.odom_covariance), gap) < _CHI_SQUARE_7)
