"""Scenes whose unit is long: all depths are below one, and count as those of any other scene.

A depth of 0 means that nothing is seen; a bound of 1 in its place would show in no scene of usual units.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from service.geometry import look_at, moved
from service.interfaces import Features, Frame
from service.matchers.mutual import mutual_nearest
from service.pose.features.rendered_views import RenderedView, View, backprojected
from service.pose.features.scene_focus import centre_depth, focus_of
from service.pose.refinement.pyramid import depth_pyramid, occluder_depth
from service.pose.refinement.pyramid_level import linearized_levels
from service.pose.refinement.refinement_config import REFINEMENT
from service.pose.retrieval import floaters, scene_symmetries, viewpoints
from service.pose.retrieval.ambiguous_hypotheses import AMBIGUITY, _shows_the_same
from service.pose.training_photos.corners import surface_corners
from service.pose.training_photos.patch_matching import predicted
from service.pose.training_photos.patch_pose import PATCH_POSE, _is_visible
from service.pose.training_photos.surface_points import TRIANGULATION, PosedPhoto, SurfacePoints, _neighbours
from service.pose.verification.advice import ADVICE, _only_side, content_extent
from service.pose.verification.captured_volume import CAPTURE, _is_beside_a_view, captured_share
from service.pose.verification.signals import typical_depth
from service.types import Camera, Intrinsics, Pose
from viewer.colours import score_colours

HERE = Pose(np.eye(4))
LENS = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)
CAMERA = Camera(LENS, HERE)
DEPTH = 0.25


def frame(depth: float | np.ndarray = DEPTH) -> Frame:
    ones = np.ones((48, 64), np.float32)
    return Frame(
        np.zeros((48, 64, 3), np.float32), ones, (depth * ones).astype(np.float32), (depth * ones).astype(np.float32)
    )


def half_seen() -> np.ndarray:
    depth = np.full((48, 64), DEPTH, np.float32)
    depth[:, :16] = 0.0
    return depth


def test_depths_of_renders_are_medians_of_what_is_seen() -> None:
    assert typical_depth(frame(half_seen())) == DEPTH
    rasterizer: Any = SimpleNamespace(render=lambda cameras: [frame()])
    assert centre_depth(rasterizer, CAMERA) == DEPTH
    cameras = [Camera(LENS, moved(HERE, np.array([0, 0, 0, x, 0, 0]))) for x in (-0.1, 0.0, 0.1)]
    depths = iter([DEPTH, 0.0, DEPTH])
    focus = focus_of(cameras, lambda camera: next(depths))
    assert focus.forward_facing
    assert focus.point_in_world == pytest.approx([0, 0, DEPTH])


def test_views_are_spaced_by_depths_below_one(monkeypatch) -> None:
    spacing: list[float] = []
    values = iter([0.0, DEPTH, DEPTH])
    monkeypatch.setattr(viewpoints, "centre_depth", lambda *_: next(values))
    monkeypatch.setattr(
        viewpoints, "choose_spread_poses", lambda poses, depth, config: spacing.append(depth) or np.array([0])
    )
    cameras = [SimpleNamespace(camera=CAMERA)] * 3
    scene: Any = SimpleNamespace(cameras=cameras, info=SimpleNamespace(cameras_doubtful=False))
    viewpoints.index_cameras(scene, None, np.random.default_rng(0))  # type: ignore[arg-type]
    assert spacing == [DEPTH]


def test_a_render_shows_the_same_from_nearly_the_same_place() -> None:
    rendered = RenderedView(frame(half_seen()), CAMERA)
    for pixels, same in ((0.9, True), (1.1, False)):
        aside = moved(HERE, np.array([0, 0, 0, pixels * DEPTH / LENS.fx, 0, 0]))
        assert rendered.shows_the_same_as(Camera(LENS, aside), 1.0) is same


def test_features_are_backprojected_to_near_surfaces() -> None:
    px = np.array([[40.5, 24.5], [8.5, 24.5]], np.float32)
    found = backprojected(Features(px, np.ones(2, np.float32), np.ones((2, 4), np.float32)), frame(half_seen()), CAMERA)
    assert found.points_in_world == pytest.approx(np.array([[8.5 / 50 * DEPTH, 0.5 / 50 * DEPTH, DEPTH]]))


def test_refinement_has_the_pixels_of_near_surfaces() -> None:
    settings = REFINEMENT.pyramid
    assert np.all(occluder_depth(frame(), settings) == np.float32(DEPTH))
    # The outline has the depth of what is before the background.
    outlined = occluder_depth(frame(half_seen()), settings)
    assert np.all(outlined[:, 16 - settings.edge_px :] == np.float32(DEPTH))
    assert not outlined[:, : 16 - settings.edge_px].any()
    fine, coarse = depth_pyramid(half_seen(), 2, settings.max_depth_ratio)
    assert fine.shape == (48, 64)
    assert np.all(coarse[:, 8:] == np.float32(DEPTH))
    assert not coarse[:, :8].any()
    photo = np.full((48, 64, 3), 128, np.uint8)
    (level,) = linearized_levels(photo, None, frame(), LENS, LENS, 1, False, REFINEMENT)
    assert len(level.pixels) == 46 * 62


def test_a_pose_sees_near_points_as_captured() -> None:
    assert captured_share(frame(), CAMERA, [CAMERA]) == 1.0
    assert captured_share(frame(0.0), CAMERA, [CAMERA]) == 0.0


def test_one_point_is_as_good_as_many() -> None:
    one = np.array([[0, 0, DEPTH]], np.float32)
    nothing = Features(*(np.zeros(shape, np.float32) for shape in ((1, 2), (1,), (1, 4))))
    view = View(CAMERA, nothing, one)
    assert _is_beside_a_view(HERE, [view], CAPTURE)
    assert _shows_the_same(view, HERE, AMBIGUITY)
    without = View(CAMERA, nothing, one[:0])
    assert not _is_beside_a_view(HERE, [without], CAPTURE)
    assert not _shows_the_same(without, HERE, AMBIGUITY)
    unit = np.array([[1.0, 0.0]], np.float32)
    assert mutual_nearest(unit, unit, 1.0).tolist() == [[0, 0]]
    assert len(mutual_nearest(unit, unit, 1.001)) == 0
    assert len(mutual_nearest(unit[:0], unit, 0.5)) == len(mutual_nearest(unit, unit[:0], 0.5)) == 0
    assert _only_side(np.array([[0.25, 0.5]]), ADVICE) == "left"
    assert content_extent(one) == 0.0
    assert content_extent(one[:0]) == np.inf


def test_points_before_a_camera_are_in_its_image() -> None:
    near = np.array([[0, 0, DEPTH], [0.02, 0.01, DEPTH], [0, 0, -DEPTH]], np.float32)
    assert scene_symmetries._share_in_image(near, CAMERA) == pytest.approx(2 / 3)
    assert floaters._depths_in_view(near.astype(np.float64), CAMERA).tolist() == pytest.approx([DEPTH, DEPTH, np.inf])
    # Half a pixel within the upper left corner.
    corner = np.array([[(0.5 - 32) / 50 * DEPTH, (0.5 - 24) / 50 * DEPTH, DEPTH]], np.float32)
    assert scene_symmetries._share_in_image(corner, CAMERA) == 1.0
    assert np.isfinite(floaters._depths_in_view(corner.astype(np.float64), CAMERA)).all()


def test_patches_on_near_surfaces_are_looked_for() -> None:
    lens = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    tangents = np.zeros((1, 3, 2), np.float32)
    tangents[0, 0, 0] = tangents[0, 1, 1] = DEPTH / 500
    point = np.array([[0.0, 0.0, DEPTH]])
    points = SurfacePoints(
        point, np.zeros((1, 3, 3), np.float32), tangents, np.zeros((1, 20, 20), np.uint8), np.zeros(1, np.int32),
        np.zeros((1, 3)),
    )  # fmt: skip
    assert predicted(points, Camera(lens, HERE)).can_match.tolist() == [True]
    rendered: Any = SimpleNamespace(frame=frame(), camera=CAMERA)
    assert _is_visible(point, rendered, PATCH_POSE).tolist() == [True]
    rendered.frame = frame(0.0)
    assert _is_visible(point, rendered, PATCH_POSE).tolist() == [False]


def test_corners_of_near_surfaces_are_kept_and_neighbours_show_them() -> None:
    rng = np.random.default_rng(0)
    photo = cv2.resize(rng.integers(0, 256, (24, 32), np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC)
    found = surface_corners(np.asarray(photo), None, frame(), CAMERA)
    assert len(found.px) > 50
    assert np.allclose(found.depth, DEPTH)
    lens = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    target = np.array([0.0, 0.0, DEPTH])
    beside = look_at(np.array([0.05, 0.0, 0.0]), target, np.array([0.0, -1.0, 0.0]))
    points = target + 0.02 * rng.uniform(-1, 1, (30, 3))
    photos = [PosedPhoto(np.zeros((480, 640), np.uint8), Camera(lens, pose)) for pose in (HERE, beside)]
    assert _neighbours(0, points, photos, TRIANGULATION) == [1]


def test_scores_that_differ_by_less_than_one_have_the_colours_of_the_ends() -> None:
    low, high = score_colours(np.array([0.2, 0.4]))
    assert np.array_equal(score_colours(np.array([-5.0, 5.0])), [low, high])
    assert np.array_equal(score_colours(np.array([0.3, 0.3])), [high, high])
