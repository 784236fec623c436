"""`splatfix bench ablation`: what each part of the default estimator contributes, each removed in turn.

Every photo of each scene, as it is and spoilt in several ways, and with the scene's cameras ignored; the index of views
is always the whole estimator's. A part is removed by putting something simpler in its place for the time of a run: the
estimator has no switches for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from service.bench.localize import Subject, Trial, answered, subject, trials_of
from service.bench.pose_metrics import COARSE, FINE, Outcome, errors
from service.errors import UnknownName
from service.estimators import view_index
from service.localize import DEFAULT_ESTIMATOR, Request
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.matching import search_stages as stages
from service.pose.matching.correspondences import Correspondences
from service.pose.refinement.config import REFINEMENT, PyramidConfig
from service.pose.refinement.photometric import refine_photometric
from service.pose.refinement.uncertainty import pose_uncertainty
from service.pose.retrieval import image_variant as sight
from service.pose.retrieval.index import ViewIndex
from service.pose.verification import appearance, gate
from service.render import cpu
from service.results import IterationRecord
from service.types import Query

CONDITIONS = {
    "clean": (), "gain 1.4": ("gain=1.4",), "roll 45": ("roll=45",), "crop 0.5": ("crop=0.5",),
    "occlusion 0.35": ("occlusion=0.35",), "focal 5 % off": ("focal=1.05",), "bare scene": (),
}  # fmt: skip
APPROXIMATE, BARE = "focal 5 % off", "bare scene"
"""The condition whose focal length is told to be approximate, and the one whose scene comes without cameras."""


DEFAULTS = view_index.Options()


@dataclass(frozen=True, slots=True)
class Removal:
    """What stands in for a part."""

    patches: tuple[tuple[Any, str, Any], ...] = ()
    """(module or class, name, stand-in)."""
    options: view_index.Options = DEFAULTS
    exact_focal: bool = False


def removals() -> dict[str, Removal]:
    """Return the parts, and how the estimator does without each."""
    v, s = view_index, stages
    return {
        "nothing": Removal(),
        "votes for views (random ones)": Removal(((ViewIndex, "votes", _any_views),)),
        "pixels enough after many matches": Removal(((v, "glance", _no_glance),)),
        "all views but the likeliest": Removal(options=view_index.Options(candidates=1)),
        "first look at a smaller photo": Removal(((v, "GLIMPSE_SHARE", 1.0),)),
        "views' matches pooled": Removal(((Correspondences, "pooled", staticmethod(_first)),)),
        "photo at the views' scale": Removal(((sight, "SAME_SCALE", np.inf),)),
        "photo turned": Removal(((v, "turned_sight", _upright),)),
        "sampled poses (effort fast)": Removal(options=view_index.Options(effort="fast")),
        "rendering and matching again": Removal(((v, "STRONG", 0),)),
        "alignment": Removal(((v, "aligned", _as_found), (s, "aligned", _as_found))),
        "second render of the alignment": Removal(((s, "ALIGNMENTS", 1), (s, "FIRST_ALIGNED_PX", None))),
        "small first render": Removal(((s, "FIRST_ALIGNED_PX", None),)),
        "larger second look": Removal(((v, "SECOND_LOOK", 1.0),)),
        "gain, bias, gamma, blur": Removal(_refined_with(estimate_photometric=False)),
        "L1 weights": Removal(_refined_with(weighting="least_squares")),
        "cut of large residuals": Removal(_refined_with(cutoff_medians=np.inf)),
        "cut-off where saturated": Removal(_refined_with(pyramid=PyramidConfig(saturated_share=np.inf))),
        "depth of the occluder at edges": Removal(_refined_with(pyramid=PyramidConfig(edge_px=0))),
        "dilation scaled": Removal(((cpu, "dilation_for", _fixed_dilation),)),
        "focal length estimated": Removal(exact_focal=True),
        "decoupled solver (PnP again instead)": Removal(((s, "solved_near", _resected_again),)),
        "tints": Removal(((appearance, "tint_agreement", _alike),)),
        "look in the mirror": Removal(((v._Hunt, "reflect", _nothing),)),
        "look elsewhere": Removal(((v._Hunt, "contest", _nothing),)),
    }


def run(
    folders: Sequence[Path],
    *,
    parts: Sequence[str] = (),
    cache_dir: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[dict[str, Any]]:
    """Return the list that `--json` writes, a row per part and condition. Raises SceneError, UnknownName.

    The photos of the next folder hide those of each. `parts` are all if none is named.
    """
    known = removals()
    for part in parts:
        if part not in known:
            raise UnknownName(f"there is no part '{part}'; known: {', '.join(known)}.", where="part")
    chosen = {part: known[part] for part in parts or known}
    outcomes: dict[tuple[str, str], list[Outcome]] = {(p, c): [] for p in chosen for c in CONDITIONS}
    for number, folder in enumerate(folders):
        with_cameras = subject(folder, cache_dir=cache_dir)
        bare = subject(folder, cameras="ignored", cache_dir=cache_dir)
        for i, (condition, modify) in enumerate(CONDITIONS.items()):
            one = bare if condition == BARE else with_cameras
            one.loaded.prepare(DEFAULT_ESTIMATOR)
            trials = list(trials_of(one, "none", len(one.photos), 0, modify, folders[(number + 1) % len(folders)]))
            for part, removal in chosen.items():
                outcomes[part, condition] += _outcomes(one, trials, removal, condition)
            if progress:
                progress(number * len(CONDITIONS) + i + 1, len(folders) * len(CONDITIONS))
    return [_row(part, condition, some) for (part, condition), some in outcomes.items()]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows as a Markdown table: how many are within 5 deg / 0.05 and 1 deg / 0.01, and CPU time."""
    cells = {(row["part"], row["condition"]): row for row in rows}
    lines = ["| without | " + " | ".join(CONDITIONS) + " | false | CPU ms, clean |"]
    lines.append("| --- |" + " --- |" * (len(CONDITIONS) + 2))
    for part in dict.fromkeys(row["part"] for row in rows):
        own = [cells[part, condition] for condition in CONDITIONS]
        counts = [f"{row['success_5deg_0p05']} / {row['success_1deg_0p01']}" for row in own]
        false = sum(row["false_localized"] for row in own)
        lines.append(f"| {part} | " + " | ".join(counts) + f" | {false} | {own[0]['cpu_ms_p50']:.0f} |")
    return "\n".join(lines)


