"""The trainer: what it starts from, and that a planted scene comes back from its photos and random points."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scenes import train, training_data
from scenes.training_data import Photo
from service.geometry import look_at
from service.render.cpu import CpuRasterizer
from service.scene_formats import load_scene
from service.types import Camera, GaussianScene, Intrinsics, SceneInfo

SIZE = 32
INFO = SceneInfo("planted", "planted", "", "ply", (0, 0, 0), training_focal_px=34, training_long_side_px=SIZE)


def ring(count: int, radius: float = 3.0) -> list[Camera]:
    """Cameras around the origin, at two heights, that look at it."""
    intrinsics = Intrinsics(SIZE, SIZE, 34, 34, SIZE / 2, SIZE / 2)
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    places = [radius * np.array([np.cos(a), np.sin(a), 0.2 + 0.3 * (k % 2)]) for k, a in enumerate(angles)]
    return [Camera(intrinsics, look_at(at, np.zeros(3), np.array([0.0, 0, 1]))) for at in places]


def planted_scene() -> GaussianScene:
    """40 opaque coloured balls."""
    rng = np.random.default_rng(1)
    n = 40
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    scales = rng.uniform(0.08, 0.2, (n, 1)).repeat(3, 1).astype(np.float32)
    sh = rng.uniform(-1.2, 1.7, (n, 1, 3)).astype(np.float32)
    means = rng.uniform(-0.8, 0.8, (n, 3)).astype(np.float32)
    return GaussianScene(means, quats, scales, np.full(n, 0.95, np.float32), sh, INFO)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Photos of the planted scene: 24 to train on, and 6 between them."""
    at = tmp_path_factory.mktemp("planted")
    rasterizer = CpuRasterizer(planted_scene())
    frames, names = [], {"train": [], "test": []}
    for k, camera in enumerate(ring(30)):
        part = "test" if k % 5 == 2 else "train"
        name = f"{part}_{k:02d}.png"
        rgb = np.clip(rasterizer.render([camera])[0].rgb, 0, 1)
        Image.fromarray(np.round(rgb * 255).astype(np.uint8)).save(at / name)
        names[part].append(name)
        pose = camera.pose.world_from_camera @ np.diag([1.0, -1, -1, 1])
        lens = {"w": SIZE, "h": SIZE, "fl_x": 34, "fl_y": 34, "cx": SIZE / 2, "cy": SIZE / 2}
        frames.append({"file_path": name, "transform_matrix": pose.tolist()} | lens)
    splits = {f"{part}_filenames": found for part, found in names.items()}
    (at / "transforms.json").write_text(json.dumps(splits | {"frames": frames}))
    return at


def test_photos_are_thinned_and_reduced_with_their_intrinsics(folder):
    everything = training_data.read_photos(folder, "train_filenames")
    half = training_data.read_photos(folder, "train_filenames", every=2, long_side=16)
    assert [photo.name for photo in half] == [photo.name for photo in everything][::2]
    assert half[0].rgb.shape == (16, 16, 3)
    k = half[0].camera.intrinsics
    assert (k.width, k.fx, k.cx) == (16, 17, 8)
    blocks = everything[0].rgb.reshape(16, 2, 16, 2, 3).astype(float).mean((1, 3))
    assert np.abs(half[0].rgb - blocks).max() <= 1


def test_random_points_are_where_three_photos_show_them(folder):
    photos = training_data.read_photos(folder, "train_filenames")
    points, colours = training_data.random_points(photos, 500, np.random.default_rng(0))
    assert points.shape == colours.shape == (500, 3)
    seen = np.zeros(500, int)
    for photo in photos:
        pose, k = photo.camera.pose.camera_from_world, photo.camera.intrinsics
        for n, point in enumerate(points):
            x, y, z = pose[:3, :3] @ point + pose[:3, 3]
            if z > 0:
                u, v = k.fx * x / z + k.cx, k.fy * y / z + k.cy
                seen[n] += 0 <= u < k.width and 0 <= v < k.height
    assert seen.min() >= training_data.MIN_VIEWS
    # All of the scene is within reach, and so is the space around it.
    assert np.all(points.min(0) < -0.8)
    assert np.all(points.max(0) > 0.8)


def test_random_points_of_two_photos(folder):
    photos = training_data.read_photos(folder, "train_filenames")[:2]
    points, _ = training_data.random_points(photos, 50, np.random.default_rng(0))
    assert len(points) == 50


def test_given_points_are_the_files(tmp_path):
    rows = np.random.default_rng(0).uniform(size=(20, 6)).astype(np.float32)
    np.save(tmp_path / "points.npy", rows)
    points, colours = training_data.given_points(tmp_path / "points.npy", 30, np.random.default_rng(1))
    nearest = np.linalg.norm(points[:, None] - rows[None, :, :3], axis=2)
    assert nearest.min(1).max() < 0.06
    assert np.allclose(colours, rows[nearest.argmin(1), 3:])


def mean_psnr(scene: GaussianScene, photos: list[Photo]) -> float:
    # The file doesn't say what size it was trained at, on which the renders depend.
    rasterizer = CpuRasterizer(replace(scene, info=INFO))
    errors = [np.mean((np.clip(rasterizer.render([p.camera])[0].rgb, 0, 1) - p.rgb / 255) ** 2) for p in photos]
    return float(np.mean(-10 * np.log10(errors)))


@pytest.mark.ci
def test_a_planted_scene_comes_back_from_random_points(folder, tmp_path, monkeypatch, capsys):
    out = tmp_path / "retrained" / "scene.ply"
    options = ["--gaussians", "300", "--iterations", "400", "--random", "--cameras", "--every", "2"]
    monkeypatch.setattr("sys.argv", ["train", str(folder), "--out", str(out), *options])
    train.main()
    trained = load_scene(out)
    held_out = training_data.read_photos(folder, "test_filenames")
    nothing = float(np.mean([-10 * np.log10(np.mean((p.rgb / 255) ** 2)) for p in held_out]))
    found = mean_psnr(trained, held_out)
    assert found > nothing + 8
    assert f"from 12 photos, held-out PSNR {found:.2f} dB" in capsys.readouterr().out
    cameras = json.loads((out.parent / "transforms.json").read_text())
    expected = [photo.name for photo in training_data.read_photos(folder, "train_filenames", every=2)]
    assert [frame["file_path"] for frame in cameras["frames"]] == cameras["train_filenames"] == expected
    assert json.loads((out.parent / "scene.json").read_text())["training_size"] == [SIZE, SIZE]
