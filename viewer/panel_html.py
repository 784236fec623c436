"""Texts of the control panel as HTML: status, numbers, captions and legends. No viser, no HTTP."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from html import escape
from urllib.parse import urlencode
from zoneinfo import ZoneInfo

import numpy as np

from service.labels import Kind, label
from service.results import IterationRecord
from service.types import Pose
from viewer.colours import (
    BLIND_COLOUR,
    COVERAGE_LEVELS,
    CURRENT_COLOUR,
    ERROR_COLOUR,
    INITIAL_COLOUR,
    INLIER_COLOUR,
    OUTLIER_COLOUR,
    PENDING_COLOUR,
    RGB,
    STATUS_COLOURS,
    TRAINING_COLOUR,
    TRUTH_COLOUR,
    ColourBy,
    outcome_colour,
    score_colours,
)
from viewer.comparison_images import Mode
from viewer.match_geometry import MatchView, pose_error
from viewer.service_values import CoverageAnswer, Job, JobOutcome, ListedJob


def job_label(job: ListedJob, zone: ZoneInfo | None = None) -> str:
    """Return a job's line in the list of jobs, with the time in a zone; the id's first digits make it unique."""
    created = datetime.fromisoformat(job.created).astimezone(zone)
    # The list is narrow, and most jobs that are looked at are today's.
    day = "" if created.date() == datetime.now(zone).date() else f"{created:%Y-%m-%d} "
    return f"{day}{created:%H:%M:%S} · {job.scene} · {(job.status or job.state).replace('_', ' ')} · {job.id[:8]}"


def headline_html(job: Job | None, records: int, error: str) -> str:
    """Return status, reason and hint of a job, or its progress; instead, an error."""
    if error:
        return _block(_badge("error", ERROR_COLOUR), escape(error))
    if job is None:
        return _block(_badge("no job", PENDING_COLOUR), "Drop a photo on the start page, or choose a job above.")
    title = escape(f"{job.photo_name or 'a photo'} in {job.scene}") + f", {labelled('estimator', job.estimator)}"
    link = f"<a href='/' data-splatfix='./#/jobs/{escape(job.id)}'>result page</a>"
    if job.outcome is None:
        # The job was read when its stream began: that it runs meanwhile only its records show.
        word = "queued" if not records else "running"
        return _block(_badge(word, PENDING_COLOUR), f"{records} steps so far", title, link=link)
    outcome = job.outcome
    return _block(
        _badge(outcome.status.replace("_", " "), STATUS_COLOURS[outcome.status]),
        _reason(outcome),
        title,
        outcome.hint,
        link,
    )


def prior_link_html(scene: str, prior: Mapping[str, object]) -> str:
    """Return a link to the start page that has a prior for the next photo."""
    query = urlencode({"prior": json.dumps(prior), "scene": scene, "of": "a view in the viewer"})
    return _padded(f"<a href='/' data-splatfix='./#/?{escape(query)}'>Choose the photo for this prior</a>")


def anchor_link_html(scene: str, point: Sequence[float]) -> str:
    """Return a link to the scene's page, where a point is named."""
    text = ",".join(f"{value:.6g}" for value in point)
    return _padded(f"<a href='/' data-splatfix='./#/scenes/{escape(scene)}?point={text}'>Name the point {text}</a>")


