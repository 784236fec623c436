"""What a browser's session decides by itself: view, job, buttons; with stand-ins for what it draws."""

from __future__ import annotations

import asyncio
import itertools
import re
import runpy
import signal
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
from fake_service import PHOTO, jpeg, orbit, records, threads, until

from service.geometry import moved
from service.types import Camera
from viewer import background_render, charts, job_display
from viewer.action_queue import ActionQueue
from viewer.background_render import BackgroundRender, Overlay, _same_view
from viewer.controls import NEXT, PLAY, PREVIOUS, Controls
from viewer.job_display import FOLLOW_AFTER_OPEN_S, JobDisplay
from viewer.job_selection import JobSelection
from viewer.requested_page import RequestedPage

COUNTS = [0, 1, 3]


class Clock:
    """Time that passes only when a test says so."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(job_display, "time", clock)
    return clock


def display(count: int | None, *, shown: bool = False) -> JobDisplay:
    """A display of a job with so many records, of which one has been shown or none; None: of no job."""
    controls, scene, scene_display = Mock(), Mock(), Mock()
    controls.speed.value = "2"
    scene_display.show.return_value = False
    stream = None
    if count is not None:
        job = Mock(outcome=None, truth=None, scene="ball", photo_step=None, photo=None)
        job.camera = lambda record: record
        stream = SimpleNamespace(id="j", attempt=1, records=records(count), job=job, error="", photo=lambda: None)
    found = JobDisplay(controls, scene, scene_display, Mock(), Mock())
    found.stream = stream  # type: ignore[assignment]
    found.step = Mock(empty=not shown)
    return found


# ------------------------------------------------------------------ whose the view is


@pytest.mark.parametrize(
    ("count", "shown", "late", "moves"),
    [
        (0, False, False, False),  # there is no pose yet
        (0, False, True, False),
        (3, False, False, True),
        (3, False, True, True),  # the first record, however long it took
        (3, True, False, True),
        (3, True, True, False),  # later the view is the user's
    ],
)
def test_the_view_follows_a_job_that_was_just_opened(
    clock: Clock, count: int, shown: bool, late: bool, moves: bool
) -> None:
    job = display(count, shown=shown)
    job._opened = clock.now
    clock.now += FOLLOW_AFTER_OPEN_S + (0.01 if late else -0.01)
    job.sync()
    assert bool(job._scene.look_from_behind.called) is moves
    if moves:
        assert job._scene.look_from_behind.call_args.args == (job.stream.records[-1].pose,)


def test_the_view_is_followed_for_two_seconds(clock: Clock) -> None:
    """As long as docs and comments say; a scene that is shown first begins them anew."""
    job = display(3, shown=True)
    job._scene_display.show.return_value = True
    job.sync()
    job._scene_display.show.return_value = False
    for seconds, follows in ((1.75, True), (2.0, False), (2.25, False)):
        job._scene.reset_mock()
        clock.now = 100.0 + seconds
        job.sync()
        assert bool(job._scene.look_from_behind.called) is follows


def test_a_view_that_the_user_chose_stays(clock: Clock) -> None:
    for choose in (JobDisplay.fly_to_result, JobDisplay.look_through):
        job = display(3, shown=True)
        job._opened = clock.now
        choose(job)
        job.sync()
        assert not job._scene.look_from_behind.called


@pytest.mark.parametrize("count", [None, *COUNTS])
def test_what_needs_a_record_does_nothing_without_one(clock: Clock, count: int | None) -> None:
    job = display(count)
    job.sync()
    for act in (job.fly_to_result, job.look_through, job.redraw, job.tick):
        act()
    job.press(NEXT)
    job.go_to(7)
    there = bool(count)
    assert bool(job._scene.fly_to.called) is there
    assert bool(job._scene.look_through.called) is there
    assert [call.args[0] for call in job._scene_display.show_photo.call_args_list] == [None] * (2 if there else 0)
    assert bool(job.step.redraw.called) is there
    assert bool(job.step.show.called) is there
    if there:
        assert job._scene.fly_to.call_args.args == (job.stream.records[-1].pose,)


def test_a_job_that_has_not_answered_shows_its_headline_alone(clock: Clock) -> None:
    job = display(2)
    job.stream.job = None
    job.sync()
    assert job._controls.headline.content
    assert not job._scene_display.show.called
    assert not job.step.show.called


@pytest.mark.parametrize("true", [False, True])
def test_all_of_a_job_is_shown_as_it_arrives(clock: Clock, true: bool) -> None:
    job = display(3)
    job.stream.job.truth = orbit(0) if true else None
    job.sync()
    assert ("true" in job._controls.legend.content) is true
    assert job._controls.set_step_count.call_args.args == (3,)
    assert job._scene.trajectory.show.call_args.args == (job.stream.records, job.stream.job)
    assert job.step.show.call_args.args == (job.stream, 2)
    job.set_mode("flicker")
    assert job.step.set_mode.call_args.args == ("flicker",)
    assert job.step.redraw.call_args.args == (job.stream, 2)


# ------------------------------------------------------------------ the player


def test_buttons_step_and_play(clock: Clock) -> None:
    job = display(3)
    job.sync()  # live: the newest

    def shown() -> int:
        return job.step.show.call_args.args[1]

    for button, index in ((PREVIOUS, 1), (PREVIOUS, 0), (PREVIOUS, 0), (NEXT, 1)):
        job.press(button)
        assert shown() == index
        assert job.tick_in_s is None
    job.press(PLAY)
    clock.now = 200.0
    job.tick()
    assert shown() == 2
    assert job.tick_in_s is None  # at the end
    job.press(PLAY)  # from the start
    assert shown() == 0
    job.tick()
    clock.now += 0.2
    assert job.tick_in_s == pytest.approx(0.3)  # two a second
    clock.now += 5
    assert job.tick_in_s == 0
    job.go_to(0)
    assert job.tick_in_s is None


def test_another_job_begins_anew(clock: Clock) -> None:
    job = display(3)
    job.sync()
    before = job.stream
    job.open("other")
    assert job._streams.leave.call_args.args == (before, job._on_change)
    assert job.stream is job._streams.follow.return_value
    assert job.step.clear.called
    job._scene_display.show_photo.assert_called_once_with(None)  # it belongs to the other job
    assert job._on_change.called  # its records may be there already
    job.leave()
    assert job.stream is None
    job.tick()  # of no job: nothing is shown


def test_a_click_jumps_looks_or_does_nothing(clock: Clock) -> None:
    camera = Camera(PHOTO, orbit(0))
    for target, index, looks in ((1, 1, False), (0, 0, False), (camera, None, True), (None, None, False)):
        job = display(3)
        job.sync()
        job.step.reset_mock()
        job._scene.hit.return_value = target
        job.click((0, 0, 0), (0, 0, 1))
        assert (job.step.show.call_args.args[1] if job.step.show.called else None) == index
        assert bool(job._scene.look_through.called) is looks


# ------------------------------------------------------------------ which buttons there are


def controls() -> Controls:
    found: Any = object.__new__(Controls)
    for name in ("step", "look_through", "fly", "replay"):
        setattr(found, name, SimpleNamespace(disabled=True, max=0, label="save"))
    found.window, found.saving_replay = SimpleNamespace(visible=True), False
    return found


@pytest.mark.parametrize(("count", "saving"), [*itertools.product(COUNTS, [False, True])])
def test_buttons_are_there_for_what_can_be_done(count: int, saving: bool) -> None:
    for saving_first in (False, True):  # in either order
        found = controls()
        if saving_first:
            found.set_saving_replay(saving)
        found.set_step_count(count)
        if not saving_first:
            found.set_saving_replay(saving)
        assert found.step.disabled is found.look_through.disabled is found.fly.disabled is (count == 0)
        assert found.replay.disabled is (count == 0 or saving)
        assert found.step.max == max(0, count - 1)
        assert found.window.visible is (count > 0)
        assert ("making" in found.replay.label) is saving
        if saving:  # and it can be saved again afterwards
            found.set_saving_replay(False)
            assert found.replay.disabled is (count == 0)


@pytest.mark.parametrize("splats", [True, False])
def test_both_panels_are_one_column_at_the_right_and_most_layers_are_shown(splats: bool) -> None:
    client = MagicMock()
    gui = client.gui
    found = Controls(client, splats=splats)
    gui.main_panel.dock_right.assert_called_once_with()
    gui.main_panel.set_width.assert_called_once_with(430)
    gui.add_panel.assert_called_once_with(visible=False)
    found.window.dock_below.assert_called_once_with(gui.main_panel)
    assert found.flush is client.flush
    assert found.saving_replay is False
    boxes = {call.args[0]: call.args[1] for call in gui.add_checkbox.call_args_list if len(call.args) > 1}
    assert {name for name, shown in boxes.items() if not shown} == {
        *("measure distances", "name a point", "plan view"),
        *("axes and scale", "poses of all jobs", "coverage", "floor plan"),
        *(() if splats else ("splats",)),
    }
    assert set(found.layers) <= boxes.keys()
    assert gui.add_slider.call_args_list[0].args == ("step", 0, 0, 1, 0)
    sliders = {call.args[0]: call for call in gui.add_slider.call_args_list[1:]}
    for name in ("photo opacity", "render opacity"):
        assert sliders[name].args[1:] == (0.0, 1.0, 0.05, 0.5)
        assert sliders[name].kwargs["visible"] is False
    # What needs a record can't be used yet.
    assert {call.args[0] for call in gui.add_button.call_args_list if call.kwargs.get("disabled")} == {
        "look through this camera", "fly to result", "save as replay file",
    }  # fmt: skip


def test_a_window_without_images_stays_hidden() -> None:
    found = controls()
    found.window.visible = False
    found.set_step_count(3)
    assert not found.window.visible


# ------------------------------------------------------------------ which job is shown


def listed(*names: str) -> tuple[Any, ...]:
    return tuple(Mock(id=name, photo=f"{name}.jpg", status="running", outcome=None) for name in names)


def selection(
    jobs: tuple[Any, ...] | None, *, asked: str | None = None, shown: str | None = None, scene: str | None = None
) -> JobSelection:
    lists = SimpleNamespace(jobs=jobs, scenes=("ball", "copy"))
    job = Mock(stream=None if shown is None else SimpleNamespace(id=shown, job=None))
    job.open.side_effect = lambda id: setattr(job, "stream", SimpleNamespace(id=id, job=None))
    job.leave.side_effect = lambda: setattr(job, "stream", None)
    return JobSelection(Mock(), lists, job, Mock(scene_id=scene), RequestedPage(asked, False, None))  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def _labels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viewer.job_selection.job_label", lambda job, zone: f"job {job.id}")


@pytest.mark.parametrize(
    ("jobs", "asked", "shown", "scene", "opened", "first_scene"),
    [
        (None, None, None, None, None, None),  # nothing is known yet
        ((), None, None, None, None, "ball"),
        ((), None, None, "copy", None, None),  # a scene is shown already
        (("b", "a"), None, None, None, "b", None),
        (("b", "a"), None, "b", "ball", None, None),
        (("c", "b"), None, "b", "ball", "c", None),
        (("b", "a"), "a", None, None, "a", None),
        (("b", "a"), "a", "a", "ball", None, None),
        (("b", "a"), "gone", None, None, "gone", None),
        (None, "a", None, None, "a", None),
    ],
)
def test_the_job_that_was_asked_for_is_opened_or_the_newest(
    jobs: tuple[str, ...] | None,
    asked: str | None,
    shown: str | None,
    scene: str | None,
    opened: str | None,
    first_scene: str | None,
) -> None:
    found = selection(None if jobs is None else listed(*jobs), asked=asked, shown=shown, scene=scene)
    assert found._controls.newest.value is (asked is None)
    found.sync()
    assert (found._job.open.call_args.args[0] if found._job.open.called else None) == opened
    assert (found._scene.show.call_args.args[0] if found._scene.show.called else None) == first_scene
    current = opened or shown
    if jobs and current in jobs:
        assert found._controls.jobs.value == f"job {current}"
        assert found._controls.jobs.options == tuple(f"job {name}" for name in jobs)
    else:
        assert isinstance(found._controls.jobs.value, Mock)  # unchanged


def test_a_chosen_job_or_scene_ends_following() -> None:
    found = selection(listed("b", "a"), shown="b", scene="ball")
    found.sync()
    found.choose_job("job unknown")
    assert not found._job.open.called
    found.choose_job("job a")
    assert found._job.open.call_args.args == ("a",)
    assert found._controls.newest.value is False
    found.choose_newest(True)
    assert found._job.open.call_args.args == ("b",)
    found.choose_newest(False)
    found._lists.jobs = listed("c", "b")
    found.sync()
    assert found._job.stream.id == "b"
    found._job.leave()
    found.sync()  # the choice is kept
    assert found._job.open.call_args.args == ("b",)
    assert found._job.stream.id == "b"
    found._job.leave.reset_mock()
    found.choose_scene("ball")  # the one that is shown
    assert not found._job.leave.called
    found.choose_scene("copy")
    assert found._job.leave.called
    assert found._controls.set_step_count.call_args.args == (0,)
    assert found._scene.show.call_args.args == ("copy", None)
    found.sync()
    assert found._job.stream is None
    assert found._controls.newest.value is False


def test_a_job_that_is_not_listed_any_more_has_a_line_above_the_others() -> None:
    found = selection(listed("c", "b"), asked="old", shown="old", scene="ball")
    found.sync()
    assert found._controls.jobs.options == ("job c", "job b")  # nothing is known of it yet
    found._job.stream.job = Mock(listed=lambda: Mock(id="old"))
    found.sync()
    assert found._controls.jobs.options == ("job old", "job c", "job b")
    assert found._controls.jobs.value == "job old"
    found._job.show_awaited_scene.assert_called_with(("ball", "copy"))
    # One that is listed has no second line.
    found._job.stream.job, found._job.stream.id = Mock(listed=lambda: Mock(id="b")), "b"
    found._chosen = "b"
    found.sync()
    assert found._controls.jobs.options == ("job c", "job b")
    assert found._controls.jobs.value == "job b"


# ------------------------------------------------------------------ actions


def test_actions_run_in_order_and_the_last_of_a_key_wins() -> None:
    queue, done = ActionQueue(), []
    for name, key in (("a", "x"), ("b", "y"), ("c", "x")):
        queue.post(lambda name=name: done.append(name), key)
    for action in queue.take(0) or []:
        action()
    assert done == ["c", "b"]
    assert queue.take(0) == []
    assert not queue.closed
    queue.post(done.clear)
    queue.close()
    assert queue.closed
    assert queue.take(None) is None


@pytest.mark.parametrize(("wake", "taken"), [("post", 1), ("close", None)])
def test_who_waits_for_actions_is_woken(wake: str, taken: int | None) -> None:
    queue = ActionQueue()
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(queue.take(None)), daemon=True)
    thread.start()
    until(lambda: queue._changed._waiters, "waiting")  # type: ignore[attr-defined]
    queue.post(lambda: None) if wake == "post" else queue.close()
    thread.join(5)
    assert [None if actions is None else len(actions) for actions in found] == [taken]


def test_actions_are_waited_for_until_the_timeout_and_taken_at_once_where_there_are_some() -> None:
    queue = ActionQueue()
    began = time.monotonic()
    assert queue.take(0.05) == []
    assert 0.04 < time.monotonic() - began < 2
    queue.post(lambda: None)
    assert len(queue.take(60) or []) == 1
    assert time.monotonic() - began < 10


# ------------------------------------------------------------------ the service's render behind the view


def background(*, scene: str | None = "ball", width: int = 1600, height: int = 1200) -> tuple[Any, list[Any], Any]:
    """A render behind the view of one browser, the images that it shows, and the service's answers."""
    shown: list[Any] = []
    camera = SimpleNamespace(
        image_width=width, image_height=height, fov=1.0, wxyz=np.array([1.0, 0, 0, 0]), position=np.zeros(3)
    )
    service = Mock()
    service.render.return_value = jpeg((9, 99, 199))
    found = BackgroundRender(SimpleNamespace(camera=camera, client_id=1), service, shown.append)  # type: ignore[arg-type]
    found._scene_id = scene
    return found, shown, service


