"""Draws the supplement's figures, and other benches', with matplotlib: from data, nothing is run or rendered here."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from service.photos.images import with_palette

DPI, PICTURES_DPI = 110, 80
MARGIN = 0.05
"""About the match vectors of Figure 1, of the photo's long side."""
GREEN, RED = "#2a9d4a", "#d1372c"
COLOURS = {"view_index": "#1b1b1b", "mc_do": "#2f6fde", "icomma": "#d1372c", "inerf_dagger": "#e0952b"}


@dataclass(frozen=True, slots=True)
class Vectors:
    """Match vectors over a photo: from the pixels of rendered points to those where the photo shows them."""

    title: str
    photo: UInt8[np.ndarray, "h w 3"]
    rendered_px: Float[np.ndarray, "m 2"]
    """In the photo's pixels."""
    photo_px: Float[np.ndarray, "m 2"]


@dataclass(frozen=True, slots=True)
class Path3D:
    """The poses of a method's trace."""

    name: str
    positions: Float[np.ndarray, "n 3"]
    """Normalized units, world axes."""
    rotation_deg: Float[np.ndarray, "n"]
    """Error."""


def vectors_and_paths(
    rows: Sequence[Sequence[Vectors]], paths: Sequence[Path3D], truth: Float[np.ndarray, "3"]
) -> bytes:
    """Draw Figure 1: rows of match vectors, below them the cameras' paths and their rotation errors."""
    columns = max(len(row) for row in rows)
    figure = Figure(figsize=(3.1 * columns, 2.9 * (len(rows) + 1)), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(len(rows), 1))
    above, below = parts
    grid = above.subplots(len(rows), columns, squeeze=False)
    box = _box_of([vectors for row in rows for vectors in row])
    for places, row in zip(grid, rows, strict=True):
        for place, vectors in zip_longest(places, row):
            if vectors is None:
                place.remove()
            else:
                _draw_vectors(place, vectors, box)
    track, errors = below.subplots(1, 2)
    _draw_paths(track, paths, truth)
    for path in paths:
        errors.plot(np.arange(len(path.rotation_deg)) + 1, path.rotation_deg, label=path.name)
    errors.set(xscale="log", yscale="log", xlabel="step", ylabel="rotation error, deg")
    errors.set_title("(c) rotation error", fontsize=9)
    errors.legend(fontsize=7)
    return _png(figure)


def pictures(
    rows: Sequence[Sequence[UInt8[np.ndarray, "_ _ 3"] | None]], columns: Sequence[str], names: Sequence[str]
) -> bytes:
    """Draw Figures 2 and 3: a row a query, a column a method; None where it has no answer."""
    figure = Figure(figsize=(1.9 * len(columns), 1.75 * len(rows) + 0.3), layout="constrained")
    axes = figure.subplots(len(rows), len(columns), squeeze=False)
    for r, row in enumerate(rows):
        for c, image in enumerate(row):
            place: Axes = axes[r, c]
            place.set_xticks([])
            place.set_yticks([])
            if image is None:
                place.text(0.5, 0.5, "not run", ha="center", va="center", fontsize=8, transform=place.transAxes)
            else:
                place.imshow(image)
            if r == 0:
                place.set_title(columns[c], fontsize=8)
            if c == 0:
                place.set_ylabel(names[r], fontsize=8)
    return _png(figure, PICTURES_DPI)


