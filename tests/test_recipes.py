"""docs/recipes: each puts a point of the demo scene into the pixel of a photo where splatfix has it.

The point is the metal ball of docs/frames.md. What the other program does with a pose is written down here, or done by
the program itself, where it is installed; none of it uses a matrix of the recipe.
"""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from api_server import ROOT
from node import node

from service.geometry import moved, rotation_from_quat, se3_log
from service.jobs.model import JobResult
from service.results import PoseEstimate, Reason, StageTiming, Status, Verdict
from service.types import Intrinsics, Pose
from service.web.schemas.conversion import pose_out, result_out
from service.web.schemas.exports import exported

RECIPES = ROOT / "docs" / "recipes"
BALL = np.array([2.42, 1.96, 0.847])
PIXEL = np.array([366.7, 350.4])
"""Of the ball in the photo, as docs/frames.md has it to a tenth."""
TAKEN = json.loads((ROOT / "scenes" / "studio" / "truth.json").read_text("utf-8"))[0]
WORLD_FROM_CAMERA = np.array(TAKEN["world_from_camera"])
K = {name: TAKEN["intrinsics"][name] for name in ("width", "height", "fx", "fy", "cx", "cy")}
POSE = pose_out(Pose(WORLD_FROM_CAMERA)).model_dump(mode="json")
RESULT: dict[str, Any] = {
    "status": "localized",
    "pose": POSE,
    "intrinsics": {**K, "model": "PINHOLE", "distortion": []},
    "frames": None,
}
JOB = {"id": "j", "photo": {"name": "a photo.jpg"}, "result": RESULT}


def recipe(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(path).stem, RECIPES / path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def seen(right: float, down: float, ahead: float) -> np.ndarray:
    return np.array([K["fx"] * right / ahead + K["cx"], K["fy"] * down / ahead + K["cy"]])


def test_the_golden_case_is_the_one_of_frames_md():
    x, y, z, _ = np.linalg.inv(WORLD_FROM_CAMERA) @ [*BALL, 1]
    assert np.allclose(seen(x, y, z), PIXEL, atol=0.05)
    assert "(366.7, 350.4)" in (ROOT / "docs" / "frames.md").read_text("utf-8")


@pytest.mark.skipif(shutil.which("mcs") is None or shutil.which("mono") is None, reason="there is no Mono")
def test_unity(tmp_path):
    sources = RECIPES / "unity" / "SplatfixPose.cs", ROOT / "tests" / "unity_stand_in.cs"
    subprocess.run(["mcs", f"-out:{tmp_path / 'golden.exe'}", *sources], check=True, capture_output=True, timeout=60)
    numbers = [*POSE["position"], *POSE["world_from_camera"]["quaternion_wxyz"], *K.values(), *BALL]
    command = ["mono", str(tmp_path / "golden.exe"), *map(str, numbers)]
    told = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    *pixel, depth = map(float, told.split())
    # In single precision.
    assert np.allclose(pixel, PIXEL, atol=0.06)
    assert -1 < depth < 1


def test_three_js_and_webxr():
    module = f"""
import {{ projection, sessionFromScene }} from "{(RECIPES / "threejs.js").as_uri()}";
const [pose, k, view] = JSON.parse(process.argv[2]);
console.log(JSON.stringify([projection(k, 0.1, 100), sessionFromScene(view, pose, 0.5)]));
"""
    session_from_camera = moved(Pose(np.eye(4)), np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0])).world_from_camera
    told = json.loads(node(module, json.dumps([POSE, K, session_from_camera.T.ravel().tolist()])))
    matrix, session = np.array(told[0]), np.array(told[1]).reshape(4, 4).T  # columns
    # In the session the content is half as large, and is seen by the camera as the photo has it.
    in_session = session[:3, :3] @ BALL + session[:3, 3]
    x, y, z, _ = np.linalg.inv(session_from_camera) @ [*in_session, 1]
    assert np.allclose(seen(x, -y, -z), PIXEL, atol=0.05)
    assert np.linalg.det(session[:3, :3]) == pytest.approx(0.125)
    # The frame of WebGL: -1..1, y up.
    cx, cy, cz, cw = matrix @ [x, y, z, 1]
    assert np.allclose([(cx / cw + 1) / 2 * K["width"], (1 - cy / cw) / 2 * K["height"]], PIXEL, atol=0.05)
    assert -1 < cz / cw < 1


