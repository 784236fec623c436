"""One browser: its job, its position in the job's trace, its scene and its widgets.

Each session has one thread, and everything that touches its state runs there: callbacks of widgets, of feeds
and of the list of jobs only post what has to be looked at again. What is posted twice before its turn runs
once, so a dragged slider or a fast job never queues up work, and a slow browser holds up no one else.
"""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import numpy as np
import viser

from service.types import Camera, Pose
from viewer.background_render import BackgroundRender
from viewer.comparison_images import Mode
from viewer.controls import NO_JOB, NO_SCENE, Controls
from viewer.job_stream import JobStream, Library, SceneContent
from viewer.playback import Playback, headline_html, job_label, legend_html, scene_html
from viewer.replay import replay_html
from viewer.scene_3d import Layer, Scene3D
from viewer.service_client import ServiceError
from viewer.step_display import StepDisplay

log = logging.getLogger(__name__)

_ARRIVAL_S = 2.0

Action = Callable[[], None]


class BrowserSession:
    """Ends with its browser tab: `close` frees everything."""

    def __init__(self, client: viser.ClientHandle, library: Library, job_id: str | None, *, splats: bool) -> None:
        """`splats`: whether the browser is to draw them, to begin with; else the service does."""
        self.panel = Controls(client, splats=splats)
        self.stage = Scene3D(client, splats=splats)
        self._client = client
        self._library = library
        self._follows = job_id is None
        """Shows the newest job, whichever that is."""
        self._wanted = job_id
        """The job that the address or the user asked for, where it doesn't follow; None: a scene by itself."""
        self._feed: JobStream | None = None
        self._scene_id: str | None = None
        self._playback = Playback()
        self._detail = StepDisplay(self.panel, self.stage)
        self._exact = BackgroundRender(client, library.service, self._show_exact)
        self._saving = False
        self._opened = self._ticked = 0.0
        self._asked: dict[str, Any] = {}
        """What the user last set; a running job sets the same widgets, perhaps before it is looked at."""
        self._todo: list[Action] = []
        self._ready = threading.Condition()
        self._closed = False

    def start(self) -> None:
        self.panel.newest.value = self._follows
        self._wire()
        self._library.listen(self._jobs_changed)
        self.post(self._sync_jobs)
        self._exact.start()
        threading.Thread(target=self._run, name=f"browser-{self._client.client_id}", daemon=True).start()

    def close(self) -> None:
        self._exact.close()
        with self._ready:
            self._closed = True
            self._ready.notify()

    def post(self, action: Action) -> None:
        """Run `action` on the session's thread, once if it is already waiting."""
        with self._ready:
            if action not in self._todo:
                self._todo.append(action)
                self._ready.notify()

    def _run(self) -> None:
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._closed or self._todo, self._idle_in_s())
                if self._closed:
                    break
                actions, self._todo = self._todo, []
            for action in actions or [self._idle]:
                self._try(action)
        self._library.ignore(self._jobs_changed)
        if self._feed is not None:
            self._library.leave(self._feed, self._feed_changed)
        # A browser's widgets refer to one another: left to itself, Python finds them when many more have come and gone.
        gc.collect()

    def _idle_in_s(self) -> float | None:
        """How long at most to wait for something to do; None: until it comes."""
        if self._detail.due_in_s is not None:
            return self._detail.due_in_s
        if self.stage.lacks_splats:
            return 0.0
        if self._playback.playing:
            return max(0.0, self._ticked + 1 / float(self.panel.speed.value) - time.monotonic())
        return None

    def _idle(self) -> None:
        """Nothing else waits: go on with the step that is shown, send the splats, or play on."""
        if self._detail.due_in_s is not None:
            self._detail.go_on()
        elif self.stage.lacks_splats:
            self.stage.add_splats()
            self._exact.stand_alone(False)
        elif self._playback.playing:
            self._ticked = time.monotonic()
            self._playback.tick()
            self._show()

    def _try(self, action: Action) -> None:
        try:
            action()
        except (ServiceError, ValueError) as error:
            log.warning("%s", error)
            self.panel.headline.content = headline_html(None, 0, str(error))
        except Exception:
            # A step that fails must not end the session; a browser that has just left makes any step fail.
            if not self._closed:
                log.exception("viewer step failed")

    def _wire(self) -> None:
        panel = self.panel
        self._on_user(panel.jobs, self._user_chose_job, "job")
        self._on_user(panel.newest, self._user_chose_newest)
        self._on_user(panel.step, self._user_moved_slider, "step")
        self._on_user(panel.scenes, self._user_chose_scene, "scene")
        for widget in (panel.matches, panel.weight, panel.colour_by):
            self._on_user(widget, self._redraw)
        self._on_user(panel.exact, lambda: self._exact.want(panel.exact.value))
        for layer in panel.layers:
            self._on_user(panel.layers[layer], partial(self._user_chose_layer, layer))
        panel.play.on_click(lambda event: self.post(lambda press=event.target.value: self._press(press)))
        panel.mode.on_click(lambda event: self.post(lambda mode=event.target.value: self._set_mode(mode)))
        panel.look_through.on_click(lambda _: self.post(self._look_through))
        panel.fly.on_click(lambda _: self.post(self._fly))
        panel.replay.on_click(lambda _: self.post(self._save_replay))
        self._client.scene.on_click()(
            lambda event: self.post(lambda: self._clicked(event.ray_origin, event.ray_direction))
        )
        command = self._client.gui.add_command
        command("Next step", hotkey="N").on_trigger(lambda _: self.post(lambda: self._press("next ▶")))
        command("Previous step", hotkey="P").on_trigger(lambda _: self.post(lambda: self._press("◀ previous")))
        command("Play or pause", hotkey="space").on_trigger(lambda _: self.post(lambda: self._press("play / pause")))

    def _on_user(self, widget: Any, action: Action, name: str = "") -> None:
        """Post the action when the user, not this program, has changed the widget; its value is asked for by `name`."""

        async def changed(event: Any) -> None:  # async: runs on viser's own loop, not in its pool of threads
            if event.client is not None:
                if name:
                    self._asked[name] = widget.value
                self.post(action)

        widget.on_update(changed)

    def _jobs_changed(self) -> None:
        self.post(self._sync_jobs)

    def _feed_changed(self) -> None:
        self.post(self._sync_feed)

    def _sync_jobs(self) -> None:
        """Bring the list of jobs up to date, and change to the newest job if that is wanted."""
        jobs = self._library.jobs or ()
        if jobs:
            self.panel.jobs.options = tuple(job_label(job) for job in jobs)
        if self._library.scenes:
            self.panel.scenes.options = self._library.scenes
        wanted = self._wanted if not self._follows else jobs[0].id if jobs else None
        if wanted is not None and (self._feed is None or self._feed.id != wanted):
            self._open(wanted)
        elif wanted is None and self._scene_id is None and self._library.jobs is not None:
            self._show_scene(next(iter(self._library.scenes), None), None)
            self.panel.headline.content = headline_html(None, 0, "")
        if self._feed is not None:
            label = next((job_label(job) for job in jobs if job.id == self._feed.id), None)
            if label is not None:
                self.panel.jobs.value = label

    def _open(self, job_id: str) -> None:
        """Leave the job that is shown and follow another one."""
        self._leave()
        self._opened = time.monotonic()
        self._feed = self._library.follow(job_id, self._feed_changed)
        self.post(self._sync_feed)

    def _leave(self) -> None:
        """Show no job any more."""
        if self._feed is not None:
            self._library.leave(self._feed, self._feed_changed)
        self._feed = None
        self._playback = Playback()
        self._detail.clear()

    def _sync_feed(self) -> None:
        """Take over what the job has told since the last time."""
        feed = self._feed
        if feed is None:
            return
        count = len(feed.records)
        self.panel.headline.content = headline_html(feed.job, count, feed.trouble)
        if feed.job is None:
            return
        self.panel.legend.content = legend_html(feed.job.answer, truth=feed.job.truth is not None)
        self._show_scene(feed.job.scene, feed.records[count - 1].pose if count else None)
        count = len(feed.records)  # again: loading a scene takes a while
        newest = feed.records[count - 1].pose if count else None
        self._playback.grow(count)
        self._enable(count)
        self.stage.show_trajectory(feed.records[:count], feed.job)
        # A job that has just been opened is looked at where it is; later on the view is the user's.
        if newest is not None and (self._detail.fresh or time.monotonic() < self._opened + _ARRIVAL_S):
            self.stage.look_over(newest)
        self._show()

    def _enable(self, count: int) -> None:
        """Let the user go through so many records."""
        panel = self.panel
        panel.step.max = max(0, count - 1)
        panel.step.disabled = panel.look_through.disabled = panel.fly.disabled = count == 0
        panel.replay.disabled = count == 0 or self._saving
        panel.window.visible = panel.window.visible and count > 0

    def _show_scene(self, scene_id: str | None, pose: Pose | None) -> None:
        if scene_id is None or scene_id == self._scene_id:
            return
        content = self._library.scene(scene_id)
        self.stage.show_scene(content, pose)
        self._opened = time.monotonic()
        self._scene_id = self.panel.scenes.value = scene_id
        self._exact.stand_alone(True)
        self._exact.use(scene_id)
        self._describe(content)

    def _describe(self, content: SceneContent) -> None:
        """Tell what is drawn of the scene."""
        drawn = len(content.splats.rgba) if self.panel.layers["splats"].value else 0
        self.panel.scene.content = scene_html(content.view.name, drawn, content.splats.total, len(content.view.cameras))

    def _show(self) -> None:
        """Show the record at the playback's position; its picture follows when nothing else waits."""
        feed, index = self._feed, self._playback.index
        if feed is not None and index < self._playback.count:
            self._detail.show(feed, index)

    def _redraw(self) -> None:
        feed, index = self._feed, self._playback.index
        if feed is not None and index < len(feed.records):
            self._detail.redraw(feed, index)

    def _show_exact(self, picture: np.ndarray | None) -> None:
        self.post(lambda: self.stage.show_exact(picture))

    def _user_chose_job(self) -> None:
        label = self._asked["job"]
        chosen = next((job.id for job in self._library.jobs or () if job_label(job) == label), None)
        if label != NO_JOB and chosen is not None:
            self._wanted, self._follows = chosen, False
            self.panel.newest.value = False
            self._sync_jobs()

    def _user_chose_scene(self) -> None:
        """Show a scene by itself, without any job."""
        scene_id = self._asked["scene"]
        if scene_id in (NO_SCENE, self._scene_id):
            return
        self.panel.newest.value = self._follows = False
        self._wanted = None
        self._leave()
        self._enable(0)
        self._show_scene(scene_id, None)
        self.panel.headline.content = headline_html(None, 0, "")

    def _user_chose_layer(self, layer: Layer) -> None:
        shown = self.panel.layers[layer].value
        self.stage.set_visible(layer, shown)
        if layer == "splats" and self._scene_id is not None:
            self._exact.stand_alone(not shown or self.stage.lacks_splats)
            self._describe(self._library.scene(self._scene_id))

    def _user_chose_newest(self) -> None:
        self._follows = self.panel.newest.value
        self._wanted = self._feed.id if self._feed is not None else None
        self._sync_jobs()

    def _user_moved_slider(self) -> None:
        self._playback.playing = False
        self._playback.go(self._asked["step"])
        self._show()

    def _press(self, button: str) -> None:
        if button == "play / pause":
            self._playback.toggle()
        else:
            self._playback.step(1 if button.startswith("next") else -1)
        self._show()

    def _set_mode(self, mode: str) -> None:
        self._detail.mode = cast(Mode, mode)
        self._redraw()

    def _look_through(self) -> None:
        feed, index = self._feed, self._playback.index
        if feed is not None and feed.job is not None and index < len(feed.records):
            self._look(feed.job.camera(feed.records[index]))

    def _look(self, camera: Camera) -> None:
        self._opened = 0.0  # from now on the view is the user's
        self.stage.look_through(camera)

    def _fly(self) -> None:
        self._opened = 0.0
        if self._feed is not None and self._feed.records:
            self.stage.fly_to(self._feed.records[-1].pose)

    def _clicked(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        """Jump to the step whose frustum was clicked, or look through a training camera."""
        target = self.stage.clicked(origin, direction)
        if isinstance(target, Camera):
            self._look(target)
        elif target is not None:
            self._playback.playing = False
            self._playback.go(target)
            self._show()

    def _save_replay(self) -> None:
        """Make the replay file on a thread of its own, and send it."""
        feed, scene_id = self._feed, self._scene_id
        if feed is None or scene_id is None or self._saving:
            return
        content = self._library.scene(scene_id)
        self._saving = self.panel.replay.disabled = True
        self.panel.replay.label = "making the replay file…"

        def make() -> None:
            try:
                page = replay_html(feed, content).encode()
                self._client.send_file_download(f"splatfix-{feed.id}.html", page, save_immediately=True)
            except Exception as error:  # whatever it is, the user shall hear of it
                log.warning("no replay of job %s: %s", feed.id, error)
                self._client.add_notification("No replay file", str(error), color="red")
            self.post(self._replay_done)

        threading.Thread(target=make, name=f"replay-{self._client.client_id}", daemon=True).start()

    def _replay_done(self) -> None:
        self._saving = self.panel.replay.disabled = False
        self.panel.replay.label = "save as replay file"
