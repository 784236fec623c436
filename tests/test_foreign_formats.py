"""Formats of other programs: files that they wrote (tests/data/formats/make.sh), checked against what was put in."""

import gzip
import json
import struct
import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard
from PIL import Image
from test_formats import GSPLY, columns, ply_bytes, written

from service.errors import CorruptScene, SceneError, UnsupportedFormat
from service.geometry import rotation_from_quat
from service.scene_formats import checkpoint, checkpoint_process, load_scene, unread

DATA = Path(__file__).parent / "data"
FILES = DATA / "formats"
PLY = DATA / "gsply_plain.ply"
GLB_FROM_PLY = np.diag([-1.0, -1.0, 1.0])
"""splat-transform turns a .ply half about z when it writes glTF."""


def covariances(scene, turn: np.ndarray | None = None) -> np.ndarray:
    turn = np.eye(3) if turn is None else turn
    axes = np.stack([rotation_from_quat(q.astype(np.float64)) for q in scene.quats]) * scene.scales[:, None, :]
    return turn @ axes @ axes.transpose(0, 2, 1) @ turn.T


def assert_same(name: str, *, means: float, shape: float, opacity: float, colour: float, rest: float | None) -> None:
    """Compare with the .ply that the file was made of; writers reorder Gaussians, so the nearest one is compared."""
    scene, source = load_scene(FILES / name), load_scene(PLY)
    turn = GLB_FROM_PLY if name.endswith(".glb") else np.eye(3)
    distances = np.linalg.norm(source.means[:, None] - (scene.means @ turn)[None], axis=2)
    match = distances.argmin(1)
    assert sorted(match) == list(range(source.count))
    assert distances.min(1).max() <= means
    expected, got = covariances(source), covariances(scene, turn)[match]
    assert (np.linalg.norm(got - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))).max() <= shape
    assert np.abs(scene.opacities[match] - source.opacities).max() <= opacity
    assert np.abs(scene.sh[match, 0] - source.sh[:, 0]).max() <= colour
    if rest is not None:
        assert scene.sh.shape == source.sh.shape
        assert np.abs(scene.sh[match, 1:] - source.sh[:, 1:]).max() <= rest


@pytest.mark.parametrize(
    ("name", "bounds"),
    [
        # Bounds: the formats' steps; seen are 0.0002, 0.064, 0.002, 0.0131, 0.0664 for SPZ.
        ("v3.spz", (1 / 4096, 0.07, 0.51 / 255, 0.51 / 255 / 0.15, 0.07)),
        ("v4.spz", (1 / 4096, 0.07, 0.51 / 255, 0.51 / 255 / 0.15, 0.07)),
        # Code books of 256 entries fitted to random values; SH are rows of a palette, tested below.
        ("v2.sog", (3e-4, 0.05, 1.01 / 255, 0.02, None)),
        ("level0.ksplat", (0, 1e-6, 1.01 / 255, 1.01 / 255 / 0.282, 1e-6)),
        ("level1.ksplat", (1e-4, 2e-3, 1.01 / 255, 1.01 / 255 / 0.282, 1e-3)),
        ("level2.ksplat", (1e-4, 2e-3, 1.01 / 255, 1.01 / 255 / 0.282, 0.0121)),
    ],
)
def test_other_programs_wrote_it(name, bounds):
    means, shape, opacity, colour, rest = bounds
    assert_same(name, means=means, shape=shape, opacity=opacity, colour=colour, rest=rest)