@pytest.fixture(scope="module")
def ros() -> ModuleType:
    return recipe("ros2/ros_poses.py")


def test_ros_2(ros):
    """A robot that odometry has elsewhere is moved to where its camera saw the ball."""
    odom_from_camera = moved(Pose(np.eye(4)), np.array([0.1, 2.9, -0.4, 5.0, -2.0, 0.3])).world_from_camera
    (tx, ty, tz), (x, y, z, w) = ros.pose_of(ros.map_from_odom(WORLD_FROM_CAMERA, odom_from_camera, 2.0))
    assert w >= 0
    rotation = rotation_from_quat(np.array([w, x, y, z]))
    camera_in_odom = odom_from_camera[:3, 3]
    assert np.allclose(rotation @ camera_in_odom + [tx, ty, tz], 2 * WORLD_FROM_CAMERA[:3, 3])
    point = rotation.T @ (2 * BALL - [tx, ty, tz])  # the ball in odom, in metres
    right, down, ahead = odom_from_camera[:3, :3].T @ (point - camera_in_odom)
    assert np.allclose(seen(right, down, ahead), PIXEL, atol=0.05)


def test_quaternions_for_ros_of_every_kind(ros):
    for seed in range(40):
        twist = np.random.default_rng(seed).normal(size=6) * [2, 2, 2, 1, 1, 1]
        pose = moved(Pose(np.eye(4)), twist).world_from_camera
        _, (x, y, z, w) = ros.pose_of(pose)
        assert np.allclose(rotation_from_quat(np.array([w, x, y, z])), pose[:3, :3], atol=1e-12)


def test_the_covariance_for_ros_is_in_its_order(ros):
    """Poses that are drawn as splatfix means it, in the order and the axes that ROS has."""
    rng = np.random.default_rng(0)
    spread = 1e-3 * rng.normal(size=(6, 6))
    covariance = spread @ spread.T
    twists = rng.multivariate_normal(np.zeros(6), covariance, 5000)
    drawn = [moved(Pose(WORLD_FROM_CAMERA), twist).world_from_camera for twist in twists]
    shifts = [2.0 * (m[:3, 3] - WORLD_FROM_CAMERA[:3, 3]) for m in drawn]
    turns = []
    for m in drawn:
        turn = np.eye(4)
        turn[:3, :3] = m[:3, :3] @ WORLD_FROM_CAMERA[:3, :3].T
        turns.append(se3_log(turn)[:3])
    told = np.array(ros.covariance_of(WORLD_FROM_CAMERA, covariance, 2.0)).reshape(6, 6)
    measured = np.cov(np.c_[shifts, turns].T)
    # 0.03 seen: what 5000 draws leave.
    assert np.allclose(told, measured, atol=0.06 * np.abs(measured).max())


