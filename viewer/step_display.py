"""What one browser sees of one step of a job: numbers, camera, matches, pictures and charts.

Numbers follow a dragged slider at once (`show`). The rest comes when nothing else waits, one after the other (`go_on`):
pictures and charts, the 3D, at last what the neighbouring steps will need. viser's page shows widgets as soon as they
come; but a message that also has to do with the 3D waits for its next frame, so they go by messages of their own.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import cast

import numpy as np
from jaxtyping import UInt8

from service.results import IterationRecord
from viewer.charts import curves_html, stages_html, vectors_html
from viewer.comparison_images import (
    ColourBy,
    Mode,
    Overlay,
    beside,
    flicker_html,
    flow,
    match_colours,
    overlaid,
    reduced,
)
from viewer.controls import Controls
from viewer.job_stream import JobStream
from viewer.match_geometry import MatchView, matches_at_pose
from viewer.playback import caption_html, flow_caption_html, record_html, small_html
from viewer.scene_3d import Scene3D
from viewer.service_client import ServiceError

_TEXTURE_PX = 512
_KEPT_PICTURES = 4
_APART_S = 0.02
"""viser puts in one message what comes within a sixtieth of a second."""


class StepDisplay:
    """All methods are called from the session's thread."""

    def __init__(self, panel: Controls, stage: Scene3D) -> None:
        self.mode: Mode = "beside"
        self._panel, self._stage = panel, stage
        self._shown: tuple[str, int] | None = None
        """Job and record that are shown."""
        self._textured: tuple[str, int | None] | None = None
        """Job, and of several photos the step, whose picture is in the camera that is shown."""
        self._todo: list[tuple[float, Callable[[], None]]] = []
        """What is still to be done for the step, and the earliest time for it."""
        self._composed: dict[tuple[object, ...], UInt8[np.ndarray, "h w 3"]] = {}
        """Pictures of this step and its neighbours, by what they show."""

    @property
    def fresh(self) -> bool:
        """Nothing of this job has been shown yet."""
        return self._shown is None

    @property
    def due_in_s(self) -> float | None:
        """When `go_on` has something to do; None: all is done."""
        return max(0.0, self._todo[0][0] - time.monotonic()) if self._todo else None

    def go_on(self) -> None:
        """Do what is due next. Raises ServiceError, ValueError."""
        self._todo.pop(0)[1]()

    def clear(self) -> None:
        self._shown = self._textured = None
        self._todo = []
        self._composed = {}
        self._stage.clear_job()

    def show(self, feed: JobStream, index: int) -> None:
        """Show a record; the rest follows with `go_on`."""
        record, job = feed.records[index], feed.job
        if job is None:
            return
        self._panel.step.value = index
        self._panel.numbers.content = record_html(record, job.truth)
        self._panel.strip.content = stages_html(feed.records, index)
        self._panel.flush()
        if self._shown != (feed.id, index):
            self._shown = feed.id, index
            self.redraw(feed, index)

    def redraw(self, feed: JobStream, index: int) -> None:
        """Let pictures, charts and 3D follow with `go_on`."""
        nearby = [k for k in (index - 1, index + 1) if 0 <= k < len(feed.records)]
        self._todo = [(0.0, partial(self._draw, feed, index))]
        self._todo += [(0.0, partial(self._prepare, feed, feed.records[k])) for k in nearby]

    def _draw(self, feed: JobStream, index: int) -> None:
        """Bring pictures and charts up to the step."""
        record, view = feed.records[index], None
        try:
            view = self._view(feed, record)
            self._picture(feed, record, view)
            self._panel.flush()
            self._panel.vectors.content = flow_caption_html(view, self._colour_by) + vectors_html(view)
            self._flow(feed, record, view)
        except (ServiceError, ValueError) as error:
            self._panel.caption.content = small_html(f"There is no picture of this step: {error}")
        truth = feed.job.truth if feed.job else None
        self._panel.curves.content = curves_html(feed.records, truth, index)
        self._panel.flush()
        self._todo.insert(0, (time.monotonic() + _APART_S, partial(self._place, feed, record, view)))

    def _place(self, feed: JobStream, record: IterationRecord, view: MatchView | None) -> None:
        """Bring the 3D up to the step."""
        if feed.job is None:
            return
        several = feed.job.photo_step is not None
        picture, textured = None, (feed.id, record.index if several else None)
        if self._textured != textured:
            picture = _photo(feed, record)
            if picture is None and several:
                picture = feed.render(record.index, matched=False)
        self._stage.show_current(feed.job.camera(record), None if picture is None else reduced(picture, _TEXTURE_PX))
        self._textured = textured
        weighed = (r.candidates for r in reversed(feed.records[: record.index + 1]) if r.candidates)
        self._stage.show_candidates(next(weighed, None), feed.job.photo)
        self._stage.show_matches(view, None if view is None else match_colours(view, self._colour_by))

    def _prepare(self, feed: JobStream, record: IterationRecord) -> None:
        """Have at hand the picture of a step."""
        with suppress(ServiceError, ValueError):
            photo, view = _photo(feed, record), self._view(feed, record)
            if photo is None:
                feed.render(record.index, matched=False)
            elif self.mode == "flicker":
                self._render(feed, record, view)
            else:
                self._compared(feed, record, view, photo)

    def _view(self, feed: JobStream, record: IterationRecord) -> MatchView | None:
        """Return the match vectors as the step sees them."""
        source = feed.matches(record.index)
        return matches_at_pose(source, feed.job.camera(record), record.index) if source and feed.job else None

    def _flow(self, feed: JobStream, record: IterationRecord, view: MatchView | None) -> None:
        """Draw the match vectors over the photo, or over what it should look like."""
        self._panel.flow.visible = view is not None
        if view is not None:
            photo = _photo(feed, record)
            ground = feed.render(record.index, matched=False) if photo is None else photo
            self._panel.flow.image = flow(ground, view, match_colours(view, self._colour_by))

    def _picture(self, feed: JobStream, record: IterationRecord, view: MatchView | None) -> None:
        """Compose photo and render."""
        panel, mode = self._panel, self.mode
        panel.matches.visible = mode == "beside"
        panel.weight.visible, panel.flicker.visible = mode == "blend", mode == "flicker"
        panel.picture.visible = mode != "flicker"
        photo = _photo(feed, record)
        if photo is None:
            step = feed.job.photo_step if feed.job else None
            why = "the photo was deleted after the job" if step is None else f"only the photo of step {step} is kept"
            panel.picture.image, panel.picture.visible = feed.render(record.index, matched=False), True
            panel.caption.content = small_html(f"The render at this step's pose; {why}.")
            panel.window.visible, panel.flicker.visible = True, False
            return
        if mode == "flicker":
            panel.flicker.content = flicker_html(photo, self._render(feed, record, view))
        else:
            panel.picture.image = self._compared(feed, record, view, photo)
        panel.caption.content = caption_html(mode, view if self._with_lines else None, self._colour_by)
        panel.window.visible = True

    def _compared(
        self, feed: JobStream, record: IterationRecord, view: MatchView | None, photo: UInt8[np.ndarray, "h w 3"]
    ) -> UInt8[np.ndarray, "a b 3"]:
        """Return photo and render in one picture; the last few are kept."""
        mode, by, weight = self.mode, self._colour_by, self._panel.weight.value
        key = feed.id, feed.complete, record.index, mode, by, weight, self._with_lines
        if key not in self._composed:
            render = self._render(feed, record, view)
            if mode == "beside":
                lines = view if self._with_lines else None
                picture = beside(photo, render, lines, None if lines is None else match_colours(lines, by))
            else:
                picture = overlaid(cast(Overlay, mode), photo, render, weight)
            kept = list(self._composed.items())[1 - _KEPT_PICTURES :]
            self._composed = dict([*kept, (key, picture)])
        return self._composed[key]

    def _render(self, feed: JobStream, record: IterationRecord, view: MatchView | None) -> UInt8[np.ndarray, "h w 3"]:
        """Return what stands beside the photo."""
        # Matches of this very step may refer to another view than its pose: then it is that view.
        matched = self._with_lines and view is not None and view.carried_from is None
        return feed.render(record.index, matched=matched)

    @property
    def _with_lines(self) -> bool:
        return self.mode == "beside" and self._panel.matches.value

    @property
    def _colour_by(self) -> ColourBy:
        return cast(ColourBy, self._panel.colour_by.value)


def _photo(feed: JobStream, record: IterationRecord) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return the photo that a step is about; None: it isn't there (any more). Raises ServiceError, ValueError."""
    of = feed.job.photo_step if feed.job else None
    return feed.photo() if of in (None, record.index) else None