class TestGltf:
    def test_splat_transform_wrote_it(self):
        assert_same("plain.glb", means=0, shape=1e-6, opacity=1e-6, colour=0, rest=None)
        assert load_scene(FILES / "plain.glb").info.up_in_world == (0, 1, 0)

    def test_a_nodes_transform_moves_its_gaussians(self, tmp_path):
        tree, data = glb_parts((FILES / "plain.glb").read_bytes())
        tree["nodes"][0] |= {"translation": [1, 2, 3], "scale": [2, 2, 2]}
        moved = load_scene(written(tmp_path, glb(tree, data), "a.glb"))
        still = load_scene(FILES / "plain.glb")
        assert np.allclose(moved.means, 2 * still.means + [1, 2, 3], atol=1e-5)
        assert np.allclose(moved.scales, 2 * still.scales)

    def test_spz_inside(self, tmp_path):
        """glTF's axes are SPZ's own: nothing is turned."""
        packed = (FILES / "v4.spz").read_bytes()
        inner = {"extensions": {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}}
        tree = {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {}, "extensions": {"KHR_gaussian_splatting": inner}}]}],
            "buffers": [{"byteLength": len(packed)}],
            "bufferViews": [{"buffer": 0, "byteLength": len(packed)}],
        }
        scene = load_scene(written(tmp_path, glb(tree, packed), "a.glb"))
        own = load_scene(FILES / "v4.spz")
        assert np.array_equal(scene.means, own.means * [1, -1, -1])
        assert np.allclose(covariances(scene), covariances(own, np.diag([1.0, -1, -1])), atol=1e-6)

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            (lambda t: t["meshes"][0]["primitives"][0].pop("extensions"), "without Gaussians"),
            (lambda t: t["accessors"][0].update(count=10**7), "beyond"),
            (lambda t: t["accessors"][0].update(count=10**9), "limit"),
            (lambda t: t["bufferViews"][0].update(byteLength=10**9), "beyond the file"),
            (lambda t: t["nodes"][0].update(children=[0]), "10000 nodes"),
            (lambda t: t["nodes"][0].update(scale=[1, 2, 1]), "shears"),
            (lambda t: t["nodes"][0].update(scale=[-1, 1, 1]), "mirrors"),
            (lambda t: t["nodes"][0].update(rotation=[0, 0, 0, 1.0015]), "unit quaternion"),
            (lambda t: t["nodes"].clear(), "no nodes"),
        ],
    )
    def test_damage(self, tmp_path, change, says):
        tree, data = glb_parts((FILES / "plain.glb").read_bytes())
        change(tree)
        with pytest.raises(SceneError, match=says):
            load_scene(written(tmp_path, glb(tree, data), "a.glb"))


def glb_parts(data: bytes) -> tuple[dict, bytes]:
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def glb(tree: dict, data: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


class TestSpz:
    def test_version_2_by_hand(self, tmp_path):
        head = struct.pack("<4sIIBBBB", b"NGSP", 2, 1, 1, 12, 1, 0)
        position = (4096).to_bytes(3, "little") + (2**24 - 8192).to_bytes(3, "little") + bytes(3)
        # (1, -2, 0) in RUB; alpha 51/255; colours; scales exp(-10 + b/16); x = 1 of the quaternion; 9 SH of 128 + b.
        body = position + bytes([51, 255, 0, 128, 160, 176, 0]) + bytes([255, 128, 128])
        body += bytes([128 + 64, 128, 128, 128, 128 + 32, 128, 128, 128, 128 + 16])
        scene = load_scene(written(tmp_path, gzip.compress(head + body), "a.spz"))
        assert np.allclose(scene.means, [[1, 2, 0]])
        assert np.allclose(scene.scales, np.exp([[0, 1, -10]]))
        assert scene.opacities[0] == pytest.approx(0.2)
        assert np.allclose(scene.sh[0, 0], [0.5 / 0.15, -0.5 / 0.15, (128 / 255 - 0.5) / 0.15], atol=1e-5)
        # Half a turn about x: the functions of y and z change their signs. Each coefficient has red, green and blue.
        assert np.allclose(scene.sh[0, 1:], [[-0.5, 0, 0], [0, -0.25, 0], [0, 0, 0.125]], atol=1e-6)
        assert scene.info.render_mode == "antialiased"

    @pytest.mark.parametrize(
        ("make", "says"),
        [
            (lambda good: good[:40], "table names|damaged|truncated"),
            (lambda good: good[:8] + struct.pack("<I", 2**31) + good[12:], "limit is"),
            (lambda good: good[:4] + struct.pack("<I", 9) + good[8:], "version 9"),
            (lambda good: good[:12] + b"\x07" + good[13:], "degree 7"),
            (lambda good: gzip.compress(b"NGSP" + struct.pack("<IIBBBB", 3, 10, 0, 12, 0, 0)), "truncated"),
            (lambda good: gzip.compress(b"NGSP" + struct.pack("<IIBBBB", 3, 10, 0, 12, 0, 0) + bytes(10**7)), None),
            (lambda good: b"\x1f\x8b" + bytes(30), "damaged"),
        ],
    )
    def test_damage(self, tmp_path, make, says):
        file = written(tmp_path, make((FILES / "v4.spz").read_bytes()), "a.spz") / "a.spz"
        if says is None:  # more than the header tells is not even unpacked
            assert load_scene(file).count == 10
            return
        with pytest.raises(SceneError, match=says):
            load_scene(file)

    def test_a_zstd_bomb(self, tmp_path):
        count = 1000
        sections = [9, 1, 3, 3, 4]
        packed = [zstandard.compress(bytes(n * count if n > 1 else 10**8)) for n in sections]
        head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 0, 5, 32)
        toc = b"".join(struct.pack("<QQ", len(p), n * count) for p, n in zip(packed, sections, strict=True))
        assert load_scene(written(tmp_path, head + toc + b"".join(packed), "a.spz")).count == count


