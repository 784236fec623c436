"""One step of a job in one browser: numbers, images, charts and 3D.

The numbers follow a dragged slider at once (`show`). The rest is queued and done by `run_next` when the session has
nothing else to do: images and charts, then the 3D, then the images of the neighbouring steps. viser's page shows
widgets as soon as their message arrives, but holds back a message that also changes the 3D until its next frame; so
both are sent in separate messages.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial

from service.client import ServiceError
from service.results import IterationRecord
from viewer.charts import curves_html, stages_html
from viewer.colours import match_colours
from viewer.comparison_images import Mode, shrink
from viewer.comparison_panel import ComparisonPanel, photo_of
from viewer.controls import Controls
from viewer.job_stream import JobStream
from viewer.match_geometry import MatchView, matches_at_pose
from viewer.panel_html import record_html, small_html
from viewer.scene_3d import Scene3D

_FRUSTUM_IMAGE_PX = 512
_MESSAGE_GAP_S = 0.02
"""viser sends in one message what is set within 1/60 s."""


class StepDisplay:
    """All methods are called from the session's thread."""

    def __init__(self, controls: Controls, scene: Scene3D) -> None:
        self._controls, self._scene = controls, scene
        self._images = ComparisonPanel(controls)
        self._shown: tuple[str, int, int] | None = None
        """Ids of the job and record that are shown."""
        self._frustum_image: tuple[str, int | None] | None = None
        """Job, and of several photos the step, whose image is in the current frustum."""
        self._queue: list[tuple[float, Callable[[], None]]] = []
        """What remains to be done, each with its earliest time."""

    @property
    def empty(self) -> bool:
        """Whether no record of the job has been shown yet."""
        return self._shown is None

    @property
    def due_in_s(self) -> float | None:
        """Time until `run_next` may be called; None: nothing is queued."""
        return max(0.0, self._queue[0][0] - time.monotonic()) if self._queue else None

    def run_next(self) -> None:
        """Do the first thing in the queue. Raises ServiceError, ValueError."""
        self._queue.pop(0)[1]()

    def clear(self) -> None:
        """Show no job."""
        self._shown = self._frustum_image = None
        self._queue = []
        self._images.clear()
        self._scene.clear_job()

    def set_mode(self, mode: Mode) -> None:
        """Choose how photo and render are compared, from the next redraw on."""
        self._images.mode = mode

    def show(self, stream: JobStream, index: int) -> None:
        """Show a record's numbers, and queue the rest if it is another record than before."""
        record, job = stream.records[index], stream.job
        if job is None:
            return
        self._controls.step.value = index
        self._controls.numbers.content = record_html(record, job.truth, self._scene.metres_per_unit)
        self._controls.stages.content = stages_html(stream.records, index)
        self._controls.flush()
        if self._shown != (stream.id, stream.attempt, index):
            self._shown = stream.id, stream.attempt, index
            self.redraw(stream, index)

    def redraw(self, stream: JobStream, index: int) -> None:
        """Queue images, charts and 3D of a record."""
        neighbours = [k for k in (index - 1, index + 1) if 0 <= k < len(stream.records)]
        # Replaces what remained for the step that was shown before.
        self._queue = [(0.0, partial(self._draw_window, stream, index))]
        self._queue += [(0.0, partial(self._prepare, stream, stream.records[k])) for k in neighbours]

    def _draw_window(self, stream: JobStream, index: int) -> None:
        if index >= len(stream.records):  # the job has begun anew
            return
        record, view = stream.records[index], None
        try:
            view = _match_view(stream, record)
            self._images.show_comparison(stream, record, view)
            self._controls.flush()
            self._images.show_match_vectors(stream, record, view)
        except (ServiceError, ValueError) as error:
            self._controls.caption.content = small_html(f"This step has no image: {error}")
        truth = stream.job.truth if stream.job else None
        self._controls.curves.content = curves_html(stream.records, truth, index, self._scene.metres_per_unit)
        self._controls.flush()
        self._queue.insert(0, (time.monotonic() + _MESSAGE_GAP_S, partial(self._draw_3d, stream, record, view)))

    def _draw_3d(self, stream: JobStream, record: IterationRecord, view: MatchView | None) -> None:
        job = stream.job
        if job is None:
            return
        several = job.photo_step is not None
        image, frustum_image = None, (stream.id, record.index if several else None)
        if self._frustum_image != frustum_image:  # sent once for all steps of a single photo
            image = photo_of(stream, record)
            if image is None and several:
                image = stream.render(record.index, matched=False)
        camera = job.camera(record)
        self._scene.trajectory.show_current(camera, None if image is None else shrink(image, _FRUSTUM_IMAGE_PX))
        self._frustum_image = frustum_image
        scored = (r.candidates for r in reversed(stream.records[: record.index + 1]) if r.candidates)
        self._scene.candidates.show(next(scored, None), job.photo)
        colours = None if view is None else match_colours(view, self._images.colour_by)
        self._scene.matches.show(view, colours)

    def _prepare(self, stream: JobStream, record: IterationRecord) -> None:
        # If the step is shown after all, the error is reported then.
        with suppress(ServiceError, ValueError):
            self._images.prepare(stream, record, _match_view(stream, record))


def _match_view(stream: JobStream, record: IterationRecord) -> MatchView | None:
    source = stream.matches(record.index)
    return matches_at_pose(source, stream.job.camera(record), record.index) if source and stream.job else None
