"""Files, places, jobs and figures exactly at a limit, as `test_exact_bounds.py` has it for poses."""

from __future__ import annotations

import asyncio
import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from starlette.websockets import WebSocketDisconnect
from test_scene_placement import MB, placement, run_job

from service.accuracy import Accuracy
from service.bench import evaluate, field_queries, field_table, gpu_equality, live, live_odometry, rigs
from service.bench.modified_photo import _edge_is_inside
from service.bench.peer.comparison import PEERS
from service.bench.peer.photo_matching import MATCHING, PhotoFeatures, matched, pairs_of_cameras
from service.bench.pose_files import _has_intrinsics, _pose_of
from service.bench.pose_metrics import COARSE, Outcome
from service.device_memory import DeviceMemory
from service.disk_cache import evict, mark_used
from service.errors import CorruptScene, InvalidAccuracy, InvalidIntrinsics, InvalidPrior, InvalidRequest
from service.geometry import look_at, moved, project, reprojection_error_px
from service.jobs.left_over_photos import LeftOverPhotos
from service.lenses.lens_estimate import LENS_MEMORY, LensEstimate, LensMeasurement, Viewpoint, updated
from service.live.mailbox import Mailbox
from service.photos import exif_gps
from service.photos.camera_identity import EXIF_FOCAL, CameraIdentity, exif_focal_prior
from service.photos.images import _target, encode_image, resized
from service.registration import register
from service.registration.known_places import place_table, scene_points, trajectory_places
from service.registration.known_places.known_place import KnownPlaces
from service.registration.observations import Evidence
from service.results import Status
from service.scene_formats import manifest, normalizations, side_file, training_files
from service.types import BoxPrior, Camera, GaussianPosePrior, GeoAnchor, Intrinsics, NamedCamera, Pose
from service.web.routes import live as live_route

HERE = Pose(np.eye(4))
LENS = Intrinsics(320, 240, 250.0, 250.0, 160.0, 120.0)


def at(x: float = 0.0) -> Pose:
    return moved(HERE, np.array([0, 0, 0, x, 0, 0]))


# ------------------------------------------------------------------ a scene's manifest


