"""Following a camera: planted paths through a room, photos with noise and changing exposure."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from api_server import until
from small_room import FOCAL, HEIGHT, WIDTH, pose_at, write_room

from service import tracking as track
from service.bench import track as bench
from service.bench.live import SessionLog, figures
from service.bench.live_film import FilmConfig, Shot, make_film
from service.bench.pose_metrics import Outcome, Units
from service.errors import InvalidImage, SceneNotFound
from service.geometry import moved, pose_distance
from service.live import live_tracker
from service.live.background import Background
from service.live.live_tracker import LIVE, LiveTracker
from service.live.live_values import LiveAnswer as Live
from service.live.live_values import LiveFrame, LiveTask
from service.live_client import LiveAnswer
from service.loaded_scene import LoadedScene
from service.localize import Cancelled, Request, render_and_verify
from service.photos.camera_identity import CameraIdentity
from service.photos.images import encode_image, query_of, read_query
from service.photos.sequence import SequencePhoto
from service.pose.verification.gate import doubted
from service.results import Reason, Status
from service.tracking import Tracker, TrackingConfig, localize_sequence
from service.types import Camera, Intrinsics, Pose, Query

LENS = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)


TILT = np.array([0.15, 0.0, 0.0, 0.0, 0.0, 0.0])
"""The walls' Gaussians lie in a plane: seen level, it would be chance which of two covers the other."""


