"""How a browser's session and the viewer's program are wired, with stand-ins for viser, browser and service."""

from __future__ import annotations

import itertools
import logging
import signal
import sys
import threading
import weakref
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from fake_service import FakeService, until

from service.client import Client, ServiceError
from viewer import __main__ as program
from viewer import browser_session, job_stream, replay_download, service_lists, viewer_server
from viewer.browser_session import BrowserSession
from viewer.job_stream import JobStream
from viewer.replay_download import ReplayDownload
from viewer.service_lists import ServiceLists

# ------------------------------------------------------------------ widgets


class Widget:
    """A widget of viser: keeps what is to be called when the user touches it."""

    def __init__(self, value: Any = None) -> None:
        self.value = value
        self.react: Any = None

    def on_click(self, react: Any) -> None:
        self.react = react

    on_trigger = on_click


def wired() -> tuple[Any, dict[str, Any]]:
    """A session whose widgets only record; with the keys of viser's commands."""
    keys: dict[str, Any] = {}
    found: Any = object.__new__(BrowserSession)
    found._job, found._selection, found._plan, found._background = Mock(), Mock(), Mock(), Mock()
    found._scene_display, found._replay, found._shared = Mock(), Mock(), Mock()
    found._queue = Mock(post=lambda action, key=None: action())
    names = "jobs newest scenes step photo_opacity plan_view match_lines weight colour_by exact play mode look_through"
    widgets = {name: Widget(f"value of {name}") for name in names.split()}
    widgets |= {name: Widget() for name in ("fly", "replay", "use_view")}
    layers = {name: Widget(f"value of {name}") for name in ("splats", "trajectory")}
    found._controls = SimpleNamespace(**widgets, layers=layers, name_point=Widget(False), measure=Widget(False))
    found._client = Mock()
    found._client.gui.add_command = lambda name, hotkey: keys.setdefault(hotkey, Widget())
    return found, keys


