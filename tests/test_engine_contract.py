"""What every engine promises: the embedded one, and one whose scenes are in another process.

The second half runs tests of the API on a service whose engine is a subprocess. All of them run so by hand:

    SPLATFIX_TEST_ENGINE=subprocess python -m pytest tests/test_api.py tests/test_durable.py tests/test_scenes.py \\
        tests/test_sequences.py tests/test_clients.py tests/test_security.py tests/test_hostile.py \\
        tests/test_route_policy.py tests/test_errors.py

What can't, because it doesn't speak HTTP only, is listed in `api_server.NOT_IN_A_SUBPROCESS`, and skipped then.
"""

from __future__ import annotations

import os
import pickle
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import test_api
import test_sequences
from api_server import GO_ON, create_app, events, finished, post, serving, settings, until, until_ready
from stand_ins import PHOTO, TURNED, make_scene, packed, set_up_engine
from subprocess_engine import SubprocessEngine
from test_scenes import ply

from service.errors import (
    BadInput,
    CorruptScene,
    EstimatorFault,
    InvalidImage,
    InvalidIntrinsics,
    SceneInUse,
    SceneNotFound,
    SceneNotReady,
    SceneUnloaded,
    SplatfixError,
)
from service.jobs.embedded_engine import EmbeddedEngine, EngineConfig
from service.jobs.engine import Engine, EngineLost, HeldScenes, LocalizeTask, SequenceSource
from service.jobs.model import JobRecord
from service.live.live_values import LiveAnswer, LiveFrame, LiveTask
from service.localize import Cancelled
from service.photos.images import read_query
from service.photos.sequence import SequenceOptions
from service.photos.sequence import packed as packed_photos
from service.results import StageTiming, Status
from service.scene_manager.status import AUTO, PictureSpec, StoredScene
from service.types import Intrinsics, Pose, Query


class PicklingEngine(EmbeddedEngine):
    """The embedded engine, if all that goes in and out were sent elsewhere: proof that it is plain data."""

    def __getattribute__(self, name: str):
        found = super().__getattribute__(name)
        if name.startswith("_") or not callable(found):
            return found

        def through_pickle(*arguments, **named):
            plain = [a if callable(a) else pickle.loads(pickle.dumps(a)) for a in arguments]
            return pickle.loads(pickle.dumps(found(*plain, **named)))

        return through_pickle


KINDS: dict[str, Callable[[EngineConfig], Engine]] = {
    "embedded": EmbeddedEngine,
    "pickling": PicklingEngine,
    "subprocess": lambda config: SubprocessEngine(config, set_up=partial(set_up_engine, {}, GO_ON)),
}


