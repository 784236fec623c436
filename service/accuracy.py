"""The accuracy that a caller asks for: how far off a pose may be and still be of use."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from service.errors import InvalidAccuracy

DEFAULT_SHARE = 0.02
"""Bound of the position where none is given, relative to the distance to what is seen."""


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Bounds of the errors of a pose: of its rotation, and of its position in one of three measures.

    Without any of these the position's is DEFAULT_SHARE. Raises InvalidAccuracy.
    """

    deg: float = 5.0
    units: float | None = None
    """Scene units."""
    metres: float | None = None
    """Only in scenes whose manifest has `metres_per_unit`."""
    share: float | None = None
    """Of the distance to what is seen: the median depth of the scene rendered at the answer."""

    def __post_init__(self) -> None:
        _require("deg", self.deg, 180.0, "degrees")
        given = [name for name in ("units", "metres", "share") if getattr(self, name) is not None]
        if len(given) > 1:
            raise InvalidAccuracy(
                "give one of units, metres and share.", where=f"accuracy.{given[1]}", hint=f"Leave out {given[1]}."
            )
        # Where the default is meant, so that the bound is always there: `units`, or `share`.
        if not given:
            object.__setattr__(self, "share", DEFAULT_SHARE)
        _require("units", self.units, math.inf, "scene units")
        _require("metres", self.metres, math.inf, "metres")
        _require("share", self.share, 1.0, "the distance to what is seen")

    def in_units(self, scene_name: str, metres_per_unit: float | None) -> Accuracy:
        """Return the accuracy without metres, for a scene of this scale. Raises InvalidAccuracy if it has none."""
        if self.metres is None:
            return self
        if metres_per_unit is None:
            raise InvalidAccuracy(
                f"scene '{scene_name}' has no scale, so metres mean nothing in it.",
                where="accuracy.metres",
                hint='Ask for units or share, or put "metres_per_unit" into a scene.json beside the scene file.',
            )
        return replace(self, units=self.metres / metres_per_unit, metres=None)

    def bound_units(self, distance: float) -> float:
        """Return the bound of the position in scene units, at this distance to what is seen. Needs `in_units`."""
        if self.units is not None:
            return self.units
        assert self.share is not None, "metres are converted first"
        return self.share * distance


def _require(name: str, value: float | None, most: float, unit: str) -> None:
    if value is not None and not (0.0 < value <= most and math.isfinite(value)):
        upper = "" if math.isinf(most) else f" and at most {most:g}"
        raise InvalidAccuracy(
            f"must be greater than 0{upper}, is {value:g}.", where=f"accuracy.{name}", hint=f"In {unit}."
        )


DEFAULT_ACCURACY = Accuracy()