@pytest.mark.parametrize(("showing", "enabled", "without"), [*itertools.product(*3 * [[False, True]])])
def test_a_movement_shows_the_splats_where_there_are_some(showing: bool, enabled: bool, without: bool) -> None:
    found, shown, _ = background()
    found._showing, found._enabled, found._without_splats = showing, enabled, without
    found.moved()
    hidden = showing and not (without and enabled)
    assert shown == ([None] if hidden else [])
    assert found._showing is (showing and not hidden)


def test_whatever_is_set_has_the_view_rendered_again() -> None:
    found, _, _ = background()
    for k, change in enumerate((
        lambda: found.set_scene("copy"), lambda: found.set_enabled(False), lambda: found.set_without_splats(False),
    )):  # fmt: skip
        change()
        assert found._moves == k + 1
    assert (found._scene_id, found._enabled, found._without_splats) == ("copy", False, False)


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("after", [False, True])
def test_a_render_of_a_moment_ago_is_shown_where_there_is_nothing_else(before: bool, after: bool, moved: bool) -> None:
    found, shown, service = background()
    found._without_splats = before

    def meanwhile(*_: Any, **__: Any) -> bytes:
        found._without_splats = after
        found._moves += moved
        return jpeg((9, 99, 199))

    service.render.side_effect = meanwhile
    found._render(found._moves, 480)
    assert len(shown) == (not moved or (before and after))
    assert found._showing is bool(shown)


