"""Lenses that a pinhole with one radial coefficient isn't: planted correspondences and photos, projected by OpenCV."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rest_in_ci import rest_in_ci
from small_room import write_room
from test_estimators import photo_at, unseen_pose

from service.estimators.view_index import Options
from service.geometry import pose_distance
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.photos.images import query_of
from service.pose.absolute_pose.fisheye import LensModels, fit_lens_models
from service.pose.absolute_pose.pnp import AbsolutePose
from service.results import PoseEstimate, Reason, Status
from service.types import Intrinsics, IntrinsicsCorrection, Pose, Query

CAMERA = Intrinsics(640, 480, 330.0, 330.0, 320.0, 240.0)
"""As a fisheye: 111 degrees wide."""
MATRIX = np.array([[330.0, 0, 320], [0, 330, 240], [0, 0, 1]])
TRUTH = unseen_pose()
NEITHER = (-1.0, 1.6, -0.6, 0.0)
"""Coefficients of a lens whose scale falls and rises again from the centre to the corner."""


def correspondences(fisheye: bool, k: tuple[float, float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """400 points in a room, seen with a pixel of noise; a third of them are wrong."""
    rng = np.random.default_rng(5)
    rays = np.c_[rng.uniform(-1.0, 1.0, (400, 2)) * [1.2, 0.9], np.ones(400)]
    points = rays * rng.uniform(1.0, 4.0, (400, 1))
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    px = project(points[:, None], np.zeros(3), np.zeros(3), MATRIX, np.array(k, float))[0][:, 0]
    px = px + rng.normal(0, 1.0, px.shape)
    px[::3] = rng.uniform(0, [640, 480], px[::3].shape)
    world = points @ TRUTH.world_from_camera[:3, :3].T + TRUTH.position_in_world
    return px, world


def fitted(px: np.ndarray, points: np.ndarray, assumed: Intrinsics = CAMERA) -> LensModels:
    near = Pose(TRUTH.world_from_camera @ np.r_[np.eye(4)[:2], [[0, 0, 1, 0.2]], [[0, 0, 0, 1]]])
    start = AbsolutePose(near, np.zeros(len(px), bool), IntrinsicsCorrection(k1=-0.1))
    return fit_lens_models(px, points, assumed, start, 5.0)


@pytest.mark.parametrize("k", [0.0, 1 / 12, -1 / 24])
@pytest.mark.parametrize("focal_factor", [1.0, 1.4])
def test_a_fisheye_is_recognised_among_wrong_matches(k: float, focal_factor: float) -> None:
    assumed = replace(CAMERA, fx=focal_factor * CAMERA.fx, fy=focal_factor * CAMERA.fy)
    models = fitted(*correspondences(True, (k, 0, 0, 0)), assumed)
    assert models.is_surely_fisheye()
    assert not models.is_unmodelled()
    lens = models.fisheye.lens(assumed)
    assert lens.model == "OPENCV_FISHEYE"
    assert lens.fx == pytest.approx(CAMERA.fx, rel=0.01)
    assert lens.distortion[0] == pytest.approx(k, abs=0.02)
    degrees, units = pose_distance(models.fisheye.pose, TRUTH)
    assert degrees < 0.7  # 0.3 at most were seen
    assert units < 0.03


@pytest.mark.parametrize("k1", [-0.1, 0.0, 0.1])
def test_a_radial_distortion_is_no_fisheye(k1: float) -> None:
    models = fitted(*correspondences(False, (k1, 0, 0, 0)))
    assert not models.is_fisheye()
    assert not models.is_unmodelled()
    assert models.radial.correction.k1 == pytest.approx(k1, abs=0.02)


def test_a_lens_of_neither_model_is_seen_as_such() -> None:
    models = fitted(*correspondences(True, NEITHER))
    assert models.is_unmodelled()


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> LoadedScene:
    return LoadedScene.load(write_room(tmp_path_factory.mktemp("room") / "room"), cache_dir=scene_cache)


def taken_through(room: LoadedScene, k: tuple[float, float, float, float]) -> np.ndarray:
    """A photo through a fisheye, from a wider one of a pinhole."""
    wide = Intrinsics(1900, 1440, 440.0, 440.0, 950.0, 720.0)
    rgb = photo_at(room, TRUTH, wide).rgb
    # OpenCV's own inverse doesn't converge for every lens: its distortion is tabulated instead.
    ray_radius = np.tan(np.linspace(0, 1.15, 4000))
    table = np.stack([ray_radius, np.zeros_like(ray_radius)], 1)[:, None]
    distorted = cv2.fisheye.distortPoints(table, np.eye(3), np.array(k, float))[:, 0, 0]
    assert (np.diff(distorted) > 0).all()
    row, column = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64) + 0.5
    seen = (np.stack([column.ravel(), row.ravel()], 1) - [CAMERA.cx, CAMERA.cy]) / CAMERA.fx
    radius = np.linalg.norm(seen, axis=1)
    rays = seen * (np.interp(radius, distorted, ray_radius) / radius)[:, None]
    # OpenCV counts from the middle of the first pixel.
    at = rays * wide.fx + [wide.cx - 0.5, wide.cy - 0.5]
    assert at.min() > 0
    assert (at.max(0) < [wide.width - 1, wide.height - 1]).all()
    x, y = at.T.reshape(2, CAMERA.height, CAMERA.width).astype(np.float32)
    return np.asarray(cv2.remap(rgb, x, y, cv2.INTER_CUBIC))


@pytest.fixture(scope="module")
def equidistant(room: LoadedScene) -> np.ndarray:
    return taken_through(room, (0, 0, 0, 0))


def found_in(room: LoadedScene, query: Query) -> PoseEstimate:
    return localize(query, room, Request(options=Options(effort="fast")))


@pytest.mark.parametrize("told", rest_in_ci(None, CAMERA, replace(CAMERA, fx=360.0, fy=360.0)))
def test_a_photo_of_an_untold_fisheye_is_localized(
    room: LoadedScene, equidistant: np.ndarray, told: Intrinsics | None
) -> None:
    found = found_in(room, query_of(equidistant, intrinsics=told))
    assert_right(found)
    assert found.intrinsics_source == "fisheye"
    assert found.intrinsics.model == "OPENCV_FISHEYE"
    assert found.intrinsics.trust == "approximate"
    assert found.intrinsics.fx == pytest.approx(CAMERA.fx, rel=0.01)
    assert any("fisheye" in warning for warning in found.warnings)
    last = found.records[-1]
    assert last.lens == found.intrinsics
    if told is not None:
        assert last.correction.focal_factor * told.fx == pytest.approx(found.intrinsics.fx)
    # What is reported is what a request states.
    again = found_in(room, query_of(equidistant, intrinsics=replace(found.intrinsics, trust="exact")))
    assert_right(again)
    assert again.intrinsics_source == "given"


def assert_right(found: PoseEstimate) -> None:
    degrees, units = pose_distance(found.pose, TRUTH)
    assert found.verdict.status is Status.LOCALIZED, found.verdict.reason
    assert degrees < 0.5
    assert units < 0.02


@pytest.mark.parametrize("told", [CAMERA, None])
def test_a_lens_that_no_model_explains_is_refused_as_such(room: LoadedScene, told: Intrinsics | None) -> None:
    found = found_in(room, query_of(taken_through(room, NEITHER), intrinsics=told))
    assert found.verdict.status is Status.UNCERTAIN
    assert found.verdict.reason is Reason.LENS_UNMODELLED
    assert found.verdict.fitting_correction is None


def test_a_plain_photo_is_not_checked(room: LoadedScene) -> None:
    for query in (photo_at(room, TRUTH), query_of(photo_at(room, TRUTH).rgb)):
        found = found_in(room, query)
        assert found.verdict.status is Status.LOCALIZED
        assert "check_lens" not in {record.stage for record in found.records}
        assert found.records[-1].lens is None
