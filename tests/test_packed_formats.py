"""Packed scene formats by hand: each version, level and degree bit by bit, and where files end."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from service.errors import CorruptScene, SceneError, UnsupportedFormat
from service.scene_formats import compressed_ply, gltf, ksplat, sog, spz
from service.types import SH_C0

COEFFICIENTS = [(degree + 1) ** 2 - 1 for degree in range(5)]

# ------------------------------------------------------------------ SPZ


def spz_body(version: int, degree: int, count: int = 2, harmonic: int = 128) -> dict[str, bytes]:
    """At x = 1, 2, ...; the identity; the other numbers are zero, or one in the middle of their range."""
    positions = b""
    for number in range(1, count + 1):
        one = np.float16(number).tobytes() if version == 1 else (number << 12).to_bytes(3, "little")
        positions += one + bytes(2 * len(one))
    rotation = bytes([128, 127, 128]) if version < 3 else struct.pack("<I", 3 << 30)
    return {
        "positions": positions, "alphas": bytes([255, 51] * count)[:count], "colours": bytes([255, 0, 128]) * count,
        "scales": bytes([160, 176, 144]) * count, "rotations": rotation * count,
        "sh": bytes([harmonic]) * (3 * COEFFICIENTS[min(degree, 4)] * count),
    }  # fmt: skip


def spz_file(
    version: int, degree: int, *, bits: int = 12, flags: int = 0, count: int = 2, cut: int = 0, **kw: Any
) -> bytes:
    head = struct.pack("<4sIIBBB", b"NGSP", version, count, degree, bits, flags)
    parts = [part for part in spz_body(version, degree, count, **kw).values() if part]
    if version < 4:
        whole = head + b"\0" + b"".join(parts)
        return gzip.compress(whole[: len(whole) - cut])
    packed = [zstandard.compress(part) for part in parts]
    toc = b"".join(struct.pack("<QQ", len(p), len(part)) for p, part in zip(packed, parts, strict=True))
    whole = head + struct.pack("<BI12x", len(parts), 32) + toc + b"".join(packed)
    return whole[: len(whole) - cut]


@pytest.mark.parametrize("version", [1, 2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_spz_of_every_version_and_degree(version, degree):
    found = spz.decoded(spz_file(version, degree, harmonic=128 + 32), "x")
    assert found.means.tolist() == [[1, 0, 0], [2, 0, 0]]
    assert found.quats == pytest.approx(np.float32([[1, 0, 0, 0]] * 2), abs=0.006)
    assert found.scales == pytest.approx(np.exp(np.float32([[0, 1, -1]] * 2)))
    assert found.opacities == pytest.approx([1.0, 0.2])
    assert found.sh[0, 0] == pytest.approx([0.5 / 0.15, -0.5 / 0.15, (128 / 255 - 0.5) / 0.15], abs=1e-5)
    assert found.sh.shape == (2, 1 + min(COEFFICIENTS[degree], 15), 3)
    assert (found.sh[:, 1:] == 0.25).all()
    assert len(found.warnings) == (degree == 4)
    assert found.render_mode is None


def test_spz_positions_have_signs_and_fractions():
    header = spz._Header(2, 1, 0, 8, 0)
    numbers = (2**24 - 256, 128, 2**23 - 256)
    data = np.frombuffer(b"".join(number.to_bytes(3, "little") for number in numbers), np.uint8)
    assert spz._positions(header, data.reshape(1, 9)).tolist() == [[-1.0, 0.5, (2**23 - 256) / 256]]


def test_spz_quaternions_leave_out_the_largest():
    """(x, y, z, w) = (0.1, -0.7, 0.3, w): y is the largest, and is made positive."""
    x, z, w = -0.1, -0.3, -0.5
    y = np.sqrt(1 - x * x - z * z - w * w)
    packed = 1 << 30
    for shift, value in ((20, x), (10, z), (0, w)):
        packed |= (int(value < 0) << 9 | round(abs(value) * 511 / np.sqrt(0.5))) << shift
    found = spz._smallest_three(np.frombuffer(struct.pack("<I", packed), np.uint8).reshape(1, 4))
    assert found == pytest.approx(np.float32([[w, x, y, z]]), abs=2e-3)
    old = spz._first_three(np.uint8([[255, 0, 128]]))
    assert old[0, 1:] == pytest.approx([1, -1, 1 / 255], abs=1e-6)
    assert old[0, 0] == 0


@pytest.mark.parametrize(("bits", "flags", "mode"), [(24, 1, "antialiased"), (0, 2, None), (12, 3, "antialiased")])
def test_spz_has_flags_and_up_to_24_fractional_bits(bits, flags, mode):
    found = spz.decoded(spz_file(2, 0, bits=bits, flags=flags), "x")
    assert found.means[0, 0] == 4096 / 2**bits
    assert found.render_mode == mode


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: spz_file(2, 0, bits=25), "25 fractional bits"),
        (lambda: spz_file(3, 1, cut=1), "truncated: 57 of 58 bytes"),
        (lambda: spz_file(4, 1, cut=1), "needed|truncated|damaged"),
        (lambda: spz_file(4, 0)[:31], "header of 32 bytes"),
        (lambda: spz_file(4, 0)[:15], "doesn't begin"),
        (lambda: b"NGS" + bytes(40), "doesn't"),
        (lambda: struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 1, 5, 12, 0, 6, 32), "SH degree 5"),
        (lambda: spz_file(4, 0)[:15] + b"\4" + spz_file(4, 0)[16:], "names 4 streams"),
        (lambda: gzip.compress(spz_file(4, 0)), "version 4 in this container; known: 1, 2, 3"),
        (lambda: gzip.decompress(spz_file(3, 0)) + bytes(32), "version 3 in this container; known: 4"),
    ],
)  # fmt: skip
def test_spz_that_ends_too_soon_or_says_too_much_is_refused(make, says):
    with pytest.raises(SceneError, match=says):
        spz.decoded(make(), "x")


# ------------------------------------------------------------------ KSPLAT


def ksplat_file(
    level: int, degree: int, count: int = 3, *, capacity: int | None = None, buckets: tuple[int, ...] = (2, 1),
    full: int = 0, bounds: tuple[float, float] = (0.0, 0.0), major: int = 0, minor: int = 1, total: int | None = None,
) -> bytes:  # fmt: skip
    """One section; in levels 1 and 2 means are steps of 2/32767 half blocks about their bucket's centre."""
    capacity = capacity or count
    record = ksplat._record(level, degree)
    rows = np.zeros(capacity, record)
    rows["scale"], rows["quat"], rows["rgba"] = (1, 2, 4), (1, 0, 0, 0), (255, 0, 0, 51)
    rows["mean"] = np.arange(3) if level == 0 else 32_767 + 16_384 * np.arange(3) - 16_384
    rows["sh"] = np.arange(3 * COEFFICIENTS[degree]) if level < 2 else 255
    partial = () if level == 0 else buckets[full:]
    centres = b"" if level == 0 else np.float32([[10 * i, 0, 0] for i in range(len(buckets))]).tobytes()
    block = 0.0 if level == 0 else 4.0
    section = struct.pack(
        "<IIIIfH2xI4xIIH", count, capacity, 2, len(buckets) if level else 0, block, 12, 0,
        full, len(partial), degree,
    )  # fmt: skip
    head = bytearray(4096)
    struct.pack_into("<BBxxI8xIH", head, 0, major, minor, 1, count if total is None else total, level)
    struct.pack_into("<2f", head, 36, *bounds)
    sizes = struct.pack(f"<{len(partial)}I", *partial)
    return bytes(head) + section.ljust(1024, b"\0") + sizes + centres + rows.tobytes()