def test_nothing_is_rendered_or_shown_that_is_not_wanted() -> None:
    for spoil in ("no scene", "off", "closed", "another scene"):
        found, shown, service = background(scene=None if spoil == "no scene" else "ball")
        found._enabled = spoil != "off"

        def meanwhile(*_: Any, found: Any = found, spoil: str = spoil, **__: Any) -> bytes:
            found._closed = spoil == "closed"
            found._scene_id = "copy" if spoil == "another scene" else "ball"
            return jpeg((9, 99, 199))

        service.render.side_effect = meanwhile
        found._render(0, 480)
        assert shown == []
        assert bool(service.method_calls) is (spoil in ("closed", "another scene"))


@pytest.mark.parametrize(
    ("size", "limit", "expected"),
    [((1600, 1200), 480, (480, 360)), ((1600, 1200), 1280, (1280, 960)), ((300, 200), 480, (300, 200)),
     ((600, 1200), 480, (240, 480)), ((0, 0), 480, (1, 1))],
)  # fmt: skip
def test_a_render_is_no_larger_than_the_browsers_view(
    size: tuple[int, int], limit: int, expected: tuple[int, int]
) -> None:
    found = background(width=size[0], height=size[1])[0]
    found._client.camera.fov = 0.7
    lens = found._camera(limit).intrinsics
    assert (lens.width, lens.height) == expected
    assert 2 * np.arctan(0.5 * lens.height / lens.fy) == pytest.approx(0.7)
    assert (lens.cx, lens.cy) == (lens.width / 2, lens.height / 2)


