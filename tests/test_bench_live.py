"""`splatfix bench live` with a planted clock, service and odometry: who hears what when, and what is made of it."""

from __future__ import annotations

import io
import threading
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_bench import LENS, poses

from service.bench import live
from service.bench.live import LinkConfig, SessionLog
from service.bench.live_film import Shot
from service.bench.live_odometry import (
    ODOMETRY,
    OdometryConfig,
    displayed,
    odometry_figures,
    units_per_metre,
    with_odometry,
)
from service.bench.pose_metrics import Units
from service.client import ServiceError
from service.errors import SceneNotFound
from service.geometry import look_at, moved, se3_exp, se3_log, so3_exp
from service.live_client import LiveAnswer, LiveClosed
from service.types import Camera, Intrinsics, Pose

UNITS = Units(np.zeros(3), 0.5, False)
"""A normalized unit is two scene units, and 0.6 m: a metre is 10 / 3 scene units."""
METRE = 1 / (0.6 * 0.5)
UP = np.array([0.0, 0.0, 1.0])
EXACT = OdometryConfig(drift=0.0, turn_deg=0.0)


def walk(count: int, step_m: float, part: Any = "steady", begin: int = 0) -> list[Shot]:
    """Frames of a camera that walks along x, turning about the upright, 30 a second."""
    shots = []
    for k in range(begin, begin + count):
        at, heading = np.array([k * step_m * METRE, 0.0, 0.0]), 0.01 * k
        pose = look_at(at, at + np.array([np.cos(heading), np.sin(heading), -0.2]), UP)
        shots.append(Shot(part, k / 30, b"", pose))
    return shots


def steps(shots: list[Shot]) -> list[np.ndarray]:
    return [a.odom.camera_from_world @ b.odom.world_from_camera for a, b in pairwise(shots)]  # type: ignore[union-attr]


def true_steps(shots: list[Shot]) -> list[np.ndarray]:
    found = [a.pose.camera_from_world @ b.pose.world_from_camera for a, b in pairwise(shots)]
    for step in found:
        step[:3, 3] /= METRE
    return found


# ------------------------------------------------------------------ the device


def test_a_device_without_errors_tells_the_motion_in_metres() -> None:
    shots = with_odometry(walk(40, 0.02), UNITS, UP, config=EXACT)
    assert units_per_metre(UNITS) == pytest.approx(METRE)
    np.testing.assert_allclose(steps(shots), true_steps(shots), atol=1e-9)
    # It knows nothing of the scene's frame: another film's begins elsewhere, by any rotation.
    starts = [with_odometry(walk(1, 0.02), UNITS, UP, seed)[0].odom for seed in range(200)]
    turns = [np.linalg.norm(se3_log(start.world_from_camera)[:3]) for start in starts if start]
    assert 0 <= min(turns) < 0.1
    assert 3.0 < max(turns) <= np.pi
    axes = np.array([se3_log(start.world_from_camera)[:3] for start in starts if start])
    assert np.abs((axes / np.linalg.norm(axes, axis=1)[:, None]).mean(0)).max() < 0.15


def test_it_begins_anew_while_it_sees_nothing_and_after_a_jump_and_a_pause() -> None:
    film = walk(4, 0.02) + walk(5, 0.02, "occluded", 4) + walk(3, 0.02, "jumped", 9)
    film += walk(3, 0.02, "blurred", 12) + walk(2, 0.02, "unlocked", 15)
    shots = with_odometry(film, UNITS, UP, config=EXACT)
    off = [np.abs(a - b).max() for a, b in zip(steps(shots), true_steps(shots), strict=True)]
    # The middle of the occluded part, the first frame of a jump, the first one after a pause.
    assert [number for number, each in enumerate(off, 1) if each > 1e-6] == [6, 9, 15]


