"""Files beside the photos: poses, true poses of held-out photos, and points to initialize Gaussians."""

from __future__ import annotations

import json
from pathlib import Path

import cameras
import numpy as np
import photos
from cameras import Room, View

Array = np.ndarray

POINTS = 240_000
OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenGL camera axes to OpenCV's, and back


def write_transforms(out: Path, training: list[View], heldout: list[View]) -> None:
    """Write poses and intrinsics of all upright photos in nerfstudio's layout."""
    names = [f"train/{v.name}.png" for v in training]
    tests = [f"heldout_original/{v.name}.png" for v in heldout]
    frames = [
        {
            "file_path": name,
            "w": view.width,
            "h": view.height,
            "fl_x": view.focal,
            "fl_y": view.focal,
            "cx": view.width / 2,
            "cy": view.height / 2,
            "transform_matrix": view.pose.tolist(),
        }
        for name, view in zip(names + tests, training + heldout, strict=True)
    ]
    layout = {
        "camera_model": "PINHOLE",
        "background": [0, 0, 0],
        "train_filenames": names,
        "test_filenames": tests,
        "frames": frames,
    }
    (out / "transforms.json").write_text(json.dumps(layout, indent=1) + "\n")


def write_heldout(out: Path, heldout: list[View], modifications: tuple[str, ...]) -> None:
    """Write the held-out photos, some of them altered, and truth.json."""
    truth = []
    turns = iter((6, 8))
    count = {"exposure": 0, "occlusion": 0}
    for view, modification in zip(heldout, modifications, strict=True):
        photo = photos.read(out / "heldout_original" / f"{view.name}.png")
        if modification == "exposure":
            photo = photos.expose(photo, count[modification])
        elif modification == "occlusion":
            photo, share = photos.occlude(photo, count[modification])
            print(f"{view.name}: {share:.1%} occluded", flush=True)
        if modification in count:
            count[modification] += 1
        orientation = next(turns) if modification == "portrait" else 1
        photos.write_jpeg(photo, view, orientation, out / "photos" / f"{view.name}.jpg")
        truth.append(
            {
                "photo": f"{view.name}.jpg",
                "modification": modification,
                "original": f"{view.name}.png",
                "intrinsics": {
                    "width": view.width,
                    "height": view.height,
                    "fx": view.focal,
                    "fy": view.focal,
                    "cx": view.width / 2,
                    "cy": view.height / 2,
                },
                "world_from_camera": (view.pose @ OPENCV).tolist(),
            }
        )
    (out / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")


def write_points(out: Path, space: Room, training: list[View], rng: np.random.Generator) -> Array:
    """Write points of the scene's surface with their colours in the training photos."""
    each = POINTS // len(training)
    rows = []
    for view in training:
        photo = photos.read(out / "train" / f"{view.name}.png")
        eye = view.pose[:3, 3]
        for x, y in rng.integers(0, (view.width, view.height), (each, 2)):
            direction = cameras.ray(view, x + 0.5, y + 0.5)
            found = space.hit(eye, direction / np.linalg.norm(direction))
            if found:
                rows.append((*found[0], *photo[y, x]))
    points = np.array(rows, np.float32)
    np.save(out / "points.npy", points)
    return points


def check_poses(out: Path, space: Room, views: list[View], points: Array) -> None:
    """Reproject the points into some photos, also displaced by a pixel or two.

    With an exact pose convention the colours agree best without displacement.
    """
    shifts = {"0": (0, 0), "+1 u": (1, 0), "-1 u": (-1, 0), "+1 v": (0, 1), "-1 v": (0, -1)}
    differences: dict[str, list[Array]] = {name: [] for name in shifts}
    for view in views[::20]:
        photo = photos.read(out / "train" / f"{view.name}.png")
        u, v, depth = cameras.project(view, points[:, :3].astype(float))
        inside = (depth > 0.3) & (u > 3) & (u < view.width - 3) & (v > 3) & (v < view.height - 3)
        near = [k for k in np.flatnonzero(inside)[::3] if space.sees(view.pose[:3, 3], points[k, :3])]
        for name, (du, dv) in shifts.items():
            seen = bilinear(photo, u[near] + du, v[near] + dv)
            differences[name].append(np.abs(seen - points[near, 3:]).mean(axis=1))
    medians = {name: float(np.median(np.concatenate(d))) for name, d in differences.items()}
    print("colour difference of reprojected points, by displacement:", medians, flush=True)
    if min(medians, key=lambda name: medians[name]) != "0":
        raise RuntimeError("the poses do not match the photos")


def bilinear(photo: Array, u: Array, v: Array) -> Array:
    """Colours at image positions whose pixel centres lie at +0.5."""
    x, y = u - 0.5, v - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    upper = photo[top, left] * (1 - fx) + photo[top, left + 1] * fx
    lower = photo[top + 1, left] * (1 - fx) + photo[top + 1, left + 1] * fx
    return upper * (1 - fy) + lower * fy
