"""One browser: its job, its position in the job's trace, its scene and its widgets.

Each session has one thread, and everything that touches its state runs there: callbacks of widgets, of feeds
and of the list of jobs only post what has to be looked at again. What is posted twice before its turn runs
once, so a dragged slider or a fast job never queues up work, and a slow browser holds up no one else.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any, cast

import viser

from service.types import Camera, IterationRecord, Pose
from viewer.client import ServiceTrouble
from viewer.draw import Mode, overlaid, reduced, side_by_side
from viewer.feed import JobFeed, Library
from viewer.panel import NO_JOB, Panel
from viewer.playback import Playback, caption_html, headline_html, job_label, record_html, scene_html, small_html
from viewer.stage import Stage

log = logging.getLogger(__name__)

_PLAY_PERIOD_S = 0.5
_TEXTURE_PX = 512
_ARRIVAL_S = 2.0

Action = Callable[[], None]


class Session:
    """Ends with its browser tab: `close` frees everything."""

    def __init__(self, client: viser.ClientHandle, library: Library, job_id: str | None) -> None:
        self.panel = Panel(client)
        self.stage = Stage(client)
        self._client = client
        self._library = library
        self._wanted = job_id
        """The job that the address or the user asked for; None: the newest."""
        self._feed: JobFeed | None = None
        self._scene_id: str | None = None
        self._playback = Playback()
        self._mode: Mode = "side by side"
        self._shown: tuple[str, int] | None = None
        """Job and record that the 3D shows."""
        self._opened = 0.0
        self._picture_due = False
        self._asked_step = 0
        self._todo: list[Action] = []
        self._ready = threading.Condition()
        self._closed = False

    def start(self) -> None:
        self.panel.newest.value = self._wanted is None
        self._wire()
        self._library.listen(self._jobs_changed)
        self.post(self._sync_jobs)
        threading.Thread(target=self._run, name=f"browser-{self._client.client_id}", daemon=True).start()

    def close(self) -> None:
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
                waits = None if not self._busy else _PLAY_PERIOD_S if not self._picture_due else 0.0
                self._ready.wait_for(lambda: self._closed or self._todo, waits)
                if self._closed:
                    break
                actions, self._todo = self._todo, []
            for action in actions or [self._idle]:
                self._try(action)
        self._library.ignore(self._jobs_changed)
        if self._feed is not None:
            self._library.leave(self._feed, self._feed_changed)

    @property
    def _busy(self) -> bool:
        return self._playback.playing or self._picture_due

    def _idle(self) -> None:
        """Nothing else waits: draw the picture that is due, or play on."""
        if self._picture_due:
            self._picture_due = False
            self._show_picture()
        else:
            self._playback.tick()
            self._show()

    def _try(self, action: Action) -> None:
        try:
            action()
        except (ServiceTrouble, ValueError) as error:
            log.warning("%s", error)
            self.panel.headline.content = headline_html(None, 0, str(error))
        except Exception:
            # A step that fails must not end the session; a browser that has just left makes any step fail.
            if not self._closed:
                log.exception("viewer step failed")

    def _wire(self) -> None:
        panel = self.panel
        self._on_user(panel.jobs, self._user_chose_job)
        self._on_user(panel.newest, self._user_chose_newest)
        self._on_user(panel.step, self._user_moved_slider, self._remember_slider)
        self._on_user(panel.matches, self._show_picture)
        self._on_user(panel.weight, self._show_picture)
        for layer, box in panel.layers.items():
            self._on_user(box, lambda layer=layer, box=box: self.stage.set_visible(layer, box.value))
        panel.play.on_click(lambda event: self.post(lambda press=event.target.value: self._press(press)))
        panel.mode.on_click(lambda event: self.post(lambda mode=event.target.value: self._set_mode(mode)))
        panel.look_through.on_click(lambda _: self.post(self._look_through))
        panel.fly.on_click(lambda _: self.post(self._fly))
        command = self._client.gui.add_command
        command("Next step", hotkey="N").on_trigger(lambda _: self.post(lambda: self._press("next ▶")))
        command("Previous step", hotkey="P").on_trigger(lambda _: self.post(lambda: self._press("◀ previous")))
        command("Play or pause", hotkey="space").on_trigger(lambda _: self.post(lambda: self._press("play / pause")))

    def _on_user(self, widget: Any, action: Action, at_once: Action | None = None) -> None:
        """Post the action when the user, not this program, has changed the widget; `at_once` runs before that."""

        async def changed(event: Any) -> None:  # async: runs on viser's own loop, not in its pool of threads
            if event.client is not None:
                if at_once is not None:
                    at_once()
                self.post(action)

        widget.on_update(changed)

    def _remember_slider(self) -> None:
        """Note what the user asked for: a running job moves the slider, too, perhaps before this is looked at."""
        self._asked_step = self.panel.step.value

    def _jobs_changed(self) -> None:
        self.post(self._sync_jobs)

    def _feed_changed(self) -> None:
        self.post(self._sync_feed)

    def _sync_jobs(self) -> None:
        """Bring the list of jobs up to date, and change to the newest job if that is wanted."""
        jobs = self._library.jobs or ()
        if jobs:
            self.panel.jobs.options = tuple(job_label(job) for job in jobs)
        wanted = self._wanted or (jobs[0].id if jobs else None)
        if wanted is not None and (self._feed is None or self._feed.id != wanted):
            self._open(wanted)
        elif wanted is None and self._scene_id is None and self._library.jobs is not None:
            self._show_scene(self._library.service.first_scene(), None)
            self.panel.headline.content = headline_html(None, 0, "")
        if self._feed is not None:
            label = next((job_label(job) for job in jobs if job.id == self._feed.id), None)
            if label is not None:
                self.panel.jobs.value = label

    def _open(self, job_id: str) -> None:
        """Leave the job that is shown and follow another one."""
        if self._feed is not None:
            self._library.leave(self._feed, self._feed_changed)
        self.stage.clear_job()
        self._playback = Playback()
        self._shown = None
        self._opened = time.monotonic()
        self._feed = self._library.follow(job_id, self._feed_changed)
        self.post(self._sync_feed)

    def _sync_feed(self) -> None:
        """Take over what the job has told since the last time."""
        feed = self._feed
        if feed is None:
            return
        count = len(feed.records)
        self.panel.headline.content = headline_html(feed.job, count, feed.trouble)
        if feed.job is None:
            return
        newest = feed.records[count - 1].pose if count else None
        self._show_scene(feed.job.scene, newest)
        self._playback.grow(count)
        self.panel.step.max = max(0, count - 1)
        self.panel.step.disabled = self.panel.look_through.disabled = self.panel.fly.disabled = count == 0
        self.stage.show_trajectory(feed.records[:count], feed.job)
        # A job that has just been opened is looked at where it is; later on the view is the user's.
        if newest is not None and (self._shown is None or time.monotonic() < self._opened + _ARRIVAL_S):
            self.stage.look_over(newest)
        self._show()

    def _show_scene(self, scene_id: str | None, pose: Pose | None) -> None:
        if scene_id is None or scene_id == self._scene_id:
            return
        content = self._library.scene(scene_id)
        self.stage.show_scene(content, pose)
        self._scene_id = scene_id
        self.panel.scene.content = scene_html(
            content.view.name, len(content.splats.rgba), content.splats.total, len(content.view.cameras)
        )

    def _show(self) -> None:
        """Show the record at the playback's position; its picture follows when nothing else waits."""
        record, feed = self._record, self._feed
        if record is None or feed is None or feed.job is None:
            return
        self.panel.step.value = self._playback.index
        self.panel.numbers.content = record_html(record)
        if self._shown == (feed.id, record.index):
            return
        new_job = self._shown is None
        texture = reduced(feed.photo(), _TEXTURE_PX) if new_job else None
        self.stage.show_current(record.pose, feed.job.photo, texture)
        weighed = (r.candidates for r in reversed(feed.records[: record.index + 1]) if r.candidates)
        self.stage.show_candidates(next(weighed, None), feed.job.photo)
        self._shown = feed.id, record.index
        self._picture_due = True

    def _show_picture(self) -> None:
        """Compose photo and render of the record that is shown."""
        panel, pair = self.panel, self._mode == "side by side"
        panel.matches.visible, panel.weight.visible = pair, self._mode == "blend"
        record, feed = self._record, self._feed
        if record is None or feed is None:
            return
        matches = record.matches if pair and panel.matches.value else None
        try:
            photo = feed.photo()
            # Matches may refer to another view than the record's pose: then that view stands beside the photo.
            render = feed.render(record.index, matched=matches is not None)
        except (ServiceTrouble, ValueError) as error:
            panel.caption.content = small_html(f"There is no picture of this step: {error}")
            return
        if self._mode == "side by side":
            panel.picture.image = side_by_side(photo, render, matches)
        else:
            panel.picture.image = overlaid(self._mode, photo, render, panel.weight.value)
        panel.caption.content = caption_html(self._mode, matches)
        panel.window.visible = True

    @property
    def _record(self) -> IterationRecord | None:
        records = self._feed.records if self._feed is not None else []
        return records[self._playback.index] if self._playback.index < len(records) else None

    def _user_chose_job(self) -> None:
        label = self.panel.jobs.value
        chosen = next((job.id for job in self._library.jobs or () if job_label(job) == label), None)
        if label != NO_JOB and chosen is not None:
            self._wanted = chosen
            self.panel.newest.value = False
            self._sync_jobs()

    def _user_chose_newest(self) -> None:
        self._wanted = None if self.panel.newest.value or self._feed is None else self._feed.id
        self._sync_jobs()

    def _user_moved_slider(self) -> None:
        self._playback.playing = False
        self._playback.go(self._asked_step)
        self._show()

    def _press(self, button: str) -> None:
        if button == "play / pause":
            self._playback.toggle()
        else:
            self._playback.step(1 if button.startswith("next") else -1)
        self._show()

    def _set_mode(self, mode: str) -> None:
        self._mode = cast(Mode, mode)
        self._show_picture()

    def _look_through(self) -> None:
        self._opened = 0.0  # from now on the view is the user's
        if self._record is not None and self._feed is not None and self._feed.job is not None:
            self.stage.look_through(Camera(self._feed.job.photo, self._record.pose))

    def _fly(self) -> None:
        self._opened = 0.0
        if self._feed is not None and self._feed.records:
            self.stage.fly_to(self._feed.records[-1].pose)
