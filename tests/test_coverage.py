"""The coverage map: where photos of the small room are found, how it is calibrated, kept, drawn and served."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from api_server import create_app, serving, settings, until
from PIL import Image
from small_room import SIZE, write_room
from stand_ins import make_scene
from test_scenes import TRANSFORMS, ply
from typer.testing import CliRunner

from service.cli.app import app as cli
from service.codec import decode, encode
from service.coverage.calibration import Calibration, brier_score, calibrated
from service.coverage.coverage_cache import coverage_file, read_coverage, write_coverage
from service.coverage.coverage_map import CoverageMap, Trial, heading_of
from service.coverage.degraded_renders import DEGRADATION, degraded_render
from service.coverage.held_out_photos import held_out_photos
from service.coverage.measurement import COVERAGE, Measurement, measured_coverage
from service.coverage.plan import PLAN, _reached, assumed_up, find_places, novelty, plan_axes, pose_at, spread
from service.coverage.plan_drawing import drawn_plan, level_colour
from service.errors import CorruptScene
from service.geometry import look_at, moved, project, transformed
from service.loaded_scene import LoadedScene
from service.localize import Cancelled, Request
from service.pose.retrieval.free_space import free_space_of
from service.results import Status
from service.types import Camera, Intrinsics, Pose

Z = np.array([0.0, 0.0, 1.0])
PHOTO = Intrinsics(320, 240, 240.0, 240.0, 160.0, 120.0)
SMALL = replace(COVERAGE, trials=20, plan=replace(PLAN, cells=9, headings=4))


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """The small room, with four photos that it was not trained on; the files hold their numbers only."""
    folder = write_room(tmp_path_factory.mktemp("coverage") / "room")
    entries = []
    for number in range(4):
        (folder / f"{number}.jpg").write_bytes(bytes([number]))
        intrinsics = {"width": 320, "height": 240, "fx": 240.0, "fy": 240.0, "cx": 160.0, "cy": 120.0}
        pose = held_out_pose(number).world_from_camera.tolist()
        entries.append({"photo": f"{number}.jpg", "intrinsics": intrinsics, "world_from_camera": pose})
    (folder / "truth.json").write_text(json.dumps(entries))
    return folder


def held_out_pose(number: int) -> Pose:
    return look_at(np.array([0.1 * number, 0.2, 0.0]), np.array([1.0, 0.4 * number, 0.0]), Z)


@pytest.fixture(scope="module")
def estimator() -> Iterator[None]:
    """In place of the default one, which takes seconds: it knows the truth. Who looks along -x is localized 1 m off,
    who looks along y isn't localized; the others are right to 0.2 degrees and 0.01 units.
    """

    def answer(truth: Pose, loaded: LoadedScene, request: Request) -> SimpleNamespace:
        x, y, _ = truth.axis_in_world
        status = Status.LOCALIZED if abs(x) > abs(y) else Status.UNCERTAIN
        twist = np.array([np.radians(0.2), 0, 0, 1.0 if x < -0.7 else 0.01, 0, 0])
        return SimpleNamespace(pose=moved(truth, twist), verdict=SimpleNamespace(status=status))

    with pytest.MonkeyPatch.context() as patch:
        module = "service.coverage.measurement."
        patch.setattr(module + "degraded_render", lambda camera, *_: camera.pose)
        patch.setattr(module + "read_query", lambda data, **_: held_out_pose(data[0]))
        patch.setattr(module + "localize_in_scene", answer)
        patch.setattr("service.pose.retrieval.free_views.FreeViews.of", lambda *_: ())
        yield


@pytest.fixture(scope="module")
def measured(room, estimator, scene_cache) -> tuple[LoadedScene, CoverageMap, list[tuple[int, int]]]:
    loaded, seen = LoadedScene.load(room, cache_dir=scene_cache), []
    how = Measurement(held_out_photos(room), lambda done, total: seen.append((done, total)), config=SMALL)
    return loaded, measured_coverage(loaded, how), seen


def trial(found: bool, x: float, heading: float = 0.0, **changes) -> Trial:
    pose = pose_at(np.array([x, 0.0, 0.0]), heading, 0.0, np.eye(3))
    return replace(Trial(pose, Status.LOCALIZED if found else Status.UNCERTAIN, found, 0.1, 0.01, 0.2), **changes)


def plan_of(trials: list[Trial], cells: int = 3) -> CoverageMap:
    """A row of cells along x, each looked at along +x and -x."""
    positions = np.column_stack([np.arange(cells), np.zeros(cells), np.zeros(cells)]).astype(float)
    sees = np.ones((cells, 2), bool)
    sees[0, 1] = False
    novelties = np.full((cells, 2), 0.2)
    headings = np.array([0.0, np.pi])
    places = positions, headings, sees, novelties
    return CoverageMap("ab", np.eye(3), 1.0, *places, tuple(trials), (), Calibration(), 1.0)


# ------------------------------------------------------------------ the measurement


def test_a_photo_is_found_that_is_localized_where_it_was_taken(measured):
    _, found, seen = measured
    assert len(found.trials) == 20
    assert 0 < found.seconds < 300
    for one in found.trials:
        x, y, _ = one.pose.axis_in_world
        assert one.found == (x > abs(y))
        assert one.status is (Status.LOCALIZED if abs(x) > abs(y) else Status.UNCERTAIN)
        assert one.rotation_deg == pytest.approx(0.2, abs=1e-6)
        assert one.position_units == pytest.approx(1.0 if x < -0.7 else 0.01, rel=1e-3)
    assert sorted(seen) == [(n, 24) for n in range(25)]


def test_held_out_photos_are_tried_at_their_own_places_and_calibrate_the_map(measured):
    found = measured[1]
    assert [t.photo for t in found.real_trials] == ["0.jpg", "1.jpg", "2.jpg", "3.jpg"]
    axes = [held_out_pose(number).axis_in_world for number in range(4)]
    assert [t.found for t in found.real_trials] == [bool(x > abs(y)) for x, y, _ in axes] == [True, True, True, False]
    for number, one in enumerate(found.real_trials):
        np.testing.assert_allclose(one.pose.world_from_camera, held_out_pose(number).world_from_camera)
    assert found.calibration.photos == 4
    assert found.title == "Coverage, calibrated on 4 held-out photos"


def test_places_lie_around_the_cameras_and_within_the_room(measured):
    loaded, found, _ = measured
    cameras = np.array([c.camera.pose.position_in_world for c in loaded.scene.cameras])
    apart = np.linalg.norm(found.positions_in_world[:, None, :2] - cameras[:, :2], axis=2).min(1)
    assert len(found.positions_in_world) >= 6
    assert apart.max() < SIZE.max() / 2
    assert (np.abs(found.positions_in_world) < SIZE / 2).all()
    assert found.sees_scene.mean() > 0.9  # walls all around


def test_a_measurement_is_the_same_again_and_can_be_cancelled(measured):
    loaded = measured[0]
    few = replace(SMALL, trials=2)
    told: list[CoverageMap] = []
    one, other = (measured_coverage(loaded, Measurement(partial=told.append, config=few)) for _ in range(2))
    # What is told while it is measured: the trials so far, in any order, of a map that else is the same.
    assert [len(part.trials) for part in told] == [1, 2, 1, 2]
    assert {encode(trial) for trial in told[1].trials} == {encode(trial) for trial in one.trials}
    assert np.array_equal(told[0].plan_from_world, one.plan_from_world)
    assert encode(replace(one, seconds=0.0)) == encode(replace(other, seconds=0.0))
    assert one.title.startswith("Coverage, upper bound")
    cancelled = threading.Event()
    cancelled.set()
    with pytest.raises(Cancelled):
        measured_coverage(loaded, Measurement(cancel=cancelled, config=few))


def test_a_degraded_photo_is_the_render_through_a_lens_that_is_a_little_different(measured):
    loaded = measured[0]
    camera = Camera(PHOTO, look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]), Z))
    clean = replace(
        DEGRADATION, gain_sigma=0.0, white_balance_sigma=0.0, vignetting=(0.0, 0.0), blur_px=(0.01, 0.011),
        noise=(0.0, 0.0), k1_sigma=0.0, focal_sigma=0.0, jpeg_quality=(99, 100),
    )  # fmt: skip
    render = loaded.rasterizer.render([camera])[0].rgb
    same = degraded_render(camera, loaded.rasterizer, np.random.default_rng(0), clean)
    assert np.abs(same.rgb / 255 - render).mean() < 0.01  # JPEG's losses: 0.004
    assert same.intrinsics.trust == "approximate"
    degraded = degraded_render(camera, loaded.rasterizer, np.random.default_rng(0))
    assert np.abs(degraded.rgb / 255 - render).mean() > 0.03
    assert degraded.intrinsics.fx != pytest.approx(240.0, abs=0.1)
    lens = replace(clean, k1_sigma=0.05)
    bent = degraded_render(camera, loaded.rasterizer, np.random.default_rng(0), lens).rgb / 255
    off = np.abs(bent - render).mean(2)
    assert off[100:140, 140:180].mean() < 0.5 * off[:40, :40].mean()  # the middle stays, the corners move


# ------------------------------------------------------------------ plan and map


def test_headings_and_poses_belong_together():
    plan = plan_axes([Camera(PHOTO, look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])))], None)
    np.testing.assert_allclose(plan[2], [0, -1, 0], atol=1e-12)  # the camera's own up: y down
    np.testing.assert_allclose(plan @ plan.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(plan) == pytest.approx(1)
    for heading in (-2.0, 0.0, 0.5, 3.0):
        pose = pose_at(np.array([1.0, 2.0, 3.0]), heading, 0.3, plan)
        assert heading_of(pose, plan) == pytest.approx(heading)
        np.testing.assert_allclose(plan @ pose.position_in_world, [1, 2, 3], atol=1e-12)
        assert plan[2] @ pose.axis_in_world == pytest.approx(np.sin(0.3))
        # Upright: a point above is above in the image.
        above = transformed(pose.camera_from_world, (pose.position_in_world + pose.axis_in_world + 0.1 * plan[2])[None])
        x, y = project(above, PHOTO)[0]
        assert x == pytest.approx(160)
        assert y < 120


def test_without_cameras_up_is_the_axis_of_those_usual_by_which_a_scene_is_flat() -> None:
    room = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)) * [6.0, 4.0, 2.5]
    assert assumed_up(room) == (0.0, 0.0, 1.0)
    assert assumed_up(room[:, [0, 2, 1]]) == (0.0, -1.0, 0.0)
    # A cube tells nothing.
    assert assumed_up(room / [6.0, 4.0, 2.5]) == (0.0, 0.0, 1.0)


def test_the_plan_of_a_scene_without_cameras_lies_level(measured) -> None:
    """Its views are upright by z and by -y: the mean of both would be tilted by half a right angle."""
    loaded = measured[0]
    scene = replace(loaded.scene, cameras=(), info=replace(loaded.scene.info, up_in_world=None))
    ups = [np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])]
    captured = [
        Camera(PHOTO, look_at(np.array([x, y, 0.0]), np.array([-x, y + 0.3, 0.1]), up))
        for x in (-0.5, 0.5) for y in (-0.5, 0.0, 0.5) for up in ups
    ]  # fmt: skip
    places = find_places(scene, loaded.rasterizer, captured, 2.0, np.random.default_rng(0), SMALL.plan)
    assert abs(places.plan_from_world[2]).max() == pytest.approx(1.0)


def test_novelty_is_zero_at_a_camera_of_the_capture_and_grows_with_distance_and_turn():
    captured = [Camera(PHOTO, pose_at(np.zeros(3), 0.0, 0.0, np.eye(3)))]
    poses = [((0, 0, 0), 0.0), ((2, 0, 0), 0.0), ((0, 0, 0), np.pi / 3), ((2, 0, 0), np.pi / 3)]
    cameras = [Camera(PHOTO, pose_at(np.array(at, float), heading, 0.0, np.eye(3))) for at, heading in poses]
    # 2 units are half of the distance; the chord of 60 degrees is 1, twice what counts as 1.
    np.testing.assert_allclose(novelty(cameras, captured, 4.0), [0, 1, 2, 5**0.5], atol=1e-9)


def test_the_map_is_sure_where_trials_succeed_and_not_where_they_fail():
    found = plan_of([trial(i > 2, x) for x in (0.0, 1.0, 8.0, 9.0) for i in range(6)][:12] + [trial(True, 9.0)] * 6)
    apart = plan_of([*[trial(False, 0.0)] * 8, *[trial(True, 9.0)] * 8], cells=10).probabilities
    assert apart[0, 0] < 0.2 < 0.8 < apart[9, 0]
    assert apart[0, 1] == 0.0  # nothing is in view there
    assert (found.probabilities >= 0).all()
    assert (found.probabilities <= 1).all()


def test_trials_say_something_of_their_own_heading_only():
    split = plan_of([*[trial(True, 1.0, 0.0)] * 8, *[trial(False, 1.0, np.pi)] * 8]).probabilities
    assert split[1, 0] > 0.8
    assert split[1, 1] < 0.2


def test_what_is_far_from_the_capture_is_predicted_by_other_places_that_are():
    near, far = [trial(True, 0.0, novelty=0.2)] * 10, [trial(False, 0.0, np.pi, novelty=2.0)] * 10
    found = replace(plan_of([*near, *far], cells=40), novelties=np.tile([[0.2, 2.0]], (40, 1)))
    # The last cell is 39 cells from all trials.
    assert found.probabilities[39, 0] > 0.85
    assert found.probabilities[39, 1] < 0.15


def test_expected_accuracy_is_of_what_is_found():
    accuracy = plan_of([trial(True, 1.0, rotation_deg=0.3), trial(False, 1.0, rotation_deg=90.0)]).expected_accuracy()
    assert accuracy.median_rotation_deg == 0.3
    nothing = plan_of([trial(False, 1.0)]).expected_accuracy()
    assert np.isnan(nothing.median_rotation_deg)
    assert nothing.sure_share == 0


def test_trials_are_spread_over_places_and_headings(measured):
    loaded = measured[0]
    captured = [named.camera for named in loaded.scene.cameras]
    places = find_places(loaded.scene, loaded.rasterizer, captured, 2.0, np.random.default_rng(0), SMALL.plan)
    assert places.headings_rad == pytest.approx([0, np.pi / 2, np.pi, 1.5 * np.pi])
    pairs = spread(places, 30)
    assert len({tuple(pair) for pair in pairs.tolist()}) == 30
    assert set(pairs[:, 1].tolist()) == {0, 1, 2, 3}
    assert len(set(pairs[:, 0].tolist())) >= 6
    assert len(spread(places, 10_000)) == places.sees_scene.sum()


# ------------------------------------------------------------------ calibration


def test_calibration_finds_planted_odds():
    rng = np.random.default_rng(0)
    shares = rng.uniform(0.02, 0.98, 4000)
    truth = 1 / (1 + np.exp(-(-1.0 + 0.8 * np.log(shares / (1 - shares)))))
    found = calibrated(shares[:150], rng.uniform(size=150) < truth[:150])
    assert found.photos == 150
    # 0.03 seen.
    assert np.abs(found.applied(shares) - truth).mean() < 0.06


def test_few_photos_calibrate_nothing_and_one_outcome_keeps_finite():
    shares = np.array([0.9, 0.8, 0.7])
    assert calibrated(shares, np.ones(3, bool)) == Calibration()
    np.testing.assert_array_equal(Calibration().applied(shares), shares)
    all_lost = calibrated(np.full(8, 0.9), np.zeros(8, bool))
    assert all_lost.applied(np.array([0.9]))[0] < 0.35
    assert all_lost.brier == pytest.approx(np.mean(all_lost.applied(np.full(8, 0.9)) ** 2), abs=0.05)
    assert brier_score(np.array([1.0, 0.0]), np.array([True, True])) == 0.5


# ------------------------------------------------------------------ kept, drawn, served


def test_a_map_is_kept_beside_the_index_and_belongs_to_its_scene(measured, room, tmp_path):
    loaded, found, _ = measured
    photos = held_out_photos(room)
    file = coverage_file(tmp_path, loaded.searched, "cpu", "xfeat", photos)
    assert read_coverage(file) is None
    write_coverage(found, file)
    assert encode(read_coverage(file)) == encode(found)
    changed = replace(loaded.searched, info=replace(loaded.searched.info, sha256="other"))
    others = [
        coverage_file(tmp_path, changed, "cpu", "xfeat", photos),
        coverage_file(tmp_path, loaded.searched, "cpu", "sift", photos),
        coverage_file(tmp_path, loaded.searched, "cpu", "xfeat", photos[1:]),
    ]
    assert len({file, *others}) == 4
    file.write_text(file.read_text()[:100])
    assert read_coverage(file) is None
    assert decode(CoverageMap, encode(found)).trials[0].status is found.trials[0].status


def test_the_drawing_has_the_colours_of_the_legend_where_the_cells_are():
    found = plan_of([*[trial(True, 2.0, 0.0)] * 9, *[trial(False, 2.0, np.pi)] * 9])
    image = np.asarray(Image.open(BytesIO(drawn_plan(found, np.zeros((0, 3)), np.array([[1.0, 0.0, 0.0]])))))
    sure = (np.abs(image.astype(int) - level_colour(0.95)).sum(2) < 10).nonzero()
    above_legend = sure[0] < image.shape[0] - 200
    # Seen from above with the first axis to the right: those that look along it are right of each cell's middle.
    assert above_legend.sum() > 100
    assert sure[1][above_legend].max() > 0.6 * image.shape[1]
    assert (np.abs(image.astype(int) - [190, 40, 40]).sum(2) < 10).any()


def test_the_command_prints_writes_and_draws_and_inspect_tells_of_it(
    room, measured, scene_cache, tmp_path, monkeypatch
):
    monkeypatch.setenv("SPLATFIX_CACHE_DIR", str(scene_cache))
    loaded, found, _ = measured
    write_coverage(found, coverage_file(scene_cache, loaded.searched, "cpu", "xfeat", held_out_photos(room)))
    result = CliRunner().invoke(
        cli, ["scenes", "coverage", str(room), "--json", str(tmp_path / "c.json"), "--image", str(tmp_path / "c.png")]
    )
    assert result.exit_code == 0, result.output
    assert "calibrated on 4 held-out photos" in result.stdout
    assert "3 of 4 held-out photos are found; Brier score" in result.stdout
    written = json.loads((tmp_path / "c.json").read_text())
    assert len(written["cells"]) == len(found.positions_in_world)
    assert [t["found"] for t in written["trials"] if t["photo"]] == [True, True, True, False]
    with Image.open(tmp_path / "c.png") as image:
        assert image.width == 900
    from service.cli.scene_facts import as_lines, inspected_scene

    facts = inspected_scene(room).facts
    assert facts["expected_accuracy"]["found"] == pytest.approx(written["found"])
    assert "of photos are found (Coverage, calibrated" in as_lines(facts)["expected accuracy"]


def test_a_broken_list_of_held_out_photos_is_named(tmp_path):
    (tmp_path / "truth.json").write_text('[{"photo": "a.jpg"}]')
    (tmp_path / "a.jpg").write_bytes(b"")
    with pytest.raises(CorruptScene, match=r"truth\.json: not a list of photos"):
        held_out_photos(tmp_path)
    assert held_out_photos(tmp_path / "none.ply") == []


def test_the_api_measures_in_the_background_and_tells_what_went_wrong(monkeypatch, plugins, tmp_path):
    go_on, may_end = threading.Event(), threading.Event()
    clock = SimpleNamespace(now=100.0, monotonic=lambda: clock.now)
    monkeypatch.setattr("service.scene_manager.scene_coverage.time", clock)

    def measured(loaded: LoadedScene, how: Measurement) -> CoverageMap:
        assert how.progress
        clock.now += 0.5
        how.progress(0, 10)
        clock.now += 0.3
        assert how.partial
        how.partial(plan_of([trial(True, 1.0, heading=np.pi / 2), trial(False, 0.5)]))
        how.progress(3, 10)
        until(lambda: go_on.is_set() or how.cancel.is_set(), 30)
        if how.cancel.is_set():
            may_end.wait(30)
            raise Cancelled
        return replace(plan_of([trial(True, 1.0)]), scene_sha256=loaded.scene.info.sha256)

    monkeypatch.setattr("service.scene_manager.scene_coverage.measured_coverage", measured)
    folder = tmp_path / "hall"
    folder.mkdir()
    (folder / "scene.ply").write_bytes(ply(50))
    (folder / "transforms.json").write_text(json.dumps(TRANSFORMS))
    (folder / "truth.json").write_text("{}")
    app = create_app(settings(scenes=[folder], cache_dir=None), {"room": make_scene()})
    with serving(app) as client:
        path, counts = "/scenes/room/coverage", {"done": 0, "total": 0, "remaining_s": None}
        nothing = {"state": "none", "map": None, "tried": None, "error": None} | counts
        assert client.get(path).json() == nothing
        assert client.post(path).status_code == 202
        until(lambda: client.get(path).json()["done"] == 3, 30)
        assert client.post(path).json()["total"] == 10  # the same measurement
        # 3 of 10 took 0.3 s, after 0.5 s of preparation: 7 more take 0.7 s.
        assert client.get(path).json()["remaining_s"] == pytest.approx(0.7)
        tried = client.get(path).json()["tried"]
        assert tried["plan_from_world"] == np.eye(3).tolist()
        said = [(one["position"][0], round(one["heading_deg"]), one["found"]) for one in tried["trials"]]
        assert said == [(1.0, 90, True), (0.5, 0, False)]
        assert client.get("/scenes/room").json()["jobs"] == 1  # it keeps the scene in memory
        # A measurement that is asked for before a cancelled one has ended is another, and isn't lost with that.
        assert client.delete(path).status_code == 200
        assert client.post(path).json()["done"] == 0
        may_end.set()
        until(lambda: client.get(path).json()["done"] == 3, 30)
        assert client.delete(path).status_code == 200
        until(lambda: client.get(path).json() == nothing, 30)
        until(lambda: client.get("/scenes/room").json()["jobs"] == 0, 30)
        assert client.delete(path).json()["state"] == "none"  # nothing is measured
        assert client.delete("/scenes/none/coverage").status_code == 404
        assert client.post(path).status_code == 202
        go_on.set()
        until(lambda: client.get(path).json()["state"] == "ready", 30)
        answer = client.get(path).json()["map"]
        assert answer["headings_deg"] == [0, 180]
        assert answer["cells"][0]["probabilities"][1] is None
        assert answer["found"] > 0.8
        until(lambda: client.get("/scenes/room").json()["jobs"] == 0, 30)
        assert client.get("/scenes/none/coverage").status_code == 404
        until(lambda: client.post("/scenes/hall/coverage").status_code == 202, 30)
        until(lambda: client.get("/scenes/hall/coverage").json()["state"] == "failed", 30)
        assert "truth.json" in str(client.get("/scenes/hall/coverage").json()["error"])


def test_places_behind_walls_are_left_out():
    """A wall crosses the room; the capture stands on one side, and cells on its other side are near enough."""
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(0.95, 1.05, 20_000), rng.uniform(-3, 3, 20_000), rng.uniform(-1, 1, 20_000)])
    around = rng.uniform(-1, 1, (20_000, 3))
    around = 3 * around / np.abs(around).max(1, keepdims=True) * [1, 1, 1 / 3]
    scene = make_scene(count=1).scene
    means = np.concatenate([wall, around]).astype(np.float32)
    space = free_space_of(
        replace(
            scene, means=means, quats=np.tile(np.float32([1, 0, 0, 0]), (len(means), 1)),
            scales=np.full((len(means), 3), 0.02, np.float32), opacities=np.ones(len(means), np.float32),
            sh=np.zeros((len(means), 1, 3), np.float32),
        )
    )  # fmt: skip
    captured = np.array([[0.0, 0.5, 0.0], [0.0, -0.5, 0.0]])
    places = np.array([[-1.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.8, 0.0, 0.0], [2.2, 1.0, 0.0]])
    np.testing.assert_array_equal(_reached(places, captured, space), [True, True, False, False])