def ray_engine(config: EngineConfig, set_up, replicas: int = 2) -> Engine:
    """The engine on a Ray cluster of two processes on this machine; skips where Ray isn't installed."""
    # Not `ray` itself: it reads when it is imported what our module sets before.
    pytest.importorskip("service.jobs.ray_engine", reason="Ray isn't installed: pip install 'splatfix[ray]'")
    from service.jobs.ray_engine import RayConfig, RayEngine

    # Its processes import the stand-ins of these tests.
    os.environ["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    return RayEngine(config, RayConfig(replicas=replicas), set_up)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Files of scenes, one of them torn."""
    folder = tmp_path_factory.mktemp("scenes")
    for name in ("attic", "cellar"):
        (folder / f"{name}.ply").write_bytes(ply())
    (folder / "torn.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n")
    return folder


@pytest.fixture(scope="module", params=[*KINDS, pytest.param("ray", marks=pytest.mark.ci)])
def engine(request, plugins, folder) -> Iterator[Engine]:
    """With `room` in memory, `attic` required, and files that are loaded when they are asked for."""
    config = EngineConfig("stepping", matcher="sift", rasterizer="cpu")
    set_up = partial(set_up_engine, {"room": packed(make_scene())}, GO_ON)
    if request.param == "ray":
        made: Engine = ray_engine(config, set_up)
    elif request.param == "subprocess":
        made = SubprocessEngine(config, set_up)
    else:
        made = KINDS[request.param](config)
        assert isinstance(made, EmbeddedEngine)
        EmbeddedEngine.add_loaded(made, "room", make_scene())
    assert isinstance(made, Engine)
    made.add(StoredScene("torn", folder / "torn.ply"), required=True)
    made.start()
    until(lambda: not made.readiness().pending, 60)
    yield made
    made.close()


def query() -> Query:
    return read_query(test_api.photo())


def task(held: HeldScenes, name: str, **options) -> LocalizeTask:
    return LocalizeTask(name, held.token, "stepping", options, 7, None, query(), StageTiming("decode", 0.5, 0.25))


@pytest.fixture
def held(engine) -> Iterator[HeldScenes]:
    held = engine.hold("room")
    yield held
    engine.release(held.token)


# ------------------------------------------------------------------ scenes


def test_scenes_and_what_became_of_them(engine):
    states = {scene.id: (scene.state, scene.gaussians, scene.jobs) for scene in engine.scenes()}
    assert states["room"] == ("ready", 5, 0)
    assert states["torn"] == ("failed", None, 0)
    room = engine.scene("room")
    assert (room.sh_degree, room.cameras, room.info.id, room.info.name) == (0, 1, "room", "Room")
    assert room.memory_bytes > 1000
    torn = engine.scene("torn").failure
    assert torn.code == "corrupt_scene"
    readiness = engine.readiness()
    assert (readiness.ready, readiness.pending, len(readiness.failed)) == (True, (), 1)
    assert readiness.rasterizers == ("flat",)
    for ask in (engine.scene, engine.contents, engine.require, engine.load, engine.unload, engine.remove):
        with pytest.raises(SceneNotFound):
            ask("none")
    with pytest.raises(CorruptScene):
        engine.require("torn")
    with pytest.raises(CorruptScene):
        engine.hold("torn")
    with pytest.raises(BadInput):
        engine.unload("room")  # it has no file


def test_contents(engine):
    contents, scene = engine.contents("room"), make_scene().scene
    assert [camera.name for camera in contents.cameras] == ["images/a.jpg"]
    assert np.array_equal(contents.cameras[0].camera.pose.world_from_camera, TURNED)
    assert np.array_equal(contents.bounds_in_world, np.quantile(scene.means, [0.01, 0.99], axis=0))
    assert engine.contents("torn") is None
    assert engine.require("room").sha256 == "ab" * 32


def test_a_scene_is_loaded_held_unloaded_and_removed(engine, folder):
    engine.add(StoredScene("attic", folder / "attic.ply"))
    assert (engine.scene("attic").state, engine.contents("attic")) == ("unloaded", None)
    answers: queue.SimpleQueue[HeldScenes | SplatfixError] = queue.SimpleQueue()
    engine.hold_later("attic", answers.put)
    held = answers.get(timeout=60)
    assert isinstance(held, HeldScenes)
    assert held.ids == ("attic",)
    assert engine.scene("attic").jobs == 1
    engine.release(held.token)
    until(lambda: engine.scene("attic").state in ("ready", "failed"), 60)
    # The stand-in estimator needs a camera, which these files don't have: preparing fails, and that is told.
    assert engine.scene("attic").failure.code == "internal_error"
    engine.remove("attic")
    engine.hold_later("attic", answers.put)
    assert isinstance(answers.get(timeout=60), SceneNotFound)
    assert "attic" not in {scene.id for scene in engine.scenes()}


def test_held_scenes_stay_until_the_last_one_lets_go(engine):
    first, second = engine.hold("room"), engine.hold(AUTO)
    assert (first.ids, second.ids, first.background_rgb) == (("room",), ("room",), (0.0, 0.0, 0.0))
    assert engine.scene("room").jobs == 2
    with pytest.raises(SceneInUse):
        engine.remove("room")
    for held in (first, first, second):  # the second time it is nothing
        engine.release(held.token)
    until(lambda: engine.scene("room").jobs == 0)
    assert engine.hold(["room", "room"]).ids == ("room",)
    with pytest.raises(SceneNotFound):
        engine.hold(["room", "none"])
    with pytest.raises(SceneNotFound):
        engine.hold(None)  # there are several
    assert engine.scene("room").jobs == 1  # what failed holds nothing


# ------------------------------------------------------------------ work


def test_a_photo_is_localized_with_a_stream_of_records(engine, held):
    seen: list[JobRecord] = []
    answer = engine.localize(task(held, "a", steps=4), lambda record, shown: seen.append(record))
    assert [(r.step.index, r.step.stage, r.frame) for r in seen] == [(k, "step", None) for k in range(4)]
    assert seen[0].step.matches.photo_px.tolist() == [[1.5, 2.5], [3.5, 4.5]]
    estimate = answer.result.estimate
    assert answer.scene == "room"
    assert np.array_equal(estimate.pose.world_from_camera, TURNED)
    assert (estimate.verdict.status, estimate.seed, estimate.estimator) == (Status.NOT_LOCALIZED, 7, "stepping")
    assert (answer.result.decode, answer.result.frames) == (StageTiming("decode", 0.5, 0.25), None)
    assert answer.result.versions.keys() >= {"splatfix", "numpy"}
    (last,) = estimate.records
    assert (last.index, last.matches) == (3, None)


def test_a_sequence_is_localized_photo_by_photo(engine, held):
    files = [(f"{k}.jpg", test_api.photo()) for k in range(3)]
    source = SequenceSource(packed_photos(files), SequenceOptions(10, times_s=(0.5, 1.0, 4.0)))
    seen: list[tuple[JobRecord, Query | None]] = []
    sequence = replace(task(held, "s", steps=2), source=source)
    answer = engine.localize(sequence, lambda record, shown: seen.append((record, shown)))
    assert [record.frame.name for record, _ in seen] == ["0.jpg", "1.jpg", "2.jpg"]
    assert [frame.time_s for frame in answer.result.frames] == [0.5, 1.0, 4.0]
    assert all(shown.rgb.shape == (64, 96, 3) for _, shown in seen)  # none was localized: the last is shown
    assert answer.result.estimate.renders == 0


def test_an_attempt_is_cancelled_at_its_next_record(engine, held):
    GO_ON.clear()
    seen: list[JobRecord] = []

    def cancel(record: JobRecord, _: object) -> None:
        seen.append(record)
        engine.cancel("c")
        GO_ON.set()

    engine.cancel("never")
    with pytest.raises(Cancelled):
        engine.localize(task(held, "c", steps=9, hold=True), cancel)
    assert len(seen) == 1


def test_who_listens_can_end_an_attempt(engine, held):
    GO_ON.clear()

    def fail(record: JobRecord, _: object) -> None:
        GO_ON.set()
        raise KeyError("enough")

    with pytest.raises(KeyError, match="enough"):
        engine.localize(task(held, "f", steps=3, hold=True), fail)


def test_errors_keep_their_kind(engine, held):
    nothing = lambda record, shown: None  # noqa: E731
    with pytest.raises(EstimatorFault) as fault:
        engine.localize(task(held, "x", fail="fault"), nothing)
    assert fault.value.message == "told to fail."
    with pytest.raises(RuntimeError):
        engine.localize(task(held, "y", fail="bug"), nothing)
    engine.release(held.token)
    with pytest.raises(SceneNotReady, match="were unloaded"):
        engine.localize(task(held, "z"), nothing)


def live_frames(count: int, seen: list[LiveAnswer]) -> Callable[[], LiveFrame | None]:
    """Frames of one camera, until so many are answered."""
    numbers = iter(range(10_000))

    def next_frame() -> LiveFrame | None:
        if len(seen) >= count:
            return None
        time.sleep(0.005)
        number = next(numbers)
        return LiveFrame(number, number / 30, test_api.photo())

    return next_frame


def test_a_live_session_answers_each_frame_it_asks_for(engine, held):
    seen: list[LiveAnswer] = []

    def until_lost() -> LiveFrame | None:
        assert len(seen) < 4000, "the search never ended"
        return None if seen and seen[-1].mode == "lost" else give()

    give = live_frames(10_000, seen)
    engine.live(LiveTask(held.token, "stepping"), until_lost, seen.append)
    # The scene is grey and the photo noise: searches end without an answer, and that is told.
    assert [answer.id for answer in seen] == list(range(len(seen)))
    assert {answer.mode for answer in seen} == {"relocalizing", "lost"}
    assert {(answer.size, answer.pose, answer.verdict) for answer in seen} == {((96, 64), None, None)}
    assert [answer.time_s for answer in seen] == [number / 30 for number in range(len(seen))]


def test_a_live_session_ends_with_an_error_of_its_own(engine, held):
    task, seen = LiveTask(held.token, "stepping"), []
    frames = iter([LiveFrame(0, 0.0, test_api.photo()), LiveFrame(1, 0.1, b"GIF89a")])
    with pytest.raises(InvalidImage, match="JPEG"):
        engine.live(task, lambda: next(frames), seen.append)
    assert [answer.id for answer in seen] == [0]

    def fail(answer: LiveAnswer) -> None:
        raise KeyError("enough")

    with pytest.raises(KeyError, match="enough"):
        engine.live(task, live_frames(1, []), fail)
    with pytest.raises(SceneNotReady, match="was unloaded"):
        engine.live(LiveTask("none", "stepping"), live_frames(1, []), seen.append)


def test_several_attempts_run_at_once(engine, held):
    GO_ON.clear()
    done: list[str] = []

    def run(name: str) -> None:
        engine.localize(task(held, name, hold=True), lambda record, shown: None)
        done.append(name)

    threads = [threading.Thread(target=run, args=(name,)) for name in "abc"]
    for thread in threads:
        thread.start()
    assert engine.scene("room").state == "ready"  # it answers meanwhile
    assert not done
    GO_ON.set()
    for thread in threads:
        thread.join(20)
    assert sorted(done) == ["a", "b", "c"]


def test_pictures_are_the_same_from_every_engine(engine):
    reference = EmbeddedEngine(EngineConfig("stepping"))
    reference.add_loaded("room", make_scene())
    small = Intrinsics(40, 30, 30.0, 30.0, 20.0, 15.0)
    for picture in (PictureSpec(Pose(TURNED), format="depth"), PictureSpec(Pose(TURNED), small, "png")):
        assert engine.render("room", picture) == reference.render("room", picture)
    assert engine.thumbnail("room") == reference.thumbnail("room")
    assert engine.splats("room", 3) == reference.splats("room", 3)
    with pytest.raises(InvalidIntrinsics):
        engine.render("room", PictureSpec(Pose(TURNED), replace(PHOTO, width=10_000, height=10_000)))
    for draw in (partial(engine.thumbnail, "none"), partial(engine.splats, "none", 3)):
        with pytest.raises(SceneNotFound):
            draw()


def test_a_scene_that_was_unloaded_stays_away(engine, folder):
    engine.add(StoredScene("cellar", folder / "cellar.ply"))
    engine.unload("cellar")
    with pytest.raises(SceneUnloaded):
        engine.require("cellar")
    with pytest.raises(SceneUnloaded):
        engine.render("cellar", PictureSpec(Pose(TURNED)))
    engine.remove("cellar")


# ------------------------------------------------------------------ the API on a subprocess engine


@pytest.fixture(scope="module")
def remote(plugins) -> Iterator:
    """A service whose engine is a subprocess."""
    with serving(create_app(settings(), {"room": make_scene()}, subprocess=True)) as client:
        until_ready(client)
        yield client


@pytest.mark.parametrize(
    "check",
    [
        test_api.test_a_photo_becomes_a_job_becomes_a_result,
        test_api.test_the_pose_is_right_in_every_spelling,
        test_api.test_json_and_form_are_the_same_request,
        test_api.test_a_job_tells_its_region,
        test_api.test_the_photo_is_upright_and_the_render_has_its_size,
        test_api.test_scenes_are_described,
        test_api.test_capabilities_tell_what_can_be_chosen,
        test_api.test_http_errors_are_problem_documents,
        test_sequences.test_a_single_photo_has_no_frames,
        test_sequences.test_several_photos_are_one_job_with_an_answer_and_an_event_each,
    ],
    ids=lambda check: check.__name__,
)
def test_the_api_is_the_same(remote, check):
    check(remote)


@pytest.mark.parametrize(
    "check",
    [
        test_api.test_events_come_live_from_the_first_and_end_with_the_result,
        test_api.test_cancelling_a_running_job_takes_effect_at_its_next_record,
        test_sequences.test_cancelling_ends_between_two_photos,
    ],
    ids=lambda check: check.__name__,
)
def test_the_api_is_the_same_while_jobs_run(remote, stepping, check):
    check(remote, stepping)
    stepping.GO_ON.set()
    until(lambda: (told := remote.get("/jobs").json())["running"] == told["queued"] == 0)


# Held jobs would hold multiprocessing's event, too, which doesn't survive its waiter's death: these are slow instead.
SLOW = {"steps": 20, "pause_s": 0.1}


def test_a_service_whose_engine_dies_makes_the_attempt_again(stepping):
    app = create_app(settings(crashes=2), {"room": make_scene()}, subprocess=True)
    with serving(app) as client:
        until_ready(client)
        job = post(client, prefer="", options=SLOW).json()
        path = job["links"]["self"]
        until(lambda: client.get(path).json()["records"] >= 2)
        with client.stream("GET", job["links"]["events"], timeout=60) as stream:
            app.state.app_state.engine.child.kill()
            told = events("".join(stream.iter_text()))
        restart = [name for name, _, _ in told].index("restarted")
        assert told[restart][1:] == ("", {"attempt": 2})
        assert [number for _, number, _ in told[:restart]] == [f"1.{k}" for k in range(restart)]
        assert [number for _, number, _ in told[restart + 1 :]] == [*(f"2.{k}" for k in range(20)), "end"]
        assert finished(client, path)["state"] == "succeeded"


@pytest.mark.ci
def test_a_job_that_kills_its_engine_is_given_up(stepping):
    app = create_app(settings(crashes=1), {"room": make_scene()}, subprocess=True)
    with serving(app) as client:
        until_ready(client)
        path = post(client, prefer="", options=SLOW).headers["location"]
        until(lambda: client.get(path).json()["records"] >= 2)
        engine, seen = app.state.app_state.engine, []

        def kill(answer: LiveAnswer) -> None:
            seen.append(answer)
            engine.child.kill()

        with pytest.raises(EngineLost):  # a live session is told
            engine.live(LiveTask(engine.hold("room").token, "stepping"), live_frames(100, seen), kill)
        job = finished(client, path)
        assert (job["state"], job["attempt"], job["error"]["code"]) == ("interrupted", 1, "interrupted")
