"""The viewer's layers on a canvas that only records: which nodes there are, what they hold, and which are visible."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, TypeVar
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import viser
from fake_service import PHOTO, orbit, records

from service.geometry import moved
from service.results import Candidates
from service.types import Camera, Intrinsics, Pose
from viewer.camera_views import SceneExtent, view_from_behind, view_through
from viewer.frusta import viser_frustum
from viewer.layers.anchor_layer import AnchorLayer
from viewer.layers.axes_layer import AxesLayer
from viewer.layers.candidate_layer import CandidateLayer
from viewer.layers.layer import Layer, linear_colours, quaternion_wxyz
from viewer.layers.match_layer import MatchLayer
from viewer.layers.measure_layer import MeasureLayer
from viewer.layers.splat_layer import SplatLayer
from viewer.layers.training_camera_layer import TrainingCameraLayer
from viewer.layers.trajectory_layer import TrajectoryLayer
from viewer.scene_3d import Scene3D
from viewer.service_values import Job, JobOutcome, Splats

L = TypeVar("L", bound=Layer)
EXTENT = SceneExtent(np.zeros(3), 5.0, np.array([0.0, 0.0, 1.0]), frustum_depth=0.4)


class Canvas:
    """Nodes by path, as viser's scene has them; drawing a path again replaces its node."""

    def __init__(self) -> None:
        self.scene: Any = self
        self.camera: Any = None
        self.up: Any = None
        self.nodes: dict[str, Any] = {}
        self.background: Any = None

    def atomic(self) -> nullcontext:
        return nullcontext()

    def flush(self) -> None: ...

    def set_up_direction(self, up: np.ndarray) -> None:
        self.up = up

    def set_background_image(self, image: np.ndarray, **options: Any) -> None:
        self.background = image, options["format"]

    def _add(self, kind: type, path: str, **values: Any) -> Any:
        node = Mock(spec=kind)
        for name, value in values.items():
            setattr(node, name, value)
        node.remove = lambda: self.nodes.pop(path)
        self.nodes[path] = node
        return node

    def add_line_segments(self, path: str, points: np.ndarray, colors: Any, **values: Any) -> Any:
        return self._add(viser.LineSegmentsHandle, path, points=points, colors=colors, **values)

    def add_point_cloud(self, path: str, points: np.ndarray, colors: Any, **values: Any) -> Any:
        return self._add(viser.PointCloudHandle, path, points=points, colors=colors, **values)

    def add_spline_catmull_rom(self, path: str, points: np.ndarray, **values: Any) -> Any:
        return self._add(viser.SplineCatmullRomHandle, path, points=points, **values)

    def add_camera_frustum(self, path: str, **values: Any) -> Any:
        return self._add(viser.CameraFrustumHandle, path, **values)

    def add_gaussian_splats(self, path: str, **values: Any) -> Any:
        return self._add(viser.GaussianSplatHandle, path, **values)

    def add_label(self, path: str, text: str, **values: Any) -> Any:
        return self._add(viser.LabelHandle, path, text=text, **values)


@pytest.fixture
def canvas() -> Canvas:
    return Canvas()


def on(canvas: Canvas, kind: type[L]) -> L:
    layer = kind(canvas)
    layer.extent = EXTENT
    return layer


def candidates(count: int) -> Candidates:
    poses = np.stack([orbit(k / count).world_from_camera for k in range(count)])
    return Candidates(poses, np.random.default_rng(0).permutation(np.linspace(0.1, 0.9, count)))


def matches(count: int) -> tuple[Any, np.ndarray]:
    segments = np.arange(6.0 * count, dtype=np.float32).reshape(count, 2, 3)
    return SimpleNamespace(segments=segments, drawn=np.arange(count)), np.full((count, 3), 200, np.uint8)


# ------------------------------------------------------------------ all layers


