"""The supplement's tables from result lines, beside the published numbers.

Success is as published: the answer is within both bounds, whatever the verdict. Every number is shown with its counts;
the note of every table has the measured mean errors of the starts that it is based on.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from service.bench.paper.plan import ABLATION, MAIN, STUDIES
from service.pose.descent.losses import LOSSES

Line = Mapping[str, Any]
PUBLISHED_AS = {
    "inerf": "inerf",
    "pnerf": "pnerf",
    "inerf_dagger": "inerf_dagger",
    "icomma": "icomma",
    "mc_do": "paper",
}
"""Our methods' names in the published tables."""
STAGES = {"MC": ("start", "hypothesis", "sample_poses"), "DO": ("decouple",), "refinement": ("refine",)}
STARTS = {
    "near": "near the truth: world frame, per axis 0..2 deg and 0..0.05 units",
    "easy": "world frame, per axis 0..30 deg and 0..0.5 units",
    "hard": "world frame, per axis 30..60 deg and 0.5..1 units",
    "pnerf": "in place, per axis -15..15 deg and -0.25..0.25 units",
    "random": "anywhere among the training cameras, any rotation",
    "none": "no start at all",
}


ABOUT_TABLE_5 = (
    "All scenes together. 'descent': the L1 refinement alone; the paper's first row names no stage. MC samples "
    "the whole scene here, because random starts hold no information. The published starts are nearer: half of them "
    "converge without MC and DO."
)
ERRORS = ("rotation_deg", "translation_units")


@dataclass(frozen=True, slots=True)
class Table:
    """A table of the paper, or of this page."""

    name: str
    title: str
    notes: tuple[str, ...]
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def published() -> dict[str, Any]:
    """Return the published numbers."""
    return json.loads(resources.files("service.bench.paper").joinpath("published.json").read_text("utf-8"))


def tables(lines: Sequence[Line], config: Mapping[str, Any]) -> list[Table]:
    """Return every table that has at least one number."""
    scenes = list(config["scenes"])
    found = [
        *_successes(lines, scenes),
        *_error_tables(lines, scenes, config),
        *_table_1(lines, scenes),
        *_table_5(lines),
        *_times(lines, scenes),
        *_ranges(lines),
        *_resolutions(lines, config),
    ]
    # A run may cover only some of the studies.
    return [table for table in found if table.rows]


def start_note(lines: Sequence[Line]) -> str:
    """Return how far the starts of some lines were from the truth, in the mean."""
    protocols = sorted({line["protocol"] for line in lines})
    sentences = []
    for protocol in protocols:
        begun = [line for line in lines if line["protocol"] == protocol and line["start_rotation_deg"] is not None]
        # A start that several methods share counts once.
        each = {(line["scene"], line["study"], line["photo"], line["trial"]): line for line in begun}.values()
        errors = ""
        if each:
            degrees, units = (np.mean([line[f"start_{key}"] for line in each]) for key in ERRORS)
            errors = f"; mean start error {degrees:.1f} deg, {units:.2f} units ({len(each)} starts)"
        sentences.append(f"Start '{protocol}': {STARTS.get(protocol, protocol)}{errors}.")
    return " ".join(sentences)


def profile_note(lines: Sequence[Line]) -> str:
    """Return the sentence that lists the baselines of the two-core profile, with their changes."""
    profiles = {line["method"]: line["profile"] for line in lines if line["profile"]}
    sentences = [f"{method}: {profile}" for method, profile in profiles.items()]
    return f"Marked *, two-core profile: {'; '.join(sentences)}." if sentences else ""


def _notes(lines: Sequence[Line], *more: str) -> tuple[str, ...]:
    return tuple(note for note in (start_note(lines), profile_note(lines), *more) if note)


def _of(lines: Sequence[Line], **wanted: str) -> list[Line]:
    return [line for line in lines if all(line[key] == value for key, value in wanted.items())]


def _share(lines: Sequence[Line], holds: Callable[[Line], bool]) -> str:
    """Return count and share, such as '38/40 = .95'."""
    if not lines:
        return ""
    count = sum(map(holds, lines))
    return f"{count}/{len(lines)} = {_fraction(count / len(lines))}"


def _fraction(value: float) -> str:
    # As printed in the supplement: no zero before the point.
    return f"{value:.2f}".removeprefix("0")


def _named(methods: Sequence[str], lines: Sequence[Line]) -> tuple[str, ...]:
    """Return the methods' names, with a star where their numbers are of the two-core profile."""
    # A profile changes the method, so its numbers must not pass for the paper's.
    marked = {line["method"] for line in lines if line["profile"]}
    return tuple(f"{method}*" if method in marked else method for method in methods)


