"""When refinement renders again, ends, or goes back to matching: with renders and refinements that follow a script."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_search_thresholds import drained

from service.geometry import moved
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.refinement import refine_stage as stage
from service.pose.refinement.refine_stage import (
    REFINE_STAGE,
    RefinedPose,
    RefineOutcome,
    refine_stage,
    rematch_and_refine,
)
from service.types import NO_CORRECTION, Camera, Intrinsics, LensPrior, Pose, Query

HERE = Pose(np.eye(4))
LENS = Intrinsics(832, 624, 800.0, 800.0, 416.0, 312.0)
PX_PER_UNIT = 100.0


class Render:
    """A render whose image moves by PX_PER_UNIT pixels, at the size of renders, for each unit that its camera moves."""

    def __init__(self, camera: Camera) -> None:
        self.camera, self.frame = camera, None

    def shows_the_same_as(self, camera: Camera, tolerance_px: float) -> bool:
        way = np.linalg.norm(camera.pose.position_in_world - self.camera.pose.position_in_world)
        assert camera.intrinsics.long_side in (416, self.camera.intrinsics.long_side)
        return bool(PX_PER_UNIT * way * self.camera.intrinsics.long_side / 416 < tolerance_px)


class Renderer:
    def __init__(self) -> None:
        self.sizes: list[int] = []
        self.latest: Any = None

    def render(self, camera: Camera) -> Any:
        self.sizes.append(camera.intrinsics.long_side)
        self.latest = Render(camera)
        return self.latest

    near = render


class Played:
    """A run of the stage in which refinement moves the camera by `steps`: (units, degrees, loss)."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, steps: list[tuple[float, float, float]], **given: Any) -> None:
        self.levels: list[tuple[int, bool]] = []
        left = iter(steps)

        def refine(rgb, frame, camera, start, levels, correction, prior, valid, coarse, config):
            self.levels.append((levels, coarse))
            units, degrees, loss = next(left)
            pose = moved(start.pose, np.array([0, np.radians(degrees), 0, units, 0, 0]))
            return SimpleNamespace(pose=pose, correction=NO_CORRECTION, loss=loss)

        monkeypatch.setattr(stage, "refine_photometric", refine)
        prior = LensPrior(0.1) if given.pop("free_lens", False) else None
        query = Query(np.zeros((624, 832, 3), np.uint8), LENS, "given", LENS, lens_prior=prior)
        self.images: Any = SimpleNamespace(query=query, resized=lambda size: None, valid_mask=lambda size: None)
        self.renderer = Renderer()
        inliers = given.pop("inliers", 60)
        self.found = AbsolutePose(HERE, np.arange(100) < inliers)
        generator: Any = refine_stage(self.found, self.images, self.renderer, **given)  # type: ignore[arg-type]
        self.records, self.outcome = drained(generator)

    @property
    def refined(self) -> RefinedPose:
        assert self.outcome.refined is not None
        return self.outcome.refined


def test_refinement_settles_where_the_image_moves_by_less_than_three_tenths_of_a_pixel(monkeypatch) -> None:
    """The first render is small, the second has the size of all others."""
    played = Played(monkeypatch, [(0.1, 0.0, 0.02), (0.00299, 0.0, 0.01)])
    assert played.renderer.sizes == [256, 416]
    assert (played.refined.settled, played.outcome.restart, played.outcome.diverged) == (True, None, False)
    assert played.refined.loss == 0.01
    assert played.refined.num_inliers == 60
    assert played.refined.rendered is played.renderer.latest
    assert [record.stage for record in played.records] == ["refine"] * 2
    assert played.records[0].step_units == pytest.approx(0.1)
    further = Played(monkeypatch, [(0.1, 0.0, 0.02), (0.00301, 0.0, 0.01), (0.0, 0.0, 0.01)])
    assert further.renderer.sizes == [256, 416, 416]