def read_ksplat(tmp_path: Path, data: bytes) -> Any:
    path = tmp_path / "a.ksplat"
    path.write_bytes(data)
    return ksplat.read(path)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(("level", "bytes_of"), [(0, 44), (1, 24), (2, 24)])
def test_ksplat_of_every_level_and_degree(tmp_path, level, bytes_of, degree):
    harmonics = 3 * COEFFICIENTS[degree]
    assert ksplat._record(level, degree).itemsize == bytes_of + harmonics * (4, 2, 1)[level]
    found = read_ksplat(tmp_path, ksplat_file(level, degree))
    if level == 0:
        assert found.means.tolist() == [[0, 1, 2]] * 3
    else:
        # Half a step of 2 units either way, about centres at 0, 0 and 10.
        step = 16_384 / 32_767 * 2
        assert found.means == pytest.approx(np.float32([[-step, 0, step]] * 2 + [[10 - step, 0, step]]))
    assert found.scales.tolist() == [[1, 2, 4]] * 3
    assert found.quats.tolist() == [[1, 0, 0, 0]] * 3
    assert found.opacities == pytest.approx([0.2] * 3)
    assert found.sh[0, 0] == pytest.approx(np.array([0.5, -0.5, -0.5]) / SH_C0)
    if level == 2:
        assert (found.sh[:, 1:] == 1.5).all()  # the default range is -1.5 to 1.5
    elif degree:
        # Band by band, in each red, then green, then blue.
        assert found.sh[0, 1:4].tolist() == [[0, 3, 6], [1, 4, 7], [2, 5, 8]]
        if degree > 1:
            assert found.sh[0, 4].tolist() == [9, 14, 19]
        if degree > 2:
            assert found.sh[0, 9].tolist() == [24, 31, 38]
    assert found.sh.shape[1] == 1 + COEFFICIENTS[degree]