def test_its_position_drifts_by_a_hundredth_of_the_way_in_a_direction_that_changes_slowly() -> None:
    config = OdometryConfig(turn_deg=0.0)
    assert (config.drift, config.drift_changes_m, ODOMETRY.turn_deg) == (0.01, 2.0, 0.1)
    correlations = []
    for seed in range(60):
        shots = with_odometry(walk(41, 0.1), UNITS, UP, seed, config)
        ends = [shot.odom.world_from_camera[:3, :3] for shot in shots[1:] if shot.odom]
        errors = [
            # In the odometry's own frame.
            end @ (np.linalg.inv(true) @ told)[:3, 3]
            for end, true, told in zip(ends, true_steps(shots), steps(shots), strict=True)
        ]
        assert np.linalg.norm(errors, axis=1) == pytest.approx(0.01 * 0.1, rel=1e-6)
        directions = np.array(errors) / 0.001
        assert (directions[:-1] * directions[1:]).sum(1).mean() > 0.93
        correlations.append((directions[:-20] * directions[20:]).sum(1).mean())
    # A direction that wanders on a sphere: after its length of two metres, exp(-2 / 3) is left; 0.07 at half of it.
    assert np.mean(correlations) == pytest.approx(np.exp(-2 / 3), abs=0.13)


def test_its_heading_drifts_about_the_upright_with_the_root_of_the_way() -> None:
    for step_m in (0.02, 0.32):
        shots = with_odometry(walk(600, step_m), UNITS, UP, config=OdometryConfig(drift=0.0, turn_deg=1.0))
        turns = []
        for true, told, shot in zip(true_steps(shots), steps(shots), shots[1:], strict=True):
            turn = se3_log(np.linalg.inv(true) @ told)[:3]
            up = shot.pose.world_from_camera[:3, :3].T @ UP
            assert turn == pytest.approx((turn @ up) * up, abs=1e-9)
            turns.append(turn @ up)
        # A degree after a metre.
        assert np.std(turns) == pytest.approx(np.radians(1.0) * np.sqrt(step_m), rel=0.09)


# ------------------------------------------------------------------ what a client shows

WORLD_FROM_ODOM = se3_exp(np.array([0.3, -0.2, 0.9, 1.0, 2.0, 3.0])) @ np.diag([METRE] * 3 + [1.0])
"""A similarity transform, with the true scale."""


def placed(shots: list[Shot]) -> list[Shot]:
    """Give frames the odometry by which WORLD_FROM_ODOM is right."""
    found = []
    for shot in shots:
        matrix = np.linalg.inv(WORLD_FROM_ODOM) @ shot.pose.world_from_camera
        matrix[:3, :3] *= METRE
        found.append(replace(shot, odom=Pose(matrix)))
    return found


def answer(number: int, shot: Shot, scale: float = 1.0, mode: str = "tracking", known: bool = True) -> LiveAnswer:
    found = LiveAnswer(number, shot.time_s, mode, "localized", None, None, None, None, None, 1.0, 2.0, [])
    if not known:
        return found
    world_from_odom = WORLD_FROM_ODOM @ np.diag([scale] * 3 + [1.0])
    covariance = np.diag([1e-4] * 3 + [1e-2] * 3 + [1e-4]).tolist()
    return replace(
        found, world_from_odom=world_from_odom.tolist(), units_per_odom=METRE * scale, odom_covariance=covariance,
        odom_resets=number,
    )  # fmt: skip


def test_a_frame_is_shown_by_the_newest_answer_that_was_heard_before_it() -> None:
    shots = placed(walk(8, 0.02))
    answers = {k: answer(k, shots[k]) for k in (0, 1, 2)}
    # The second one is wrong in scale; it is heard with the frame at 3 / 30, the third one at 5 / 30.
    answers[1] = answer(1, shots[1], 1.5)
    heard_at = {0: 1.5 / 30, 1: shots[3].time_s, 2: 4.5 / 30}
    shown = displayed(shots, answers, heard_at)
    assert shown[:2] == [None, None]
    right = [pose is not None and np.allclose(pose.world_from_camera, shot.pose.world_from_camera, atol=1e-6)
             for pose, shot in zip(shown, shots, strict=True)]  # fmt: skip
    assert right == [False, False, True, False, False, True, True, True]
    # An answer without the odometry's place is no help, and takes the last one's place.
    answers[2] = answer(2, shots[2], known=False)
    assert [pose is not None for pose in displayed(shots, answers, heard_at)] == [False] * 2 + [True] * 3 + [False] * 3
    # An order that is not that of the frames: what is heard last counts.
    swapped = displayed(shots, {0: answer(0, shots[0]), 1: answers[1]}, {0: 3.5 / 30, 1: 0.5 / 30})
    assert swapped[7] is not None
    assert np.allclose(swapped[7].world_from_camera, shots[7].pose.world_from_camera, atol=1e-6)


