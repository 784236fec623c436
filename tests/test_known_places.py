"""Files of known places, as the programs write them: the poses that they mean, by formulas of those programs' own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from small_room import pose_at

from service.device_readings import DeviceReadings, GpsPosition, Heading
from service.errors import InvalidRequest
from service.geodesy import enu_from_geographic
from service.geometry import look_at, quat_from_rotation, so3_exp
from service.photos.exif_gps import exif_place, with_readings
from service.photos.images import open_photo, query_of
from service.registration.gathering import GatherOptions, LocalizedPhoto, gathered
from service.registration.known_places import exif_places, place_table, scene_points, trajectory_places
from service.registration.known_places.known_place import KnownPlace, KnownPlaces, in_metres, observation_of
from service.registration.known_places.reading import read_places
from service.types import Pose, SceneInfo

FLIP = np.diag([1.0, -1.0, -1.0])
POSE = look_at(np.array([1.0, 2.0, 0.5]), np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]))
R = POSE.world_from_camera[:3, :3]
INFO = SceneInfo("hall", "Hall", "ab" * 32, "ply")


def written(tmp_path: Path, name: str, content: object) -> Path:
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), "utf-8")
    return path


def arkit() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R @ FLIP, POSE.position_in_world
    return matrix


def test_a_table_of_positions_and_poses(tmp_path):
    w, x, y, z = quat_from_rotation(R)
    rows = "\ufeffname, x,y,z,qw,qx,qy,qz,sigma_m", f"a.jpg,1,2,0.5,{w},{x},{y},{z},0.1", "b.jpg,0,0,1,,,,,"
    known = read_places(written(tmp_path, "p.csv", "\n".join(rows)))
    first, second = known.places
    assert first.position == pytest.approx([1, 2, 0.5])
    assert first.target_from_camera == pytest.approx(R)
    assert first.covariance == pytest.approx(0.01 * np.eye(3))
    assert second.target_from_camera is None
    assert second.covariance is None
    rows = [{"name": "a", "latitude": 47, "longitude": 8, "height": 400, "heading_deg": 90}]
    known = read_places(written(tmp_path, "p.json", rows))
    assert known.is_geographic
    assert known.places[0].heading == pytest.approx(np.pi / 2)
    places = [{"name": "a", "x": 1, "y": 2, "z": 3}]
    known = read_places(written(tmp_path, "q.json", {"up": [0, 0, 2], "places": places}))
    assert known.up == (0, 0, 1)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("name,x,y,z\na.jpg,1,2,\n", "has x, but no z"),
        ("name,x,y,z\na.jpg,1,2,north\n", "must be numbers"),
        ("name,x,y,z\na.jpg,1,2,nan\n", "finite"),
        ("name,latitude,longitude,height\na,91,0,0\n", "latitude must lie"),
        ("name,latitude,longitude,height\na,0,181,0\n", "latitude must lie"),
        ("name,latitude,longitude,height\na,0,-181,0\n", "latitude must lie"),
        ("name,x,y,z,qw,qx,qy,qz\na,1,2,3,1,1,0,0\n", "length 1"),
        ("name,x,y,z,sigma_m\na,1,2,3,0\n", "at least"),
        ("name,x,y,z,colour\na,1,2,3,red\n", "unknown key 'colour'"),
        ("[{]", "not JSON"),
        ("[1]", "needs a 'name'"),
        ("just text", "not a file of known places"),
        ('{"frames": []}', "list of frames"),
        ('{"frames": [{"file_path": "a", "transform_matrix": [[1]]}]}', "rigid 4x4"),
        ("1 2 3 4 0 0 0 1\n0 2 3 4 0 0 0 1\n", "ascend"),
    ],
)
def test_a_fault_is_told_with_its_place(tmp_path, content, complaint):
    with pytest.raises(InvalidRequest, match=complaint):
        read_places(written(tmp_path, "p.txt", content))


def test_an_ar_recorder_writes_arkits_camera_transform(tmp_path):
    """nerfcapture: one pose a frame, each with its intrinsics; OpenGL's axes, y up."""
    frame = {
        "file_path": "images/0", "transform_matrix": arkit().tolist(), "timestamp": 1.5, "depth_path": "d.png",
        "fl_x": 1400.0, "fl_y": 1400.0, "cx": 960.0, "cy": 720.0, "w": 1920, "h": 1440,
    }  # fmt: skip
    known = read_places(written(tmp_path, "transforms.json", {"frames": [frame], "fl_x": 1.0}))
    place = known.places[0]
    assert place.target_from_camera == pytest.approx(R)
    assert place.position == pytest.approx(POSE.position_in_world)
    assert (place.time_s, place.intrinsics.fx, known.up) == (1.5, 1400.0, (0, 1, 0))
    assert known.drift == 0.01


