"""Gravity, position and heading that a device measured: the equations, and what they decide in scenes that repeat."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_room import HALF_TURN, UPSIDE_DOWN, pose_at, write_room
from test_estimators import LENS, assert_near, photo_at, unseen_pose

from service.device_readings import DeviceReadings, GpsPosition, Gravity, Heading
from service.errors import InvalidPrior
from service.estimators.view_index import Options
from service.geodesy import geographic
from service.geometry import look_at, moved, pose_distance, se3_log
from service.live.live_tracker import LiveTracker
from service.live.live_values import LiveFrame, LiveTask
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.photos.images import encode_image
from service.pose.absolute_pose.device_priors import contradicts, prefers, residuals, with_readings
from service.readings_in_scene import scene_priors
from service.registration.registration import PARTS, Origin, Registration
from service.results import PoseEstimate, Reason, Status
from service.scene_origin import shifted
from service.types import GeoAnchor, Pose, SceneInfo

FAST = Request(options=Options(effort="fast"))
TRUTH = unseen_pose()
TWIN = Pose(HALF_TURN @ TRUTH.world_from_camera)


APART = 6.0
"""Units between two rooms like one another: 10 m."""


def similarity(turn: float = 0.7, scale: float = 10 / APART) -> np.ndarray:
    """Metres east, north and up of a scene whose z is up: turned, and scaled."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    matrix[:3, :3] *= scale
    matrix[:3, 3] = [12.0, -7.0, 3.0]
    return matrix


ANCHOR = GeoAnchor(47.3, 8.5, 450.0, similarity())
INFO = SceneInfo("room", "room", "0" * 64, "ply", up_in_world=(0.0, 0.0, 1.0), geo_anchor=ANCHOR)


def gravity_at(pose: Pose, sigma_deg: float = 1.0) -> Gravity:
    return Gravity(tuple(pose.world_from_camera[2, :3].tolist()), sigma_deg)


def gps_at(pose: Pose, sigma_m: float = 1.0, east_m: float = 0.0) -> GpsPosition:
    moved_there = pose.world_from_camera.copy()
    moved_there[:3, 3] += np.linalg.solve(ANCHOR.enu_from_world[:3, :3], [east_m, 0.0, 0.0])
    place, _ = geographic(ANCHOR, Pose(moved_there))
    return GpsPosition(*map(float, place[:2]), sigma_m)


def heading_at(pose: Pose, off_deg: float = 0.0, sigma_deg: float = 15.0) -> Heading:
    axis = ANCHOR.enu_from_world[:3, :3] @ pose.axis_in_world
    return Heading(float(np.degrees(np.arctan2(axis[0], axis[1]))) + off_deg, sigma_deg)


def all_at(pose: Pose) -> DeviceReadings:
    return DeviceReadings(gravity_at(pose), gps_at(pose), heading_at(pose))


# ---------------------------------------------------------------------- equations


def test_readings_at_the_truth_leave_no_residual() -> None:
    gps = replace(gps_at(TRUTH), height_m=float(geographic(ANCHOR, TRUTH)[0][2]))
    priors = scene_priors(replace(all_at(TRUTH), gps=gps), INFO)
    found = residuals(priors, TRUTH)
    assert [one.name for one in found] == ["up", "position", "heading"]
    assert [len(one.value) for one in found] == [2, 3, 1]
    # Metres: the scene lies 14 m from its anchor, where the Earth curves by 15 micrometres.
    assert max(np.abs(one.value).max() for one in found) < 1e-4


def test_jacobians_are_those_of_the_residuals() -> None:
    """Against central differences; the residual of up is exact in its derivative only where it is small."""
    near = moved(TRUTH, np.array([1e-4, -2e-4, 1e-4, 0.3, -0.2, 0.4]))
    priors = scene_priors(all_at(near), INFO)
    for one in residuals(priors, TRUTH):
        steps = []
        for k in range(6):
            ahead, behind = (
                next(r for r in residuals(priors, moved(TRUTH, sign * 1e-6 * np.eye(6)[k])) if r.name == one.name)
                for sign in (1, -1)
            )
            steps.append((ahead.value - behind.value) / 2e-6)
        assert np.allclose(np.stack(steps, 1), one.jacobian, atol=2e-3)