def test_ksplat_buckets_are_full_ones_then_others_and_room_is_passed_over(tmp_path):
    found = read_ksplat(tmp_path, ksplat_file(1, 0, 5, capacity=9, buckets=(2, 2, 1), full=2))
    step = 16_384 / 32_767 * 2
    assert found.means[:, 0] + step == pytest.approx([0, 0, 10, 10, 20])
    found = read_ksplat(tmp_path, ksplat_file(2, 1, bounds=(-2.0, 3.0)))
    assert (found.sh[:, 1:] == 3.0).all()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ksplat_file(0, 0, minor=0), "version 0.0"),
        (lambda: ksplat_file(0, 0, major=1), "version 1.1"),
        (lambda: ksplat_file(0, 0)[:4095], "the header has 4096"),
        (lambda: ksplat_file(0, 0)[:-1], "truncated: section 0"),
        (lambda: ksplat_file(0, 0)[:5000], "1 sections in 5000 bytes"),
        (lambda: ksplat_file(0, 0, 3, capacity=2), "truncated"),
        (lambda: ksplat_file(0, 0, total=4), "don't hold the 4"),
        (lambda: ksplat_file(1, 0, buckets=(2, 2)), "don't hold its 3"),
        (lambda: ksplat_file(1, 0, buckets=(2,)), "don't hold its 3"),
        (lambda: ksplat_file(0, 0, total=0), "empty"),
    ],
)  # fmt: skip
def test_ksplat_that_contradicts_itself_is_refused(tmp_path, make, says):
    with pytest.raises(SceneError, match=says):
        read_ksplat(tmp_path, make())
    level = bytearray(ksplat_file(0, 0))
    struct.pack_into("<H", level, 20, 3)
    with pytest.raises(UnsupportedFormat, match="compression level 3"):
        read_ksplat(tmp_path, bytes(level))


# ------------------------------------------------------------------ compressed PLY


