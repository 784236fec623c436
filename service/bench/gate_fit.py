"""The fit of the verification gate's model to samples of right and wrong poses, and its test.

Weights and floors are fitted on all scenes but one and tested on that one, for each in turn (with a single scene, on
three quarters of its photos and tested on the rest); the counts are of those tests. The model itself is fitted on all.
Floors are of right poses of photos degraded within reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from service.pose.verification.gate import VERIFICATION
from service.pose.verification.gate_model import GateModel, Logistic


@dataclass(frozen=True, slots=True)
class FitConfig:
    """How the model is fitted."""

    penalty: float = 0.02
    """On the squared weights, for a hundred samples: keeps few samples from giving certainty."""
    below_floor: float = 0.003
    """Share of the right poses that are below a signal's floor: with nine or ten floors at most 3 % in all."""
    bins: int = 10
    """Of the reliability diagram."""
    photo_folds: int = 4
    """Of a single scene."""
    max_iterations: int = 100
    max_step: float = 5.0
    """Of a weight, in one of Newton's steps."""


FIT = FitConfig()


@dataclass(frozen=True, slots=True)
class Sample:
    """The gate's signals at one pose, and whether the pose is right."""

    scene: str
    kind: str
    photo: str
    right: bool
    signals: Mapping[str, float]
    doubted: bool
    """For another reason than the signals: never localized."""
    nees: float | None
    tracked: bool | None = None
    """Whether the tracker accepts the pose by its pixels alone; None: it wasn't tracked."""
    matched: bool = False
    """Whether many matches with a view led there: then the pixels alone may decide."""


@dataclass(frozen=True, slots=True)
class _Table:
    """The samples as arrays."""

    right: Bool[np.ndarray, "n"]
    doubted: Bool[np.ndarray, "n"]
    """What is refused for another reason is not for the signals to decide."""
    usual: Bool[np.ndarray, "n"]
    """Right, and of a photo degraded within reason: what floors are of."""
    matched: Bool[np.ndarray, "n"]
    kinds: np.ndarray
    folds: Int64[np.ndarray, "n"]

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> _Table:
        right, kinds = np.array([s.right for s in samples]), np.array([s.kind for s in samples])
        # Photos degraded beyond reason may be refused: they don't lower the floors.
        usual = right & ~np.char.startswith(kinds, "beyond")
        matched, doubted = np.array([s.matched for s in samples]), np.array([s.doubted for s in samples])
        return cls(right, doubted, usual, matched, kinds, _folds(samples))


def _folds(samples: Sequence[Sample]) -> Int64[np.ndarray, "n"]:
    """Return each sample's fold: its scene, or, where there is only one, a group of its photos."""
    scenes = np.unique([s.scene for s in samples], return_inverse=True)[1]
    if scenes.max(initial=0) > 0:
        return scenes
    return np.unique([s.photo for s in samples], return_inverse=True)[1] % FIT.photo_folds


def fit_model(samples: Sequence[Sample], shape: GateModel, data: Mapping[str, Any]) -> GateModel:
    """Return a model fitted on all samples; `shape` has the scales, the signals of each part, and floors set by hand.

    Those floors are kept: the samples have too few of the poses that they exclude.
    `data` describes what the samples come from; the counts of poses are added to it.
    """
    samples = [sample for sample in samples if sample.tracked is None]
    table = _Table.of(samples)
    parts, ends = {}, {}
    for name, part in (("photometric", shape.photometric), ("with_matches", shape.with_matches)):
        features = scaled(samples, part, shape)
        weights = fitted(features[~table.doubted], table.right[~table.doubted])
        # The model file is read by people, and more digits mean nothing.
        bias, *rest = np.round(weights, 2).tolist()
        parts[name] = Logistic(bias, dict(zip(part.weights, rest, strict=True)))
        lowest = floors(features[table.usual])[1:]
        ends |= {n: round(shape.scales[n].value_at(f), 3) for n, f in zip(part.weights, lowest, strict=True)}
    ends |= {name: entry.floor for name, entry in shape.set_by_hand.items()}
    counts = {"poses": len(samples), "right": int(table.right.sum()), "doubted": int(table.doubted.sum())}
    fitted_on = {**data, **counts}
    return replace(
        shape, with_matches=parts["with_matches"], photometric=parts["photometric"], floors=ends, fitted_on=fitted_on
    )


def summary(samples: Sequence[Sample], shape: GateModel) -> dict[str, Any]:
    """Return what models say of the scenes, or photos, that they were not fitted on."""
    result: dict[str, Any] = {"tracked": _tracked_counts([s for s in samples if s.tracked is not None])}
    samples = [sample for sample in samples if sample.tracked is None]
    table = _Table.of(samples)
    photometric = _tested(scaled(samples, shape.photometric, shape), table)
    with_matches = _tested(scaled(samples, shape.with_matches, shape), table)
    # As the estimator asks: matches only where the pixels alone don't suffice.
    sufficient = table.matched & (photometric >= VERIFICATION.min_localized)
    with_matches = np.where(sufficient, np.maximum(photometric, with_matches), with_matches)
    for name, tested in (("photometric", photometric), ("with_matches", with_matches)):
        result[name] = {
            **_counts(tested, table.right, table.kinds, table.doubted),
            "reliability": _reliability(tested, table.right),
        }
    return result


