"""Training cameras in another frame or convention than the scene file: found out, corrected, told; or left out."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from rest_in_ci import rest_in_ci
from small_room import INTRINSICS, training_poses, write_room
from test_numbers import write_moved

from service.codec import decode, encode
from service.geometry import so3_exp
from service.loaded_scene import LoadedScene
from service.photos.images import encode_image
from service.pose.retrieval.viewpoints import index_cameras
from service.scene_formats import load_scene
from service.scene_formats.colmap import read_points
from service.scene_formats.manifest import Manifest
from service.scene_formats.normalizations import (
    COLMAP_TO_Z_UP,
    as_nerfstudio_trained,
    gsplat_normalization,
    gsplat_normalizations,
    nerfstudio_normalization,
    nerfstudio_normalizations,
    rotation_between,
)
from service.scene_formats.similarity import moved_pose
from service.scene_formats.training_files import read_training
from service.types import Camera, GaussianScene, Intrinsics, Pose, SceneFrame, SceneInfo
from service.web.schemas.conversion import result_pose_out

GL = np.diag([1.0, -1.0, -1.0, 1.0])
TURN = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
POSES = np.array([pose.world_from_camera for pose in training_poses(24)])
Change = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """A room with its training photos beside it."""
    folder = write_room(tmp_path_factory.mktemp("room"))
    (folder / "images").mkdir()
    cameras = [Camera(Intrinsics(**INTRINSICS), Pose(pose)) for pose in POSES]
    frames = LoadedScene.of(load_scene(folder), rasterizer="cpu").rasterizer.render(cameras)
    for i, frame in enumerate(frames):
        (folder / "images" / f"{i}.png").write_bytes(encode_image(frame.rgb, "png"))
    return folder


def planted(room: Path, folder: Path, change: Change, photos: bool = True, **more) -> Path:
    """Write the room with camera matrices that were changed."""
    (folder / "scene.ply").write_bytes((room / "scene.ply").read_bytes())
    cameras = json.loads((room / "transforms.json").read_text()) | more
    for frame in cameras["frames"]:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    (folder / "transforms.json").write_text(json.dumps(cameras))
    if photos:
        copytree(room / "images", folder / "images")
    return folder


def cameras_frame(scene: GaussianScene) -> SceneFrame:
    return next(frame for frame in scene.info.frames if frame.name == "cameras")


CONFUSIONS: dict[str, tuple[Change, Change, dict]] = {
    "right": (lambda m: m, lambda pose: pose @ GL, {}),
    "OpenCV's matrices": (lambda m: m @ GL, lambda pose: pose, {}),
    "camera_from_world": (lambda m: np.linalg.inv(m @ GL), lambda pose: np.linalg.inv(pose), {}),
    "y and z flipped": (lambda m: GL @ m, lambda pose: pose @ GL, {}),
    "applied_transform": (lambda m: TURN @ m, lambda pose: pose @ GL, {"applied_transform": TURN[:3].tolist()}),
}


@pytest.mark.parametrize(
    ("name", "photos"),
    [
        ("right", False),
        *rest_in_ci(("camera_from_world", True), *((n, True) for n in CONFUSIONS if n != "camera_from_world")),
        pytest.param("camera_from_world", False, marks=pytest.mark.ci),
    ],
)
def test_a_confusion_is_found_out_and_corrected(room, tmp_path, name, photos):
    change, spelled, more = CONFUSIONS[name]
    scene = load_scene(planted(room, tmp_path, change, photos, **more))
    frame = cameras_frame(scene)
    own = [np.array(f["transform_matrix"]) for f in json.loads((tmp_path / "transforms.json").read_text())["frames"]]
    for named, truth, matrix in zip(scene.cameras, POSES, own, strict=True):
        assert np.abs(named.camera.pose.world_from_camera - truth).max() < 1e-9
        pose = moved_pose(named.camera.pose, frame.frame_from_world).world_from_camera
        assert np.abs(spelled(pose) - matrix).max() < 1e-9
    assert frame.verified or not photos
    assert bool(scene.info.warnings) == (name != "right")
    assert all(name == "right" or "don't fit the scene as their file has them" in text for text in scene.info.warnings)


def test_nerfstudios_normalization_is_undone(room, tmp_path):
    """The data's world is tilted and larger; the trainer turned up to z, centred the cameras, and scaled them to 1."""
    positions = POSES[:, :3, 3]
    unit = 1 / np.abs(positions - positions.mean(0)).max()
    folder = write_moved(room, tmp_path, unit, -unit * positions.mean(0))
    copytree(room / "images", folder / "images")
    tilt = np.eye(4)
    tilt[:3, :3] = rotation_between(np.array([0, 0, 1.0]), np.array([0.6, 0, 0.8]))
    tilt[:3, 3] = 1.0, -2.0, 3.0
    cameras = json.loads((room / "transforms.json").read_text())
    for frame, pose in zip(cameras["frames"], POSES, strict=True):
        larger = pose.copy()
        larger[:3, 3] *= 2.5
        frame["transform_matrix"] = (tilt @ larger @ GL).tolist()
    (folder / "transforms.json").write_text(json.dumps(cameras))
    scene = load_scene(folder)
    assert "nerfstudio's normalization (orientation up, centre poses, scaled)" in cameras_frame(scene).decided_by
    for named, pose, frame in zip(scene.cameras, POSES, cameras["frames"], strict=True):
        expected = pose.copy()
        expected[:3, 3] = unit * (pose[:3, 3] - positions.mean(0))
        assert np.abs(named.camera.pose.world_from_camera - expected).max() < 1e-6
        own = moved_pose(named.camera.pose, cameras_frame(scene).frame_from_world).world_from_camera @ GL
        assert np.abs(own - frame["transform_matrix"]).max() < 1e-6
    # As nerfstudio writes it beside its model: x_in_model = scale * (transform @ x_in_data).
    transform = np.eye(4)
    transform[:3, :3] = tilt[:3, :3].T
    transform[:3, 3] = -tilt[:3, :3].T @ tilt[:3, 3] - 2.5 * positions.mean(0)
    written = {"transform": transform[:3].tolist(), "scale": unit / 2.5}
    (folder / "dataparser_transforms.json").write_text(json.dumps(written))
    again = load_scene(folder)
    assert cameras_frame(again).verified
    assert cameras_frame(again).decided_by.startswith("dataparser_transforms.json")
    assert np.allclose(again.cameras[3].camera.pose.world_from_camera, scene.cameras[3].camera.pose.world_from_camera)


