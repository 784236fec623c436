"""The gate's fitted model: how probably a pose is right, from its signals. Its numbers are in `model.json`.

A logistic model without negative weights: each signal is mapped to 0..1 and cut off at both ends. Besides, each signal
has a floor: below it a pose is in doubt, however good the other signals are, because a sum would compensate for one
that is bad. `splatfix bench gate` fits weights and floors, and writes the file; floors that were set by hand it keeps.
Floors of one kind of signals don't hold where all other kinds support the pose (`FloorException`): those of colours in
other light than that of the training photos, those of gradients where photo and scene differ in detail.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

MODEL_FILE = Path(__file__).with_name("model.json")
FORMAT_VERSION = 5


@dataclass(frozen=True, slots=True)
class Scale:
    """Maps a signal to 0..1, linearly between two values and cut off there; `at_zero` may be the greater one."""

    at_zero: float
    at_one: float
    logarithmic: bool = False
    """Linear in the logarithm of the signal."""

    def __call__(self, value: Float[np.ndarray, "*n"] | float) -> Float64[np.ndarray, "*n"] | np.float64:
        ends = np.array([self.at_zero, self.at_one])
        if self.logarithmic:
            # Ratios matter for counts and pixels, differences for correlations.
            value, ends = np.log(np.maximum(value, 1e-6)), np.log(ends)
        return np.clip((np.asarray(value) - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)

    def value_at(self, scaled: float) -> float:
        """Return the signal that is mapped to this number."""
        if self.logarithmic:
            return float(self.at_zero * (self.at_one / self.at_zero) ** scaled)
        return self.at_zero + scaled * (self.at_one - self.at_zero)


@dataclass(frozen=True, slots=True)
class Logistic:
    """log odds = bias + sum of weight times scaled signal."""

    bias: float
    weights: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class HandSetFloor:
    """A floor that the samples of the fit don't determine."""

    floor: float
    """In the signal's unit."""
    reason: str


@dataclass(frozen=True, slots=True)
class FloorException:
    """When floors of some signals don't hold: the others are above floors of this exception."""

    ignored: tuple[str, ...]
    """Signals whose own floors then don't hold."""
    floors: Mapping[str, float]
    """Of the others, in the signals' units."""
    reason: str


@dataclass(frozen=True, slots=True)
class GateModel:
    """Weights, floors and scales by the signals' names, and what they were fitted on."""

    scales: Mapping[str, Scale]
    with_matches: Logistic
    """Its signals are those of pixels and of matches."""
    photometric: Logistic
    """Its signals are those of pixels alone."""
    floors: Mapping[str, float]
    """In the signals' units; for a signal whose scale descends, a ceiling. Includes those that were set by hand."""
    set_by_hand: Mapping[str, HandSetFloor] = field(default_factory=dict)
    """Floors that a fit keeps, by the signals' names."""
    other_light: FloorException | None = None
    """For colours, where the light may be another than the scene's. Exceptions are kept by a fit, too; None: there is
    none."""
    poor_model: FloorException | None = None
    """For colours that are nearly right, with less support than those of another light need: the scene's model is poor
    there. Where the light may be another, too."""
    less_detail: FloorException | None = None
    """For gradients: a photo that was enlarged after it was cropped, or is sharper than the scene's model."""
    fitted_on: Mapping[str, Any] = field(default_factory=dict)
    """Scenes with their hashes and photos, and counts of right and wrong poses."""

    def probability(self, signals: Mapping[str, float]) -> float:
        """Return how probably a pose with these signals is right, 0..1; without signals of matches by the others."""
        # Verification by the pixels alone has a model of its own.
        model = self.with_matches if self.with_matches.weights.keys() <= signals.keys() else self.photometric
        logit = model.bias + sum(weight * self.scales[name](signals[name]) for name, weight in model.weights.items())
        return float(1.0 / (1.0 + np.exp(-logit)))

    def below_floor(self, signals: Mapping[str, float], light_may_differ: bool = False) -> list[str]:
        """Return the names of the signals that are below their floors.

        The exceptions `other_light` and `poor_model` are made with `light_may_differ` only.
        """
        below = self._below(signals, self.floors)
        of_colours = (self.other_light, self.poor_model) if light_may_differ else ()
        for exception in (*of_colours, self.less_detail):
            if exception and exception.floors.keys() <= signals.keys() and not self._below(signals, exception.floors):
                below = [name for name in below if name not in exception.ignored]
        return below

    def _below(self, signals: Mapping[str, float], floors: Mapping[str, float]) -> list[str]:
        scales = self.scales
        return [n for n, value in signals.items() if n in floors and scales[n](value) < scales[n](floors[n])]


def model_from_json(content: Mapping[str, Any]) -> GateModel:
    """Return the model that a file's content describes. Raises ValueError if it is of another version."""
    if content["version"] != FORMAT_VERSION:
        raise ValueError(f"the gate's model has version {content['version']}, this code reads {FORMAT_VERSION}")
    set_by_hand = {name: HandSetFloor(**entry) for name, entry in content["set_by_hand"].items()}
    return GateModel(
        scales=MappingProxyType({name: Scale(**scale) for name, scale in content["scales"].items()}),
        with_matches=_logistic(content["with_matches"]),
        photometric=_logistic(content["photometric"]),
        floors=MappingProxyType(content["floors"] | {name: entry.floor for name, entry in set_by_hand.items()}),
        set_by_hand=MappingProxyType(set_by_hand),
        other_light=_exception(content["other_light"]),
        poor_model=_exception(content["poor_model"]),
        less_detail=_exception(content["less_detail"]),
        fitted_on=MappingProxyType(content["fitted_on"]),
    )


def _logistic(content: Mapping[str, Any]) -> Logistic:
    return Logistic(content["bias"], MappingProxyType(content["weights"]))


def _exception(content: Mapping[str, Any] | None) -> FloorException | None:
    if content is None:
        return None
    return FloorException(tuple(content["ignored"]), MappingProxyType(content["floors"]), content["reason"])


def _exception_to_json(exception: FloorException | None) -> dict[str, Any] | None:
    if exception is None:
        return None
    return {
        "ignored": list(exception.ignored),
        "floors": dict(exception.floors),
        "reason": exception.reason,
    }


def model_to_json(model: GateModel) -> dict[str, Any]:
    """Return the content of a file that describes the model."""
    return {
        "version": FORMAT_VERSION,
        "fitted_on": dict(model.fitted_on),
        "scales": {
            name: {"at_zero": scale.at_zero, "at_one": scale.at_one, "logarithmic": scale.logarithmic}
            for name, scale in model.scales.items()
        },
        "with_matches": {"bias": model.with_matches.bias, "weights": dict(model.with_matches.weights)},
        "photometric": {"bias": model.photometric.bias, "weights": dict(model.photometric.weights)},
        # Each floor stands in one place only, so that the two can't contradict one another.
        "floors": {name: floor for name, floor in model.floors.items() if name not in model.set_by_hand},
        "set_by_hand": {name: asdict(entry) for name, entry in model.set_by_hand.items()},
        "other_light": _exception_to_json(model.other_light),
        "poor_model": _exception_to_json(model.poor_model),
        "less_detail": _exception_to_json(model.less_detail),
    }


def load_model(path: Path = MODEL_FILE) -> GateModel:
    """Read a model."""
    return model_from_json(json.loads(path.read_text("utf-8")))


def write_model(model: GateModel, path: Path) -> None:
    """Write a model."""
    path.write_text(json.dumps(model_to_json(model), indent=2) + "\n", encoding="utf-8")


# Read once, when the module is imported.
SHIPPED_MODEL = load_model()