def _successes(lines: Sequence[Line], scenes: Sequence[str]) -> Iterator[Table]:
    for study, protocol in (("table2", "hard"), ("table2", "easy"), ("pnerf", "pnerf"), ("table2", "none")):
        chosen = _of(lines, study=study, protocol=protocol)
        methods = [m.name for m in MAIN if _of(chosen, method=m.name)]
        rows = []
        for scene in scenes:
            here = [_of(chosen, scene=scene, method=method) for method in methods]
            if not any(here):
                continue
            for bound, key in (("5 deg, 0.05", "within_5deg_0p05"), ("1 deg, 0.01", "within_1deg_0p01")):
                rows.append((scene, bound, "here", *(_share(each, lambda line, key=key: line[key]) for each in here)))
                level = "standard" if key == "within_5deg_0p05" else "hard"
                if protocol == "hard" and (known := _published_of("table2", scene, level, methods)):
                    rows.append((scene, bound, "published", *known))
        # The supplement's Table 2 has the start 'hard'; ours has others as well.
        number = "Table 2" if protocol == "hard" else f"Table 2, start '{protocol}'"
        yield Table(
            f"table2_{protocol}",
            f"{number}: success rates",
            _notes(chosen, "k/n queries within the bound, and their share."),
            ("scene", "bound", "", *_named(methods, chosen)),
            tuple(rows),
        )


def _published_of(table: str, scene: str, part: str, methods: Sequence[str]) -> tuple[str, ...]:
    """Return the published numbers of a scene of that name; empty if there is none."""
    for rows in published()[table].values():
        if scene.lower() in rows:
            values = rows[scene.lower()][part]
            each = [values.get(PUBLISHED_AS.get(method, "")) for method in methods]
            return tuple("" if v is None else _fraction(v) if table == "table2" else f"{v:g}" for v in each)
    return ()


def _error_tables(lines: Sequence[Line], scenes: Sequence[str], config: Mapping[str, Any]) -> Iterator[Table]:
    chosen = _of(lines, study="table2", protocol="hard")
    methods = [m.name for m in MAIN if _of(chosen, method=m.name)]
    for number, name, reduce in ((3, "median", np.median), (4, "mean", np.mean)):
        rows = []
        for scene in scenes:
            here = [_of(chosen, scene=scene, method=method) for method in methods]
            if not any(here):
                continue
            radius = config["scenes"][scene]["trajectory_radius_units"]
            for what, key, scale in (
                ("deg", "rotation_deg", 1.0),
                ("units", "translation_units", 1.0),
                ("% of the radius", "translation_units", 100.0 / radius),
            ):
                values = [f"{scale * reduce([line[key] for line in e]):.3g}" if e else "" for e in here]
                rows.append((scene, what, "here", *values))
                part = "rotation_deg" if key == "rotation_deg" else "translation_units"
                # Published errors are in degrees and units only.
                if scale == 1.0 and (known := _published_of(f"table{number}", scene, part, methods)):
                    rows.append((scene, what, "published", *known))
        yield Table(
            f"table{number}",
            f"Table {number}: {name} errors",
            _notes(
                chosen, "The radius is that of the training cameras' trajectory: their mean distance from its centre."
            ),
            ("scene", "error", "", *_named(methods, chosen)),
            tuple(rows),
        )


def _table_1(lines: Sequence[Line], scenes: Sequence[str]) -> Iterator[Table]:
    chosen, known = _of(lines, study="table1"), published()["table1"]
    # The supplement has means over data sets, not of scenes.
    groups = ("NeRF-Synthetic", "Mip-NeRF 360", "Deep Blending", "mean")
    rows = []
    for bound, key, holds in (
        ("< 5 deg", "rotation_5deg", lambda line: line["rotation_deg"] <= 5),
        ("< 0.05 units", "translation_0p05", lambda line: line["translation_units"] <= 0.05),
        ("< 0.01 units", "", lambda line: line["translation_units"] <= 0.01),
    ):
        for loss in LOSSES:
            here = [_of(chosen, method=f"mc_do:{loss}", scene=scene) for scene in scenes]
            if any(here):
                of_all = _share([line for each in here for line in each], holds)
                paper = tuple(_fraction(known[loss][key][g]) for g in groups) if key else ("",) * len(groups)
                rows.append((bound, loss, *(_share(each, holds) for each in here), of_all, *paper))
    for what, key in (("median deg", "rotation_deg"), ("median units", "translation_units")):
        for loss in LOSSES:
            here = [_of(chosen, method=f"mc_do:{loss}", scene=scene) for scene in scenes]
            if any(here):
                each = [_median(lines, key) for lines in (*here, [line for lines in here for line in lines])]
                rows.append((what, loss, *each, *("",) * len(groups)))
    yield Table(
        "table1",
        "Table 1: losses near the optimum",
        _notes(
            chosen,
            f"The descent alone, {STUDIES.table1_steps} steps, from the start; the published starts are not known.",
        ),
        ("bound", "loss", *scenes, "all here", *(f"published, {g}" for g in groups)),
        tuple(rows),
    )