def test_the_ros_message_has_the_numbers_in_its_fields(ros):
    rosbags = pytest.importorskip("rosbags.typesys", reason="the package rosbags is not installed")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    kind = store.types["geometry_msgs/msg/PoseWithCovariance"]
    point, quaternion = (store.types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion"))
    pose = store.types["geometry_msgs/msg/Pose"]
    translation, rotation = ros.pose_of(WORLD_FROM_CAMERA)
    covariance = ros.covariance_of(WORLD_FROM_CAMERA, np.diag([1, 2, 3, 40, 50, 60]))
    said = kind(pose=pose(point(*translation), quaternion(*rotation)), covariance=np.array(covariance))
    back = store.deserialize_cdr(store.serialize_cdr(said, kind.__msgtype__), kind.__msgtype__)
    q = back.pose.orientation
    r = rotation_from_quat(np.array([q.w, q.x, q.y, q.z]))
    p = back.pose.position
    assert np.allclose(seen(*(r.T @ (BALL - [p.x, p.y, p.z]))), PIXEL, atol=0.05)
    assert np.allclose(np.linalg.eigvalsh(back.covariance.reshape(6, 6)[:3, :3]), [40, 50, 60])
    assert np.allclose(np.linalg.eigvalsh(back.covariance.reshape(6, 6)[3:, 3:]), [1, 2, 3])


def test_a_camera_info_is_what_the_service_takes(ros):
    k = [K["fx"], 0, K["cx"] - 0.5, 0, K["fy"], K["cy"] - 0.5, 0, 0, 1]
    assert ros.intrinsics_of(K["width"], K["height"], k, "plumb_bob", [0.0] * 5) == pytest.approx(K)
    bent = ros.intrinsics_of(K["width"], K["height"], k, "plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.5])
    assert bent["distortion"] == [0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0]
    fisheye = ros.intrinsics_of(K["width"], K["height"], k, "equidistant", [0.1, 0.2, 0.3, 0.4])
    assert (fisheye["model"], fisheye["distortion"]) == ("OPENCV_FISHEYE", [0.1, 0.2, 0.3, 0.4])


def test_blender(tmp_path):
    """By Blender itself: its own matrix of the view and the projection."""
    bpy = pytest.importorskip("bpy", reason="Blender's module is not installed")
    from mathutils import Vector

    camera_of = recipe("blender_camera.py").add_camera
    for stretch in (1.0, 1.2, 0.8):
        # With pixels that aren't square, and a principal point that isn't the centre.
        k = {**K, "fy": K["fy"] * stretch, "cx": K["cx"] + 20, "cy": K["cy"] - 9}
        camera = camera_of({**RESULT, "intrinsics": k})
        scene = bpy.context.scene
        bpy.context.view_layer.update()
        render = scene.render
        projection = camera.calc_matrix_camera(
            bpy.context.evaluated_depsgraph_get(),
            x=render.resolution_x,
            y=render.resolution_y,
            scale_x=render.pixel_aspect_x,
            scale_y=render.pixel_aspect_y,
        )
        clip = projection @ camera.matrix_world.inverted() @ Vector((*BALL, 1))
        pixel = [(clip.x / clip.w + 1) / 2 * k["width"], (1 - clip.y / clip.w) / 2 * k["height"]]
        middle = np.array([K["cx"], K["cy"]])
        assert np.allclose(pixel, (PIXEL - middle) * [1, stretch] + middle + [20, -9], atol=0.1)
    answer = {"status": "localized", "world_from_camera": POSE["world_from_camera"]}
    walk = [{"index": i, "time_s": i / 12, **answer} for i in range(3)]
    camera = camera_of({**RESULT, "frames": walk})
    assert (scene.frame_end, round(scene.render.fps / scene.render.fps_base, 6)) == (2, 12)
    scene.frame_set(2)
    assert np.allclose(camera.matrix_world, POSE["opengl"]["world_from_camera"]["matrix"], atol=1e-5)
    plate = bpy.data.images.new("plate", 8, 8)
    plate.filepath_raw = str(tmp_path / "plate.png")
    plate.file_format = "PNG"
    plate.save()
    camera = camera_of(RESULT, str(tmp_path / "plate.png"))
    assert camera.data.background_images[0].image.size[0] == 8


def test_gltf():
    document = recipe("gltf_camera.py").gltf(RESULT)
    node_, lens = document["nodes"][0], document["cameras"][0]["perspective"]
    matrix = np.array(node_["matrix"]).reshape(4, 4).T
    x, y, z, _ = np.linalg.inv(matrix) @ [*BALL, 1]
    # As glTF defines the perspective camera.
    half = np.tan(lens["yfov"] / 2)
    across, up = x / -z / (lens["aspectRatio"] * half), y / -z / half
    pixel = np.array([(across + 1) / 2 * K["width"], (1 - up) / 2 * K["height"]])
    centre = np.array([K["width"] / 2, K["height"] / 2])
    assert np.allclose(pixel - centre + [K["cx"], K["cy"]], PIXEL, atol=0.05)


def test_nerfstudio_and_colmap_exports():
    """What the service writes: nerfstudio's cameras have OpenGL's axes, COLMAP's images have camera_from_world."""
    k = Intrinsics(int(K["width"]), int(K["height"]), K["fx"], K["fy"], K["cx"], K["cy"])
    verdict = Verdict(Status.LOCALIZED, Reason.VERIFIED, 0.9, 100, 0.8, 1.0, np.eye(6))
    estimate = PoseEstimate(
        Pose(WORLD_FROM_CAMERA), verdict, k, "given", "studio", "0" * 64, "e", "r", "m", 0, False, 0, (), (), ()
    )  # fmt: skip
    result = result_out(JobResult(estimate, StageTiming("decode", 0, 0), None, {}))
    frame = json.loads(exported("nerfstudio", "a photo.jpg", datetime(2026, 1, 2, tzinfo=UTC), result))
    x, y, z, _ = np.linalg.inv(np.array(frame["transform_matrix"])) @ [*BALL, 1]
    pixel = frame["fl_x"] * x / -z + frame["cx"], frame["fl_y"] * -y / -z + frame["cy"]
    assert np.allclose(pixel, PIXEL, atol=0.05)
    lines = exported("colmap", "a photo.jpg", datetime(2026, 1, 2, tzinfo=UTC), result).splitlines()
    numbers = np.array(next(line for line in lines if line[0] != "#").split()[1:8], float)
    assert np.allclose(seen(*(rotation_from_quat(numbers[:4]) @ BALL + numbers[4:])), PIXEL, atol=0.05)


def colmap_model(tmp_path: Path) -> Path:
    (tmp_path / "job.json").write_text(json.dumps(JOB))
    lost = {**JOB, "result": {**RESULT, "status": "not_localized"}}
    (tmp_path / "lost.json").write_text(json.dumps(lost))
    command = [sys.executable, RECIPES / "colmap_model.py", "model", "job.json", "lost.json"]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=60)
    return tmp_path / "model"


def test_colmap_text(tmp_path):
    folder = colmap_model(tmp_path)
    (camera,) = (folder / "cameras.txt").read_text().splitlines()
    assert camera.split()[:2] == ["1", "PINHOLE"]
    width, height, fx, fy, cx, cy = map(float, camera.split()[2:])
    image, empty = (folder / "images.txt").read_text().splitlines()
    _, *pose, camera_id, name = image.split()
    assert (camera_id, name, empty) == ("1", "a_photo.jpg", "")
    quaternion, translation = np.array(pose[:4], float), np.array(pose[4:], float)
    x, y, z = rotation_from_quat(quaternion) @ BALL + translation
    assert np.allclose([fx * x / z + cx, fy * y / z + cy], PIXEL, atol=0.05)
    assert (width, height) == (K["width"], K["height"])


def test_colmap_reads_it(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    read = pycolmap.Reconstruction(str(colmap_model(tmp_path)))
    (image,) = read.images.values()
    assert np.allclose(image.project_point(BALL), PIXEL, atol=0.05)


def test_supersplat(tmp_path):
    """What SuperSplat does with a file of cameras: x and y are negated, it looks along the third column, y is up."""
    (tmp_path / "job.json").write_text(json.dumps(JOB))
    command = [sys.executable, RECIPES / "supersplat_cameras.py", tmp_path / "job.json"]
    (camera,) = json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)
    assert camera["img_name"] == "a photo.jpg"
    position, rotation = np.array(camera["position"]), np.array(camera["rotation"])
    target = position + 2 * rotation[:, 2]
    position, target = position * [-1, -1, 1], target * [-1, -1, 1]
    shown = np.array(recipe("supersplat_cameras.py").in_supersplat(BALL)) - position
    forward = (target - position) / np.linalg.norm(target - position)
    # The roll is not in the file, so the distance from the optical axis is what can be compared.
    off_axis = np.linalg.norm(np.cross(forward, shown)) / (forward @ shown)
    expected = (PIXEL - [K["cx"], K["cy"]]) / [K["fx"], K["fy"]]
    assert off_axis == pytest.approx(np.linalg.norm(expected), abs=2e-4)


def test_each_recipe_says_whether_it_was_run():
    text = (ROOT / "docs" / "clients.md").read_text("utf-8")
    kinds = (".cs", ".js", ".py", ".swift")
    files = {str(path.relative_to(ROOT / "docs")) for path in RECIPES.rglob("*") if path.suffix in kinds}
    assert files
    rows = [line for line in text.splitlines() if line.startswith("| [")]
    assert files == {name for row in rows for name in re.findall(r"\]\((recipes/[^)]+)\)", row)}
    for row in rows:
        assert re.search(r"\brun\b", row.split(" | ")[-1]), row