def test_cameras_that_fit_nowhere_are_left_out(room, tmp_path):
    rng = np.random.default_rng(1)

    def scattered(matrix: np.ndarray) -> np.ndarray:
        moved = np.eye(4)
        moved[:3, :3] = so3_exp(rng.normal(size=3))
        moved[:3, 3] = 50 * rng.normal(size=3)
        return moved

    scene = load_scene(planted(room, tmp_path, scattered))
    assert scene.cameras == ()
    assert [frame.name for frame in scene.info.frames] == ["file"]
    assert "left out" in scene.info.warnings[0]
    assert scene.info.training_focal_px == INTRINSICS["fx"]  # the lens is right all the same


def test_few_cameras_are_taken_as_they_are(room, tmp_path):
    planted(room, tmp_path, lambda m: m @ GL, photos=False)
    file = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").write_text(json.dumps(file | {"frames": file["frames"][:3]}))
    scene = load_scene(tmp_path)
    assert len(scene.cameras) == 3
    assert not cameras_frame(scene).verified
    assert "too few" in cameras_frame(scene).decided_by


def test_the_manifest_moves_the_frames_too(room, tmp_path):
    planted(room, tmp_path, lambda m: m, photos=False)
    world = np.diag([2.0, 2.0, 2.0, 1.0])
    world[:3, 3] = 1, 2, 3
    (tmp_path / "scene.json").write_text(json.dumps({"world_from_scene": world.tolist()}))
    scene = load_scene(tmp_path)
    for frame in scene.info.frames:
        assert np.allclose(frame.frame_from_world, np.linalg.inv(world))
    assert np.allclose(scene.cameras[0].camera.pose.position_in_world, 2 * POSES[0][:3, 3] + [1, 2, 3])