def test_views_are_the_same_up_to_rounding() -> None:
    found = background()[0]
    now = found._camera()
    assert not _same_view(None, now)
    for change, same in ((1e-6, True), (1e-3, False)):
        found._client.camera.position = np.array([change, 0, 0])
        assert _same_view(now, found._camera()) is same
    found._client.camera.position = np.zeros(3)
    for fov, same in ((1 + 1e-6, True), (1 + 1e-3, False)):
        found._client.camera.fov = fov
        assert _same_view(now, found._camera()) is same
    found._client.camera.fov = 1.0
    for factor, same in ((1 + 0.9e-4, True), (1 - 0.9e-4, True), (1 + 1.1e-4, False), (1 - 1.1e-4, False)):
        lens = replace(now.intrinsics, fy=factor * now.intrinsics.fy)
        assert _same_view(replace(now, intrinsics=lens), now) is same
    found._client.camera.image_width = 1500
    assert not _same_view(now, found._camera())


def test_the_photo_is_over_renders_from_its_own_place_alone() -> None:
    found, shown, _ = background(width=96, height=64)
    view = found._camera()
    found._overlay = Overlay(np.full((64, 96, 3), 255, np.uint8), view)
    found._opacity = 1.0
    image = np.zeros((64, 96, 3), np.uint8)
    assert found._with_overlay(image, view)[32, 48].tolist() == [255, 255, 255]
    aside = replace(view, pose=moved(view.pose, np.array([0, 0, 0, 0.01, 0, 0])))
    assert found._with_overlay(image, aside) is image
    # Up to 60 degrees beside its axis something of it may be in view.
    for degrees, fits in ((59, True), (61, False)):
        turned = replace(view, pose=moved(view.pose, np.array([0, np.radians(degrees), 0, 0, 0, 0])))
        assert found._overlay.fits(turned) is fits
    # Its opacity is changed at once where a render is shown.
    found._rendered = image, view
    found.set_opacity(0.5)
    assert shown == []
    found._showing = True
    found.set_opacity(0.0)
    (seen,) = shown
    assert seen[32, 48].tolist() == [0, 0, 0]


