"""The bench of the gate: its fit against planted weights, its counts by hand, its pictures of nothing."""

from __future__ import annotations

import numpy as np
import pytest

from service.bench.gate import GARBAGE, garbage
from service.bench.gate_fit import Sample, fitted, probabilities, summary
from service.pose.verification.gate import VERIFICATION
from service.pose.verification.model import SHIPPED_MODEL


def test_the_fit_finds_planted_weights_and_no_negative_ones() -> None:
    rng = np.random.default_rng(0)
    features = np.concatenate([np.ones((20_000, 1)), rng.uniform(size=(20_000, 3))], 1)
    planted = np.array([-2.0, 3.0, 1.0, -2.0])
    right = rng.uniform(size=len(features)) < probabilities(features, planted)
    # Both classes weigh alike: that shifts the bias alone.
    found = fitted(features[:, :3], rng.uniform(size=len(features)) < probabilities(features[:, :3], planted[:3]))
    assert found[1:] == pytest.approx([3.0, 1.0], abs=0.25)
    assert fitted(features, right)[3] == 0


def sample(scene: str, kind: str, right: bool, level: float, doubted: bool = False) -> Sample:
    signals = {
        name: scale.at_zero + level * (scale.at_one - scale.at_zero) for name, scale in SHIPPED_MODEL.scales.items()
    }
    return Sample(scene, kind, "p", right, signals, doubted, None)


def test_counts_are_of_scenes_that_were_left_out() -> None:
    rng = np.random.default_rng(1)
    samples = []
    for scene in ("a", "b", "c"):
        samples += [sample(scene, "clean", True, level) for level in rng.uniform(0.8, 1.0, 60)]
        samples += [sample(scene, "moved", False, level) for level in rng.uniform(0.0, 0.3, 60)]
        samples += [sample(scene, "foreign", False, 0.0) for _ in range(20)]
        samples += [sample(scene, "garbage", False, 1.0, doubted=True)]  # a doubt keeps it from being called localized
    found = summary(samples, SHIPPED_MODEL)["with_matches"]
    assert (found["right"], found["wrong"], found["foreign_or_garbage"]) == (180, 180, 63)
    assert (found["wrong_localized"], found["foreign_or_garbage_localized"]) == (0, 0)
    assert found["right_localized"] > 120
    assert sum(row["count"] for row in found["reliability"]) == len(samples)
    top = found["reliability"][-1]
    assert VERIFICATION.min_localized < top["said"] <= 1
    assert found["by_kind"]["clean"]["right"] == 180


def test_pictures_of_nothing_are_pictures_and_differ() -> None:
    pictures = [garbage(number) for number in range(GARBAGE)]
    assert all(p.shape == (480, 640, 3) and p.dtype == np.float32 for p in pictures)
    assert all(p.min() >= 0 and p.max() <= 1 for p in pictures)
    means = np.array([[p.mean(), p.std(), np.abs(np.diff(p, axis=1)).mean()] for p in pictures])
    assert len(np.unique(means.round(4), axis=0)) == GARBAGE