def test_what_has_become_empty_is_removed_and_can_come_back(canvas: Canvas) -> None:
    layers = {
        "candidates": (on(canvas, CandidateLayer), lambda layer, n: layer.show(candidates(n) if n else None, PHOTO)),
        "match vectors": (on(canvas, MatchLayer), lambda layer, n: layer.show(*(matches(n) if n else (None, None)))),
        "training cameras": (
            on(canvas, TrainingCameraLayer),
            lambda layer, n: layer.show([Camera(PHOTO, orbit(k / max(n, 1))) for k in range(n)]),
        ),
    }
    nodes = {"/candidates/candidates", "/candidates/cloud", "/match vectors/vectors", "/match vectors/points"}
    nodes |= {"/training cameras/cameras"}
    for count, expected in ((0, set()), (5, nodes), (0, set()), (3, nodes)):
        for layer, show in layers.values():
            show(layer, count)
        assert set(canvas.nodes) == expected
    for layer, _ in layers.values():
        layer.clear()
    assert not canvas.nodes


def test_what_stays_is_changed_in_place(canvas: Canvas) -> None:
    layer = on(canvas, MatchLayer)
    layer.show(*matches(4))
    before = dict(canvas.nodes)
    layer.show(*matches(7))
    assert canvas.nodes == before
    assert len(canvas.nodes["/match vectors/vectors"].points) == len(canvas.nodes["/match vectors/points"].points) == 7
    assert len(canvas.nodes["/match vectors/points"].colors) == 7
    # The size of points can't be changed in place.
    layer.extent = replace(EXTENT, frustum_depth=0.8)
    layer.show(*matches(7))
    assert canvas.nodes["/match vectors/points"] is not before["/match vectors/points"]


def test_nothing_is_drawn_before_the_size_of_the_scene_is_known(canvas: Canvas) -> None:
    job = job_of(None)
    camera = Camera(PHOTO, orbit(0.0))
    CandidateLayer(canvas).show(candidates(3), PHOTO)
    MatchLayer(canvas).show(*matches(3))
    cameras, trajectory = TrainingCameraLayer(canvas), TrajectoryLayer(canvas)
    cameras.show([camera])
    trajectory.show(records(3), job)
    trajectory.show_current(camera, None)
    trajectory.show_label(camera.pose, "here")
    assert not canvas.nodes
    ray = camera.pose.position_in_world, camera.pose.axis_in_world
    assert cameras.hit(*ray) is trajectory.hit(*ray) is None


def test_a_hidden_layer_stays_hidden_and_is_not_hit(canvas: Canvas) -> None:
    cameras, trajectory = on(canvas, TrainingCameraLayer), on(canvas, TrajectoryLayer)
    camera = Camera(PHOTO, orbit(0.0))
    for layer in (cameras, trajectory):
        layer.set_visible(False)
    for _ in range(2):  # drawn anew, and changed in place
        cameras.show([camera])
        trajectory.show(records(3), job_of(None))
        trajectory.show_label(camera.pose, "here")
        assert canvas.nodes
        assert not any(node.visible for node in canvas.nodes.values())
    behind = camera.pose.position_in_world - 2 * camera.pose.axis_in_world, camera.pose.axis_in_world
    first = records(3)[0].pose
    behind_first = first.position_in_world - 2 * first.axis_in_world, first.axis_in_world
    assert cameras.hit(*behind) is trajectory.hit(*behind_first) is None
    for layer in (cameras, trajectory):
        layer.set_visible(True)
    assert all(node.visible for node in canvas.nodes.values())
    assert cameras.hit(*behind) is camera
    assert trajectory.hit(*behind_first) == 0


def test_rotations_are_unit_quaternions_with_the_scalar_first() -> None:
    for share in (0.05, 0.3, 0.8):
        rotation = orbit(share).world_from_camera
        w, *xyz = quaternion_wxyz(rotation)
        axis = np.array(xyz)
        angle = 2 * np.arctan2(np.linalg.norm(axis), w)
        # Rodrigues' formula, by OpenCV.
        assert np.allclose(cv2.Rodrigues(angle * axis / np.linalg.norm(axis))[0], rotation[:3, :3])


def test_linear_colours_are_those_of_the_srgb_standard() -> None:
    values = np.arange(256)
    x = values / 255
    # IEC 61966-2-1; a power of 2.2 differs from it by at most 0.0078, and values are cut to whole numbers.
    standard = 255 * np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    ours = linear_colours(np.repeat(values[:, None], 3, 1).astype(np.uint8))
    assert np.abs(ours[:, 0] - standard).max() < 3
    assert (ours == ours[:, :1]).all()


# ------------------------------------------------------------------ single layers