class TestSog:
    def test_palette_by_hand(self):
        with zipfile.ZipFile(FILES / "v2.sog") as bundle:
            meta = json.loads(bundle.read("meta.json"))["shN"]
            centroids, labels = (np.asarray(Image.open(BytesIO(bundle.read(name)))) for name in meta["files"])
        scene = load_scene(FILES / "v2.sog")
        flat = labels.reshape(-1, labels.shape[2])
        for i in (0, 17, 299):
            label = int(flat[i, 0]) + 256 * int(flat[i, 1])
            row, column = divmod(label, 64)
            for k in range(8):
                entry = centroids[row, 8 * column + k]
                assert scene.sh[i, 1 + k].tolist() == [np.float32(meta["codebook"][b]) for b in entry[:3]]

    def folder(self, tmp_path: Path) -> Path:
        with zipfile.ZipFile(FILES / "v2.sog") as bundle:
            bundle.extractall(tmp_path)
        return tmp_path

    def test_a_folder_is_the_same(self, tmp_path):
        scene, bundle = load_scene(self.folder(tmp_path)), load_scene(FILES / "v2.sog")
        assert np.array_equal(scene.means, bundle.means)
        assert np.array_equal(scene.sh, bundle.sh)
        sha = scene.info.sha256
        plane = tmp_path / "means_l.webp"
        pixels = np.array(Image.open(plane))
        pixels[0, 0, 0] ^= 1
        Image.fromarray(pixels).save(plane, lossless=True, exact=True)
        assert load_scene(tmp_path).info.sha256 != sha

    def test_version_1_by_hand(self, tmp_path):
        def plane(name: str, *pixel: int) -> str:
            Image.fromarray(np.array([[pixel]], np.uint8)).save(tmp_path / name, "webp", lossless=True, exact=True)
            return name

        meta = {
            "means": {"shape": [1, 3], "mins": [-1, -1, -2], "maxs": [1, 1, 2],
                      "files": [plane("l.webp", 255, 0, 255, 255), plane("u.webp", 255, 0, 127, 255)]},
            "scales": {"mins": [-5, -5, -5], "maxs": [0, 0, 0], "files": [plane("s.webp", 255, 0, 51, 255)]},
            "quats": {"files": [plane("q.webp", 255, 128, 128, 253)]},
            "sh0": {"mins": [-1, -1, -1, -4], "maxs": [1, 1, 1, 4], "files": [plane("c.webp", 255, 0, 51, 255)]},
        }  # fmt: skip
        (tmp_path / "meta.json").write_text(json.dumps(meta))
        scene = load_scene(tmp_path)
        z = -2 + 4 * (127 * 256 + 255) / 65535
        assert np.allclose(scene.means, [[np.expm1(1), -np.expm1(1), np.sign(z) * np.expm1(abs(z))]])
        assert np.allclose(scene.scales, np.exp([[0, -5, -4]]))
        assert np.allclose(scene.quats, [[np.sqrt(0.5), np.sqrt(0.5), 0, 0]], atol=0.01)
        assert scene.opacities[0] == pytest.approx(1 / (1 + np.exp(-4)))
        assert np.allclose(scene.sh[0, 0], [1, -1, -0.6])

    def test_damage(self, tmp_path):
        folder = self.folder(tmp_path)
        good = (folder / "meta.json").read_text()
        size = (8999 | 8999 << 14).to_bytes(4, "little")  # its header alone tells it
        (folder / "huge.webp").write_bytes(b"RIFF0000WEBPVP8L0000\x2f" + size + bytes(40))
        (folder / "outside.webp").symlink_to(FILES.parent / "rotated.heic")
        for old, new, says in [
            ('"means_l.webp"', '"../means_l.webp"', "not found beside it"),
            ('"means_l.webp"', '"outside.webp"', "link out of"),
            ('"means_l.webp"', '"huge.webp"', "9000 x 9000 pixels"),
            ('"version":2', '"version":3', "SOG version 3"),
            ('"count":300', '"count":30000', "pixels"),
            ('"count":300', '"count":1e99', "whole number"),
            ('"mins":[', '"mins":[1e9,', "must be 3"),
        ]:
            assert old in good
            (folder / "meta.json").write_text(good.replace(old, new))
            with pytest.raises(SceneError, match=says):
                load_scene(folder)


