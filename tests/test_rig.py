"""Rigs: photos with planted relative poses as one query, in a small room."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from api_server import assert_problem, fake_estimators, ready_service
from api_server import photo as any_photo
from small_room import FOCAL, HALF_TURN, HEIGHT, INTRINSICS, WIDTH, pose_at, write_room
from typer.testing import CliRunner

from service.cli.app import app
from service.device_readings import DeviceReadings, Heading
from service.errors import InvalidRequest
from service.estimators.view_index import Options
from service.geometry import moved, pose_distance
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.photos.images import encode_image, query_of
from service.results import Reason, Status
from service.rig import RigPhoto, localize_rig
from service.types import Camera, GeoAnchor, Intrinsics, Pose

LENS = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
TILT = np.array([0.15, 0.0, 0.0, 0.0, 0.0, 0.0])
POSES = [moved(pose_at(angle, height), TILT) for angle, height in ((1.0, 0.1), (2.2, 0.0), (3.6, 0.2), (5.1, 0.1))]
WORLD_FROM_RIG = moved(POSES[0], np.array([0.2, 0.1, -0.3, 0.5, 0.2, 0.1]))
MOUNTS = [Pose(WORLD_FROM_RIG.camera_from_world @ pose.world_from_camera) for pose in POSES]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_room(tmp_path_factory.mktemp("rig") / "room")


@pytest.fixture(scope="module")
def room(folder, scene_cache) -> LoadedScene:
    loaded = LoadedScene.load(folder, cache_dir=scene_cache)
    loaded.prepare("view_index")
    return loaded


def pictures(room: LoadedScene, hidden: float = 0.6) -> list[np.ndarray]:
    """Photos of which a share is hidden by stripes of noise, on the left or on the right."""
    rng, found = np.random.default_rng(2), []
    for number, pose in enumerate(POSES):
        rgb = np.clip(255 * room.rasterizer.render([Camera(LENS, pose)])[0].rgb, 0, 255).astype(np.uint8)
        across = round(hidden * WIDTH)
        columns = slice(0, across) if number % 2 else slice(WIDTH - across, WIDTH)
        blocks = rng.integers(0, 255, (HEIGHT // 8, -(-across // 8), 3), np.uint8)
        rgb[:, columns] = blocks.repeat(8, 0).repeat(8, 1)[:, :across]
        found.append(rgb)
    return found


def photos(room: LoadedScene, mounts: list[Pose] | None = None, hidden: float = 0.6) -> list[RigPhoto]:
    queries = [query_of(rgb, intrinsics=LENS) for rgb in pictures(room, hidden)]
    return [RigPhoto(query, mount) for query, mount in zip(queries, mounts or MOUNTS, strict=True)]


@pytest.mark.ci
def test_photos_that_are_hidden_by_more_than_half_fail_alone(room):
    fast = Request(options=Options(effort="fast"))  # searches that fail are long
    assert Status.LOCALIZED not in [localize(photo.query, room, fast).verdict.status for photo in photos(room)]


@pytest.mark.ci
def test_photos_that_fail_alone_are_localized_together(room):
    found = localize_rig(photos(room), room)
    assert found.estimate.verdict.status is Status.LOCALIZED
    turned, way = pose_distance(found.world_from_rig, WORLD_FROM_RIG)
    assert turned < 0.2  # seen: 0.01
    assert way < 0.01
    assert np.array_equal(found.estimate.pose.world_from_camera, found.photos[0][0].world_from_camera)
    for (pose, verdict), truth in zip(found.photos, POSES, strict=True):
        assert pose_distance(pose, truth)[1] < 0.01
        assert verdict.covariance is not None
        assert np.sqrt(np.trace(verdict.covariance[3:, 3:])) < 0.02


@pytest.mark.ci
def test_wrong_relative_poses_are_never_localized(room):
    found = localize_rig(photos(room, [MOUNTS[1], MOUNTS[2], MOUNTS[3], MOUNTS[0]], 0.3), room)
    assert found.estimate.verdict.status is not Status.LOCALIZED


@pytest.mark.ci
def test_a_rig_in_a_room_that_repeats_itself_is_ambiguous_unless_a_heading_decides(tmp_path, scene_cache):
    """Each of its photos, and so the rig, has two places, half a turn apart."""
    twice = LoadedScene.load(write_room(tmp_path / "room", repeated=True), cache_dir=scene_cache)
    info = replace(twice.scene.info, geo_anchor=GeoAnchor(47.3, 8.5, 450.0, np.eye(4)))
    twice = replace(twice, scene=replace(twice.scene, info=info))
    first, *others = photos(twice, hidden=0.0)
    found = localize_rig([first, *others], twice)
    assert (found.estimate.verdict.status, found.estimate.verdict.reason) == (Status.UNCERTAIN, Reason.AMBIGUOUS)
    # The world's y is north.
    heading = float(np.degrees(np.arctan2(*POSES[0].axis_in_world[:2])))
    for off, truth in ((5.0, WORLD_FROM_RIG), (185.0, Pose(HALF_TURN @ WORLD_FROM_RIG.world_from_camera))):
        readings = DeviceReadings(heading=Heading((heading + off) % 360))
        found = localize_rig([replace(first, query=replace(first.query, readings=readings)), *others], twice)
        assert found.estimate.verdict.status is Status.LOCALIZED
        assert pose_distance(found.world_from_rig, truth)[1] < 0.01
    readings = DeviceReadings(heading=Heading((heading + 90) % 360))
    found = localize_rig([replace(first, query=replace(first.query, readings=readings)), *others], twice)
    assert found.estimate.verdict.reason is Reason.AMBIGUOUS
    assert any("heading" in warning for warning in found.estimate.warnings)


@pytest.mark.ci
def test_a_rig_in_a_room_that_is_the_same_upside_down_is_ambiguous(tmp_path):
    tumbled = LoadedScene.load(write_room(tmp_path / "room", 12, upside_down=True), cache_dir=tmp_path)
    found = localize_rig(photos(tumbled, hidden=0.0), tumbled)
    assert (found.estimate.verdict.status, found.estimate.verdict.reason) == (Status.UNCERTAIN, Reason.AMBIGUOUS)


def test_a_rig_in_metres_needs_a_scene_in_metres(room):
    with pytest.raises(InvalidRequest, match="length of a unit"):
        localize_rig(photos(room), room, metric=True)


def rig_field() -> dict:
    cameras = [{"rig_from_camera": mount.world_from_camera.tolist(), "intrinsics": INTRINSICS} for mount in MOUNTS]
    return {"cameras": cameras}


@pytest.mark.ci
def test_the_command_line_localizes_a_rig(room, folder, tmp_path):
    names = []
    for number, rgb in enumerate(pictures(room)):
        names.append(tmp_path / f"{number}.png")
        names[-1].write_bytes(encode_image(rgb / np.float32(255), "png"))
    (tmp_path / "rig.json").write_text(json.dumps(rig_field()))
    arguments = ["localize", *map(str, names), "--scene", str(folder), "--rig", str(tmp_path / "rig.json"), "--json"]
    ran = CliRunner().invoke(app, arguments)
    assert ran.exit_code == 0, ran.output
    (result,) = json.loads(ran.stdout)
    assert result["status"] == "localized"
    assert [frame["status"] for frame in result["frames"]] == 4 * ["localized"]
    for frame, truth in zip(result["frames"], POSES, strict=True):
        assert pose_distance(Pose(np.array(frame["world_from_camera"]["matrix"])), truth)[1] < 0.01


def test_what_is_wrong_with_a_rig_is_told_at_its_field():
    eye = np.eye(4).tolist()
    camera = {"rig_from_camera": eye, "intrinsics": {"width": 96, "height": 64, "fx": 80, "fy": 80, "cx": 48, "cy": 32}}
    sheared = [[1, 1, 0, 0], *eye[1:]]
    cases = [
        ({"cameras": [camera]}, {}, "invalid_request", "rig.cameras"),
        ({"cameras": 3 * [camera]}, {}, "invalid_request", "rig.cameras"),
        ({"cameras": [camera, camera | {"rig_from_camera": sheared}]}, {}, "invalid_request",
         "rig.cameras.1.rig_from_camera"),
        ({"cameras": [camera, camera | {"intrinsics": {"width": 96}}]}, {}, "invalid_intrinsics",
         "rig.cameras.1.intrinsics.height"),
        ({"cameras": 2 * [camera]}, {"times_s": "[1, 2]"}, "invalid_request", "times_s"),
        ({"cameras": 2 * [camera]}, {"scene": "auto"}, "invalid_request", "scene"),
    ]  # fmt: skip
    files = [("photo", (f"{n}.jpg", any_photo(), "image/jpeg")) for n in range(2)]
    with fake_estimators(), ready_service() as client:
        for rig, fields, code, where in cases:
            answer = client.post("/localize", files=files, data={"rig": json.dumps(rig), **fields})
            assert_problem(answer, 422 if code == "invalid_intrinsics" else 400, code, where)