def test_the_pose_by_photo_and_readings_is_that_of_all_equations_at_once() -> None:
    """Against a Gauss-Newton solution of the stacked, whitened equations by least squares."""
    rng = np.random.default_rng(1)
    root = rng.normal(0, 0.02, (6, 6))
    covariance = root @ root.T + 1e-5 * np.eye(6)
    readings = DeviceReadings(gravity_at(moved(TRUTH, np.r_[0.01, 0.02, -0.01, 0, 0, 0])), gps_at(TRUTH, 0.3, 0.2))
    priors = scene_priors(readings, INFO)
    pose, fused = with_readings(priors, TRUTH, covariance)
    rows, values = [np.linalg.inv(np.linalg.cholesky(covariance))], [np.zeros(6)]
    for one in residuals(priors, TRUTH):
        whiten = np.linalg.inv(np.linalg.cholesky(one.noise))
        rows.append(whiten @ one.jacobian)
        values.append(-whiten @ one.value)
    twist, *_ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)
    assert np.allclose(pose.world_from_camera, moved(TRUTH, twist).world_from_camera, atol=1e-9)
    assert np.allclose(fused, np.linalg.inv(np.concatenate(rows).T @ np.concatenate(rows)), rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(covariance - fused).min() > -1e-12


def test_the_covariance_by_photo_and_readings_holds() -> None:
    """Drawn errors of photo and readings: the squared distances of the estimates have the mean of a chi-square."""
    rng = np.random.default_rng(2)
    covariance = np.diag(np.r_[np.full(3, 0.02), np.full(3, 0.4)] ** 2)
    squared = []
    # The scene's own errors, 2 degrees and 1 m, are drawn with the device's.
    known = scene_priors(DeviceReadings(gps=gps_at(TRUTH, 1.0)), INFO).position
    assert known is not None
    for _ in range(300):
        start = moved(TRUTH, rng.multivariate_normal(np.zeros(6), covariance))
        tilted = moved(TRUTH, np.r_[np.radians(rng.normal(0, np.hypot(1, 2), 3)), 0, 0, 0])
        off = np.linalg.solve(ANCHOR.enu_from_world[:3, :3], np.r_[rng.normal(0, np.hypot(1, 1), 2), 0])
        priors = scene_priors(DeviceReadings(gravity_at(tilted)), INFO)
        priors = replace(priors, position=replace(known, position_in_world=known.position_in_world + off))
        pose, fused = with_readings(priors, start, covariance)
        twist = se3_log(pose.camera_from_world @ TRUTH.world_from_camera)
        squared.append(twist @ np.linalg.solve(fused, twist))
    # 6, with a standard error of 0.2.
    assert 5.4 < np.mean(squared) < 6.6


def test_what_is_far_from_a_reading_contradicts_it() -> None:
    tight = np.diag(np.repeat([0.001, 0.001], 3) ** 2)
    for wrong in (
        DeviceReadings(gravity=gravity_at(moved(TRUTH, np.array([0, 0, np.pi / 2, 0, 0, 0])))),
        DeviceReadings(gravity=Gravity(tuple((-TRUTH.world_from_camera[2, :3]).tolist()))),
        DeviceReadings(gps=gps_at(TRUTH, 5.0, 50.0)),
        DeviceReadings(heading=heading_at(TRUTH, 120.0)),
    ):
        assert contradicts(scene_priors(wrong, INFO), TRUTH, tight)
        # A photo that says as little contradicts nothing.
        assert not contradicts(scene_priors(wrong, INFO), TRUTH, np.eye(6) * 400)
    assert not contradicts(scene_priors(all_at(TRUTH), INFO), TRUTH, tight)


def test_readings_that_differ_too_little_or_contradict_both_decide_nothing() -> None:
    def decide(readings: DeviceReadings) -> bool:
        return prefers(scene_priors(readings, INFO), TRUTH, None, TWIN, None)

    # The twin is 2 m away: nothing against a sigma of as much, and the scene's own 1 m.
    assert not decide(DeviceReadings(gps=gps_at(TRUTH, 3.0)))
    assert not decide(DeviceReadings(gps=gps_at(TRUTH, 2.0, 300.0)))
    assert decide(DeviceReadings(heading=heading_at(TRUTH)))
    # Gravity that only the other one agrees with outweighs whatever else there is.
    flipped = Gravity(tuple((-TWIN.world_from_camera[2, :3]).tolist()))
    assert not decide(DeviceReadings(gravity=flipped))


def test_a_steep_camera_has_no_heading() -> None:
    down = look_at(np.zeros(3), np.array([0.0, 0.05, -1.0]), np.array([0.0, 1.0, 0.0]))
    assert not residuals(scene_priors(DeviceReadings(heading=Heading(77.0)), INFO), down)


def test_a_registration_counts_before_the_files_and_adds_its_own_uncertainty() -> None:
    covariance = np.diag([0.01, 0.02, 0.05, 3.0, 4.0, 5.0, 0.0]) ** 2
    registration = Registration(
        similarity(), np.zeros(3), covariance, PARTS, "", up_in_target=(0.0, 0.0, 1.0), origin=Origin(47.3, 8.5, 450.0)
    )
    bare = replace(INFO, up_in_world=(1.0, 0.0, 0.0), geo_anchor=None)
    priors = scene_priors(all_at(TRUTH), bare, registration)
    assert not contradicts(priors, TRUTH, None)
    assert priors.up is not None
    assert priors.up.sigma == pytest.approx(np.hypot(np.radians(1), 0.02))
    assert priors.heading is not None
    assert priors.heading.sigma == pytest.approx(np.hypot(np.radians(15), 0.05))
    assert priors.position is not None
    arm = similarity()[:3, :3] @ TRUTH.position_in_world
    # A turn by 0.05 rad moves what is an arm away, too.
    by_turns = (0.05 * arm[1]) ** 2 + (0.02 * arm[2]) ** 2
    assert priors.position.covariance[0, 0] == pytest.approx(1 + 9 + by_turns, rel=1e-3)


def test_a_scene_without_up_or_place_says_what_it_can_not_use() -> None:
    nowhere = replace(INFO, up_in_world=None, geo_anchor=None)
    priors = scene_priors(all_at(TRUTH), nowhere)
    assert (priors.up, priors.position, priors.heading) == (None, None, None)
    assert [warning.split(" was")[0] for warning in priors.warnings] == [
        "the gravity",
        "the GPS position",
        "the heading",
    ]
    assert scene_priors(DeviceReadings(gravity_at(TRUTH)), replace(INFO, up_in_world=None)).up is not None


@pytest.mark.parametrize(
    ("make", "where"),
    [
        (lambda: Gravity((0.0, 0.0, 0.0)), "up_in_camera.direction"),
        (lambda: Gravity((np.nan, 0.0, 1.0)), "up_in_camera.direction"),
        (lambda: Gravity((0.0, -1.0, 0.0), 0.0), "up_in_camera.sigma_deg"),
        (lambda: GpsPosition(91.0, 0.0, 5.0), "gps.latitude"),
        (lambda: GpsPosition(0.0, 181.0, 5.0), "gps.longitude"),
        (lambda: GpsPosition(0.0, 0.0, 0.0), "gps.sigma_m"),
        (lambda: GpsPosition(0.0, 0.0, 5.0, 1e6), "gps.height"),
        (lambda: Heading(np.nan), "heading.degrees"),
        (lambda: Heading(1.0, 181.0), "heading.sigma_deg"),
    ],
)
def test_what_is_no_reading_is_refused(make, where: str) -> None:
    with pytest.raises(InvalidPrior) as error:
        make()
    assert error.value.where == where


# ---------------------------------------------------------------------- in scenes


def on_earth(folder: Path, **kind) -> LoadedScene:
    """A room of `small_room` that says where it is, and which way is up."""
    loaded = LoadedScene.load(write_room(folder / "room", 12, **kind), cache_dir=folder / "cache")
    info = replace(loaded.scene.info, up_in_world=(0.0, 0.0, 1.0), geo_anchor=ANCHOR)
    return replace(loaded, scene=replace(loaded.scene, info=info))


ALONG_Y = moved(pose_at(0.5 * np.pi, 0.1), np.array([0.05, 0.03, -0.04, 0.1, -0.05, 0.1]))
"""Looks past the other room, which shines through the walls a little."""
IN_OTHER_ROOM = shifted(ALONG_Y, np.array([APART, 0, 0]))
FLIPPED = Pose(UPSIDE_DOWN @ TRUTH.world_from_camera)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> LoadedScene:
    return on_earth(tmp_path_factory.mktemp("rooms"), apart=APART)


@pytest.fixture(scope="module")
def tumbled(tmp_path_factory: pytest.TempPathFactory) -> LoadedScene:
    return on_earth(tmp_path_factory.mktemp("tumbled"), upside_down=True)


def found_with(loaded: LoadedScene, pose: Pose, readings: DeviceReadings | None) -> PoseEstimate:
    return localize(replace(photo_at(loaded, pose), readings=readings), loaded, FAST)


def against(found: PoseEstimate) -> list[str]:
    return [warning.split()[1] for warning in found.warnings if "not used" in warning]


@pytest.mark.ci
def test_gps_tells_two_rooms_apart_that_are_the_same(rooms: LoadedScene) -> None:
    """10 m: by a sigma of 2 m, not by one of 10 m."""
    without = found_with(rooms, ALONG_Y, None)
    assert without.verdict.reason is Reason.AMBIGUOUS
    for place in (ALONG_Y, IN_OTHER_ROOM):
        found = found_with(rooms, ALONG_Y, DeviceReadings(gps=gps_at(place, 2.0)))
        assert found.verdict.status is Status.LOCALIZED
        assert_near(found.pose, place)
        assert not against(found)
        vague = found_with(rooms, ALONG_Y, DeviceReadings(gps=gps_at(place, 10.0)))
        assert vague.verdict.reason is Reason.AMBIGUOUS


def test_the_index_knows_how_a_room_repeats_itself_upside_down(tumbled: LoadedScene) -> None:
    motions = tumbled.prepare("view_index").repetitions.motions
    assert len(motions) >= 6
    for motion in motions:
        angle, way = pose_distance(Pose(motion), Pose(UPSIDE_DOWN))
        assert angle < 3
        assert way < 0.1


def test_gravity_tells_a_room_from_itself_upside_down(tumbled: LoadedScene) -> None:
    """A camera that is held upside down sees there what an upright one does."""
    without = found_with(tumbled, FLIPPED, None)
    assert without.verdict.reason is Reason.AMBIGUOUS
    ((other, _),) = without.alternatives
    both = sorted((without.pose, other), key=lambda pose: pose_distance(pose, TRUTH)[0])
    for found, place in zip(both, (TRUTH, FLIPPED), strict=True):
        assert_near(found, place)
    for place in (TRUTH, FLIPPED):
        found = found_with(tumbled, place, DeviceReadings(gravity=gravity_at(place)))
        assert found.verdict.status is Status.LOCALIZED
        assert found.records[-1].stage == "fuse_readings"
        assert_near(found.pose, place)
        assert not against(found)


WRONG = {
    "gravity": lambda pose: DeviceReadings(gravity=gravity_at(moved(pose, np.array([0, 0, np.pi / 2, 0, 0, 0])))),
    "position": lambda pose: DeviceReadings(gps=gps_at(pose, 2.0, 50.0)),
    "heading": lambda pose: DeviceReadings(heading=heading_at(pose, -120.0)),
}


@pytest.mark.ci
@pytest.mark.parametrize("kind", WRONG)
def test_what_is_wrong_is_left_out_and_named_and_the_photo_alone_counts(
    kind: str, rooms: LoadedScene, tumbled: LoadedScene
) -> None:
    for loaded, pose, other in ((rooms, ALONG_Y, IN_OTHER_ROOM), (tumbled, TRUTH, FLIPPED)):
        found = found_with(loaded, pose, WRONG[kind](pose))
        assert found.verdict.reason is Reason.AMBIGUOUS
        assert min(pose_distance(found.pose, place)[1] for place in (pose, other)) < 0.01
        assert against(found) == [kind]


@pytest.mark.ci
def test_a_live_session_searches_with_the_frames_gravity(tumbled: LoadedScene) -> None:
    """Without it a camera that is held upside down may as well be upright."""
    jpeg = encode_image(photo_at(tumbled, FLIPPED).rgb)
    for truth in (TRUTH, FLIPPED):
        up = gravity_at(truth).direction
        with closing(LiveTracker(LiveTask("", "view_index", intrinsics=LENS), tumbled)) as tracker:
            for number in range(400):
                answer = tracker.use(LiveFrame(number, 0.05 * number, jpeg, up_in_camera=up))
                if answer.pose is not None:
                    break
                time.sleep(0.05)
        assert answer.verdict is not None
        assert answer.verdict.status is Status.LOCALIZED
        assert answer.pose is not None
        assert_near(answer.pose, truth)