class TestKsplat:
    @pytest.mark.parametrize(
        ("at", "new", "says"),
        [
            (1, b"\0", "version 0.0"),
            (20, b"\x03\0", "level 3"),
            (4, struct.pack("<I", 2**31), "sections"),
            (16, struct.pack("<I", 299), "299 Gaussians"),
            (16, struct.pack("<I", 2**31), "limit"),
            (4096 + 4, struct.pack("<I", 2**31), "truncated"),
            (4096 + 40, b"\x09\0", "degree 9"),
        ],
    )
    def test_damage(self, tmp_path, at, new, says):
        data = bytearray((FILES / "level1.ksplat").read_bytes())
        data[at : at + len(new)] = new
        with pytest.raises(SceneError, match=says):
            load_scene(written(tmp_path, bytes(data), "a.ksplat"))


def tensors() -> dict[str, torch.Tensor]:
    return {name: torch.tensor(value) for name, value in GSPLY.items()}


def gsplat_checkpoint(path: Path, **other: object) -> Path:
    """As gsplat's simple_trainer.py saves it."""
    splats = tensors()
    splats["sh0"] = splats["sh0"][:, None]
    torch.save({"step": 6999, "splats": splats | other}, path)
    return path


@pytest.fixture
def in_this_process(monkeypatch):
    """Loads checkpoints here: starting PyTorch takes seconds."""
    load = lambda path, folder: checkpoint.checked_answer(checkpoint_process.extracted(path, folder, 10**6), path.name)  # noqa: E731
    monkeypatch.setattr(checkpoint, "_extracted", load)