@pytest.mark.parametrize(("count", "frusta"), [(3, 3), (24, 24), (40, 24)])
def test_the_24_best_candidates_are_frusta_and_all_are_points(canvas: Canvas, count: int, frusta: int) -> None:
    shown = candidates(count)
    on(canvas, CandidateLayer).show(shown, PHOTO)
    points, segments = canvas.nodes["/candidates/cloud"], canvas.nodes["/candidates/candidates"]
    assert np.allclose(points.points, shown.world_from_camera[:, :3, 3])
    apexes = np.unique(segments.points.reshape(frusta, 8, 2, 3)[:, 0, 0].round(4), axis=0)
    best = np.argsort(-shown.scores)[:frusta]
    assert np.allclose(apexes, np.unique(shown.world_from_camera[best, :3, 3].astype(np.float32).round(4), axis=0))
    # They are smaller than the photo's own frustum.
    corners = segments.points.reshape(frusta, 8, 2, 3)[:, 0]
    height = np.sqrt(1 + (48 / 80) ** 2 + (32 / 80) ** 2)  # from the apex to a corner, at a depth of one
    depths = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1) / height
    assert depths == pytest.approx(0.7 * EXTENT.frustum_depth, rel=1e-4)
    assert points.point_size < 0.1 * EXTENT.frustum_depth
    # The frusta have their points' colours, as linear light.
    assert np.array_equal(segments.colors[::8, 0], linear_colours(points.colors[best]))


def job_of(status: str | None, truth: Pose | None = None) -> Job:
    outcome = JobOutcome(status, "", "") if status else None
    return Job("j", "running", "ball", "", "view_index", "photo.jpg", PHOTO, truth, outcome)


def test_a_path_has_a_frustum_for_each_step_that_moves(canvas: Canvas) -> None:
    moving = records(4)
    still = [replace(moving[0], index=1), *(replace(record, index=record.index + 1) for record in moving[1:])]
    layer = on(canvas, TrajectoryLayer)
    layer.show([moving[0], *still], job_of(None))
    assert set(canvas.nodes) == {"/trajectory/path", "/trajectory/steps", "/trajectory/initial"}
    assert np.allclose(canvas.nodes["/trajectory/path"].points, [r.pose.position_in_world for r in moving])
    # The first has a node of its own, the last is the current or the final one.
    assert len(canvas.nodes["/trajectory/steps"].points) == 8 * 2
    last = moving[-1].pose
    assert layer.hit(last.position_in_world - 3 * last.axis_in_world, last.axis_in_world) in (2, 3, 4)
    layer.clear()
    assert layer.hit(last.position_in_world - 3 * last.axis_in_world, last.axis_in_world) is None
    on(canvas, TrajectoryLayer).show([moving[0]] * 3, job_of(None))
    assert set(canvas.nodes) == {"/trajectory/initial"}  # a camera that stays has no path


def test_two_poses_make_a_path_and_one_that_stays_removes_it(canvas: Canvas) -> None:
    layer = on(canvas, TrajectoryLayer)
    layer.show(records(2), job_of(None))
    assert "/trajectory/path" in canvas.nodes
    layer.show([records(1)[0]] * 2, job_of(None))
    assert "/trajectory/path" not in canvas.nodes


def test_training_cameras_are_smaller_than_the_photos(canvas: Canvas) -> None:
    """Else the photo's own frustum could not be told from those around it."""
    on(canvas, TrainingCameraLayer).show([Camera(PHOTO, Pose(np.eye(4)))])
    assert 0.3 * EXTENT.frustum_depth < canvas.nodes["/training cameras/cameras"].points[..., 2].max()
    assert canvas.nodes["/training cameras/cameras"].points[..., 2].max() < 0.8 * EXTENT.frustum_depth


def test_matches_without_colours_are_not_drawn(canvas: Canvas) -> None:
    layer = on(canvas, MatchLayer)
    view, colours = matches(3)
    layer.show(view, None)
    layer.show(None, colours)
    assert not canvas.nodes


def depth_of(node: Any) -> float:
    """Return the depth of a drawn frustum: viser's scale is proportional to it."""
    return node.scale / viser_frustum(PHOTO, 1.0)[2]


