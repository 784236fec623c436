"""Both sides of the limits that readers of untrusted files have: what programs write is read, and little more."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from service.errors import CorruptScene, UnsupportedFormat
from service.scene_formats import gaussians, ply_header
from service.scene_formats.gaussians import RawGaussians, checked, require_count
from service.scene_formats.ply_header import element_records, read_header
from service.scene_manager import scene_archive
from service.scene_manager.scene_archive import unpack

# ------------------------------------------------------------------ PLY headers


def ply_file(folder: Path, *lines: str, data: bytes = b"", kind: str = "binary_little_endian") -> Path:
    path = folder / "a.ply"
    head = "\n".join(["ply", f"format {kind} 1.0", *lines, "end_header"]) + "\n"
    path.write_bytes(head.encode() + data)
    return path


def test_a_header_may_have_thousands_of_long_properties_and_is_bounded(tmp_path: Path) -> None:
    # Feature fields have hundreds; names of 32 characters make 4096 of them 200 kB.
    many = [f"property float {'feature' * 4}{k:04}" for k in range(4096)]
    header = read_header(ply_file(tmp_path, "element vertex 1", *many))
    (element,) = header.elements
    assert element.dtype is not None
    assert len(element.dtype.names or ()) == 4096
    with pytest.raises(CorruptScene, match="4097 properties"):
        read_header(ply_file(tmp_path, "element vertex 1", *many, "property float one_more"))
    with pytest.raises(CorruptScene, match="end_header"):
        read_header(ply_file(tmp_path, *["comment " + 92 * "x"] * 3000))  # 300 kB
    with pytest.raises(CorruptScene, match="2 properties, 1 of them different"):
        read_header(ply_file(tmp_path, "element vertex 1", "property float x", "property int x"))


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (["element vertex 9999999999999999999", "property float x"], "not 'element NAME COUNT'"),
        (["element vertex -1", "property float x"], "not 'element NAME COUNT'"),
        (["element vertex 1 1", "property float x"], "not 'element NAME COUNT'"),
        (["property float x"], "a property out of place"),
        (["element vertex 1", "property float"], "a property out of place"),
        (["element vertex 1", "property quad x"], "unknown type 'quad'"),
        (["format ascii 1.0", "element vertex 1"], "exactly one 'format'"),
    ],
)
def test_a_header_that_is_none_is_refused_with_its_place(lines: list[str], says: str, tmp_path: Path) -> None:
    with pytest.raises(CorruptScene, match=says):
        read_header(ply_file(tmp_path, *lines))


def test_the_largest_count_that_a_header_can_have_is_compared_with_the_file(tmp_path: Path) -> None:
    path = ply_file(tmp_path, "element vertex 999999999999999999", "property float x", data=b"1234" * 3)
    with pytest.raises(CorruptScene, match="the file ends after 3"):
        element_records(path, read_header(path), "vertex")
    before = ply_file(tmp_path, "element face 999999999999999999", "property float x", "element vertex 1",
                      "property float x", data=bytes(20))  # fmt: skip
    with pytest.raises(CorruptScene, match="truncated within 'face'"):
        element_records(before, read_header(before), "vertex")
    few = ply_file(tmp_path, "element vertex 1", "property float x", data=bytes(4))
    with pytest.raises(CorruptScene, match="no element 'chunk'"):
        element_records(few, read_header(few), "chunk")


@pytest.mark.parametrize(("entries", "read"), [(65_536, True), (65_537, False)])
def test_lists_before_the_records_are_passed_over_up_to_a_limit(entries: int, read: bool, tmp_path: Path) -> None:
    """Faces have three or four corners: a longer list is damage, which could make a reader walk for hours."""
    lines = ["element face 1", "property uchar flag", "property list uint uchar corners"]
    lines += ["element vertex 2", "property float x"]
    data = b"\x07" + struct.pack("<I", entries) + bytes(entries) + struct.pack("<2f", 1.5, 2.5)
    path = ply_file(tmp_path, *lines, data=data)
    if read:
        assert element_records(path, read_header(path), "vertex")["x"].tolist() == [1.5, 2.5]
    else:
        with pytest.raises(CorruptScene, match="truncated within 'face'"):
            element_records(path, read_header(path), "vertex")


@pytest.mark.parametrize("missing", [0, 1, 4, 5])
def test_records_are_read_to_the_last_byte_and_no_further(missing: int, tmp_path: Path) -> None:
    data = struct.pack("<3f", 1.0, 2.0, 3.0)
    path = ply_file(tmp_path, "element vertex 3", "property float x", data=data[: len(data) - missing])
    if missing:
        with pytest.raises(CorruptScene, match=f"the file ends after {2 if missing <= 4 else 1}"):
            element_records(path, read_header(path), "vertex")
    else:
        assert element_records(path, read_header(path), "vertex")["x"].tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_records_in_blocks_are_those_of_the_whole(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply_header, "BLOCK", 4)
    values = np.arange(10, dtype="<f4")
    data = values.tobytes() if kind != "ascii" else "\n".join(map(str, values)).encode()
    path = ply_file(tmp_path, "element vertex 10", "property float x", data=data, kind=kind)
    blocks = list(ply_header.element_blocks(path, read_header(path), "vertex"))
    assert [(place.start, place.stop) for place, _ in blocks] == [(0, 4), (4, 8), (8, 10)]
    assert np.array_equal(np.concatenate([block["x"] for _, block in blocks]), values)


# ------------------------------------------------------------------ Gaussians


def raw(count: int = 10) -> RawGaussians:
    return RawGaussians(
        np.zeros((count, 3), np.float32),
        np.tile(np.float32([2, 0, 0, 0]), (count, 1)),
        np.ones((count, 3), np.float32),
        np.full(count, 0.5, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


@pytest.mark.parametrize(("bad", "read"), [(4, True), (5, False)])
def test_a_file_half_of_which_is_damaged_is_refused(bad: int, read: bool) -> None:
    given = raw()
    given.means[:bad, 1] = np.nan
    if not read:
        with pytest.raises(CorruptScene, match="5 of 10 Gaussians have non-finite means"):
            checked(given, "a.ply")
        return
    found = checked(given, "a.ply")
    assert len(found.means) == len(found.quats) == len(found.sh) == 6
    assert "4 of 10" in found.warnings[0]


@pytest.mark.parametrize(
    ("name", "value", "usable"),
    [
        ("means", 1e9, True),
        ("means", -1e9, True),
        ("means", -1.01e9, False),
        ("scales", 1e9, True),
        ("scales", 1.01e9, False),
        ("scales", 0.0, True),
        ("scales", -1e-30, False),
        ("opacities", np.inf, False),
        ("sh", np.nan, False),
    ],
)
def test_values_that_no_renderer_can_use_are_left_out(name: str, value: float, usable: bool) -> None:
    given = raw()
    getattr(given, name)[3] = value
    assert len(checked(given, "a").means) == (10 if usable else 9)


def test_a_rotation_of_any_length_but_zero_is_one() -> None:
    given = raw()
    given.quats[2] = np.float32([0, 1e-11, 0, 0])  # its square is 0 in float32
    given.quats[3] = 0
    found = checked(given, "a")
    assert len(found.quats) == 9
    assert np.allclose(np.linalg.norm(found.quats, axis=1), 1)


def test_a_scene_has_one_gaussian_at_least_and_twenty_million_at_most() -> None:
    """More than any published scene: 20 million of SH degree 3 take 5 GB."""
    for count in (1, 20_000_000):
        require_count(count, "a")
    with pytest.raises(CorruptScene, match="empty"):
        require_count(0, "a")
    with pytest.raises(CorruptScene, match="the limit is 20000000"):
        require_count(20_000_001, "a")
    assert gaussians.MAX_GAUSSIANS * (3 + 4 + 3 + 1 + 48) * 4 < 5e9


# ------------------------------------------------------------------ archives

PLY = b"ply\n"


def zipped(folder: Path, *names: str, data: bytes = b"x") -> Path:
    path = folder / "a.zip"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as opened:
        for name in names:
            opened.writestr(name, data)
    path.write_bytes(buffer.getvalue())
    return path


def unpacked(folder: Path, *names: str, data: bytes = b"x", most: int = 10**6) -> set[str]:
    target = folder / "out"
    target.mkdir()
    unpack(zipped(folder, *names, data=data), target, most)
    return {path.relative_to(target).as_posix() for path in target.rglob("*") if path.is_file()}


@pytest.mark.parametrize("count", [3, 4])
def test_files_and_photos_of_an_archive_are_counted(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["scene.ply", *(f"images/{k}.jpg" for k in range(count))]
    monkeypatch.setattr(scene_archive, "_MAX_PHOTOS", 3)
    assert unpacked(tmp_path, *names) == {"scene.ply", "images/0.jpg", "images/1.jpg", "images/2.jpg"}
    monkeypatch.setattr(scene_archive, "_MAX_MEMBERS", 4)
    (tmp_path / "again").mkdir()
    if count + 1 <= 4:
        unpacked(tmp_path / "again", *names)
    else:
        with pytest.raises(CorruptScene, match="more than 4 files"):
            unpacked(tmp_path / "again", *names)


@pytest.mark.parametrize(("size", "kept"), [(100, True), (101, False)])
def test_a_photo_of_an_archive_has_a_size_at_most(
    size: int, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_archive, "_MAX_PHOTO_BYTES", 100)
    found = unpacked(tmp_path, "scene.ply", "images/a.jpg", data=bytes(size))
    assert found == {"scene.ply"} | ({"images/a.jpg"} if kept else set())


@pytest.mark.parametrize(("most", "fits"), [(20, True), (19, False)])
def test_an_archive_unpacks_to_so_many_bytes_in_all(most: int, fits: bool, tmp_path: Path) -> None:
    names = ("scene.ply", "scene.json")
    if fits:
        assert unpacked(tmp_path, *names, data=bytes(10), most=most) == set(names)
    else:
        with pytest.raises(CorruptScene, match="archive"):
            unpacked(tmp_path, *names, data=bytes(10), most=most)


@pytest.mark.parametrize(
    ("name", "taken"),
    [
        ("a/b/c/x.jpg", True),
        ("a/b/c/d/x.jpg", False),
        ("x.jpg", False),  # beside the scene: nothing is read from it there
        ("images/x.JPEG", True),
        ("images/x.gif", False),
        ("transforms.json", True),
        ("transforms_train.json", True),
        ("other.json", False),
        ("cameras.json", True),
        ("poses.json", True),
        ("sparse/0/cameras.bin", True),
        ("sparse/images.txt", True),
        ("sparse/0/notes.pdf", False),
        ("sparse/1/cameras.bin", False),
        ("images/.hidden.jpg", False),
        ("images/a:b.jpg", False),
        ("means_l.webp", True),
    ],
)
def test_only_what_a_scene_is_read_from_is_taken(name: str, taken: bool, tmp_path: Path) -> None:
    assert unpacked(tmp_path, "scene.ply", name) == {"scene.ply"} | ({name} if taken else set())


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (("room/scene.ply", "room/images/a.jpg"), {"scene.ply", "images/a.jpg"}),
        (("room/scene.ply", "transforms.json"), {"transforms.json"}),  # no folder that holds all
        (("room\\scene.ply",), {"scene.ply"}),  # as some Windows programs write it
        (("room/scene.ply", "__MACOSX/room/._scene.ply", "room/.DS_Store"), {"scene.ply"}),
        (("sparse/0/cameras.bin", "sparse/0/images.bin"), {"sparse/0/cameras.bin", "sparse/0/images.bin"}),
    ],
)
def test_the_folder_that_holds_everything_is_left_out(names: tuple[str, ...], found: set[str], tmp_path: Path) -> None:
    assert unpacked(tmp_path, *names) == found


def test_two_files_of_one_name_and_other_compressions_are_refused(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="Duplicate"), pytest.raises(CorruptScene, match="same name"):
        unpacked(tmp_path, "scene.ply", "scene.ply")
    path = tmp_path / "lzma.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as opened:
        opened.writestr("scene.ply", PLY)
    with pytest.raises(UnsupportedFormat, match="stored and deflated"):
        unpack(path, tmp_path, 1000)
    path.write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(CorruptScene, match="can't be read"):
        unpack(path, tmp_path, 1000)
