"""Data sets in their published layouts, written here as their authors' tools write them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_bench import OPENGL, poses, scene_ply

from service.bench import localize as bench
from service.bench.datasets import LAYOUTS, detect_layout, read_data_set
from service.errors import CorruptScene, SceneNotFound, UnknownName
from service.geometry import moved, quat_from_rotation
from service.photos.images import photo_size, read_query
from service.types import Pose

COUNT = 17
"""Photos: three are test photos where every eighth is."""
WRONG = np.array([0.3, -1.0, 0.5, 7.0, -8.0, 9.0])


def pictures(folder: Path, names: list[str], width: int, height: int, mode: str = "RGB") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.new(mode, (width, height), 0).save(folder / name)


def matrices(wrong: bool) -> list[np.ndarray]:
    """Poses of all photos; the test photos' may be wrong."""
    found = [moved(pose, WRONG) if wrong and i % 8 == 0 else pose for i, pose in enumerate(poses(COUNT))]
    return [pose.world_from_camera for pose in found]


def nerf_synthetic(folder: Path, wrong: bool = False) -> Path:
    """Blender's: camera_angle_x, './train/r_0' without suffix, OpenGL axes, cut-out photos."""
    all_poses = matrices(wrong)
    for part, chosen in (("train", [i for i in range(COUNT) if i % 8]), ("test", [0, 8, 16]), ("val", [1])):
        names = [f"r_{k}" for k in range(len(chosen))]
        pictures(folder / part, [f"{name}.png" for name in names], 40, 40, "RGBA")
        frames = [
            {"file_path": f"./{part}/{name}", "rotation": 0.01, "transform_matrix": (all_poses[i] @ OPENGL).tolist()}
            for name, i in zip(names, chosen, strict=True)
        ]
        file = {"camera_angle_x": 2 * np.arctan(0.5), "frames": frames}
        (folder / f"transforms_{part}.json").write_text(json.dumps(file))
    return folder


def llff(folder: Path, wrong: bool = False) -> Path:
    """poses_bounds.npy: [down, right, backwards, position, (height, width, focal)], near, far; of the full size."""
    rows = []
    for matrix in matrices(wrong):
        right, down, forwards, position = (matrix[:3, i] for i in range(4))
        block = np.stack([down, right, -forwards, position, [30.0, 40.0, 36.0]], 1)
        rows.append([*block.ravel(), 1.0, 9.0])
    pictures(folder / "images", [f"IMG_{4000 + i}.JPG" for i in range(COUNT)], 40, 30)
    pictures(folder / "images_2", [f"image{i:03d}.png" for i in range(COUNT)], 20, 15)
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def colmap(folder: Path, wrong: bool = False) -> Path:
    """A model in text, its images in no order."""
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "sparse" / "0" / "cameras.txt").write_text("# a comment\n1 PINHOLE 40 30 36 36 20 15\n")
    lines = []
    for i, matrix in list(enumerate(matrices(wrong)))[::-1]:
        inverse = Pose(matrix).camera_from_world
        quat = quat_from_rotation(inverse[:3, :3])
        lines += [f"{i + 1} {' '.join(map(str, [*quat, *inverse[:3, 3]]))} 1 DSC{i:04d}.JPG", ""]
    (folder / "sparse" / "0" / "images.txt").write_text("\n".join(lines) + "\n")
    pictures(folder / "images", [f"DSC{i:04d}.JPG" for i in range(COUNT)], 40, 30)
    return folder


def mipnerf360(folder: Path, wrong: bool = False) -> Path:
    colmap(folder, wrong)
    np.save(folder / "poses_bounds.npy", np.zeros((COUNT, 17)))
    pictures(folder / "images_2", [f"DSC{i:04d}.JPG" for i in range(COUNT)], 20, 15)
    return folder


