"""What the viewer's window shows of a step, and which scene it shows, with stand-ins for browser and service."""

from __future__ import annotations

import itertools
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from fake_service import PHOTO, orbit, records

from service.client import ServiceError
from service.results import MatchVectors
from service.types import Camera, IntrinsicsCorrection
from viewer import browser_camera, step_display
from viewer.browser_camera import BrowserCamera
from viewer.browser_session import BrowserSession
from viewer.camera_views import Viewpoint
from viewer.colours import INLIER_COLOUR, OUTLIER_COLOUR
from viewer.comparison_images import match_vectors_image
from viewer.comparison_panel import ComparisonPanel, photo_of
from viewer.match_geometry import MatchView, backproject_matches, matches_at_pose
from viewer.scene_display import SceneDisplay
from viewer.step_display import StepDisplay

RED, BLUE, GREEN = (np.full((PHOTO.height, PHOTO.width, 3), colour, np.uint8) for colour in (
    (200, 20, 20), (20, 20, 200), (20, 200, 20)
))  # fmt: skip
INLIERS_ONE_OF_TWO = np.array([INLIER_COLOUR, OUTLIER_COLOUR], np.uint8)
RECORD = records(1)[0]


class Stream:
    """A job whose photo is red and whose renders are blue, green from a match's camera."""

    def __init__(self, photo: bool = True, photo_step: int | None = None) -> None:
        self.id, self.complete = "j", False
        self.job = SimpleNamespace(photo_step=photo_step, photo=PHOTO)
        self.rendered: list[tuple[int, bool]] = []
        self._photo = RED if photo else None

    def photo(self) -> np.ndarray | None:
        return self._photo

    def render(self, index: int, *, matched: bool) -> np.ndarray:
        self.rendered.append((index, matched))
        return GREEN if matched else BLUE


def panel(mode: str = "side by side", *, lines: bool = True, weight: float = 0.5) -> tuple[ComparisonPanel, Any]:
    controls: Any = Mock()
    controls.match_lines.value, controls.weight.value, controls.colour_by.value = lines, weight, "inlier"
    found = ComparisonPanel(controls)
    found.mode = mode  # type: ignore[assignment]
    return found, controls


def view(carried_from: int | None = None) -> MatchView:
    """Two matches of a wall at depth 3; one agrees."""
    pose = orbit(0.1)
    px = np.array([[10.0, 10.0], [50.0, 40.0]], np.float32)
    matches = MatchVectors(px, px + 1, np.array([True, False]), Camera(PHOTO, pose))
    points = backproject_matches(matches, np.full((PHOTO.height, PHOTO.width), 3, np.float32), carried_from or 0)
    return matches_at_pose(points, Camera(PHOTO, pose), 0 if carried_from is None else carried_from + 1)


# ------------------------------------------------------------------ comparisons