class TestCheckpoint:
    def test_gsplat(self, tmp_path):
        scene, source = load_scene(gsplat_checkpoint(tmp_path / "ckpt_6999_rank0.pt")), load_scene(PLY)
        for name in ("means", "scales", "opacities", "quats", "sh"):
            assert np.allclose(getattr(scene, name), getattr(source, name), atol=1e-6)

    def test_nerfstudio(self, tmp_path, in_this_process):
        values = tensors()
        stored = {"sh0": "features_dc", "shN": "features_rest"}
        params = {f"_model.gauss_params.{stored.get(name, name)}": value for name, value in values.items()}
        params["_model.gauss_params.opacities"] = values["opacities"][:, None]
        (tmp_path / "nerfstudio_models").mkdir()
        for step in (9000, 29999):  # by number, not by name
            torch.save({"step": step, "pipeline": params}, tmp_path / f"nerfstudio_models/step-{step}.ckpt")
            params["_model.gauss_params.means"] = values["means"] + 1
        scene = load_scene(tmp_path)
        assert np.allclose(scene.means, GSPLY["means"] + 1)
        assert np.allclose(scene.sh[:, 1:], GSPLY["shN"])

    def test_parameters_as_they_were_trained(self, tmp_path, in_this_process):
        trained = {name: torch.nn.Parameter(value) for name, value in tensors().items()}
        scene = load_scene(gsplat_checkpoint(tmp_path / "a.pt", **trained | {"sh0": trained["sh0"][:, None]}))
        assert np.array_equal(scene.means, load_scene(gsplat_checkpoint(tmp_path / "b.pt")).means)

    @pytest.mark.parametrize(
        "change",
        [
            lambda means: means.to_sparse(),
            lambda means: means.to("meta"),
            lambda means: means.int(),
            lambda means: torch.quantize_per_tensor(means, 0.1, 0, torch.qint8),
        ],
    )
    @pytest.mark.filterwarnings("ignore")  # PyTorch's, of what is new or old in it
    def test_other_tensors_are_named(self, change, tmp_path, in_this_process):
        with pytest.raises(CorruptScene, match=r"'means' (is no plain tensor|has the shape)"):
            load_scene(gsplat_checkpoint(tmp_path / "a.pt", means=change(tensors()["means"])))

    def test_code_in_a_pickle_is_not_run(self, tmp_path, in_this_process):
        class Hostile:
            def __reduce__(self):
                return Path.touch, (tmp_path / "ran",)

        torch.save({"splats": Hostile()}, tmp_path / "a.pt")
        with pytest.raises(CorruptScene, match="can't be loaded"):
            load_scene(tmp_path / "a.pt")
        assert not (tmp_path / "ran").exists()

    @pytest.mark.parametrize("left", [0, 1, 40, -2])
    def test_a_pickle_that_ends_too_soon(self, left, tmp_path, in_this_process):
        whole = gsplat_checkpoint(tmp_path / "a.pt")
        with zipfile.ZipFile(whole) as opened:
            parts = {name: opened.read(name) for name in opened.namelist()}
        with zipfile.ZipFile(tmp_path / "b.pt", "w") as cut:
            for name, data in parts.items():
                cut.writestr(name, data[:left] if name.endswith("data.pkl") else data)
        with pytest.raises(CorruptScene, match=r"the checkpoint can't be loaded: [\w ]+\.$"):
            load_scene(tmp_path / "b.pt")

    def test_what_is_no_scene(self, tmp_path, in_this_process):
        torch.save({"pipeline": {"_model.field": torch.zeros(3)}}, tmp_path / "nerf.ckpt")
        with pytest.raises(UnsupportedFormat, match="another method"):
            load_scene(tmp_path / "nerf.ckpt")
        (tmp_path / "old.pt").write_bytes(b"\x80\x02\x8a")
        with pytest.raises(UnsupportedFormat, match="ns-export"):
            load_scene(tmp_path / "old.pt")
        assert checkpoint.UNPICKLES