def nerfstudio(folder: Path, wrong: bool = False) -> Path:
    pictures(folder / "images", [f"frame_{i:05d}.jpg" for i in range(COUNT)], 40, 30)
    frames = [
        {"file_path": f"images/frame_{i:05d}.jpg", "transform_matrix": (matrix @ OPENGL).tolist()}
        for i, matrix in enumerate(matrices(wrong))
    ]
    lens = {"w": 40, "h": 30, "fl_x": 36.0, "fl_y": 36.0, "cx": 20.0, "cy": 15.0}
    names = [frame["file_path"] for frame in frames]
    lists = {"train_filenames": [n for i, n in enumerate(names) if i % 8], "test_filenames": names[::8]}
    (folder / "transforms.json").write_text(json.dumps({**lens, **lists, "frames": frames}))
    return folder


WRITERS = {
    "nerf_synthetic": nerf_synthetic, "llff": llff, "mipnerf360": mipnerf360, "deep_blending": colmap,
    "nerfstudio": nerfstudio,
}  # fmt: skip


@pytest.mark.parametrize("layout", WRITERS)
def test_photos_truth_and_split(layout: str, tmp_path: Path) -> None:
    found = read_data_set(WRITERS[layout](tmp_path), layout)
    assert len(found.test) == 3
    assert found.training is not None
    assert len(found.training) == COUNT - 3
    for photo, truth in zip(found.test, poses(COUNT)[::8], strict=True):
        assert photo.path.is_file()
        assert np.allclose(photo.camera.pose.world_from_camera, truth.world_from_camera, atol=1e-9)
        size = photo_size(photo.path.read_bytes())
        lens = photo.camera.intrinsics
        assert (lens.width, lens.height) == size
        assert lens.fx == pytest.approx((40 if layout == "nerf_synthetic" else 36) * size[0] / 40)
    trained = [named.camera.pose.world_from_camera for named in found.training]
    assert np.allclose(trained, [p.world_from_camera for i, p in enumerate(poses(COUNT)) if i % 8], atol=1e-9)
    assert found.background_rgb == ((1.0, 1.0, 1.0) if layout == "nerf_synthetic" else None)


@pytest.mark.parametrize("layout", WRITERS)
def test_the_layout_is_seen(layout: str, tmp_path: Path) -> None:
    """nerfstudio's is our scene folder's as well."""
    assert detect_layout(WRITERS[layout](tmp_path)) == ("scene" if layout == "nerfstudio" else layout)


@pytest.mark.parametrize("layout", WRITERS)
def test_query_poses_never_reach_the_scene(layout: str, tmp_path: Path) -> None:
    """Wrong poses of the test photos change nothing in the scene that is localized in, nor in the units."""
    seen = []
    scene_ply(tmp_path / "scene.ply")
    for wrong in (False, True):
        (tmp_path / str(wrong)).mkdir()
        folder = WRITERS[layout](tmp_path / str(wrong), wrong)
        seen.append(bench.load_bench_scene(tmp_path / "scene.ply", folder, layout=layout))
    right, spoilt = seen
    assert right.loaded.scene.info.sha256 == spoilt.loaded.scene.info.sha256
    assert right.units.units_per_scene_unit == spoilt.units.units_per_scene_unit
    assert len(right.loaded.scene.cameras) == COUNT - 3
    first = [one.photos[0].camera.pose.position_in_world for one in seen]
    assert not np.allclose(*first)


@pytest.mark.parametrize(
    ("background", "expected"), [("scene", (1.0, 1.0, 1.0)), ("white", (1.0, 1.0, 1.0)), ("black", (0.0, 0.0, 0.0))]
)
def test_background(background: str, expected: tuple, tmp_path: Path) -> None:
    folder = nerf_synthetic(tmp_path)
    scene_ply(folder / "scene.ply")
    one = bench.load_bench_scene(folder, background=background)
    assert one.background_rgb == expected
    (trial,) = bench.make_trials(one, "none", 1, 0)
    query = read_query(trial.data, intrinsics=trial.intrinsics, background_rgb=one.background_rgb)
    assert np.all(query.rgb == np.array(expected) * 255)  # the pictures are transparent all over
    assert query.valid_mask is None  # that there is nothing is known