def test_views_are_placed_beside_doubtful_cameras(room, tmp_path):
    scene = load_scene(planted(room, tmp_path, lambda m: m, photos=False))
    sure = LoadedScene.of(scene, rasterizer="cpu")
    doubtful = replace(scene, info=replace(scene.info, cameras_doubtful=True))
    counts = [
        len(index_cameras(each, sure.rasterizer, np.random.default_rng(0)))
        for each in (scene, doubtful, replace(doubtful, cameras=()))
    ]
    assert counts[1] == counts[0] + counts[2]
    assert counts[0] == len(POSES)


def test_nerfstudios_normalization_does_what_its_documentation_says():
    """Up becomes z, the cameras' mean the origin, the largest coordinate 1."""
    moved = np.array([moved_pose(Pose(TURN @ pose), W).world_from_camera for pose in POSES for W in [_ns()]])
    assert np.allclose(moved[:, :3, 3].mean(0), 0, atol=1e-9)
    assert np.isclose(np.abs(moved[:, :3, 3]).max(), 1)
    up = -moved[:, :3, 1].mean(0)
    assert np.allclose(up / np.linalg.norm(up), [0, 0, 1])


def _ns() -> np.ndarray:
    return nerfstudio_normalization(TURN @ POSES, "up", "poses", True)


SIGNS = [np.diag([*signs, 1.0]) for signs in ([1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1])]


