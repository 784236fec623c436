"""What is run: methods with their options, and studies, each a method under a protocol.

Baselines have the supplement's parameters, less what two cores can't do in five minutes a trial: that is their
two-core profile, and it is named beside every number. `mc_do` and `view_index` have their defaults.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from service.bench.starts import require_kind
from service.errors import UnknownName
from service.estimators import ESTIMATORS
from service.pose.descent.losses import LOSSES

SLOW = ("inerf", "inerf_dagger", "pnerf", "icomma")
"""Methods that get few trials."""
STEPS_OF_TABLE_1 = 120
"""Of the descent. Its rates fall: in 60 steps they go 1.4 degrees about an axis; near starts are up to 2 off."""
IMAGES_OF_TABLE_5 = 5
"""Of each scene; with 40 trials a cell they have ten starts each, as published, and five where stages are left out."""
STEP_CURVES = ("icomma", "inerf_dagger", "mc_do", "view_index")
"""Methods of Figure 4, whose errors are kept step by step."""


@dataclass(frozen=True, slots=True)
class Method:
    name: str
    estimator: str
    changed: Mapping[str, Any] = field(default_factory=dict)
    """Options other than the estimator's defaults."""
    profile: str = ""
    """What the changes mean, for the reader of a number."""

    @property
    def options(self) -> Any:
        return ESTIMATORS.load(self.estimator).Options(**self.changed)

    def config(self) -> dict[str, Any]:
        """Return all that decides what the method does."""
        return {"estimator": self.estimator, "options": dataclasses.asdict(self.options), "profile": self.profile}


@dataclass(frozen=True, slots=True)
class Cell:
    """A method under a protocol: what one number of a table is made of, on every scene."""

    study: str
    method: Method
    protocol: str
    share: float = 1.0
    """Of the number of trials that is asked for."""
    photos: int | None = None
    """Of the scene's test photos, evenly spread; None: all."""

    @property
    def name(self) -> str:
        return f"{self.study}/{self.method.name}/{self.protocol}"


def _mc_do(name: str, **changed: Any) -> Method:
    return Method(name, "mc_do", changed)


_NO_STAGE = {"hypotheses": 0, "iterations": 0, "refinement_steps": 0}
_STAGES: dict[str, dict[str, Any]] = {
    # A start from anywhere says nothing of where to look.
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
    Method(
        "pnerf", "pnerf", {"hypotheses": 2, "long_side_px": 64}, "3DGS in place of Instant-NGP, 2 hypotheses, 64 px"
    ),
)
ABLATION = {"": ("loss",), "mc": ("mc",), "do": ("do",), "mc+do": ("mc", "do"), "mc+do+loss": ("mc", "do", "loss")}
"""Table 5's rows. Of its first one the supplement doesn't say what is left; here it is the descent alone."""
RESOLUTIONS_PX = (208, 416, 800)
RANGES_DEG = (15.0, 30.0, 60.0, 120.0)


@cache
def cells() -> tuple[Cell, ...]:
    """Return all there is to run, in the order of worth."""
    starts = (("table2", "hard"), ("table2", "none"), ("table2", "easy"), ("pnerf", "pnerf"))
    found = [Cell(study, method, start) for study, start in starts for method in MAIN[:2]]
    found += [Cell(study, method, start, 0.25) for study, start in starts if start != "none" for method in MAIN[2:]]
    for row, stages in ABLATION.items():
        options = _NO_STAGE | {key: value for stage in stages for key, value in _STAGES[stage].items()}
        method = _mc_do(f"mc_do:{row or 'descent'}", **options)
        share = 1.25 if len(stages) == len(_STAGES) else 0.625
        found.append(Cell("table5", method, "random", share=share, photos=IMAGES_OF_TABLE_5))
    found.append(Cell("table5", MAIN[0], "random", share=1.25, photos=IMAGES_OF_TABLE_5))
    for loss in LOSSES:
        method = _mc_do(f"mc_do:{loss}", **_NO_STAGE | {"refinement_steps": STEPS_OF_TABLE_1, "loss": loss})
        found.append(Cell("table1", method, "near", share=0.25))
    for degrees in RANGES_DEG:
        found.append(Cell("range", _mc_do(f"mc_do:range{degrees:g}", range_deg=degrees), "hard", share=0.25))
    for pixels in RESOLUTIONS_PX:
        sizes = {"hypothesis_px": pixels, "render_px": pixels}
        found.append(Cell("resolution", _mc_do(f"mc_do:{pixels}px", **sizes), "hard", share=0.125))
    return tuple(sorted(found, key=lambda cell: cell.method.name == "pnerf"))  # a trial of it takes longest


def chosen(
    studies: Collection[str] = (), methods: Collection[str] = (), protocols: Collection[str] = ()
) -> tuple[Cell, ...]:
    """Return the cells of these; an empty choice is all. Raises UnknownName."""
    for protocol in protocols:
        require_kind(protocol)
    for what, names, known in (
        ("study", studies, {cell.study for cell in cells()}),
        ("method", methods, {cell.method.name for cell in cells()}),
        ("protocol", protocols, {cell.protocol for cell in cells()}),
    ):
        for name in names:
            if name not in known:
                raise UnknownName(f"there is no {what} '{name}'; known: {', '.join(sorted(known))}.", where=what)
    return tuple(_filtered(studies, methods, protocols))


def _filtered(studies: Collection[str], methods: Collection[str], protocols: Collection[str]) -> Iterator[Cell]:
    for cell in cells():
        wanted = ((studies, cell.study), (methods, cell.method.name), (protocols, cell.protocol))
        if all(not names or name in names for names, name in wanted):
            yield cell
