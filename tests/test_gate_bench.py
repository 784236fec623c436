"""The bench of the gate: its fit against planted weights, its counts by hand, its pictures of nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.bench.gate import GARBAGE, unrelated_image
from service.bench.gate_fit import Sample, fit_model, fitted, probabilities, summary
from service.pose.verification.gate import VERIFICATION
from service.pose.verification.gate_model import MODEL_FILE, SHIPPED_MODEL, load_model, write_model


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


def scene_samples(scene: str, photos: int, rng: np.random.Generator) -> list[Sample]:
    return [
        replace(sample(scene, kind, right, level), photo=str(number))
        for number in range(photos)
        for kind, right, low, high in (("clean", True, 0.8, 1.0), ("moved", False, 0.0, 0.3))
        for level in rng.uniform(low, high, 10)
    ]


def test_the_model_of_a_single_scene_is_tested_on_photos_that_were_left_out(tmp_path: Path) -> None:
    samples = scene_samples("a", 8, np.random.default_rng(2))
    assert summary(samples, SHIPPED_MODEL)["photometric"]["wrong_localized"] == 0
    model = fit_model(samples, SHIPPED_MODEL, {"scenes": [{"name": "a", "sha256": "0", "photos": 8}]})
    assert (model.fitted_on["poses"], model.fitted_on["right"], model.fitted_on["scenes"][0]["photos"]) == (160, 80, 8)
    # The file says the same, and a signal below the floors of right poses is in doubt.
    write_model(model, tmp_path / "model.json")
    read = load_model(tmp_path / "model.json")
    right, wrong = (sample("a", "clean", True, level).signals for level in (0.97, 0.1))
    for signals in (right, wrong):
        assert read.probability(signals) == model.probability(signals)
        assert read.below_floor(signals) == model.below_floor(signals)
    assert read.probability(wrong) < 0.5 < read.probability(right)
    assert read.below_floor(right) == []
    assert set(read.below_floor(wrong)) == set(SHIPPED_MODEL.scales)


def test_floors_set_by_hand_survive_a_fit(tmp_path: Path) -> None:
    """A level of 0.8 and more would give each signal a floor near 0.8; the shipped one of local colour is higher."""
    samples = scene_samples("a", 4, np.random.default_rng(4))
    model = fit_model(samples, SHIPPED_MODEL, {})
    by_hand, fitted_freely = "local_colour_correlation", "colours"
    assert model.floors[by_hand] == SHIPPED_MODEL.floors[by_hand] == 0.935
    assert model.floors[fitted_freely] != SHIPPED_MODEL.floors[fitted_freely]
    # Without the mark the fit determines this floor, too.
    unmarked = fit_model(samples, replace(SHIPPED_MODEL, set_by_hand={}), {})
    assert unmarked.floors[by_hand] < 0.92
    # The file keeps the mark, and so does a fit from it.
    write_model(model, tmp_path / "model.json")
    read = load_model(tmp_path / "model.json")
    assert fit_model(samples, read, {}).floors == read.floors == model.floors
    assert "mistake a thing for a similar one" in read.set_by_hand[by_hand].reason


def test_colours_count_unless_matches_and_gradients_support_another_light(tmp_path: Path) -> None:
    right = sample("a", "clean", True, 0.97).signals
    in_other_light = {**right, "colours": 0.1, "colours_half": 0.2, "local_colour_correlation": 0.4}
    colours = ["colours", "colours_half", "local_colour_correlation"]
    assert SHIPPED_MODEL.below_floor(in_other_light) == colours
    assert SHIPPED_MODEL.below_floor(in_other_light, light_may_differ=True) == []
    for name, value in {"inliers": 80.0, "inlier_share": 0.55, "inlier_spread": 0.45, "gradients_half": 0.88}.items():
        weaker = {**in_other_light, name: value}
        assert set(SHIPPED_MODEL.below_floor(weaker, light_may_differ=True)) >= set(colours)
    # Other doubts remain, and without matches there is no support.
    assert SHIPPED_MODEL.below_floor({**in_other_light, "drift_px": 15.0}, light_may_differ=True) == ["drift_px"]
    alone = {name: value for name, value in in_other_light.items() if not name.startswith("inlier")}
    assert SHIPPED_MODEL.below_floor(alone, light_may_differ=True) == colours
    # A fit keeps the rule, and so does its file.
    write_model(fit_model(scene_samples("a", 4, np.random.default_rng(4)), SHIPPED_MODEL, {}), tmp_path / "m.json")
    read, ours = load_model(tmp_path / "m.json"), SHIPPED_MODEL
    assert (read.other_light, read.less_detail) == (ours.other_light, ours.less_detail)
    assert read.poor_model == ours.poor_model


def test_less_support_is_enough_for_colours_that_are_nearly_right() -> None:
    right = sample("a", "clean", True, 0.97).signals
    support = {"inliers": 210.0, "inlier_share": 0.56, "inlier_spread": 0.7, "gradients_half": 0.87}
    nearly = {**right, **support, "colours_half": 0.92, "local_colour_correlation": 0.82}
    assert SHIPPED_MODEL.below_floor(nearly) == ["local_colour_correlation"]
    assert SHIPPED_MODEL.below_floor(nearly, light_may_differ=True) == []
    less = {"inliers": 190.0, "inlier_share": 0.54, "inlier_spread": 0.55, "gradients_half": 0.84}
    for name, value in (less | {"colours_half": 0.88, "local_colour_correlation": 0.78}).items():
        assert "local_colour_correlation" in SHIPPED_MODEL.below_floor({**nearly, name: value}, light_may_differ=True)


def test_gradients_count_unless_matches_and_colours_support_the_pose() -> None:
    """An enlarged crop is blurred: its gradients hardly correlate, all else agrees."""
    right = sample("a", "clean", True, 0.97).signals
    blurred = {**right, "gradients": 0.5, "gradients_half": 0.75, "inliers": 400.0}
    assert SHIPPED_MODEL.below_floor(blurred) == []
    gradients = {"gradients", "gradients_half"}
    weaker = {"inliers": 150.0, "inlier_share": 0.6, "inlier_spread": 0.5, "colours_half": 0.9}
    for name, value in {**weaker, "local_colour_correlation": 0.95}.items():
        assert gradients <= set(SHIPPED_MODEL.below_floor({**blurred, name: value}))
    alone = {name: value for name, value in blurred.items() if not name.startswith("inlier")}
    assert set(SHIPPED_MODEL.below_floor(alone)) == gradients


def test_a_photo_that_always_fails_moves_only_its_own_fold() -> None:
    """Were the test on the samples of the fit, the odd photo's right poses would lower the floors and pass."""
    rng = np.random.default_rng(3)
    samples = scene_samples("a", 8, rng)
    odd = [replace(sample("a", "clean", True, 0.6), photo="0") for _ in range(4)]
    found = summary(samples + odd, SHIPPED_MODEL)["with_matches"]
    assert found["right"] - found["right_localized"] >= len(odd)


def test_a_model_of_another_version_is_refused(tmp_path: Path) -> None:
    content = json.loads(MODEL_FILE.read_text())
    (tmp_path / "model.json").write_text(json.dumps(content | {"version": 99}))
    with pytest.raises(ValueError, match="version 99"):
        load_model(tmp_path / "model.json")


def test_pictures_of_nothing_are_pictures_and_differ() -> None:
    pictures = [unrelated_image(number) for number in range(GARBAGE)]
    assert all(p.shape == (480, 640, 3) and p.dtype == np.float32 for p in pictures)
    assert all(p.min() >= 0 and p.max() <= 1 for p in pictures)
    means = np.array([[p.mean(), p.std(), np.abs(np.diff(p, axis=1)).mean()] for p in pictures])
    assert len(np.unique(means.round(4), axis=0)) == GARBAGE