def test_where_frusta_coincide_the_more_important_one_is_deeper(canvas: Canvas) -> None:
    layer = on(canvas, TrajectoryLayer)
    layer.show(records(2), job_of("localized", truth=orbit(0.15)))
    layer.show_current(Camera(PHOTO, orbit(0.15)), None)
    depths = [depth_of(canvas.nodes[f"/trajectory/{name}"]) for name in ("initial", "current", "final", "truth")]
    assert depths == sorted(depths)
    assert depths[1] == pytest.approx(EXTENT.frustum_depth)
    # Near the current one's, so that it doesn't look like another camera's.
    assert 0.5 * EXTENT.frustum_depth < depths[0]
    assert depths[-1] < 1.3 * EXTENT.frustum_depth


def test_the_current_frustum_keeps_its_image_while_it_moves(canvas: Canvas) -> None:
    layer, image = on(canvas, TrajectoryLayer), np.zeros((2, 3, 3), np.uint8)
    layer.show_current(Camera(PHOTO, orbit(0.1)), image)
    node = canvas.nodes["/trajectory/current"]
    layer.show_current(Camera(replace(PHOTO, fx=40.0, fy=40.0), orbit(0.2)), None)
    assert canvas.nodes["/trajectory/current"] is node
    assert node.image is image
    assert np.allclose(node.position, orbit(0.2).position_in_world)
    assert np.allclose(node.wxyz, quaternion_wxyz(orbit(0.2).world_from_camera))
    assert node.fov == pytest.approx(2 * np.arctan(0.5 * PHOTO.height / 40.0))
    layer.show_current(Camera(PHOTO, orbit(0.3)), image + 1)
    assert canvas.nodes["/trajectory/current"] is not node


def test_a_label_is_above_the_image_plane(canvas: Canvas) -> None:
    pose = orbit(0.1)
    on(canvas, TrajectoryLayer).show_label(pose, "here")
    label = canvas.nodes["/trajectory/label"]
    offset = label.position - pose.position_in_world
    aside = offset - offset[2] * EXTENT.up
    assert (aside @ pose.axis_in_world) > 0.9 * np.linalg.norm(aside) > 0
    # Higher than the frustum's upper edge, which is half the image's height over the focal length away.
    edge = EXTENT.frustum_depth * (pose.axis_in_world - 0.5 * PHOTO.height / PHOTO.fy * pose.world_from_camera[:3, 1])
    assert offset @ EXTENT.up > edge @ EXTENT.up


# ------------------------------------------------------------------ splats


def content(variance: float, background: tuple[float, float, float] = (1.0, 0.5, 0.0)) -> Any:
    upper = np.float32(variance) * np.array([[4, 1, 2, 5, 3, 6], [1e-4, 0, 0, 1e-4, 0, 1e-4]], np.float32)
    splats = Splats(np.eye(3, dtype=np.float32)[:2], upper, np.full((2, 4), 7, np.uint8), total=2)
    return SimpleNamespace(splats=splats, description=SimpleNamespace(background_rgb=background))


@pytest.mark.parametrize("variance", [1e-8, 1.0, 1e8])
def test_splats_of_any_size_survive_half_precision(canvas: Canvas, variance: float) -> None:
    layer = on(canvas, SplatLayer)
    assert not layer.pending
    layer.send()
    assert not canvas.nodes
    layer.show(content(variance))
    assert layer.pending
    layer.set_visible(False)
    assert not layer.pending
    layer.set_visible(True)
    layer.send()
    assert not layer.pending
    node = canvas.nodes["/splats/splats"]
    sent = node.covariances.astype(np.float16).astype(np.float64)
    exact = np.array([[4, 1, 2], [1, 5, 3], [2, 3, 6]], np.float64)
    assert np.allclose(sent[0] * node.scale**2, variance * exact, rtol=2e-3)
    # A ten-thousandth of the size still has its digits.
    assert np.allclose(sent[1] * node.scale**2, variance * 1e-4 * np.eye(3), rtol=2e-3)
    assert np.allclose(node.centers * node.scale, np.eye(3)[:2], atol=1e-6)
    assert np.array_equal(node.rgbs, np.full((2, 3), 7))
    assert np.array_equal(node.opacities, np.full((2, 1), 7))
    layer.show(content(variance))
    assert layer.pending  # another scene's splats replace them
    assert not canvas.nodes


