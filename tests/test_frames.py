"""docs/frames.md: its blocks run, and each recipe projects a point to the pixel where splatfix has it.

What the other program does with a pose is written down here from its own documentation, without a matrix of the recipe.
"""

from __future__ import annotations

import contextlib
import io
import re
from typing import Any

import numpy as np
import pytest
from api_server import ROOT

from service.geometry import moved, rotation_from_quat, se3_log
from service.types import Pose

DOCUMENT = (ROOT / "docs" / "frames.md").read_text("utf-8")
K = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 310.0, "cy": 251.0}
POSES = [moved(Pose(np.eye(4)), np.random.default_rng(seed).normal(size=6)).world_from_camera for seed in range(8)]
POINTS_IN_CAMERA = np.array([[0.3, -0.2, 2.0], [-0.7, 0.4, 3.0], [0.0, 0.5, 1.5]])


@pytest.fixture(scope="module")
def recipes() -> tuple[dict[str, Any], str]:
    """The document's names, and what it prints."""
    names: dict[str, Any] = {}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.chdir(ROOT):
        exec("\n".join(re.findall(r"```python\n(.*?)```", DOCUMENT, re.DOTALL)), names)
    return names, printed.getvalue()


def in_world(pose: np.ndarray) -> np.ndarray:
    return POINTS_IN_CAMERA @ pose[:3, :3].T + pose[:3, 3]