def _outcomes(one: Subject, trials: Sequence[Trial], removal: Removal, condition: str) -> list[Outcome]:
    request = Request(options=removal.options)
    trust = "approximate" if condition == APPROXIMATE and not removal.exact_focal else "given"
    outcomes = []
    with _patched(removal.patches):
        for trial in trials:
            wall, cpu_s = time.perf_counter(), time.process_time()
            estimate = answered(one, trial, request, trust)
            spent = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu_s)
            error = errors(estimate.pose, trial.truth.pose, one.units)
            outcomes.append(Outcome(estimate.verdict.status, *error, *spent))
    return outcomes


def _row(part: str, condition: str, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    return {
        "part": part,
        "condition": condition,
        "photos": len(outcomes),
        "success_5deg_0p05": sum(o.success(COARSE) for o in outcomes),
        "success_1deg_0p01": sum(o.success(FINE) for o in outcomes),
        "false_localized": sum(o.false for o in outcomes),
        "cpu_ms_p50": float(np.median([o.cpu_ms for o in outcomes])),
    }


@contextmanager
def _patched(patches: Sequence[tuple[Any, str, Any]]) -> Iterator[None]:
    before = [(place, name, vars(place)[name]) for place, name, _ in patches]
    try:
        for place, name, stand_in in patches:
            setattr(place, name, stand_in)
        yield
    finally:
        for place, name, original in before:
            setattr(place, name, original)


# --- what stands in for the parts

_SOLVED_NEAR = stages.solved_near


def _refined_with(**changed: Any) -> tuple[tuple[Any, str, Any], ...]:
    """Return the patches that refine, and estimate the uncertainty, with a changed config."""
    config = replace(REFINEMENT, **changed)
    return (
        (stages, "refine_photometric", partial(refine_photometric, config=config)),
        (gate, "pose_uncertainty", partial(pose_uncertainty, config=config)),
    )


def _any_views(index: ViewIndex, descriptors: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).random(len(index.views))


def _first(parts: Sequence[Correspondences]) -> Correspondences:
    return parts[0]


def _upright(upright: Any, query: Any, tools: Any) -> Any:
    return upright


def _as_found(found: AbsolutePose, query: Any, tools: Any) -> Iterator[IterationRecord]:
    yield IterationRecord("refine", found.pose, found.correction, num_inliers=found.num_inliers)


def _fixed_dilation(camera: Any, info: Any) -> float:
    return cpu.DILATION


def _no_glance(*others: Any) -> None:
    return None


def _alike(blocks: appearance.Blocks) -> float:
    return 1.0


def _nothing(*others: Any) -> Iterator[IterationRecord]:
    return iter(())


def _resected_again(near: AbsolutePose, matches: Correspondences, query: Query) -> AbsolutePose | None:
    """Solve the matches with a render at a pose as if they were with a view, where the lens is known."""
    if query.focal_sigma:
        return _SOLVED_NEAR(near, matches, query)
    return stages.resected(matches, query, stages.REMATCH_ERROR_PX, 500)
