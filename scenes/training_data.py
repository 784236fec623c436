"""What the trainer starts from: photos with their cameras, and points."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from service.geometry import nearest_point_to_axes, project, transformed, unproject
from service.types import Camera, Intrinsics, Pose

MIN_VIEWS = 3
"""Photos that must show a random point: one or two don't say how far away it is."""
DEPTHS = (0.1, 2.0)
"""Of random points, as shares of the scene's size."""


@dataclass(slots=True)
class Photo:
    """A photo with its camera; `name` as in transforms.json."""

    name: str
    camera: Camera
    rgb: np.ndarray
    _blurred: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def blurred(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the photo (0..1) with its local means and variances for SSIM; computed once."""
        if self._blurred is None:
            target = self.rgb.astype(np.float32) / np.float32(255)
            means = blur(target)
            self._blurred = target, means, blur(target * target) - means * means
        return self._blurred


def blur(image: np.ndarray) -> np.ndarray:
    """Return the image under SSIM's window (Wang et al. 2004): Gaussian, 11 pixels, sigma 1.5.

    The filter is symmetric, so it is its own adjoint.
    """
    return cv2.GaussianBlur(image, (11, 11), 1.5, borderType=cv2.BORDER_CONSTANT)


def read_photos(folder: Path, key: str, every: int = 1, long_side: int | None = None) -> list[Photo]:
    """Return the photos that `transforms.json` lists under the key, reduced to `long_side` pixels.

    Of these `every` takes the first, and then every second, third and so on.
    """
    transforms = json.loads((folder / "transforms.json").read_text())
    frames = {frame["file_path"]: frame for frame in transforms["frames"]}
    photos = []
    for name in transforms[key][::every]:
        frame, pixels = frames[name], Image.open(folder / name).convert("RGB")
        intrinsics = Intrinsics(*pixels.size, frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"])
        if long_side is not None and long_side < intrinsics.long_side:
            intrinsics = intrinsics.with_long_side(long_side)
            pixels = pixels.resize((intrinsics.width, intrinsics.height), Image.Resampling.BOX)
        opencv = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])
        photos.append(Photo(name, Camera(intrinsics, Pose(opencv)), np.asarray(pixels)))
    return photos


def given_points(path: Path, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and colours of so many of the file's points."""
    given = np.load(path, allow_pickle=False)
    rows = given[rng.choice(len(given), count, replace=len(given) < count)]
    points, colours = rows[:, :3].astype(np.float32), rows[:, 3:]
    if len(given) < count:
        # Points drawn twice are moved apart by a centimetre, else their Gaussians would stay identical.
        points = points + rng.normal(size=points.shape).astype(np.float32) * 0.01
    return points, colours


def random_points(photos: list[Photo], count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return positions at random depths behind random pixels, and the colours of these.

    The depths are uniform up to twice the distance that the cameras have from each other or from what they look at.
    Only points in the view of MIN_VIEWS cameras are kept.
    """
    places = np.array([photo.camera.pose.position_in_world for photo in photos])
    focus = nearest_point_to_axes([photo.camera.pose for photo in photos])
    reach = max(extent_of(places), float(np.median(np.linalg.norm(places - focus, axis=1))))
    points, colours, found = [], [], 0
    while found < count:
        for photo in photos:
            k, each = photo.camera.intrinsics, max(1, count // len(photos))
            pixels = rng.uniform(0, (k.width, k.height), (each, 2))
            depth = rng.uniform(*np.array(DEPTHS) * reach, each)
            inside = transformed(photo.camera.pose.world_from_camera, unproject(pixels, depth, k))
            kept = views_of(inside, photos) >= min(MIN_VIEWS, len(photos))
            column, row = pixels[kept].astype(int).T
            points.append(inside[kept])
            colours.append(photo.rgb[row, column] / 255)
            found += np.count_nonzero(kept)
    chosen = rng.permutation(found)[:count]
    return np.concatenate(points)[chosen], np.concatenate(colours)[chosen]


def views_of(points: np.ndarray, photos: list[Photo]) -> np.ndarray:
    """Return how many of the photos have each point in their view."""
    count = np.zeros(len(points), int)
    for photo in photos:
        k = photo.camera.intrinsics
        local = transformed(photo.camera.pose.camera_from_world, points)
        ahead = np.flatnonzero(local[:, 2] > 0)
        pixels = project(local[ahead], k)
        count[ahead] += np.all((pixels >= 0) & (pixels < (k.width, k.height)), axis=1)
    return count


def extent_of(places: np.ndarray) -> float:
    """Return the largest distance of a camera from their mean."""
    return float(np.linalg.norm(places - places.mean(0), axis=1).max())


def write_cameras(folder: Path, out: Path, names: list[str], intrinsics: Intrinsics) -> None:
    """Write transforms.json with the named cameras of the folder's, and scene.json with the size trained at."""
    transforms = json.loads((folder / "transforms.json").read_text())
    frames = {frame["file_path"]: frame for frame in transforms["frames"]}
    kept = {
        "camera_model": "PINHOLE", "train_filenames": names, "test_filenames": [], "frames": [frames[n] for n in names]
    }  # fmt: skip
    background = transforms.get("background", [0, 0, 0])
    manifest = {"background": background, "training_size": [intrinsics.width, intrinsics.height]}
    (out / "transforms.json").write_text(json.dumps(kept) + "\n")
    (out / "scene.json").write_text(json.dumps(manifest) + "\n")