def test_record3d_writes_quaternions_scalar_last(tmp_path):
    w, x, y, z = quat_from_rotation(R @ FLIP)
    k = [1400, 0, 0, 0, 1401, 0, 960, 720, 1]  # column by column
    data = {"K": k, "w": 1920, "h": 1440, "fps": 60, "poses": [[x, y, z, w, 1, 2, 0.5], [x, y, z, w, 3, 2, 0.5]]}
    known = read_places(written(tmp_path, "metadata", data))
    assert known.places[1].name == "1.jpg"
    assert known.places[0].target_from_camera == pytest.approx(R)
    assert known.places[1].position == pytest.approx([3, 2, 0.5])
    assert (known.places[0].intrinsics.fy, known.places[0].intrinsics.cy) == (1401, 720)
    assert known.places[1].time_s == pytest.approx(1 / 60)


def test_a_colmap_model(tmp_path):
    w, x, y, z = quat_from_rotation(R.T)
    shift = -R.T @ POSE.position_in_world
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    line = f"1 {w} {x} {y} {z} {shift[0]} {shift[1]} {shift[2]} 1 a b.jpg\n\n"
    (tmp_path / "sparse" / "0" / "images.txt").write_text(line)
    (place,) = read_places(tmp_path).places
    assert place.name == "a b.jpg"
    assert place.position == pytest.approx(POSE.position_in_world)
    assert place.target_from_camera == pytest.approx(R)
    with pytest.raises(InvalidRequest, match="no COLMAP model"):
        read_places(tmp_path / "sparse")


def test_a_trajectory_is_interpolated_by_time(tmp_path):
    turn = so3_exp(np.array([0.0, 0.0, 0.4]))
    lines = ["# time x y z qx qy qz qw"]
    for time, rotation, at in ((10.0, R, 0.0), (10.5, turn @ R, 2.0), (20.0, R, 9.0)):
        w, x, y, z = quat_from_rotation(rotation)
        lines.append(f"{time} {at} 1 2 {x} {y} {z} {w}")
    known = read_places(written(tmp_path, "trajectory.txt", "\n".join(lines)))
    place = trajectory_places.at_time(known, 10.25, "a.jpg")
    assert place.position == pytest.approx([1, 1, 2])
    assert place.target_from_camera == pytest.approx(so3_exp(np.array([0.0, 0.0, 0.2])) @ R)
    for time in (9.0, 15.0, 21.0):
        with pytest.raises(InvalidRequest, match="no pose at"):
            trajectory_places.at_time(known, time, "a.jpg")


def with_gps(tags: dict) -> bytes:
    import io

    exif = Image.Exif()
    exif.get_ifd(0x8825).update(tags)
    file = io.BytesIO()
    Image.new("RGB", (32, 24)).save(file, "jpeg", exif=exif)
    return file.getvalue()