@pytest.mark.parametrize(
    ("inliers", "free_lens", "levels"),
    [(60, False, [2, 1, 1]), (59, False, [4, 2, 2]), (60, True, [2, 2, 2]), (59, True, [4, 2, 2])],
)
def test_the_pyramid_is_as_high_as_the_pose_may_be_off(monkeypatch, inliers: int, free_lens: bool, levels) -> None:
    steps = [(0.03, 0.0, 0.01), (0.02, 0.0, 0.01), (0.0, 0.0, 0.01)]
    played = Played(monkeypatch, steps, inliers=inliers, free_lens=free_lens)
    assert played.levels == list(zip(levels, [True, False, False], strict=True))


@pytest.mark.parametrize(("loss", "restarts"), [(0.03, False), (0.031, True)])
def test_four_renders_that_do_not_settle_restart_from_matches_unless_the_photo_agrees(
    monkeypatch, loss, restarts
) -> None:
    played = Played(monkeypatch, [(0.1, 0.0, loss)] * 4)
    assert len(played.records) == 4
    assert (played.outcome.restart is not None) == restarts
    assert played.refined.settled != restarts
    assert (played.refined.photometric is None) == restarts
    if restarts:
        assert played.outcome.restart.pose.position_in_world[0] == pytest.approx(0.4)
        assert played.renderer.sizes == [256, 416, 416, 416, 416]
    settled = Played(monkeypatch, [(0.1, 0.0, 0.5)] * 3 + [(0.0, 0.0, 0.5)])
    assert settled.outcome.restart is None


def test_with_approximate_intrinsics_ten_renders_follow_matches_with_a_render(monkeypatch) -> None:
    steps = [(0.03, 0.0, 0.01)] * 12
    assert len(Played(monkeypatch, steps, free_lens=True, is_rematched=True).records) == 10
    assert len(Played(monkeypatch, steps, free_lens=True).records) == 4
    assert len(Played(monkeypatch, steps, is_rematched=True).records) == 4
    assert Played(monkeypatch, steps, free_lens=True).outcome.restart is not None


@pytest.mark.parametrize(
    ("units", "loss", "changed", "ends"),
    [
        # The small render has 256 pixels of 416: the bound is 4 px at that size.
        (0.041, 0.031, {}, True),
        (0.039, 0.031, {}, False),
        (0.041, 0.03, {}, False),
        (0.041, 0.031, {"is_rematched": True}, False),
        (0.041, 0.031, {"free_lens": False}, False),
    ],
)
def test_a_first_refinement_that_leads_far_with_approximate_intrinsics_matches_again(
    monkeypatch, units: float, loss: float, changed: dict, ends: bool
) -> None:
    played = Played(monkeypatch, [(units, 0.0, loss), (0.0, 0.0, loss)], **({"free_lens": True} | changed))
    assert (len(played.records) == 1) == ends
    assert (played.outcome.restart is played.found) == ends
    assert played.refined.settled != ends
    later = Played(monkeypatch, [(0.01, 0.0, loss), (units, 0.0, loss), (0.0, 0.0, loss)], free_lens=True)
    assert len(later.records) == 3


@pytest.mark.parametrize(
    ("inliers", "degrees", "diverges"), [(60, 10.1, True), (60, 9.9, False), (59, 10.1, False), (59, 60.0, False)]
)
def test_a_trusted_pose_is_not_left_by_more_than_ten_degrees(monkeypatch, inliers, degrees, diverges) -> None:
    played = Played(monkeypatch, [(0.0, degrees, 0.01), (0.0, 0.0, 0.01)], inliers=inliers)
    assert played.outcome.diverged == diverges
    assert (played.outcome.refined is None) == diverges
    assert (played.outcome.restart is played.found) == diverges
    second = Played(monkeypatch, [(0.1, 0.0, 0.01), (0.0, degrees, 0.01)], inliers=inliers)
    assert second.outcome.diverged == diverges
    if diverges:
        assert second.refined.pose.position_in_world[0] == pytest.approx(0.1)
        assert (second.refined.photometric, second.refined.settled) == (None, False)
        assert second.refined.rendered is second.renderer.latest


