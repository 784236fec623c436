"""`python supersplat_cameras.py JOB.json ... > cameras.json`: poses as key frames of SuperSplat; drop the file on it.

It has the form that Inria's training code writes. SuperSplat shows scene files turned by 180 degrees about z, and turns
these poses likewise.
"""

import json
import sys
from pathlib import Path


def cameras(jobs):
    """Return the list of the localized poses of jobs and of their frames."""
    listed = []
    for job in jobs:
        result = job["result"]
        frames = result.get("frames")
        for answer in frames or [result]:
            if answer["status"] != "localized":
                continue
            pose = answer["world_from_camera"] if frames else answer["pose"]["world_from_camera"]
            k, matrix = result["intrinsics"], pose["matrix"][:3]
            name = answer["name"] if frames else job["photo"]["name"]
            camera = {"id": len(listed), "img_name": name, **{n: k[n] for n in ("width", "height", "fx", "fy")}}
            axes = {"position": [row[3] for row in matrix], "rotation": [row[:3] for row in matrix]}
            listed.append(camera | axes)
    return listed


def in_supersplat(point):
    """Return where SuperSplat shows a point of the scene file's world."""
    x, y, z = point
    return [-x, -y, z]


if __name__ == "__main__":
    json.dump(cameras(json.loads(Path(path).read_text("utf-8")) for path in sys.argv[1:]), sys.stdout)