@pytest.mark.parametrize(
    ("widget", "part", "method"),
    [
        ("jobs", "_selection", "choose_job"),
        ("newest", "_selection", "choose_newest"),
        ("scenes", "_selection", "choose_scene"),
        ("step", "_job", "go_to"),
        ("photo_opacity", "_background", "set_opacity"),
        ("plan_view", "_plan", "set_plan_view"),
        ("exact", "_background", "set_enabled"),
        ("mode", "_job", "set_mode"),
        *((name, "_job", "redraw") for name in ("match_lines", "weight", "colour_by")),
    ],
)
def test_each_widget_does_its_own_thing(widget: str, part: str, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    connected: list[tuple[Widget, Any]] = []
    monkeypatch.setattr(browser_session, "on_user_change", lambda *pair: connected.append(pair))
    found, _ = wired()
    found._connect_widgets()
    found._connect_player()
    (react,) = (react for one, react in connected if one is getattr(found._controls, widget))
    react("chosen")
    getattr(getattr(found, part), method).assert_called_once_with(*(() if method == "redraw" else ("chosen",)))
    assert sum(len(each.mock_calls) for each in (found._job, found._selection, found._plan, found._background)) == 1
    for name, checkbox in found._controls.layers.items():
        (show,) = (react for one, react in connected if one is checkbox)
        show(False)
        found._plan.set_layer_visible.assert_called_with(name, False)


def test_each_button_and_key_does_its_own_thing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(browser_session, "on_user_change", Mock())
    found, keys = wired()
    found._connect_player()
    for name, method in (("look_through", "look_through"), ("fly", "fly_to_result")):
        getattr(found._controls, name).react(None)
        getattr(found._job, method).assert_called_once_with()
    found._controls.use_view.react(None)
    found._scene_display.offer_prior.assert_called_once_with()
    found._controls.play.react(SimpleNamespace(target=Widget("a button")))
    for key in ("N", "P", "space"):
        keys[key].react(None)
    pressed = [call.args[0] for call in found._job.press.call_args_list]
    assert pressed == ["a button", "next ▶", "◀ previous", "play / pause"]
    assert set(keys) == {"N", "P", "space"}
    # A click into the scene, by what is switched on.
    connect = found._client.scene.on_click.return_value
    (clicked,) = connect.call_args.args
    event = SimpleNamespace(ray_origin=[1, 2, 3], ray_direction=[0, 0, 1])
    for naming, measuring, met in (
        (False, False, found._job.click),
        (False, True, found._scene_display.measure),
        (True, False, found._plan.pick_point),
        (True, True, found._plan.pick_point),
    ):
        met.reset_mock()
        found._controls.name_point.value, found._controls.measure.value = naming, measuring
        clicked(event)
        met.assert_called_once_with([1, 2, 3], [0, 0, 1])


@pytest.mark.parametrize(("job", "scene"), [*itertools.product((True, False), repeat=2)])
def test_a_replay_needs_a_job_and_its_scene(job: bool, scene: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(browser_session, "on_user_change", Mock())
    found, _ = wired()
    found._job.stream = "the job" if job else None
    found._scene_display.scene_id = "room" if scene else None
    found._shared.scenes.get = {"room": "the room"}.__getitem__
    found._connect_player()
    found._controls.replay.react(None)
    assert [call.args for call in found._replay.start.call_args_list] == [("the job", "the room")] * (job and scene)


def test_a_session_takes_up_the_lists_and_leaves_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(browser_session, "on_user_change", Mock())
    found, _ = wired()
    posted: list[Any] = []
    taken = iter([[], [lambda: posted.append("asked for")], None])
    found._queue = Mock(closed=False, take=lambda wait: next(taken))
    found._queue.post = lambda action, key=None: posted.append(action)
    found._scene, found._job.step.due_in_s, found._job.tick_in_s, found._plan.due_in_s = Mock(), None, None, None
    found._scene.splats.pending = True
    found._client.client_id = "wired"
    found.start()
    until(lambda: found._job.close.called, "the session's end")
    found._shared.lists.add_listener.assert_called_once_with(found._lists_changed)
    found._shared.lists.remove_listener.assert_called_once_with(found._lists_changed)
    # What the lists say is shown at first, without a change of them.
    assert posted[:2] == [found._selection.sync, found._plan.refresh]
    assert posted[2:] == ["asked for"]
    found._background.start.assert_called_once_with()
    assert found._scene_display.send_splats.call_count == 1  # only where nothing was asked for
    assert found._plan.follow_scene.call_count == 2
    found.close()
    found._background.close.assert_called_once_with()
    found._queue.close.assert_called_once_with()


def test_what_changes_elsewhere_is_shown_by_the_sessions_thread() -> None:
    found, _ = wired()
    found._scene = Mock()
    found._stream_changed()
    found._job.sync.assert_called_once_with()
    image = np.zeros((2, 3, 3), np.uint8)
    found._show_background(image)
    found._scene.splats.show_background.assert_called_once_with(image)


def test_a_browser_that_has_left_is_told_nothing() -> None:
    found, _ = wired()
    found._controls = Mock()
    found._controls.headline.content = "before"
    found._queue.closed = True

    def fails() -> None:
        raise ServiceError("unreachable", "the connection is closed")

    found._try(fails)
    assert found._controls.headline.content == "before"


# ------------------------------------------------------------------ replay files


def download(monkeypatch: pytest.MonkeyPatch, page: Any) -> tuple[ReplayDownload, Any]:
    monkeypatch.setattr(replay_download, "replay_html", page)
    parts: Any = SimpleNamespace(client=Mock(), controls=Mock(saving_replay=False), queue=Mock())
    parts.queue.post = lambda action: action()
    return ReplayDownload(parts.client, parts.controls, parts.queue), parts


def test_one_replay_file_is_made_at_a_time_and_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    goes_on = threading.Event()

    def page(stream: Any, content: Any) -> str:
        goes_on.wait(10)
        return f"<p>{stream.id} in {content} é"

    found, parts = download(monkeypatch, page)
    said = parts.controls.set_saving_replay
    found.start(Mock(id="j1"), "a room")  # type: ignore[arg-type]
    assert [call.args for call in said.call_args_list] == [(True,)]
    parts.controls.saving_replay = True
    found.start(Mock(id="j2"), "a room")  # type: ignore[arg-type]
    goes_on.set()
    until(lambda: said.call_count == 2, "the end")
    assert said.call_args.args == (False,)
    sent = "<p>j1 in a room é".encode()
    parts.client.send_file_download.assert_called_once_with("splatfix-j1.html", sent, save_immediately=True)
    parts.client.add_notification.assert_not_called()


def test_a_replay_file_that_fails_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    found, parts = download(monkeypatch, Mock(side_effect=ServiceError("not_found", "The photo is gone.")))
    found.start(Mock(id="j"), "a room")  # type: ignore[arg-type]
    until(lambda: parts.controls.set_saving_replay.call_count == 2, "the end")
    assert "The photo is gone." in parts.client.add_notification.call_args.args
    parts.client.send_file_download.assert_not_called()
    assert parts.controls.set_saving_replay.call_args.args == (False,)


# ------------------------------------------------------------------ what browsers share


def test_depths_of_old_steps_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a long job that is played only the last ones stay in memory; those are not asked for again."""
    monkeypatch.setattr(job_stream, "_IMAGES_KEPT", 2)
    fake = FakeService()
    job = fake.job("j", 4, finished=True)
    stream = JobStream(Client("http://fake", transport=fake.transport), "j")
    stream.job, stream.records = job_stream.job_of(stream._client.job("j")), tuple(job.records)  # type: ignore[assignment]
    asked = Mock(wraps=stream._client.depth)
    monkeypatch.setattr(stream._client, "depth", asked)
    for index, times in ((0, 1), (1, 2), (0, 2), (2, 3), (1, 3), (2, 3), (0, 4)):
        found = stream.matches(index)
        assert found is not None
        assert asked.call_count == times
    assert len(stream._backprojected) == 2


def test_a_stream_tells_of_each_record_and_forgets_the_images_of_another_attempt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    heard: list[int] = []
    stream = JobStream(Mock(), "j")
    stream.listeners.add(lambda: heard.append(len(stream.records)))
    monkeypatch.setattr(job_stream, "record_of", lambda said: SimpleNamespace(index=said.index))

    def said(index: int, attempt: int = 1) -> Any:
        return SimpleNamespace(index=index, attempt=attempt)

    for record in (said(0), said(1), None, said(0), said(1), said(2)):  # a stream that was resumed repeats them
        stream._append(record)
    assert heard == [1, 2, 3]
    stream._renders[0, True], stream._backprojected[0] = Mock(), Mock()
    stream._append(said(3))
    assert len(stream._renders) == len(stream._backprojected) == 1
    stream._append(said(0, attempt=2))
    assert heard == [1, 2, 3, 4, 1]
    assert len(stream._renders) == len(stream._backprojected) == 0
    # At its end a sequence's photo is another step's; a single photo stays the same.
    monkeypatch.setattr(job_stream, "api", SimpleNamespace(Job=str))
    for step, again in ((None, False), (3, True)):
        stream._photo_requested = True
        monkeypatch.setattr(job_stream, "job_of", lambda said, step=step: SimpleNamespace(photo_step=step))
        stream._append("the job")  # type: ignore[arg-type]
        assert stream.complete
        assert stream._photo_requested is not again
    assert heard == [1, 2, 3, 4, 1, 1, 1]


def test_streams_have_listeners_until_the_last_one_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(JobStream, "start", Mock())
    streams = job_stream.JobStreams(Mock())
    one, two = Mock(), Mock()
    stream = streams.follow("a", one)
    assert streams.follow("a", two) is stream
    assert stream.listeners == {one, two}
    assert JobStream.start.call_count == 1  # type: ignore[attr-defined]
    streams.leave(stream, one)
    assert not stream._stop.is_set()
    assert len(streams) == 1
    streams.leave(stream, two)
    assert stream._stop.is_set()
    assert len(streams) == 0
    others = [streams.follow(name, one) for name in "ab"]
    streams.close()
    assert all(other._stop.is_set() for other in others)


def test_an_outage_is_logged_once_and_again_after_it_was_over(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(service_lists, "_POLL_S", 0.001)
    client = Mock()
    client.scenes.return_value = []
    down = ServiceError("unreachable", "nobody answers")
    other = ServiceError("unreachable", "another reason")
    answers = iter([down, down, down, other, [], down])
    client.jobs.side_effect = lambda limit: _raised(next(answers, []))
    lists = ServiceLists(client)
    lists.add_listener(lambda: None)
    with caplog.at_level(logging.WARNING):
        lists.start()
        until(lambda: client.jobs.call_count > 6, "all answers")
        lists.close()
    said = [record.getMessage() for record in caplog.records if "list of jobs" in record.getMessage()]
    assert [text.partition(": ")[2] for text in said] == ["nobody answers", "another reason", "nobody answers"]


def test_the_thread_ends_though_the_last_listener_goes_after_the_end() -> None:
    """And lets go of whom it told: they held their browsers' widgets for as long as the viewer ran."""
    client = Mock()
    client.jobs.return_value = client.scenes.return_value = []
    lists, told = ServiceLists(client), threading.Event()

    def listener() -> None:
        told.set()

    lists.add_listener(listener)
    before = set(threading.enumerate())
    lists.start()
    (thread,) = set(threading.enumerate()) - before
    assert told.wait(20)
    seen = weakref.ref(listener)
    lists.close()
    lists.remove_listener(listener)
    del listener
    thread.join(20)
    assert not thread.is_alive()
    until(lambda: seen() is None, "the end of the listener")


def _raised(answer: Any) -> Any:
    if isinstance(answer, Exception):
        raise answer
    return answer


def test_a_browser_that_leaves_while_it_is_met_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    found: Any = object.__new__(viewer_server.Viewer)
    found.server, found._shared, found._sessions, found._lock = Mock(), Mock(), {}, threading.Lock()
    monkeypatch.setattr(viewer_server, "sent_token", lambda server, number: f"token {number}")
    monkeypatch.setattr(viewer_server, "requested_path", lambda server, number: "/jobs/j")
    met = Mock(side_effect=[ConnectionError("it has left"), "session 8"])
    monkeypatch.setattr(viewer_server, "BrowserSession", met)
    with pytest.raises(ConnectionError):
        found._open(Mock(client_id=7))
    found._shared.take.assert_called_once_with("token 7")
    found._shared.give_back.assert_called_once_with("token 7")
    assert found._sessions == {}
    assert met.call_args.args[2].job_id == "j"
    session = Mock()
    met.side_effect = [session]
    found._open(client := Mock(client_id=8))
    assert found._sessions == {8: (session, "token 8")}
    session.start.assert_called_once_with()
    found._shared.give_back.reset_mock()
    for _ in range(2):
        found._close(client)
        session.close.assert_called_once_with()
        found._shared.give_back.assert_called_once_with("token 8")
    found._sessions[9] = session, "token 9"
    found.stop()
    assert session.close.call_count == 2
    found._shared.give_back.assert_called_with("token 9")
    found.server.stop.assert_called_once_with()
    assert found._sessions == {}


# ------------------------------------------------------------------ the program


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The program without a viewer; a signal, or the end of standard input, ends it."""
    seen = SimpleNamespace(handlers={}, given=[], stopped=0, read=threading.Event(), pieces=[b"x", b"y", b""])
    seen.levels = {name: logging.getLogger(name).level for name in ("httpx", "websockets")}

    class Viewer:
        server = SimpleNamespace(get_port=lambda: 81)

        def __init__(self, connect: Any, host: str, port: int) -> None:
            sys.stdout.write("viser's address")
            seen.given.append((connect, host, port))

        def stop(self) -> None:
            sys.stdout.write("viser's farewell")
            seen.stopped += 1

    def read(descriptor: int, count: int) -> bytes:
        assert descriptor == 0
        seen.read.set()
        return seen.pieces.pop(0)

    class Event(threading.Event):
        waited = 0

        def wait(self, timeout: float | None = None) -> bool:
            self.waited += 1
            assert self.waited < 100, "it goes on for ever"
            return super().wait(timeout)

    monkeypatch.setattr(program, "threading", SimpleNamespace(Event=Event, Thread=threading.Thread))
    numbers = {"SIGTERM": signal.SIGTERM, "SIGINT": signal.SIGINT}
    monkeypatch.setattr(program, "signal", SimpleNamespace(**numbers, signal=seen.handlers.__setitem__))
    monkeypatch.setattr(program, "os", SimpleNamespace(read=read))
    monkeypatch.setattr(program, "Viewer", Viewer)
    yield seen
    for name, level in seen.levels.items():
        logging.getLogger(name).setLevel(level)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_program_serves_until_a_signal(
    started: SimpleNamespace, number: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = ["viewer", "--service", "http://127.0.0.1:1", "--port", "8081", "--certificate", "no.pem"]
    monkeypatch.setattr(sys, "argv", [*told, "--host", "::1"])
    threading.Timer(0.05, lambda: started.handlers[number](number, None)).start()
    program.main()
    ((connect, host, port),) = started.given
    assert (host, port) == ("::1", 8081)
    assert connect.args == ("http://127.0.0.1:1",)
    assert connect.keywords == {"timeout_s": 30.0, "use_proxy": False, "certificate": "no.pem"}
    assert set(started.handlers) == {signal.SIGTERM, signal.SIGINT}
    assert not started.read.is_set()
    assert started.stopped == 1
    assert capsys.readouterr().out == ""
    assert all(not logging.getLogger(name).isEnabledFor(logging.INFO) for name in started.levels)


def test_the_program_ends_with_its_input_where_that_is_asked(
    started: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["viewer", "--service", "http://s", "--port", "0", "--end-with-stdin"])
    program.main()
    assert started.given[0][1:] == ("127.0.0.1", 0)
    assert started.pieces == []
    assert started.stopped == 1


def test_the_program_needs_a_service_and_a_port(
    started: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["viewer"])
    with pytest.raises(SystemExit):
        program.main()
    assert "--service, --port" in capsys.readouterr().err
