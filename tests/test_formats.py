"""Scene files and folders: read against other programs' files, moved, and every kind of damage."""

import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import reference_renderer as reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from test_images import COLMAP_PARAMETERS

from service.errors import CorruptScene, SceneError, SceneNotFound, UnsupportedFormat
from service.geometry import look_at, quat_from_rotation, se3_exp, so3_exp
from service.scene_formats import SCENE_FORMATS, load_scene
from service.scene_formats.manifest import Manifest
from service.scene_formats.training_files import read_training, same_photo
from service.types import Camera, GaussianScene, Intrinsics, Pose

DATA = Path(__file__).parent / "data"
GSPLY = np.load(DATA / "gsply_values.npz")
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
ALL_FORMATS = re.escape(f"known: {', '.join(SCENE_FORMATS.names())}.")


def columns(count=20, degree=1, seed=0) -> dict[str, np.ndarray]:
    """The properties of a 3DGS .ply, in Inria's order."""
    rng = np.random.default_rng(seed)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return {name: rng.normal(size=count) for name in names}


def ply_bytes(
    table: dict[str, np.ndarray],
    *,
    types: dict[str, str] | None = None,
    order="little",
    comments=(),
    count=None,
    end="\n",
) -> bytes:
    """A small independent writer: struct, one value at a time."""
    codes = {"float": "f", "double": "d", "uchar": "B", "int": "i"}
    types = types or {}
    rows = len(next(iter(table.values())))
    lines = ["ply", f"format binary_{order}_endian 1.0", *(f"comment {c}" for c in comments)]
    lines += [f"element vertex {rows if count is None else count}"]
    lines += [f"property {types.get(name, 'float')} {name}" for name in table] + ["end_header"]
    pack = struct.Struct(("<" if order == "little" else ">") + "".join(codes[types.get(n, "float")] for n in table))
    values = [
        pack.pack(*(int(c[i]) if types.get(n) in ("uchar", "int") else float(c[i]) for n, c in table.items()))
        for i in range(rows)
    ]
    return (end.join(lines) + end).encode() + b"".join(values)


def written(folder: Path, data: bytes | None = None, name="scene.ply", manifest: dict | None = None) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / name).write_bytes(ply_bytes(columns()) if data is None else data)
    if manifest:
        (folder / "scene.json").write_text(json.dumps(manifest))
    return folder


def assert_is(scene: GaussianScene, table: dict[str, np.ndarray], degree: int):
    """Compare with the table by the equations of the format, element by element."""
    stack = lambda *names: np.stack([table[n] for n in names], 1)  # noqa: E731
    assert np.allclose(scene.means, stack("x", "y", "z"), rtol=1e-6)
    assert np.allclose(scene.scales, np.exp(stack("scale_0", "scale_1", "scale_2")), rtol=1e-5)
    assert np.allclose(scene.opacities, 1 / (1 + np.exp(-table["opacity"])), rtol=1e-5)
    quats = stack("rot_0", "rot_1", "rot_2", "rot_3")
    assert np.allclose(scene.quats, quats / np.linalg.norm(quats, axis=1, keepdims=True), atol=1e-6)
    assert np.allclose(scene.sh[:, 0], stack("f_dc_0", "f_dc_1", "f_dc_2"), rtol=1e-6)
    per_channel = (degree + 1) ** 2 - 1
    for coefficient in range(per_channel):
        for channel in range(3):
            stored = table[f"f_rest_{channel * per_channel + coefficient}"]
            assert np.allclose(scene.sh[:, 1 + coefficient, channel], stored, rtol=1e-6)
    assert scene.sh_degree == degree


class TestPly:
    @pytest.mark.parametrize("degree", [0, 1, 2, 3])
    def test_degrees(self, tmp_path, degree):
        table = columns(degree=degree)
        assert_is(load_scene(written(tmp_path, ply_bytes(table))), table, degree)

    @pytest.mark.parametrize("order", ["little", "big"])
    @pytest.mark.parametrize("end", ["\n", "\r\n"])
    def test_any_order_of_properties_any_type_any_byte_order(self, tmp_path, order, end):
        table = columns()
        names = list(table)
        np.random.default_rng(1).shuffle(names)
        table = {n: table[n] for n in names if n[0] != "n"} | {"class": np.arange(20)}
        types = {"x": "double", "opacity": "double", "class": "uchar", "f_dc_0": "int"}
        table["f_dc_0"] = np.arange(20.0)
        data = ply_bytes(table, types=types, order=order, end=end)
        assert_is(load_scene(written(tmp_path, data)), table, 1)

    def test_gsply_wrote_it(self):
        scene = load_scene(DATA / "gsply_plain.ply")
        assert np.array_equal(scene.means, GSPLY["means"])
        assert np.allclose(scene.scales, np.exp(GSPLY["scales"]), rtol=1e-6)
        assert np.allclose(scene.opacities, 1 / (1 + np.exp(-GSPLY["opacities"])), rtol=1e-6)
        assert np.allclose(scene.quats, GSPLY["quats"], atol=1e-7)
        assert np.array_equal(scene.sh[:, 0], GSPLY["sh0"])
        assert np.array_equal(scene.sh[:, 1:], GSPLY["shN"])

    def test_read_only(self, tmp_path):
        scene = load_scene(written(tmp_path))
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert not getattr(scene, name).flags.writeable

    @pytest.mark.parametrize(
        ("comments", "mode"),
        [
            ([], "default"),
            (["SplatRenderMode: default"], "default"),
            (["SplatRenderMode: mip"], "antialiased"),
            (["Generated by x", "antialiased 1"], "antialiased"),
            (["antialiased 0"], "default"),
            (["antialiased 1", "SplatRenderMode: default"], "default"),
        ],
    )
    def test_render_mode_in_comments(self, tmp_path, comments, mode):
        scene = load_scene(written(tmp_path, ply_bytes(columns(), comments=comments)))
        assert scene.info.render_mode == mode

    def test_2dgs_is_refused_by_name(self, tmp_path):
        flat = {k: v for k, v in columns().items() if k != "scale_2"}
        for data in (ply_bytes(flat), ply_bytes(columns(), comments=["SplatRenderMode: 2dgs"])):
            with pytest.raises(UnsupportedFormat, match=r"(?i)2dgs"):
                load_scene(written(tmp_path, data))

    def test_opacity_of_infinite_logit_is_one(self, tmp_path):
        table = columns()
        table["opacity"][:2] = [np.inf, -np.inf]
        assert load_scene(written(tmp_path, ply_bytes(table))).opacities[:2].tolist() == [1.0, 0.0]


