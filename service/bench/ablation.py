"""`splatfix bench ablation`: what each part of the default estimator contributes, each removed in turn.

Every photo of each scene, unaltered and altered in several ways, and with the scene's cameras ignored; the index of
views is always the whole estimator's. A part is removed by a value of the estimator's config, options or query.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from service.bench.localize import BenchScene, Trial, load_bench_scene, localize_trial, make_trials
from service.bench.pose_metrics import COARSE, FINE, Outcome, errors
from service.errors import UnknownName
from service.estimators import view_index
from service.estimators.search_config import SEARCH, SearchConfig
from service.loaded_scene import DEFAULT_ESTIMATOR
from service.localize import Request
from service.pose.refinement.refinement_config import REFINEMENT, PyramidConfig
from service.pose.retrieval.scores import ScoreConfig
from service.pose.verification.appearance import LOCAL_COLOUR
from service.pose.verification.gate_model import SHIPPED_MODEL
from service.render import cpu

CONDITIONS = {
    "clean": (), "gain 1.4": ("gain=1.4",), "roll 45": ("roll=45",), "crop 0.5": ("crop=0.5",),
    "occlusion 0.35": ("occlusion=0.35",), "focal 5 % off": ("focal=1.05",), "bare scene": (),
}  # fmt: skip
APPROXIMATE, BARE = "focal 5 % off", "bare scene"
"""The condition whose focal length is said to be approximate, and the one whose scene comes without cameras."""


DEFAULTS = view_index.Options()


@dataclass(frozen=True, slots=True)
class Removal:
    """How the estimator does without a part."""

    config: SearchConfig = SEARCH
    options: view_index.Options = DEFAULTS
    exact_focal: bool = False
    """The photo's focal length is said to be exact."""
    unscaled_dilation: bool = False
    """Renders are dilated like the training photos, whatever their size."""


def removals() -> dict[str, Removal]:
    """Return the parts, and how the estimator does without each."""
    refine, matching, mirror, ambiguity = SEARCH.refinement, SEARCH.matching, SEARCH.mirror, SEARCH.ambiguity
    # Without features of the photo all scores are equal, and sorting keeps the order.
    scores = ScoreConfig(photo_features=0)
    return {
        "nothing": Removal(),
        "retrieval scores (views in the index's order instead)": _retrieved_with(scores=scores),
        "verification by pixels after many matches": _searched_with(photometric_min_inliers=np.inf),
        "all views but the best scored": Removal(options=view_index.Options(candidates=1)),
        "coarse pass on a small photo": _searched_with(small_photo_factor=1.0),
        "pooled matches of several views": _searched_with(matching=replace(matching, pool_views=False)),
        "photo at the views' scale": _retrieved_with(same_scale=np.inf),
        "in-plane rotation": _retrieved_with(max_rotations=0),
        "sampled poses (effort fast)": Removal(options=view_index.Options(effort="fast")),
        "render and rematch": _searched_with(rematch_below_inliers=0),
        "photometric refinement": _searched_with(refinement=replace(refine, max_renders=0)),
        "second render of the refinement": _searched_with(
            refinement=replace(refine, max_renders=1, max_renders_free_lens=1, first_render_px=None)
        ),
        "small first render": _searched_with(refinement=replace(refine, first_render_px=None)),
        "larger photo in the last retrieval": _searched_with(large_photo_factor=1.0),
        "photometric parameters (gain, bias, gamma, blur)": _refined_with(estimate_photometric=False),
        "L1 weights": _refined_with(weighting="least_squares"),
        "cut-off of large residuals": _refined_with(cutoff_medians=np.inf),
        "clipping of the render where the photo is saturated": _refined_with(
            pyramid=PyramidConfig(saturated_share=np.inf)
        ),
        "depth of the occluder at edges": _refined_with(pyramid=PyramidConfig(edge_px=0)),
        "scaled dilation": Removal(unscaled_dilation=True),
        "estimation of the focal length": Removal(exact_focal=True),
        "decoupled solver (PnP instead)": _searched_with(matching=replace(matching, solver="pnp")),
        "local colour correlation": _without_local_colour(),
        "search for mirror images": _searched_with(mirror=replace(mirror, beyond_doubt=-np.inf)),
        "search for ambiguous hypotheses": _searched_with(ambiguity=replace(ambiguity, max_hypotheses=0)),
    }


def _searched_with(**changed: Any) -> Removal:
    return Removal(replace(SEARCH, **changed))


def _retrieved_with(**changed: Any) -> Removal:
    return _searched_with(retrieval=replace(SEARCH.retrieval, **changed))


def _refined_with(**changed: Any) -> Removal:
    """Return the removal that refines, and estimates the uncertainty, with a changed config."""
    config = replace(REFINEMENT, **changed)
    return _searched_with(
        refinement=replace(SEARCH.refinement, photometric=config),
        # The gate makes a step of refinement of its own.
        verification=replace(SEARCH.verification, refinement=config),
    )


def _without_local_colour() -> Removal:
    """Return the removal whose gate has no floor for the local colour correlation, which has no weight anyway."""
    floors = {name: floor for name, floor in SHIPPED_MODEL.floors.items() if name != LOCAL_COLOUR}
    return _searched_with(verification=replace(SEARCH.verification, model=replace(SHIPPED_MODEL, floors=floors)))


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
            raise UnknownName(f"unknown part '{part}'; known: {', '.join(known)}.", where="part")
    chosen = {part: known[part] for part in parts or known}
    outcomes: dict[tuple[str, str], list[Outcome]] = {(p, c): [] for p in chosen for c in CONDITIONS}
    for number, folder in enumerate(folders):
        with_cameras = load_bench_scene(folder, cache_dir=cache_dir)
        # The same scene once more, as if nothing were known of its training photos.
        bare = load_bench_scene(folder, cameras="ignored", cache_dir=cache_dir)
        for i, (condition, modify) in enumerate(CONDITIONS.items()):
            one = bare if condition == BARE else with_cameras
            one.loaded.prepare(DEFAULT_ESTIMATOR)
            # Every part answers the same files.
            trials = list(make_trials(one, "none", len(one.photos), 0, modify, folders[(number + 1) % len(folders)]))
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


def _outcomes(one: BenchScene, trials: Sequence[Trial], removal: Removal, condition: str) -> list[Outcome]:
    request = Request(options=removal.options, config=removal.config)
    # Only in that condition is there a focal length to estimate.
    trust = "approximate" if condition == APPROXIMATE and not removal.exact_focal else "given"
    outcomes = []
    # The renderer has no option for it, since nothing else needs biased renders.
    with unscaled_dilation() if removal.unscaled_dilation else nullcontext():
        for trial in trials:
            wall, cpu_s = time.perf_counter(), time.process_time()
            estimate = localize_trial(one, trial, request, trust)
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
def unscaled_dilation() -> Iterator[None]:
    """Dilate renders like the training photos, whatever their size, for as long as the context lasts."""
    scaled = cpu.dilation_for
    try:
        cpu.dilation_for = lambda camera, info: cpu.DEFAULTS.dilation_px2
        yield
    finally:
        cpu.dilation_for = scaled