def test_a_refinement_without_a_finite_loss_diverges_and_a_large_one_ends_it(monkeypatch) -> None:
    lost = Played(monkeypatch, [(0.0, 0.0, np.inf)])
    assert (lost.outcome.refined, lost.outcome.restart, lost.outcome.diverged) == (None, lost.found, True)
    few = Played(monkeypatch, [(0.0, 0.0, np.inf)], inliers=59)
    assert (few.outcome.restart, few.outcome.diverged) == (None, True)
    bad = Played(monkeypatch, [(0.1, 0.0, 0.04), (0.0, 0.0, 0.051)], max_loss=0.05)
    assert (bad.outcome.restart, bad.outcome.diverged) == (None, False)
    assert bad.refined.loss == 0.04
    assert Played(monkeypatch, [(0.0, 0.0, 0.05)], max_loss=0.05).refined.loss == 0.05


def test_without_renders_the_pose_of_the_matches_is_the_answer(monkeypatch) -> None:
    played = Played(monkeypatch, [], config=replace(REFINE_STAGE, max_renders=0))
    assert (played.refined.pose, played.refined.loss, played.refined.num_inliers) == (HERE, None, 60)
    assert [record.num_inliers for record in played.records] == [60]
    assert played.renderer.sizes == []


def test_the_gate_measures_at_the_size_of_renders_within_a_pixel(monkeypatch) -> None:
    played = Played(monkeypatch, [(0.1, 0.0, 0.02), (0.0, 0.0, 0.01)])
    refined, images = played.refined, played.images
    rendered = refined.rendered
    for units, same in ((0.0099, True), (0.0101, False)):
        pose = moved(rendered.camera.pose, np.array([0, 0, 0, units, 0, 0]))
        view, result = replace(refined, pose=pose).view_at_pose(images, played.renderer)
        assert (view is rendered) == same
        assert result is (refined.photometric if same else None)
    view, result = replace(refined, rendered=None).view_at_pose(images, played.renderer)
    assert (view.camera.intrinsics.long_side, result) == (416, None)


@pytest.mark.parametrize("rounds", [0, 1])
def test_a_pose_that_loses_its_matches_is_wrong_and_one_without_any_stays(monkeypatch, rounds: int) -> None:
    played = Played(monkeypatch, [(0.0, 0.0, 0.01)])

    def rematch(*_: Any):
        yield from ()
        return SimpleNamespace(found=None, rounds=rounds)

    monkeypatch.setattr(stage, "render_and_rematch", rematch)
    before = played.refined
    _, found = drained(rematch_and_refine(played.found, played.images, played.renderer, before=before))  # type: ignore[arg-type]
    assert found.refined is (before if rounds == 0 else None)
    assert found.rounds == rounds


@pytest.mark.parametrize(
    ("diverged", "restarts", "as_matched"), [(True, True, True), (True, False, False), (False, True, False)]
)
def test_where_refinement_diverges_from_a_trusted_pose_that_of_the_matches_is_the_answer(
    monkeypatch, diverged: bool, restarts: bool, as_matched: bool
) -> None:
    played = Played(monkeypatch, [(0.0, 0.0, 0.01)])
    rematched = replace(played.found, pose=moved(HERE, np.full(6, 0.1)))

    def rematch(*_: Any):
        yield from ()
        return SimpleNamespace(found=rematched, rounds=2)

    def refined(found, images, renderer, config, is_rematched):
        assert is_rematched
        yield from ()
        return RefineOutcome(played.refined, found if restarts else None, diverged)

    monkeypatch.setattr(stage, "render_and_rematch", rematch)
    monkeypatch.setattr(stage, "refine_stage", refined)
    records, found = drained(rematch_and_refine(played.found, played.images, played.renderer))  # type: ignore[arg-type]
    assert found.rounds == 2
    assert (found.refined is played.refined) != as_matched
    assert len(records) == as_matched
    if as_matched:
        assert found.refined.pose is rematched.pose