def test_a_render_covers_the_splats_and_leaves_the_background_colour(canvas: Canvas) -> None:
    layer, image = on(canvas, SplatLayer), np.zeros((4, 5, 3), np.uint8)
    layer.show(content(1.0))
    layer.show_background(image)
    layer.send()
    assert not canvas.nodes["/splats/splats"].visible
    assert canvas.background == (image, "jpeg")
    layer.show_background(None)
    assert canvas.nodes["/splats/splats"].visible
    colour, kind = canvas.background
    assert kind == "png"  # a lossy one would have another colour
    assert colour.tolist() == [[[255, 127, 0]]]
    layer.set_visible(False)
    layer.show_background(None)
    assert not canvas.nodes["/splats/splats"].visible


def test_another_scene_begins_with_its_own_view_size_and_background(canvas: Canvas) -> None:
    canvas.camera = SimpleNamespace(aspect=1.5)
    scene, training = Scene3D(canvas), Camera(PHOTO, orbit(0.6))
    assert scene.metres_per_unit is None
    for pose, metres, colour in ((None, 0.5, (1.0, 0.0, 0.0)), (orbit(0.2), None, (0.0, 0.0, 1.0))):
        described = SimpleNamespace(background_rgb=colour, cameras=(SimpleNamespace(camera=training),))
        described.metres_per_unit = metres
        splats = Splats(np.zeros((1, 3), np.float32), np.full((1, 6), 1e-4, np.float32), np.zeros((1, 4), np.uint8), 1)
        shown: Any = SimpleNamespace(description=described, splats=splats, extent=EXTENT)
        scene.splats.show_background(np.zeros((4, 5, 3), np.uint8))  # the last scene's
        scene.show_scene(shown, pose)
        assert canvas.background[0].tolist() == [[[255 * part for part in colour]]]
        assert "/training cameras/cameras" in canvas.nodes
        assert scene.metres_per_unit == metres
        assert np.array_equal(canvas.up, EXTENT.up)
        wanted = view_from_behind(pose, EXTENT, splats.centres) if pose else view_through(training, EXTENT, 1.0)
        assert np.allclose(canvas.camera.position, wanted.position)
        assert np.allclose(canvas.camera.look_at, wanted.look_at)
        # One looks through a camera: its own frustum is before the near plane, the scene behind it.
        assert EXTENT.frustum_depth < canvas.camera.near < 2 * EXTENT.frustum_depth
        assert canvas.camera.far > 100 * EXTENT.radius
    scene.trajectory.show(records(3), job_of(None))
    scene.candidates.show(candidates(3), PHOTO)
    scene.matches.show(*matches(3))
    here = records(3)[-1].pose
    behind = here.position_in_world - 3 * here.axis_in_world
    assert isinstance(scene.hit(behind.tolist(), here.axis_in_world.tolist()), int)
    scene.clear_job()
    assert not any(path.startswith(("/trajectory", "/candidates", "/match vectors")) for path in canvas.nodes)
    assert "/training cameras/cameras" in canvas.nodes
    away = training.pose.position_in_world - 3 * training.pose.axis_in_world
    assert scene.hit(away.tolist(), training.pose.axis_in_world.tolist()) is training


def test_views_of_a_scene_and_its_floor_plan(canvas: Canvas) -> None:
    canvas.camera = SimpleNamespace(aspect=1.5)
    scene, training = Scene3D(canvas), Camera(PHOTO, orbit(0.6))
    # Without a scene nothing can be looked at.
    scene.look_from_above()
    scene.look_at_first()
    scene.look_from_behind(orbit(0.2))
    scene.set_visible("floor plan", True)
    assert vars(canvas.camera) == {"aspect": 1.5}
    assert canvas.nodes == {}
    assert not scene.is_visible("coverage")
    centres = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32)
    splats = Splats(centres, np.tile(np.float32(1e-4), (200, 6)), np.full((200, 4), 200, np.uint8), 200)
    described = SimpleNamespace(background_rgb=(0.0, 0.0, 0.0), cameras=(SimpleNamespace(camera=training),))
    described.metres_per_unit = 1.0
    shown: Any = SimpleNamespace(description=described, splats=splats, extent=EXTENT)
    scene.show_scene(shown, orbit(0.2))
    # Megabytes that most browsers never need; this one has asked for them, and gets them with each scene.
    assert "/floor plan/points" in canvas.nodes
    scene.set_visible("floor plan", False)
    scene.show_scene(shown, orbit(0.2))
    assert "/floor plan/points" not in canvas.nodes
    scene.set_visible("coverage", True)
    assert "/floor plan/points" not in canvas.nodes
    scene.set_visible("floor plan", True)
    assert canvas.nodes["/floor plan/points"].visible
    scene.look_from_above()
    down = canvas.camera.look_at - canvas.camera.position
    assert np.allclose(down / np.linalg.norm(down), [0, 0, -1])
    scene.look_at_first()
    assert np.allclose(canvas.camera.position, view_through(training, EXTENT, 1.0).position)
    scene.look_through(Camera(PHOTO, orbit(0.4)))
    assert np.allclose(canvas.camera.position, orbit(0.4).position_in_world)
    # What was measured and picked in one scene isn't in the next one.
    origin = centres[0] + np.array([0, 0, 50.0])
    for _ in range(2):
        scene.measure(origin.tolist(), [0.0, 0.0, -1.0])
    scene.anchors.pick(np.array([1.0, 2.0, 3.0]))
    assert {"/anchors/picked"} <= set(canvas.nodes)
    assert any(path.startswith("/measured distance") for path in canvas.nodes)
    scene.show_scene(shown, None)
    assert not any(path.startswith(("/measured distance", "/anchors")) for path in canvas.nodes)


