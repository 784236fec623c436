"""What one browser sees of one step of a job: numbers, camera, matches, pictures and charts.

The light part follows a dragged slider at once (`show`); pictures and charts come when nothing else waits (`draw`).
"""

from __future__ import annotations

from typing import cast

from service.types import IterationRecord
from viewer.charts import curves_html, stages_html, vectors_html
from viewer.client import ServiceTrouble
from viewer.draw import ColourBy, Mode, beside, flicker_html, flow, match_colours, overlaid, reduced
from viewer.feed import JobFeed
from viewer.measure import MatchView, seen
from viewer.panel import Panel
from viewer.playback import caption_html, flow_caption_html, record_html, small_html
from viewer.stage import Stage

_TEXTURE_PX = 512


class Detail:
    """All methods are called from the session's thread."""

    def __init__(self, panel: Panel, stage: Stage) -> None:
        self.mode: Mode = "beside"
        self.due = False
        """Pictures and charts are older than the step."""
        self._panel, self._stage = panel, stage
        self._shown: tuple[str, int] | None = None
        """Job and record that the 3D shows."""

    @property
    def fresh(self) -> bool:
        """Nothing of this job has been shown yet."""
        return self._shown is None

    def clear(self) -> None:
        self._shown = None
        self._stage.clear_job()

    def show(self, feed: JobFeed, index: int) -> None:
        """Show a record; its pictures follow with `draw`. Raises ServiceTrouble, ValueError."""
        record, job = feed.records[index], feed.job
        if job is None:
            return
        self._panel.step.value = index
        self._panel.numbers.content = record_html(record, job.truth)
        self._panel.strip.content = stages_html(feed.records, index)
        if self._shown == (feed.id, index):
            return
        photo = feed.photo() if self._shown is None else None
        texture = None if photo is None else reduced(photo, _TEXTURE_PX)
        self._stage.show_current(job.camera(record), texture)
        weighed = (r.candidates for r in reversed(feed.records[: index + 1]) if r.candidates)
        self._stage.show_candidates(next(weighed, None), job.photo)
        self._shown = feed.id, index
        self.due = True

    def draw(self, feed: JobFeed, index: int) -> None:
        """Bring pictures, matches and charts up to the step."""
        self.due = False
        record = feed.records[index]
        try:
            view = self._matches(feed, record)
            self._picture(feed, record, view)
            self._flow(feed, record, view)
        except (ServiceTrouble, ValueError) as error:
            self._panel.caption.content = small_html(f"There is no picture of this step: {error}")
        truth = feed.job.truth if feed.job else None
        self._panel.curves.content = curves_html(feed.records, truth, index)

    def _matches(self, feed: JobFeed, record: IterationRecord) -> MatchView | None:
        """Show the match vectors, 3D and histograms; return them."""
        source = feed.matches(record.index)
        view = seen(source, feed.job.camera(record), record.index) if source and feed.job else None
        colours = None if view is None else match_colours(view, self._colour_by)
        self._stage.show_matches(view, colours)
        self._panel.vectors.content = flow_caption_html(view, self._colour_by) + vectors_html(view)
        return view

    def _flow(self, feed: JobFeed, record: IterationRecord, view: MatchView | None) -> None:
        """Draw the match vectors over the photo, or over what it should look like."""
        self._panel.flow.visible = view is not None
        if view is not None:
            photo = feed.photo()
            ground = feed.render(record.index, matched=False) if photo is None else photo
            self._panel.flow.image = flow(ground, view, match_colours(view, self._colour_by))

    def _picture(self, feed: JobFeed, record: IterationRecord, view: MatchView | None) -> None:
        """Compose photo and render."""
        panel, mode = self._panel, self.mode
        panel.matches.visible = mode == "beside"
        panel.weight.visible, panel.flicker.visible = mode == "blend", mode == "flicker"
        panel.picture.visible = mode != "flicker"
        if mode != "beside" or not panel.matches.value:
            view = None
        photo = feed.photo()
        if photo is None:
            panel.picture.image, panel.picture.visible = feed.render(record.index, matched=False), True
            panel.caption.content = small_html("The render at this step's pose; the photo was deleted after the job.")
            panel.window.visible, panel.flicker.visible = True, False
            return
        # Matches of this very step may refer to another view than its pose: then that view stands beside the photo.
        render = feed.render(record.index, matched=view is not None and view.carried_from is None)
        if mode == "flicker":
            panel.flicker.content = flicker_html(photo, render)
        elif mode == "beside":
            panel.picture.image = beside(
                photo, render, view, None if view is None else match_colours(view, self._colour_by)
            )
        else:
            panel.picture.image = overlaid(mode, photo, render, panel.weight.value)
        panel.caption.content = caption_html(mode, view, self._colour_by)
        panel.window.visible = True

    @property
    def _colour_by(self) -> ColourBy:
        return cast(ColourBy, self._panel.colour_by.value)