class TestPlyVariants:
    def test_gz(self, tmp_path):
        for name in ("gsply_plain.ply", "gsply.compressed.ply"):
            file = tmp_path / f"{name}.gz"
            file.write_bytes(gzip.compress((DATA / name).read_bytes()))
            assert np.array_equal(load_scene(file).sh, load_scene(DATA / name).sh)
        (tmp_path / "bomb.ply.gz").write_bytes(gzip.compress(bytes(3_000_000)))
        with pytest.raises(CorruptScene, match="unpacks to more"):
            load_scene(tmp_path / "bomb.ply.gz")

    def test_text(self, tmp_path):
        table = columns()
        head, _ = ply_bytes(table).replace(b"binary_little_endian", b"ascii").split(b"end_header\n", 1)
        rows = "\n".join(" ".join(repr(float(column[i])) for column in table.values()) for i in range(20))
        text = load_scene(written(tmp_path / "a", head + b"end_header\n" + rows.encode()))
        binary = load_scene(written(tmp_path / "b", ply_bytes(table)))
        assert np.array_equal(text.means, binary.means)
        assert np.array_equal(text.sh, binary.sh)

    @pytest.mark.parametrize("faces", [0, 2])
    def test_faces_before_and_bytes_after(self, tmp_path, faces):
        head, body = ply_bytes(columns()).split(b"end_header\n", 1)
        element = b"element face %d\nproperty list uchar int vertex_indices\nelement vertex" % faces
        data = head.replace(b"element vertex", element) + b"end_header\n"
        data += faces * struct.pack("<B3i", 3, 0, 1, 2) + body + b"\n"
        assert np.array_equal(load_scene(written(tmp_path, data)).means, load_scene(written(tmp_path / "b")).means)

    def test_nerfstudio_colours(self, tmp_path):
        table = {n: v for n, v in columns().items() if n[:2] != "f_"}
        for channel, value in (("red", 255), ("green", 0), ("blue", 51)):
            table[channel] = np.full(20, value)
        scene = load_scene(written(tmp_path, ply_bytes(table, types=dict.fromkeys(("red", "green", "blue"), "uchar"))))
        assert np.allclose(0.5 + scene.sh[:, 0] / np.sqrt(4 * np.pi), [1, 0, 0.2], atol=1e-6)

    def test_degree_4_is_cut_and_said(self, tmp_path):
        table = columns(degree=4)
        scene = load_scene(written(tmp_path, ply_bytes(table)))
        assert scene.sh_degree == 3
        assert "degree 4" in scene.info.warnings[0]
        assert np.allclose(scene.sh[:, 3, 1], table["f_rest_26"])  # green's third: 24 coefficients a channel

    def test_the_3d_filter_is_fused(self, tmp_path):
        """As create_fused_ply.py: variances add, opacities shrink by the root of the determinants' ratio."""
        table = columns() | {"filter_3D": np.full(20, 0.5)}
        scene = load_scene(written(tmp_path, ply_bytes(table)))
        scales = np.exp(np.stack([table[f"scale_{i}"] for i in range(3)], 1))
        assert np.allclose(scene.scales, np.sqrt(scales**2 + 0.25), rtol=1e-5)
        ratio = np.sqrt((scales**2).prod(1) / (scales**2 + 0.25).prod(1))
        assert np.allclose(scene.opacities, ratio / (1 + np.exp(-table["opacity"])), rtol=1e-4)

    def test_features_are_passed_over(self, tmp_path):
        table = columns() | {f"semantic_{i}": np.zeros(20) for i in range(600)}
        assert load_scene(written(tmp_path, ply_bytes(table))).count == 20

    def test_integers_for_shapes_are_named(self, tmp_path):
        table = {n: np.zeros(20) for n in columns()}
        types = dict.fromkeys(("opacity", "scale_0", "scale_1", "scale_2"), "int")
        with pytest.raises(UnsupportedFormat, match="32-bit integers"):
            load_scene(written(tmp_path, ply_bytes(table, types=types)))

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            (lambda t: t.pop("scale_2"), "2DGS"),
            (lambda t: t.update({"f_offset_0": t["x"], "f_anchor_feat_0": t["x"]}), "Scaffold-GS"),
            (lambda t: t.update({"motion_0": t["x"]}), "4D"),
            (lambda t: [t.pop(n) for n in list(t) if n not in "xyz"], "point cloud"),
        ],
    )
    def test_other_methods_are_named(self, tmp_path, change, says):
        table = columns()
        change(table)
        with pytest.raises(UnsupportedFormat, match=says) as caught:
            load_scene(written(tmp_path, ply_bytes(table)))
        assert caught.value.hint


@pytest.mark.parametrize("name", [f"scene{s}" if s[0] == "." else s for s in unread.UNREAD_SUFFIXES])
def test_unread_formats_are_named_with_a_hint(tmp_path, name):
    with pytest.raises(UnsupportedFormat, match="is not supported") as caught:
        load_scene(written(tmp_path, b"\x1f\x8b", name))
    assert caught.value.hint