def compressed(
    count: int, *, chunks: int | None = None, colours: bool = True, rest: int = 0, harmonics: int | None = None,
    kind: str = "uint", position: int = 0, rotation: int = 0, colour: int = 0, byte: int = 0, drop: str = "",
) -> bytes:  # fmt: skip
    chunks = -(-count // 256) if chunks is None else chunks
    bounds = [f"{end}_{part}{axis}" for part in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    bounds += [f"{end}_{c}" for end in ("min", "max") for c in "rgb"] if colours else []
    bounds = [name for name in bounds if name != drop]
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in bounds]
    lines += [f"element vertex {count}"]
    lines += [
        f"property {kind} packed_{name}"
        for name in ("position", "rotation", "scale", "color")
        if f"packed_{name}" != drop
    ]
    if rest:
        lines += [f"element sh {count if harmonics is None else harmonics}"]
        lines += [f"property uchar f_rest_{i}" for i in range(rest)]
    values = {"min_x": -1.0, "max_x": 1.0, "max_y": 2.0, "max_z": 4.0, "max_scale_x": 1.0}
    values |= {"max_r": 0.5, "max_g": 1.0, "max_b": 1.0}
    body = b""
    for number in range(chunks):  # each ten further along x
        moved = values | {name: values[name] + 10 * number for name in ("min_x", "max_x")}
        body += np.float32([moved.get(name, 0.0) for name in bounds]).tobytes()
    body += struct.pack("<4I", position, rotation, (1 << 32) - 1, colour) * count
    return ("\n".join(lines) + "\nend_header\n").encode() + body + bytes([byte]) * (rest * count)


def read_compressed(tmp_path: Path, *given: Any, **fields: Any) -> Any:
    path = tmp_path / "a.ply"
    path.write_bytes(compressed(*given, **fields))
    return compressed_ply.read(path)


def test_bounds_of_logarithms_are_those_that_have_an_exponential():
    for end in ("mins", "maxs"):
        ends = {"mins": -1, "maxs": [1, 2, 3]}
        for value in (700, -700, [0, -700, 700]):
            low, high = sog._bounds({"scales": ends | {end: value}}, "scales", 3, "meta.json")
            assert (low if end == "mins" else high).tolist() == (value if isinstance(value, list) else [value] * 3)
        for value in (700.1, [0, -700.1, 0]):
            with pytest.raises(CorruptScene, match=rf"'scales.{end}' must lie within -700..700"):
                sog._bounds({"scales": ends | {end: value}}, "scales", 3, "meta.json")


def test_packed_numbers_are_shares_of_their_chunks_bounds(tmp_path):
    position = 2047 << 21 | 0 << 11 | 2047
    colour = 255 << 24 | 51 << 16 | 0 << 8 | 102
    found = read_compressed(tmp_path, 257, position=position, colour=colour)
    assert found.means[[0, 255, 256]] == pytest.approx(np.float32([[1, 0, 4], [1, 0, 4], [11, 0, 4]]))
    assert found.scales[0] == pytest.approx([np.e, 1, 1])
    assert found.opacities[0] == pytest.approx(0.4)
    assert 0.5 + SH_C0 * found.sh[0, 0] == pytest.approx([0.5, 0.2, 0.0], abs=1e-6)
    plain = read_compressed(tmp_path, 1, colour=colour, colours=False)
    assert 0.5 + SH_C0 * plain.sh[0, 0] == pytest.approx([1.0, 0.2, 0.0], abs=1e-6)


@pytest.mark.parametrize("largest", [0, 1, 2, 3])
def test_packed_quaternions_leave_out_the_largest(tmp_path, largest):
    others = [0.1, -0.3, 0.5]
    packed = largest << 30
    for shift, value in zip((20, 10, 0), others, strict=True):
        packed |= round((value / np.sqrt(2) + 0.5) * 1023) << shift
    expected = others.copy()
    expected.insert(largest, np.sqrt(1 - 0.35))
    assert read_compressed(tmp_path, 1, rotation=packed).quats[0] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("byte", "value"), [(0, -4.0), (255, 4.0), (1, (1.5 / 256 - 0.5) * 8), (127, (127.5 / 256 - 0.5) * 8)]
)
@pytest.mark.parametrize(("rest", "coefficients"), [(9, 3), (24, 8), (45, 15)])
def test_packed_harmonics_are_the_middles_of_256_steps(tmp_path, byte, value, rest, coefficients):
    found = read_compressed(tmp_path, 1, rest=rest, byte=byte)
    assert found.sh.shape == (1, 1 + coefficients, 3)
    assert found.sh[0, 1:] == pytest.approx(np.full((coefficients, 3), value))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"count": 257, "chunks": 1}, "1 chunks for 257"),
        ({"count": 256, "chunks": 2}, "2 chunks for 256"),
        ({"count": 1, "rest": 12}, "9, 24 or 45 bytes"),
        ({"count": 2, "rest": 9, "harmonics": 1}, "must have 2 records"),
        ({"count": 1, "kind": "int"}, "must be uint"),
        ({"count": 1, "drop": "max_scale_z"}, "no 'max_scale_z'"),
        ({"count": 1, "drop": "max_b"}, "no 'max_b'"),
        ({"count": 1, "drop": "packed_scale"}, "no 'packed_scale'"),
    ],
)  # fmt: skip
def test_compressed_files_that_contradict_themselves_are_refused(tmp_path, given, says):
    with pytest.raises(CorruptScene, match=says):
        read_compressed(tmp_path, **given)


# ------------------------------------------------------------------ glTF


