"""`python gltf_camera.py job.json camera.gltf`: the camera of a job as glTF 2.0, for whatever program imports it."""

import json
import math
import sys


def gltf(result):
    """Return the document. glTF's cameras look along -z; the principal point is the centre, as glTF has no other."""
    k, rows = result["intrinsics"], result["pose"]["opengl"]["world_from_camera"]["matrix"]
    lens = {"yfov": 2 * math.atan(k["height"] / (2 * k["fy"])), "znear": 0.01}
    # Of square pixels width / height; fx and fy may differ.
    lens["aspectRatio"] = k["width"] * k["fy"] / (k["height"] * k["fx"])
    columns = [rows[i][j] for j in range(4) for i in range(4)]
    return {
        "asset": {"version": "2.0", "generator": "splatfix"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "splatfix", "camera": 0, "matrix": columns}],
        "cameras": [{"type": "perspective", "perspective": lens}],
    }


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as job, open(sys.argv[2], "w", encoding="utf-8") as out:
        json.dump(gltf(json.load(job)["result"]), out)