def test_the_view_is_rendered_once_it_rests_and_again_after_each_movement(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background_render, "_REST_S", 0.01)
    found, shown, service = background()
    reports: list[Any] = []
    found._client.camera.on_update = reports.append
    found._without_splats = False
    found.start()
    (report,) = reports
    for count in (1, 2):
        found._client.camera.position = np.array([float(count), 0, 0])
        asyncio.run(report(None))
        until(lambda count=count: service.render.call_count == count and len(shown) == 2 * count - 1, "a render")
        assert shown[-1] is not None
        asyncio.run(report(None))  # a view that was set from here comes back
        assert len(shown) == 2 * count - 1
    found.close()
    until(lambda: not threads("background-1"), "the thread's end")
    assert service.render.call_count == 2


# ------------------------------------------------------------------ charts


def test_a_curve_goes_through_its_values_and_the_step_is_marked_there() -> None:
    """Read back from the SVG: places on both axes are where the ticks' texts say."""
    shown = [replace(r, step_deg=10.0 * r.index, stage="a" if r.index < 2 else "b") for r in records(5)]
    drawn = charts.curves_html(shown, None, 3)
    chart = drawn.split("</svg>")[1]  # of the steps' rotations
    ticks = {float(text): float(y) for y, text in re.findall(r"y='([\d.]+)' text-anchor='end'[^>]*>([\d.]+)<", chart)}
    steps = {int(text): float(x) for x, text in re.findall(r"x='([\d.]+)' y='102.0'[^>]*>(\d+)<", chart)}
    (mark,) = re.findall(r"M([\d.]+) 6V", chart)
    assert set(steps) == {0, 4}
    at = {step: steps[0] + (steps[4] - steps[0]) * step / 4 for step in range(5)}
    assert float(mark) == pytest.approx(at[3], abs=0.1)
    # Texts stand 3 units below their line.
    unit = (ticks[40] - ticks[0]) / 40
    expected = [(at[k], ticks[0] - 3 + 10 * k * unit) for k in range(5)]
    (line,) = re.findall(r"<path d='(M[^']*)' fill='none'", chart)
    points = [tuple(map(float, point)) for point in re.findall(r"([\d.]+) ([\d.]+)", line)]
    assert np.allclose(points, expected, atol=0.11)
    width, height = map(float, re.findall(r"viewBox='0 0 (\d+) (\d+)'", chart)[0])
    assert all(0 < x < width and 0 < y < height for x, y in points)


