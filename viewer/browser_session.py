"""One browser tab: connects its widgets and its 3D view with the job and the scene that it shows.

Each session has one thread, on which everything that touches its state runs: callbacks of widgets, of job streams and
of the list of jobs only post actions. A slow browser therefore delays no other.
"""

from __future__ import annotations

import gc
import logging
import threading
from collections.abc import Sequence
from functools import partial
from typing import cast

import numpy as np
import viser
from jaxtyping import UInt8

from service.client import ServiceError
from viewer.action_queue import Action, ActionQueue
from viewer.background_render import BackgroundRender
from viewer.comparison_images import Mode
from viewer.controls import NEXT, PLAY, PREVIOUS, Controls, on_user_change
from viewer.job_display import JobDisplay
from viewer.job_selection import JobSelection
from viewer.panel_html import headline_html
from viewer.plan_display import PlanDisplay
from viewer.replay_download import ReplayDownload
from viewer.requested_page import RequestedPage
from viewer.scene_3d import Scene3D
from viewer.scene_display import SceneDisplay
from viewer.shared_data import SharedData

log = logging.getLogger(__name__)


class BrowserSession:
    """Runs from `start` to `close`, which is called when the tab is closed and frees everything."""

    def __init__(self, client: viser.ClientHandle, shared: SharedData, page: RequestedPage) -> None:
        """`page`: what the browser has opened. Where WebGL is drawn in software, splats are not shown at first."""
        splats = not page.software
        self._client, self._shared = client, shared
        self._queue = ActionQueue()
        self._controls = Controls(client, splats=splats)
        self._scene = Scene3D(client, splats=splats)
        self._background = BackgroundRender(client, shared.client, self._show_background)
        self._scene_display = SceneDisplay(self._controls, self._scene, self._background, shared.scenes)
        self._plan = PlanDisplay(self._controls, self._scene, self._background, self._scene_display, shared.client)
        self._job = JobDisplay(self._controls, self._scene, self._scene_display, shared.streams, self._stream_changed)
        self._selection = JobSelection(self._controls, shared.lists, self._job, self._scene_display, page)
        self._replay = ReplayDownload(client, self._controls, self._queue)

    def start(self) -> None:
        """Start the session's threads."""
        self._connect_widgets()
        self._connect_player()
        self._shared.lists.add_listener(self._lists_changed)
        self._lists_changed()
        self._background.start()
        # Last, so that no action runs before everything is connected.
        threading.Thread(target=self._run, name=f"browser-{self._client.client_id}", daemon=True).start()

    def close(self) -> None:
        """End the session's threads."""
        self._background.close()
        self._queue.close()

    def _run(self) -> None:
        while (actions := self._queue.take(self._idle_in_s())) is not None:
            # Idle work is done in small parts, between which new actions are taken first.
            for action in actions or [self._idle]:
                self._try(action)
            self._try(self._plan.follow_scene)
        self._shared.lists.remove_listener(self._lists_changed)
        self._job.close()
        # Widgets form reference cycles, which Python would otherwise collect only after many more browsers.
        gc.collect()

    def _idle_in_s(self) -> float | None:
        """Return how long to wait for an action before `_idle`; None: without end."""
        if self._job.step.due_in_s is not None:
            return self._job.step.due_in_s
        if self._scene.splats.pending:
            return 0.0
        return min((due for due in (self._job.tick_in_s, self._plan.due_in_s) if due is not None), default=None)

    def _idle(self) -> None:
        """Do what waits until there are no actions: the rest of a step, splats, playback, coverage; in this order."""
        if self._job.step.due_in_s is not None:
            self._job.step.run_next()
        elif self._scene.splats.pending:
            self._scene_display.send_splats()
        else:
            tick, plan = self._job.tick_in_s, self._plan.due_in_s
            if plan is not None and (tick is None or plan < tick):
                self._plan.refresh()
            elif tick is not None:
                self._job.tick()

    def _try(self, action: Action) -> None:
        try:
            action()
        except (ServiceError, ValueError) as error:
            # A browser that has left shows nothing: requests under way end with its client.
            if self._queue.closed:
                return
            log.warning("%s", error)
            self._controls.headline.content = headline_html(None, 0, str(error))
        except Exception:
            # The session outlives any failed action; after the browser has left, every action fails.
            if not self._queue.closed:
                log.exception("viewer step failed")

    def _connect_widgets(self) -> None:
        controls, post = self._controls, self._queue.post
        # With the user's value, since a running job may set the widget before the action runs.
        on_user_change(controls.jobs, lambda label: post(partial(self._selection.choose_job, label), "job"))
        on_user_change(controls.newest, lambda follow: post(partial(self._selection.choose_newest, follow), "newest"))
        on_user_change(controls.scenes, lambda name: post(partial(self._selection.choose_scene, name), "scene"))
        on_user_change(controls.step, lambda index: post(partial(self._job.go_to, index), "step"))
        on_user_change(
            controls.photo_opacity, lambda opacity: post(partial(self._background.set_opacity, opacity), "opacity")
        )
        on_user_change(controls.plan_view, lambda on: post(partial(self._plan.set_plan_view, on), "plan"))
        for widget in (controls.match_lines, controls.weight, controls.colour_by):
            on_user_change(widget, lambda _: post(self._job.redraw))
        on_user_change(
            controls.exact, lambda enabled: post(partial(self._background.set_enabled, enabled), "exact render")
        )
        for name, checkbox in controls.layers.items():
            show = partial(self._plan.set_layer_visible, name)
            on_user_change(checkbox, lambda shown, name=name, show=show: post(partial(show, shown), ("layer", name)))

    def _connect_player(self) -> None:
        controls, post = self._controls, self._queue.post
        controls.play.on_click(lambda event: post(partial(self._job.press, event.target.value)))
        on_user_change(controls.mode, lambda mode: post(partial(self._job.set_mode, cast(Mode, mode))))
        controls.look_through.on_click(lambda _: post(self._job.look_through))
        controls.fly.on_click(lambda _: post(self._job.fly_to_result))
        controls.replay.on_click(lambda _: post(self._save_replay))
        controls.use_view.on_click(lambda _: post(self._scene_display.offer_prior))
        self._client.scene.on_click()(lambda event: post(partial(self._click, event.ray_origin, event.ray_direction)))
        command = self._client.gui.add_command
        command("Next step", hotkey="N").on_trigger(lambda _: post(partial(self._job.press, NEXT)))
        command("Previous step", hotkey="P").on_trigger(lambda _: post(partial(self._job.press, PREVIOUS)))
        command("Play or pause", hotkey="space").on_trigger(lambda _: post(partial(self._job.press, PLAY)))

    def _click(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        if self._controls.name_point.value:
            self._plan.pick_point(origin, direction)
        elif self._controls.measure.value:
            self._scene_display.measure(origin, direction)
        else:
            self._job.click(origin, direction)

    def _lists_changed(self) -> None:
        self._queue.post(self._selection.sync)
        self._queue.post(self._plan.refresh, "plan layers")

    def _stream_changed(self) -> None:
        self._queue.post(self._job.sync)

    def _show_background(self, image: UInt8[np.ndarray, "h w 3"] | None) -> None:
        self._queue.post(partial(self._scene.splats.show_background, image))

    def _save_replay(self) -> None:
        if self._job.stream is not None and self._scene_display.scene_id is not None:
            self._replay.start(self._job.stream, self._shared.scenes.get(self._scene_display.scene_id))