def record_html(record: IterationRecord, truth: Pose | None = None, metres_per_unit: float | None = None) -> str:
    """Return a record's numbers as a table, with its errors where the true pose is given.

    Lengths are in metres where the scene has a scale.
    """
    unit, scale = length_unit(metres_per_unit), metres_per_unit or 1.0
    error_deg, error_units = pose_error(record.pose, truth) if truth else (None, None)
    rows = [
        ("elapsed", f"{record.elapsed_s * 1000:.0f} ms"),
        # Wall and CPU time differ where a job waits or uses several threads.
        ("CPU time", f"{record.cpu_s * 1000:.0f} ms"),
        ("matches", _or_dash(record.num_matches, "d")),
        ("inliers", _or_dash(record.num_inliers, "d")),
        ("loss", _or_dash(record.loss, ".4g")),
        ("rotation step", _or_dash(record.step_deg, ".3g", "°")),
        (f"position step, {unit}", _or_dash(scaled(record.step_units, scale), ".3g")),
    ]
    if truth:
        rows += [
            ("rotation error", _or_dash(error_deg, ".3g", "°")),
            (f"position error, {unit}", _or_dash(scaled(error_units, scale), ".3g")),
        ]
    cells = "".join(
        f"<div><div style='opacity:.85;font-size:.8em'>{name}</div><div style='white-space:nowrap'>{value}</div></div>"
        for name, value in rows
    )
    stage = f"<div style='grid-column:1/-1'>{labelled('stage', record.stage)}</div>"
    return _padded(f"<div style='display:grid;grid-template-columns:repeat(4,1fr);gap:.35em .6em'>{stage}{cells}</div>")


def length_unit(metres_per_unit: float | None) -> str:
    """Return the unit in which lengths of a scene are shown."""
    return "m" if metres_per_unit else "units"


def scaled(length: float | None, scale: float) -> float | None:
    """Return a length in another unit; None stays None."""
    return None if length is None else length * scale


_CAPTIONS: dict[Mode, str] = {
    "side by side": "photo, and render at this step's pose",
    "blend": "photo and render at this step's pose blended",
    "checker": "photo and render at this step's pose, in alternating tiles: edges should continue across them",
    "difference": "of photo and render at this step's pose, doubled: black means equal",
    "flicker": "photo and render at this step's pose, alternating: what jumps is misaligned",
}


def caption_html(mode: Mode, view: MatchView | None, colour_by: ColourBy = "inlier") -> str:
    """Return the caption of the comparison of photo and render."""
    if view is None:
        return _small(f"<b>{mode}</b>: {_CAPTIONS[mode]}")
    if view.carried_from is None:
        what = "photo, and the render that was matched"
    else:
        what = f"photo, and render at this step's pose with the matches of step {view.carried_from}"
    return _small(f"<b>{mode}</b>: {what}; lines: {_colours_text(view, colour_by)}")


def vectors_caption_html(view: MatchView | None, colour_by: ColourBy) -> str:
    """Return the caption of the image of the match vectors."""
    if view is None:
        return ""
    of = "" if view.carried_from is None else f" of step {view.carried_from}"
    return _small(
        f"matches{of}, each from where the render has it to where the photo has it: {_colours_text(view, colour_by)}"
    )


def _colours_text(view: MatchView, colour_by: ColourBy) -> str:
    if colour_by == "residual":
        known = view.residual_px[np.isfinite(view.residual_px)]
        middle = f"; median {np.median(known):.2g} px" if len(known) else ""
        return f"off by {_coloured('½ px', INLIER_COLOUR)} to {_coloured('50 px', OUTLIER_COLOUR)}{middle}"
    inliers = int(view.inlier.sum())
    outliers = len(view.inlier) - inliers
    return f"{_coloured(f'{inliers} agree', INLIER_COLOUR)}, {_coloured(f'{outliers} do not', OUTLIER_COLOUR)}"


def legend_html(outcome: JobOutcome | None, *, truth: bool) -> str:
    """Return the legend of the cameras' colours in 3D."""
    cameras = [("start", INITIAL_COLOUR), ("this step", CURRENT_COLOUR)]
    if outcome:
        cameras.append(("result", outcome_colour(outcome)))
    if truth:
        cameras.append(("true", TRUTH_COLOUR))
    cameras.append(("training", TRAINING_COLOUR))
    named = " ".join(f"<span style='white-space:nowrap'>{_swatch(f'rgb{c}')}{name}</span>" for name, c in cameras)
    ramp = ",".join(f"rgb{tuple(map(int, colour))}" for colour in score_colours(np.linspace(0, 1, 5)))
    scores = f"{_swatch(f'linear-gradient(90deg,{ramp})', '2.4em')}candidates, worst to best score"
    return _small(f"cameras: {named}<br>{scores}")