def test_the_strip_of_stages_names_each_and_marks_the_step() -> None:
    shown = [replace(r, stage="first" if r.index < 2 else "second") for r in records(5)]
    strip = charts.stages_html(shown, 1)
    spans = [tuple(map(float, span)) for span in re.findall(r"left:([\d.]+)%;width:([\d.]+)%", strip)]
    assert spans == [(0, 37.5), (37.5, 62.5)]
    assert "calc(25.00% - 1.5px)" in strip
    for name, colour in charts.stage_colours(shown).items():
        assert f">{name}<" not in strip.partition("</div></div>")[0].partition("flex")[0]
        assert re.search(rf"background:{colour};margin-right:.3em'></i>{name}</span>", strip)
    assert "first: 2 steps" in strip
    assert "second: 3 steps" in strip
    assert charts.stages_html([], 0) == ""


@pytest.mark.parametrize(
    ("values", "log", "ends", "ticks"),
    [
        ([0.2, 0.9], False, (0, 0.9), [0, 0.2, 0.4, 0.6, 0.8]),
        ([3.0, 4.5], False, (0, 4.5), [0, 1, 2, 3, 4]),
        ([-1.0, 1.0], False, (-1, 1), [-1, -0.5, 0, 0.5, 1]),
        ([0.0], False, (0, 1), [0, 0.2, 0.4, 0.6, 0.8, 1]),
        ([80.0], False, (0, 80), [0, 20, 40, 60, 80]),
        ([5.0], False, (0, 5), [0, 2, 4]),
        ([-4.0, 4.0], False, (-4, 4), [-4, -2, 0, 2, 4]),
        ([0.02, 3.0], True, (0.01, 10), [0.01, 0.1, 1, 10]),
        ([1e-6, 3.0], True, (1e-6, 10), [1e-6, 1e-4, 1e-2, 1]),
    ],
)
def test_axes_have_a_few_round_ticks(
    values: list[float], log: bool, ends: tuple[float, float], ticks: list[float]
) -> None:
    low, high, found = charts._axis(np.array(values), log=log)
    assert (low, high) == pytest.approx(ends)
    assert found == pytest.approx(ticks)


# ------------------------------------------------------------------ the process


def test_the_process_serves_until_its_input_ends(monkeypatch):
    made, signals, read = [], [], iter([b"still there", b""])

    class Served:
        def __init__(self, connect, host, port):
            made.append((connect.args, connect.keywords, host, port))
            self.server = SimpleNamespace(get_port=lambda: 8001)

        def stop(self):
            made.append("stopped")

    monkeypatch.setattr("viewer.viewer_server.Viewer", Served)
    monkeypatch.setattr("os.read", lambda descriptor, count: next(read) if descriptor == 0 else b"")
    monkeypatch.setattr("signal.signal", lambda number, _: signals.append(number))
    monkeypatch.setattr("logging.basicConfig", lambda **_: None)
    monkeypatch.setattr(sys, "argv", ["viewer", "--service", "http://s", "--port", "7", "--end-with-stdin"])
    monkeypatch.delitem(sys.modules, "viewer.__main__", raising=False)
    runpy.run_module("viewer", run_name="__main__")
    asked = {"timeout_s": 30.0, "use_proxy": False, "certificate": None}
    assert made == [(("http://s",), asked, "127.0.0.1", 7), "stopped"]
    assert signals == [signal.SIGTERM, signal.SIGINT]
    assert next(read, None) is None
