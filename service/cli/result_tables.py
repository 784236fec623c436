"""Results as text: a line for each photo, and tables as CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

from service.errors import BadInput
from service.web.schemas.exports import smoothed_frames
from service.web.schemas.job_results import FrameOut, Result
from service.web.schemas.poses import Transform

_POSE_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")


def photo_line(name: str, result: Result) -> str:
    """Return one photo's result as a line."""
    status = f"{result.status} in {result.scene.id}" if result.scene_ranking else result.status
    line = _line(name, status, result.score, result.pose.world_from_camera)
    said = [text for text in (result.search_summary, result.hint, *result.advice) if text]
    return " ".join([f"{line}.", *said]) if said else line


def frame_line(frame: FrameOut) -> str:
    """Return the result of one photo of a sequence as a line."""
    name = f"{frame.time_s:.3f} s, {frame.name}"
    line = _line(name, frame.status, frame.score, frame.world_from_camera)
    return line if frame.tracked else f"{line}, searched"


def _line(name: str, status: str, score: float, world_from_camera: Transform) -> str:
    position = " ".join(f"{value:.4f}" for value in world_from_camera.translation)
    quaternion = " ".join(f"{value:.4f}" for value in world_from_camera.quaternion_wxyz)
    return f"{name}: {status}, score {score:.2f}, position {position}, quaternion_wxyz {quaternion}"


def write_photo_table(path: Path, results: Sequence[tuple[str, Result | BadInput]]) -> None:
    """Write a CSV table with one row a photo; the pose is world_from_camera in OpenCV axes, in scene units.

    A photo that could not be read has status `error` and the error's code as reason.
    """
    head = ("photo", "scene", "status", "reason", "score", *_POSE_COLUMNS, "inliers", "latency_ms")
    rows: list[Sequence[object]] = []
    for name, result in results:
        if isinstance(result, BadInput):
            rows.append((name, "", "error", result.code, *[""] * (len(head) - 4)))
            continue
        latency_ms = round(1000 * sum(timing.wall_s for timing in result.timings), 1)
        verdict = (result.scene.id, result.status, result.reason, result.score)
        rows.append((name, *verdict, *_pose(result.pose.world_from_camera), result.inliers, latency_ms))
    _write(path, head, rows)


def write_frame_table(path: Path, frames: Sequence[FrameOut], *, smooth: bool = False) -> None:
    """Write a CSV table with one row a photo of the sequence; the pose is world_from_camera in OpenCV axes.

    With `smooth` the column `smoothed` has `smoothed` or `interpolated`, and is empty where no pose is known.
    """
    found = smoothed_frames(frames) if smooth else []
    replaced = {f.index: (f, "interpolated" if mark else "smoothed") for f, mark in found}
    rows = []
    for f, mark in (replaced.get(f.index, (f, "")) for f in frames):
        row = (f.name, f.time_s, f.status, f.reason, f.score, *_pose(f.world_from_camera), int(f.tracked))
        rows.append((*row, mark) if smooth else row)
    # Names of columns stay as they are, since scripts read them: `followed` is `tracked` of the API.
    head = ("photo", "time_s", "status", "reason", "score", *_POSE_COLUMNS, "followed", *["smoothed"] * smooth)
    _write(path, head, rows)


def _pose(world_from_camera: Transform) -> list[float]:
    return [*world_from_camera.translation, *world_from_camera.quaternion_wxyz]


def _write(path: Path, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    # The csv module writes its own line ends.
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(head)
        table.writerows(rows)
