"""Every reason of a result, provoked, and what it tells the user to do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_room import write_room
from test_estimators import LENS, photo_at, unseen_pose
from test_fisheye import CAMERA, NEITHER, taken_through

from service.estimators.view_index import Options
from service.geometry import look_at
from service.loaded_scene import LoadedScene
from service.localize import Request, localize, render_and_verify
from service.photos.images import query_of
from service.pose.features.mirrored_query import mirrored_query
from service.pose.features.query_images import QueryImages
from service.pose.refinement.photometric import refine_photometric
from service.results import HINTS, Reason, Status, Verdict
from service.types import LENS_PRIORS, BoxPrior, Camera, Pose, Query

TRUTH = unseen_pose()
UP = np.array([0.0, 0.0, 1.0])
BEFORE_A_WALL = look_at(np.array([0.7, 0.1, 0.0]), np.array([2.0, 0.1, 0.0]), UP)
FAR_OUTSIDE = look_at(np.array([25.0, 3.0, 4.0]), np.zeros(3), UP)
BEHIND_A_WALL = look_at(np.array([4.5, 0.3, 0.2]), np.zeros(3), UP)
FAST = Request(options=Options(effort="fast"))

Rooms = dict[str, LoadedScene]


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> Rooms:
    folder = tmp_path_factory.mktemp("rooms")
    kinds = {"ordinary": {}, "repeated": {"repeated": True}, "symmetric": {"symmetric": True}}
    return {k: LoadedScene.load(write_room(folder / k, **how), cache_dir=scene_cache) for k, how in kinds.items()}


def judged(room: LoadedScene, query: Query, pose: Pose = TRUTH) -> Verdict:
    return render_and_verify(QueryImages(query, room.matcher), pose, room.rasterizer)


def blurred(query: Query, sigma_px: float) -> Query:
    return replace(query, rgb=np.asarray(cv2.GaussianBlur(query.rgb, (0, 0), sigma_px)))


def grey(query: Query) -> Query:
    return replace(query, rgb=np.full_like(query.rgb, 127))


PROVOKED: dict[Reason, Callable[[LoadedScene, Rooms], Verdict]] = {
    Reason.VERIFIED: lambda room, _: judged(room, photo_at(room, TRUTH)),
    Reason.FEW_FEATURES: lambda room, _: localize(grey(photo_at(room, TRUTH)), room, FAST).verdict,
    Reason.NO_MATCHING_VIEW: lambda room, _: judged(room, photo_at(room, TRUTH), unseen_pose(4)),
    Reason.RENDER_MISMATCH: lambda room, _: judged(room, with_swapped_colours(photo_at(room, TRUTH))),
    Reason.FEW_INLIERS: lambda room, _: judged(room, blurred(photo_at(room, TRUTH), 10.0)),
    Reason.LOW_COVERAGE: lambda room, _: judged(room, photo_at(room, FAR_OUTSIDE), FAR_OUTSIDE),
    Reason.OUTSIDE_CAPTURED_VOLUME: lambda room, _: (
        localize(replace(photo_at(room, BEHIND_A_WALL), prior=BEHIND_A_WALL), room, FAST).verdict
    ),
    Reason.FOCAL_UNCERTAIN: lambda room, _: judged(room, with_any_lens(middle_of_a_wall(room, 0.1)), BEFORE_A_WALL),
    Reason.INTRINSICS_CONTRADICTED: lambda room, _: judged(room, *with_a_wrong_lens(room)),
    Reason.LENS_UNMODELLED: lambda room, _: (
        localize(query_of(taken_through(room, NEITHER), intrinsics=CAMERA), room, FAST).verdict
    ),
    Reason.POSITION_UNCERTAIN: lambda room, _: judged(room, middle_of_a_wall(room), BEFORE_A_WALL),
    Reason.OUTSIDE_PRIOR: lambda room, _: judged(room, replace(photo_at(room, TRUTH), region=ELSEWHERE)),
    Reason.AMBIGUOUS: lambda _, rooms: localize(photo_at(rooms["repeated"], TRUTH), rooms["repeated"], FAST).verdict,
    Reason.MIRRORED: lambda _, rooms: (
        localize(mirrored_query(photo_at(rooms["symmetric"], TRUTH)), rooms["symmetric"], FAST).verdict
    ),
    Reason.BUDGET_EXHAUSTED: lambda room, _: (
        localize(photo_at(room, TRUTH), room, replace(FAST, budget_s=1e-9)).verdict
    ),
}
ELSEWHERE = BoxPrior(np.array([0.0, 0, 0]), np.array([0.01, 0.01, 0.01]))


def with_swapped_colours(query: Query) -> Query:
    return replace(query, rgb=np.ascontiguousarray(query.rgb[..., [1, 2, 0]]))


def with_any_lens(query: Query) -> Query:
    return replace(query, lens_prior=LENS_PRIORS["given"])


def with_a_wrong_lens(room: LoadedScene) -> tuple[Query, Pose]:
    """The photo with a focal length 4 % too long, and the pose that makes up for it best."""
    query = photo_at(room, TRUTH)
    lens, pose = replace(LENS, fx=1.04 * LENS.fx, fy=1.04 * LENS.fy), TRUTH
    for _ in range(3):
        camera = Camera(lens, pose)
        pose = refine_photometric(query.rgb, room.rasterizer.render([camera])[0], camera, camera, 2).pose
    return replace(query, intrinsics=lens, photo_intrinsics=lens), pose


def middle_of_a_wall(room: LoadedScene, margin: float = 0.25) -> Query:
    """A small, flat part: a step aside is as good as a turn, a shorter distance as good as a longer lens."""
    query = photo_at(room, BEFORE_A_WALL)
    known = np.zeros(query.rgb.shape[:2], bool)
    top, left = (int(margin * side) for side in known.shape)
    known[top:-top, left:-left] = True
    return replace(query, valid_mask=known)


@pytest.mark.parametrize("reason", list(Reason))
def test_every_reason_is_given_where_it_is_due(reason: Reason, rooms: Rooms) -> None:
    verdict = PROVOKED[reason](rooms["ordinary"], rooms)
    assert verdict.reason is reason, (verdict.score, dict(verdict.signals))
    assert (verdict.status is Status.LOCALIZED) == (reason is Reason.VERIFIED)
    assert bool(HINTS[reason]) == (reason is not Reason.VERIFIED)