class TestCompressedPly:
    def test_gsply_wrote_it(self):
        """Errors are at most half a step of the quantization, between each chunk's bounds."""
        scene = load_scene(DATA / "gsply.compressed.ply")
        assert scene.info.format == "compressed_ply"
        assert np.abs(scene.means - GSPLY["means"]).max() < 0.51 * 6 / 1023
        assert np.abs(np.log(scene.scales) - GSPLY["scales"]).max() < 0.51 * 5 / 1023
        opacities = 1 / (1 + np.exp(-GSPLY["opacities"]))
        assert np.abs(scene.opacities - opacities).max() < 0.51 / 255
        assert np.abs(scene.sh[:, 0] - GSPLY["sh0"]).max() < 0.51 * 3 / 255
        assert np.abs(scene.sh[:, 1:] - GSPLY["shN"]).max() < 0.51 * 8 / 256
        angles = 2 * np.degrees(np.arccos(np.minimum(1, np.abs((scene.quats * GSPLY["quats"]).sum(1)))))
        assert angles.max() < 0.3  # seen: 0.153; a step of sqrt(2) / 1023 is 0.16 degrees

    def test_by_hand(self, tmp_path):
        """One Gaussian, packed bit by bit."""
        bounds = {"x": (0, 2047), "y": (0, 1023), "z": (-1, 1)}
        bounds |= {"scale_x": (-1, 1), "scale_y": (-3, -3), "scale_z": (0, 2)}
        names = [f"{e}_{p}{a}" for p in ("", "scale_") for e in ("min", "max") for a in "xyz"]
        header = "ply\nformat binary_little_endian 1.0\nelement chunk 1\n"
        header += "".join(f"property float {n}\n" for n in names)
        header += "element vertex 1\n" + "".join(
            f"property uint packed_{n}\n" for n in ("position", "rotation", "scale", "color")
        )
        floats = [bounds[n[4:]][n.startswith("max")] for n in names]
        position = 5 << 21 | 7 << 11 | 2047
        # The second component (x) is the largest; the others, w y z, are 0, +sqrt(1/2), 0 up to half a step.
        rotation = 1 << 30 | 512 << 20 | 1023 << 10 | 512
        scale = 2047 << 21 | 0 << 11 | 0
        color = 255 << 24 | 0 << 16 | 51 << 8 | 102
        data = header.encode() + b"end_header\n" + struct.pack("<12f", *floats)
        data += struct.pack("<4I", position, rotation, scale, color)
        scene = load_scene(written(tmp_path, data))
        assert np.allclose(scene.means, [[5, 7, 1]])
        assert np.allclose(scene.scales, np.exp([[1, -3, 0]]))
        assert np.allclose(np.abs(scene.quats), [[0, np.sqrt(0.5), np.sqrt(0.5), 0]], atol=2e-3)
        assert scene.opacities[0] == pytest.approx(0.4)
        assert np.allclose(0.5 + scene.sh[0, 0] / np.sqrt(4 * np.pi), [1, 0, 0.2], atol=1e-6)

    def test_damage(self, tmp_path):
        good = (DATA / "gsply.compressed.ply").read_bytes()
        for old, new, says in [
            (b"element chunk 2", b"element chunk 1", "chunks"),
            (b"element sh 300", b"element sh 299", "sh"),
            (b"uint packed_scale", b"float packed_scale", "uint"),
            (b"float max_scale_x", b"float something_", "max_scale_x"),
            (b"uchar f_rest_3\n", b"uchar g_rest_3\n", "f_rest"),
            (b"uchar f_rest_23\n", b"uchar f_rest_23\nproperty uchar f_rest_24\n", "9, 24 or 45"),
        ]:
            assert old in good
            with pytest.raises(CorruptScene, match=says):
                load_scene(written(tmp_path, good.replace(old, new)))
        with pytest.raises(CorruptScene, match="truncated"):
            load_scene(written(tmp_path, good[:-1]))