@pytest.mark.parametrize(
    ("twist", "anew"), [([0.55, 0, 0, 0, 0, 0], True), ([0.45, 0, 0, 0, 0, 0], False),
                        ([0, 0, 0, 0.55, 0, 0], True), ([0, 0, 0, 0, 0.45, 0], False)],
)  # fmt: skip
def test_after_a_reset_nothing_is_shown_until_an_answer_knows_of_it(twist: list[float], anew: bool) -> None:
    """The motion of one frame that no hand makes: more than half a radian, or half a metre."""
    shots = placed(walk(6, 0.0))
    for k in range(3, 6):
        shots[k] = replace(shots[k], odom=moved(shots[k].odom, np.array(twist)))  # type: ignore[arg-type]
    answers, heard_at = {0: answer(0, shots[0]), 4: answer(4, shots[4])}, {0: 0.5 / 30, 4: 4.5 / 30}
    shown = [pose is not None for pose in displayed(shots, answers, heard_at)]
    assert shown == [False, True, True, not anew, not anew, True]


def test_the_odometrys_figures_are_those_of_planted_answers() -> None:
    camera = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    shots = placed(walk(60, 0.05) + walk(4, 0.05, "dark", 60))
    # Turned by a hundredth of a radian about the viewing direction: points move by their distance from the middle.
    turned = moved(shots[1].pose, np.array([0, 0, 0.01, 0, 0, 0]))
    shown: list[Pose | None] = [
        shots[0].pose,
        turned,
        None,
        *(None for _ in shots[3:60]),
        shots[0].pose,
        None,
        None,
        None,
    ]
    scales = {0: 1.5, 10: 1.2, 21: 1.1, 30: 1.0, 40: 0.9, 62: 1.0}
    answers = {k + 100: answer(k, shots[k], scale) for k, scale in scales.items()}
    answers[141] = answer(41, shots[41], known=False)
    answers[142] = answer(5, shots[42], mode="carried", known=False)
    shot_of = {number: number - 100 for number in answers}
    found = odometry_figures(shots, answers, shot_of, shown, camera, UNITS)
    assert found["overlay_share"] == 2 / 60
    x, y = np.meshgrid(np.linspace(64, 576, 5) - 320, np.linspace(48, 432, 5) - 240)
    off = np.hypot(x, y).mean() * 2 * np.sin(0.005)
    assert found["overlay_px_p50"] == pytest.approx(off / 2, rel=1e-6)
    assert found["overlay_px_p95"] == pytest.approx(0.95 * off, rel=1e-6)
    # The camera is a metre away after 20 steps of 5 cm, and farther from the 21st on.
    assert found["scale_off_after_a_metre"] == pytest.approx(0.1)
    assert found["scale_off_p95"] == pytest.approx(0.1)
    # The scale is a sigma of 1 % off: 1.0 is in the region, what is a tenth off is not.
    assert found["in_region"] == pytest.approx(2 / 6)
    assert (found["resets"], found["carried"]) == (62, 1)
    # A shift to the side moves points that are four normalized, eight scene units away by 500 / 8 pixels a unit.
    shown = [moved(shots[0].pose, np.array([0, 0, 0, 0.1, 0, 0])), *(None for _ in shots[1:])]
    assert odometry_figures(shots, answers, shot_of, shown, camera, UNITS)["overlay_px_p50"] == pytest.approx(6.25)
    nothing = odometry_figures(shots, {}, {}, [None] * 64, camera, UNITS)
    assert nothing == dict.fromkeys(nothing, None) | {"overlay_share": 0.0, "resets": 0, "carried": 0}


