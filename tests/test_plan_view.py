"""The viewer's layers of a whole scene: coverage map, poses of all jobs, floor plan, and the view from above."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from fake_service import PHOTO, FakeService, coverage_map, orbit
from test_layers import Canvas, on

from service.client import Client
from service.coverage.plan_drawing import LEVELS
from service.geometry import look_at, project, transformed
from service.results import Reason, Status
from service.scene_manager.status import CoverageStatus
from service.types import Camera, Intrinsics
from service.web.schemas.coverage import coverage_status_out
from viewer.camera_views import SceneExtent, scene_extent, view_from_above
from viewer.colours import BLIND_COLOUR, COVERAGE_LEVELS, STATUS_COLOURS, coverage_colour
from viewer.layers.anchor_layer import AnchorLayer
from viewer.layers.coverage_layer import CoverageLayer
from viewer.layers.floor_plan_layer import FloorPlanLayer, below_the_cut
from viewer.layers.job_poses_layer import JobPosesLayer
from viewer.layers.layer import linear_colours
from viewer.panel_html import coverage_html
from viewer.plan_display import PlanDisplay
from viewer.scene_cache import SceneCache
from viewer.service_values import coverage_of, found_cameras


@pytest.fixture
def canvas() -> Canvas:
    return Canvas()


@pytest.fixture
def fake() -> FakeService:
    return FakeService()


@pytest.fixture
def client(fake: FakeService) -> Client:
    return Client("http://fake", transport=fake.transport)


def answered(status: CoverageStatus):
    return coverage_of(coverage_status_out(status, "/").model_dump(mode="json"))


def test_a_ray_points_where_the_camera_looks_in_the_colour_of_the_legend(canvas: Canvas) -> None:
    answer = answered(CoverageStatus("ready", found=coverage_map()))
    assert answer.found
    on(canvas, CoverageLayer).show(answer.found)
    node = canvas.nodes["/coverage/rays"]
    rays = node.points[:, 1] - node.points[:, 0]
    np.testing.assert_allclose(rays[:4] / np.linalg.norm(rays[:4], axis=1)[:, None], [
        [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0],
    ], atol=1e-6)  # fmt: skip
    assert (np.linalg.norm(node.points[:4, 1] - orbit(0).position_in_world, axis=1) < 0.5 * 0.8).all()
    expected = linear_colours(np.array([coverage_colour(1.0)] * 3 + [BLIND_COLOUR], np.uint8))
    np.testing.assert_array_equal(node.colors[:4, 0], expected)
    # Each begins beside the middle of its cell, on the side that it points to.
    begins = node.points[:4, 0] - orbit(0).position_in_world
    assert (np.einsum("kj,kj->k", begins, rays[:4]) > 0).all()
    layer = on(canvas, CoverageLayer)
    layer.show(answer.found)
    layer.show(None)
    assert canvas.nodes == {}


def test_the_legend_has_the_words_and_bounds_of_the_drawing() -> None:
    assert [(least, words) for least, _, words in COVERAGE_LEVELS] == [(least, words) for least, _, words in LEVELS]
    text = coverage_html(answered(CoverageStatus("ready", found=coverage_map())))
    assert "upper bound" in text
    for _, _, words in LEVELS:
        assert words in text
    assert "3 of 10 test renders" in coverage_html(answered(CoverageStatus("running", 3, 10)))
    assert "not measured yet" in coverage_html(answered(CoverageStatus("none")))


def test_all_jobs_of_the_scene_are_shown_but_for_photos_that_were_not_localized(
    canvas: Canvas, fake: FakeService, client: Client
) -> None:
    fake.job("one", 3, finished=True)
    fake.job("two", 3).finish(Status.UNCERTAIN, Reason.FEW_INLIERS)
    fake.job("none", 3).finish(Status.NOT_LOCALIZED, Reason.NO_MATCHING_VIEW)
    cameras = [camera for name in ("one", "two", "none") for camera in found_cameras(client.job(name))]
    assert [found.status for found in cameras] == ["localized", "uncertain"]
    on(canvas, JobPosesLayer).show(cameras)
    node = canvas.nodes["/poses of all jobs/cameras"]
    assert len(node.points) == 16
    expected = linear_colours(np.array([STATUS_COLOURS["localized"], STATUS_COLOURS["uncertain"]], np.uint8))
    np.testing.assert_array_equal(node.colors[[0, 8], 0], expected)


def test_the_floor_plan_is_what_lies_below_the_cameras(canvas: Canvas, client: Client) -> None:
    content = SceneCache(client).get("ball")
    # Cameras stand all around in the middle of the scene's height, if x is taken for that.
    content = replace(content, extent=replace(content.extent, up=np.array([1.0, 0.0, 0.0])))
    cut = below_the_cut(content)
    np.testing.assert_array_equal(cut, content.splats.centres[:, 0] < 0.15 * content.extent.radius)
    assert 0 < cut.sum() < len(cut)
    on(canvas, FloorPlanLayer).show(content)
    assert len(canvas.nodes["/floor plan/points"].points) == cut.sum()
    without = replace(content, description=replace(content.description, cameras=()))
    assert 0.4 < below_the_cut(without).mean() < 0.6


@pytest.mark.parametrize("aspect", [0.5, 1.8])
def test_from_above_all_cameras_are_in_view_and_x_is_right(aspect: float) -> None:
    cameras = [Camera(PHOTO, orbit(share)) for share in np.arange(12) / 12]
    points = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    scene = scene_extent(points, cameras, (0.0, 0.0, 1.0))
    view = view_from_above(scene, cameras, points, aspect)
    focal = 50 / np.tan(view.fov_rad / 2)
    lens = Intrinsics(round(100 * aspect), 100, focal, focal, 50 * aspect, 50)
    seen = look_at(view.position, view.look_at, view.up)
    at = transformed(seen.camera_from_world, np.array([c.pose.position_in_world for c in cameras]))
    px = project(at, lens)
    assert px.min() > 0
    assert (px < [lens.width, 100]).all()
    # Nearly without perspective: the same scale all over.
    right = project(transformed(seen.camera_from_world, np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])), lens)
    assert right[1, 0] > right[0, 0]
    assert right[1, 1] == pytest.approx(right[0, 1], abs=1e-6)
    assert right[2, 1] < right[0, 1]


def test_from_above_is_along_the_scenes_upright_wherever_that_points() -> None:
    up = np.array([0.6, 0.48, 0.64])
    scene = SceneExtent(np.array([10.0, 20.0, 30.0]), 2.0, up, 0.2)
    points = (scene.centre + np.random.default_rng(0).normal(size=(300, 3))).astype(np.float32)
    view = view_from_above(scene, [], points, 1.5)
    down = view.look_at - view.position
    np.testing.assert_allclose(down / np.linalg.norm(down), -up, atol=1e-9)
    assert view.up @ up == pytest.approx(0, abs=1e-9)
    # What is right is the y axis, the nearest to a horizontal one, as far as it is horizontal.
    right = np.cross(down, view.up)
    np.testing.assert_allclose(
        right / np.linalg.norm(right), (np.eye(3)[1] - 0.48 * up) / np.sqrt(1 - 0.48**2), atol=1e-9
    )
    # It looks at the middle of the points, at the height of the scene's centre.
    assert np.linalg.norm(view.look_at - scene.centre) < 0.5
    assert (view.look_at - scene.centre) @ up == pytest.approx(0, abs=1e-6)


def display(client: Client) -> Any:
    controls, scene, scene_display = Mock(), Mock(), Mock(scene_id="ball")
    names = ("splats", "floor plan", "training cameras", "poses of all jobs", "coverage", "anchors")
    controls.exact.value = True
    controls.layers = {name: Mock(value=name in ("splats", "training cameras")) for name in names}
    visible = {name: widget.value for name, widget in controls.layers.items()}
    scene_display.set_layer_visible = visible.__setitem__
    scene.is_visible = visible.__getitem__
    found = PlanDisplay(controls, scene, Mock(), scene_display, client)
    found.visible = visible  # type: ignore[attr-defined]
    return found


def test_the_plan_view_shows_the_jobs_and_leaves_all_as_it_was(fake: FakeService, client: Client) -> None:
    fake.job("one", 3, finished=True)
    plan = display(client)
    before = dict(plan.visible)
    plan.set_plan_view(True)
    shown = {"floor plan", "training cameras", "poses of all jobs"}
    assert {name for name, visible in plan.visible.items() if visible} == shown
    assert plan._scene.look_from_above.called
    plan._background.set_enabled.assert_called_with(False)
    assert [found.status for found in plan._scene.job_poses.show.call_args.args[0]] == ["localized"]
    plan.set_plan_view(False)
    assert {**plan.visible, "poses of all jobs": False} == before
    plan._background.set_enabled.assert_called_with(True)


def test_a_job_that_has_ended_is_requested_once(fake: FakeService, client: Client) -> None:
    fake.job("one", 3, finished=True)
    fake.job("runs", 2)
    plan = display(client)
    for _ in range(3):
        plan.set_layer_visible("poses of all jobs", True)
    assert fake.asked.count("/jobs/one") == 1
    assert "/jobs/runs" not in fake.asked


def test_coverage_is_requested_when_its_layer_is_shown(fake: FakeService, client: Client) -> None:
    plan = display(client)
    plan.refresh()
    assert "/scenes/ball/coverage" not in fake.asked
    fake.coverage = CoverageStatus("ready", found=coverage_map())
    plan.set_layer_visible("coverage", True)
    assert plan._scene.coverage.show.call_args.args[0].title.startswith("Coverage, upper bound")
    assert "upper bound" in plan._controls.coverage.content


def test_anchors_are_drawn_with_their_names_and_a_picked_point_is_offered_to_be_named(
    canvas: Canvas, fake: FakeService, client: Client
) -> None:
    fake.anchors = {"door": [1.0, 2.0, 3.0], "lamp": [0.0, 0.0, 1.0]}
    layer = on(canvas, AnchorLayer)
    layer.show(client.anchors("ball"))
    assert [canvas.nodes[f"/anchors/name {k}"].text for k in range(2)] == ["door", "lamp"]
    np.testing.assert_allclose(canvas.nodes["/anchors/points"].points, [[1, 2, 3], [0, 0, 1]])
    layer.show({})
    assert not canvas.nodes
    plan = display(client)
    plan._scene.surface.return_value = np.array([0.5, -1.25, 3.0])
    plan.pick_point([0, 0, 0], [0, 0, 1])
    assert "./#/scenes/ball?point=0.5,-1.25,3'" in plan._controls.anchor.content
    plan._scene.surface.return_value = None
    plan._controls.anchor.content = ""
    plan.pick_point([0, 0, 0], [0, 0, 1])
    assert plan._controls.anchor.content == ""
    plan.set_layer_visible("anchors", True)
    assert list(plan._scene.anchors.show.call_args.args[0]) == ["door", "lamp"]


def test_coverage_is_asked_for_each_second_while_it_is_measured_and_shown(
    fake: FakeService, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=100.0, monotonic=lambda: clock.now)
    monkeypatch.setattr("viewer.plan_display.time", clock)
    plan = display(client)
    assert plan.due_in_s is None
    fake.coverage = CoverageStatus("running", 3, 10)
    plan.set_layer_visible("coverage", True)
    assert plan.due_in_s == 1.0
    assert "3 of 10" in plan._controls.coverage.content
    clock.now += 0.75
    assert plan.due_in_s == 0.25
    clock.now += 2
    assert plan.due_in_s == 0.0
    plan.set_layer_visible("coverage", False)
    assert plan.due_in_s is None
    fake.coverage = CoverageStatus("ready", found=coverage_map())
    plan.set_layer_visible("coverage", True)
    assert plan.due_in_s is None
    assert plan._scene.coverage.show.call_args.args[0] is not None