@pytest.mark.parametrize(("metres_per_unit", "told"), [(None, "5 units"), (2.5, "12.5 m")])
def test_two_points_have_a_distance_and_a_third_begins_another(
    canvas: Canvas, metres_per_unit: float | None, told: str
) -> None:
    bare, here = MeasureLayer(canvas), on(canvas, MeasureLayer)
    bare.add(np.zeros(3), None)
    assert canvas.nodes == {}  # of no scene
    path = "/measured distance/"
    for _ in range(2):
        here.add(np.array([1.0, 2.0, 3.0]), metres_per_unit)
        assert set(canvas.nodes) == {path + "points"}
        here.add(np.array([1.0, 5.0, 7.0]), metres_per_unit)
        assert set(canvas.nodes) == {path + "points", path + "line", path + "length"}
    assert canvas.nodes[path + "length"].text == told
    np.testing.assert_array_equal(canvas.nodes[path + "length"].position, [1, 3.5, 5])
    np.testing.assert_array_equal(canvas.nodes[path + "line"].points, [[[1, 2, 3], [1, 5, 7]]])
    points = canvas.nodes[path + "points"]
    assert 0.05 < points.point_size / EXTENT.frustum_depth < 0.5
    assert points.colors.tolist() == [list(canvas.nodes[path + "line"].colors)] * 2
    here.clear()
    assert canvas.nodes == {}
    here.add(np.zeros(3), metres_per_unit)
    assert set(canvas.nodes) == {path + "points"}


@pytest.mark.parametrize(
    ("centre", "metres_per_unit", "label", "length", "origin"),
    [
        ((0, 0, 0), None, "x, 2 units", 2.0, (0, 0, 0)),  # 0.4 radii of 5
        ((0, 0, 0), 4.0, "x, 5 m", 1.25, (0, 0, 0)),
        ((9.9, 0, 0), None, "x, 2 units", 2.0, (0, 0, 0)),
        ((10.1, 0, 0), None, "x, 2 units", 2.0, (10.1, 0, 0)),  # in map coordinates
    ],
)
def test_axes_have_a_round_length_and_stand_where_they_can_be_seen(
    canvas: Canvas, centre: tuple, metres_per_unit: float | None, label: str, length: float, origin: tuple
) -> None:
    bare = AxesLayer(canvas)
    bare.show(None)
    assert canvas.nodes == {}
    layer = on(canvas, AxesLayer)
    up = np.array([0.0, 0.6, 0.8])
    layer.extent = replace(EXTENT, centre=np.array(centre, float), up=up)
    layer.show(metres_per_unit)
    lines = canvas.nodes["/axes and scale/lines"]
    np.testing.assert_allclose(lines.points[:, 0], np.tile(origin, (4, 1)), rtol=1e-6)
    ends = origin + length * np.vstack([np.eye(3), up])
    np.testing.assert_allclose(lines.points[:, 1], ends, rtol=1e-6)
    # Red, green, blue for x, y, z, as everywhere; up is white.
    for k in range(3):
        assert np.argmax(lines.colors[k, 0]) == k
        assert np.array_equal(lines.colors[k, 0], lines.colors[k, 1])
    assert len(set(lines.colors[3, 0].tolist())) == 1
    for name, end in zip("xyz", ends, strict=False):
        np.testing.assert_allclose(canvas.nodes[f"/axes and scale/{name}"].position, end)
    assert canvas.nodes["/axes and scale/x"].text == label
    assert canvas.nodes["/axes and scale/up"].text == "up"


