"""Charts as SVG in HTML: curves over the steps, histograms of match vectors, a strip of stages; for a dark background.

viser's own plots support neither gaps in a curve nor marks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from itertools import groupby

import numpy as np
from jaxtyping import Float64

from service.labels import label
from service.results import IterationRecord
from service.types import Pose
from viewer.match_geometry import MIN_VECTOR_PX, MatchView, direction_histogram, mean_angle_deg, pose_error

_DIRECTION_BINS = 24
_GREY = "#9aa0a8"
_SERIES_COLOURS = ("#f0953f", "#5cb3e8", "#7bd88f", "#d68ce6", "#e8d44d", "#ef6f6c", "#8fa3ff", "#c2b280")
_WIDTH, _HEIGHT, _LEFT = 390, 104, 46
"""Of a curve's chart, and of its left margin; SVG units."""
_MAX_DOTS = 60
"""Curves with more points have no dots with values: they would merge into a band, and take long to send."""


def vectors_html(view: MatchView | None) -> str:
    """Return a polar histogram of the match vectors' directions and a logarithmic one of their lengths."""
    if view is None or not len(view.inlier):
        return _note("This step has no matches.")
    angle = mean_angle_deg(view.vectors_px)
    angle_text = "no vector is long enough" if angle is None else f"{angle:.0f}° between two, on average"
    lengths = np.linalg.norm(view.vectors_px, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    if not len(lengths):
        return _note("No match is in view here.")
    median = float(np.median(lengths))
    length_text = f"below {MIN_VECTOR_PX}" if median < MIN_VECTOR_PX else f"{median:.3g}"
    return (
        "<div style='display:flex;gap:.8em;padding:0 .6em;flex-wrap:wrap'>"
        f"{_figure(_polar_histogram(direction_histogram(view.vectors_px, _DIRECTION_BINS)), f'angles: {angle_text}')}"
        f"{_figure(_length_histogram(lengths), f'lengths: {length_text} px, the median')}"
        "</div>"
        + _note(
            "From where the render has a point to where the photo has it. Turned about its axis or swung round what it "
            "sees, the camera interweaves the vectors; shifted, it makes them long and parallel."
        )
    )


def stages_html(records: Sequence[IterationRecord], index: int) -> str:
    """Return a strip under the slider that shows the stages, with a mark at step `index`."""
    if not records:
        return ""
    last = max(1, len(records) - 1)
    colours = stage_colours(records)
    parts, names = [], []
    for stage, steps in groupby(records, lambda r: r.stage):
        indices = [r.index for r in steps]
        left, right = (100 * float(np.clip(i, 0, last)) / last for i in (indices[0] - 0.5, indices[-1] + 0.5))
        parts.append(
            f"<div title='{_words(stage)}: {len(indices)} steps' style='position:absolute;left:{left:.2f}%;"
            f"width:{right - left:.2f}%;height:100%;background:{colours[stage]}'></div>"
        )
    for stage, colour in colours.items():
        names.append(
            f"<span style='white-space:nowrap' title='{escape(stage)}'>"
            f"<i style='display:inline-block;width:.7em;height:.7em;"
            f"background:{colour};margin-right:.3em'></i>{_words(stage)}</span>"
        )
    mark = (
        f"<div style='position:absolute;left:calc({100 * index / last:.2f}% - 1.5px);top:-3px;bottom:-3px;width:3px;"
        "background:#fff;box-shadow:0 0 2px #000'></div>"
    )
    return (
        f"<div style='padding:.2em .9em .3em'><div style='position:relative;height:7px'>{''.join(parts)}{mark}</div>"
        "<div style='display:flex;flex-wrap:wrap;gap:.1em .8em;margin-top:.35em;font-size:.75em'>"
        f"{''.join(names)}</div></div>"
    )


def _words(stage: str) -> str:
    return escape(label("stage", stage))


def stage_colours(records: Sequence[IterationRecord]) -> dict[str, str]:
    """Return a colour for each stage, in order of first appearance; after eight they repeat."""
    names = dict.fromkeys(record.stage for record in records)
    return {name: _SERIES_COLOURS[i % len(_SERIES_COLOURS)] for i, name in enumerate(names)}


def curves_html(
    records: Sequence[IterationRecord], truth: Pose | None, index: int, metres_per_unit: float | None = None
) -> str:
    """Return curves over the steps: loss, step size, matches and, given the true pose, errors. `index` is marked."""
    unit, scale = ("m", metres_per_unit) if metres_per_unit else ("units", 1.0)
    loss = _column(records, "loss")
    # One curve per stage, as losses of different stages aren't comparable.
    losses = {stage: np.where([r.stage == stage for r in records], loss, np.nan) for stage in stage_colours(records)}
    turned, moved = _column(records, "step_deg"), _column(records, "step_units")
    matches, inliers = _column(records, "num_matches"), _column(records, "num_inliers")
    charts = [
        ("loss", {name: values for name, values in losses.items() if np.isfinite(values).any()}),
        ("rotation step, degrees", {"": turned}),
        (f"position step, {unit}", {"": scale * moved}),
        ("matches and inliers", {"matches": matches, "inliers": inliers}),
    ]
    if truth is not None and records:
        errors = np.array([pose_error(r.pose, truth) for r in records]).T
        charts += [("rotation error, degrees", {"": errors[0]}), (f"position error, {unit}", {"": scale * errors[1]})]
    drawn = [_curve_chart(title, series, records, index) for title, series in charts if _finite_values(series).size]
    return "".join(drawn) or _note("There is nothing to plot yet.")


def _curve_chart(
    title: str, series: dict[str, Float64[np.ndarray, "n"]], records: Sequence[IterationRecord], index: int
) -> str:
    finite = _finite_values(series)
    # Logarithmic where the values span more than one and a half decades.
    log = bool(finite.min() > 0 and finite.max() > 30 * finite.min())
    low, high, ticks = _axis(finite, log=log)
    last = max(1, len(records) - 1)

    def x(step: float) -> float:
        return _LEFT + 4 + (_WIDTH - _LEFT - 12) * step / last

    def y(value: float) -> float:
        share = np.log(value / low) / np.log(high / low) if log else (value - low) / (high - low)
        return float(_HEIGHT - 14 - (_HEIGHT - 22) * share)

    colours = stage_colours(records)
    # The losses' series are the stages, and have their colours.
    palette = colours if set(series) <= set(colours) else dict(zip(series, _SERIES_COLOURS, strict=False))
    parts = [_bands(records, x)]
    for tick in ticks:
        parts.append(f"<path d='M{_LEFT} {y(tick):.1f}H{_WIDTH - 4}' stroke='{_GREY}' stroke-opacity='.25'/>")
        parts.append(_text(_LEFT - 5, y(tick) + 3, f"{tick:g}", "end"))
    parts.append(f"<path d='M{x(index):.1f} 6V{_HEIGHT - 12}' stroke='#fff' stroke-width='1.5'/>")
    for name, values in series.items():
        parts.append(_line(values, x, y, palette[name]))
    parts += [_text(x(step), _HEIGHT - 2, str(step)) for step in (0, last)]
    legend = " ".join(f"<b style='color:{palette[name]}'>{_words(name)}</b>" for name in series if name)
    return (
        f"<div style='padding:0 .6em'><div style='font-size:.8em'>{escape(title)} {legend}</div>"
        f"<svg viewBox='0 0 {_WIDTH} {_HEIGHT}' width='100%' role='img' aria-label='{escape(title)} by step'>"
        f"{''.join(parts)}</svg></div>"
    )


def _finite_values(series: dict[str, Float64[np.ndarray, "n"]]) -> Float64[np.ndarray, "k"]:
    values = np.concatenate([np.zeros(0), *series.values()])
    return values[np.isfinite(values)]


def _axis(values: Float64[np.ndarray, "k"], *, log: bool) -> tuple[float, float, list[float]]:
    """Return the ends of an axis and a few round values between them."""
    if log:
        low, high = 10.0 ** np.floor(np.log10(values.min())), 10.0 ** np.ceil(np.log10(values.max()))
        powers = np.arange(np.log10(low), np.log10(high) + 0.5)
        return float(low), float(high), [float(10.0**p) for p in powers[:: -(-len(powers) // 4)]]
    low, high = min(0.0, float(values.min())), float(values.max()) or 1.0
    # Steps of 1, 2 or 5 times a power of ten, at most five of them.
    step = 10.0 ** np.floor(np.log10(high - low))
    step *= next(f for f in (0.2, 0.5, 1.0) if (high - low) / (f * step) <= 5) if (high - low) / step < 5 else 2.0
    return low, high, [float(t) for t in np.arange(np.ceil(low / step), high / step + 1e-9) * step]


def _bands(records: Sequence[IterationRecord], x: Callable[[float], float]) -> str:
    """Return the stages as coloured background rectangles."""
    colours, bands = stage_colours(records), []
    for stage, steps in groupby(records, lambda r: r.stage):
        indices = [r.index for r in steps]
        left, right = x(indices[0] - 0.5), x(indices[-1] + 0.5)
        bands.append(
            f"<rect x='{left:.1f}' y='4' width='{right - left:.1f}' height='{_HEIGHT - 18}' "
            f"fill='{colours[stage]}' fill-opacity='.12'><title>{_words(stage)}</title></rect>"
        )
    return "".join(bands)


def _line(
    values: Float64[np.ndarray, "n"], x: Callable[[float], float], y: Callable[[float], float], colour: str
) -> str:
    """Return a polyline that is interrupted where there is no value, and a dot with a tooltip at each value."""
    path, dots, pen = [], [], "M"
    count = np.isfinite(values).sum()
    for i in range(len(values)):
        if not np.isfinite(values[i]):
            pen = "M"
            continue
        path.append(f"{pen}{x(i):.1f} {y(values[i]):.1f}")
        pen = "L"
        if count <= _MAX_DOTS:
            dots.append(
                f"<circle cx='{x(i):.1f}' cy='{y(values[i]):.1f}' r='2.6'>"
                f"<title>step {i}: {values[i]:.4g}</title></circle>"
            )
    line = f"<path d='{''.join(path)}' fill='none' stroke='{colour}' stroke-width='1.6'/>"
    return f"{line}<g fill='{colour}'>{''.join(dots)}</g>"


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f"<text x='{x:.1f}' y='{y:.1f}' text-anchor='{anchor}' fill='{_GREY}' font-size='9'>{text}</text>"


def _column(records: Sequence[IterationRecord], name: str) -> Float64[np.ndarray, "n"]:
    found = [getattr(record, name) for record in records]
    return np.array([np.nan if value is None else value for value in found], np.float64)


def _polar_histogram(counts: Float64[np.ndarray, "bins"]) -> str:
    """Return wedges about a centre with areas proportional to the counts, in the image's directions."""
    # The square root makes areas, not radii, proportional to the counts.
    reach = 62 * np.sqrt(counts / max(counts.max(), 1))
    half = np.pi / len(counts)
    wedges = []
    for i, r in enumerate(reach):
        (ax, ay), (bx, by) = (
            (r * np.cos(turn), r * np.sin(turn)) for turn in (2 * half * i - 0.9 * half, 2 * half * i + 0.9 * half)
        )
        wedges.append(f"<path d='M0 0L{ax:.1f} {ay:.1f}A{r:.1f} {r:.1f} 0 0 1 {bx:.1f} {by:.1f}Z'/>")
    rings = "".join(f"<circle r='{r}' fill='none' stroke='{_GREY}' stroke-opacity='.35'/>" for r in (31, 62))
    labels = "".join(
        _text(x, y, text) for x, y, text in ((72, 3, "0°"), (0, 74, "90°"), (-72, 3, "180°"), (0, -67, "270°"))
    )
    return _svg("-84 -78 168 158", "directions", f"{rings}<g fill='{_SERIES_COLOURS[0]}'>{''.join(wedges)}</g>{labels}")


def _length_histogram(lengths: Float64[np.ndarray, "m"]) -> str:
    """Return a histogram over a logarithmic axis of pixels."""
    # From the 2 % quantile: a single tiny vector would add empty decades.
    low = np.floor(np.log10(max(np.quantile(lengths, 0.02), MIN_VECTOR_PX)))
    high = np.ceil(np.log10(max(lengths.max(), 10**low * 10)))
    edges = np.linspace(low, high, int(4 * (high - low)) + 1)
    counts, _ = np.histogram(np.log10(np.clip(lengths, 10**low, 10**high)), edges)
    wide, top = 164 / len(counts), max(counts.max(), 1)
    bars = "".join(
        f"<rect x='{i * wide + 0.5:.1f}' y='{130 - 120 * c / top:.1f}' width='{wide - 1:.1f}' "
        f"height='{120 * c / top:.1f}'/>"
        for i, c in enumerate(counts)
    )
    ticks = "".join(_text(164 * (p - low) / (high - low), 145, f"{10.0**p:g}") for p in np.arange(low, high + 1))
    return _svg("-12 0 188 158", "lengths", f"<g fill='{_SERIES_COLOURS[1]}'>{bars}</g>{ticks}")


def _svg(box: str, label: str, inner: str) -> str:
    return f"<svg viewBox='{box}' width='168' role='img' aria-label='{label}'>{inner}</svg>"


def _figure(svg: str, caption: str) -> str:
    return (
        f"<figure style='margin:0'>{svg}"
        f"<figcaption style='font-size:.75em;max-width:168px'>{escape(caption)}</figcaption></figure>"
    )


def _note(text: str) -> str:
    return f"<div style='padding:.3em .6em;font-size:.8em;opacity:.85'>{escape(text)}</div>"