def glb_file(
    tree: Any, data: bytes = b"", *, version: int = 2, kind: bytes = b"JSON", length: int | None = None
) -> bytes:
    text = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    length = len(text) if length is None else length
    head = struct.pack("<4sIII4s", b"glTF", version, 0, length, kind)
    return head + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def scene_tree(nodes: list[dict], columns: dict[str, np.ndarray], **of_view: Any) -> tuple[dict, bytes]:
    """A primitive whose attributes have a buffer view each."""
    views, accessors, attributes, data = [], [], {}, b""
    for number, (name, values) in enumerate(columns.items()):
        kind = {"f4": 5126, "u1": 5121, "i1": 5120, "u2": 5123, "i2": 5122}[values.dtype.str[1:]]
        part = np.ascontiguousarray(values).tobytes()
        view = {"buffer": 0, "byteOffset": len(data), "byteLength": len(part)}
        views.append(view | of_view.get(name, {}))
        width = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
        accessors.append({"bufferView": number, "componentType": kind, "count": len(values), "type": width})
        attributes[name if name in ("COLOR_0", "POSITION") else f"KHR_gaussian_splatting:{name}"] = number
        data += part
    primitive = {"attributes": attributes, "extensions": {"KHR_gaussian_splatting": {}}}
    tree = {
        "scenes": [{"nodes": [0]}], "nodes": nodes, "meshes": [{"primitives": [primitive]}],
        "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    return tree, data


def columns(count: int = 2, **changes: np.ndarray) -> dict[str, np.ndarray]:
    found = {
        "POSITION": np.float32([[1, 2, 3]] * count), "ROTATION": np.float32([[0, 0, 0, 1]] * count),
        "SCALE": np.float32([[1, 1, 1]] * count), "OPACITY": np.float32([[0.5]] * count),
        "SH_DEGREE_0_COEF_0": np.float32([[0.1, 0.2, 0.3]] * count),
    }  # fmt: skip
    return found | changes


def read_glb(tmp_path: Path, data: bytes) -> Any:
    path = tmp_path / "a.glb"
    path.write_bytes(data)
    return gltf.read(path)


def test_attributes_are_floats_or_shares_of_integers(tmp_path):
    tree, data = scene_tree([{"mesh": 0}], columns(
        OPACITY=np.uint8([[255], [51]]), ROTATION=np.int16([[0, 32767, 0, 0], [0, 0, 0, -32768]]),
    ))  # fmt: skip
    found = read_glb(tmp_path, glb_file(tree, data))
    assert found.opacities == pytest.approx([1.0, 0.2])
    assert found.quats.tolist() == [[0, 0, 1, 0], [-1, 0, 0, 0]]
    assert found.sh[0, 0] == pytest.approx([0.1, 0.2, 0.3])
    assert found.up == (0.0, 1.0, 0.0)


@pytest.mark.parametrize("kind", ["u1", "<u2", "i1", "<i2"])
def test_the_largest_integer_of_each_kind_is_one(kind, tmp_path):
    largest = np.iinfo(kind).max
    tree, data = scene_tree([{"mesh": 0}], columns(OPACITY=np.array([[largest], [largest // 3]], kind)))
    assert read_glb(tmp_path, glb_file(tree, data)).opacities == pytest.approx([1.0, (largest // 3) / largest])


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_harmonics_come_by_degree_and_number(tmp_path, degree):
    more = {
        f"SH_DEGREE_{d}_COEF_{k}": np.float32([[d, k, 0]] * 2) for d in range(1, degree + 1) for k in range(2 * d + 1)
    }
    found = read_glb(tmp_path, glb_file(*scene_tree([{"mesh": 0}], columns(**more))))
    assert found.sh.shape[1] == min((degree + 1) ** 2, 16)
    assert len(found.warnings) == (degree == 4)
    if degree:
        assert found.sh[0, 1:4] == pytest.approx(np.array([[1, 0, 0], [1, 1, 0], [1, 2, 0]]), abs=1e-6)


def test_without_harmonics_there_are_colours(tmp_path):
    given = columns(COLOR_0=np.float32([[0.5, 1.0, 0.0, 1.0]] * 2))
    del given["SH_DEGREE_0_COEF_0"]
    found = read_glb(tmp_path, glb_file(*scene_tree([{"mesh": 0}], given)))
    assert 0.5 + SH_C0 * found.sh[0, 0] == pytest.approx([0.5, 1.0, 0.0], abs=1e-6)


def test_attributes_may_be_interleaved(tmp_path):
    """Positions with a fourth number after each; the last one ends with the view."""
    rows = np.float32([[1, 2, 3, 9], [4, 5, 6, 9]])
    tree, data = scene_tree([{"mesh": 0}], columns(POSITION=rows), POSITION={"byteStride": 16, "byteLength": 28})
    tree["accessors"][0]["type"] = "VEC3"
    assert read_glb(tmp_path, glb_file(tree, data)).means.tolist() == [[1, 2, 3], [4, 5, 6]]
    tree["accessors"][0]["byteOffset"] = 4
    with pytest.raises(CorruptScene, match="beyond its buffer view"):
        read_glb(tmp_path, glb_file(tree, data))
    tree["bufferViews"][0]["byteLength"] = 32
    assert read_glb(tmp_path, glb_file(tree, data)).means[0].tolist() == [2, 3, 9]
    tree["bufferViews"][0]["byteStride"] = 8
    with pytest.raises(CorruptScene, match="beyond its buffer view"):
        read_glb(tmp_path, glb_file(tree, data))


def test_nodes_move_what_is_below_them(tmp_path):
    """Turned by a quarter about z, twice as large; below it one further along its own x, by a matrix."""
    half = np.sqrt(0.5)
    child = np.eye(4)
    child[0, 3] = 10.0
    nodes = [
        {"children": [1], "rotation": [0, 0, half, half], "scale": [2, 2, 2], "translation": [100, 0, 0]},
        {"mesh": 0, "matrix": child.T.ravel().tolist()},
    ]
    found = read_glb(tmp_path, glb_file(*scene_tree(nodes, columns(1))))
    # (11, 2, 3) turned is (-2, 11, 3).
    assert found.means == pytest.approx(np.array([[96.0, 22.0, 6.0]]), abs=1e-5)
    assert found.scales == pytest.approx(np.full((1, 3), 2.0))


@pytest.mark.parametrize(
    ("node", "fits"),
    [
        ({"scale": [1.1e-6] * 3}, True), ({"scale": [0.9e-6] * 3}, False), ({"scale": [9e5] * 3}, True),
        ({"scale": [1.1e6] * 3}, False), ({"scale": [1, 1, 1.00004]}, True), ({"scale": [1, 1, 1.0001]}, False),
        ({"rotation": [0, 0, 0, 1.0009]}, True), ({"rotation": [0, 0, 0, 1.0011]}, False),
        ({"rotation": [0, 0, 0, 0.9989]}, False), ({"scale": [1, 1, -1]}, False), ({"scale": [1, 1]}, False),
    ],
)  # fmt: skip
def test_nodes_scale_evenly_and_turn(tmp_path, node, fits):
    data = glb_file(*scene_tree([{"mesh": 0} | node], columns()))
    if fits:
        assert len(read_glb(tmp_path, data).means) == 2
    else:
        with pytest.raises(CorruptScene):
            read_glb(tmp_path, data)


def changed(change: Any) -> bytes:
    tree, data = scene_tree([{"mesh": 0}], columns())
    change(tree)
    return glb_file(tree, data)


GOOD = glb_file(*scene_tree([{"mesh": 0}], columns()))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: GOOD[:19], "header of 20 bytes"),
        (lambda: glb_file({}, version=1), "version 1"),
        (lambda: glb_file({}, kind=b"BIN\0"), "no JSON"),
        (lambda: glb_file({}, length=10**6), "no JSON"),
        (lambda: glb_file(b"{]"), "JSON chunk is damaged"),
        (lambda: glb_file([]), "must be an object"),
        (lambda: changed(lambda t: t["nodes"][0].update(mesh=1)), r"no meshes\[1\]"),
        (lambda: changed(lambda t: t["nodes"][0].update(mesh=-1)), r"no meshes\[-1\]"),
        (lambda: changed(lambda t: t["bufferViews"][0].update(buffer=1)), "no range in this file"),
        (lambda: changed(lambda t: t["bufferViews"][0].update(byteOffset=-1)), "beyond the file"),
        (lambda: changed(lambda t: t["bufferViews"][0].update(byteLength="x")), "no range"),
        (lambda: changed(lambda t: t["accessors"][0].update(componentType=5125)), "known type"),
        (lambda: changed(lambda t: t["accessors"][0].update(type="VEC4")), "must be 3 number"),
        (lambda: changed(lambda t: t["accessors"][0].update(count="2")), "must be 3 number"),
        (lambda: changed(lambda t: t["accessors"][0].update(byteOffset=-4)), "beyond its buffer view"),
        (lambda: changed(lambda t: t["meshes"][0]["primitives"][0].pop("attributes")), "without attributes"),
        (
            lambda: changed(lambda t: t["meshes"][0]["primitives"][0]["attributes"].pop("POSITION")),
            "no attribute 'POSITION'",
        ),
    ],
)  # fmt: skip
def test_gltf_that_contradicts_itself_is_refused(tmp_path, make, says):
    with pytest.raises(CorruptScene, match=says):
        read_glb(tmp_path, make())


def test_colours_of_another_space_are_refused(tmp_path):
    tree, data = scene_tree([{"mesh": 0}], columns())
    tree["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["colorSpace"] = "lin"
    with pytest.raises(UnsupportedFormat, match="colours in 'lin'"):
        read_glb(tmp_path, glb_file(tree, data))