class TestSplat:
    def record(self, mean, scale, rgba, rotation) -> bytes:
        return struct.pack("<6f8B", *mean, *scale, *rgba, *rotation)

    def test_record(self, tmp_path):
        data = self.record((1, 2, 3), (0.1, 0.2, 0.3), (255, 0, 51, 102), (128, 255, 128, 128))
        data += self.record((-1, 0, 0), (1, 1, 1), (0, 0, 0, 255), (255, 128, 128, 128))
        scene = load_scene(written(tmp_path, data, "a.splat"))
        assert scene.info.format == "splat"
        assert np.allclose(scene.means, [[1, 2, 3], [-1, 0, 0]])
        assert np.allclose(scene.scales[0], [0.1, 0.2, 0.3])
        assert np.allclose(scene.quats, [[0, 1, 0, 0], [1, 0, 0, 0]])
        assert np.allclose(scene.opacities, [0.4, 1])
        assert np.allclose(0.5 + scene.sh[:, 0] / np.sqrt(4 * np.pi), [[1, 0, 0.2], [0, 0, 0]], atol=1e-6)

    def test_damage(self, tmp_path):
        good = self.record((1, 2, 3), (0.1, 0.2, 0.3), (255, 0, 51, 102), (128, 255, 128, 128))
        for data, says in [
            (b"", "empty"),
            (good[:-1], "whole number"),
            (good + good[:28] + bytes([128] * 4), "length zero or the like, the first is number 1"),
            (good + struct.pack("<f", np.nan) + good[4:], "non-finite means"),
            (good[:12] + struct.pack("<f", -1) + good[16:], "negative scales"),
        ]:
            with pytest.raises(CorruptScene, match=says):
                load_scene(written(tmp_path, data, "a.splat"))


class TestDamage:
    @pytest.mark.parametrize(
        ("name", "value", "says"),
        [
            ("x", np.nan, "2 of 20 Gaussians have non-finite means.* first is number 3"),
            ("f_rest_4", np.inf, "non-finite sh"),
            ("scale_1", 200.0, "non-finite scales"),  # exp overflows
            ("scale_1", 40.0, "scales beyond"),
            ("opacity", np.nan, "non-finite opacities"),
            ("rot_2", np.nan, "non-finite quats"),
            ("y", 1e12, "means beyond"),
        ],
    )
    def test_bad_values_are_counted_and_located(self, tmp_path, name, value, says):
        table = columns()
        table[name][[3, 11]] = value
        scene = load_scene(written(tmp_path, ply_bytes(table)))
        assert scene.count == 18
        assert re.search(says, scene.info.warnings[0])
        kept = np.delete(table["z"], [3, 11])
        assert np.allclose(scene.means[:, 2], kept, rtol=1e-6)
        table[name][:] = value
        with pytest.raises(CorruptScene, match="20 of 20"):
            load_scene(written(tmp_path, ply_bytes(table)))

    def test_zero_quaternions(self, tmp_path):
        table = columns()
        for i in range(4):
            table[f"rot_{i}"][7] = 0
        scene = load_scene(written(tmp_path, ply_bytes(table)))
        assert scene.count == 19
        assert "length zero or the like, the first is number 7" in scene.info.warnings[0]

    def test_a_double_too_large_for_float(self, tmp_path):
        table = columns()
        table["x"][2] = 1e300
        scene = load_scene(written(tmp_path, ply_bytes(table, types={"x": "double"})))
        assert (scene.count, "means beyond 1e+09 units" in scene.info.warnings[0]) == (19, True)

    @pytest.mark.parametrize(
        ("data", "error", "says"),
        [
            (b"", CorruptScene, "empty"),
            (b"ply\n", CorruptScene, "end_header"),
            (b"ply\nformat binary_little_endian 1.0\nend_header\n", UnsupportedFormat, "vertex"),
            (b"ply\nelement vertex 1\nend_header\n", CorruptScene, "format"),
            (b"ply\nformat binary_middle_endian 1.0\nend_header\n", CorruptScene, "middle"),
            (ply_bytes(columns()).replace(b"binary_little_endian", b"ascii"), CorruptScene, "numbers on each"),
            (ply_bytes(columns(), count=0), CorruptScene, "empty"),
            (ply_bytes(columns(), count=21), CorruptScene, "truncated: .* 21 .* after 20"),
            (ply_bytes(columns(), count=10**12), CorruptScene, "limit is 20000000"),
            (ply_bytes(columns(), count=10**30), CorruptScene, "NAME COUNT"),
            (ply_bytes(columns(), count=-5), CorruptScene, "NAME COUNT"),
            (ply_bytes(columns())[:-1], CorruptScene, "truncated"),
            (b"ply\n" + b"comment " + b"x" * 50_000_000, CorruptScene, "end_header"),
            (ply_bytes(columns()).replace(b"float x\n", b"list uchar int x\n"), UnsupportedFormat, "plain"),
            (ply_bytes(columns()).replace(b"float x\n", b"quad x\n"), CorruptScene, "quad"),
            (ply_bytes(columns()).replace(b"float y\n", b"float x\n"), CorruptScene, "different"),
            (ply_bytes(columns()).replace(b"float x\n", b"float\n"), CorruptScene, "out of place"),
            (ply_bytes(columns()).replace(b"opacity", b"opaque1"), UnsupportedFormat, "no opacity"),
            (ply_bytes({k: v for k, v in columns().items() if k != "f_rest_8"}), CorruptScene, "8 f_rest"),
            (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
             + b"".join(b"property float p%d\n" % i for i in range(5000)) + b"end_header\n", CorruptScene, "4096"),
            (b"solid something", UnsupportedFormat, ALL_FORMATS),
        ],
    )  # fmt: skip
    def test_hostile_headers(self, tmp_path, data, error, says):
        with pytest.raises(error, match=says):
            load_scene(written(tmp_path, data))

    @settings(max_examples=200)
    @given(st.data())
    def test_no_damage_raises_anything_else(self, tmp_path_factory, data):
        kind = data.draw(st.sampled_from(list(_WHOLE)))
        whole = bytearray(_WHOLE[kind])
        for _ in range(data.draw(st.integers(0, 4))):
            whole[data.draw(st.integers(0, min(len(whole), 2000) - 1))] = data.draw(st.integers(0, 255))
        file = tmp_path_factory.mktemp("damage") / kind
        file.write_bytes(bytes(whole[: data.draw(st.integers(0, len(whole)))]))
        try:
            scene = load_scene(file)
        except SceneError as error:
            assert error.where  # noqa: PT017 (both outcomes are right)
        else:
            assert np.isfinite(scene.means).all()


