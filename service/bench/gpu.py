"""`splatfix bench gpu`: is a GPU's renderer right, and what is it worth? In under 8 minutes, beside the CPU's renderer.

Each part yields rows of plain values, which are in the file as soon as they are made (see `gpu_runner`); later parts
need nothing of earlier ones, and they are ordered by what a run that is cut short should rather have told.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from service.bench.gpu_runner import Part, Row, run_parts
from service.errors import UnknownName

LIMIT_S = 470.0
"""Of all parts together."""
_EQUALITY, _SPEED = "service.bench.gpu_equality", "service.bench.gpu_speed"
PARTS = (
    Part("machine", "service.bench.gpu_shared:machine", 90.0),  # it waits for the libraries
    Part("pictures", f"{_EQUALITY}:pictures", 60.0),
    Part("gradients", f"{_EQUALITY}:gradients", 45.0),
    Part("poses", f"{_EQUALITY}:poses", 90.0),
    Part("latency", f"{_SPEED}:latency", 40.0),
    Part("throughput", f"{_SPEED}:throughput", 60.0),
    Part("index", f"{_SPEED}:index", 40.0),
    Part("sizes", "service.bench.gpu_memory:sizes", 120.0),
    Part("out of memory", "service.bench.gpu_memory:out_of_memory", 30.0),
    Part("many jobs", "service.bench.gpu_memory:many_jobs", 80.0),
)
"""The limits are three times what is expected of a data-centre card, so that one slow part leaves time for the rest."""


def run(
    folder: Path,
    *,
    renderer: str = "gsplat_cuda",
    small: bool = False,
    names: Sequence[str] = (),
    limit_s: float = LIMIT_S,
    facts: Row | None = None,
    file: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Run the parts, or those of these names, on a scene folder with test photos; return what `--json` writes.

    `small` takes few and small images and scenes, for a renderer that is a stand-in. `facts` are added to the outcome.
    Raises UnknownName for a part that doesn't exist.
    """
    known = [part.name for part in PARTS]
    for name in names:
        if name not in known:
            raise UnknownName(f"unknown part '{name}'; known: {', '.join(known)}.", where="part")
    # The first one is always run: without it the figures belong to no machine.
    chosen = [part for part in PARTS if not names or part.name in names or part is PARTS[0]]
    setup = "service.bench.gpu_shared:Shared", (folder, renderer, small)
    outcome = {**(facts or {}), "scene": folder.name, "renderer": renderer, "small": small}
    return run_parts(chosen, setup, facts=outcome, limit_s=limit_s, file=file, progress=progress)
