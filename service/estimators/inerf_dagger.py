"""iNeRF-dagger of the supplement: `inerf` with its loss over the whole picture."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import asdict, dataclass
from typing import ClassVar

from service.estimators import inerf
from service.interfaces import Tools
from service.pose.descent.gradient_descent import require_within
from service.pose.descent.losses import require_loss
from service.pose.features.image_sizes import RENDER_PX
from service.pose.features.scene_focus import Focus
from service.results import IterationRecord
from service.types import Query

prepare = inerf.prepare


NEEDS_PRIOR = True


@dataclass(frozen=True, slots=True)
class Options:
    steps: int = 500
    rate: float = 0.05
    """Adam's at the start; 0.8 times as much every 100 steps."""
    loss: str = "l2"
    """l1, l2, relative, feature, corner or blur."""
    long_side_px: int = RENDER_PX
    """Long side of the renders, in pixels."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "use_attribute_docstrings": True}

    def __post_init__(self) -> None:
        require_within(self, inerf.LIMITS)
        require_loss(self.loss)


def run(query: Query, tools: Tools[Focus], options: Options) -> Generator[IterationRecord, None, None]:
    """Run `inerf` on all pixels. Raises InvalidPrior without a prior."""
    inerf.required_prior(query, "inerf_dagger")
    yield from inerf.run(query, tools, inerf.Options(rays=0, **asdict(options)))