def _tested(features: Float64[np.ndarray, "n k"], table: _Table) -> Float64[np.ndarray, "n"]:
    """Return each sample's score by the model that was fitted on the other folds."""
    tested = np.zeros(len(features))
    for fold in np.unique(table.folds):
        here = table.folds == fold
        others = ~here & ~table.doubted
        weights, floor = fitted(features[others], table.right[others]), floors(features[~here & table.usual])
        # As in the gate: floors cap the score.
        doubtful = (features[here] < floor).any(1)
        score = probabilities(features[here], weights)
        tested[here] = np.minimum(score, np.where(doubtful, VERIFICATION.doubtful_score, 1.0))
    return tested


def _tracked_counts(samples: Sequence[Sample]) -> dict[str, int]:
    """Return how many right and wrong poses the tracker accepts by their pixels alone."""
    right, wrong = [s for s in samples if s.right], [s for s in samples if not s.right]
    return {
        "right": len(right),
        "right_localized": sum(bool(s.tracked) for s in right),
        "wrong": len(wrong),
        "wrong_localized": sum(bool(s.tracked) for s in wrong),
    }


def scaled(samples: Sequence[Sample], part: Logistic, shape: GateModel) -> Float64[np.ndarray, "n k"]:
    """Return the samples' scaled signals in the order of the part's weights; the first column is 1, for the bias."""
    columns = [np.ones(len(samples))]
    columns += [shape.scales[name](np.array([s.signals[name] for s in samples])) for name in part.weights]
    return np.stack(columns, 1)


def probabilities(features: Float64[np.ndarray, "n k"], weights: Float64[np.ndarray, "k"]) -> Float64[np.ndarray, "n"]:
    """Return the logistic model's values."""
    return 1.0 / (1.0 + np.exp(-np.clip(features @ weights, -50, 50)))


def fitted(features: Float64[np.ndarray, "n k"], right: Bool[np.ndarray, "n"]) -> Float64[np.ndarray, "k"]:
    """Return the penalized maximum-likelihood weights, none negative but the bias; both classes weigh alike.

    By Newton's steps on the free weights; one that would turn negative is fixed at 0.
    """
    weights = np.zeros(features.shape[1])
    # How many there are of each is the choice of the bench, so both classes have the same total weight.
    each = np.where(right, 0.5 / max(right.sum(), 1), 0.5 / max((~right).sum(), 1)) * len(right)
    penalty = FIT.penalty * np.r_[0.0, np.ones(features.shape[1] - 1)] * len(right) / 100
    free = np.ones(len(weights), bool)
    for _ in range(FIT.max_iterations):
        p = probabilities(features, weights)
        gradient = features.T @ (each * (right - p)) - penalty * weights
        hessian = (features * (each * p * (1 - p))[:, None]).T @ features + np.diag(penalty + 1e-9)
        step = np.zeros_like(weights)
        step[free] = np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
        weights = weights + step * min(1.0, FIT.max_step / max(np.abs(step).max(), 1e-9))
        # A negative weight would mean that a better signal speaks against the pose.
        below = np.r_[False, weights[1:] < 0]
        weights[below], free[below] = 0.0, False
        if np.abs(step).max() < 1e-6:
            break
    return weights


def floors(features: Float64[np.ndarray, "n k"]) -> Float64[np.ndarray, "k"]:
    """Return what nearly all of these right poses' scaled signals stay above."""
    return np.quantile(features, FIT.below_floor, axis=0)


def _counts(
    tested: Float64[np.ndarray, "n"],
    right: Bool[np.ndarray, "n"],
    kinds: np.ndarray,
    doubted: Bool[np.ndarray, "n"],
) -> dict[str, Any]:
    """Return how many of each kind are called localized, apart from those that are in doubt for other reasons."""
    called = (tested >= VERIFICATION.min_localized) & ~doubted
    # They have no right pose, so they are counted apart from wrong poses.
    nothing = np.isin(kinds, ["foreign", "garbage"])
    wrong = ~right & ~nothing
    return {
        "foreign_or_garbage": int(nothing.sum()),
        "foreign_or_garbage_localized": int((called & nothing).sum()),
        "wrong": int(wrong.sum()),
        "wrong_localized": int((called & wrong).sum()),
        "right": int(right.sum()),
        "right_localized": int((called & right).sum()),
        "by_kind": {
            str(kind): {
                "right": int((right & (kinds == kind)).sum()),
                "right_localized": int((called & right & (kinds == kind)).sum()),
                "wrong": int((~right & (kinds == kind)).sum()),
                "wrong_localized": int((called & ~right & (kinds == kind)).sum()),
            }
            for kind in np.unique(kinds)
        },
    }


def _reliability(tested: Float64[np.ndarray, "n"], right: Bool[np.ndarray, "n"]) -> list[dict[str, float]]:
    """Return, for equal intervals of the probability, what was said and what came true."""
    bins = np.minimum((tested * FIT.bins).astype(int), FIT.bins - 1)
    return [
        {
            "from": k / FIT.bins,
            "to": (k + 1) / FIT.bins,
            "count": int((bins == k).sum()),
            "said": float(tested[bins == k].mean()),
            "true": float(right[bins == k].mean()),
        }
        for k in range(FIT.bins)
        if (bins == k).any()
    ]