def test_gps_in_exif_with_altitude_and_heading():
    tags = {
        1: "S",
        2: (47.0, 22.0, 30.0),
        3: "W",
        4: (8.0, 30.0, 0.0),
        5: b"\x00",
        6: 408.5,
        16: "T",
        17: 450.0,
        31: 3.0,
    }
    known = exif_places.read([("a", open_photo(with_gps(tags)).gps), ("b", {})], 47.5)
    (place,) = known.places
    assert place.position == pytest.approx([-47.375, -8.5, 456.0])
    assert place.heading == pytest.approx(np.pi / 2)
    assert np.sqrt(place.covariance[0, 0]) == pytest.approx(3)
    assert not known.warnings
    assert "above the sea" in exif_places.read([("a", tags)], None).warnings[0]
    hostile = {1: "N", 2: "x", 3: "E", 4: (1, 2), 6: b"?"}
    assert exif_places.read([("a", hostile)], 0.0).places == ()
    assert exif_places.read([("a", {2: (0, 0, 0), 4: (0, 0, 0)})], 0.0).places == ()


PLACE = {1: "N", 2: (47, 0, 0), 3: "E", 4: (8, 0, 0)}
"""By the numbers that EXIF 2.32 gives the tags."""


@pytest.mark.parametrize(
    ("tags", "latitude", "longitude"),
    [
        ({2: (90, 0, 0), 4: (180, 0, 0)}, 90.0, 180.0), ({2: (90, 0, 1)}, None, None), ({4: (180, 0, 1)}, None, None),
        ({1: "south", 2: (47, 30, 36), 3: "w", 4: (8, 6, 0)}, -47.51, -8.1), ({2: (-1, 0, 0)}, None, None),
        ({2: (0, 0, 0)}, 0.0, 8.0), ({4: (0, 0, 0)}, 47.0, 0.0), ({2: (0, 0, 0), 4: (0, 0, 0)}, None, None),
        ({2: (0, 0, 36), 4: (0, 0, 0)}, 0.01, 0.0), ({2: (47, 0)}, None, None), ({4: (8, 0, float("nan"))}, None, None),
    ],
)  # fmt: skip
def test_a_place_is_in_degrees_within_the_earths(tags, latitude, longitude):
    found = exif_place(PLACE | tags)
    if latitude is None:
        assert found is None
    else:
        assert found is not None
        assert (found.latitude_deg, found.longitude_deg) == pytest.approx((latitude, longitude))


@pytest.mark.parametrize(
    ("tags", "told"),
    [
        ({}, {"sigma_m": 5.0, "altitude_m": None, "heading_deg": None, "heading_sigma_deg": 15.0}),
        ({31: 0.01}, {"sigma_m": 0.01}), ({31: 0.009}, {"sigma_m": 5.0}), ({31: 1000}, {"sigma_m": 1000.0}),
        ({31: 1001}, {"sigma_m": 5.0}), ({6: 12.5}, {"altitude_m": 12.5}), ({5: 1, 6: 12.5}, {"altitude_m": -12.5}),
        ({5: b"\x01", 6: 2}, {"altitude_m": -2.0}), ({5: 0, 6: 2}, {"altitude_m": 2.0}),
        ({17: 370}, {"heading_deg": 10.0}),
        ({16: "m", 17: 360}, {"heading_deg": 0.0, "heading_sigma_deg": 25.0}), ({17: "north"}, {"heading_deg": None}),
    ],
)  # fmt: skip
def test_what_exif_tells_beside_the_place(tags, told):
    found = exif_place(PLACE | tags)
    assert {name: getattr(found, name) for name in told} == told


