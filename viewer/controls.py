"""The widgets of one browser: a control panel, and a window with images, match vectors and curves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import viser

from viewer.colours import ColourBy
from viewer.comparison_images import MODES
from viewer.layers.layer import LayerName

NO_JOB: str = "no job yet"
NO_SCENE: str = "no scene yet"
PLAY, PREVIOUS, NEXT = "play / pause", "◀ previous", "next ▶"
_COLUMN_WIDTH_PX = 430
"""Both panels are one column: at 1280 px two thirds are left for the 3D view."""
HIDDEN_AT_FIRST: tuple[LayerName, ...] = ("axes and scale", "poses of all jobs", "coverage", "floor plan")
_REPLAY_LABEL = "save as replay file"
_REPLAY_HINT = "One HTML file that plays this job from disk, without a service."
_SPEEDS = ("1", "2", "5", "10", "20")


class Controls:
    """Handles of the widgets by purpose. `BrowserSession` connects them to what they do."""

    def __init__(self, client: viser.ClientHandle, *, splats: bool) -> None:
        """`splats`: whether the layer of splats is shown at first."""
        gui = client.gui
        self.saving_replay = False
        """Whether a replay file is being made."""
        self.flush = client.flush
        """Send pending changes to the browser at once."""
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_COLUMN_WIDTH_PX)
        gui.add_html(
            # A script of the relay follows data-splatfix on a click; `href` would leave a service below a sub-path.
            "<a href='/' data-splatfix='./' style='padding:0 .6em;font-size:.9em'>← Start page</a>"
        )
        self._add_job(gui)
        self._add_view(gui)
        self._add_layers(gui, splats)
        self._add_window(gui)

    def _add_job(self, gui: viser.GuiApi) -> None:
        """Add what chooses a job and one of its steps, and shows that step's figures."""
        self.jobs = gui.add_dropdown("job", (NO_JOB,), initial_value=NO_JOB)
        self.newest = gui.add_checkbox("follow newest job", True, hint="Switch to each new job as it appears.")
        self.scenes = gui.add_dropdown("scene", (NO_SCENE,), initial_value=NO_SCENE)
        self.headline = gui.add_html("")
        self.step = gui.add_slider("step", 0, 0, 1, 0, disabled=True)
        self.stages = gui.add_html("")
        self.play = gui.add_button_group("", (PREVIOUS, PLAY, NEXT))
        self.speed = gui.add_dropdown("steps per second", _SPEEDS, initial_value="2")
        self.numbers = gui.add_html("")

    def _add_view(self, gui: viser.GuiApi) -> None:
        """Add what moves the camera, picks points, and makes files."""
        self.look_through = gui.add_button("look through this camera", disabled=True)
        self.fly = gui.add_button("fly to result", disabled=True)
        self.photo_opacity = gui.add_slider(
            "photo opacity", 0.0, 1.0, 0.05, 0.5, visible=False, hint="Of the photo over the view through its camera."
        )
        self.measure = gui.add_checkbox("measure distances", False, hint="Click two points of the scene.")
        self.name_point = gui.add_checkbox("name a point", False, hint="Click a point of the scene: an anchor.")
        self.anchor = gui.add_html("")
        self.plan_view = gui.add_checkbox(
            "plan view", False, hint="From above, cut open, with training cameras and the poses of all jobs."
        )
        self.use_view = gui.add_button("use this view as prior", hint="For the next photo: a pose to start from.")
        self.prior = gui.add_html("")
        self.replay = gui.add_button(_REPLAY_LABEL, disabled=True, hint=_REPLAY_HINT)

    def _add_layers(self, gui: viser.GuiApi, splats: bool) -> None:
        """Add what decides what is drawn."""
        with gui.add_folder("show"):
            shown = {"splats": splats} | dict.fromkeys(HIDDEN_AT_FIRST, False)
            self.layers = {layer: gui.add_checkbox(layer, shown.get(layer, True)) for layer in get_args(LayerName)}
            self.coverage = gui.add_html("", visible=False)
            self.colour_by = gui.add_dropdown("colour matches by", get_args(ColourBy), initial_value="inlier")
            self.exact = gui.add_checkbox(
                "full-quality render when still",
                True,
                hint="When the view is still, the service renders it as the estimator sees it; without splats also "
                "while it moves.",
            )
            self.legend = gui.add_html("")
            self.scene = gui.add_html("")

    def _add_window(self, gui: viser.GuiApi) -> None:
        """Add the window of images, match vectors and curves."""
        # Hidden until there is an image to show.
        self.window = gui.add_panel(visible=False)
        with self.window.add_tab("photo and render"):
            self.mode = gui.add_dropdown("compare", MODES)
            self.comparison = gui.add_image(np.zeros((1, 1, 3), np.uint8), jpeg_quality=88)
            self.flicker = gui.add_html("", visible=False)
            self.caption = gui.add_html("")
            self.match_lines = gui.add_checkbox("match lines", True)
            self.weight = gui.add_slider("render opacity", 0.0, 1.0, 0.05, 0.5, visible=False)
        with self.window.add_tab("match vectors"):
            self.vectors_image = gui.add_image(np.zeros((1, 1, 3), np.uint8), jpeg_quality=88, visible=False)
            self.vectors = gui.add_html("")
        with self.window.add_tab("curves"):
            self.curves = gui.add_html("")
        self.window.dock_below(gui.main_panel)

    def set_step_count(self, count: int) -> None:
        """Enable what needs records, for so many of them."""
        self.step.max = max(0, count - 1)
        self.step.disabled = self.look_through.disabled = self.fly.disabled = count == 0
        self.replay.disabled = count == 0 or self.saving_replay
        self.window.visible = self.window.visible and count > 0

    def set_saving_replay(self, saving: bool) -> None:
        """Show whether a replay file is being made; meanwhile there is no other."""
        self.saving_replay = saving
        self.replay.disabled = saving or self.step.disabled
        self.replay.label = "making the replay file…" if saving else _REPLAY_LABEL


def on_user_change(widget: Any, react: Callable[[Any], None]) -> None:
    """Call `react` with the widget's value whenever the user, not this program, has changed it."""

    async def changed(event: Any) -> None:  # async: runs on viser's event loop, not in its pool of threads
        if event.client is not None:
            react(widget.value)

    widget.on_update(changed)
