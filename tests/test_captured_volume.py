"""Poses from where a scene was captured, and from where it was not, in a small room with its cameras in the middle."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small_room import FOCAL, HEIGHT, WIDTH, pose_at, write_room

from service.geometry import look_at, moved, pose_distance
from service.interfaces import Frame
from service.loaded_scene import LoadedScene
from service.localize import localize
from service.pose.features.rendered_views import View
from service.pose.verification.captured_volume import CAPTURE, _in_image, _is_beside_a_view, captured_share, is_outside
from service.results import Reason, Status
from service.types import Camera, Intrinsics, Pose, Query

LENS = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
UP = np.array([0.0, 0.0, 1.0])
INSIDE = pose_at(0.4, 0.1)
BEHIND_A_WALL = look_at(np.array([4.5, 0.3, 0.2]), np.zeros(3), UP)
"""2.5 units outside of the wall at x = 2, of which it sees the back."""


@pytest.fixture(scope="module")
def room(tmp_path_factory, scene_cache) -> LoadedScene:
    return LoadedScene.load(write_room(tmp_path_factory.mktemp("captured") / "room"), cache_dir=scene_cache)


def photo_from(room: LoadedScene, pose: Pose) -> np.ndarray:
    (frame,) = room.rasterizer.render([Camera(LENS, pose)])
    return np.rint(np.clip(frame.rgb, 0, 1) * 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("pose", "expected"),
    [
        (INSIDE, 1.0),
        (BEHIND_A_WALL, 0.0),
        # At half the distance, and at a tenth: from -0.6 the wall at 2 is 2.6 away.
        (look_at(np.array([0.7, 0, 0]), np.array([2.0, 0, 0]), UP), 1.0),
        (look_at(np.array([1.75, 0, 0]), np.array([2.0, 0, 0]), UP), 0.0),
    ],
)
def test_what_views_see_from_a_like_direction_and_distance_is_captured(
    room: LoadedScene, pose: Pose, expected: float
) -> None:
    camera = Camera(LENS.with_long_side(128), pose)
    views = [named.camera for named in room.scene.cameras]
    share = captured_share(room.rasterizer.render([camera])[0], camera, views)
    assert share == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize(("zoom_of_views", "expected"), [(1.0, 1.0), (16.0, 0.0)])
def test_a_telephoto_lens_sees_from_afar_what_was_captured_from_near(
    room: LoadedScene, zoom_of_views: float, expected: float
) -> None:
    """A wall is 2 away from the views, and 32 from the pose, outside of the room, whose other wall is left out."""
    size = zoomed(LENS.with_long_side(128), 16.0)
    (frame,) = room.rasterizer.render([Camera(size, pose_at(0.0, 0.0))])
    inside = pose_at(0.0, 0.0)
    away = Camera(size, look_at(inside.position_in_world - 30.0 * inside.axis_in_world, inside.position_in_world, UP))
    seen = replace(frame, median_depth=frame.median_depth + np.float32(30.0))
    views = [replace(n.camera, intrinsics=zoomed(n.camera.intrinsics, zoom_of_views)) for n in room.scene.cameras]
    assert captured_share(seen, away, views) == pytest.approx(expected, abs=0.05)


def share_seen(from_: Pose, lens: Intrinsics = LENS, alpha: float = 1.0) -> float | None:
    """Of a wall 4 ahead of a camera at the origin, what a camera elsewhere has captured."""
    image = np.full((HEIGHT, WIDTH), 4.0, np.float32)
    frame = Frame(np.zeros((HEIGHT, WIDTH, 3), np.float32), np.full_like(image, alpha), image, image)
    wide = replace(
        lens, width=4000, height=4000, cx=2000.0, cy=2000.0, fx=lens.fx * 4000 / WIDTH, fy=lens.fy * 4000 / WIDTH
    )
    narrow = zoomed(LENS, 50.0)  # all of the wall that it shows lies on the axis
    return captured_share(frame, Camera(narrow, Pose(np.eye(4))), [Camera(zoomed(wide, 50.0), from_)])


@pytest.mark.parametrize(
    ("turn_deg", "distance", "expected"),
    [
        (0, 4.0, 1.0), (58, 4.0, 1.0), (62, 4.0, 0.0), (-58, 4.0, 1.0), (-62, 4.0, 0.0),
        (0, 31.0, 1.0), (0, 33.0, 0.0), (0, 1.4, 1.0), (0, 1.3, 0.0),
    ],
)  # fmt: skip
def test_a_surface_is_captured_within_sixty_degrees_and_from_a_third_to_eight_times_as_far(
    turn_deg: float, distance: float, expected: float
) -> None:
    ahead, angle = np.array([0.0, 0.0, 4.0]), np.radians(turn_deg)
    eye = ahead - distance * np.array([np.sin(angle), 0.0, np.cos(angle)])
    share = share_seen(look_at(eye, ahead, np.array([0.0, -1.0, 0.0])))
    assert share is not None
    assert share > 0.1 if expected else share == 0.0  # from near the view shows a part of it


def test_only_opaque_surface_counts_and_only_what_lies_in_the_view() -> None:
    assert share_seen(Pose(np.eye(4)), alpha=0.5) is None
    assert share_seen(Pose(np.eye(4)), alpha=0.51) == 1.0
    away = look_at(np.zeros(3), np.array([4.0, 0.0, 0.5]), np.array([0.0, -1.0, 0.0]))
    assert share_seen(away) == 0.0


def test_the_edge_of_an_image_lies_in_the_view_and_what_is_behind_does_not() -> None:
    """Points half a pixel inside of each edge, half a pixel outside of it, and behind."""
    view = Camera(Intrinsics(40, 30, 20.0, 20.0, 20.0, 15.0), Pose(np.eye(4)))
    px = [(0.5, 15), (39.5, 15), (20, 0.5), (20, 29.5), (-0.5, 15), (40.5, 15), (20, -0.5), (20, 30.5)]
    points = np.array([[(u - 20) / 20, (v - 15) / 20, 1.0] for u, v in px] + [[0.0, 0.0, -1.0], [0.0, 0.0, 0.5]])
    assert _in_image(points, view).tolist() == [True] * 4 + [False] * 5 + [True]


@pytest.mark.parametrize(
    ("away", "turn_deg", "beside"),
    [(1.9, 0, True), (2.1, 0, False), (0.0, 44, True), (0.0, 46, False), (1.9, 44, True)],
)
def test_a_pose_beside_a_view_needs_no_render(away: float, turn_deg: float, beside: bool) -> None:
    """The view sees points 4 away, in the median."""
    points = np.array([[0.0, 0, 3.0], [0.0, 0, 4.0], [0.0, 0, 50.0]], np.float32)
    features: Any = None
    camera = Camera(LENS, Pose(np.eye(4)))
    view, empty, one = (View(camera, features, some) for some in (points, points[:0], points[1:2]))
    pose = moved(Pose(np.eye(4)), np.array([0, np.radians(turn_deg), 0, 0, 0, 0]))
    pose = Pose(pose.world_from_camera + np.array([[0, 0, 0, away]] + [[0.0] * 4] * 3))
    assert _is_beside_a_view(pose, [view], CAPTURE) == beside
    assert not _is_beside_a_view(pose, [empty], CAPTURE)
    assert _is_beside_a_view(pose, [one], CAPTURE) == beside


def zoomed(size: Intrinsics, factor: float) -> Intrinsics:
    return replace(size, fx=factor * size.fx, fy=factor * size.fy)


def test_no_evidence_says_nothing(room: LoadedScene) -> None:
    away = look_at(np.array([9.0, 0, 0]), np.array([19.0, 0, 0]), UP)
    camera = Camera(LENS, away)
    views = room.prepare("view_index").views
    assert captured_share(room.rasterizer.render([camera])[0], camera, [v.camera for v in views]) is None
    assert not is_outside(LENS, away, room.rasterizer, views)
    assert not is_outside(LENS, BEHIND_A_WALL, room.rasterizer, ())
    assert is_outside(LENS, BEHIND_A_WALL, room.rasterizer, views)


def test_a_photo_of_the_back_of_a_wall_is_uncertain_for_that_reason(room: LoadedScene) -> None:
    """The prior is the truth, and the render there the photo: only where the pose is speaks against it."""
    query = Query(photo_from(room, BEHIND_A_WALL), LENS, "given", LENS, prior=BEHIND_A_WALL)
    found = localize(query, room)
    assert pose_distance(found.pose, BEHIND_A_WALL)[1] < 0.05
    assert (found.verdict.status, found.verdict.reason) == (Status.UNCERTAIN, Reason.OUTSIDE_CAPTURED_VOLUME)
    assert found.verdict.score <= 0.5


def test_a_photo_from_inside_is_localized(room: LoadedScene) -> None:
    found = localize(Query(photo_from(room, INSIDE), LENS, "given", LENS), room)
    assert found.verdict.status is Status.LOCALIZED