def trained_by_pca(poses: np.ndarray, signs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What nerfstudio writes with orientation pca, and what its model has: turned about x where z comes out down."""
    middle = poses[:, :3, 3].mean(0)
    axes = np.linalg.svd(poses[:, :3, 3] - middle)[2].T
    axes[:, 2] *= np.linalg.det(axes)
    written = np.eye(4)
    written[:3, :3] = axes @ signs[:3, :3]  # not transposed
    written[:3, 3] = -written[:3, :3] @ middle
    is_down = (written @ poses @ GL).mean(0)[2, 1] < 0
    return written, GL @ written if is_down else written


def test_nerfstudios_pca_is_turned_as_its_trainer_does_whatever_the_signs_of_eigenvectors():
    """Its float32 gave other signs than numpy's float64 for the cameras of NeRF-Synthetic's chair."""
    poses = TURN @ POSES * [[1], [0.9], [0.8], [1]]  # no two axes with the same spread
    poses[:, :3, :3] = TURN[:3, :3] @ POSES[:, :3, :3]
    turned = []
    for signs in SIGNS:
        written, trained = trained_by_pca(poses, signs)
        turned.append(not np.allclose(written, trained))
        assert np.allclose(as_nerfstudio_trained(poses, written), trained)
        half = np.diag([0.5, 0.5, 0.5, 1.0])
        assert np.allclose(as_nerfstudio_trained(poses, half @ written), half @ trained)
        # Of COLMAP's world, which nerfstudio turns before.
        data = COLMAP_TO_Z_UP.T @ poses
        assert np.allclose(as_nerfstudio_trained(data, written @ COLMAP_TO_Z_UP), trained @ COLMAP_TO_Z_UP)
        found = [n for name, n in nerfstudio_normalizations(poses) if name.endswith("centre poses)")]
        assert any(np.allclose(n, trained) for n in found)
    assert sorted(set(turned)) == [False, True]
    upright = nerfstudio_normalization(poses, "up", "poses", True)
    assert np.array_equal(as_nerfstudio_trained(poses, upright), upright)


def test_what_nerfstudio_wrote_begins_with_the_world_before_applied_transform(tmp_path):
    """It writes the product with `applied_transform` and of the scales, and centres in the unit of transforms.json."""
    applied, applied_scale, scale = TURN.copy(), 4.0, 0.3
    applied[:3, 3] = 1.0, -2.0, 0.5
    normalization = nerfstudio_normalization(POSES, "up", "poses", False)
    file = {
        "applied_transform": applied[:3].tolist(),
        "applied_scale": applied_scale,
        "frames": [
            {"file_path": f"{i}.png", "transform_matrix": (pose @ GL).tolist(), "w": 64, "h": 48, "fl_x": 50.0}
            for i, pose in enumerate(POSES)
        ],
    }
    (tmp_path / "transforms.json").write_text(json.dumps(file))
    written = {"transform": (normalization @ applied)[:3].tolist(), "scale": scale * applied_scale}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(written))
    stated = read_training(tmp_path, Manifest()).file.stated
    expected = np.diag([scale, scale, scale, 1.0]) @ normalization
    assert stated[0].is_model_frame
    assert np.allclose(stated[0].file_from_cameras, expected)


def test_gsplats_principal_axes_may_have_any_signs():
    points = np.random.default_rng(0).normal(size=(500, 3)) * [3.0, 2.0, 1.0]
    by_cameras = gsplat_normalization(POSES, "focus", False)
    moved = points @ by_cameras[:3, :3].T + by_cameras[:3, 3]
    middle = np.median(moved, axis=0)
    axes = np.linalg.svd(moved - moved.mean(0))[2]
    axes[0] *= np.linalg.det(axes)
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = axes, -axes @ middle
    found = [n for name, n in gsplat_normalizations(POSES, points) if "(centre focus, principal axes" in name]
    for signs in SIGNS:
        assert any(np.allclose(n, signs @ turn @ by_cameras, atol=1e-6) for n in found)


def test_gsplats_normalization_does_what_its_documentation_says():
    """Up becomes -y, the median distance 1, and the axes pass the origin, in the median over each coordinate."""
    W = gsplat_normalization(TURN @ POSES, "focus", False)
    moved = np.array([moved_pose(Pose(TURN @ pose), W).world_from_camera for pose in POSES])
    up = -moved[:, :3, 1].mean(0)
    assert np.allclose(up / np.linalg.norm(up), [0, -1, 0])
    assert np.isclose(np.median(np.linalg.norm(moved[:, :3, 3], axis=1)), 1)
    assert np.isclose(np.linalg.det(W[:3, :3]) ** (1 / 3), np.median(np.linalg.norm(W[:3, :3], axis=0)))


def test_frames_survive_storage_and_are_told_with_a_pose():
    half = np.diag([0.5, 0.5, 0.5, 1.0])
    half[:3, 3] = 10.0, 0.0, 0.0
    frame = SceneFrame("cameras", half, "by hand", False)
    info = SceneInfo("s", "S", "0", "ply", frames=(frame,))
    (stored,) = decode(SceneInfo, encode(info)).frames
    assert np.array_equal(stored.frame_from_world, half)
    told = result_pose_out(Pose(POSES[0]), (stored,))
    assert told.position == POSES[0][:3, 3].tolist()
    assert told.frames[0].frame.name == "cameras"
    assert told.frames[0].position == (0.5 * POSES[0][:3, 3] + [10, 0, 0]).tolist()
    assert np.allclose(np.array(told.frames[0].world_from_camera.matrix)[:3, :3], POSES[0][:3, :3])


def test_points_of_a_colmap_model_are_read(tmp_path):
    """Laid out by COLMAP's description of the format."""
    text = "# a comment\n7 1.5 -2 3 255 0 0 0.1 1 2 3 4\n9 4 5 6 0 0 0 0.2\n"
    (tmp_path / "points3D.txt").write_text(text)
    assert np.array_equal(read_points(tmp_path), [[1.5, -2, 3], [4, 5, 6]])
    one = np.uint64(7).tobytes() + np.array([1.5, -2, 3]).tobytes() + b"rgb" + np.float64(0.1).tobytes()
    data = np.uint64(2).tobytes() + one + np.uint64(2).tobytes() + bytes(16) + one + np.uint64(0).tobytes()
    (tmp_path / "points3D.bin").write_bytes(data)
    assert np.array_equal(read_points(tmp_path), [[1.5, -2, 3], [1.5, -2, 3]])
    (tmp_path / "points3D.bin").write_bytes(data[:60])
    assert read_points(tmp_path) is None