def test_photos_of_the_size_that_is_used_in_training(tmp_path: Path) -> None:
    """The smallest of at least 800 px; names may differ between the sizes."""
    llff(tmp_path)
    pictures(tmp_path / "images_4", [f"image{i:03d}.png" for i in range(COUNT)], 1000, 750)
    pictures(tmp_path / "images_1", [f"image{i:03d}.png" for i in range(COUNT)], 2000, 1500)
    photo = read_data_set(tmp_path).test[1]
    assert photo.path.relative_to(tmp_path) == Path("images_4/image008.png")
    assert photo.camera.intrinsics.fx == pytest.approx(900)


@pytest.mark.parametrize(("widths", "chosen"), [((800, 799), 800), ((799, 700), 799), ((2000, 801, 300), 801)])
def test_a_size_of_800_pixels_is_enough(widths: tuple[int, ...], chosen: int, tmp_path: Path) -> None:
    np.save(tmp_path / "poses_bounds.npy", np.load(llff(tmp_path / "other") / "poses_bounds.npy"))
    for width in widths:
        pictures(tmp_path / f"images_{width}", [f"{i:03d}.png" for i in range(COUNT)], width, width * 3 // 4)
    # More photos than poses, or none, belong to something else.
    pictures(tmp_path / "images_more", [f"{i:03d}.png" for i in range(COUNT + 1)], 810, 600)
    (tmp_path / "images_none").mkdir()
    photo = read_data_set(tmp_path).test[1]
    assert photo.path.parent.name == f"images_{chosen}"
    lens = photo.camera.intrinsics
    # The principal point is the image's middle.
    assert (lens.cx, lens.cy) == (pytest.approx(lens.width / 2), pytest.approx(lens.height / 2, abs=0.5))


@pytest.mark.parametrize("marker", ["truth.json", "scene.json"])
def test_a_scene_is_known_by_either_of_its_files(marker: str, tmp_path: Path) -> None:
    llff(tmp_path)
    (tmp_path / marker).write_text("{}")
    assert detect_layout(tmp_path) == "scene"


def test_nerfstudio_without_lists_trains_on_nine_tenths(tmp_path: Path) -> None:
    folder = nerfstudio(tmp_path)
    file = json.loads((folder / "transforms.json").read_text())
    del file["train_filenames"], file["test_filenames"]
    (folder / "transforms.json").write_text(json.dumps(file))
    found = read_data_set(folder, "nerfstudio")
    assert found.training is not None
    assert (len(found.test), len(found.training)) == (1, 16)


def test_truth_moves_with_the_scene(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "scene").mkdir()
    scene_ply(tmp_path / "scene" / "scene.ply")
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    (tmp_path / "scene" / "scene.json").write_text(json.dumps({"world_from_scene": matrix.tolist()}))
    one = bench.load_bench_scene(tmp_path / "scene", colmap(tmp_path / "data"), layout="deep_blending")
    assert np.allclose(one.photos[1].camera.pose.position_in_world, 2 * poses(COUNT)[8].position_in_world)
    assert np.allclose(one.training[0].pose.position_in_world, 2 * poses(COUNT)[1].position_in_world)


def test_what_is_no_data_set_is_reported(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match=f"unknown layout 'tum'; known: auto, {', '.join(LAYOUTS)}"):
        read_data_set(tmp_path, "tum")
    with pytest.raises(SceneNotFound, match="known: nerf_synthetic, llff"):
        read_data_set(tmp_path)
    with pytest.raises(SceneNotFound, match="no such folder"):
        read_data_set(tmp_path / "none")
    scene_ply(tmp_path / "scene.ply")
    with pytest.raises(SceneNotFound, match="has no photos"):
        bench.load_bench_scene(tmp_path / "scene.ply")
    (tmp_path / "poses_bounds.npy").write_bytes(b"no array")
    with pytest.raises(CorruptScene, match="not LLFF's poses"):
        read_data_set(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((4, 12)))
    with pytest.raises(CorruptScene, match=r"\(4, 12\)"):
        read_data_set(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((4, 17)))
    with pytest.raises(SceneNotFound, match="images folder with 4 photos"):
        read_data_set(tmp_path)
