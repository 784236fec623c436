"""`splatfix bench evaluate`: hloc's figures on hloc's files, and each format on planted poses."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from service.bench.evaluate import PhotoError, evaluated, photo_errors, summary
from service.bench.pose_files import PhotoPose, read_names, read_pose_file
from service.cli.app import app
from service.errors import CorruptScene, InvalidRequest
from service.geometry import moved, quat_from_rotation, so3_exp
from service.types import Pose

FILES = Path(__file__).parent / "data" / "hloc"
"""24 poses by pycolmap 4.2.1 (names as 7-Scenes has them), and results by hloc's `write_poses` for 17 of its 20 test
photos; the figures below are what hloc's `evaluate` prints for these (its commit c13273b)."""
HLOC_MEDIANS = (0.191, 1.168)
HLOC_SHARES = [5.0, 10.0, 20.0, 30.0, 40.0, 60.0, 80.0]


def poses(count: int = 6) -> list[PhotoPose]:
    rng = np.random.default_rng(1)
    found = []
    for i in range(count):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = so3_exp(rng.normal(size=3)), rng.normal(size=3)
        found.append(PhotoPose(f"images/p {i}.jpg", Pose(matrix), 100.0 + i / 30))
    return found


def test_hlocs_own_figures_come_out_on_its_files() -> None:
    found = evaluated(FILES / "results.txt", FILES)
    assert (found["photos_of"], found["photos"], found["answered"]) == ("list_test.txt", 20, 17)
    medians = round(found["median_translation_m"], 3), round(found["median_rotation_deg"], 3)
    assert medians == HLOC_MEDIANS
    assert [round(100 * row["share"], 2) for row in found["recall"]] == HLOC_SHARES
    # The same model as text.
    as_text = evaluated(FILES / "results.txt", FILES / "images.txt", FILES / "list_test.txt")
    assert as_text["recall"] == found["recall"]
    missing = [row["photo"] for row in found["per_photo"] if not row["answered"]]
    assert missing == [f"seq-02/frame-0000{i}.color.png" for i in (21, 22, 23)]


def test_metres_and_units_scale_the_bounds(tmp_path: Path) -> None:
    found = evaluated(FILES / "results.txt", FILES, metres_per_unit=100.0)
    assert found["median_translation_m"] == pytest.approx(100 * HLOC_MEDIANS[0], abs=0.05)
    scaled = evaluated(FILES / "results.txt", FILES, units_per_unit=0.2)
    (fine, coarse) = [row for row in scaled["recall"] if "units" in row]
    # 0.05 units of 5 of the truth's are 25 cm.
    within = [e["answered"] and e["translation_m"] < 0.25 and e["rotation_deg"] < 5 for e in scaled["per_photo"]]
    assert coarse == {"units": 0.05, "deg": 5.0, "share": np.mean(within)}
    assert 0 < fine["share"] < coarse["share"]


def test_a_photo_is_within_bounds_if_both_errors_are_smaller() -> None:
    """Of 5 m and 10 degrees, hloc's coarsest bounds; translations are in units of half a metre."""
    errors = [(9.9, 9.9), (10.0, 9.9), (9.9, 10.0), (10.1, 1.0), (1.0, 10.1)]
    found = summary([PhotoError(str(k), *error, True) for k, error in enumerate(errors)], 0.5, None)
    assert found["recall"][-1] == {"m": 5.0, "deg": 10.0, "share": 1 / 5}
    assert [row["m"] for row in found["recall"]] == [0.01, 0.02, 0.03, 0.05, 0.25, 0.5, 5.0]
    assert [row["deg"] for row in found["recall"]] == [1, 2, 3, 5, 2, 5, 10]
    assert found["median_translation_m"] == pytest.approx(4.95)