def test_a_picked_point_is_drawn_larger_than_anchors(canvas: Canvas) -> None:
    layer = on(canvas, AnchorLayer)
    layer.show({"door": np.array([1.0, 1.0, 1.0])})
    layer.pick(np.array([1.0, 2.0, 3.0]))
    anchor, picked = canvas.nodes["/anchors/points"], canvas.nodes["/anchors/picked"]
    np.testing.assert_array_equal(picked.points, [[1, 2, 3]])
    # Both are smaller than a camera's frustum, so that they don't hide it.
    depth = EXTENT.frustum_depth
    assert 0.05 * depth < anchor.point_size < picked.point_size < 0.5 * depth
    assert not np.array_equal(anchor.colors, picked.colors)


@pytest.mark.parametrize(("width", "height", "fx", "fy"), [(300, 200, 90.0, 120.0), (100, 500, 400.0, 800.0)])
def test_visers_frustum_has_the_photos_angles_and_depth(width: int, height: int, fx: float, fy: float) -> None:
    """As viser's page draws it: a pyramid of depth 1, divided by the cube root of x y z / 3, times `scale`."""
    fov, aspect, scale = viser_frustum(Intrinsics(width, height, fx, fy, 10.0, 20.0), 0.25)
    y = np.tan(fov / 2)
    x = y * aspect
    assert (x, y) == pytest.approx((width / 2 / fx, height / 2 / fy))
    assert scale / np.cbrt(x * y * 1.0 / 3) == pytest.approx(0.25)


# ------------------------------------------------------------------ where the view goes


@pytest.mark.parametrize(("between", "far"), [(0, True), (11, True), (12, False), (40, False)])
def test_a_dozen_splats_between_occlude_a_camera(between: int, far: bool) -> None:
    """Counted on the line of sight from the farthest place, all of them beyond the next one."""
    pose = Pose(np.eye(4))
    extent = SceneExtent(np.zeros(3), 5.0, np.array([0.0, -1.0, 0.0]), frustum_depth=1.0)
    free = view_from_behind(pose, extent, np.zeros((0, 3), np.float32))
    splats = np.repeat(0.95 * free.position[None], between, 0).astype(np.float32)
    chosen = view_from_behind(pose, extent, splats)
    assert bool(np.allclose(chosen.position, free.position)) is far
    assert np.linalg.norm(chosen.position) <= np.linalg.norm(free.position)
    # From the nearest place, too, the whole frustum is in front.
    assert (np.array([0, 0, 1.0]) - chosen.position)[2] > 2


@pytest.mark.parametrize(("aside", "occluded"), [(0.45, True), (0.55, False)])
def test_what_is_within_half_a_frustum_of_the_line_of_sight_occludes(aside: float, occluded: bool) -> None:
    """Of a small scene far from the origin: all is relative to the camera, in depths of its frustum."""
    pose, depth = Pose(moved(Pose(np.eye(4)), np.array([0, 0, 0, 30.0, -20.0, 10.0])).world_from_camera), 0.2
    extent = SceneExtent(pose.position_in_world, 2.5, np.array([0.0, -1.0, 0.0]), frustum_depth=depth)
    free = view_from_behind(pose, extent, np.zeros((0, 3), np.float32))
    # It looks along the camera's axis, and at something in front of the frustum, within the scene.
    ahead = (free.look_at - pose.position_in_world) / depth
    np.testing.assert_allclose(ahead[:2], 0, atol=1e-9)
    assert 2 < ahead[2] < extent.radius / depth
    sight = pose.position_in_world + 0.95 * (free.position - pose.position_in_world)
    splats = np.tile(sight + np.array([aside * depth, 0, 0]), (40, 1)).astype(np.float32)
    chosen = view_from_behind(pose, extent, splats)
    assert bool(np.allclose(chosen.position, free.position)) is not occluded
