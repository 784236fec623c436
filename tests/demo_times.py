"""Localize the demo photos, and time it beside a loop that depends on nothing of ours: prints a line of JSON.

    python tests/demo_times.py given | withheld

A process of its own: what other tests have left in memory would be a part of the time.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numba
import numpy as np

from service.geometry import pose_distance
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.photos.images import read_query
from service.types import Intrinsics, Pose

STUDIO = Path(__file__).parents[1] / "scenes" / "studio"


@numba.njit(nogil=True)
def _iterated(values: np.ndarray, rounds: int) -> float:
    total = 0.0
    for value in values:
        x = value
        for _ in range(rounds):
            x = x * x - 1.5 if abs(x) < 2 else x * 0.25
        total += x
    return total


def calibration() -> float:
    """Compute scalar code, wide arrays, and in the interpreter."""
    image = np.linspace(0, 1, 1_000_000, dtype=np.float32).reshape(1000, 1000)
    for _ in range(8):
        image = (image[1:-1, :-2] + image[1:-1, 2:]) * np.float32(0.5)
    return _iterated(np.linspace(-1, 1, 8000), 500) + float(image.sum()) + sum(i % 7 for i in range(80_000))


def main(lens: str) -> None:
    """The loop goes on beside the photos for half their time: what else slows this machine slows both."""
    truth = json.loads((STUDIO / "truth.json").read_text("utf-8"))
    studio = LoadedScene.load(STUDIO)
    found, photos_s, loops_s = [], [], []
    calibration()
    for row in [truth[0], *truth]:  # the first one compiles
        data = (STUDIO / "photos" / row["photo"]).read_bytes()
        intrinsics = Intrinsics(**row["intrinsics"]) if lens == "given" else None
        begun = time.thread_time()
        answer = localize(read_query(data, intrinsics=intrinsics), studio, Request(seed=0))
        photos_s.append(time.thread_time() - begun)
        degrees, units = pose_distance(answer.pose, Pose(np.array(row["world_from_camera"])))
        found.append([str(answer.verdict.status), degrees < 5 and units < 0.05])
        while sum(loops_s) < sum(photos_s[1:]) / 2:
            begun = time.thread_time()
            calibration()
            loops_s.append(time.thread_time() - begun)
    told = {"found": found[1:], "ratio": float(np.mean(photos_s[1:]) / np.mean(loops_s))}
    sys.stdout.write(json.dumps(told) + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
