"""The job that one browser shows: its records as they arrive, the step that is shown, and the view of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from service.types import Camera
from viewer.background_render import Overlay
from viewer.comparison_images import Mode
from viewer.comparison_panel import photo_of
from viewer.controls import NEXT, PLAY, Controls
from viewer.job_stream import JobStream, JobStreams
from viewer.panel_html import headline_html, legend_html
from viewer.playback import Playback
from viewer.scene_3d import Scene3D
from viewer.scene_display import SceneDisplay
from viewer.step_display import StepDisplay

FOLLOW_AFTER_OPEN_S = 2.0
"""Time after a job was opened in which the view follows its newest pose."""


class JobDisplay:
    """All methods are called from the session's thread."""

    def __init__(
        self,
        controls: Controls,
        scene: Scene3D,
        scene_display: SceneDisplay,
        streams: JobStreams,
        on_change: Callable[[], None],
    ) -> None:
        """`on_change` is called on the stream's thread after each change; it should have `sync` called."""
        self.stream: JobStream | None = None
        """Of the job that is shown; None: no job."""
        self.step = StepDisplay(controls, scene)
        self._controls, self._scene, self._scene_display = controls, scene, scene_display
        self._streams, self._on_change = streams, on_change
        self._playback = Playback()
        self._opened = self._ticked = 0.0
        """When the job was opened (0: the user has moved the view since), and when playback moved on."""

    def open(self, job_id: str) -> None:
        """Leave the job that is shown and follow another one."""
        self.leave()
        self._opened = time.monotonic()
        self.stream = self._streams.follow(job_id, self._on_change)
        # A stream that another browser follows has its records already and may never change again.
        self._on_change()

    def leave(self) -> None:
        """Show no job."""
        self.close()
        self.stream = None
        self._playback = Playback()
        self._scene_display.show_photo(None)
        self.step.clear()

    def close(self) -> None:
        """Stop following the job."""
        if self.stream is not None:
            self._streams.leave(self.stream, self._on_change)

    def sync(self) -> None:
        """Show what has changed in the job's stream. Raises ServiceError, ValueError."""
        stream = self.stream
        if stream is None:
            return
        count = len(stream.records)
        self._controls.headline.content = headline_html(stream.job, count, stream.error)
        if stream.job is None:
            return
        self._controls.legend.content = legend_html(stream.job.outcome, truth=stream.job.truth is not None)
        if self._scene_display.show(stream.job.scene, stream.records[count - 1].pose if count else None):
            self._opened = time.monotonic()
        count = len(stream.records)  # again, as more may have arrived while the scene was loaded
        self._playback.set_count(count)
        self._controls.set_step_count(count)
        self._scene.trajectory.show(stream.records[:count], stream.job)
        # The view follows a job that has just been opened; later on it is the user's.
        if count and (self.step.empty or time.monotonic() < self._opened + FOLLOW_AFTER_OPEN_S):
            self._scene.look_from_behind(stream.records[count - 1].pose)
        self._show()

    def show_awaited_scene(self, loaded: Sequence[str]) -> None:
        """Show the job's scene once it is in memory, where it wasn't when the job was opened."""
        job = self.stream and self.stream.job
        if job and job.scene != self._scene_display.scene_id and job.scene in loaded:
            self.sync()

    @property
    def tick_in_s(self) -> float | None:
        """Time until playback moves on; None: it is paused."""
        if not self._playback.playing:
            return None
        return max(0.0, self._ticked + 1 / float(self._controls.speed.value) - time.monotonic())

    def tick(self) -> None:
        """Show the next record if playing."""
        self._ticked = time.monotonic()
        self._playback.tick()
        self._show()

    def go_to(self, index: int) -> None:
        """Pause, and show record `index`."""
        self._playback.playing = False
        self._playback.go(index)
        self._show()

    def press(self, button: str) -> None:
        """Play, pause or move by one record, as a button of the player says."""
        if button == PLAY:
            self._playback.toggle()
        else:
            self._playback.step(1 if button == NEXT else -1)
        self._show()

    def set_mode(self, mode: Mode) -> None:
        """Choose how photo and render are compared."""
        self.step.set_mode(mode)
        self.redraw()

    def redraw(self) -> None:
        """Draw the record anew, after a widget that it depends on has changed."""
        stream, index = self.stream, self._playback.index
        if stream is not None and index < len(stream.records):
            self.step.redraw(stream, index)

    def look_through(self) -> None:
        """Take the view of the camera of the record that is shown."""
        stream, index = self.stream, self._playback.index
        if stream is not None and stream.job is not None and index < len(stream.records):
            record = stream.records[index]
            camera = stream.job.camera(record)
            self._look_through(camera)
            photo = photo_of(stream, record)
            self._scene_display.show_photo(None if photo is None else Overlay(photo, camera))

    def fly_to_result(self) -> None:
        """Move the view to the newest pose."""
        self._opened = 0.0
        if self.stream is not None and self.stream.records:
            self._scene.fly_to(self.stream.records[-1].pose)

    def click(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        """Show the record whose frustum a ray hits, or look through the training camera that it hits."""
        target = self._scene.hit(origin, direction)
        if isinstance(target, Camera):
            self._look_through(target)
        elif target is not None:
            self.go_to(target)

    def _look_through(self, camera: Camera) -> None:
        self._opened = 0.0
        self._scene_display.show_photo(None)
        self._scene.look_through(camera)

    def _show(self) -> None:
        stream, index = self.stream, self._playback.index
        if stream is not None and index < self._playback.count:
            self.step.show(stream, index)