_WHOLE = {
    "scene.ply": ply_bytes(columns()),
    "scene.compressed.ply": (DATA / "gsply.compressed.ply").read_bytes(),
    **{
        file.name: file.read_bytes()
        for file in sorted((DATA / "formats").iterdir())
        if file.suffix not in (".sh", ".mjs")
    },
    "scene.splat": TestSplat().record((1, 2, 3), (0.1, 0.2, 0.3), (255, 0, 51, 102), (128, 255, 128, 128)) * 9,
}


class TestFolder:
    def test_bare_file_and_folder(self, tmp_path):
        folder = written(tmp_path / "my scene.v2")
        assert load_scene(folder).info.id == "my scene.v2"
        assert load_scene(folder / "scene.ply").info.id == "scene"

    def test_nothing_there(self, tmp_path):
        with pytest.raises(SceneNotFound, match="no such"):
            load_scene(tmp_path / "none")
        with pytest.raises(SceneNotFound, match="no scene file"):
            load_scene(tmp_path)

    def test_several_scene_files_need_a_name(self, tmp_path):
        folder = written(written(tmp_path), name="b.ply")
        with pytest.raises(CorruptScene, match=r"b\.ply, scene\.ply"):
            load_scene(folder)
        (folder / "scene.json").write_text('{"file": "b.ply"}')
        assert load_scene(folder).count == 20

    def test_built_in_formats_are_known(self):
        assert {"compressed_ply", "ply", "splat"} <= set(SCENE_FORMATS.names())

    def test_every_reader_has_the_contract(self):
        for name in SCENE_FORMATS.names():
            reader = SCENE_FORMATS.load(name)
            assert reader.accepts(b"", "") is False
            assert callable(reader.read)
            assert all(suffix.startswith(".") and suffix == suffix.lower() for suffix in reader.SUFFIXES)


ANCHOR = {"latitude": 47.0, "longitude": 8.0, "height": 400.0, "enu_from_world": np.eye(4).tolist()}


