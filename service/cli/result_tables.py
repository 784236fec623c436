"""What the command line tells of answers: a line each, tables, trajectories."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

from service.web.schemas.job_results import FrameOut, Result
from service.web.schemas.poses import Transform

_POSE_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")


def photo_line(name: str, result: Result) -> str:
    """Return a photo's answer as a line."""
    status = f"{result.status} in {result.scene.id}" if result.scene_ranking else result.status
    told = _line(name, status, result.score, result.pose.world_from_camera)
    return f"{told}. {result.hint}" if result.hint else told


def frame_line(frame: FrameOut) -> str:
    """Return the answer of one photo of a sequence as a line."""
    name = f"{frame.time_s:.3f} s, {frame.name}"
    told = _line(name, frame.status, frame.score, frame.world_from_camera)
    return told if frame.tracked else f"{told}, searched"


def _line(name: str, status: str, score: float, world_from_camera: Transform) -> str:
    place = " ".join(f"{value:.4f}" for value in world_from_camera.translation)
    turn = " ".join(f"{value:.4f}" for value in world_from_camera.quaternion_wxyz)
    return f"{name}: {status}, score {score:.2f}, position {place}, quaternion_wxyz {turn}"


def write_photo_table(path: Path, results: Sequence[tuple[str, Result]]) -> None:
    """One row a photo; the pose is world_from_camera in OpenCV axes."""
    rows = [
        (
            *(name, result.scene.id, result.status, result.reason, result.score),
            *_pose(result.pose.world_from_camera),
            *(result.inliers, round(1000 * sum(timing.wall_s for timing in result.timings), 1)),
        )
        for name, result in results
    ]
    _write(path, ("photo", "scene", "status", "reason", "score", *_POSE_COLUMNS, "inliers", "latency_ms"), rows)


def write_frame_table(path: Path, frames: Sequence[FrameOut]) -> None:
    """One row a photo of the sequence; the pose is world_from_camera in OpenCV axes."""
    rows = [
        (f.name, f.time_s, f.status, f.reason, f.score, *_pose(f.world_from_camera), int(f.tracked)) for f in frames
    ]
    _write(path, ("photo", "time_s", "status", "reason", "score", *_POSE_COLUMNS, "followed"), rows)


def _pose(world_from_camera: Transform) -> list[float]:
    return [*world_from_camera.translation, *world_from_camera.quaternion_wxyz]


def _write(path: Path, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(head)
        table.writerows(rows)