def place(angle: float, height: float) -> Pose:
    return moved(pose_at(angle, height), TILT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = write_room(tmp_path_factory.mktemp("track") / "room")
    path = folder / "transforms.json"
    transforms = json.loads(path.read_text())
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    for frame in transforms["frames"]:
        level = Pose(np.array(frame["transform_matrix"]) @ opengl)
        frame["transform_matrix"] = (moved(level, TILT).world_from_camera @ opengl).tolist()
    path.write_text(json.dumps(transforms))
    return folder


@pytest.fixture(scope="module")
def room(folder, scene_cache) -> LoadedScene:
    loaded = LoadedScene.load(folder, cache_dir=scene_cache)
    loaded.prepare("view_index")
    return loaded


def path(count: int, start: float = 1.0) -> list[Pose]:
    """A turn of 1.1 degrees a photo, while the camera goes up and down."""
    return [place(start + 0.02 * i, 0.1 + 0.1 * np.sin(0.3 * i)) for i in range(count)]


def photo(room: LoadedScene, pose: Pose, number: int = 0, lens: Intrinsics = LENS) -> np.ndarray:
    rgb = room.rasterizer.render([Camera(lens, pose)])[0].rgb
    noise = np.random.default_rng(number).normal(0, 0.03, rgb.shape)
    return np.rint(255 * np.clip((0.9 + 0.2 * np.sin(number)) * rgb + noise, 0, 1)).astype(np.uint8)


def query(room: LoadedScene, pose: Pose, number: int = 0, intrinsics: Intrinsics | None = LENS) -> Query:
    return query_of(photo(room, pose, number), intrinsics=intrinsics)


def followed(estimate) -> bool:
    return estimate.records[-1].stage == "track"


def close(pose: Pose, truth: Pose, degrees: float = 0.1, units: float = 0.005) -> bool:
    turned, shifted = pose_distance(pose, truth)
    return turned < degrees and shifted < units


BLACK = Query(np.zeros((HEIGHT, WIDTH, 3), np.uint8), LENS, "given", LENS)


def test_a_smooth_path_is_searched_once_and_then_followed(room):
    tracker, truth = Tracker(room), path(12)
    found = [tracker.track(query(room, pose, i)) for i, pose in enumerate(truth)]
    assert [followed(estimate) for estimate in found] == [False, *[True] * 11]
    assert {estimate.verdict.status for estimate in found} == {Status.LOCALIZED}
    errors = [pose_distance(estimate.pose, pose) for estimate, pose in zip(found, truth, strict=True)]
    assert max(e[0] for e in errors) < 0.1  # seen: 0.013
    assert max(e[1] for e in errors) < 0.005  # seen: 0.0005
    # No drift: the last is as good as the first.
    assert errors[-1][1] < 0.002
    assert all(estimate.verdict.covariance is not None for estimate in found)
    assert found[5].renders <= 2


def test_a_lost_camera_says_so_and_is_found_again(room):
    tracker, truth = Tracker(room), path(6)
    for i in range(2):
        tracker.track(query(room, truth[i], i))
    blind = tracker.track(BLACK)
    assert blind.verdict.status is Status.NOT_LOCALIZED
    again = tracker.track(query(room, truth[3], 3))
    assert again.verdict.status is Status.LOCALIZED
    assert not followed(again)
    assert close(again.pose, truth[3])
    assert followed(tracker.track(query(room, truth[4], 4)))


def test_a_jump_is_not_followed_into_a_wrong_place(room):
    tracker = Tracker(room)
    tracker.track(query(room, place(1.0, 0.1)))
    there = place(3.5, -0.1)
    found = tracker.track(query(room, there, 1))
    assert close(found.pose, there)
    assert found.verdict.status is Status.LOCALIZED
    assert not followed(found)


@pytest.mark.ci
def test_a_photo_of_elsewhere_on_the_way_is_not_localized(room):
    """Every answer that is called localized is right, whatever comes in between."""
    tracker, truth = Tracker(room), path(4)
    rng = np.random.default_rng(5)
    tracker.track(query(room, truth[0]))
    coarse = rng.integers(0, 255, (12, 16, 3)).astype(np.uint8)
    foreign = query_of(np.kron(coarse, np.ones((20, 20, 1), np.uint8)).astype(np.uint8), intrinsics=LENS)
    assert tracker.track(foreign).verdict.status is not Status.LOCALIZED
    assert close(tracker.track(query(room, truth[2], 2)).pose, truth[2])


def test_times_scale_the_expected_motion(room):
    tracker = Tracker(room)
    a, b = place(1.0, 0.1), place(1.02, 0.1)
    for time_s, pose in ((0.0, a), (0.5, b)):
        tracker.track(query(room, pose), time_s)
    step = a.camera_from_world @ b.world_from_camera
    for time_s, intervals in ((1.0, 1), (1.5, 2), (99.0, 2)):  # a velocity isn't believed for long
        expected = Pose(b.world_from_camera @ np.linalg.matrix_power(step, intervals))
        assert close(tracker._expected(time_s), expected, 0.1, 0.005), time_s


def test_the_gate_is_asked_in_doubt_and_now_and_then(room, monkeypatch):
    asked = []
    monkeypatch.setattr(track, "render_and_verify", lambda *a: asked.append(1) or render_and_verify(*a))
    tracker, truth = Tracker(room, config=TrackingConfig(verify_every=3)), path(7)
    for i, pose in enumerate(truth):
        tracker.track(query(room, pose, i))
    assert len(asked) == 2  # photos 3 and 6 after the first
    monkeypatch.setattr(track, "photometric_suffices", lambda signals, config: False)
    asked.clear()
    estimate = tracker.track(query(room, path(8)[7], 7))
    assert asked
    assert estimate.verdict.inliers > 50
    assert followed(estimate)


def test_photos_tell_their_lens_together(room):
    """The focal length isn't told: it comes to be known better than one photo tells it, and the places with it."""
    truth = [place(1.0 + 0.06 * i, 0.3 * np.sin(0.5 * i)) for i in range(10)]
    guess = replace(LENS, fx=1.08 * FOCAL, fy=1.08 * FOCAL, trust="approximate")
    tracker = Tracker(room, config=TrackingConfig(settled_focal_sigma=0.0))
    found = [tracker.track(query(room, pose, i, guess)) for i, pose in enumerate(truth)]
    alone = found[0]
    assert abs(found[-1].intrinsics.fx / FOCAL - 1) < 0.005  # seen: 0.0005
    assert found[-1].verdict.focal_sigma < alone.verdict.focal_sigma
    assert found[-1].verdict.status is Status.LOCALIZED
    assert close(found[-1].pose, truth[-1], 0.3, 0.02)


def test_a_sequence_ends_with_its_budget_and_on_cancelling(room):
    camera = CameraIdentity(LENS.width, LENS.height)
    photos = [SequencePhoto(f"{i}", i, query(room, pose, i), camera) for i, pose in enumerate(path(5))]
    found = list(localize_sequence(photos, room, Request(budget_renders=1)))
    assert len(found) == 1
    assert found[0].exhausted
    cancel = threading.Event()
    poses = localize_sequence(photos, room, Request(cancel=cancel))
    next(poses)
    cancel.set()
    with pytest.raises(Cancelled):
        next(poses)


def test_photos_of_another_shape_are_searched_for(room):
    tracker = Tracker(room)
    tracker.track(query(room, place(1.0, 0.1)))
    upright = Intrinsics(HEIGHT, WIDTH, FOCAL, FOCAL, HEIGHT / 2, WIDTH / 2)
    pose = place(1.02, 0.1)
    found = tracker.track(query_of(photo(room, pose, 1, upright), intrinsics=upright))
    assert close(found.pose, pose)


class TestBench:
    UNITS = Units(np.zeros(3), 2.0, False)

    def test_the_path_is_smooth_steady_and_goes_through_the_cameras(self):
        stations = [place(a, 0.3 * np.cos(a)) for a in (0.0, 0.9, 0.4, 1.5)]
        poses = bench.smooth_path(stations, self.UNITS, 400)
        assert len(poses) == 400
        steps = [bench._frames_between(a, b, self.UNITS, bench.SEQUENCE) for a, b in pairwise(poses)]
        assert max(steps) < 1.05  # frames; where it turns back, less
        assert np.median(steps) > 0.95
        for station in stations:
            nearest = min(pose_distance(station, pose) for pose in poses)
            assert nearest[0] < bench.SEQUENCE.step_deg
            assert nearest[1] < bench.SEQUENCE.step_units

    def test_the_outcome_counts_what_happened(self, folder, scene_cache):
        shown, wall, cpu = [], time.perf_counter(), time.process_time()
        outcome = bench.run(folder, frames=8, seed=3, progress=lambda *now: shown.append(now), cache_dir=scene_cache)
        assert shown == [(k, 8) for k in range(1, 9)]
        assert (outcome["frames"], outcome["followed"], outcome["false_localized"]) == (8, 7, 0)
        assert outcome["success_1deg_0p01"] == 1.0
        assert 0 < outcome["rotation_deg_p50"] <= outcome["rotation_deg_p100"] < 0.2
        assert 1e3 * (time.perf_counter() - wall) > outcome["latency_ms_p50"] > outcome["decode_ms_p50"] > 0
        assert 1e3 * (time.process_time() - cpu) > outcome["cpu_ms_p50"] > 0
        assert len(outcome["per_frame"]) == 8

    def test_times_are_those_of_frames_that_can_be_tracked(self):
        """The first of four frames takes a second; the errors grow by 0.1 degrees and 0.001 units a frame."""

        def step(number: int, ms: float) -> bench.Step:
            outcome = Outcome(Status.LOCALIZED, 0.1 * number, 0.001 * number, ms, ms / 2)
            return bench.Step(SimpleNamespace(records=[SimpleNamespace(stage="track")]), outcome, 2.0, 6.0)

        told = bench.summary([step(k, ms) for k, ms in enumerate([1000.0, 10.0, 40.0, 20.0])])
        assert (told["first_ms"], told["latency_ms_p50"], told["latency_ms_p100"]) == (1000.0, 20.0, 40.0)
        assert (told["cpu_ms_p50"], told["decode_ms_p50"], told["nees_mean"]) == (10.0, 2.0, 6.0)
        assert (told["drift_deg"], told["drift_units"]) == (pytest.approx(0.3), pytest.approx(0.003))
        assert (told["frames"], told["followed"], told["success_1deg_0p01"]) == (4, 4, 1.0)
        assert bench.summary([step(0, 7.0)])["latency_ms_p50"] == 7.0

    def test_a_scene_without_cameras_has_no_path(self, folder, tmp_path):
        (tmp_path / "scene.ply").write_bytes((folder / "scene.ply").read_bytes())
        with pytest.raises(SceneNotFound, match="two training cameras"):
            bench.run(tmp_path)


def test_a_photo_and_its_file_are_the_same_query(room):
    pixels = photo(room, place(1.0, 0.1))
    a = query_of(pixels, intrinsics=LENS, long_side=200)
    b = read_query(encode_image(pixels, "png"), intrinsics=LENS, long_side=200)
    assert a.intrinsics == b.intrinsics
    assert np.array_equal(a.rgb, b.rgb)


# ------------------------------------------------------------------ live

SHORT = replace(LIVE, search_s=(0.2, 2.0), check_every_s=0.2)


def test_a_live_camera_is_searched_beside_followed_and_found_again(room):
    """Frames as they come from a camera; a lens that was covered for a while; the camera elsewhere afterwards."""
    tracker = LiveTracker(LiveTask("room", "view_index", intrinsics=LENS), room)
    black = encode_image(BLACK.rgb)
    there, elsewhere = path(8), path(6, start=3.0)
    frames = [(k / 30, encode_image(photo(room, pose, k)), pose) for k, pose in enumerate(there)]
    frames += [(0.5 + k / 30, black, None) for k in range(3)]
    frames += [(9 + k / 30, encode_image(photo(room, pose, k)), pose) for k, pose in enumerate(elsewhere)]
    found, number = [], 0
    with closing(tracker):
        for time_s, jpeg, truth in frames:
            # The camera stands still until the search beside has ended.
            for _ in range(200):
                number += 1
                answer = tracker.use(LiveFrame(number, time_s, jpeg))
                if truth is None or answer.mode == "tracking":
                    break
                time.sleep(0.05)
            found.append((answer, truth))
    assert [answer.mode for answer, _ in found] == [*8 * ["tracking"], *3 * ["relocalizing"], *6 * ["tracking"]]
    poses = [(answer, truth) for answer, truth in found if truth is not None]
    assert {answer.verdict.status for answer, _ in poses} == {Status.LOCALIZED}
    assert all(close(answer.pose, truth) for answer, truth in poses)  # seen: 0.02 degrees, 0.001
    assert all(answer.pose is None and answer.verdict is None for answer, truth in found if truth is None)


def test_a_live_frame_without_a_pose_is_carried_by_odometry(room):
    """Odometry in metres, two a scene unit, in a frame of its own; the lens is covered while the camera goes on."""
    scale, start = 0.5, moved(Pose(np.eye(4)), np.array([0.3, -1.0, 0.5, 4.0, 5.0, 6.0]))
    camera = path(40)

    def odom(pose: Pose) -> Pose:
        between = camera[0].camera_from_world @ pose.world_from_camera
        between[:3, 3] /= scale
        return Pose(start.world_from_camera @ between)

    tracker = LiveTracker(LiveTask("room", "view_index", intrinsics=LENS), room, SHORT)
    black = encode_image(BLACK.rgb)
    found, number = [], 0
    with closing(tracker):
        for k, pose in enumerate(camera):
            jpeg = black if 25 <= k < 32 else encode_image(photo(room, pose, k))
            for _ in range(200):
                number += 1
                answer = tracker.use(LiveFrame(number, k / 10, jpeg, odom_from_camera=odom(pose)))
                if answer.mode in ("tracking", "carried"):
                    break
                time.sleep(0.05)
            found.append(answer)
    assert [answer.mode for answer in found[:25] + found[32:]] == 33 * ["tracking"]
    dark = found[25:32]
    assert [answer.mode for answer in dark] == 7 * ["carried"]
    assert all(answer.verdict is None and answer.covariance is not None for answer in dark)
    # Carried on for 0.7 s, by a scale that 25 frames showed; seen: 0.003
    assert all(close(answer.pose, pose, 0.2, 0.02) for answer, pose in zip(dark, camera[25:32], strict=True))
    told = found[-1].odometry
    assert told is not None
    assert told.scale == pytest.approx(scale, rel=0.03)  # seen: 0.004
    matrix = told.world_from_odom @ odom(camera[-1]).world_from_camera
    assert np.linalg.norm(matrix[:3, 3] - camera[-1].position_in_world) < 0.01


@pytest.mark.ci
def test_live_frames_that_fail_alone_are_searched_for_together(room, monkeypatch):
    """Searches of single frames find nothing; odometry relates four frames of a turn, in a scene that has a scale."""
    metric = replace(room, scene=replace(room.scene, info=replace(room.scene.info, metres_per_unit=2.0)))
    search = live_tracker.localize_in_scene

    def nothing(query, loaded, request):
        found = search(query, loaded, request)
        return replace(found, verdict=doubted(found.verdict, Reason.FEW_INLIERS))

    monkeypatch.setattr(live_tracker, "localize_in_scene", nothing)
    camera = [place(1.0 + 0.3 * k, 0.1) for k in range(4)]
    start = moved(Pose(np.eye(4)), np.array([0.3, -1.0, 0.5, 4.0, 5.0, 6.0]))
    with closing(LiveTracker(LiveTask("room", "view_index", intrinsics=LENS), metric, SHORT)) as tracker:
        for number in range(400):
            k = min(number, 3)
            between = camera[0].camera_from_world @ camera[k].world_from_camera
            between[:3, 3] *= 2.0
            odom = Pose(start.world_from_camera @ between)
            frame = LiveFrame(number, k + number / 1000, encode_image(photo(room, camera[k], k)), odom_from_camera=odom)
            answer = tracker.use(frame)
            if answer.mode == "tracking":
                break
            time.sleep(0.05)
    assert answer.mode == "tracking"
    assert answer.verdict.status is Status.LOCALIZED
    assert close(answer.pose, camera[3])


def test_a_live_lens_is_estimated_once_and_kept_for_frames_of_any_size(room):
    wrong = replace(LENS, fx=1.1 * FOCAL, fy=1.1 * FOCAL, trust="approximate")
    half = LENS.resized(WIDTH // 2, HEIGHT // 2)
    with closing(LiveTracker(LiveTask("room", "view_index", intrinsics=wrong), room)) as tracker:
        first = encode_image(photo(room, place(1.0, 0.1)))
        until(lambda: tracker.use(LiveFrame(0, 0.0, first)).mode == "tracking")
        small = tracker.use(LiveFrame(1, 0.1, encode_image(photo(room, place(1.02, 0.1), 1, half))))
        # This frame says what its lens is.
        own = tracker.use(LiveFrame(2, 0.2, encode_image(photo(room, place(1.04, 0.1), 2)), intrinsics=LENS))
        with pytest.raises(InvalidImage, match="at most 4200000 pixels, not 2300 x 2000"):
            tracker.use(LiveFrame(3, 0.3, encode_image(np.zeros((2000, 2300, 3), np.uint8))))
    assert small.intrinsics is not None
    assert small.intrinsics.fx == pytest.approx(FOCAL / 2, rel=0.02)
    assert small.pose is not None
    assert close(small.pose, place(1.02, 0.1), 0.2, 0.05)
    assert own.intrinsics == LENS


def used_until(tracker: LiveTracker, frames: Iterator[LiveFrame], done: Callable[[Live], bool]) -> Live:
    """Give frames to a tracker until an answer is as wanted; return that."""
    for _, frame in zip(range(400), frames, strict=False):
        answer = tracker.use(frame)
        if done(answer):
            return answer
        time.sleep(0.02)
    raise AssertionError("never")


def standing(room: LoadedScene, pose: Pose, start_s: float = 0.0, hidden: float = 0.0) -> Iterator[LiveFrame]:
    """Frames of a camera that stands still, 30 a second; a part of them is hidden by something striped."""
    rgb = photo(room, pose)
    rgb[:, : round(hidden * WIDTH)] = 255 * (np.arange(HEIGHT) // 8 % 2)[:, None, None]
    jpeg = encode_image(rgb)
    return (LiveFrame(round(1000 * (start_s + k / 30)), start_s + k / 30, jpeg) for k in range(10_000))


def test_what_the_whole_gate_refuses_is_uncertain_until_a_search_confirms_it(room, monkeypatch):
    seen, refusing = [], threading.Event()

    def verify(images, pose, rasterizer):
        verdict = render_and_verify(images, pose, rasterizer)
        seen.append(verdict.status)
        return doubted(verdict, Reason.FEW_INLIERS) if refusing.is_set() else verdict

    monkeypatch.setattr(live_tracker, "verify_whole", verify)
    with closing(LiveTracker(LiveTask("room", "view_index", intrinsics=LENS), room, SHORT)) as tracker:
        frames = standing(room, place(1.0, 0.1))
        used_until(tracker, frames, lambda answer: answer.mode == "tracking")
        used_until(tracker, frames, lambda _: bool(seen))
        assert seen[0] is Status.LOCALIZED
        assert tracker.use(next(frames)).verdict.status is Status.LOCALIZED
        refusing.set()
        doubt = used_until(tracker, frames, lambda answer: answer.verdict.status is Status.UNCERTAIN)
        assert (doubt.mode, doubt.verdict.reason) == ("tracking", Reason.FEW_INLIERS)
        assert close(doubt.pose, place(1.0, 0.1))
        refusing.clear()
        again = used_until(tracker, frames, lambda answer: answer.verdict.status is Status.LOCALIZED)
        assert close(again.pose, place(1.0, 0.1))


def test_a_camera_that_is_hidden_more_and_more_is_never_localized_wrongly(room):
    pose = place(1.0, 0.1)
    with closing(LiveTracker(LiveTask("room", "view_index", intrinsics=LENS), room, SHORT)) as tracker:
        used_until(tracker, standing(room, pose), lambda answer: answer.mode == "tracking")
        shares = [0.2, 0.4, 0.6, 0.7, 0.8, 0.95]
        answers = [tracker.use(next(standing(room, pose, 0.1 + share / 10, hidden=share))) for share in shares]
        assert answers[0].verdict.status is Status.LOCALIZED
        assert answers[-1].mode == "relocalizing"
        for answer in answers:
            assert (answer.pose is None) == (answer.verdict is None) == (answer.mode != "tracking")
            # Where most is hidden refinement goes astray, by up to 1.5 degrees here, and says so.
            is_right = answer.pose is not None and close(answer.pose, pose)
            assert is_right or answer.verdict is None or answer.verdict.status is Status.UNCERTAIN


def test_a_camera_that_moves_on_while_it_is_searched_for_is_followed_to_the_present(room, monkeypatch):
    """However long the search takes: what is kept of the way is thinned out, its beginning stays."""
    go_on, searches, search = threading.Event(), [], live_tracker.localize_in_scene

    def waiting(*arguments):
        searches.append(arguments)
        assert go_on.wait(20)
        return search(*arguments)

    monkeypatch.setattr(live_tracker, "localize_in_scene", waiting)
    way = path(45)  # 50 degrees
    jpegs = [encode_image(photo(room, pose, k)) for k, pose in enumerate(way)]
    few = replace(SHORT, kept=20, search_s=(10.0,))
    with closing(LiveTracker(LiveTask("room", "view_index", intrinsics=LENS), room, few)) as tracker:
        for number, jpeg in enumerate(jpegs):
            assert tracker.use(LiveFrame(number, number / 10, jpeg)).mode == "relocalizing"
        go_on.set()
        last = (LiveFrame(100 + k, 4.5 + k / 1000, jpegs[-1]) for k in range(1000))
        found = used_until(tracker, last, lambda answer: answer.mode == "tracking")
    assert len(searches) == 1
    assert found.verdict.status is Status.LOCALIZED
    assert close(found.pose, way[-1])


def test_what_runs_beside_yields_and_ends_when_it_is_not_wanted():
    began = threading.Event()

    def call(cancel: threading.Event) -> int:
        began.set()
        assert cancel.wait(10)
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) if sys.platform == "linux" else 0

    background: Background[int] = Background()
    with closing(background):
        assert background.result() is None
        background.start(call)
        assert began.wait(10)
        assert not background.idle
        assert background.result() is None
        background.cancel()
        while (nice := background.result()) is None:
            time.sleep(0.005)
        assert background.idle
    if sys.platform == "linux":
        assert nice > os.getpriority(os.PRIO_PROCESS, 0)
    ended, other = threading.Event(), Background[None]()
    other.start(lambda cancel: (cancel.wait(10), time.sleep(0.05), ended.set())[-1])
    other.close()
    assert ended.is_set()


def test_the_film_of_a_live_bench_has_its_parts_and_true_poses(room):
    training = [named.camera for named in room.scene.cameras]
    config = FilmConfig(fps=10.0, locked_s=5.0)
    film = make_film(
        [c.pose for c in training], LENS, room.rasterizer, Units(np.zeros(3), 1.0, False), 2.0, 3, None, config
    )
    assert [shot.part for shot in film] == [
        *3 * ["steady"], *3 * ["exposure"], *3 * ["occluded"], *2 * ["dark"], *3 * ["blurred"], *3 * ["jumped"],
        *3 * ["unlocked"],
    ]  # fmt: skip
    assert np.diff([shot.time_s for shot in film]).round(6).tolist() == [*16 * [0.1], 5.1, 0.1, 0.1]
    assert [shot.truth is None for shot in film] == [shot.part == "dark" for shot in film]
    seen = {shot.part: read_query(shot.jpeg).rgb.astype(float) for shot in reversed(film)}
    assert seen["dark"].mean() < 10
    first = film[0].truth
    assert first is not None
    plain = 255 * room.rasterizer.render([Camera(LENS, first)])[0].rgb
    assert np.abs(seen["steady"] - np.clip(plain, 0, 255)).mean() < 8  # seen: 4, noise and JPEG
    # What the service says of this frame is right.
    assert close(Tracker(room).track(read_query(film[0].jpeg, intrinsics=LENS)).pose, first)


def test_the_figures_of_a_live_bench_are_those_of_what_was_heard():
    shots = [Shot("steady", k / 10, b"", Pose(np.eye(4))) for k in range(8)]
    shots += [
        Shot("dark", 0.8, b"", Pose(np.eye(4))),
        Shot("jumped", 0.9, b"", Pose(np.eye(4))),
        Shot("jumped", 1.0, b"", Pose(np.eye(4))),
    ]
    told = SessionLog(shots)

    def hear(number: int, at_s: float, off: float | None, status: str = "localized") -> None:
        matrix = (
            None if off is None else moved(Pose(np.eye(4)), np.array([0, 0, 0, off, 0, 0])).world_from_camera.tolist()
        )
        mode = "lost" if off is None else "tracking"
        told.answers[number] = LiveAnswer(number, 0.0, mode, status, None, None, matrix, None, None, 5.0, 15.0, [])
        told.heard_at[number] = at_s

    for number, shot in enumerate(shots[:7] + shots[8:]):  # one is lost on the way
        told.sent_at[number], told.shot_of[number] = shot.time_s, number + (number > 6)
    for number in range(5):
        hear(number, 0.1 + number / 10, 0.0)
    hear(5, 0.6, 0.02, "uncertain")  # within a degree, beyond 0.01
    hear(7, 0.9, 0.0, "uncertain")  # in the dark nothing can be right
    hear(8, 1.0, None, "not_localized")
    hear(9, 1.25, 0.06)  # wrong
    found = figures(told, Units(np.zeros(3), 1.0, False), LENS)
    assert (found["sent"], found["wrong_localized"]) == (10, 1)
    assert found["right"] == 5 / 10
    assert found["localized"] == 6 / 10
    assert found["used_per_s"] == pytest.approx(10 * 8 / 10)
    assert found["right_by_part"] == {"steady": 5 / 8, "jumped": 0.0}
    assert found["arrival_to_answer_ms_p95"] == 20.0
    assert found["back_s"]["steady"] == pytest.approx(0.1)
    assert found["back_s"]["jumped"] == pytest.approx(0.35)
    assert found["back_s"]["unlocked"] is None