class TestManifest:
    def test_all_keys(self, tmp_path):
        manifest = {
            "name": "Room",
            "file": "room.ply",
            "convention": "opencv",
            "up": [0, 0, 2],
            "world_from_scene": np.eye(4).tolist(),
            "metres_per_unit": 0.5,
            "background": [0.1, 0.2, 0.3],
            "training_size": [1280, 720],
            "render_mode": "antialiased",
            "geo_anchor": ANCHOR,
        }
        info = load_scene(written(tmp_path, name="room.ply", manifest=manifest)).info
        assert (info.name, info.up_in_world, info.metres_per_unit) == ("Room", (0, 0, 1), 0.5)
        assert info.background_rgb == (0.1, 0.2, 0.3)
        assert (info.training_long_side_px, info.training_focal_px) == (1280, None)
        assert info.render_mode == "antialiased"
        assert info.geo_anchor is not None
        assert (info.geo_anchor.latitude_deg, info.geo_anchor.height_m) == (47.0, 400.0)

    @pytest.mark.parametrize(
        ("manifest", "error", "says"),
        [
            ({"metres_per_units": 1}, CorruptScene, "metres_per_units.*known: name, file"),
            ({"render_mode": "2dgs"}, UnsupportedFormat, "'2dgs' is not supported"),
            ({"render_mode": ["default"]}, UnsupportedFormat, "not supported"),
            ({"up": [0, 0, 0]}, CorruptScene, "up"),
            ({"up": "z"}, CorruptScene, "up"),
            ({"metres_per_unit": 0}, CorruptScene, "positive"),
            ({"background": [0, 0, 255]}, CorruptScene, "0..1"),
            ({"training_size": [640.5, 480]}, CorruptScene, "whole pixels"),
            ({"training_size": 640}, CorruptScene, "training_size"),
            ({"convention": "colmap"}, CorruptScene, "opengl or opencv"),
            ({"file": "../other.ply"}, CorruptScene, "in the folder"),
            ({"file": "none.ply"}, SceneNotFound, "none.ply"),
            ({"name": ""}, CorruptScene, "name"),
            ({"world_from_scene": np.diag([1, 1, -1, 1]).tolist()}, CorruptScene, "mirroring"),
            ({"world_from_scene": np.diag([1, 2, 1, 1]).tolist()}, CorruptScene, "shear"),
            ({"world_from_scene": np.diag([1, 1, 1, 2]).tolist()}, CorruptScene, "last row"),
            ({"geo_anchor": {"latitude": 1}}, CorruptScene, "exactly the keys"),
            ({"geo_anchor": ANCHOR | {"latitude": 91}}, CorruptScene, "geo_anchor.latitude"),
            ({"geo_anchor": ANCHOR | {"enu_from_world": np.diag([1, 2, 1, 1]).tolist()}}, CorruptScene, "shear"),
            ({"world_from_scene": [[1, 0], [0, 1]]}, CorruptScene, "4 x 4"),
        ],
    )
    def test_errors(self, tmp_path, manifest, error, says):
        with pytest.raises(error, match=says):
            load_scene(written(tmp_path, manifest=manifest))

    @pytest.mark.parametrize("text", ["{", "[]", "[" * 100_000, '{"up": [NaN, 0, 1]}', "\xff"])
    def test_broken_json(self, tmp_path, text):
        (written(tmp_path) / "scene.json").write_bytes(text.encode("latin-1"))
        with pytest.raises(CorruptScene):
            load_scene(tmp_path)


def frame(name: str, pose: Pose, **extra) -> dict:
    return {"file_path": name, "transform_matrix": (pose.world_from_camera @ OPENGL).tolist(), **extra}


def some_pose(seed: int) -> Pose:
    return Pose(se3_exp(np.random.default_rng(seed).normal(size=6)))


LENS = {"w": 640, "h": 480, "fl_x": 500.0, "fl_y": 510.0, "cx": 321.0, "cy": 238.0}


class TestTransforms:
    def test_nerfstudio(self, tmp_path):
        frames = [frame(f"./images/{i}.jpg", some_pose(i), **({"fl_x": 600} if i else {})) for i in range(3)]
        data = {**LENS, "frames": frames, "background": [1, 1, 1]}
        (written(tmp_path) / "transforms.json").write_text(json.dumps(data))
        scene = load_scene(tmp_path)
        assert [c.name for c in scene.cameras] == [f"images/{i}.jpg" for i in range(3)]
        assert scene.cameras[0].camera.intrinsics == Intrinsics(640, 480, 500.0, 510.0, 321.0, 238.0)
        for i, camera in enumerate(scene.cameras):
            pose = camera.camera.pose
            assert np.allclose(pose.world_from_camera, some_pose(i).world_from_camera, atol=1e-12)
        assert scene.info.background_rgb == (1, 1, 1)
        assert (scene.info.training_focal_px, scene.info.training_long_side_px) == (600, 640)

    def test_axes_by_hand(self, tmp_path):
        """OpenGL's camera looks along its -z: identity in the file looks down the world's z axis."""
        data = {**LENS, "frames": [{"file_path": "a", "transform_matrix": np.eye(4).tolist()}]}
        (written(tmp_path) / "transforms.json").write_text(json.dumps(data))
        assert np.allclose(load_scene(tmp_path).cameras[0].camera.pose.axis_in_world, [0, 0, -1])
        (tmp_path / "scene.json").write_text('{"convention": "opencv"}')
        assert np.allclose(load_scene(tmp_path).cameras[0].camera.pose.axis_in_world, [0, 0, 1])

    def test_blender(self, tmp_path):
        """camera_angle_x, no suffix, the size from the photo; the training file before the others."""
        folder = written(tmp_path)
        (folder / "train").mkdir()
        Image.new("RGB", (80, 60)).save(folder / "train" / "r_0.png")
        for split in ("train", "test", "val"):
            data = {"camera_angle_x": 0.6911112, "frames": [frame(f"./{split}/r_0", some_pose(0))]}
            (folder / f"transforms_{split}.json").write_text(json.dumps(data))
        (camera,) = load_scene(folder).cameras
        assert camera.name == "train/r_0"
        focal = 40 / np.tan(0.6911112 / 2)
        assert camera.camera.intrinsics == Intrinsics(80, 60, focal, focal, 40.0, 30.0)
        (folder / "train" / "r_0.png").unlink()
        with pytest.raises(CorruptScene, match="size of the photo is unknown"):
            load_scene(folder)
        (folder / "scene.json").write_text('{"training_size": [800, 800]}')
        assert load_scene(folder).cameras[0].camera.intrinsics.width == 800

    @pytest.mark.parametrize(
        ("lists", "expected"),
        [
            ({}, ["a", "b", "c"]),
            ({"train_filenames": ["./b.png"]}, ["b"]),
            ({"train_filenames": ["b.png"], "test_filenames": ["a.png"]}, ["b"]),
            ({"test_filenames": ["a.png"], "val_filenames": ["b.png"]}, ["c"]),
        ],
    )
    def test_only_training_photos_count(self, tmp_path, lists, expected):
        data = {**LENS, **lists, "frames": [frame(f"{n}.png", some_pose(0)) for n in "abc"]}
        (written(tmp_path) / "transforms.json").write_text(json.dumps(data))
        assert [Path(c.name).stem for c in load_scene(tmp_path).cameras] == expected

    def test_training_at_another_size_scales_the_focal_length(self, tmp_path):
        data = {**LENS, "frames": [frame("a.png", some_pose(0))]}
        (written(tmp_path, manifest={"training_size": [320, 240]}) / "transforms.json").write_text(json.dumps(data))
        info = load_scene(tmp_path).info
        assert (info.training_focal_px, info.training_long_side_px) == (250, 320)

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            ({"frames": 3}, "frames"),
            ({"frames": [7]}, "file_path"),
            ({"frames": [{"file_path": "a"}]}, "transform_matrix"),
            ({"frames": [frame("a", some_pose(0), fl_x=0)]}, "focal length"),
            ({"frames": [{"file_path": "a", "transform_matrix": (2 * np.eye(4)).tolist()}]}, "rotation"),
            ({"frames": [frame("a", some_pose(0), w="wide")]}, "w, h"),
            ({"train_filenames": "a"}, "list of file names"),
            ({"background": [1, 1]}, "background"),
        ],
    )
    def test_errors(self, tmp_path, change, says):
        data = {**LENS, "frames": [frame("a", some_pose(0))], **change}
        (written(tmp_path) / "transforms.json").write_text(json.dumps(data))
        with pytest.raises(CorruptScene, match=says):
            load_scene(tmp_path)


