"""A camera file in any frame: found by localizing the training photos, stored, and used from then on."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_camera_frames import GL, POSES, cameras_frame, planted
from test_camera_frames import room as room
from typer.testing import CliRunner

from service.cli.app import app
from service.errors import CorruptScene, StorageFailed
from service.geometry import se3_exp, so3_exp
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.scene_formats import load_scene
from service.scene_formats.similarity import moved_pose
from service.scene_formats.training_files import CAMERA_FRAME
from service.scene_manager import camera_frame
from service.scene_manager.camera_frame import FoundFrame, found_camera_frame, is_sought
from service.scene_manager.entry import Entry
from service.scene_manager.manager import Scenes
from service.types import NamedCamera, Pose

NEAR = 0.02
"""Of four units. The cameras are level and the room's Gaussians lie in rows: those of a column have one depth, and
which of them is in front, so where its colours seem to end, depends on the last digit of the pose."""
CAMERAS_FROM_SCENE = np.eye(4)
"""An editor of splats left the scene turned, shifted and 3.7 times smaller than its cameras' world."""
CAMERAS_FROM_SCENE[:3, :3] = 3.7 * so3_exp(np.array([0.4, -0.8, 0.5]))
CAMERAS_FROM_SCENE[:3, 3] = 2.0, -7.0, 1.5


def moved(matrix: np.ndarray) -> np.ndarray:
    return moved_pose(Pose(matrix @ GL), CAMERAS_FROM_SCENE).world_from_camera @ GL


@pytest.fixture
def edited(room: Path, tmp_path: Path) -> Path:
    return planted(room, tmp_path, moved)


@pytest.fixture
def bare(room: Path) -> LoadedScene:
    return LoadedScene.of(load_scene(room, cameras=False), rasterizer="cpu")


@pytest.fixture
def planted_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos are localized at the pose of their name, 2 mm and 0.05 deg off; every fifth one isn't."""
    rng = np.random.default_rng(0)

    def localized(named: NamedCamera, path: Path, loaded: LoadedScene) -> SimpleNamespace | None:
        number = int(path.stem)
        twist = np.concatenate([np.radians(0.05) * rng.normal(size=3), 0.002 * rng.normal(size=3)])
        pose = Pose(POSES[number] @ se3_exp(twist))
        world = loaded.scene.info.frames[0].frame_from_world  # file from world
        pose = moved_pose(pose, np.linalg.inv(world))
        return None if number % 5 == 4 else SimpleNamespace(pose=pose, verdict=SimpleNamespace(covariance=None))

    monkeypatch.setattr(camera_frame, "_localized", localized)


def require_planted(scene, folder: Path) -> None:
    """The cameras are where they were planted, and a training photo's pose comes out as its file has it."""
    frame = cameras_frame(scene)
    assert frame.verified
    assert "found by localizing their photos" in frame.decided_by
    own = [np.array(f["transform_matrix"]) for f in json.loads((folder / "transforms.json").read_text())["frames"]]
    for named, truth, matrix in zip(scene.cameras, POSES, own, strict=True):
        assert np.abs(named.camera.pose.position_in_world - truth[:3, 3]).max() < NEAR
        assert np.abs(named.camera.pose.world_from_camera[:3, :3] - truth[:3, :3]).max() < 0.004
        back = moved_pose(named.camera.pose, frame.frame_from_world).world_from_camera
        assert np.abs(back @ GL - matrix).max() < 1e-6


@pytest.mark.parametrize("axes", ["OpenGL's", pytest.param("OpenCV's", marks=pytest.mark.ci)])
@pytest.mark.usefixtures("planted_answers")
def test_the_similarity_is_found_by_photos(room: Path, bare: LoadedScene, tmp_path: Path, axes: str) -> None:
    # OpenCV's axes in a file that is read as OpenGL's: all positions agree, and no rotation does.
    folder = planted(room, tmp_path, moved if axes == "OpenGL's" else lambda m: moved(m) @ GL)
    scene = load_scene(folder)
    assert scene.cameras == ()
    assert "scenes align" in scene.info.warnings[0]
    assert is_sought(bare, folder)
    found = found_camera_frame(bare, folder)
    assert found
    assert found.agreeing >= 11
    assert (found.localized, found.tried) == (12, 14)
    assert 0.02 < found.median_deg < 0.2
    assert 0.001 < found.median_error / 3.7 < 0.008
    assert np.abs(found.file_from_cameras @ CAMERAS_FROM_SCENE - np.eye(4)).max() < NEAR
    found.write(folder)
    again = load_scene(folder)
    if axes == "OpenGL's":
        require_planted(again, folder)
    else:
        assert "camera axes of the other family" in cameras_frame(again).decided_by
        assert np.abs(again.cameras[5].camera.pose.position_in_world - POSES[5][:3, 3]).max() < NEAR
    assert again.info.sha256 != scene.info.sha256  # an index of the bare scene is not its own


@pytest.mark.ci
@pytest.mark.usefixtures("planted_answers")
def test_the_manifest_moves_the_world_of_the_answer(room: Path, edited: Path) -> None:
    world = np.diag([2.0, 2.0, 2.0, 1.0])
    world[:3, 3] = 1, 2, 3
    (edited / "scene.json").write_text(json.dumps({"world_from_scene": world.tolist()}))
    found = found_camera_frame(LoadedScene.of(load_scene(edited), rasterizer="cpu"), edited)
    assert found
    assert np.abs(found.file_from_cameras @ CAMERAS_FROM_SCENE - np.eye(4)).max() < NEAR