def shares_by_step(panels: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float], int]]]) -> bytes:
    """Draw Figure 4, a panel a start; by method: steps, shares of queries within the bounds, number of queries."""
    figure = Figure(figsize=(5.2 * len(panels), 3.6), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for place, (title, methods) in zip(axes, panels.items(), strict=True):
        for name, (steps, shares, count) in methods.items():
            label = f"{name} ({count} queries)"
            place.step(np.asarray(steps) + 1, shares, where="post", label=label, color=COLOURS.get(name))
        place.set(xscale="log", ylim=(-0.03, 1.03), xlabel="step (record of the trace)", title=title)
        place.set_ylabel("share within 5 deg and 0.05 units")
        place.grid(alpha=0.3)
        place.legend(fontsize=7)
    return _png(figure)


def _box_of(shown: Sequence[Vectors]) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top of the matches' extent in the photo, with a margin."""
    ends = np.concatenate([np.concatenate([vectors.rendered_px, vectors.photo_px]) for vectors in shown])
    height, width = shown[0].photo.shape[:2]
    # Percentiles, because single wrong matches reach far out.
    (left, top), (right, bottom) = np.percentile(ends, [0.5, 99.5], axis=0)
    margin = MARGIN * max(width, height)
    return (
        max(0.0, left - margin),
        min(float(width), right + margin),
        min(float(height), bottom + margin),
        max(0.0, top - margin),
    )


def _draw_vectors(place: Axes, vectors: Vectors, box: tuple[float, float, float, float]) -> None:
    # A pale photo, so that the vectors stand out.
    faded = 255 - (255 - vectors.photo.astype(float)) * 0.45
    place.imshow(faded.astype(np.uint8))
    a, b = vectors.rendered_px - 0.5, vectors.photo_px - 0.5  # matplotlib puts the first pixel's centre at 0
    shift = b - a
    place.quiver(*a.T, *shift.T, angles="xy", scale_units="xy", scale=1, width=0.003, color="#3a3a3a")
    place.scatter(*a.T, s=7, facecolors="none", edgecolors=RED, linewidths=0.8)
    place.scatter(*b.T, s=7, facecolors="none", edgecolors=GREEN, linewidths=0.8)
    place.set(xlim=box[:2], ylim=box[2:], xticks=[], yticks=[])
    place.set_title(vectors.title, fontsize=8)


def _draw_paths(place: Axes, paths: Sequence[Path3D], truth: Float[np.ndarray, "3"]) -> None:
    """Draw positions in the plane in which they extend most."""
    every = np.concatenate([path.positions for path in paths] + [truth[None]])
    # The two principal directions of all positions.
    axes = np.linalg.svd(every - every.mean(0), full_matrices=False)[2][:2]
    for path in paths:
        place.plot(*(axes @ (path.positions - truth).T), marker=".", markersize=3, linewidth=1, label=path.name)
    place.plot(0, 0, marker="*", markersize=11, color=GREEN, linestyle="none", label="truth")
    place.set_aspect("equal", adjustable="datalim")
    place.set_title("(c) the camera's path, units", fontsize=9)
    place.legend(fontsize=7)


def reliability(models: Mapping[str, Sequence[Mapping[str, float]]]) -> bytes:
    """Draw a reliability diagram: the share of right poses against their predicted probability, and their number.

    Each model has rows of `said` (the mean prediction), `true` (the share), `count`, and the bin's `from` and `to`.
    """
    figure = Figure(figsize=(6.0, 5.4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    above.plot([0, 1], [0, 1], color="#999999", linestyle=":", label="calibrated")
    for (name, rows), colour in zip(models.items(), (GREEN, COLOURS["mc_do"]), strict=False):
        said, true = [row["said"] for row in rows], [row["true"] for row in rows]
        above.plot(said, true, "o-", color=colour, label=name.replace("_", " "))
        middles = [0.5 * (row["from"] + row["to"]) for row in rows]
        below.bar(middles, [row["count"] for row in rows], 0.08, color=colour, alpha=0.5)
    above.set(
        ylabel="share that was right", xlim=(0, 1), ylim=(-0.02, 1.02), title="The gate on scenes it was not fitted on"
    )
    above.legend()
    below.set(xlabel="probability that was said", ylabel="poses", yscale="log")
    return _png(figure)


def growth(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw CPU time and memory against the number of Gaussians; the rows are those of `bench scale`."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    times, latency, memory = figure.subplots(1, 3)
    size = [row["gaussians"] for row in rows]
    stages = (("load_cpu_s", "load from the file"), ("load_again_cpu_s", "load again"), ("index_cpu_s", "index"))
    for name, label in stages:
        times.plot(size, [row[name] for row in rows], "o-", label=label)
    times.set(title="CPU seconds to be ready", yscale="log")
    latency.plot(size, [row["cpu_ms_p50"] for row in rows], "o-", label="localize")
    latency.set(title="CPU ms per photo, median", ylim=(0, None))
    for name, label in (("peak_bytes", "peak"), ("resident_bytes", "resident"), ("anonymous_bytes", "anonymous")):
        memory.plot(size, [row[name] / 1e6 for row in rows], "o-", label=label)
    memory.plot(size, [row["file_bytes"] / 1e6 for row in rows], "--", label="scene file", color="gray")
    memory.set(title="MB", ylim=(0, None))
    for place in (times, latency, memory):
        place.set(xscale="log", xlabel="Gaussians")
        place.grid(alpha=0.3)
        place.legend(fontsize=7)
    return _png(figure)


def _png(figure: Figure, dpi: int = DPI) -> bytes:
    stream = io.BytesIO()
    # The figure's own canvas, without pyplot: no global state, no display.
    FigureCanvasAgg(figure).print_figure(stream, dpi=dpi, format="png")
    return with_palette(stream.getvalue())
