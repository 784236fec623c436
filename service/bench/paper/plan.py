"""The experiments: methods with their options, and studies, whose cells are a method under a protocol each.

Baselines have the supplement's parameters, reduced where two cores would need more than five minutes a trial: that is
their two-core profile, which is stated beside every number. `mc_do` and `view_index` have their defaults.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from service.bench.start_poses import require_kind
from service.errors import UnknownName
from service.estimators import ESTIMATORS
from service.pose.descent.losses import LOSSES

SLOW = ("inerf", "inerf_dagger", "pnerf", "icomma")
"""Methods that get few trials."""
STEP_CURVES = ("icomma", "inerf_dagger", "mc_do", "view_index")
"""Methods of Figure 4, whose errors are kept step by step."""


@dataclass(frozen=True, slots=True)
class StudyConfig:
    """Sizes of the studies."""

    table1_steps: int = 120
    """Of the descent. Its rates fall: in 60 steps they add up to 1.4 degrees about an axis; near starts are up to 2
    off."""
    table5_photos: int = 5
    """Of each scene; with 40 trials a cell they have ten starts each, as published, and five where stages are left
    out."""
    resolutions_px: tuple[int, ...] = (208, 416, 800)
    """Long sides of renders, for section C."""
    ranges_deg: tuple[float, ...] = (15.0, 30.0, 60.0, 120.0)
    """Of the hypotheses per axis, for section H."""
    slow_share: float = 0.25
    """Of the trials, for baselines in Table 2 and for tables 1 and H."""
    resolution_share: float = 0.125
    table5_share: float = 1.25
    """For the complete method; half of it where stages are left out."""


STUDIES = StudyConfig()


@dataclass(frozen=True, slots=True)
class Method:
    """An estimator with options, as a row of the tables."""

    name: str
    estimator: str
    changed: Mapping[str, Any] = field(default_factory=dict)
    """Options that differ from the estimator's defaults."""
    profile: str = ""
    """The changes in words, stated beside the method's numbers."""

    @property
    def options(self) -> Any:
        """The estimator's options with the changes."""
        return ESTIMATORS.load(self.estimator).Options(**self.changed)

    def config(self) -> dict[str, Any]:
        """Return all that determines the method's results, as JSON values."""
        return {"estimator": self.estimator, "options": dataclasses.asdict(self.options), "profile": self.profile}


@dataclass(frozen=True, slots=True)
class Cell:
    """A method under a protocol, on every scene: its lines make up the numbers of one table cell."""

    study: str
    method: Method
    protocol: str
    share: float = 1.0
    """Of the run's number of trials."""
    photos: int | None = None
    """Of the scene's test photos, evenly spread; None: all."""

    @property
    def name(self) -> str:
        """Name of the cell in results, unique within a plan."""
        return f"{self.study}/{self.method.name}/{self.protocol}"


def _mc_do(name: str, **changed: Any) -> Method:
    return Method(name, "mc_do", changed)


_NO_STAGE = {"hypotheses": 0, "iterations": 0, "refinement_steps": 0}
_STAGES: dict[str, dict[str, Any]] = {
    # A random start holds no information about the pose, so hypotheses are drawn over the whole scene.
    "mc": {"hypotheses": 64, "around": "scene"},
    "do": {"iterations": 10},
    "loss": {"refinement_steps": 60},
}
MAIN = (
    Method("view_index", "view_index"),
    _mc_do("mc_do"),
    _mc_do("mc_do_gradient", solver="gradient"),
    Method("inerf_dagger", "inerf_dagger", {"long_side_px": 256}, "256 px"),
    Method("icomma", "icomma", {"long_side_px": 256, "rematch_every": 10}, "256 px, XFeat re-matched every 10 steps"),
    Method("inerf", "inerf", {"long_side_px": 256}, "256 px"),
    # By step 1280 the rates have fallen to 0.4 %: what is left of the 2560 moves a hypothesis by less than 0.3 degrees.
    Method(
        "pnerf",
        "pnerf",
        {"hypotheses": 32, "steps": 1280, "long_side_px": 64},
        "3DGS in place of Instant-NGP, 32 hypotheses, 1280 steps, 64 px",
    ),
)
ABLATION = {"": ("loss",), "mc": ("mc",), "do": ("do",), "mc+do": ("mc", "do"), "mc+do+loss": ("mc", "do", "loss")}
"""Table 5's rows. The supplement names no stage for its first one; here it is the descent alone."""


@cache
def cells(config: StudyConfig = STUDIES) -> tuple[Cell, ...]:
    """Return the cells of all studies, the most important first, and the slowest last."""
    starts = (("table2", "hard"), ("table2", "none"), ("table2", "easy"), ("pnerf", "pnerf"))
    found = [Cell(study, method, start) for study, start in starts for method in MAIN[:2]]
    found += [
        Cell(study, method, start, config.slow_share)
        for study, start in starts
        if start != "none"
        for method in MAIN[2:]
    ]
    for row, stages in ABLATION.items():
        options = _NO_STAGE | {key: value for stage in stages for key, value in _STAGES[stage].items()}
        method = _mc_do(f"mc_do:{row or 'descent'}", **options)
        share = config.table5_share if len(stages) == len(_STAGES) else 0.5 * config.table5_share
        found.append(Cell("table5", method, "random", share=share, photos=config.table5_photos))
    # The default has no stages to leave out: one row, for comparison.
    found.append(Cell("table5", MAIN[0], "random", share=config.table5_share, photos=config.table5_photos))
    for loss in LOSSES:
        method = _mc_do(f"mc_do:{loss}", **_NO_STAGE | {"refinement_steps": config.table1_steps, "loss": loss})
        found.append(Cell("table1", method, "near", share=config.slow_share))
    for degrees in config.ranges_deg:
        found.append(
            Cell("range", _mc_do(f"mc_do:range{degrees:g}", range_deg=degrees), "hard", share=config.slow_share)
        )
    for pixels in config.resolutions_px:
        sizes = {"hypothesis_px": pixels, "render_px": pixels}
        found.append(Cell("resolution", _mc_do(f"mc_do:{pixels}px", **sizes), "hard", share=config.resolution_share))
    return tuple(sorted(found, key=lambda cell: cell.method.name == "pnerf"))  # a trial of it takes longest


def chosen(
    studies: Collection[str] = (), methods: Collection[str] = (), protocols: Collection[str] = ()
) -> tuple[Cell, ...]:
    """Return the cells of these studies, methods and protocols; an empty choice means all. Raises UnknownName."""
    for protocol in protocols:
        require_kind(protocol)
    for what, names, known in (
        ("study", studies, {cell.study for cell in cells()}),
        ("method", methods, {cell.method.name for cell in cells()}),
        ("protocol", protocols, {cell.protocol for cell in cells()}),
    ):
        for name in names:
            if name not in known:
                raise UnknownName(f"unknown {what} '{name}'; known: {', '.join(sorted(known))}.", where=what)
    return tuple(_filtered(studies, methods, protocols))


def _filtered(studies: Collection[str], methods: Collection[str], protocols: Collection[str]) -> Iterator[Cell]:
    for cell in cells():
        wanted = ((studies, cell.study), (methods, cell.method.name), (protocols, cell.protocol))
        if all(not names or name in names for names, name in wanted):
            yield cell