@pytest.mark.usefixtures("planted_answers")
def test_photos_of_other_cameras_tell_nothing(bare: LoadedScene, edited: Path) -> None:
    cameras = json.loads((edited / "transforms.json").read_text())
    order = np.random.default_rng(2).permutation(len(POSES))
    for frame, other in zip(cameras["frames"], [cameras["frames"][i]["file_path"] for i in order], strict=True):
        frame["file_path"] = other
    (edited / "transforms.json").write_text(json.dumps(cameras))
    assert found_camera_frame(bare, edited) is None


@pytest.mark.usefixtures("planted_answers")
def test_three_localized_photos_are_too_few(bare: LoadedScene, edited: Path) -> None:
    for path in (edited / "images").iterdir():
        if path.stem not in ("0", "1", "2", "4", "9"):  # of which two aren't localized
            path.unlink()
    assert is_sought(bare, edited)
    assert found_camera_frame(bare, edited) is None


@pytest.mark.usefixtures("planted_answers")
def test_a_third_of_wrong_answers_does_not_matter(
    bare: LoadedScene, edited: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = camera_frame._localized

    def sometimes_wrong(named: NamedCamera, path: Path, loaded: LoadedScene) -> SimpleNamespace | None:
        found = right(named, path, loaded)
        if found and int(path.stem) % 3 == 0:
            found.pose = Pose(POSES[(int(path.stem) + 7) % len(POSES)])
        return found

    monkeypatch.setattr(camera_frame, "_localized", sometimes_wrong)
    found = found_camera_frame(bare, edited)
    assert found
    assert 7 <= found.agreeing <= 9
    assert np.abs(found.file_from_cameras @ CAMERAS_FROM_SCENE - np.eye(4)).max() < NEAR


@pytest.mark.usefixtures("planted_answers")
def test_it_ends_between_two_photos(bare: LoadedScene, edited: Path) -> None:
    asked = []
    assert found_camera_frame(bare, edited, go_on=lambda: asked.append(1) or len(asked) < 3) is None
    assert len(asked) == 3


def test_nothing_is_sought_without_need_or_photos(room: Path, bare: LoadedScene, edited: Path) -> None:
    assert not is_sought(LoadedScene.of(load_scene(room), rasterizer="cpu"), room)  # its cameras fit
    for path in sorted((edited / "images").iterdir())[3:]:
        path.unlink()
    assert not is_sought(bare, edited)
    assert not is_sought(bare, edited / "scene.ply")


@pytest.mark.parametrize(
    "text", ['{"file_from_cameras": [[1]]}', "{}", '{"file_from_cameras": ' + str(np.diag([1, 2, 3, 1]).tolist()) + "}"]
)
def test_a_broken_file_is_named(edited: Path, text: str) -> None:
    (edited / CAMERA_FRAME).write_text(text)
    with pytest.raises(CorruptScene, match=CAMERA_FRAME):
        load_scene(edited)


def test_a_frame_of_another_scene_does_not_count(edited: Path) -> None:
    other = np.eye(4)
    other[:3, 3] = 5.0
    (edited / CAMERA_FRAME).write_text(json.dumps({"file_from_cameras": other.tolist()}))
    assert load_scene(edited).cameras == ()


@pytest.mark.ci
def test_a_service_finds_it_by_itself_and_loads_the_scene_again(edited: Path, tmp_path: Path) -> None:
    """The whole of it, with photos that are localized in the scene."""
    scenes = Scenes(DEFAULT_ESTIMATOR, tmp_path / "cache", rasterizer="cpu")
    entry = Entry("edited", edited, required=True)
    scenes.add(entry)
    scenes.start()
    try:
        until = time.monotonic() + 110
        while entry.loaded is None or entry.state != "ready":
            assert time.monotonic() < until
            time.sleep(0.02)
        held = scenes.acquire("edited")
        while not (edited / CAMERA_FRAME).is_file():
            assert time.monotonic() < until
            time.sleep(0.02)
        # Whoever uses the scene keeps it.
        assert entry.loaded is held.scenes[0]
        scenes.release(held.scenes)
        while entry.loaded is None or not entry.loaded.scene.cameras or entry.state != "ready":
            assert time.monotonic() < until
            time.sleep(0.02)
        require_planted(entry.loaded.scene, edited)
        assert not entry.is_outdated
    finally:
        scenes.close()


@pytest.mark.ci
@pytest.mark.usefixtures("planted_answers")
def test_the_command_stores_it_once(edited: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LoadedScene, "prepare", lambda self, estimator: None)  # nothing is localized
    said = CliRunner().invoke(app, ["scenes", "align", str(edited)])
    assert said.exit_code == 0, said.output
    assert "of 12 localized photos agree" in said.output
    require_planted(load_scene(edited), edited)
    again = CliRunner().invoke(app, ["scenes", "align", str(edited)])
    assert "nothing to do" in again.output
    bare = CliRunner().invoke(app, ["scenes", "align", str(edited / "scene.ply")])
    assert bare.exit_code != 0


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(StorageFailed, match="can't be written beside the scene"):
        FoundFrame(np.eye(4), 4, 4, 4, 0.1, 0.1).write(tmp_path / "gone")