@pytest.mark.parametrize(("sigmas", "inside"), [(3.74, True), (3.76, False)])
@pytest.mark.parametrize("axis", [0, 2, 3, 5, 6])
def test_a_region_holds_the_truth_to_95_percent_of_seven_degrees_of_freedom(
    axis: int, sigmas: float, inside: bool
) -> None:
    """The quantile is 14.07: 3.751 sigma along one axis."""
    (shot,) = placed(walk(1, 0.0))
    gap = np.zeros(7)
    gap[axis] = sigmas * (1e-2 if axis in (0, 2, 6) else 0.1)
    scale = np.exp(gap[6])
    told = moved(shot.pose, -gap[:6])
    # What the answer has to say so that the client shows that place.
    world_from_odom = told.world_from_camera.copy()
    world_from_odom[:3, :3] *= METRE / scale
    inverse = shot.odom.camera_from_world.copy()  # type: ignore[union-attr]
    one = replace(answer(0, shot), world_from_odom=(world_from_odom @ inverse).tolist(), units_per_odom=METRE / scale)
    found = odometry_figures([shot], {0: one}, {0: 0}, [None], LENS, UNITS)
    assert found["in_region"] == float(inside)


def test_a_session_with_odometry_counts_frames_that_the_client_carried_on() -> None:
    shots = placed(walk(8, 0.02))
    told = SessionLog(shots, {k: k / 30 for k in range(8)}, {k: k for k in range(8)})
    matrix = shots[0].pose.world_from_camera.tolist()
    told.answers[0], told.heard_at[0] = replace(answer(0, shots[0]), world_from_camera=matrix), 0.05 / 30
    # The fourth frame has an answer with a wrong pose of its own, which counts whatever the odometry says.
    wrong = moved(shots[3].pose, np.array([0, 0, 0, 1.0, 0, 0])).world_from_camera.tolist()
    told.answers[3], told.heard_at[3] = replace(answer(3, shots[3]), world_from_camera=wrong), 3.5 / 30
    matrix = shots[4].pose.world_from_camera.tolist()
    told.answers[4], told.heard_at[4] = replace(answer(4, shots[4]), world_from_camera=matrix), 4.5 / 30
    found = live.figures(told, UNITS, LENS)
    assert found["right"] == 7 / 8
    assert found["right_of_answered"] == 2 / 3
    assert found["wrong_localized"] == 1
    assert found["overlay_share"] == 7 / 8
    told.shots = [replace(shot, odom=None) for shot in shots]
    found = live.figures(told, UNITS, LENS)
    assert found["right"] == 2 / 8
    assert "overlay_share" not in found


# ------------------------------------------------------------------ sessions


class Clock:
    """Time passes by sleeping alone."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.cpu = 50.0

    def perf_counter(self) -> float:
        return self.now

    monotonic = perf_counter

    def process_time(self) -> float:
        return self.cpu

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(live, "time", clock)
    return clock


class Service:
    """Live sessions that answer each frame at once; the third answer of each has a hint, and so has the fourth."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
        self.opened: list[dict[str, Any]] = []
        self.sent: list[tuple[float, bytes, float, Any]] = []
        self.closed = 0
        service = self

        class Live:
            def __init__(self, url: str, scene: str, **given: Any) -> None:
                service.opened.append({"url": url, "scene": scene, **given})
                self.hint: dict[str, Any] | None = None
                self._answers: list[LiveAnswer] = []
                self._changed, self._closed, self._told = threading.Condition(), False, 0

            def __enter__(self) -> Live:
                return self

            def __exit__(self, *_: object) -> None:
                assert self._closed, "the session was not closed"

            def send(self, image: bytes, time_s: float, odom_from_camera: Any = None) -> int:
                service.sent.append((clock.now - 1000.0, image, time_s, odom_from_camera))
                number = 7 + len(service.sent)
                with self._changed:
                    self._answers.append(answer(number, Shot("steady", time_s, b"", Pose(np.eye(4))), known=False))
                    self._changed.notify_all()
                    self._changed.wait_for(lambda: not self._answers, 5)
                return number

            def answer(self) -> LiveAnswer:
                with self._changed:
                    self._changed.wait_for(lambda: self._answers or self._closed, 5)
                    if not self._answers:
                        raise LiveClosed("closed", 1000)
                    self._told += 1
                    self.hint = {3: {"a": 1}, 4: {"a": 1}, 5: {"b": 2}}.get(self._told)
                    found = self._answers.pop()
                    self._changed.notify_all()
                    return found

            def close(self) -> None:
                service.closed += 1
                with self._changed:
                    self._closed = True
                    self._changed.notify_all()

        monkeypatch.setattr(live, "Live", Live)