@pytest.mark.parametrize(
    ("altitude", "error", "height", "sigma"),
    [
        (99_999.0, 3.0, 99_999.0, (10.0, 30.0)), (100_000.0, 3.0, None, (10.0, 30.0)),
        (-100_000.0, 3.0, None, (10.0, 30.0)),
        (408.5, 40.0, 408.5, (40.0, 30.0)),
    ],
)  # fmt: skip
def test_a_height_by_exif_is_as_uncertain_as_the_receiver_and_the_geoid(altitude, error, height, sigma):
    opened: Any = SimpleNamespace(gps=PLACE | {6: altitude, 31: error})
    found = with_readings(query_of(np.zeros((240, 320, 3), np.uint8)), None, opened).readings
    assert found.gps == GpsPosition(47.0, 8.0, error, height, float(np.hypot(*sigma)))
    assert found.heading is None


def test_a_photo_s_own_place_counts_only_where_it_is_asked_for():
    tags = {1: "N", 2: (47.0, 0.0, 0.0), 3: "E", 4: (8.0, 30.0, 0.0), 5: b"\x00", 6: 408.5, 16: "M", 17: 90.0}
    opened = open_photo(with_gps(tags))
    query = query_of(np.zeros((240, 320, 3), np.uint8))
    assert with_readings(query, None).readings is None
    found = with_readings(query, DeviceReadings(heading=Heading(10.0)), opened).readings
    # By magnetic north 25 degrees, unless the request has a heading of its own; the geoid isn't known.
    assert found.gps == GpsPosition(47.0, 8.5, 5.0, 408.5, float(np.hypot(10, 30)))
    assert found.heading == Heading(10.0)
    assert with_readings(query, None, opened).readings.heading == Heading(90.0, 25.0)
    nowhere = with_readings(query, None, open_photo(with_gps({6: 1e7})))
    assert nowhere.readings.gps is None
    assert "no position" in nowhere.warnings[-1]


def test_geographic_places_become_metres_east_north_up():
    places = [KnownPlace(n, np.array(p)) for n, p in (("a", [47.0, 8.0, 400.0]), ("b", [47.0, 8.001, 410.0]))]
    known, origin = in_metres(KnownPlaces("table", tuple(places), is_geographic=True))
    assert origin.latitude_deg == pytest.approx(47.0)
    a, b = (place.position for place in known.places)
    # A degree of longitude at 47 degrees north is 76,056 m on the ellipsoid.
    assert b - a == pytest.approx([76.056, 0, 10], abs=0.02)
    assert enu_from_geographic(np.array([47.0, 8.0, 0.0]), np.array([[47.0, 8.0, 5.0]])) == pytest.approx(
        np.array([[0, 0, 5]]), abs=1e-8
    )


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_photo_that_exif_turns_has_the_pose_of_its_stored_form(orientation):
    """A ray through a pixel has one direction, whichever way the photo is held."""
    stored = np.array([0.3, -0.2, 1.0])
    x, y, z = stored
    upright = {1: [x, y, z], 3: [-x, -y, z], 6: [-y, x, z], 8: [y, -x, z]}[orientation]
    seen = observation_of(KnownPlace("a", None, target_from_camera=R), "a", Pose(np.eye(4)), None, orientation)
    assert seen.target_from_camera @ upright == pytest.approx(R @ stored)


