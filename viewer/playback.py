"""Which record of a job is shown, and what is said of it. Pure logic: no viser, no HTTP."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from html import escape

import numpy as np

from service.results import IterationRecord
from service.types import Pose
from viewer.comparison_images import INLIER, OUTLIER, ColourBy, Mode, score_colours
from viewer.match_geometry import MatchView, pose_error
from viewer.service_client import Answer, JobSummary, JobView

STATUS_COLOURS = {
    "localized": (60, 180, 90),
    "uncertain": (235, 165, 40),
    "not_localized": (215, 65, 65),
    "failed": (215, 65, 65),
    "cancelled": (140, 140, 140),
    "interrupted": (140, 140, 140),
}
PENDING_COLOUR = (40, 120, 200)
INITIAL_COLOUR, CURRENT_COLOUR, TRUTH_COLOUR = (150, 150, 150), (255, 140, 0), (240, 240, 240)
TRAINING_COLOUR = (70, 105, 160)


@dataclass(slots=True)
class Playback:
    """A position in a list of records that may still grow."""

    count: int = 0
    index: int = 0
    playing: bool = False
    live: bool = True
    """At the newest record, and moving on with it."""

    @property
    def at_end(self) -> bool:
        return self.index >= self.count - 1

    def grow(self, count: int) -> None:
        self.count = count
        if self.live and not self.playing:
            self.index = max(0, count - 1)

    def go(self, index: int) -> None:
        """Jump; at the newest record it stays with the newest."""
        self.index = max(0, min(index, self.count - 1))
        self.live = self.at_end

    def step(self, by: int) -> None:
        self.playing = False
        self.go(self.index + by)

    def toggle(self) -> None:
        """Play or pause; played to the end, play starts over."""
        self.playing = not self.playing and self.count > 1
        if self.playing and self.at_end:
            self.go(0)

    def tick(self) -> None:
        """Show the next record while playing."""
        if self.playing:
            self.go(self.index + 1)
            self.playing = not self.at_end


def job_label(job: JobSummary) -> str:
    """One line for a list of jobs; the id makes it unique."""
    started = datetime.fromisoformat(job.created).astimezone()
    return f"{started:%H:%M:%S} · {job.scene} · {(job.status or job.state).replace('_', ' ')} · {job.id[:8]}"


def headline_html(job: JobView | None, records: int, trouble: str) -> str:
    """Status, reason and hint, or how far the job is."""
    if trouble:
        return _block(_badge("no connection", (215, 65, 65)), trouble)
    if job is None:
        return _block(_badge("no job", PENDING_COLOUR), "Drop a photo on the start page, or choose a job above.")
    title = f"{job.photo_name or 'a photo'} in {job.scene}, by {job.estimator}"
    link = f"<a href='/' data-splatfix='./#/jobs/{escape(job.id)}'>its result page</a>"
    if job.answer is None:
        word = "queued" if not records else "running"
        return _block(_badge(word, PENDING_COLOUR), f"{records} steps so far", title, link=link)
    answer = job.answer
    return _block(
        _badge(answer.status.replace("_", " "), STATUS_COLOURS[answer.status]),
        _why(answer),
        title,
        answer.hint,
        link,
    )


def record_html(record: IterationRecord, truth: Pose | None = None) -> str:
    """The numbers of one record as a small table."""
    off = pose_error(record.pose, truth) if truth else (None, None)
    rows = [
        ("stage", escape(record.stage)),
        ("after", f"{record.elapsed_s * 1000:.0f} ms"),
        ("CPU time", f"{record.cpu_s * 1000:.0f} ms"),
        ("matches", _or_dash(record.num_matches, "d")),
        ("inliers", _or_dash(record.num_inliers, "d")),
        ("loss", _or_dash(record.loss, ".4g")),
        ("turned", _or_dash(record.step_deg, ".3g", "°")),
        ("moved, units", _or_dash(record.step_units, ".3g")),
    ]
    if truth:
        rows += [("turned off", _or_dash(off[0], ".3g", "°")), ("away, units", _or_dash(off[1], ".3g"))]
    cells = "".join(
        f"<div><div style='opacity:.6;font-size:.8em'>{name}</div><div style='white-space:nowrap'>{value}</div></div>"
        for name, value in rows
    )
    return _padded(f"<div style='display:grid;grid-template-columns:repeat(4,1fr);gap:.35em .6em'>{cells}</div>")


_CAPTIONS: dict[Mode, str] = {
    "beside": "photo, and render at this step's pose",
    "blend": "photo and render at this step's pose on top of one another",
    "checker": "photo and render at this step's pose, in turns: edges should run on from tile to tile",
    "difference": "of photo and render at this step's pose, doubled: black is agreement",
    "flicker": "photo and render at this step's pose, one after the other: what jumps is off",
}


def caption_html(mode: Mode, view: MatchView | None, colour_by: ColourBy = "inlier") -> str:
    """What the picture shows."""
    if view is None:
        return _small(f"<b>{mode}</b>: {_CAPTIONS[mode]}")
    if view.carried_from is None:
        what = "photo, and the render that was matched"
    else:
        what = f"photo, and render at this step's pose with the matches of step {view.carried_from}"
    return _small(f"<b>{mode}</b>: {what}; lines: {_colours_said(view, colour_by)}")


def flow_caption_html(view: MatchView | None, colour_by: ColourBy) -> str:
    """What the picture of the match vectors shows."""
    if view is None:
        return ""
    of = "" if view.carried_from is None else f" of step {view.carried_from}"
    return _small(
        f"matches{of}, each from where the render has it to where the photo has it: {_colours_said(view, colour_by)}"
    )


def _colours_said(view: MatchView, colour_by: ColourBy) -> str:
    if colour_by == "residual":
        known = view.residual_px[np.isfinite(view.residual_px)]
        middle = f"; median {np.median(known):.2g} px" if len(known) else ""
        return f"off by {_coloured('½ px', INLIER)} to {_coloured('50 px', OUTLIER)}{middle}"
    inliers = int(view.inlier.sum())
    return f"{_coloured(f'{inliers} agree', INLIER)}, {_coloured(f'{len(view.inlier) - inliers} do not', OUTLIER)}"


def legend_html(answer: Answer | None, *, truth: bool) -> str:
    """The colours of the cameras in 3D."""
    cameras = [("start", INITIAL_COLOUR), ("this step", CURRENT_COLOUR)]
    if answer:
        cameras.append(("answer", answer_colour(answer)))
    if truth:
        cameras.append(("true", TRUTH_COLOUR))
    cameras.append(("training", TRAINING_COLOUR))
    named = " ".join(f"<span style='white-space:nowrap'>{_swatch(f'rgb{c}')}{name}</span>" for name, c in cameras)
    ramp = ",".join(f"rgb{tuple(map(int, colour))}" for colour in score_colours(np.linspace(0, 1, 5)))
    scores = f"{_swatch(f'linear-gradient(90deg,{ramp})', '2.4em')}candidates, worst to best score"
    return _small(f"cameras: {named}<br>{scores}")


def _swatch(ground: str, width: str = ".7em") -> str:
    return (
        f"<i style='display:inline-block;width:{width};height:.7em;border-radius:2px;margin:0 .3em;"
        f"background:{ground}'></i>"
    )


def scene_html(name: str, drawn: int, total: int, cameras: int) -> str:
    """How much of the scene the browser draws, and what viser can't draw; 0: the service draws it."""
    of = f"{drawn:,} splats" if drawn == total else f"{drawn:,} of {total:,} splats, the most important ones"
    said = f"{of}, without view-dependent colour" if drawn else f"{total:,} Gaussians, drawn by the service"
    return _small(f"{escape(name)}: {said}; {cameras} training cameras")