class TestWithoutPhotos:
    """A bench's queries are out before anything is read: whatever their frames say must not matter."""

    def transforms(self, folder: Path, wrong: object) -> Path:
        folder = written(folder)
        frames = [frame(f"images/{i:04}.jpg", some_pose(i)) for i in range(4)]
        frames[2]["transform_matrix"] = wrong
        (folder / "transforms.json").write_text(json.dumps({**LENS, "frames": frames}))
        return folder

    @pytest.mark.parametrize("name", ["images/0002.jpg", "0002.png", "./images/0002", "data/images/0002.jpg"])
    def test_wrong_poses_change_nothing(self, tmp_path, name):
        right = self.transforms(tmp_path / "a", frame("", some_pose(2))["transform_matrix"])
        wrong = self.transforms(tmp_path / "b", frame("", some_pose(99))["transform_matrix"])
        broken = self.transforms(tmp_path / "c", [["not", "a", "pose"]])
        scenes = [load_scene(folder, without_photos=[name]) for folder in (right, wrong, broken)]
        assert [Path(c.name).stem for c in scenes[0].cameras] == ["0000", "0001", "0003"]
        assert len({scene.info.sha256 for scene in scenes}) == 1
        assert load_scene(right).info.sha256 not in {scenes[0].info.sha256, load_scene(wrong).info.sha256}

    def test_colmap(self, tmp_path):
        folders = [colmap_folder(tmp_path / name, "txt", wrong) for name, wrong in (("a", 1), ("b", 1e9))]
        scenes = [load_scene(folder, without_photos=["photos/b.jpg"]) for folder in folders]
        assert [[c.name for c in scene.cameras] for scene in scenes] == [["a.jpg"], ["a.jpg"]]
        assert scenes[0].info.sha256 == scenes[1].info.sha256

    def test_no_cameras_at_all(self, tmp_path):
        folder = self.transforms(tmp_path, frame("", some_pose(2))["transform_matrix"])
        scene = load_scene(folder, cameras=False)
        assert scene.cameras == ()
        assert (scene.info.training_focal_px, scene.info.training_long_side_px) == (None, 640)

    def test_same_photo(self):
        assert same_photo("r_0.png", "train/r_0")
        assert not same_photo("test/r_0.png", "train/r_0.png")
        assert not same_photo("10.png", "0.png")
        assert same_photo("../images/1.jpg", "images\\1.png")
        for odd in ("", ".", "/", ".."):
            assert not same_photo(odd, "1.png")