def test_points_lengths_and_a_floor():
    data = {
        "points": [{"in_world": [1, 2, 3], "x": 4, "y": 5, "z": 6, "sigma_m": 0.1}],
        "lengths": [{"from_in_world": [0, 0, 0], "to_in_world": [0, 0, 2], "metres": 5}],
        "floor": [[0, 0, 0], [1, 0, 0], [0, 0, 1]],
    }
    points = scene_points.read(data, "points")
    assert points.lengths[0].units == 2
    up, heights = scene_points.floor_evidence(points.floor, np.array([0.0, -3.0, 0.0]), (0, 0, 1))
    assert up.in_world == pytest.approx([0, -1, 0])
    assert len(heights) == 3
    evidence, origin = gathered(
        KnownPlaces("points", ()), [], points, INFO, np.array([0.0, -3.0, 0.0]), GatherOptions()
    )
    assert origin is None
    assert evidence.observations[0].position == pytest.approx([4, 5, 6])
    lengths, floor = ({name: data[name]} for name in ("lengths", "floor"))
    world = replace(INFO, up_in_world=(1.0, 0.0, 0.0))
    for read, given, up, directions in (
        (floor, None, (0, 0, 1), [[0, -1, 0], [1, 0, 0]]), (floor, (0.0, 1.0, 0.0), (0, 1, 0), [[0, -1, 0], [1, 0, 0]]),
        (lengths, None, (0, 0, 1), [[1, 0, 0]]), (lengths, (0.0, 1.0, 0.0), (0, 1, 0), [[1, 0, 0]]),
        ({"points": data["points"]}, None, None, []),
    ):  # fmt: skip
        picked, above = scene_points.read(read, "points"), np.array([0.0, -3.0, 0.0])
        found, _ = gathered(KnownPlaces("points", ()), [], picked, world, above, GatherOptions(given))
        assert found.up == (None if up is None else pytest.approx(up))
        seen = [each.in_world for each in found.directions]
        assert np.reshape(seen, (-1, 3)) == pytest.approx(np.reshape(directions, (-1, 3)))
        assert all(each.in_target == pytest.approx(up) for each in found.directions)
        assert len(found.heights) == (3 if read is floor else 0)


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        ({}, "some of the keys"),
        ({"point": []}, "some of the keys"),
        ({"points": [{"in_world": [1, 2], "x": 1, "y": 1, "z": 1}]}, "three finite"),
        ({"lengths": [{"from_in_world": [0, 0, 0], "to_in_world": [0, 0, 0], "metres": 1}]}, "different points"),
        ({"lengths": [{"metres": 1}]}, "must have"),
        ({"floor": 3}, "list"),
    ],
)
def test_faulty_points_are_told(data, complaint):
    with pytest.raises(InvalidRequest, match=complaint):
        scene_points.read(data, "points")


@pytest.mark.parametrize(
    ("metres", "sigma", "taken"),
    [
        (9.9e6, None, True), (1.1e7, 1.0, False), (1.1e-6, 1e-6, True), (0.9e-6, 1e-6, False), (1.0, 9.9e6, True),
        (1.0, 1.1e7, False), (1.0, 1.1e-7, True), (1.0, 0.9e-7, False), (1.0, "far", False),
    ],
)  # fmt: skip
def test_a_length_is_taken_within_its_bounds(metres, sigma, taken):
    told = {"from_in_world": [0, 0, 0], "to_in_world": [0, 0, 1e-9], "metres": metres}
    data = {"lengths": [told | ({} if sigma is None else {"sigma_m": sigma})]}
    if not taken:
        with pytest.raises(InvalidRequest, match="lengths, 1: must be a positive length"):
            scene_points.read(data, "points")
        return
    (length,) = scene_points.read(data, "points").lengths
    assert (length.metres, length.sigma) == (metres, 0.01 * metres if sigma is None else sigma)


def test_a_floor_on_a_line_is_refused():
    with pytest.raises(InvalidRequest, match="line"):
        scene_points.floor_evidence(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.ones(3), (0, 0, 1))


def test_photos_on_earth_and_points_in_metres_do_not_mix():
    known = KnownPlaces("exif", (), is_geographic=True)
    photo = LocalizedPhoto("a", KnownPlace("a", np.array([47.0, 8.0, 400.0])), pose_at(0.0, 0.0), None)
    points = scene_points.read({"points": [{"in_world": [1, 2, 3], "x": 4, "y": 5, "z": 6}]}, "points")
    with pytest.raises(InvalidRequest, match="both be on Earth"):
        gathered(known, [photo], points, INFO, np.zeros(3), GatherOptions())


def test_a_table_is_recognized_by_its_head():
    assert place_table.accepts("name,x,y,z\n", "p.csv")
    assert not place_table.accepts("time,x\n", "p.csv")