def answer_colour(answer: Answer | None) -> tuple[int, int, int]:
    """Return the colour that stands for a verdict, or for its absence."""
    return STATUS_COLOURS[answer.status] if answer else PENDING_COLOUR


def _why(answer: Answer) -> str:
    words = [answer.reason.replace("_", " ")]
    if answer.score is not None:
        words.append(f"score {answer.score:.2f}")
    if answer.inliers:  # following a camera needs no matches
        words.append(f"{answer.inliers} inliers")
    return ", ".join(w for w in words if w)


def _block(badge: str, text: str, title: str = "", hint: str = "", link: str = "") -> str:
    parts = [f"{badge} <span>{escape(text)}</span>"]
    if title:
        parts.append(f"<div style='opacity:.7;font-size:.85em;overflow-wrap:anywhere'>{escape(title)}; {link}</div>")
    if hint:
        parts.append(f"<div style='margin-top:.3em'>{escape(hint)}</div>")
    return _padded("".join(parts))


def _badge(text: str, colour: tuple[int, int, int]) -> str:
    # Dark text on a light ground and the other way round, whichever is readable.
    ink = "#000" if 0.3 * colour[0] + 0.6 * colour[1] + 0.1 * colour[2] > 120 else "#fff"
    return (
        f"<span style='background:rgb{colour};color:{ink};border-radius:.3em;padding:.1em .6em;"
        f"font-weight:600'>{escape(text)}</span>"
    )


def small_html(text: str) -> str:
    """A line of small print."""
    return _small(escape(text))


def _small(html: str) -> str:
    return f"<div style='padding:0 .6em .2em;font-size:.8em;opacity:.75'>{html}</div>"


def _coloured(text: str, colour: tuple[int, int, int]) -> str:
    return f"<b style='color:rgb{colour}'>{text}</b>"


def _padded(inner: str) -> str:
    return f"<div style='padding:.2em .6em;font-size:.9em;line-height:1.5'>{inner}</div>"


def _or_dash(value: float | int | None, spec: str, unit: str = "") -> str:
    return "–" if value is None else f"{value:{spec}}{unit}"
