"""Advice, planted: in each test one thing is wrong with a photo of the small room, and the advice is about that."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from small_room import write_room
from test_estimators import photo_at, unseen_pose
from test_reasons import BEFORE_A_WALL, FAR_OUTSIDE, FAST, middle_of_a_wall, with_any_lens

from service.geometry import look_at, moved
from service.interfaces import Frame, Rasterizer
from service.loaded_scene import LoadedScene
from service.localize import Request, localize, render_and_verify
from service.pose.features.query_images import QueryImages
from service.pose.verification.advice import advice_for, content_extent
from service.pose.verification.photo_quality import blur_effect, photo_faults
from service.pose.verification.search_summary import search_summary
from service.results import IterationRecord, Reason, Status, Verdict
from service.types import BoxPrior, Camera, Pose, Query

TRUTH = unseen_pose()
UP = np.array([0.0, 0.0, 1.0])
GREY = np.full((48, 64, 3), 0.5, np.float32)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> LoadedScene:
    return LoadedScene.load(write_room(tmp_path_factory.mktemp("advice") / "room"), cache_dir=scene_cache)


def refused(verdict: Verdict) -> Verdict:
    """As if the gate hadn't accepted the pose: advice doesn't depend on why."""
    return replace(verdict, status=Status.UNCERTAIN) if verdict.status is Status.LOCALIZED else verdict


def advice(room: LoadedScene, query: Query, pose: Pose, others: tuple[Pose, ...] = ()) -> str:
    images = QueryImages(query, room.matcher)
    verdict = refused(render_and_verify(images, pose, room.rasterizer))
    extent = content_extent(room.scene.means)
    return " ".join(advice_for(images, pose, room.rasterizer, verdict, others, extent))


def only(query: Query, side: str) -> Query:
    """The photo with something else in all but one half of it."""
    rgb = np.random.default_rng(0).integers(0, 256, query.rgb.shape, np.uint8)
    height, width = rgb.shape[:2]
    kept = {
        "left": np.s_[:, : width // 2],
        "right": np.s_[:, width // 2 :],
        "up": np.s_[: height // 2],
        "down": np.s_[height // 2 :],
    }[side]
    rgb[kept] = query.rgb[kept]
    return replace(query, rgb=rgb)


SAID = {"left": "turn left", "right": "turn right", "up": "tilt the camera up", "down": "tilt the camera down"}


@pytest.mark.parametrize("side", SAID)
def test_a_photo_of_which_one_half_shows_the_scene_is_turned_to_that_side(room: LoadedScene, side: str) -> None:
    said = advice(room, only(photo_at(room, TRUTH), side), TRUTH)
    assert SAID[side] in said
    assert not [other for name, other in SAID.items() if name != side and other in said]


@pytest.mark.parametrize(("aside", "said"), [(2.4, "turn left"), (-2.4, "turn right")])
def test_a_camera_that_looks_past_the_scene_is_turned_back_to_it(room: LoadedScene, aside: float, said: str) -> None:
    """From outside the room, looking past one end of it."""
    position = np.array([6.0, 0.0, 0.3])
    # Looking along -x, world +y is on the right.
    pose = look_at(position, np.array([0.0, aside, 0.0]), UP)
    found = advice(room, photo_at(room, pose), pose)
    assert said in found
    assert "fills only" in found


def test_a_scene_that_is_small_in_the_photo_is_approached(room: LoadedScene) -> None:
    pose = look_at(0.5 * FAR_OUTSIDE.position_in_world, np.zeros(3), UP)
    found = advice(room, photo_at(room, pose), pose)
    assert "step nearer" in found
    assert "turn" not in found.replace("turn so that", "")


def test_from_a_wall_that_fills_the_photo_one_steps_back(room: LoadedScene) -> None:
    near = look_at(np.array([1.3, 0.1, 0.0]), np.array([2.0, 0.1, 0.0]), UP)
    assert "step back" in advice(room, photo_at(room, near), near)


def test_what_is_flat_is_told_and_what_is_not_is_not(room: LoadedScene) -> None:
    assert "one plane" in advice(room, photo_at(room, BEFORE_A_WALL), BEFORE_A_WALL)
    corner = look_at(np.array([0.0, 0.0, 0.0]), np.array([2.0, 1.5, 0.3]), UP)
    assert "plane" not in advice(room, photo_at(room, corner), corner)


def test_the_lens_is_asked_for_where_it_is_what_leaves_the_position_open(room: LoadedScene) -> None:
    query = middle_of_a_wall(room, 0.1)
    assert "exact intrinsics" in advice(room, with_any_lens(query), BEFORE_A_WALL)
    assert "intrinsics" not in advice(room, query, BEFORE_A_WALL)


def test_a_prior_is_told_how_far_off_it_is(room: LoadedScene) -> None:
    corner = TRUTH.position_in_world + np.array([0.3, 0.4, 0.0])
    box = BoxPrior(corner, corner + 1.0)
    assert "0.5 units outside the prior's box" in advice(room, replace(photo_at(room, TRUTH), region=box), TRUTH)


# ------------------------------------------------------------------ the photo as a picture


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda rgb: rgb // 8, "dark"),
        (lambda rgb: np.minimum(rgb.astype(np.int32) * 6, 255).astype(np.uint8), "overexposed"),
        (lambda rgb: np.asarray(cv2.GaussianBlur(rgb, (0, 0), 4.0)), "blurred"),
        (lambda rgb: np.full_like(rgb, 127), "hardly any texture"),
    ],
)
def test_a_bad_picture_is_told_as_such_and_a_good_one_is_not(
    room: LoadedScene, spoil: Callable[[np.ndarray], np.ndarray], said: str
) -> None:
    query = photo_at(room, TRUTH)
    assert said in advice(room, replace(query, rgb=spoil(query.rgb)), TRUTH)
    assert said not in advice(room, query, TRUTH)


def test_a_white_background_is_not_overexposed() -> None:
    white = np.full((48, 64, 3), 255, np.uint8)
    white[10:40:2] = 90
    assert "overexposed" not in " ".join(photo_faults(white, white.astype(np.float32) / 255))
    assert "overexposed" in " ".join(photo_faults(white, GREY))


def test_blur_grows_with_blur_whatever_the_light() -> None:
    rng = np.random.default_rng(1)
    sharp = cv2.resize(rng.random((60, 80)).astype(np.float32), (320, 240), interpolation=cv2.INTER_NEAREST)
    effects = [blur_effect(sharp)] + [blur_effect(np.asarray(cv2.GaussianBlur(sharp, (0, 0), s))) for s in (1, 2, 4, 8)]
    assert effects == sorted(effects)
    assert blur_effect(0.2 * sharp) == pytest.approx(effects[0], abs=1e-3)
    assert blur_effect(np.zeros((20, 20), np.float32)) == 0.0


def test_a_photo_of_something_else_is_to_be_taken_elsewhere(room: LoadedScene) -> None:
    other = replace(photo_at(room, TRUTH), rgb=np.random.default_rng(2).integers(0, 256, (240, 320, 3), np.uint8))
    assert "second photo" in advice(room, other, TRUTH)


# ------------------------------------------------------------------ places that look alike


class TwoPlaces:
    """A rasterizer. All is grey, but beside what the photo shows the second place has a bright strip on one side."""

    def __init__(self, side: str | None, second: Pose) -> None:
        self.side, self.second = side, second

    def render(self, cameras: Sequence[Camera]) -> list[Frame]:
        return [self._frame(camera) for camera in cameras]

    def _frame(self, camera: Camera) -> Frame:
        height, width = camera.intrinsics.height, camera.intrinsics.width
        rgb, depth = np.full((height, width, 3), 0.5, np.float32), np.ones((height, width), np.float32)
        if camera.pose is self.second and self.side:
            x, y = width // 8, height // 8
            strip = {"left": np.s_[:, :x], "right": np.s_[:, -x:], "up": np.s_[:y], "down": np.s_[-y:]}[self.side]
            rgb[strip] = 1.0
        return Frame(rgb, depth, depth, depth)


@pytest.mark.parametrize("side", [*SAID, None])
def test_places_that_look_alike_are_told_apart_where_they_differ(room: LoadedScene, side: str | None) -> None:
    query, second = photo_at(room, TRUTH), moved(TRUTH, np.array([0, np.pi, 0, 0, 0, 0]))
    images = QueryImages(query, room.matcher)
    verdict = refused(render_and_verify(images, TRUTH, room.rasterizer))
    said = " ".join(advice_for(images, TRUTH, cast(Rasterizer, TwoPlaces(side, second)), verdict, (second,)))
    assert (SAID[side] if side else "second photo") in said


# ------------------------------------------------------------------ in a result


def test_a_localized_photo_needs_no_advice_and_any_other_has_some(room: LoadedScene) -> None:
    query = photo_at(room, TRUTH)
    assert localize(query, room).advice == ()
    half = localize(replace(only(query, "left"), prior=TRUTH), room, Request(budget_renders=1))
    assert half.verdict.status is not Status.LOCALIZED
    assert 1 <= len(half.advice) <= 3


# ---------------------------------------------------------------- what the search found


@pytest.mark.parametrize(
    ("steps", "reason", "said"),
    [
        ([("retrieve", None, None)], "few_features", ""),
        ([("descend", None, None)], "render_mismatch", ""),
        ([("retrieve", None, None), ("match", 0, 0)], "no_matching_view", "No feature of the photo matches the scene."),
        (
            [("match", 40, 0), ("match", 90, 0)],
            "few_inliers",
            "None of 90 matches with the scene agree on a camera pose.",
        ),
        (
            [("retrieve", None, None), ("match", 400, 9), ("match_pooled", 1073, 14), ("check_mirror", 500, 30)],
            "no_matching_view",
            "At best 14 of 1073 matches with the scene agree on a camera pose: too few to trust it.",
        ),
        (
            [("retrieve", None, None), ("match", 400, 60), ("refine", None, 60), ("verify", None, 0)],
            "render_mismatch",
            "At best 60 of 400 matches with the scene agree on a camera pose, but the scene rendered at the best guess "
            "does not look like the photo.",
        ),
        (
            [("retrieve", None, None), ("match", 400, 60), ("verify", None, 12)],
            "low_coverage",
            "At best 60 of 400 matches with the scene agree on a camera pose.",
        ),
    ],
)
def test_the_summary_has_the_numbers_of_the_trace(
    steps: list[tuple[str, int | None, int | None]], reason: str, said: str, room: LoadedScene
) -> None:
    records = [IterationRecord(stage, TRUTH, num_matches=n, num_inliers=k) for stage, n, k in steps]
    verdict = render_and_verify(QueryImages(photo_at(room, TRUTH), room.matcher), TRUTH, room.rasterizer)
    assert search_summary(records, replace(verdict, status=Status.NOT_LOCALIZED, reason=Reason(reason))) == said
    assert search_summary(records, verdict) == ""


def test_a_photo_of_something_else_is_told_how_many_matches_there_were(room: LoadedScene) -> None:
    query = photo_at(room, TRUTH)
    rgb = np.random.default_rng(3).permutation(query.rgb.reshape(-1, 16, 3)).reshape(query.rgb.shape)
    found = localize(replace(query, rgb=rgb), room, FAST)
    assert found.verdict.status is Status.NOT_LOCALIZED
    best, matches = map(int, re.findall(r"(\d+) of (\d+) matches", found.search_summary)[0])
    pairs = [(r.num_inliers, r.num_matches) for r in found.records if r.num_matches and r.stage != "check_mirror"]
    assert (best, matches) in pairs
    assert best == max(inliers or 0 for inliers, _ in pairs)