def colmap_folder(folder: Path, kind: str, scale: float = 1.0) -> Path:
    """Two cameras, two photos; 'b.jpg' with points. `scale` spoils the quaternion of b.jpg."""
    sparse = written(folder) / "sparse" / "0"
    sparse.mkdir(parents=True)
    quats = {n: quat_from_rotation(so3_exp(np.array(v))) for n, v in (("b", [0.3, 0, 0]), ("a", [0, 2.0, 1]))}
    if scale != 1:
        quats["b"] = np.full(4, scale)
    poses = {"b": [*quats["b"], 1, 2, 3], "a": [*quats["a"], -4, 5, 6]}
    if kind == "txt":
        (sparse / "cameras.txt").write_text(
            "# header\n1 SIMPLE_RADIAL 800 600 700 400 300 0.1\n2 PINHOLE 640 480 500 510 320 240\n"
        )
        text = "# header\n" + "".join(
            f"{i} {' '.join(map(repr, map(float, poses[n])))} {i} {n}.jpg\n{points}\n"
            for i, n, points in ((1, "b", "1.5 2.5 -1 3 4 7"), (2, "a", ""))
        )
        (sparse / "images.txt").write_text(text)
        return folder
    (sparse / "cameras.bin").write_bytes(
        struct.pack("<QiiQQ4d", 2, 1, 2, 800, 600, 700, 400, 300, 0.1)
        + struct.pack("<iiQQ4d", 2, 1, 640, 480, 500, 510, 320, 240)
    )
    images = struct.pack("<Q", 2)
    for i, n, points in ((1, "b", 2), (2, "a", 0)):
        images += struct.pack("<i7di", i, *poses[n], i) + f"{n}.jpg".encode() + b"\0"
        images += struct.pack("<Q", points) + bytes(24 * points)
    (sparse / "images.bin").write_bytes(images)
    return folder


class TestColmap:
    def test_blank_lines_and_a_byte_order_mark(self, tmp_path):
        images = colmap_folder(tmp_path, "txt") / "sparse/0/images.txt"
        text = images.read_text()
        images.write_text("\n\n" + text.replace("\n2 ", "\n\n2 "), "utf-8-sig")
        assert [camera.name for camera in load_scene(tmp_path).cameras] == ["a.jpg", "b.jpg"]

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            (lambda text: text.replace("1.5 2.5 -1 3 4 7\n", ""), "no line of points"),
            (lambda text: text.replace("b.jpg", "K\u00fcche.jpg"), "Save it as UTF-8"),
        ],
    )
    def test_what_is_wrong_with_images_txt_is_told(self, tmp_path, change, says):
        images = colmap_folder(tmp_path, "txt") / "sparse/0/images.txt"
        images.write_text(change(images.read_text()), "latin-1")
        with pytest.raises(CorruptScene, match=says):
            load_scene(tmp_path)

    def test_unknown_camera_models_are_named(self, tmp_path):
        for number, says in ((17, "EQUIRECTANGULAR"), (99, "camera model 99")):
            folder = colmap_folder(tmp_path / str(number), "bin")
            (folder / "sparse/0/cameras.bin").write_bytes(struct.pack("<QiiQQ2d", 1, 1, number, 8, 6, 8, 6))
            with pytest.raises(CorruptScene, match=says):
                load_scene(folder)

    def test_a_model_elsewhere_is_not_read_silently(self, tmp_path):
        folder = colmap_folder(tmp_path, "txt")
        (folder / "sparse" / "0").rename(folder / "sparse" / "1")
        scene = load_scene(folder)
        assert scene.cameras == ()
        assert "'sparse/1'" in scene.info.warnings[0]

    @pytest.mark.parametrize("kind", ["txt", "bin"])
    def test_cameras(self, tmp_path, kind):
        a, b = load_scene(colmap_folder(tmp_path, kind)).cameras
        assert (a.name, b.name) == ("a.jpg", "b.jpg")
        assert a.camera.intrinsics == Intrinsics(640, 480, 500.0, 510.0, 320.0, 240.0)
        assert b.camera.intrinsics == Intrinsics(800, 600, 700.0, 700.0, 400.0, 300.0)
        expected = np.eye(4)
        expected[:3, :3], expected[:3, 3] = so3_exp(np.array([0.3, 0, 0])), [1, 2, 3]
        assert np.allclose(b.camera.pose.camera_from_world, expected)

    @pytest.mark.parametrize("kind", ["txt", "bin"])
    def test_every_model_of_colmap(self, tmp_path, kind):
        """One after the other in one file: a wrong number of parameters would spoil the next camera."""
        folder = colmap_folder(tmp_path, kind) / "sparse" / "0"
        cameras, images, known = b"", b"", []
        for number, (model, listed) in enumerate(COLMAP_PARAMETERS.items()):
            given = {"f": 700 + number, "fx": 710 + number, "fy": 720 + number, "cx": 390 + number, "cy": 290 + number}
            values = [given.get(name, 0.25) for name in listed.split(", ")]
            if kind == "txt":
                cameras += f"{number} {model} 800 600 {' '.join(map(str, values))}\n".encode()
                images += f"{number} 1 0 0 0 0 0 0 {number} {number:02}.jpg\n\n".encode()
            else:
                cameras += struct.pack(f"<iiQQ{len(values)}d", number, number, 800, 600, *values)
                images += struct.pack("<i7di", number, 1, *[0.0] * 6, number) + f"{number:02}.jpg\0".encode() + bytes(8)
            focals = ("f", "f") if listed.startswith("f,") else ("fx", "fy")
            known.append(Intrinsics(800, 600, *(float(given[name]) for name in (*focals, "cx", "cy"))))
        head = struct.pack("<Q", len(known)) if kind == "bin" else b""
        (folder / f"cameras.{kind}").write_bytes(head + cameras)
        (folder / f"images.{kind}").write_bytes(head + images)
        read = read_training(tmp_path, Manifest()).file.cameras
        assert [named.camera.intrinsics for named in read] == known

    def test_transforms_win(self, tmp_path):
        folder = colmap_folder(tmp_path, "bin")
        (folder / "transforms.json").write_text(json.dumps({**LENS, "frames": [frame("z", some_pose(0))]}))
        assert [c.name for c in load_scene(folder).cameras] == ["z"]

    @pytest.mark.parametrize("kind", ["txt", "bin"])
    def test_damage(self, tmp_path, kind):
        folder = colmap_folder(tmp_path, kind)
        images = folder / "sparse" / "0" / f"images.{kind}"
        whole = images.read_bytes()
        # Within the first photo's line: how long the lines are depends on the last digits of this machine's cosine.
        broken = [whole[:60], b"\xff" * 80]
        if kind == "bin":
            broken += [whole[:3], struct.pack("<Q", 2**60) + whole[8:], whole[:-1]]
            broken += [whole[:80].replace(b"b.jpg\0", b"b.jpgx") + b"x" * 50]
        for data in broken:
            images.write_bytes(data)
            with pytest.raises(CorruptScene):
                load_scene(folder)
        images.write_bytes(whole)
        (folder / "sparse" / "0" / f"cameras.{kind}").unlink()
        with pytest.raises(CorruptScene, match="missing"):
            load_scene(folder)