def test_without_a_list_beside_it_all_of_the_truth_counts(tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    known = poses()
    there = written("7scenes", known, tmp_path / "truth")
    found = evaluated(written("truth", known[:2], tmp_path), there, metres_per_unit=4.0)
    assert (found["photos"], found["answered"], found["photos_of"]) == (len(known), 2, there.name)
    shifted = [replace(one, pose=moved(one.pose, np.array([0, 0, 0, 0.5, 0, 0]))) for one in known]
    found = evaluated(written("truth", shifted, tmp_path), there, metres_per_unit=4.0)
    assert [row["translation_m"] for row in found["per_photo"]] == pytest.approx([2.0] * len(known))


def written(kind: str, known: list[PhotoPose], folder: Path) -> Path:
    """Write poses in a format, from its description."""

    def wxyz(matrix: np.ndarray) -> np.ndarray:
        return quat_from_rotation(matrix[:3, :3])

    here = [one.pose.world_from_camera for one in known]
    there = [np.linalg.inv(matrix) for matrix in here]
    if kind == "7scenes":
        for one, matrix in zip(known, here, strict=True):
            path = folder / "seq" / f"{one.name}.pose.txt"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(path, matrix, fmt="%.9e", delimiter="\t")
        return folder / "seq"
    names = [one.name for one in known]
    path = folder / {"transforms": "transforms.json", "truth": "truth.json", "table": "poses.csv"}.get(
        kind, "poses.txt"
    )
    lines: list[list] = {
        "hloc": [[n, *wxyz(m), *m[:3, 3]] for n, m in zip(names, there, strict=True)],
        "tum": [
            ["# time x y z qx qy qz qw"],
            *([o.time_s, *m[:3, 3], *np.roll(wxyz(m), -1)] for o, m in zip(known, here, strict=True)),
        ],
        "cambridge": [
            ["Visual Landmark Dataset V1"],
            ["ImageFile, Camera Position [X Y Z W P Q R]"],
            [""],
            *([n, *m[:3, 3], *wxyz(t)] for n, m, t in zip(names, here, there, strict=True)),
        ],
    }.get(kind, [])
    text = "\n".join(" ".join(map(str, line)) for line in lines) + "\n"
    if kind == "transforms":
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        frames = [
            {"file_path": f"./{n}", "transform_matrix": (m @ flip).tolist()} for n, m in zip(names, here, strict=True)
        ]
        text = json.dumps({"frames": frames})
    elif kind == "truth":
        text = json.dumps([{"photo": n, "world_from_camera": m.tolist()} for n, m in zip(names, here, strict=True)])
    elif kind == "table":
        with path.open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(["photo", "status", "x", "y", "z", "qw", "qx", "qy", "qz"])
            table.writerows([n, "localized", *m[:3, 3], *wxyz(m)] for n, m in zip(names, here, strict=True))
            table.writerow([names[0], "uncertain", 9, 9, 9, 1, 0, 0, 0])
        return path
    path.write_text(text)
    return path


@pytest.mark.parametrize("kind", ["hloc", "tum", "cambridge", "7scenes", "transforms", "truth", "table"])
def test_each_format_holds_the_planted_poses(kind: str, tmp_path: Path) -> None:
    known = poses()
    read = read_pose_file(written(kind, known, tmp_path))
    assert len(read) == len(known)
    if kind != "tum":
        known = [replace(one, time_s=None) for one in known]
    for error in photo_errors(read, known):
        assert error.answered
        assert error.translation < 1e-6
        assert error.rotation_deg < 1e-4


def test_names_with_other_folders_and_suffixes_are_found_if_only_one_fits() -> None:
    known = [replace(one, time_s=None) for one in poses(3)]
    ends = [replace(known[0], name="p 0.png"), replace(known[1], name="left/images/p 1.jpg")]
    assert [e.answered for e in photo_errors(ends, known)] == [True, True, False]
    twins = [replace(known[0], name="a/x.jpg"), replace(known[1], name="b/x.jpg")]
    with pytest.raises(InvalidRequest, match=r"'x.jpg' may be 'a/x.jpg' and 'b/x.jpg'"):
        photo_errors([replace(known[0], name="x.jpg")], twins)
    assert photo_errors([replace(known[1], name="b/x.jpg")], twins)[1].translation == 0
    with pytest.raises(InvalidRequest, match="has two poses"):
        photo_errors([ends[0], known[0]], known)
    with pytest.raises(InvalidRequest, match=r"no photo of the truth has a pose.*'q.jpg'.*'images/p 0.jpg'"):
        photo_errors([replace(known[0], name="q.jpg")], known)
    with pytest.raises(InvalidRequest, match=r"no photo 'q.jpg'"):
        photo_errors(known, known, ["q.jpg"])


def test_trajectories_are_compared_by_time() -> None:
    known = [replace(one, name="") for one in poses(3)]
    shifted = [replace(one, time_s=one.time_s + 0.005) for one in known if one.time_s]
    assert [e.translation for e in photo_errors(shifted, known)] == [0, 0, 0]
    # As TUM's tools: up to 20 ms.
    for seconds, near in ((0.019, True), (-0.019, True), (0.021, False)):
        beside = [replace(known[0], time_s=known[0].time_s + seconds), *known[1:]]  # type: ignore[operator]
        assert [e.answered for e in photo_errors(beside, known)] == [near, True, True]
    late = [replace(one, time_s=one.time_s + 9.0) for one in shifted if one.time_s]
    with pytest.raises(InvalidRequest, match=r"no two times.*109.005 and 100.000"):
        photo_errors(late, known)
    with pytest.raises(InvalidRequest, match="names and the other one times"):
        photo_errors(known, [replace(one, name="a", time_s=None) for one in known])


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.txt", "p.jpg 1 0 0 0 1 2\n", "line 1: must be 'name qw qx"),
        ("a.txt", "p.jpg 2 0 0 0 1 2 3\n", "line 1: a quaternion must have length 1"),
        ("a.txt", "1.5 0 0 0 0 0 0 1\n2.5 0 nan 0 0 0 0 1\n", "line 2: a position must be finite"),
        ("a.txt", "# nothing\n", "holds no pose"),
        ("a.json", "{]", "not JSON"),
        ("a.json", '[{"photo": "a", "world_from_camera": [[1]]}]', "entry 0: a pose must be a 4 x 4"),
        ("a.json", '{"frames": [{"file_path": "a"}]}', "entry 0: must have 'file_path' and 'transform_matrix'"),
        ("a.csv", "photo,x,y,z\n", "lacks the columns qw, qx, qy, qz"),
        ("a.csv", "photo,x,y,z,qw,qx,qy,qz\na,1,2,?,1,0,0,0\n", "line 2: x, y, z, qw"),
        ("images.bin", "abc", "not COLMAP's images"),
        ("images.txt", "1 1 0 0 0 1 2 3 1\n\n", "not COLMAP's images"),
        ("a.pose.txt", "1 0 0 0 0 1 0 0", "a pose must be a 4 x 4"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_file_is_said_with_its_place(tmp_path: Path, name: str, text: str, says: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises((InvalidRequest, CorruptScene)) as raised:
        read_pose_file(path)
    assert says in str(raised.value)


def test_lists_of_queries_have_names_first(tmp_path: Path) -> None:
    listed = tmp_path / "list.txt"
    listed.write_text("seq1/a b.png\nseq1/c.png SIMPLE_RADIAL 640 480 500.0 320 240 0.1\n")
    assert read_names(listed) == ["seq1/a b.png", "seq1/c.png"]


def test_the_command_prints_the_figures_and_writes_them(tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    command = ["bench", "evaluate", "--poses", str(FILES / "results.txt"), "--truth", str(FILES), "--json", str(file)]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0
    assert "17 of 20 photos of list_test.txt" in done.output
    assert "0.1911 m, 1.168 deg" in done.output
    assert "25 cm 2 deg: 40.00 %" in done.output
    assert len(json.loads(file.read_text())["per_photo"]) == 20