def coverage_html(answer: CoverageAnswer) -> str:
    """Return the coverage map's title with the legend of its colours, or why there is no map."""
    if answer.found is not None:
        levels = [(f"rgb{colour}", words) for _, colour, words in COVERAGE_LEVELS]
        levels.append((f"rgb{BLIND_COLOUR}", "nothing of the scene in view"))
        rows = "".join(f"<div style='white-space:nowrap'>{_swatch(ground)}{words}</div>" for ground, words in levels)
        return _small(f"<b>{escape(answer.found.title)}</b>{rows}each ray points where the camera looks")
    if answer.state == "running":
        return _small(f"coverage: {answer.done} of {answer.total or '…'} test renders and held-out photos tried")
    if answer.problem:
        return _small(f"coverage could not be measured: {escape(answer.problem)}")
    return _small("coverage is not measured yet: measure it on the scene's page (start page, “Plan and coverage”)")


def _swatch(ground: str, width: str = ".7em") -> str:
    return (
        f"<i style='display:inline-block;width:{width};height:.7em;border-radius:2px;margin:0 .3em;"
        f"background:{ground}'></i>"
    )


def scene_html(name: str, drawn: int, total: int, cameras: int) -> str:
    """Return how many of a scene's splats the browser draws; `drawn` 0: the service renders all of them."""
    of = f"{drawn:,} splats" if drawn == total else f"{drawn:,} of {total:,} splats, the most important ones"
    splats = f"{of}, without view-dependent colour" if drawn else f"{total:,} Gaussians, drawn by the service"
    return _small(f"{escape(name)}: {splats}; {cameras} training cameras")


def labelled(kind: Kind, name: str) -> str:
    """Return the words for a name of the API, as HTML with the name as their tooltip."""
    return f"<span title='{escape(name)}'>{escape(label(kind, name))}</span>"


def _reason(outcome: JobOutcome) -> str:
    """Return as HTML why a result has its status, with its numbers; of a failed job, what failed."""
    words = [escape(outcome.reason) if outcome.score is None else labelled("reason", outcome.reason)]
    if outcome.score is not None:
        words.append(f"score {outcome.score:.2f}")
    if outcome.inliers:  # tracking finds poses without matches
        words.append(f"{outcome.inliers} inliers")
    return ", ".join(w for w in words if w)


def _block(badge: str, text: str, title: str = "", hint: str = "", link: str = "") -> str:
    """Return the panel's head; all but the hint is HTML."""
    parts = [f"{badge} <span>{text}</span>"]
    if title:
        parts.append(f"<div style='opacity:.85;font-size:.85em;overflow-wrap:anywhere'>{title}; {link}</div>")
    if hint:
        parts.append(f"<div style='margin-top:.3em'>{escape(hint)}</div>")
    return _padded("".join(parts))


def _badge(text: str, colour: RGB) -> str:
    # Black text on a light colour, white on a dark one.
    ink = "#000" if 0.3 * colour[0] + 0.6 * colour[1] + 0.1 * colour[2] > 120 else "#fff"
    return (
        f"<span style='background:rgb{colour};color:{ink};border-radius:.3em;padding:.1em .6em;"
        f"font-weight:600'>{escape(text)}</span>"
    )


def small_html(text: str) -> str:
    """Return a plain text as a line in small type."""
    return _small(escape(text))


def _small(html: str) -> str:
    return f"<div style='padding:0 .6em .2em;font-size:.8em;opacity:.85'>{html}</div>"


def _coloured(text: str, colour: RGB) -> str:
    return f"<b style='color:rgb{colour}'>{text}</b>"


def _padded(inner: str) -> str:
    return f"<div style='padding:.2em .6em;font-size:.9em;line-height:1.5'>{inner}</div>"


def _or_dash(value: float | int | None, spec: str, unit: str = "") -> str:
    return "–" if value is None else f"{value:{spec}}{unit}"
