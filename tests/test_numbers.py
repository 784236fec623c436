"""Scenes far from their origin, or in another unit: the same pictures, and results in the file's own frame."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_room import INTRINSICS, pose_at, write_room

from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.photos.images import open_photo, query_of
from service.results import Status
from service.scene_formats import load_scene
from service.scene_formats.cache import mapped_scene
from service.scene_manager.entry import Entry
from service.scene_manager.manager import Scenes
from service.scene_manager.scene_images import picture
from service.scene_manager.splat_sample import packed_splats
from service.scene_manager.status import PictureSpec
from service.scene_origin import shifted
from service.tracking import Tracker
from service.types import BoxPrior, Camera, GaussianPosePrior, Intrinsics, Pose

LENS = Intrinsics(**INTRINSICS)
UTM = np.array([448_312.25, 5_411_877.5, 312.0])
POSE = pose_at(0.3, 0.1)


def write_moved(source: Path, folder: Path, unit: float = 1.0, offset: np.ndarray | tuple = (0, 0, 0)) -> Path:
    """Write the room in another unit and place, with coordinates as doubles; cameras too."""
    folder.mkdir(parents=True, exist_ok=True)
    head, _, data = (source / "scene.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[2].decode() for line in head.splitlines() if line.startswith(b"property")]
    table = np.frombuffer(data, "<f4").reshape(-1, len(names))
    moved = np.empty(len(table), [(name, "<f8" if name in "xyz" else "<f4") for name in names])
    for i, name in enumerate(names):
        moved[name] = table[:, i]
        if name in "xyz":
            moved[name] = table[:, i].astype(np.float64) * unit + offset["xyz".index(name)]
        elif name.startswith("scale_"):
            moved[name] = table[:, i] + np.log(unit)
    for axis in (b"x", b"y", b"z"):
        head = head.replace(b"property float %s\n" % axis, b"property double %s\n" % axis)
    (folder / "scene.ply").write_bytes(head + b"end_header\n" + moved.tobytes())
    cameras = json.loads((source / "transforms.json").read_text())
    for frame in cameras["frames"]:
        frame["transform_matrix"] = in_world(
            Pose(np.array(frame["transform_matrix"])), unit, offset
        ).world_from_camera.tolist()
    (folder / "transforms.json").write_text(json.dumps(cameras))
    return folder


def in_world(pose: Pose, unit: float, offset: np.ndarray | tuple) -> Pose:
    matrix = pose.world_from_camera.copy()
    matrix[:3, 3] = unit * matrix[:3, 3] + offset
    return Pose(matrix)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return write_room(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def at_origin(room, scene_cache) -> LoadedScene:
    return LoadedScene.of(load_scene(room), rasterizer="cpu", cache_dir=scene_cache)


@pytest.fixture(scope="module")
def image(at_origin) -> np.ndarray:
    return np.asarray(at_origin.rasterizer.render([Camera(LENS, POSE)])[0].rgb)


@pytest.fixture(scope="module")
def at_utm(room, tmp_path_factory) -> LoadedScene:
    folder = write_moved(room, tmp_path_factory.mktemp("utm"), offset=UTM)
    return LoadedScene.load(folder, rasterizer="cpu", cache_dir=tmp_path_factory.mktemp("cache"))


@pytest.mark.parametrize("unit", [1e-4, 1e-3, 1e3, 1e5])
def test_a_scene_looks_the_same_in_every_unit(room, image, tmp_path, unit):
    loaded = LoadedScene.of(load_scene(write_moved(room, tmp_path, unit)), rasterizer="cpu")
    pose = in_world(POSE, unit, (0, 0, 0))
    frame = loaded.rasterizer.render([Camera(LENS, pose)])[0]
    assert np.abs(frame.rgb - image).max() < 0.02  # seen: 0.004 (logarithms of scales are float32)
    assert np.isclose(np.median(frame.median_depth), unit * 1.8, rtol=0.5)


@pytest.mark.parametrize("offset", [(5_000.0, 0.0, 0.0), (500_000.0, -3.0, 7.5), tuple(UTM)])
def test_a_scene_far_from_its_origin_looks_the_same(room, image, tmp_path, offset):
    scene = load_scene(write_moved(room, tmp_path, offset=offset))
    assert np.abs(scene.means).max() < 10
    pose = shifted(POSE, np.subtract(offset, scene.info.origin_in_world))
    frame = LoadedScene.of(scene, rasterizer="cpu").rasterizer.render([Camera(LENS, pose)])[0]
    assert np.abs(frame.rgb - image).max() < 0.02  # seen: 0.001


def test_the_manifest_moves_before_anything_is_rounded(room, image, tmp_path):
    folder = write_moved(room, tmp_path, offset=UTM)
    back = np.eye(4)
    back[:3, 3] = -UTM
    (folder / "scene.json").write_text(json.dumps({"world_from_scene": back.tolist()}))
    scene = load_scene(folder)
    assert scene.info.origin_in_world == (0, 0, 0)
    frame = LoadedScene.of(scene, rasterizer="cpu").rasterizer.render([Camera(LENS, POSE)])[0]
    assert np.abs(frame.rgb - image).max() < 0.02  # seen: 0.001


def test_photos_are_localized_in_the_files_own_coordinates(at_origin, at_utm, image):
    photo = query_of((255 * image + 0.5).astype(np.uint8), intrinsics=LENS, prior=shifted(POSE, (0.2, 0.1, 0.0)))
    expected = localize(photo, at_origin).pose
    truth, records = shifted(POSE, UTM), []
    box = BoxPrior(truth.position_in_world - 1.5, truth.position_in_world + 1.5)
    photo = replace(photo, prior=photo.prior and shifted(photo.prior, UTM), region=box)
    estimate = localize(photo, at_utm, Request(), records.append)
    assert estimate.verdict.status is Status.LOCALIZED
    for pose in (estimate.pose, estimate.records[-1].pose, records[-1].pose):
        way = pose.position_in_world - UTM - expected.position_in_world
        assert np.linalg.norm(way) < 0.003  # seen: 0.0002; the pose itself is 0.014 off
    for matches in [r.matches for r in estimate.records if r.matches]:
        assert np.linalg.norm(matches.render_camera.pose.position_in_world - UTM) < 5
    gaussian = GaussianPosePrior(truth, np.diag([0.1] * 6))
    tracked = Tracker(at_utm).track(replace(photo, region=gaussian)).pose
    assert np.linalg.norm(tracked.position_in_world - truth.position_in_world) < 0.03  # seen: 0.014


@pytest.mark.ci
def test_a_region_elsewhere_excludes_the_pose(at_utm, image):
    photo = query_of((255 * image + 0.5).astype(np.uint8), intrinsics=LENS)
    box = BoxPrior(np.full(3, -5.0), np.full(3, 5.0))
    assert localize(replace(photo, region=box), at_utm).verdict.status is not Status.LOCALIZED


def test_what_leaves_a_scene_is_in_the_world(at_utm, image):
    scenes = Scenes("view_index", None)
    scenes.add(Entry("utm", None, "ready", at_utm))
    contents = scenes.contents("utm")
    assert contents is not None
    assert contents.bounds_in_world is not None
    assert np.abs(contents.bounds_in_world - UTM).max() < 3
    assert np.abs(contents.cameras[0].camera.pose.position_in_world - UTM).max() < 3
    jpeg = picture(at_utm, PictureSpec(shifted(POSE, UTM), LENS, quality=95))
    drawn = open_photo(jpeg).query(intrinsics=LENS).rgb
    assert np.abs(drawn / 255 - image).mean() < 0.02  # seen: 0.01, JPEG's
    splats = packed_splats(at_utm.scene, 10)
    start = 4 + int.from_bytes(splats[:4], "little")
    assert np.abs(np.frombuffer(splats, "<f4", 30, start).reshape(10, 3) - UTM).max() < 5


def test_a_mapped_scene_keeps_origin_and_near_plane(room, tmp_path):
    folder = write_moved(room, tmp_path / "scene", 1e-3, UTM)
    once, again = (mapped_scene(folder, tmp_path / "cache").info for _ in range(2))
    assert (once.origin_in_world, once.near_plane) == (again.origin_in_world, again.near_plane)
    assert np.abs(once.origin_in_world - UTM).max() < 0.01
    assert once.near_plane < 1e-3