def rendered(scene: GaussianScene, camera: Camera, scale: float) -> tuple[np.ndarray, np.ndarray]:
    tensors = [torch.tensor(getattr(scene, n)).double() for n in ("means", "quats", "scales", "opacities", "sh")]
    i = camera.intrinsics
    picture = reference.render(
        *tensors, torch.tensor(camera.pose.camera_from_world), (i.fx, i.fy, i.cx, i.cy), i.width, i.height,
        0.3, torch.zeros(3, dtype=torch.float64),
    )  # fmt: skip
    return picture.rgb.numpy(), picture.depth.numpy() / scale


class TestWorldFromScene:
    def test_picture_stays_the_same(self, tmp_path):
        """Turned, shifted and scaled together, Gaussians and cameras give the same picture: means, rotations,
        scales, view-dependent colours and poses are all moved rightly."""
        table = columns(count=60, degree=3, seed=5)
        for axis in "xyz":
            table[axis] *= 0.5
        for i in range(3):
            table[f"scale_{i}"] = table[f"scale_{i}"] * 0.5 - 2
        data = ply_bytes(table)
        pose = look_at(np.array([0.3, -0.4, -3.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
        lens = {"w": 40, "h": 30, "fl_x": 40, "fl_y": 41, "cx": 20, "cy": 15}
        transforms = json.dumps({**lens, "frames": [frame("a", pose)]})
        world_from_scene = se3_exp(np.array([0.5, -1.2, 2.0, 3.0, -2.0, 1.0]))
        world_from_scene[:3, :3] *= 1.7
        plain = written(tmp_path / "plain", data)
        moved = written(tmp_path / "moved", data, manifest={"world_from_scene": world_from_scene.tolist()})
        pictures = []
        for folder, scale in ((plain, 1.0), (moved, 1.7)):
            (folder / "transforms.json").write_text(transforms)
            scene = load_scene(folder)
            pictures.append(rendered(scene, scene.cameras[0].camera, scale))
        assert pictures[0][0].std() > 0.1, "there must be something to see"
        # Seen: 6e-7, the rounding of the stored Gaussians to float32.
        assert np.abs(pictures[0][0] - pictures[1][0]).max() < 5e-6
        assert np.abs(pictures[0][1] - pictures[1][1]).max() < 5e-6

    def test_focal_length_stays(self, tmp_path):
        folder = written(tmp_path, manifest={"world_from_scene": np.diag([3.0, 3.0, 3.0, 1.0]).tolist()})
        (folder / "transforms.json").write_text(json.dumps({**LENS, "frames": [frame("a", some_pose(1))]}))
        scene = load_scene(folder)
        assert scene.info.training_focal_px == 500
        expected = 3 * some_pose(1).position_in_world
        assert np.allclose(scene.cameras[0].camera.pose.position_in_world, expected)


class TestDigest:
    def test_changes_with_everything_that_matters(self, tmp_path):
        seen = [load_scene(written(tmp_path)).info.sha256]
        (tmp_path / "scene.json").write_text('{"background": [1, 1, 1]}')
        seen.append(load_scene(tmp_path).info.sha256)
        (tmp_path / "transforms.json").write_text(json.dumps({**LENS, "frames": [frame("a", some_pose(0))]}))
        seen.append(load_scene(tmp_path).info.sha256)
        written(tmp_path, ply_bytes(columns(seed=1)))
        seen.append(load_scene(tmp_path).info.sha256)
        assert len(set(seen)) == 4
        assert load_scene(tmp_path).info.sha256 == seen[-1]

    def test_stays_when_the_folder_is_moved(self, tmp_path):
        folder = written(tmp_path / "a")
        before = load_scene(folder).info.sha256
        assert load_scene(folder.rename(tmp_path / "b")).info.sha256 == before