def _median(lines: Sequence[Line], key: str) -> str:
    return f"{np.median([line[key] for line in lines]):.2g}" if lines else ""


def _table_5(lines: Sequence[Line]) -> Iterator[Table]:
    chosen, known = _of(lines, study="table5"), published()["table5"]
    bounds = {
        "rotation_5deg": ("< 5 deg", lambda line: line["rotation_deg"] <= 5),
        "rotation_1deg": ("< 1 deg", lambda line: line["rotation_deg"] <= 1),
        "translation_0p05": ("< 0.05", lambda line: line["translation_units"] <= 0.05),
        "translation_0p01": ("< 0.01", lambda line: line["translation_units"] <= 0.01),
    }
    rows = []
    # The row without a name is the descent alone; the default estimator is added for comparison.
    for row, method in [*((row or "descent", f"mc_do:{row or 'descent'}") for row in ABLATION), ("", "view_index")]:
        here = _of(chosen, method=method)
        if here:
            paper = tuple(_fraction(known[row][key]) if row else "" for key in bounds)
            rows.append((row or method, *(_share(here, holds) for _, holds in bounds.values()), *paper))
    heads = [head for head, _ in bounds.values()]
    yield Table(
        "table5",
        "Table 5: what each stage does, from random starts",
        _notes(chosen, ABOUT_TABLE_5),
        ("stages", *heads, *(f"published {head}" for head in heads)),
        tuple(rows),
    )


def _times(lines: Sequence[Line], scenes: Sequence[str]) -> Iterator[Table]:
    chosen = [line for line in lines if line["study"] == "table2"]
    rows = []
    for method in (m.name for m in MAIN):
        for protocol in ("hard", "easy", "none"):
            for scene in scenes:
                here = _of(chosen, method=method, protocol=protocol, scene=scene)
                if here:
                    rows.append((*_named([method], here), protocol, scene, str(len(here)), *_spent(here)))
    yield Table(
        "times",
        "Time and renders a query",
        (*_notes(chosen), "Seconds. CPU time is the process's; wall time also"
         " holds what else the machine did. Renders: pictures, and gradients as one more each; the median."),
        ("method", "start", "scene", "queries", "CPU p50", "CPU p95", "wall p50", "wall p95", "renders"),
        tuple(rows),
    )  # fmt: skip


def _spent(lines: Sequence[Line]) -> tuple[str, ...]:
    times = [
        f"{np.percentile([line[key] for line in lines], q) / 1e3:.2f}"
        for key in ("cpu_ms", "latency_ms")
        for q in (50, 95)
    ]
    return (*times, f"{np.median([line['renders'] for line in lines]):.0f}")


def _ranges(lines: Sequence[Line]) -> Iterator[Table]:
    chosen = _of(lines, study="range")
    rows = []
    for degrees in STUDIES.ranges_deg:
        here = _of(chosen, method=f"mc_do:range{degrees:g}")
        if here:
            share = _share(here, lambda line: line["within_5deg_0p05"])
            rows.append((f"+-{degrees:g} deg", share, *_spent(here)))
    yield Table(
        "section_h",
        "Section H: success and time against the sampling range",
        _notes(chosen, "All scenes together; 64 hypotheses in the first round whatever the range. Seconds."),
        ("range", "5 deg, 0.05", "CPU p50", "CPU p95", "wall p50", "wall p95", "renders"),
        tuple(rows),
    )


def _resolutions(lines: Sequence[Line], config: Mapping[str, Any]) -> Iterator[Table]:
    chosen = _of(lines, study="resolution")
    rows = []
    for pixels in STUDIES.resolutions_px:
        for scene, facts in config["scenes"].items():
            here = _of(chosen, method=f"mc_do:{pixels}px", scene=scene)
            if here:
                size = (f"{facts['gaussians']:,}", f"{facts['megabytes']:.0f}")
                share = _share(here, lambda line: line["within_5deg_0p05"])
                rows.append((f"{pixels} px", scene, *size, *(f"{_stage_s(here, s):.2f}" for s in STAGES), share))
    # Measured on other scenes and another machine, so it is a note and no column.
    paper = published()["section_c"]
    note = (
        f"Median CPU seconds. Published: MC {paper['mc_s']} s and DO {paper['do_s']} s ({paper['do_iterations']} "
        f"iterations), {paper['machine']}; scenes of 50 to 800 MB."
    )
    yield Table(
        "section_c",
        "Section C: time of the stages against render resolution and scene size",
        _notes(chosen, note),
        ("renders", "scene", "Gaussians", "MB", *STAGES, "5 deg, 0.05"),
        tuple(rows),
    )


def _stage_s(lines: Sequence[Line], stage: str) -> float:
    return float(np.median([sum(line["stages_cpu_ms"].get(s, 0.0) for s in STAGES[stage]) for line in lines])) / 1e3
