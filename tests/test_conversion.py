"""Scenes converted to .ply: read here by their headers with numpy, and compared with what was put into the source."""

import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from small_room import write_room
from test_formats import columns, ply_bytes, written

from service.errors import InvalidRequest, UnsupportedFormat
from service.scene_formats import scene_conversion
from service.scene_formats.scene_conversion import convert_scene

DATA = Path(__file__).parent / "data"
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def read(path: Path) -> tuple[np.ndarray, list[str]]:
    """Return the records of a binary .ply of one element, and its comments."""
    head, data = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    types = {"float": "<f4", "double": "<f8"}
    fields = [(line.split()[2], types[line.split()[1]]) for line in lines if line.startswith("property")]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    table = np.frombuffer(data, np.dtype(fields))
    assert len(table) == count
    return table, [line[8:] for line in lines if line.startswith("comment")]


@pytest.mark.parametrize("degree", [0, 3])
def test_a_ply_stays_what_it_was(tmp_path, degree):
    """20,000 Gaussians: more than one block is written."""
    table = {name: column.astype(np.float32) for name, column in columns(20_000, degree, seed=4).items()}
    table["opacity"][:3] = [-30, 12, 40]
    source = tmp_path / "a.ply"
    data = np.stack(list(table.values()), 1).astype("<f4").tobytes()
    head = ply_bytes({name: column[:1] for name, column in table.items()}, count=20_000, comments=["antialiased 1"])
    source.write_bytes(head.split(b"end_header\n")[0] + b"end_header\n" + data)
    found = convert_scene(source, tmp_path / "b.ply")
    assert (found.count, found.sh_degree, found.cameras, found.warnings) == (20_000, degree, 0, ())
    got, comments = read(tmp_path / "b.ply")
    assert list(got.dtype.names) == list(table)
    assert comments == ["SplatRenderMode: mip"]
    length = np.linalg.norm([table[f"rot_{i}"] for i in range(4)], axis=0)
    for name, column in table.items():
        if name.startswith("rot"):
            assert np.allclose(got[name], column / length, atol=1e-6)
        elif name.startswith("scale"):
            assert np.allclose(got[name], column, atol=1e-6)
        elif name == "opacity":
            assert np.allclose(1 / (1 + np.exp(-got[name])), 1 / (1 + np.exp(-column)), rtol=1e-6, atol=0)
            assert np.isfinite(got[name]).all()
        else:
            assert np.array_equal(got[name], 0 * column if name in ("nx", "ny", "nz") else column), name


def test_a_splat(tmp_path):
    data = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0, 255, 0, 51, 102, 128, 255, 128, 128)
    convert_scene(written(tmp_path / "a", data, "a.splat"), tmp_path / "b.ply")
    (got,), _ = read(tmp_path / "b.ply")
    assert [got[name] for name in ("x", "y", "z")] == [1, 2, 3]
    assert np.allclose([got["scale_0"], got["scale_1"]], np.log([0.1, 0.2]))
    assert -100 < got["scale_2"] < -80  # of length 0, whose logarithm isn't finite
    assert np.isclose(got["opacity"], np.log(0.4 / 0.6))
    assert np.allclose([got[f"rot_{i}"] for i in range(4)], [0, 1, 0, 0], atol=1e-6)
    assert np.allclose([0.5 + 0.28209479 * got[f"f_dc_{i}"] for i in range(3)], [1, 0, 0.2], atol=1e-6)


def test_an_spz_of_another_program(tmp_path):
    """Within the steps of its numbers it has what the .ply has that it was made of."""
    convert_scene(DATA / "formats" / "v4.spz", tmp_path / "b.ply")
    got, (expected, _) = read(tmp_path / "b.ply")[0], read(DATA / "gsply_plain.ply")
    means = [np.stack([table[axis] for axis in "xyz"], 1) for table in (expected, got)]
    match = np.linalg.norm(means[0][:, None] - means[1][None], axis=2).argmin(1)
    assert sorted(match) == list(range(len(expected)))
    for name in set(expected.dtype.names) - {f"rot_{i}" for i in range(4)} - {"nx", "ny", "nz"}:
        step = {"x": 1 / 4096, "y": 1 / 4096, "z": 1 / 4096}.get(name)
        step = step or (0.07 if name.startswith("f_rest") else 0.035 if name.startswith("scale") else 0.014)
        differ = got[name][match] - expected[name]
        if name == "opacity":
            differ = 1 / (1 + np.exp(-got[name][match])) - 1 / (1 + np.exp(-expected[name]))
        assert np.abs(differ).max() <= step, name


def test_positions_far_from_the_origin_stay_doubles(tmp_path):
    table = columns()
    table["x"] += 448_312.256789
    convert_scene(written(tmp_path / "a", ply_bytes(table, types={"x": "double"})), tmp_path / "b.ply")
    got, _ = read(tmp_path / "b.ply")
    assert np.array_equal(got["x"], table["x"])


def test_a_folder_has_what_the_file_does_not(tmp_path):
    source = write_room(tmp_path / "a", cameras=6)
    turned = [[0, 0, 2, 1], [2, 0, 0, 2], [0, 2, 0, 3], [0, 0, 0, 1]]
    given = {
        "name": "Room",
        "world_from_scene": turned,
        "up": [1, 0, 0],
        "metres_per_unit": 0.5,
        "background": [1, 1, 1],
    }
    (source / "scene.json").write_text(json.dumps({**given, "file": "scene.ply", "convention": "opencv"}))
    cameras = json.loads((source / "transforms.json").read_text())
    opencv = [
        {**frame, "transform_matrix": (np.array(frame["transform_matrix"]) @ OPENGL).tolist()}
        for frame in cameras["frames"]
    ]
    (source / "transforms.json").write_text(json.dumps({**cameras, "frames": opencv}))
    target = tmp_path / "b"
    assert convert_scene(source, target).cameras == 6
    assert json.loads((target / "scene.json").read_text()) == {**given, "render_mode": "default"}
    got, put = read(target / "scene.ply")[0], read(source / "scene.ply")[0]
    assert all(np.array_equal(got[axis], put[axis]) for axis in "xyz")
    frames = json.loads((target / "transforms.json").read_text())["frames"]
    for frame, original in zip(frames, cameras["frames"], strict=True):
        assert (frame["file_path"], frame["w"], frame["fl_x"]) == (original["file_path"], cameras["w"], cameras["fl_x"])
        assert np.allclose(frame["transform_matrix"], original["transform_matrix"], atol=1e-9)


def test_nothing_is_overwritten_and_nothing_is_left(tmp_path, monkeypatch):
    source = written(tmp_path / "a")
    there = tmp_path / "there.ply"
    there.write_text("mine")
    for target, says in [
        (there, "is there already"),
        (tmp_path, "is there already"),
        (tmp_path / "none" / "b.ply", "doesn't exist"),
        (tmp_path / "b.spz", "only plain .ply"),
        (tmp_path / "b.compressed.ply", "only plain .ply"),
    ]:
        with pytest.raises(InvalidRequest, match=says):
            convert_scene(source, target)
    assert there.read_text() == "mine"

    def full(raw, path):
        path.write_text("half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(scene_conversion, "write_ply", full)
    for target in (tmp_path / "b.ply", tmp_path / "b"):
        with pytest.raises(InvalidRequest, match="No space left"):
            convert_scene(source, target)
        assert not target.exists()
    shutil.copy(there, source / "scene.ply")
    with pytest.raises(UnsupportedFormat):
        convert_scene(source, tmp_path / "b")
    assert not (tmp_path / "b").exists()