def pixels(right: np.ndarray, down: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    return np.stack([K["fx"] * right / ahead + K["cx"], K["fy"] * down / ahead + K["cy"]], 1)


SEEN = pixels(*POINTS_IN_CAMERA.T)


def turned_back(xyzw: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return q^-1 v q, as every program defines it in its own axes."""
    q, w = -np.asarray(xyzw[:3]), xyzw[3]
    return vectors + 2 * w * np.cross(q, vectors) + 2 * np.cross(q, np.cross(q, vectors))


def opengl(matrix: np.ndarray, world: np.ndarray) -> np.ndarray:
    """The pixels of a camera with y up that looks along -z; `matrix` is its own in the world."""
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
    x, y, z = (np.linalg.inv(matrix) @ np.c_[world, np.ones(3)].T)[:3]
    return pixels(x, -y, -z)


def test_the_worked_example_prints_what_the_page_says(recipes):
    names, printed = recipes
    assert printed.strip()
    assert f"```text\n{printed}```" in DOCUMENT
    rounded = re.search(r"```text\n( 0\.48.*?)```", DOCUMENT, re.DOTALL)
    assert rounded
    # Half of the last digit.
    assert np.allclose(np.array(rounded[1].split(), float).reshape(4, 4), names["world_from_camera"], atol=5.1e-5)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 2, 0), (0, 0, -1), (0.3, -0.5, 0.2)])
def test_the_levelled_world_points_up_and_has_metres(recipes, up):
    levelled = [recipes[0]["z_up_in_metres"](pose, up, 0.5) for pose in POSES]
    for pose, result in zip(POSES, levelled, strict=True):
        assert np.linalg.det(result[:3, :3]) == pytest.approx(1)
        # A camera's axes have the same heights over both ups, and its centre half the height.
        unit = np.array(up) / np.linalg.norm(up)
        assert np.allclose(unit @ pose[:3, :3], result[2, :3])
        assert unit @ pose[:3, 3] == pytest.approx(2 * result[2, 3])
    # All poses are moved alike.
    between = np.linalg.inv(POSES[0]) @ POSES[1]
    between[:3, 3] *= 0.5
    assert np.allclose(np.linalg.inv(levelled[0]) @ levelled[1], between)


@pytest.mark.parametrize("pose", POSES)
def test_unity(recipes, pose):
    position, rotation = recipes[0]["unity"](pose)
    x, y, z = turned_back(rotation, in_world(pose)[:, [0, 2, 1]] - position).T  # right, up, forward
    assert np.allclose(pixels(x, -y, z), SEEN)


@pytest.mark.parametrize("pose", POSES)
def test_unreal(recipes, pose):
    location, (pitch, yaw, roll) = recipes[0]["unreal"](pose)
    # Turned by the engine's three angles, one after the other: yaw from x to y, pitch from x to z, roll from z to y.
    x, y, z = (100 * in_world(pose) * [1, -1, 1] - location).T
    (sp, sy, sr), (cp, cy, cr) = (f(np.radians([pitch, yaw, roll])) for f in (np.sin, np.cos))
    x, y = cy * x + sy * y, cy * y - sy * x
    x, z = cp * x + sp * z, cp * z - sp * x
    y, z = cr * y - sr * z, cr * z + sr * y
    assert np.allclose(pixels(y, -z, x), SEEN)


@pytest.mark.parametrize("pose", POSES)
def test_three_js(recipes, pose):
    x, y, z = in_world(pose).T
    assert np.allclose(opengl(recipes[0]["three_js"](pose), np.stack([x, z, -y], 1)), SEEN)


@pytest.mark.parametrize("pose", POSES)
def test_arkit_and_webxr(recipes, pose):
    """The session's camera sees the scene's content where the photo has it, however both worlds are turned."""
    session_from_camera = POSES[3]
    session_from_scene = recipes[0]["session_from_scene"](session_from_camera, pose, 0.25)
    assert np.linalg.det(session_from_scene[:3, :3]) == pytest.approx(0.25**3)
    moved_points = in_world(pose) @ session_from_scene[:3, :3].T + session_from_scene[:3, 3]
    assert np.allclose(opengl(session_from_camera, moved_points), SEEN)


def test_a_photo_that_was_turned_upright(recipes):
    """A pixel of the sensor's image, turned with it, is the pixel of the camera that was localized."""
    sensor = np.zeros((480, 640), bool)
    sensor[100, 500] = True
    ((v, u),) = np.argwhere(np.rot90(sensor, -1))  # clockwise
    ray_in_sensor = np.array([500 + 0.5 - 320, 100 + 0.5 - 240, 500.0])
    ray_in_upright = np.array([u + 0.5 - 240, v + 0.5 - 320, 500.0])
    for world_from_upright in POSES:
        world_from_sensor = recipes[0]["sensor_pose"](world_from_upright)
        assert np.allclose(world_from_sensor[:3, :3] @ ray_in_sensor, world_from_upright[:3, :3] @ ray_in_upright)


@pytest.mark.parametrize("pose", POSES)
def test_ros(recipes, pose):
    translation, rotation = recipes[0]["ros_pose"](pose)
    assert np.allclose(pixels(*turned_back(rotation, in_world(pose) - translation).T), SEEN)
    translation, rotation = recipes[0]["ros_body"](pose)
    forward, left, up = turned_back(rotation, in_world(pose) - translation).T
    assert np.allclose(pixels(-left, -up, forward), SEEN)


def test_the_covariance_for_ros_is_that_of_poses_drawn_from_ours(recipes):
    rng, pose = np.random.default_rng(0), POSES[5]
    spread = 1e-3 * rng.normal(size=(6, 6))
    covariance = spread @ spread.T
    twists = rng.multivariate_normal(np.zeros(6), covariance, 20_000)
    drawn = [moved(Pose(pose), twist).world_from_camera for twist in twists]
    shifts = [2.0 * (matrix[:3, 3] - pose[:3, 3]) for matrix in drawn]
    turns = [se3_log(_rotation(matrix[:3, :3] @ pose[:3, :3].T))[:3] for matrix in drawn]
    seen = np.cov(np.c_[shifts, turns].T)
    # A hundredth is what 20,000 draws leave.
    assert np.allclose(recipes[0]["ros_covariance"](pose, covariance, 2.0), seen, atol=0.03 * np.abs(seen).max())


def _rotation(matrix: np.ndarray) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = matrix
    return result


@pytest.mark.parametrize("pose", POSES)
def test_blender(recipes, pose):
    matrix, lens, shift_x, shift_y = recipes[0]["blender"](pose, K)
    # The sensor is 36 mm wide, its frame shifted by shares of that; a frame that moves right moves its content left.
    ahead = opengl(matrix, in_world(pose)) - [K["cx"], K["cy"]]
    sensor_mm = ahead / K["fx"] * lens
    across = sensor_mm[:, 0] / 36 + 0.5 - shift_x
    down = sensor_mm[:, 1] / 36 + 0.5 * K["height"] / K["width"] + shift_y
    assert np.allclose(np.stack([across, down], 1) * K["width"], SEEN)


@pytest.mark.parametrize("pose", POSES)
def test_colmap(recipes, pose):
    image_id, *numbers, camera_id, name = recipes[0]["colmap_line"](pose, "a.jpg", 7, 2).split()
    assert (image_id, camera_id, name) == ("7", "2", "a.jpg")
    quaternion, translation = np.array(numbers[:4], float), np.array(numbers[4:], float)
    in_camera = in_world(pose) @ rotation_from_quat(quaternion).T + translation
    assert np.allclose(pixels(*in_camera.T), SEEN)


@pytest.mark.parametrize("pose", POSES)
def test_nerfstudio(recipes, pose):
    scale, data_pose = 0.3, POSES[1]
    turned = np.concatenate([POSES[6][:3, :3], [[0.2], [-0.4], [1.5]]], 1)
    # As its data parser makes the model's frame of the data's.
    model_pose = np.eye(4)
    model_pose[:3] = turned @ data_pose
    model_pose[:3, 3] *= scale
    world_from_camera = model_pose @ np.diag([1, -1, -1, 1])
    transforms = {"transform": turned.tolist(), "scale": scale}
    assert np.allclose(recipes[0]["nerfstudio_data_pose"](world_from_camera, transforms), data_pose)