@pytest.mark.parametrize(
    ("key", "value", "read"),
    [
        ("name", "x" * 200, True), ("name", "x" * 201, False), ("name", "x", True), ("name", " ", False),
        ("file", "x" * 200, True), ("file", "\u00e9" * 127 + "x", True), ("file", "\u00e9" * 128, False),
        ("file", "a/b", False),
        ("background", [0, 0.5, 1], True), ("background", [0, 0, 1.001], False), ("background", [-0.001, 0, 0], False),
        ("up", [1e-6, 0, 0], True), ("up", [0.99e-6, 0, 0], False),
        ("metres_per_unit", 1e-9, True), ("metres_per_unit", 0, False),
        ("training_size", [1, 1], True), ("training_size", [100_000, 100_000], True), ("training_size", [0, 1], False),
        ("training_size", [1, 100_001], False), ("training_size", [1.5, 2], False),
        ("world_from_scene", np.diag([2e-6, 2e-6, 2e-6, 1]).tolist(), True),
        ("world_from_scene", np.diag([0.5e-6, 0.5e-6, 0.5e-6, 1]).tolist(), False),
        ("world_from_scene", np.diag([2e6, 2e6, 2e6, 1]).tolist(), False),
        ("world_from_scene", np.diag([1, 1, 1.0002, 1]).tolist(), False),
        ("world_from_scene", np.diag([1, 1, 1.00005, 1]).tolist(), True),
        ("world_from_scene", np.diag([1, 1, -1.0, 1]).tolist(), False),
        ("world_from_scene", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1e-12, 1]], False),
        ("convention", "opencv", True), ("convention", "opencl", False),
    ],
)  # fmt: skip
def test_an_entry_of_a_manifest_is_read_up_to_its_limits(key: str, value: Any, read: bool, tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text(json.dumps({key: value}))
    if read:
        assert getattr(manifest.read_manifest(tmp_path), key) is not None
    else:
        with pytest.raises(CorruptScene, match=key):
            manifest.read_manifest(tmp_path)


def test_a_place_on_earth_is_read_up_to_the_poles_the_date_line_and_20_km() -> None:
    given = {"latitude": 90, "longitude": -180, "height": 2e4, "enu_from_world": np.eye(4).tolist()}
    found = manifest._geo_anchor("geo_anchor", given)
    assert isinstance(found, GeoAnchor)
    assert (found.latitude_deg, found.longitude_deg, found.height_m) == (90, -180, 2e4)
    manifest._geo_anchor("geo_anchor", given | {"latitude": -90, "longitude": 180, "height": -2e4})
    for name, value in (("latitude", 90.001), ("longitude", -180.001), ("height", -20000.001)):
        with pytest.raises(CorruptScene, match=name):
            manifest._geo_anchor("geo_anchor", given | {name: value})
    with pytest.raises(CorruptScene, match="exactly the keys"):
        manifest._geo_anchor("geo_anchor", {name: given[name] for name in ("latitude", "longitude", "height")})


def test_a_file_of_json_may_be_as_large_as_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.json").write_text('{"a": 1}')
    for limit, read in ((8, True), (7, False)):
        monkeypatch.setattr(manifest, "MAX_JSON_BYTES", limit)
        if read:
            assert manifest.read_json(tmp_path / "a.json") == {"a": 1}
        else:
            with pytest.raises(CorruptScene, match="larger than 7 bytes"):
                manifest.read_json(tmp_path / "a.json")


def test_a_copy_of_an_object_is_compared_anew_after_two_seconds_or_a_change(tmp_path: Path, monkeypatch) -> None:
    asked: list[str] = []
    objects = {"scenes/a/anchors.json": b"first"}
    store = SimpleNamespace(get=lambda key: asked.append(key) or objects.get(key), put=objects.__setitem__)
    remote: Any = SimpleNamespace(store=store, prefix="scenes/a/")
    now = [100.0]
    monkeypatch.setattr(side_file.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(side_file, "_REFRESHED", {})
    file = side_file.SideFile(tmp_path / "scenes" / "a", "anchors.json", None, remote)
    assert file.path.read_text() == "first"
    objects["scenes/a/anchors.json"] = b"second"
    now[0] = 101.999
    assert file.path.read_text() == "first"
    now[0] = 102.0
    assert file.path.read_text() == "second"
    # Who changes it here reads what was changed at once.
    objects["scenes/a/anchors.json"] = b"third"
    file.forget_copy()
    assert file.path.read_text() == "third"
    file.write("fourth")
    assert file.path.read_text() == "fourth"
    before = os.stat(file.path).st_mtime_ns
    now[0] += 2
    assert os.stat(file.path).st_mtime_ns == before  # the same bytes are not written again
    del objects["scenes/a/anchors.json"]
    now[0] += 2
    assert not file.path.is_file()
    assert asked == ["scenes/a/anchors.json"] * 6


# ------------------------------------------------------------------ values


def test_values_at_their_limits_are_taken() -> None:
    Intrinsics(100_000, 1, 1.0, 1.0, 0.0, 0.0)
    for width, focal in ((100_001, 1.0), (0, 1.0), (1, 1e7), (1, 0.0)):
        with pytest.raises(InvalidIntrinsics):
            Intrinsics(width, 1, focal, 1.0, 0.0, 0.0)
    for lower, upper in ((0.0, 0.0), (1.0, 0.0)):
        with pytest.raises(InvalidPrior):
            BoxPrior(np.array([lower, 0, 0]), np.array([upper, 1.0, 1.0]))
    for variance in (0.0, -1.0):
        with pytest.raises(InvalidPrior):
            GaussianPosePrior(HERE, np.diag([variance, 1, 1, 1, 1, 1.0]))
    Accuracy(deg=180.0)
    for given in ({"deg": 180.001}, {"deg": 0.0}, {"units": 0.0}, {"share": -1.0}):
        with pytest.raises(InvalidAccuracy):
            Accuracy(**given)


def test_a_point_in_the_cameras_plane_has_no_error_and_a_camera_along_up_has_an_upright() -> None:
    points = np.array([[0, 0, 1e-9], [0, 0, 2e-9]])
    found = reprojection_error_px(np.array([[160.0, 120.0]] * 2), points, LENS, HERE)
    assert found.tolist() == [np.inf, 0.0]
    assert project(np.array([[0.0, 0, 1.0]]), LENS).tolist() == [[160.0, 120.0]]
    pose = look_at(np.zeros(3), np.array([0.0, 0, 1.0]), np.array([0.0, 0, 1.0]))
    assert np.allclose(pose.world_from_camera[:3, :3] @ pose.world_from_camera[:3, :3].T, np.eye(3))
    assert pose.axis_in_world.tolist() == [0.0, 0.0, 1.0]


def test_a_photo_contradicts_a_lens_only_beyond_four_sigmas() -> None:
    seen = Viewpoint("a", HERE, 10.0)
    # Exactly representable: 0.75 and 1, hence 1.25, and an innovation of four times that.
    before = LensEstimate((0.0,) * 4, (0.75,) * 4, 5, 5, seen)
    config = replace(LENS_MEMORY, photo_sigma=(0.0,) * 4, outlier_sigmas=4.0)
    for innovation, contradicts in ((5.0, False), (5.001, True)):
        found = LensMeasurement((innovation, 0.0, 0.0, 0.0), (1.0,) * 4, replace(seen, scene_sha256="b"))
        assert (updated(before, found, config).viewpoints == 0) is contradicts
    # As far away as a twentieth of the distance, 10, is the same place.
    assert not seen.differs(replace(seen, pose=at(0.5)), replace(LENS_MEMORY, new_view_share=0.05))
    assert before.is_tested(replace(LENS_MEMORY, min_viewpoints=5))
    assert not before.is_tested(replace(LENS_MEMORY, min_viewpoints=6))


# ------------------------------------------------------------------ photos


def test_a_photo_of_its_own_size_is_interpolated_and_a_smaller_one_averaged() -> None:
    image = np.zeros((4, 4, 3), np.float32)
    image[::2] = 1.0
    assert np.array_equal(resized(image, 4, 4), image)
    assert resized(image, 2, 2) == pytest.approx(0.5)
    # As many pixels in another shape are interpolated: between two rows, not their average.
    assert resized(image, 8, 2)[0, 0, 0] == pytest.approx(0.5)
    assert resized(image, 2, 8)[0, 0, 0] == 1.0


def test_a_photo_is_reduced_to_the_long_side_and_never_enlarged() -> None:
    assert _target((2000, 1000), 1000) == (1000, 500)
    assert _target((1000, 500), 1000) == (1000, 500)
    assert _target((500, 250), 1000) == (500, 250)


def test_a_tag_at_the_limit_of_lenses_is_one_and_a_crop_to_half_of_the_frame_was_hardly_resized() -> None:
    identity = CameraIdentity(3600, 2400, 1, focal_35mm=36.0)
    # A factor of 1: the logarithm of the limit is exact there.
    assert exif_focal_prior(identity, replace(EXIF_FOCAL, max_focal=1.0))
    assert not exif_focal_prior(identity, replace(EXIF_FOCAL, max_focal=0.999))
    whole = replace(identity, exif_width=3600, exif_height=2400)
    assert not whole.is_cropped
    for side, probability in ((1200, 0.25), (1199, 0.75)):
        cropped = replace(whole, width=side, height=side)
        assert cropped.is_cropped
        modes = exif_focal_prior(
            cropped, replace(EXIF_FOCAL, resampled_probability=(0.25, 0.75), longer_probability=0.5)
        )
        # Of the tag alone, the longer ones and the resized ones.
        weights = sorted([0.5 * (1 - probability), 0.5, probability])
        assert sorted(mode.probability for mode in modes) == pytest.approx([w / sum(weights) for w in weights])
    assert not replace(whole, width=4000, height=2400).is_cropped
    # A camera that wrote no digital zoom, or 1, has no other mode for it.
    assert len(exif_focal_prior(identity)) == len(exif_focal_prior(replace(identity, digital_zoom=1.01))) - 1


@pytest.mark.parametrize(("degrees", "known"), [(90, True), (90.0001, False), (0, True), (-0.0001, False)])
def test_degrees_in_exif_are_within_the_bound(degrees: float, known: bool) -> None:
    found = exif_gps._degrees((degrees, 0, 0), "N", "S", 90)
    assert found == (degrees if known else None)
    assert exif_gps._degrees((10, 30, 36), "S", "S", 90) == pytest.approx(-10.51)


# ------------------------------------------------------------------ known places


def test_places_are_read_up_to_the_poles_and_the_date_line() -> None:
    def place(latitude: float, longitude: float) -> Any:
        return place_table._place({"name": "a", "latitude": latitude, "longitude": longitude, "height": 0.0}, "a")

    assert place(90.0, 180.0)[1]
    assert place(-90.0, -180.0)[1]
    for latitude, longitude in ((90.001, 0.0), (0.0, -180.001)):
        with pytest.raises(InvalidRequest, match="latitude must lie"):
            place(latitude, longitude)
    assert place_table.unit_vector([2e-9, 0, 0], "up") == (1.0, 0.0, 0.0)
    assert place_table.unit_vector([0, 0, -9e8], "up") == (0.0, 0.0, -1.0)
    for vector in ([1e-9, 0, 0], [0, 1e9, 0], [1, 2], "up", None):
        with pytest.raises(InvalidRequest, match="three numbers"):
            place_table.unit_vector(vector, "up")


def test_points_and_lengths_are_read_up_to_their_limits() -> None:
    most = place_table.MAX_METRES
    assert scene_points._vector([most, 0, -most], "p").tolist() == [most, 0, -most]
    with pytest.raises(InvalidRequest, match="finite numbers up to"):
        scene_points._vector([np.nextafter(most, np.inf), 0, 0], "p")
    whole = [0] * scene_points.MAX_POINTS
    assert scene_points._list({"points": whole}, "points", "file") is whole
    with pytest.raises(InvalidRequest, match="at most"):
        scene_points._list({"points": [*whole, 0]}, "points", "file")
    given = {"from_in_world": [0, 0, 0], "to_in_world": [1, 0, 0]}
    for metres, sigma, taken in (
        (2e-6, 2e-7, True), (1e-6, 2e-7, False), (9e6, 9e6, True), (1e7, 1.0, False), (1.0, 1e-7, False),
        (1.0, 1e7, False),
    ):  # fmt: skip
        value = given | {"metres": metres, "sigma_m": sigma}
        if taken:
            found = scene_points._length(value, "length")
            assert (found.metres, found.sigma) == (metres, sigma)
        else:
            with pytest.raises(InvalidRequest, match="positive length"):
                scene_points._length(value, "length")
    with pytest.raises(InvalidRequest, match="must have"):
        scene_points._length(given, "length")


def test_a_trajectory_is_interpolated_over_the_longest_gap_and_known_at_its_ends() -> None:
    gap = trajectory_places.MAX_GAP_S
    places = tuple(
        place_table.KnownPlace("", np.array([time_s, 0, 0]), None, np.eye(3), time_s=time_s)
        for time_s in (0.0, gap, 2 * gap + 1e-3)
    )
    known = KnownPlaces("trajectory", places)
    for time_s in (0.0, 0.25 * gap, gap, 2 * gap + 1e-3):
        found = trajectory_places.at_time(known, time_s, "a")
        assert found.position is not None
        assert found.position[0] == pytest.approx(time_s)
    for time_s in (-1e-6, 1.5 * gap, 2 * gap + 2e-3):
        with pytest.raises(InvalidRequest, match="no pose at"):
            trajectory_places.at_time(known, time_s, "a")


# ------------------------------------------------------------------ memory and queues


def test_what_fits_exactly_fits(tmp_path: Path) -> None:
    table = placement(budget=300 * MB, x=100 * MB, y=200 * MB, z=201 * MB)
    assert table.could_hold(["x", "y"])
    assert not table.could_hold(["x", "z"])
    memory = DeviceMemory()
    memory._taken.append(60.0)
    object.__setattr__(memory, "_free_bytes", 0.0)
    room = memory.budget_bytes - 60.0
    assert memory._fits(room)
    assert not memory._fits(room + 1)
    for number, name in enumerate(("view-index-a", "view-index-b", "view-index-c")):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "views").write_bytes(bytes(100))
        os.utime(folder, (1000 + number, 1000 + number))
    assert evict(tmp_path, 300) == 0
    assert evict(tmp_path, 200) == 1
    assert not (tmp_path / "view-index-a").exists()
    mark_used(tmp_path / "view-index-b")
    assert evict(tmp_path, 199) == 1
    assert (tmp_path / "view-index-b").exists()


def test_of_equal_replicas_the_first_is_chosen_and_a_copy_goes_where_less_than_half_wait() -> None:
    table = placement(replicas="ab")
    run_job(table, "x", keep=True)
    for _ in range(3):
        table.take(table.choose(("x",)), ("x",))
    table._queues["x"] = table._config.crowded
    assert table.extra_copy("x") is None
    table._queues["x"] = 1.001 * table._config.crowded
    # Four jobs where the scene is: a replica with two has half as many, which is not less.
    for jobs, copied in ((2, False), (1, True)):
        table._replicas["b"].jobs = jobs
        assert (table.extra_copy("x") is not None) is copied
        table._queues["x"] = 2 * table._config.crowded


def test_an_only_copy_is_missed_for_fewer_decisions_than_ten_loads_take_jobs() -> None:
    """A load of one second is ten jobs: a hundred."""
    table = placement(x=0)
    run_job(table, "x")
    for since, missed in ((99, True), (100, False)):
        table._decisions = table.copies("x")["a"].used + since
        assert table._is_missed("x") is missed


def test_left_over_photos_are_looked_for_as_soon_as_it_is_time(monkeypatch: pytest.MonkeyPatch) -> None:
    left: Any = LeftOverPhotos.__new__(LeftOverPhotos)
    left._next_at, left._suspects, left._store = 10.0, set(), SimpleNamespace(ids=set)
    looked: list[float] = []
    for now in (9.999, 10.0, 10.001):
        monkeypatch.setattr("service.jobs.left_over_photos.time", SimpleNamespace(monotonic=lambda now=now: now))
        monkeypatch.setattr(LeftOverPhotos, "_found", lambda self, now=now: looked.append(now) or set())
        left.delete_old()
    assert looked == [10.0]


# ------------------------------------------------------------------ a live session


class Steps:
    """Messages at their times, then the client leaves."""

    def __init__(self, *messages: tuple[float, str | bytes]) -> None:
        self.now, self._left = 0.0, list(messages)

    def time(self) -> float:
        return self.now

    async def receive(self) -> dict[str, Any]:
        if not self._left:
            return {"type": "websocket.disconnect"}
        self.now, message = self._left.pop(0)
        return {"type": "websocket.receive", "text" if isinstance(message, str) else "bytes": message}


def session_of(steps: Steps, **settings: Any) -> Any:
    session: Any = live_route._Session.__new__(live_route._Session)
    session._loop = session._socket = steps
    session._settings = SimpleNamespace(**{"live_fps": 2, "live_frame_bytes": 4, "live_idle_s": 8.0} | settings)
    session._heard_at, session._caller, session._mailbox = 0.0, None, Mailbox()
    return session


@pytest.mark.parametrize(
    ("times", "used"),
    [
        ([0.0] * 4, 4), ([0.0] * 5, 4),  # two seconds of two frames
        ([0.0] * 4 + [0.5, 1.0, 1.5], 7), ([0.0] * 4 + [0.5, 0.5], 5),
        ([0.0] * 4 + [9.0] * 5, 8),  # no more than that is saved up
    ],
)  # fmt: skip
def test_frames_are_limited_on_average_over_two_seconds(times, used, monkeypatch) -> None:
    taken: list[Any] = []
    monkeypatch.setattr(live_route, "read_frame", lambda message, last: taken.append(last) or SimpleNamespace(id=1))
    session = session_of(Steps(*((time_s, b"frame"[:4]) for time_s in times)))
    with pytest.raises((live_route._End, WebSocketDisconnect)) as ended:
        asyncio.run(session._frames())
    assert len(taken) == used
    assert taken[0] is None
    assert (getattr(ended.value, "code", None) == live_route.TOO_MANY) is (used < len(times))
    assert session._heard_at == times[min(used, len(times) - 1)]


def test_a_message_of_the_limit_is_received_and_a_text_is_no_frame() -> None:
    for message, received in ((b"1234", True), ("1234", True), (b"12345", False), ("12345", False)):
        session = session_of(Steps((1.0, message)))
        if received:
            assert asyncio.run(session._receive()) == message
        else:
            with pytest.raises(live_route._End, match="at most 4 bytes, not 5"):
                asyncio.run(session._receive())
    with pytest.raises(InvalidRequest, match="binary"):
        asyncio.run(session_of(Steps((1.0, "1234")))._frames())
    with pytest.raises(WebSocketDisconnect):
        asyncio.run(session_of(Steps())._receive())


@pytest.mark.parametrize(("heard_at", "valid", "code"), [(1.0, False, "KEY_GONE"), (0.999, True, "TIMEOUT")])
def test_a_session_ends_without_frames_and_with_its_key(heard_at, valid, code, monkeypatch) -> None:
    slept: list[float] = []

    async def sleep(seconds: float) -> None:
        slept.append(seconds)

    monkeypatch.setattr(live_route.asyncio, "sleep", sleep)
    session = session_of(Steps())
    session._loop.now, session._heard_at = 9.0, heard_at  # after just the time that is allowed, 8 s, or more
    session._caller = "somebody"
    session._state = SimpleNamespace(keys=SimpleNamespace(still_valid=lambda caller: valid))
    with pytest.raises(live_route._End) as ended:
        asyncio.run(session._watch())
    assert ended.value.code == getattr(live_route, code)
    assert slept == [1.0]
    session._settings.live_idle_s, session._heard_at, session._loop.now = 2.0, 0.0, 9.0
    with pytest.raises(live_route._End, match="no frame for 2 s"):
        asyncio.run(session._watch())
    assert slept == [1.0, 0.5]


# ------------------------------------------------------------------ figures of the benches


def test_errors_at_the_bounds_are_within_them_and_of_published_benchmarks_below() -> None:
    exact = Outcome(Status.LOCALIZED, *COARSE, 1.0, 1.0)
    assert exact.success(COARSE)
    assert not exact.false
    for beyond in (replace(exact, rotation_deg=5.001), replace(exact, translation_units=0.0501)):
        assert beyond.false
    for within in (rigs._within, live._within):
        assert within(COARSE, COARSE)
        assert not within((COARSE[0], 0.0501), COARSE)
        assert not within((5.001, 0.0), COARSE)
    bound, degrees = evaluate.BOUNDS[0]
    errors = [
        evaluate.PhotoError("a", bound, 0.0, True),
        evaluate.PhotoError("b", 0.0, degrees, True),
        evaluate.PhotoError("c", 0.99 * bound, 0.99 * degrees, True),
    ]
    assert evaluate.summary(errors, 1.0, None)["recall"][0]["share"] == pytest.approx(1 / 3)


def test_shares_are_told_of_as_many_lines_as_the_least(monkeypatch: pytest.MonkeyPatch) -> None:
    least = field_table.MIN_SHARED
    counts = dict.fromkeys(("queries", "localized", "refused", "wrong", "lost", "unanswerable"), 0)
    figures = counts | dict.fromkeys(("error_deg", "error_units", "focal_error", "k1_error"), None) | {"cpu_ms": 1.0}
    figures |= {name: {} for name in field_table.REFUSALS} | {"in_68": 0.7, "in_95": 1.0}
    for many in (least, least - 1):
        monkeypatch.setattr(
            field_table, "summary", lambda _, n=many: figures | {"with_covariance": n, "answerable": n, "localized": n}
        )
        row = field_table._cells("row", [])
        assert ("100.0 %" in row) is (many == least)
        assert ("70, 100" in row) is (many == least)


def test_a_pose_in_a_file_is_rigid_to_a_hundredth() -> None:
    for scale, read in ((1.0099, True), (1.0101, False), (0.9901, True), (0.9899, False)):
        matrix = np.diag([scale, 1, 1, 1])
        if read:
            assert np.allclose(_pose_of(matrix, "f").world_from_camera, np.eye(4))
        else:
            with pytest.raises(InvalidRequest, match="orthogonal"):
                _pose_of(matrix, "f")
    with pytest.raises(InvalidRequest, match="right-handed"):
        _pose_of(np.diag([1, 1, -1, 1.0]), "f")
    last = np.eye(4)
    last[3, 0] = 2e-6
    with pytest.raises(InvalidRequest, match="last row"):
        _pose_of(last, "f")
    assert [_has_intrinsics(line) for line in ("a PINHOLE 1 2 3 4", "a PINHOLE 1 2 3", "a b c 1 2 3")] == [
        True, False, False,
    ]  # fmt: skip


def test_a_rectangle_whose_edge_lies_on_the_outermost_pixels_is_inside() -> None:
    def shifted(by: float) -> Any:
        return lambda x, y: (x + by, y)

    assert _edge_is_inside(0, 8, 6, shifted(0.0))
    assert not _edge_is_inside(0, 8, 6, shifted(0.01))
    assert not _edge_is_inside(0, 8, 6, shifted(-0.01))
    assert _edge_is_inside(1, 8, 6, shifted(1.0))
    assert not _edge_is_inside(0, 8, 6, lambda x, y: (x, y + 0.01))
    assert not _edge_is_inside(0, 8, 6, lambda x, y: (x, y - 0.01))


def test_a_match_of_the_peer_is_nearer_than_the_bound_and_better_than_the_second() -> None:
    def features(*rows: tuple[float, ...]) -> PhotoFeatures:
        table = np.array(rows, np.float32)
        return PhotoFeatures(np.zeros((len(rows), 2)), table)

    # Squared distances 2 - 2 c: 1 for a cosine of 0.5.
    photo = features((1, 0, 0), (0, 0, 1))
    others = features((0.5, np.sqrt(0.75), 0), (-1, 0, 0))
    for bound, count in ((1.0, 0), (1.01, 1)):
        config = replace(MATCHING, max_distance=bound, ratio=0.9)
        assert len([pair for pair in matched(photo, others, config) if pair[0] == 0]) == count
    # The second has a squared distance of 4: half of that in length.
    for ratio, count in ((0.5, 0), (0.501, 1)):
        config = replace(MATCHING, max_distance=2.0, ratio=ratio)
        assert len([pair for pair in matched(photo, others, config) if pair[0] == 0]) == count
    assert len(matched(features((1, 0, 0)), others)) == len(matched(photo, features((1, 0, 0)))) == 0
    cameras = [Camera(LENS, pose) for pose in (HERE, moved(HERE, np.array([0, np.pi / 2, 0, 0, 0, 0])))]
    for most, pairs in ((90.0, [(0, 1)]), (89.99, [])):
        assert pairs_of_cameras(cameras, replace(MATCHING, max_pair_angle_deg=most)) == pairs


def test_images_are_equal_whose_differences_are_below_the_bounds() -> None:
    ones = np.ones((10, 10), np.float32)
    ours: Any = SimpleNamespace(rgb=np.stack([ones] * 3, 2), alpha=ones, depth=ones, median_depth=ones)
    theirs: Any = SimpleNamespace(rgb=np.stack([0.5 * ones] * 3, 2), alpha=ones, depth=ones, median_depth=3 * ones)
    found = gpu_equality.image_differences(ours, theirs)
    assert found["rgb"] == (0.5, 0.5)
    assert found["alpha"] == (0.0, 0.0)
    assert found["median_depth"] == pytest.approx((2 / gpu_equality.DEPTH_SCALE,) * 2)


def test_what_a_client_hears_as_a_frame_is_taken_shows_that_frame() -> None:
    shots: Any = [SimpleNamespace(time_s=float(k), odom=at(0.25 * k)) for k in range(4)]
    answer: Any = SimpleNamespace(time_s=0.0, world_from_odom=np.eye(4), units_per_odom=1.0)
    shown = live_odometry.displayed(shots, {7: answer}, {7: 2.0})
    assert [pose is not None for pose in shown] == [False, False, True, True]
    assert shown[2].position_in_world[0] == 0.5
    # A step of half a unit, or of half a radian, is none that begins anew.
    for step, anew in ((0.5, 0), (0.501, 1)):
        two: Any = [SimpleNamespace(odom=HERE), SimpleNamespace(odom=at(step))]
        assert live_odometry._segments(two) == [0, anew]


# ------------------------------------------------------------------ photos of training cameras, and registrations


@pytest.mark.parametrize(
    ("photo", "camera", "read"),
    [
        # 1.8 % and 2.2 % from the camera's shape; exactly 2 %.
        ((100, 50), (1000, 509), True), ((100, 50), (1000, 491), True),
        ((100, 50), (1000, 511), False), ((100, 50), (1000, 490), False),
        ((50, 49), (50, 50), False),
    ],
)  # fmt: skip
def test_a_training_photo_has_its_cameras_shape(
    tmp_path: Path, photo: tuple[int, int], camera: tuple[int, int], read: bool
) -> None:
    data = encode_image(np.full((photo[1], photo[0], 3), 128, np.uint8), "png")
    (tmp_path / "a.png").write_bytes(data)
    lens = Intrinsics(*camera, 100.0, 100.0, 0.5 * camera[0], 0.5 * camera[1])
    found = training_files.photos_beside(tmp_path, None)(NamedCamera("a.png", Camera(lens, HERE)))
    assert (found is not None) is read


def test_a_training_photo_may_be_exactly_as_large_as_files_may_be(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "a.png").write_bytes(bytes(10))
    for limit, found in ((10, tmp_path / "a.png"), (9, None)):
        monkeypatch.setattr(training_files, "_MAX_PHOTO_BYTES", limit)
        assert training_files.training_photo_path(tmp_path, "a.png") == found


@pytest.mark.parametrize("axis", range(3))
def test_opposite_directions_have_a_rotation_of_their_own(axis: int) -> None:
    source, own = np.eye(3)[axis], np.diag([-1.0, -1.0, 1.0])
    half = normalizations.rotation_between(source, -source)
    assert half @ source == pytest.approx(-source)
    assert half @ half == pytest.approx(np.eye(3))
    assert np.linalg.det(half) == pytest.approx(1)
    for cosine, is_own in ((-1 + 0.9e-9, True), (-1 + 1e-9, False), (-1 + 2e-9, False)):
        assert (normalizations.rotation_between(source, cosine * source, own) is own) is is_own


@pytest.mark.parametrize("stated", [(), ("position",), ("rotation",), ("position", "rotation")])
@pytest.mark.parametrize("told", [("position",), ("rotation",), ("position", "rotation")])
def test_noise_is_told_of_what_was_measured_and_came_without_one(
    told: tuple[str, ...], stated: tuple[str, ...], monkeypatch
) -> None:
    monkeypatch.setattr(register, "is_stated", lambda kind, observations: kind in stated)
    noise = SimpleNamespace(position_sigma=2.0, rotation_sigma=0.1, factors={"position": 3.0, "rotation": 5.0})
    fit: Any = SimpleNamespace(of_kind=lambda kind: np.array([False, kind in told]), noise=noise)
    expected = {"position": 6.0, "rotation": 0.5}
    found = register._noise(fit, Evidence([]))
    assert found == {kind: value for kind, value in expected.items() if kind in told and kind not in stated}


def test_the_peers_detect_as_colmap_and_hloc_configure_them() -> None:
    """hloc/extractors/dog.py: first octave 0, peak threshold 0.01; COLMAP's defaults are those of its library."""
    assert {name: (peer.sift, peer.best_photos) for name, peer in PEERS.items()} == {
        "sift_best10": ({}, 10),
        "dog_direct": ({"first_octave": 0, "peak_threshold": 0.01}, None),
    }


@pytest.mark.parametrize(
    ("error", "stays"),
    [(COARSE, True), ((COARSE[0], 0.0), True), ((COARSE[0] + 1e-6, 0.0), False), ((0.0, COARSE[1] + 1e-6), False)],
)
def test_a_photo_stays_at_home_within_the_coarse_bounds(error: tuple[float, float], stays: bool, monkeypatch) -> None:
    for name in ("read_query", "QueryImages", "ViewRenderer", "rasterizer_for"):
        monkeypatch.setattr(field_queries, name, lambda *_, **__: None)
    monkeypatch.setattr(field_queries, "errors", lambda *_: error)
    one: Any = SimpleNamespace(background_rgb=None, loaded=SimpleNamespace(matcher=None), units=None)
    sent: Any = SimpleNamespace(truth=Camera(LENS, HERE), data=b"")
    for refined, expected in ((SimpleNamespace(pose=HERE), (stays, *error)), (None, (False, None, None))):
        monkeypatch.setattr(
            field_queries, "_refined_from", lambda *_, refined=refined: SimpleNamespace(refined=refined)
        )
        assert tuple(field_queries.home(one, sent, exact=True).values()) == expected
