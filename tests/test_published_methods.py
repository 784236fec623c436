"""What the published methods' own schedules do in each step, with a loss and matches that are planted."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from service.errors import InvalidOptions
from service.estimators import icomma, inerf, mc_do, pnerf
from service.geometry import pose_distance
from service.pose.descent.losses import interest_region, loss_against
from service.pose.features.scene_focus import Focus
from service.pose.matching.correspondences import Correspondences
from service.results import IterationRecord
from service.types import Intrinsics, Pose, Query

LENS = Intrinsics(64, 64, 60.0, 60.0, 32.0, 32.0)
PRIOR = Pose(np.eye(4))
FOCUS = Focus(np.array([0.0, 0.0, 8.0]), 8.0, False)
"""A scene unit is half a normalized unit."""
TWIST = np.array([1.0, -2.0, 3.0, -4.0, 5.0, -6.0])


class RecordedAdam:
    """Steps by nothing, and tells with which rate and gradient."""

    def __init__(self, size: int, rate: float) -> None:
        self.rate = rate
        SEEN.append(self)
        self.steps: list[tuple[float, np.ndarray]] = []

    def step(self, gradient: np.ndarray) -> np.ndarray:
        self.steps.append((self.rate, gradient))
        return np.zeros(6)


SEEN: list[RecordedAdam] = []


@pytest.fixture
def stepped(monkeypatch: pytest.MonkeyPatch):
    """`run` an estimator whose loss is 0.5 everywhere; return its records, rates and gradients."""

    def run(estimator: Any, prepared: Any = FOCUS, seed: int = 0, **options: Any):
        SEEN.clear()
        monkeypatch.setattr(estimator, "Adam", RecordedAdam, raising=False)
        monkeypatch.setattr(estimator, "loss_and_gradient", lambda *_: (0.5, TWIST), raising=False)
        losses = lambda _, __, poses, ___: [(0.5, TWIST)] * len(poses)  # noqa: E731
        monkeypatch.setattr(estimator, "losses_and_gradients", losses, raising=False)
        query = Query(np.full((64, 64, 3), 128, np.uint8), LENS, "given", LENS, prior=PRIOR)
        rng = np.random.default_rng(seed)
        tools = SimpleNamespace(prepared=prepared, rng=rng, rasterizer=None, matcher=None, image_matcher=None)
        records = list(estimator.run(query, tools, estimator.Options(**options)))
        rates, gradients = zip(*SEEN[0].steps, strict=True) if SEEN and SEEN[0].steps else ((), ())
        return records, list(rates), list(gradients)

    return run


def test_inerfs_rate_falls_to_four_fifths_in_a_hundred_steps(stepped) -> None:
    records, rates, _ = stepped(inerf, steps=201, rays=0)
    assert rates == pytest.approx([0.05 * 0.8 ** (step / 100) for step in range(201)])
    assert [record.stage for record in records] == ["start", *["descend"] * 201]
    assert {record.loss for record in records[1:]} == {0.5}


@pytest.mark.parametrize(("distances", "off_at"), [((0.01, 0.0011, 0.0009), 2), ((0.001,) * 9, None)])
def test_icommas_matches_count_four_fifths_until_they_are_close_then_the_rate_falls(
    stepped, monkeypatch: pytest.MonkeyPatch, distances, off_at
) -> None:
    left, asked = itertools.chain(distances, itertools.repeat(distances[-1])), []
    none = Correspondences(*(np.zeros((0, size), np.float32) for size in (2, 2, 3)))

    def rematch(camera, images, tools, least):
        asked.append(least)
        return none, IterationRecord("match", camera.pose)

    monkeypatch.setattr(icomma, "_rematch", rematch)
    monkeypatch.setattr(icomma, "match_loss", lambda *_: (next(left), -TWIST))
    # Gradients by the twist are what Adam gets.
    monkeypatch.setattr(icomma.Se3, "gradient", lambda self, xi, twist: twist)
    records, rates, gradients = stepped(icomma, steps=9)
    count = 9 if off_at is None else off_at + 1
    assert asked == [5] * count
    assert [record.stage for record in records[1:]] == ["match"] * count + ["compare"] * (9 - count)
    expected = [0.8 * distance + 0.2 * 0.5 for distance in distances[:count]] + [0.5] * (9 - count)
    assert [record.loss for record in records[1:]] == pytest.approx(expected)
    for step, gradient in enumerate(gradients):
        assert gradient == pytest.approx((-0.8 + 0.2) * TWIST if step < count else TWIST)
    # From the step that ends matching on: 0.6 in 50 steps.
    since = 9 if off_at is None else off_at
    assert rates == pytest.approx([0.05 * 0.6 ** (max(0, step - since + 1) / 50) for step in range(9)])


@pytest.mark.parametrize(("kept", "enough"), [(5, True), (4, False)])
def test_icomma_needs_five_matches(monkeypatch: pytest.MonkeyPatch, kept: int, enough: bool) -> None:
    found = Correspondences(*(np.zeros((8, size), np.float32) for size in (2, 2, 3)))
    monkeypatch.setattr(icomma, "render_and_match", lambda *_: iter([(found, SimpleNamespace(camera=None))]))
    monkeypatch.setattr(icomma, "epipolar_inliers", lambda *_: np.arange(8) < kept)
    monkeypatch.setattr(icomma, "match_record", lambda *_: IterationRecord("match", PRIOR))
    images = SimpleNamespace(query=SimpleNamespace(intrinsics=LENS))
    tools = SimpleNamespace(rasterizer=None, image_matcher=None)
    matches, _ = icomma._rematch(SimpleNamespace(pose=PRIOR), images, tools, icomma.ICOMMA.min_matches)  # type: ignore[arg-type]
    assert (matches is not None) is enough
    assert matches is None or len(matches.photo_px) == kept


def test_pnerfs_rates_fall_to_a_third_in_256_steps_for_rotation_and_translation(
    stepped, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates = []
    monkeypatch.setattr(pnerf._Hypothesis, "update", lambda self, loss, twist, each: rates.append(each))
    stepped(pnerf, hypotheses=1, steps=257, long_side_px=32)
    assert rates[0] == pytest.approx([5e-3] * 3 + [3e-3] * 3)
    assert rates[128] == pytest.approx(0.33**0.5 * rates[0])
    assert rates[256] == pytest.approx(0.33 * rates[0])


def test_pnerf_draws_around_the_prior_and_then_around_the_best(stepped) -> None:
    records, _, _ = stepped(pnerf, hypotheses=64, steps=33, resample_every=32, long_side_px=32)
    shown = [step for step, record in enumerate(records[1:]) if record.candidates is not None]
    assert shown == [0, 16, 32]  # hypotheses of every 16th step are recorded
    first = records[1].candidates
    assert first is not None
    assert np.array_equal(first.world_from_camera[0], PRIOR.world_from_camera)
    away = np.array([pose_distance(Pose(matrix), PRIOR) for matrix in first.world_from_camera[1:]])
    # 15 degrees and 0.3 normalized units, 0.6 scene units, an axis.
    assert 15 < away[:, 0].max() <= 15 * np.sqrt(3)
    shifts = np.abs(first.world_from_camera[1:, :3, 3])
    assert 0.58 < shifts.max() <= 0.6
    # Of equal losses the first are kept: a quarter, halved in each round; the others are drawn around these in turn.
    second = records[33].candidates
    assert second is not None
    kept = 8
    assert np.array_equal(second.world_from_camera[:kept], first.world_from_camera[:kept])
    for number in range(kept, 64):
        parent = Pose(second.world_from_camera[(number - kept) % kept])
        child = Pose(second.world_from_camera[number])
        assert pose_distance(child, parent)[0] <= 3 * np.sqrt(3)
        assert np.abs(child.position_in_world - parent.position_in_world).max() <= 0.2
    turned = [
        pose_distance(Pose(second.world_from_camera[n]), Pose(second.world_from_camera[n % 8])) for n in range(8, 64)
    ]
    assert max(turned)[0] > 3


@pytest.mark.parametrize(("count", "number", "kept"), [(64, 1, 8), (64, 2, 4), (64, 3, 4), (256, 3, 8), (3, 1, 3)])
def test_pnerf_keeps_a_quarter_halved_in_each_round_and_four_at_least(count: int, number: int, kept: int) -> None:
    tools = SimpleNamespace(prepared=FOCUS, rng=np.random.default_rng(0))
    hypotheses = [pnerf._Hypothesis(PRIOR, FOCUS) for _ in range(count)]
    for i, hypothesis in enumerate(hypotheses):
        hypothesis.loss = float((7 * i) % count)
    found = pnerf._resampled(hypotheses, number, tools, pnerf.PNERF)  # type: ignore[arg-type]
    assert len(found) == count
    assert [each.loss for each in found[:kept]] == list(range(kept))
    assert all(np.isinf(each.loss) for each in found[kept:])


# ------------------------------------------------------------------ the Monte Carlo stage


@pytest.fixture
def sampled(monkeypatch: pytest.MonkeyPatch):
    """`run` the Monte Carlo stage with planted supports; return its records and how each round was drawn."""

    def run(supports: list[float], prior: bool = True, **options: Any):
        left, drawn = iter(supports), []

        def around(parents, focus, degrees, share, count, rng):
            drawn.append((len(parents), degrees, share, count))
            return [PRIOR] * count

        def scores(poses, images, tools, options, scored):
            turned = Pose(np.diag([1.0, -1, -1, 1]))
            for pose in poses:
                support = next(left)
                solved = SimpleNamespace(support=support, pose=turned) if support >= 0 else None
                scored.append(mc_do._Hypothesis(pose, solved))  # type: ignore[arg-type]
                yield IterationRecord("hypothesis", pose)

        monkeypatch.setattr(mc_do, "around", around)
        monkeypatch.setattr(mc_do, "_scores", scores)
        query = Query(np.zeros((64, 64, 3), np.uint8), LENS, "given", LENS, prior=PRIOR if prior else None)
        tools = SimpleNamespace(prepared=mc_do.Prepared(FOCUS, None, (PRIOR,) * 5), rng=None, matcher=None)  # type: ignore[arg-type]
        chosen = mc_do.Options(iterations=0, refinement_steps=0, **options)
        return list(mc_do.run(query, tools, chosen)), drawn, list(left)  # type: ignore[arg-type]

    return run


def test_rounds_shrink_around_the_eight_best(sampled) -> None:
    records, drawn, left = sampled([*range(1, 60), *[0.0] * 5, *[2.0] * 99], hypotheses=64)
    # Each later round: the solutions of the eight best, and an eighth of the first one's hypotheses.
    assert drawn == [(1, 60.0, 0.25, 64), (8, pytest.approx(18.0), pytest.approx(0.075), 8),
                     (8, pytest.approx(5.4), pytest.approx(0.0225), 8)]  # fmt: skip
    assert len(left) == 99 - 2 * 16
    rounds = [record for record in records if record.stage == "sample_poses"]
    assert [len(record.candidates.scores) for record in rounds] == [64, 64, 64]  # the best 64 are listed
    assert rounds[-1].candidates.scores.max() == 59
    many = sampled([1.0] * 400, hypotheses=128, rounds=1)
    assert many[1][1][3] == 16


def test_without_a_prior_rounds_are_drawn_around_the_scenes_viewpoints(sampled) -> None:
    _, drawn, _ = sampled([1.0] * 40, prior=False, hypotheses=8)
    assert drawn[0] == (5, 10.0, 0.05, 8)
    assert sampled([1.0] * 40, hypotheses=8, around="scene")[1][0] == (5, 10.0, 0.05, 8)


@pytest.mark.parametrize(("support", "ends"), [(60.0, False), (60.5, True)])
def test_a_support_of_more_than_sixty_ends_the_search(sampled, support: float, ends: bool) -> None:
    records, drawn, _ = sampled([3.0, support, *[5.0] * 99], hypotheses=8)
    assert (len(drawn) == 1) is ends
    assert sum(record.stage == "hypothesis" for record in records) == (2 if ends else 8 + 2 * 16)
    assert np.array_equal(records[-1].pose.world_from_camera, PRIOR.world_from_camera)


def test_nothing_is_drawn_around_what_matched_nowhere(sampled) -> None:
    _, drawn, _ = sampled([-1.0] * 20, hypotheses=8)
    assert len(drawn) == 1


# ------------------------------------------------------------------ losses, by their definitions


def spots(size: int) -> np.ndarray:
    """White squares on black: their corners are where features are."""
    photo = np.zeros((size, size, 3), np.uint8)
    photo[size // 4 : size // 4 + 12, size // 4 : size // 4 + 12] = 255
    return photo


@pytest.mark.parametrize("off", [0.1, -0.2])
def test_each_loss_of_an_even_difference_is_its_definition(off: float) -> None:
    photo = np.full((40, 40, 3), 128, np.uint8)
    target = np.float32(128) / np.float32(255)
    render = np.full((40, 40, 3), target + np.float32(off), np.float32)
    for name, expected in (
        ("l1", abs(off)),
        ("l2", off**2),
        ("relative", off**2 / ((target + off) ** 2 + 0.01)),
        # No feature and no corner is in an even photo.
        ("feature", off**2),
        ("corner", off**2),
    ):
        value, gradient = loss_against(name, photo)(render)
        assert value == pytest.approx(expected, rel=1e-5), name
        assert np.sign(gradient) == pytest.approx(np.sign(off))


def test_features_count_seven_tenths_more_within_six_pixels() -> None:
    photo = spots(96)
    region = interest_region(photo)
    assert 0 < region.mean() < 0.5
    # Whole squares of 13 pixels: eroding by one of 13 and dilating again changes nothing.
    kernel = np.ones((13, 13), np.uint8)
    opened = cv2.dilate(cv2.erode(region.astype(np.uint8), kernel, borderValue=1), kernel)
    assert np.array_equal(opened > 0, region)
    larger = np.ones((15, 15), np.uint8)
    assert not np.array_equal(cv2.dilate(cv2.erode(region.astype(np.uint8), larger, borderValue=1), larger) > 0, region)
    render = photo.astype(np.float32) / 255 + np.float32(0.1) * region[..., None]
    value, _ = loss_against("feature", photo)(render)
    assert value == pytest.approx(0.01 * region.mean() + 0.7 * 0.01, rel=1e-4)


def test_corners_are_summed_over_squares_of_51_pixels_of_800() -> None:
    photo = spots(400)
    render = photo.astype(np.float32) / 255 + np.float32(0.1)
    value, _ = loss_against("corner", photo)(render)
    # Corners of a square of 12 pixels, each with 25 by 25 around it: their union is 36 to 38 pixels wide.
    beyond = (value - 0.01) / (7.5e-5 * 3 * 0.01)
    assert 35**2 < beyond < 39**2


def test_the_blur_has_a_sigma_of_5_pixels_of_800_and_counts_four_fifths() -> None:
    photo = np.zeros((400, 400, 3), np.uint8)
    render = np.zeros((400, 400, 3), np.float32)
    render[200, 200] = 1.0
    value, _ = loss_against("blur", photo)(render)
    # The squares of a Gaussian of 2.5 pixels add up to 1 / (4 pi sigma^2).
    assert value * 400**2 == pytest.approx(1 + 0.8 / (4 * np.pi * 2.5**2), rel=1e-3)


# ------------------------------------------------------------------ options

LIMITS = {
    inerf: {"steps": (1, 100_000), "rays": (0, 10_000_000), "rate": (0, 10), "long_side_px": (32, 4096)},
    icomma: {"steps": (1, 100_000), "rematch_every": (1, 100_000), "rate": (0, 10), "long_side_px": (32, 4096)},
    pnerf: {
        "hypotheses": (1, 1024), "steps": (1, 100_000), "resample_every": (1, 100_000), "turn_rate": (0, 1),
        "shift_rate": (0, 1), "long_side_px": (32, 4096),
    },
    mc_do: {
        "hypotheses": (0, 4096), "range_deg": (0, 180), "range_share": (0, 10), "rounds": (0, 10),
        "hypothesis_px": (64, 1024), "render_px": (64, 2048), "iterations": (0, 1000), "refinement_steps": (0, 10_000),
    },
}  # fmt: skip
"""So that one request can't keep a worker for hours, nor take the memory of a huge image."""


@pytest.mark.parametrize(
    ("estimator", "name", "ends"),
    [(each, name, ends) for each, limits in LIMITS.items() for name, ends in limits.items()],
)
def test_an_option_is_taken_up_to_its_limits_and_refused_beyond(estimator: Any, name: str, ends: tuple) -> None:
    low, high = ends
    for value in ends:
        assert getattr(estimator.Options(**{name: value}), name) == value
    for value in (low - 1, high + 1):
        with pytest.raises(InvalidOptions, match=f"must lie in {low}..{high}, is {value}") as refused:
            estimator.Options(**{name: value})
        assert refused.value.where == name