def test_frames_come_at_their_times_with_the_links_delay_in_their_order(
    monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    service = Service(monkeypatch, clock)
    film = [replace(shot, jpeg=bytes([k])) for k, shot in enumerate(placed(walk(60, 0.02)))]
    threads = threading.active_count()
    (told,) = live.play(film, "http://s", "room", 1, LENS, 3, LinkConfig(0.1, 0.05, 0.0))
    assert threading.active_count() == threads
    assert service.closed == 1
    (opened,) = service.opened
    assert opened == {
        "url": "http://s", "scene": "room", "odometry": {"metric": False}, "proxy": None,
        "intrinsics": {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 33.0, "cy": 23.0},
    }  # fmt: skip
    assert [image for _, image, _, _ in service.sent] == [shot.jpeg for shot in film]
    assert [taken for _, _, taken, _ in service.sent] == [shot.time_s for shot in film]
    np.testing.assert_allclose([odom for *_, odom in service.sent], [s.odom.world_from_camera for s in film if s.odom])
    late = np.array([at - taken for at, _, taken, _ in service.sent])
    assert 0.05 <= late.min() < 0.08
    assert 0.13 < late.max() <= 0.15 + 1e-9
    assert told.shot_of == {8 + k: k for k in range(60)}
    assert list(told.sent_at.values()) == pytest.approx([at for at, *_ in service.sent])
    assert set(told.answers) == set(told.heard_at) == set(told.shot_of)
    assert all(0 <= told.heard_at[number] - told.sent_at[number] < 1e-6 for number in told.answers)
    assert told.hints == [{"a": 1}, {"b": 2}]
    # The last answers are waited for.
    assert clock.now == pytest.approx(1000.0 + service.sent[-1][0] + 1.0)


def test_a_poor_link_loses_its_share_and_each_session_has_a_link_of_its_own(
    monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    service = Service(monkeypatch, clock)
    monkeypatch.setattr(live.threading, "Thread", InTurn)
    two = live.play(walk(400, 0.02), "http://s", "room", 2, None, 3, LinkConfig(0.0, 0.0, 0.1))
    lost = [set(range(400)) - set(told.shot_of.values()) for told in two]
    assert all(len(each) == pytest.approx(40, abs=20) for each in lost)
    assert lost[0] != lost[1]
    assert all(opened["intrinsics"] is None and opened["odometry"] is None for opened in service.opened)
    assert all(odom is None for *_, odom in service.sent)
    assert len(service.opened) == service.closed == 2


class InTurn(threading.Thread):
    """A session's thread runs to its end before the next one begins."""

    def start(self) -> None:
        is_session = "_session" in self.name
        super().start()
        if is_session:
            self.join()


def test_a_warm_up_ends_after_more_than_thirty_frames_that_were_tracked(
    monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    sent: list[tuple[bytes, float, float]] = []
    modes: Any = iter([])

    class Live:
        def __init__(self, url: str, scene: str, *, intrinsics: Any, proxy: None) -> None:
            assert (url, scene, intrinsics["fx"]) == ("http://s", "room", 60.0)

        def __enter__(self) -> Live:
            return self

        def __exit__(self, *_: object) -> None: ...

        def send(self, image: bytes, time_s: float) -> None:
            sent.append((image, time_s, clock.now))

        def answer(self, timeout_s: float) -> Any:
            mode = next(modes, "lost")
            return mode and SimpleNamespace(mode=mode)

    monkeypatch.setattr(live, "Live", Live)
    film = [Shot("steady", 0.0, b"first", Pose(np.eye(4))), Shot("steady", 0.1, b"second", Pose(np.eye(4)))]
    modes = iter(["lost", None, "tracking", "relocalizing"] + ["tracking"] * 50)
    live._warm_up("http://s", "room", film, LENS)
    assert len(sent) == 3 + 31
    assert {image for image, _, _ in sent} == {b"first"}
    # Of a film of 15 frames a second, at no more than 20 a second.
    assert np.diff([time_s for _, time_s, _ in sent]) == pytest.approx(1 / 15)
    assert np.diff([at for _, _, at in sent]) == pytest.approx(0.05)
    sent.clear()
    modes = iter([])
    live._warm_up("http://s", "room", film, LENS)
    assert len(sent) == 600


# ------------------------------------------------------------------ the service's process


class Ready:
    """A service that can't be reached for a while."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, errors: list[Exception]) -> None:
        self.waited: list[tuple[str, float]] = []
        ready = self

        class Client:
            def __init__(self, url: str) -> None:
                assert url == "http://s"

            def __enter__(self) -> Client:
                return self

            def __exit__(self, *_: object) -> None: ...

            def scenes(self) -> list[Any]:
                if errors:
                    raise errors.pop(0)
                return [SimpleNamespace(id="room")]

            def wait_until_ready(self, scene: str, timeout_s: float) -> None:
                ready.waited.append((scene, timeout_s))

        monkeypatch.setattr(live, "Client", Client)


def test_a_service_is_waited_for_until_its_scene_is_ready(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    away = [ServiceError("unreachable", "refused") for _ in range(3)]
    ready = Ready(monkeypatch, [*away])
    assert live._ready_scene("http://s", 30.0) == "room"
    assert ready.waited == [("room", 30.0)]
    assert clock.now == pytest.approx(1000.6)
    Ready(monkeypatch, [ServiceError("corrupt_scene", "no scene"), *away])
    with pytest.raises(ServiceError, match="no scene"):
        live._ready_scene("http://s")
    Ready(monkeypatch, away * 99)
    began = clock.now
    with pytest.raises(ServiceError, match="refused"):
        live._ready_scene("http://s", 10.0)
    assert clock.now - began == pytest.approx(10.2, abs=0.21)


@pytest.mark.parametrize("fails", [False, True])
def test_a_service_is_a_process_on_its_own_processors_that_ends(
    fails: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    done: list[Any] = []

    class Popen:
        pid = 77

        def __init__(self, command: list[str], env: dict[str, str], stdout: int) -> None:
            done.append((command, {name: env[name] for name in env if name.startswith("SPLATFIX_")}))

        def terminate(self) -> None:
            done.append("terminate")

        def wait(self) -> None:
            done.append("wait")

    def ready(url: str) -> str:
        if fails:
            raise ServiceError("unreachable", "refused")
        return f"the scene at {url}"

    monkeypatch.setattr(live.subprocess, "Popen", Popen)
    monkeypatch.setattr(live, "keep_to_cores", lambda pid, cores: done.append((pid, cores)))
    monkeypatch.setattr(live, "_ready_scene", ready)
    for name in ("DATA_DIR", "KEYS_FILE", "VIEWER", "CACHE_DIR"):
        monkeypatch.delenv(f"SPLATFIX_{name}", raising=False)
    try:
        with live._service(Path("room"), 3, tmp_path) as (url, scene):
            assert scene == f"the scene at {url}"
            assert done[-1] == (77, 3)
        assert not fails
    except ServiceError:
        assert fails
    command, settings = done[0]
    assert command[1:5] == ["-m", "service", "serve", "room"]
    assert command[5] == "--port"
    assert 0 < int(command[6]) < 65536
    data = settings["SPLATFIX_DATA_DIR"]
    assert settings["SPLATFIX_KEYS_FILE"] == str(Path(data, "keys.json"))
    assert (settings["SPLATFIX_VIEWER"], settings["SPLATFIX_CACHE_DIR"]) == ("false", str(tmp_path))
    assert not Path(data).exists()
    assert done[1:] == [(77, 3), "terminate", "wait"]


def test_the_services_processor_time_is_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    text = b"# HELP process_cpu_seconds_total Total\nother 1.0\nprocess_cpu_seconds_total 12.5\nlast 2.0\n"
    opener = SimpleNamespace(open=lambda address, timeout: io.BytesIO(text) if address == "http://s/metrics" else None)
    monkeypatch.setattr(live, "build_opener", lambda handler: opener)
    assert live._cpu_s("http://s") == 12.5


# ------------------------------------------------------------------ a run


@pytest.fixture
def planted(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> SimpleNamespace:
    """A run whose film has ten frames, and whose service takes 3 s of 20."""
    seen = SimpleNamespace(cameras=[SimpleNamespace(camera=Camera(replace(LENS, width=32), p)) for p in poses()[:2]])
    seen.done, seen.cpu = [], iter([2.0, 5.0])
    scene = SimpleNamespace(cameras=seen.cameras)
    loaded = SimpleNamespace(scene=scene, rasterizer="renderer")

    class Served:
        def __init__(self, folder: Path, cores: int, cache_dir: Path | None) -> None:
            seen.done.append(("serve", folder, cores, cache_dir))

        def __enter__(self) -> tuple[str, str]:
            return "http://s", "room"

        def __exit__(self, *_: object) -> None:
            seen.done.append("end")

    def make_film(stations: Any, camera: Intrinsics, rasterizer: Any, units: Units, *more: Any) -> list[Shot]:
        assert stations == [one.camera.pose for one in scene.cameras]
        assert (rasterizer, units.units_per_scene_unit) == ("renderer", 0.5)
        seen.camera = camera
        return walk(10, 0.02)

    def play(film: Any, url: str, scene: str, sessions: int, camera: Any, seed: int, link: Any) -> list[SessionLog]:
        assert (url, scene) == ("http://s", "room")
        seen.film, seen.given = film, camera
        seen.done.append("play")
        clock.now += 20.0
        clock.cpu += 4.0
        told = [SessionLog(film) for _ in range(sessions)]
        for one in told:
            one.answers |= dict.fromkeys(range(5), None)  # type: ignore[arg-type]
        return told

    monkeypatch.setattr(live, "load_scene", lambda folder: scene)
    monkeypatch.setattr(live.LoadedScene, "of", lambda scene, cache_dir: loaded)
    monkeypatch.setattr(live, "units_of", lambda cameras, depth_of: UNITS)
    monkeypatch.setattr(live, "make_film", make_film)
    monkeypatch.setattr(live, "_service", Served)
    monkeypatch.setattr(live, "_warm_up", lambda url, scene, film, camera: seen.done.append("warm up"))
    monkeypatch.setattr(live, "_cpu_s", lambda url: seen.done.append("cpu") or next(seen.cpu))
    monkeypatch.setattr(live, "play", play)
    monkeypatch.setattr(live, "figures", lambda told, units, camera: len(told.shots))
    return seen


def test_a_run_counts_what_service_and_clients_take_while_the_film_is_played(planted: SimpleNamespace) -> None:
    found = live.run(Path("room"), sessions=3, cores=2, seed=9)
    assert planted.done == [("serve", Path("room"), 2, None), "warm up", "cpu", "play", "cpu", "end"]
    assert found["service_cpu_share"] == pytest.approx(3 / 20)
    assert found["service_cpu_ms_a_frame"] == pytest.approx(3000 / 15)
    assert found["clients_cpu_share"] == pytest.approx(4 / 20)
    assert (found["frames"], found["sessions"], found["intrinsics"]) == (10, [10] * 3, "given")
    # The first training camera's angle of view, at 640 pixels; it is 32 wide.
    assert planted.camera == planted.given == Intrinsics(640, 480, 1200.0, 1200.0, 320.0, 240.0)
    # The cameras' mean upright is what the odometry's heading drifts about.
    assert all(shot.odom is not None for shot in planted.film)


def test_a_run_withholds_intrinsics_and_odometry_where_that_is_asked(planted: SimpleNamespace) -> None:
    found = live.run(Path("room"), withheld=True, odometry=False)
    assert (found["intrinsics"], found["odometry"], planted.given) == ("withheld", False, None)
    assert all(shot.odom is None for shot in planted.film)
    planted.cameras.pop()
    with pytest.raises(SceneNotFound, match="two training cameras"):
        live.run(Path("room"))


def test_the_odometrys_upright_is_a_unit_vector_against_the_cameras_y(
    planted: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    turn = np.eye(4)
    turn[:3, :3] = so3_exp(np.array([0.0, 0.0, np.pi / 2]))
    for one, pose in zip(planted.cameras, (Pose(np.eye(4)), Pose(turn)), strict=True):
        one.camera = Camera(LENS, pose)
    ups = []
    monkeypatch.setattr(live, "with_odometry", lambda film, units, up, seed: ups.append(up) or film)
    live.run(Path("room"))
    assert ups[0] == pytest.approx(np.array([1.0, -1.0, 0.0]) / np.sqrt(2))