class TestTrainersFolders:
    def inria(self, folder: Path) -> Path:
        """As graphdeco-inria/gaussian-splatting leaves it."""
        for step in (7000, 30000):
            place = folder / f"point_cloud/iteration_{step}"
            place.mkdir(parents=True)
            (place / "point_cloud.ply").write_bytes(ply_bytes(columns(seed=step)))
        (folder / "cfg_args").write_text("Namespace(sh_degree=3, source_path='/x', white_background=True)")
        camera = {"id": 0, "img_name": "a", "width": 640, "height": 480, "fx": 500.0, "fy": 510.0}
        camera |= {"position": [1, 2, 3], "rotation": [[0, 0, 1], [1, 0, 0], [0, 1, 0]]}
        (folder / "cameras.json").write_text(json.dumps([camera]))
        points = {n: np.zeros(9) for n in ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")}
        (folder / "input.ply").write_bytes(ply_bytes(points, types=dict.fromkeys(("red", "green", "blue"), "uchar")))
        return folder

    def test_inria(self, tmp_path):
        scene = load_scene(self.inria(tmp_path))
        assert np.allclose(scene.means[:, 0], columns(seed=30000)["x"], rtol=1e-6)
        assert scene.info.background_rgb == (1, 1, 1)
        (camera,) = scene.cameras
        assert (camera.name, camera.camera.intrinsics.fx, camera.camera.intrinsics.cx) == ("a", 500, 320)
        assert camera.camera.pose.position_in_world.tolist() == [1, 2, 3]
        assert camera.camera.pose.axis_in_world.tolist() == [1, 0, 0]  # the third column

    @pytest.mark.parametrize(
        ("camera", "says"),
        [
            ({}, "img_name"),
            ({"img_name": "a"}, "rotation"),
            ({"img_name": "a", "rotation": np.eye(3).tolist()}, "position"),
        ],
    )
    def test_broken_cameras(self, tmp_path, camera, says):
        (self.inria(tmp_path) / "cameras.json").write_text(json.dumps([camera]))
        with pytest.raises(CorruptScene, match=says):
            load_scene(tmp_path)

    def test_multiset(self, tmp_path):
        """As its documentation shows the file; a quarter turn about z has the quaternion (0, 0, s, s), scalar last."""
        s = np.sqrt(0.5)
        poses = [
            {"ts": "1776075484.516121864", "T": [1, 2, 3], "R": [0, 0, s, s], "RGB": None},
            {"ts": "1776075485.016", "T": [4, 5, 6], "R": [1.4, 0, 0, 1.4], "RGB": None},
        ]
        folder = written(tmp_path, name="point_cloud.ply")
        (folder / "poses.json").write_text(json.dumps({"poses": poses}))
        scene = load_scene(folder)
        first, second = scene.cameras
        assert first.name == "1776075484.516121864"
        assert first.camera.pose.position_in_world.tolist() == [1, 2, 3]
        assert np.allclose(first.camera.pose.world_from_camera[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
        assert np.allclose(second.camera.pose.world_from_camera[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        assert scene.info.training_focal_px is None  # the lens is assumed: nothing is known of training
        assert scene.info.training_long_side_px is None

    @pytest.mark.parametrize(
        ("changed", "says"),
        [({"ts": None}, "'ts'"), ({"R": [0, 0, 0, 0]}, "R: must not be zero"), ({"T": [1, 2]}, "pose 0: T")],
    )
    def test_broken_poses(self, tmp_path, changed, says):
        folder = written(tmp_path, name="point_cloud.ply")
        pose = {"ts": "1", "T": [1, 2, 3], "R": [0, 0, 0, 1]} | changed
        (folder / "poses.json").write_text(json.dumps({"poses": [pose]}))
        with pytest.raises(CorruptScene, match=says):
            load_scene(folder)

    @pytest.mark.parametrize("text", ["[]", "{", '{"poses": {}}', '{"poses": [{"pose": 1}]}'])
    def test_poses_of_other_programs_are_left_alone(self, tmp_path, text):
        folder = written(tmp_path, name="point_cloud.ply")
        (folder / "poses.json").write_text(text)
        assert load_scene(folder).cameras == ()

    def test_point_clouds_and_hidden_files_are_no_scenes(self, tmp_path):
        folder = written(tmp_path, name="splat.ply")
        (folder / "sparse_pc.ply").write_bytes(ply_bytes({n: np.zeros(9) for n in "xyz"}))
        (folder / "._splat.ply").write_bytes(b"\0\5\26\7" + bytes(80))
        assert load_scene(folder).count == 20

    def test_a_scene_file_before_a_checkpoint(self, tmp_path):
        gsplat_checkpoint(tmp_path / "ckpt_1.pt")
        assert load_scene(written(tmp_path)).info.format == "ply"
