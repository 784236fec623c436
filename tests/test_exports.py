"""Poses on Earth and in other programs' files, against hand-computed places and independent readers."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.cli.result_tables import write_frame_table
from service.errors import NoGeoAnchor
from service.geodesy import geographic
from service.geometry import look_at, rotation_from_quat
from service.geometry import moved as along
from service.jobs.model import JobResult, SequenceFrame
from service.results import PoseEstimate, Reason, StageTiming, Status, Verdict
from service.types import GeoAnchor, Intrinsics, Pose
from service.web.schemas.conversion import frame_out, geopose_out, result_out
from service.web.schemas.exports import exported
from service.web.schemas.job_results import Result

CREATED = datetime(2026, 1, 2, 3, 4, 5, 250_000, tzinfo=UTC)
POSE = look_at(np.array([1.0, 2.0, 3.0]), np.array([4.0, 4.0, 2.0]), np.array([0.0, 0.0, 1.0]))
WIDE = Intrinsics(640, 480, 500.0, 510.0, 321.0, 239.0, "OPENCV", (0.1, -0.02, 0.001, 0.002))


def result(intrinsics: Intrinsics = WIDE, anchor: GeoAnchor | None = None) -> Result:
    verdict = Verdict(Status.LOCALIZED, Reason.VERIFIED, 0.9, 100, 0.8, 1.0, np.eye(6))
    estimate = PoseEstimate(
        POSE, verdict, intrinsics, "given", "room", "0" * 64, "e", "r", "m", 0, False, 0, (), (), ()
    )  # fmt: skip
    return result_out(JobResult(estimate, StageTiming("decode", 0, 0), anchor, {}))


def at(latitude: float, longitude: float, height: float = 0.0, enu_from_world: np.ndarray | None = None) -> GeoAnchor:
    return GeoAnchor(latitude, longitude, height, np.eye(4) if enu_from_world is None else enu_from_world)


# ------------------------------------------------------------------ files


def test_a_smoothed_sequence_marks_what_is_interpolated(tmp_path):
    """Of a camera that goes along a line with jitter, and one photo that was not localized."""
    rng = np.random.default_rng(0)
    frames = []
    for i in range(12):
        pose = along(POSE, np.r_[np.zeros(3), 0.1 * i, 0, 0])
        seen = along(pose, 0.01 * rng.normal(size=6))
        status = Status.NOT_LOCALIZED if i in (0, 6) else Status.LOCALIZED
        answer = SequenceFrame(i, f"{i}.jpg", 0.1 * i, status, Reason.VERIFIED, 0.9, True, seen, 1e-4 * np.eye(6))
        frames.append(frame_out(answer))
    sequence = result().model_copy(update={"frames": frames})

    def positions(text: str) -> np.ndarray:
        return np.array([line.split()[1:4] for line in text.splitlines() if not line.startswith("#")], float)

    plain, smooth = (exported("tum", "p", CREATED, sequence, smooth=smooth) for smooth in (False, True))
    assert (len(positions(plain)), len(positions(smooth))) == (10, 11)
    marked = smooth.splitlines()
    assert marked[marked.index(next(line for line in marked if line.startswith("#"))) + 1].startswith("0.600000 ")
    truth = np.array([along(POSE, np.r_[np.zeros(3), 0.1 * i, 0, 0]).position_in_world for i in range(12)])
    raw = positions(plain) - np.delete(truth, [0, 6], 0)
    # 0.5 of the jitter remains.
    assert np.abs(positions(smooth) - truth[1:]).mean() < 0.8 * np.abs(raw).mean()
    entries = json.loads(exported("nerfstudio", "p", CREATED, sequence, smooth=True))["frames"]
    assert [entry["file_path"] for entry in entries if entry.get("interpolated")] == ["6.jpg"]
    assert exported("colmap", "p", CREATED, sequence, smooth=True).count("# interpolated") == 1
    write_frame_table(tmp_path / "a.csv", frames, smooth=True)
    head, *rows = [line.split(",") for line in (tmp_path / "a.csv").read_text().splitlines()]
    marks = [row[head.index("smoothed")] for row in rows]
    assert marks == ["", *["smoothed"] * 5, "interpolated", *["smoothed"] * 5]


def test_a_colmap_line_is_read_back_by_its_own_rules():
    text = exported("colmap", "my photo.jpg", CREATED, result())
    lines = [line for line in text.split("\n") if not line.startswith("#")]
    assert lines[1] == ""  # no observed points
    fields = lines[0].split(" ")
    assert (fields[0], fields[8], fields[9]) == ("1", "1", "my_photo.jpg")
    rotation = rotation_from_quat(np.array([float(v) for v in fields[1:5]]))
    # COLMAP projects x_camera = R x_world + t: the camera's centre goes to 0, what it looks at to the axis.
    translation = np.array([float(v) for v in fields[5:8]])
    assert np.allclose(rotation @ [1, 2, 3] + translation, 0, atol=1e-12)
    assert np.allclose(rotation @ [4, 4, 2] + translation, [0, 0, 14**0.5])
    assert "1 OPENCV 640 480 500 510 321 239 0.1" in text


def test_a_model_with_one_focal_length_has_one_in_colmap():
    simple = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, "SIMPLE_RADIAL", (0.1,))
    assert "1 SIMPLE_RADIAL 640 480 500 320 240 0.1" in exported("colmap", "p", CREATED, result(simple))


def test_a_nerfstudio_frame_has_blenders_axes_and_the_lens():
    frame = json.loads(exported("nerfstudio", "a/b.jpg", CREATED, result()))
    matrix = np.array(frame["transform_matrix"])
    forward = np.array([3, 2, -1]) / 14**0.5
    assert np.allclose(matrix[:3, 2], -forward)  # z points backwards
    assert matrix[2, 1] > 0  # y points up
    assert np.allclose(matrix[:3, 3], [1, 2, 3])
    assert (frame["file_path"], frame["fl_y"], frame["p2"]) == ("a/b.jpg", 510.0, 0.002)
    for model, distortion, told in (
        ("PINHOLE", (), "OPENCV"),
        ("SIMPLE_RADIAL_FISHEYE", (0.1,), "OPENCV_FISHEYE"),
        ("OPENCV_FISHEYE", (0.1, 0.0, 0.0, 0.0), "OPENCV_FISHEYE"),
    ):
        lens = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, model, distortion)
        frame = json.loads(exported("nerfstudio", "a.jpg", CREATED, result(lens)))
        assert (frame["camera_model"], frame.get("k1", 0.0)) == (told, sum(distortion))


def test_a_tum_line_is_time_position_quaternion_xyzw():
    values = [float(v) for v in exported("tum", "p", CREATED, result()).split()]
    assert values[0] == CREATED.timestamp()
    assert values[1:4] == [1, 2, 3]
    x, y, z, w = values[4:]
    assert np.allclose(rotation_from_quat(np.array([w, x, y, z])), POSE.world_from_camera[:3, :3])


@pytest.mark.parametrize("name", ["a\nb.jpg", "a b.jpg", "\x00", ""])
def test_a_photos_name_cannot_break_a_line(name):
    lines = exported("colmap", name, CREATED, result()).split("\n")
    assert len(lines) == 5
    assert len(lines[2].split(" ")) == 10


# ------------------------------------------------------------------ on Earth


def test_a_scene_without_a_place_has_no_geopose():
    assert result().geopose is None
    with pytest.raises(NoGeoAnchor):
        exported("geopose", "p", CREATED, result())


def test_a_camera_at_the_anchor_that_looks_north():
    level_north = look_at(np.zeros(3), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    found = geopose_out(at(47.0, 8.0, 400.0), level_north)
    place = found.position
    # 1e-9 degrees are 0.1 mm.
    assert np.allclose([place.lat, place.lon, place.h], [47, 8, 400], atol=1e-9)
    # By hand: x east, y up, z south is a quarter turn about east.
    q = found.quaternion
    assert np.allclose([q.w, q.x, q.y, q.z], [0.5**0.5, 0.5**0.5, 0, 0])


def test_metres_become_degrees():
    """On the equator a degree of longitude is 111,319.49 m of the ellipsoid, one of latitude 110,574.28 m."""
    world = np.diag([10.0, 10.0, 10.0, 1.0])  # a unit is 10 m
    east, _ = geographic(at(0, 0, enu_from_world=world), Pose(moved(100.0, 0, 0)))
    assert east[1] == pytest.approx(1000 / 111319.49, rel=1e-6)
    # On the tangent plane, 1 km off, one is d^2 / 2R = 7.8 cm above the ellipsoid.
    assert east[2] == pytest.approx(1000**2 / 2 / 6378137, rel=1e-3)
    north, _ = geographic(at(0, 0, enu_from_world=world), Pose(moved(0, 100.0, 5.0)))
    assert north[0] == pytest.approx(1000 / 110574.28, rel=1e-4)
    assert north[2] == pytest.approx(50 + 1000**2 / 2 / 6335439, rel=1e-3)


@given(
    st.floats(-89, 89),
    st.floats(-180, 180),
    st.tuples(*[st.floats(-500, 500)] * 3),
    st.tuples(*[st.floats(-1, 1)] * 3),
)
def test_neighbours_see_the_same_direction(latitude, longitude, place, axis):
    """Whatever the anchor, the viewing direction in the Earth's frame is that of the camera in the scene."""
    target = np.array(place) + axis + [0, 0, 2.5]
    pose = look_at(np.array(place), target, np.array([0.1, 1.0, 0.0]))
    (lat, lon, _), (w, x, y, z) = geographic(at(latitude, longitude), pose)
    seen = rotation_from_quat(np.array([w, x, y, z])) @ [0, 0, -1]
    expected = enu_axes(latitude, longitude) @ pose.axis_in_world
    assert np.allclose(enu_axes(lat, lon) @ seen, expected, atol=1e-9)


def moved(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def enu_axes(latitude: float, longitude: float) -> np.ndarray:
    """East, north, up from the sphere's parametrization: the derivatives by longitude and latitude."""
    lat, lon = np.radians([latitude, longitude])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.cross([0, 0, 1], up)
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up], 1)
