"""The window's images of one step: photo and render compared, and the match vectors."""

from __future__ import annotations

from typing import cast

import numpy as np
from jaxtyping import UInt8

from service.results import IterationRecord
from viewer.charts import vectors_html
from viewer.colours import ColourBy, match_colours
from viewer.comparison_images import (
    Mode,
    Overlay,
    flicker_html,
    match_vectors_image,
    overlay,
    side_by_side,
    undistorted,
)
from viewer.controls import Controls
from viewer.job_stream import JobStream
from viewer.match_geometry import MatchView
from viewer.panel_html import caption_html, small_html, vectors_caption_html

_IMAGES_KEPT = 4


class ComparisonPanel:
    """Composes the images as the widgets choose. Methods raise ServiceError or ValueError if an image is missing."""

    def __init__(self, controls: Controls) -> None:
        self.mode: Mode = "side by side"
        self._controls = controls
        self._composed: dict[tuple[object, ...], UInt8[np.ndarray, "h w 3"]] = {}
        """Comparisons of the step that is shown and of its neighbours, by all that they depend on."""

    @property
    def colour_by(self) -> ColourBy:
        """What the colours of matches stand for."""
        return cast(ColourBy, self._controls.colour_by.value)

    def clear(self) -> None:
        """Drop the images of a job."""
        self._composed = {}

    def show_comparison(self, stream: JobStream, record: IterationRecord, view: MatchView | None) -> None:
        """Show photo and render in the chosen mode; without the photo, the render alone."""
        controls, mode = self._controls, self.mode
        controls.match_lines.visible = mode == "side by side"
        controls.weight.visible, controls.flicker.visible = mode == "blend", mode == "flicker"
        controls.comparison.visible = mode != "flicker"
        photo = photo_of(stream, record)
        if photo is None:
            self._show_render_alone(stream, record)
            return
        if mode == "flicker":
            controls.flicker.content = flicker_html(photo, self._render(stream, record, view))
        else:
            controls.comparison.image = self._compose(stream, record, view, photo)
        controls.caption.content = caption_html(mode, view if self._with_lines else None, self.colour_by)
        controls.window.visible = True

    def _show_render_alone(self, stream: JobStream, record: IterationRecord) -> None:
        controls = self._controls
        step = stream.job.photo_step if stream.job else None
        why = "the photo was deleted after the job" if step is None else f"only the photo of step {step} is kept"
        controls.comparison.image, controls.comparison.visible = stream.render(record.index, matched=False), True
        controls.caption.content = small_html(f"The render at this step's pose; {why}.")
        controls.window.visible, controls.flicker.visible = True, False

    def show_match_vectors(self, stream: JobStream, record: IterationRecord, view: MatchView | None) -> None:
        """Show the match vectors over the photo, or over the render if there is no photo, and their histograms."""
        controls = self._controls
        controls.vectors.content = vectors_caption_html(view, self.colour_by) + vectors_html(view)
        controls.vectors_image.visible = view is not None
        if view is not None:
            photo = photo_of(stream, record)
            background = stream.render(record.index, matched=False) if photo is None else photo
            controls.vectors_image.image = match_vectors_image(background, view, match_colours(view, self.colour_by))

    def prepare(self, stream: JobStream, record: IterationRecord, view: MatchView | None) -> None:
        """Request and compose the images of a step that may be shown next."""
        photo = photo_of(stream, record)
        if photo is None:
            stream.render(record.index, matched=False)
        elif self.mode == "flicker":
            self._render(stream, record, view)
        else:
            self._compose(stream, record, view, photo)

    def _compose(
        self, stream: JobStream, record: IterationRecord, view: MatchView | None, photo: UInt8[np.ndarray, "h w 3"]
    ) -> UInt8[np.ndarray, "a b 3"]:
        mode, by, weight = self.mode, self.colour_by, self._controls.weight.value
        # `complete`, because the photo of a sequence's job changes when it ends.
        key = stream.id, stream.complete, record.index, mode, by, weight, self._with_lines
        if key not in self._composed:
            render = self._render(stream, record, view)
            if mode == "side by side":
                lines = view if self._with_lines else None
                image = side_by_side(photo, render, lines, None if lines is None else match_colours(lines, by))
            else:
                image = overlay(cast(Overlay, mode), photo, render, weight)
            # The oldest go first; a dict is in order of insertion.
            kept = list(self._composed.items())[1 - _IMAGES_KEPT :]
            self._composed = dict([*kept, (key, image)])
        return self._composed[key]

    def _render(self, stream: JobStream, record: IterationRecord, view: MatchView | None) -> UInt8[np.ndarray, "h w 3"]:
        # The step's own matches may refer to another camera than its pose; their lines fit only that camera's render.
        matched = self._with_lines and view is not None and view.carried_from is None
        return stream.render(record.index, matched=matched)

    @property
    def _with_lines(self) -> bool:
        return self.mode == "side by side" and self._controls.match_lines.value


def photo_of(stream: JobStream, record: IterationRecord) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return the photo that a record belongs to, without the distortion that the record estimates.

    None if the service doesn't keep it. Raises ServiceError, ValueError.
    """
    if stream.job is None or stream.job.photo_step not in (None, record.index):
        return None
    photo, correction = stream.photo(), record.correction
    if photo is None or not correction.k1:
        return photo
    return undistorted(photo, stream.job.photo.corrected(correction), correction.k1)