@pytest.mark.parametrize(
    ("mode", "shown"),
    [
        ("side by side", {"match_lines", "comparison"}),
        ("blend", {"weight", "comparison"}),
        ("difference", {"comparison"}),
        ("checker", {"comparison"}),
        ("flicker", {"flicker"}),
    ],
)
def test_each_mode_has_its_own_widgets(mode: str, shown: set[str]) -> None:
    found, controls = panel(mode, lines=False)
    stream: Any = Stream()
    found.show_comparison(stream, RECORD, None)
    visible = {name for name in ("match_lines", "weight", "flicker", "comparison") if getattr(controls, name).visible}
    assert visible == shown
    assert controls.window.visible is True
    assert controls.caption.content
    if mode == "flicker":
        assert controls.flicker.content.count("data:image/jpeg") == 2
    if mode == "side by side":
        image = controls.comparison.image
        height, width = image.shape[:2]
        # A wide photo above, its render below.
        assert np.array_equal(image[height // 4, width // 2], RED[0, 0])
        assert np.array_equal(image[3 * height // 4, width // 2], BLUE[0, 0])
    if mode == "blend":
        assert np.abs(controls.comparison.image[0, 0] - (RED[0, 0] / 2 + BLUE[0, 0] / 2)).max() <= 1


@pytest.mark.parametrize(
    ("mode", "lines", "carried_from", "matched"),
    [
        ("side by side", True, None, True),
        ("side by side", False, None, False),  # nothing has to fit: the step's own pose
        ("side by side", True, 0, False),  # another step's matches, carried over to this pose
        ("difference", True, None, False),
        ("flicker", True, None, False),
    ],
)
def test_lines_are_drawn_on_the_render_that_they_belong_to(
    mode: str, lines: bool, carried_from: int | None, matched: bool
) -> None:
    for call in ("show_comparison", "prepare"):
        found, controls = panel(mode, lines=lines)
        stream: Any = Stream()
        getattr(found, call)(stream, RECORD, view(carried_from))
        assert stream.rendered == [(0, matched)], call
        if call == "show_comparison":
            assert ("lines:" in controls.caption.content) is (mode == "side by side" and lines)


@pytest.mark.parametrize(("mode", "renders"), [("side by side", 1), ("blend", 1), ("flicker", 2)])
def test_what_was_prepared_is_shown_at_once(mode: str, renders: int) -> None:
    """Flickering images are not composed; the stream keeps them."""
    found, _ = panel(mode)
    stream: Any = Stream()
    found.prepare(stream, RECORD, None)
    found.show_comparison(stream, RECORD, None)
    assert len(stream.rendered) == renders


def test_a_composed_image_is_kept_for_four_steps_and_made_anew_for_another_choice() -> None:
    found, controls = panel("blend")
    stream: Any = Stream()
    for step in (0, 1, 2, 3, 0, 1, 4, 1, 0):  # at 4, 0 was composed first
        found.show_comparison(stream, replace(RECORD, index=step), None)
    assert [index for index, _ in stream.rendered] == [0, 1, 2, 3, 4, 0]
    before = len(stream.rendered)
    changes = [
        lambda: setattr(controls.weight, "value", 0.7),
        lambda: setattr(controls.colour_by, "value", "residual"),
        lambda: setattr(found, "mode", "difference"),
        lambda: setattr(stream, "complete", True),
        found.clear,
    ]
    for count, change in enumerate(changes, 1):
        change()
        for _ in range(2):
            found.show_comparison(stream, replace(RECORD, index=0), None)
        assert len(stream.rendered) == before + count


@pytest.mark.parametrize(
    ("photo", "photo_step", "said"),
    [(False, None, "deleted after the job"), (True, 3, "only the photo of step 3 is kept")],
)
def test_without_its_photo_a_step_shows_the_render_alone(photo: bool, photo_step: int | None, said: str) -> None:
    found, controls = panel("flicker")
    stream: Any = Stream(photo, photo_step)
    assert photo_of(stream, RECORD) is None
    found.show_comparison(stream, RECORD, view())
    assert controls.comparison.image is BLUE
    assert (controls.comparison.visible, controls.flicker.visible, controls.window.visible) == (True, False, True)
    assert said in controls.caption.content
    found.show_match_vectors(stream, RECORD, view())
    assert np.array_equal(controls.vectors_image.image, match_vectors_image(BLUE, view(), INLIERS_ONE_OF_TWO))
    stream.rendered.clear()
    found.prepare(stream, RECORD, view())
    assert stream.rendered == [(0, False)]


def test_the_photo_of_a_sequence_belongs_to_one_step() -> None:
    stream: Any = Stream(photo_step=3)
    assert photo_of(stream, replace(RECORD, index=3)) is RED
    assert photo_of(stream, replace(RECORD, index=2)) is None
    stream.job = None  # not known yet: whose photo it is neither
    assert photo_of(stream, replace(RECORD, index=3)) is None


def test_a_photo_is_shown_as_a_pinhole_with_the_steps_intrinsics_would_have_taken_it() -> None:
    stream: Any = Stream()
    bent = photo_of(stream, replace(RECORD, correction=IntrinsicsCorrection(k1=-0.3)))
    assert bent is not None
    assert bent.shape == RED.shape
    # Barrel distortion: what a pinhole would show in its corners is not all in the photo, its middle is.
    assert np.array_equal(bent[PHOTO.height // 2, PHOTO.width // 2], RED[0, 0])
    assert np.array_equal(photo_of(Stream(), RECORD), RED)  # type: ignore[arg-type]
    pinched = photo_of(stream, replace(RECORD, correction=IntrinsicsCorrection(k1=0.3)))
    assert pinched is not None
    assert np.array_equal(pinched[0, 0], [0, 0, 0])  # beside the photo


def test_match_vectors_are_drawn_over_the_photo_where_there_are_matches() -> None:
    found, controls = panel()
    stream: Any = Stream()
    found.show_match_vectors(stream, RECORD, None)
    assert controls.vectors_image.visible is False
    found.show_match_vectors(stream, RECORD, view())
    assert controls.vectors_image.visible is True
    assert np.array_equal(controls.vectors_image.image, match_vectors_image(RED, view(), INLIERS_ONE_OF_TWO))
    assert "1 agree" in controls.vectors.content


# ------------------------------------------------------------------ steps


def steps(count: int = 4, **job: Any) -> tuple[StepDisplay, Any, Any]:
    """A display of steps with stand-ins for images and scene, and a job with so many records."""
    controls, scene = Mock(), Mock(metres_per_unit=None)
    found = StepDisplay(controls, scene)
    found._images = Mock(colour_by="inlier")
    stream: Any = Stream()
    stream.attempt, stream.records = 1, records(count)
    camera = lambda record: Camera(PHOTO, record.pose)  # noqa: E731
    stream.job = SimpleNamespace(**{"photo_step": None, "photo": PHOTO, "truth": None, "camera": camera} | job)
    stream.matches = lambda index: None
    return found, stream, SimpleNamespace(controls=controls, scene=scene, images=found._images)


def test_a_step_has_its_numbers_at_once_then_images_3d_and_its_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=50.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(step_display, "time", clock)
    found, stream, parts = steps()
    assert found.empty
    assert found.due_in_s is None
    found.show(stream, 1)
    assert not found.empty
    assert parts.controls.step.value == 1
    assert ">101<" in parts.controls.numbers.content
    assert parts.controls.stages.content
    assert parts.controls.flush.call_count == 1  # before anything that takes long
    parts.images.show_comparison.assert_not_called()
    assert found.due_in_s == 0.0
    found.run_next()
    parts.images.show_comparison.assert_called_once_with(stream, stream.records[1], None)
    parts.images.show_match_vectors.assert_called_once_with(stream, stream.records[1], None)
    assert "by step" in parts.controls.curves.content
    assert parts.controls.flush.call_count == 3
    # In a message of its own: viser sends together what is set within a sixtieth of a second.
    parts.scene.trajectory.show_current.assert_not_called()
    assert found.due_in_s is not None
    assert 1 / 60 < found.due_in_s < 0.1
    clock.now += 1.0
    assert found.due_in_s == 0.0
    found.run_next()
    assert parts.scene.trajectory.show_current.call_args.args[0].pose == stream.records[1].pose
    parts.images.prepare.assert_not_called()
    found.run_next()
    found.run_next()
    assert [call.args[1].index for call in parts.images.prepare.call_args_list] == [0, 2]
    assert found.due_in_s is None


@pytest.mark.parametrize(("index", "neighbours"), [(0, [1]), (1, [0, 2]), (3, [2])])
def test_the_steps_beside_are_prepared(index: int, neighbours: list[int]) -> None:
    found, stream, parts = steps()
    found.show(stream, index)
    parts.images.prepare.side_effect = ServiceError("unreachable", "told when the step is shown")
    while found.due_in_s is not None:
        found.run_next()
    assert [call.args[1].index for call in parts.images.prepare.call_args_list] == neighbours


def test_a_step_is_drawn_once_and_again_in_another_attempt() -> None:
    found, stream, _ = steps()
    found.show(stream, 2)
    found._queue.clear()
    found.show(stream, 2)
    assert found.due_in_s is None
    stream.attempt = 2
    found.show(stream, 2)
    assert len(found._queue) == 3
    # What remains of one step is dropped for the next one.
    found.show(stream, 3)
    assert len(found._queue) == 2
    stream.records = stream.records[:1]  # the job has begun anew
    found.run_next()
    found._images.show_comparison.assert_not_called()  # type: ignore[attr-defined]
    found.clear()
    assert found.empty
    assert found.due_in_s is None
    found._images.clear.assert_called_once_with()  # type: ignore[attr-defined]
    found._scene.clear_job.assert_called_once_with()  # type: ignore[attr-defined]
    stream.job = None
    found.show(stream, 0)
    assert found.empty


def test_a_step_without_an_image_says_so_and_has_its_curves() -> None:
    found, stream, parts = steps()
    parts.images.show_comparison.side_effect = ServiceError("not_ready", "The scene is loading.")
    found.show(stream, 1)
    found.run_next()
    assert "no image: " in parts.controls.caption.content
    assert "The scene is loading." in parts.controls.caption.content
    assert "by step" in parts.controls.curves.content
    found.run_next()
    assert parts.scene.trajectory.show_current.called


def frustum_images(found: StepDisplay, stream: Any, *indices: int) -> list[Any]:
    """Draw steps in 3D; return the colour of each image that their frustum gets."""
    shown: list[Any] = []
    for index in indices:
        found._draw_3d(stream, stream.records[index], None)
        image = found._scene.trajectory.show_current.call_args.args[1]  # type: ignore[attr-defined]
        shown.append(None if image is None else image[0, 0].tolist())
    return shown


def test_the_frustums_image_is_sent_once_for_all_steps_of_one_photo() -> None:
    red, blue = RED[0, 0].tolist(), BLUE[0, 0].tolist()
    found, stream, _ = steps()
    assert frustum_images(found, stream, 0, 1, 1) == [red, None, None]
    found.clear()
    assert frustum_images(found, stream, 1) == [red]
    # Of a sequence each step has its own photo, of which one is kept; the others show their render.
    found, stream, _ = steps(photo_step=2)
    assert frustum_images(found, stream, 1, 2, 2, 3) == [blue, red, None, blue]
    assert stream.rendered == [(1, False), (3, False)]
    # Without its photo a single one has none.
    found, stream, _ = steps()
    stream._photo = None
    assert frustum_images(found, stream, 0) == [None]
    stream.job = None
    found._scene.reset_mock()  # type: ignore[attr-defined]
    found._draw_3d(stream, stream.records[0], None)
    assert not found._scene.method_calls  # type: ignore[attr-defined]


def test_candidates_are_those_of_the_last_step_that_has_some_and_matches_have_colours() -> None:
    found, stream, parts = steps()
    stream.records = [replace(r, candidates="some" if k == 1 else None) for k, r in enumerate(stream.records)]
    for index, shown in ((0, None), (1, "some"), (3, "some")):
        found._draw_3d(stream, stream.records[index], None)
        assert parts.scene.candidates.show.call_args.args == (shown, PHOTO)
        assert parts.scene.matches.show.call_args.args == (None, None)
    found._draw_3d(stream, stream.records[3], view())
    seen, inks = parts.scene.matches.show.call_args.args
    assert len(seen.inlier) == 2
    assert np.array_equal(inks, INLIERS_ONE_OF_TWO)


# ------------------------------------------------------------------ scenes


def scene_display(splats_shown: bool = True) -> tuple[SceneDisplay, Any]:
    content = SimpleNamespace(
        splats=SimpleNamespace(rgba=np.zeros((25, 4), np.uint8), total=40),
        description=SimpleNamespace(name="Room", cameras=(1, 2, 3)),
    )
    parts: Any = SimpleNamespace(controls=Mock(), scene=Mock(), background=Mock(), cache=Mock())
    parts.controls.layers = {"splats": SimpleNamespace(value=splats_shown), "trajectory": SimpleNamespace(value=True)}
    parts.cache.get.return_value = content
    parts.scene.splats.pending = False
    return SceneDisplay(parts.controls, parts.scene, parts.background, parts.cache), parts


def test_a_scene_is_shown_once_and_rendered_by_the_service_until_its_splats_are_there() -> None:
    display, parts = scene_display()
    assert display.show(None, None) is False
    assert display.show("room", None) is True
    assert display.show("room", None) is False
    parts.scene.show_scene.assert_called_once()
    parts.background.set_scene.assert_called_once_with("room")
    assert parts.controls.scenes.value == display.scene_id == "room"
    assert [call.args for call in parts.background.set_without_splats.call_args_list] == [(True,)]
    assert "25 of 40 splats" in parts.controls.scene.content
    assert "3 training cameras" in parts.controls.scene.content
    display.send_splats()
    parts.scene.splats.send.assert_called_once()
    assert parts.background.set_without_splats.call_args.args == (False,)


@pytest.mark.parametrize(("visible", "pending"), [*itertools.product((True, False), repeat=2)])
def test_without_splats_in_the_browser_the_service_renders(visible: bool, pending: bool) -> None:
    display, parts = scene_display(splats_shown=not visible)
    display.set_layer_visible("splats", visible)
    parts.background.set_without_splats.assert_not_called()  # there is no scene yet
    display.show("room", None)
    parts.background.set_without_splats.reset_mock()
    parts.scene.splats.pending = pending
    parts.controls.layers["splats"].value = visible
    display.set_layer_visible("splats", visible)
    parts.background.set_without_splats.assert_called_once_with(not visible or pending)
    assert ("drawn by the service" in parts.controls.scene.content) is not visible
    parts.background.set_without_splats.reset_mock()
    display.set_layer_visible("trajectory", False)
    parts.scene.set_visible.assert_called_with("trajectory", False)
    parts.background.set_without_splats.assert_not_called()


# ------------------------------------------------------------------ a session


def session(
    due: float | None = None, pending: bool = False, tick: float | None = None, plan: float | None = None
) -> Any:
    """A session without a browser: what it does when nothing was asked of it."""
    found: Any = object.__new__(BrowserSession)
    found._job = Mock(tick_in_s=tick, step=Mock(due_in_s=due))
    found._scene, found._scene_display, found._plan = Mock(), Mock(), Mock(due_in_s=plan)
    found._scene.splats.pending = pending
    found._controls, found._queue = Mock(), Mock(closed=False)
    return found


@pytest.mark.parametrize(
    ("due", "pending", "tick", "plan", "waits", "done"),
    [
        (0.2, True, 1.0, 0.1, 0.2, "step"),  # the rest of a step first
        (None, True, 1.0, 0.1, 0.0, "splats"),
        (None, False, 1.0, None, 1.0, "tick"),
        (None, False, 0.5, 0.7, 0.5, "tick"),
        (None, False, 0.5, 0.3, 0.3, "plan"),
        (None, False, None, 0.3, 0.3, "plan"),
        (None, False, 0.0, 0.0, 0.0, "tick"),
        (0.0, False, None, None, 0.0, "step"),
        (None, False, None, None, None, None),
    ],
)
def test_idle_time_is_for_the_step_then_the_splats_then_playback_and_coverage(
    due: float | None, pending: bool, tick: float | None, plan: float | None, waits: float | None, done: str | None
) -> None:
    found = session(due, pending, tick, plan)
    assert found._idle_in_s() == waits
    found._idle()
    called = {
        "step": found._job.step.run_next.called,
        "splats": found._scene_display.send_splats.called,
        "tick": found._job.tick.called,
        "plan": found._plan.refresh.called,
    }
    assert [name for name, was in called.items() if was] == ([done] if done else [])


def test_a_failed_action_is_shown_and_the_session_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    def fails(error: Exception) -> Any:
        def action() -> None:
            raise error

        return action

    for error in (ServiceError("unreachable", "nobody answers"), ValueError("nobody answers")):
        found = session()
        found._try(fails(error))
        assert "nobody answers" in found._controls.headline.content
    found = session()
    found._try(fails(RuntimeError("a mistake of ours")))
    assert "viewer step failed" in caplog.text
    caplog.clear()
    found._queue.closed = True  # the browser has left
    found._try(fails(RuntimeError("a mistake of ours")))
    assert "viewer step failed" not in caplog.text


# ------------------------------------------------------------------ the camera


def test_a_flight_starts_here_ends_there_and_is_smooth(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [50.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds
        assert now[0] < 60.0, "it never arrives"

    clock = SimpleNamespace(monotonic=lambda: now[0], sleep=sleep)
    monkeypatch.setattr(browser_camera, "time", clock)
    x, z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    seen: list[tuple[float, float]] = []

    class Recording(SimpleNamespace):
        def __setattr__(self, name: str, value: Any) -> None:
            super().__setattr__(name, value)
            if name == "fov":
                seen.append((now[0] - 50.0, float(self.position[0])))

    camera = Recording(position=0 * x, look_at=z, up_direction=z, aspect=2.0)
    camera.fov = 1.0
    flushed: list[float] = []
    canvas: Any = SimpleNamespace(camera=camera, atomic=nullcontext, flush=lambda: flushed.append(now[0] - 50.0))
    seen.clear()
    BrowserCamera(canvas).fly_to(Viewpoint(10 * x, 5 * z, z, 0.5))
    assert np.allclose(camera.position, 10 * x)
    assert np.allclose(camera.look_at, 5 * z)
    assert camera.fov == 0.5
    times, places = np.array(seen).T
    # Its docstring says 0.8 s; a picture every thirtieth of a second looks continuous.
    assert 0.75 <= times[-1] <= 0.9
    assert 1 / 45 < np.diff(times).min() <= np.diff(times).max() < 1 / 25
    assert flushed == times.tolist()  # each is drawn before the next one
    steps = np.diff(places)
    assert (steps >= 0).all()
    assert steps[0] < 0.2 * steps.max() > steps[-1]  # it speeds up and brakes
    assert BrowserCamera(canvas).aspect == 2.0
    BrowserCamera(canvas).set_clipping(0.1, 50.0)
    assert (camera.near, camera.far) == (0.1, 50.0)
