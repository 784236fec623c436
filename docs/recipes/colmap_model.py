"""`python colmap_model.py FOLDER JOB.json ...`: the photos of jobs as a COLMAP model in text, which COLMAP opens."""

import json
import re
import sys
from pathlib import Path

ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


def model(jobs):
    """Return the texts of cameras.txt and images.txt; only localized photos are in it."""
    cameras, images = [], []
    for job in jobs:
        result = job["result"]
        if result["status"] != "localized" or result.get("frames"):  # of a sequence: GET /jobs/ID/export/colmap
            continue
        k, pose, number = result["intrinsics"], result["pose"]["camera_from_world"], len(images) + 1
        focal = [k["fx"]] if k["model"] in ONE_FOCAL else [k["fx"], k["fy"]]
        lens = [*focal, k["cx"], k["cy"], *k["distortion"]]
        cameras.append(f"{number} {k['model']} {k['width']} {k['height']} {line(lens)}\n")
        name = re.sub(r"\s+", "_", job["photo"]["name"])
        # The second line is for observed points: none.
        images.append(f"{number} {line(pose['quaternion_wxyz'] + pose['translation'])} {number} {name}\n\n")
    return "".join(cameras), "".join(images)


def line(numbers):
    """Return numbers as COLMAP reads them."""
    return " ".join(f"{number:.17g}" for number in numbers)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    texts = model(json.loads(Path(path).read_text("utf-8")) for path in sys.argv[2:])
    for name, text in zip(("cameras.txt", "images.txt", "points3D.txt"), (*texts, ""), strict=True):
        (folder / name).write_text(text, encoding="utf-8")
