"""Renders and what is taken from them, and the loops of the published methods: by hand, with planted renders."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_search_thresholds import HERE, QUERY, drained

from service import localize as localizing
from service.errors import InvalidOptions
from service.estimators import inerf, mc_do
from service.geometry import look_at, moved, transformed, unproject
from service.interfaces import Features, Frame, ImagePairs
from service.pose.descent.contribution_pruning import contributions
from service.pose.features import rendered_views
from service.pose.features.rendered_views import RenderedView, ViewRenderer, backprojected, to_uint8
from service.pose.matching import render_and_match
from service.pose.retrieval import viewpoints
from service.results import IterationRecord, Status
from service.types import Camera, Intrinsics

SMALL = Intrinsics(64, 48, 50.0, 60.0, 30.0, 25.0)
CAMERA = Camera(SMALL, moved(HERE, np.array([0.1, -0.2, 0.3, 1.0, 2, 3])))


def frame_of(depth: np.ndarray, alpha: float = 1.0) -> Frame:
    return Frame(np.zeros((*depth.shape, 3), np.float32), np.full_like(depth, alpha), depth, depth)


# ------------------------------------------------------------------ renders that show the same


def test_a_render_shows_the_same_where_nine_in_ten_points_hardly_move() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    rendered = RenderedView(frame_of(depth), CAMERA)

    def beside(pixels: float, size: Intrinsics = SMALL) -> Camera:
        # A pixel is 2 / 50 of a unit at this depth.
        return Camera(size, moved(CAMERA.pose, np.array([0, 0, 0, pixels * 2 / 50, 0, 0])))

    assert rendered.shows_the_same_as(Camera(replace(SMALL), CAMERA.pose), 0.0)
    assert rendered.shows_the_same_as(beside(0.99), 1.0)
    assert not rendered.shows_the_same_as(beside(1.01), 1.0)
    assert not rendered.shows_the_same_as(beside(0.0, replace(SMALL, width=65)), 9.0)
    assert not rendered.shows_the_same_as(beside(0.0, replace(SMALL, cx=33.0)), 2.0)
    # Of the twelve pixels that are looked at one may be nearer, so that it moves further, but not two.
    for count, same in ((1, True), (2, False)):
        near = depth.copy()
        near[4, 4 : 4 + 16 * count : 16] = 0.5
        assert RenderedView(frame_of(near), CAMERA).shows_the_same_as(beside(0.5), 1.0) is same
    # Where nothing is seen nothing is compared: one point that moves by two pixels.
    only = np.zeros((48, 64), np.float32)
    assert not RenderedView(frame_of(only), CAMERA).shows_the_same_as(beside(0.5), 1.0)
    only[36, 52] = 2.0
    assert RenderedView(frame_of(only), CAMERA).shows_the_same_as(beside(0.9), 1.0)


def test_renders_ahead_are_made_in_one_call_where_the_renderer_prefers_that() -> None:
    calls: list[int] = []

    def render(cameras: list[Camera]) -> list[Frame]:
        calls.append(len(cameras))
        return [frame_of(np.full((48, 64), 2.0, np.float32)) for _ in cameras]

    others = [Camera(SMALL, moved(HERE, np.array([0, 0, 0, float(k), 0, 0]))) for k in range(3)]
    for at_once, expected in ((2, [3]), (1, [1, 1])):
        calls.clear()
        renderer = ViewRenderer(SimpleNamespace(render=render, cameras_at_once=at_once))  # type: ignore[arg-type]
        renderer.render_ahead(others)
        assert renderer.render(others[2]).camera == others[2]
        renderer.render(others[1])
        assert calls == expected
    # Within a pixel the latest one is taken, whatever was rendered ahead.
    latest = renderer.latest
    assert renderer.near(Camera(SMALL, moved(others[1].pose, np.array([0, 0, 0, 0.03, 0, 0])))) is latest
    assert renderer.near(Camera(SMALL, moved(others[1].pose, np.array([0, 0, 0, 0.05, 0, 0])))) is not latest


def test_features_have_the_median_depth_of_nine_pixels_of_one_surface() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    depth[9:12, 19:22] = np.array([[2.00, 2.01, 2.02], [2.03, 2.04, 2.05], [2.06, 2.07, 2.08]])
    depth[30, 40] = 2.121  # by more than 0.06 of the others
    depth[30, 50] = 2.119
    depth[40, 10] = 0.0
    alpha = np.ones((48, 64), np.float32)
    alpha[20, 30], alpha[20, 34] = 0.5, 0.51
    px = np.array(
        [[20.7, 10.2], [40.5, 30.5], [49.5, 29.5], [9.5, 40.5], [30.5, 20.5], [34.5, 20.5], [0.2, 47.9]], np.float32
    )
    features = Features(px, np.arange(7, dtype=np.float32), np.arange(14, dtype=np.float32).reshape(7, 2))
    view = backprojected(features, replace(frame_of(depth), alpha=alpha), CAMERA)
    kept = [0, 2, 5, 6]
    assert view.features.scores.tolist() == kept
    assert view.features.descriptors.tolist() == features.descriptors[kept].tolist()
    points = unproject(px[kept], np.array([2.04, 2, 2, 2]), SMALL)
    assert view.points_in_world == pytest.approx(transformed(CAMERA.pose.world_from_camera, points), abs=1e-5)
    away = np.linalg.norm(points, axis=1)
    assert view.distance == pytest.approx(np.median(away), abs=1e-5)


def test_renders_become_bytes_within_their_range() -> None:
    rgb = np.array([[[-0.5, 0.0, 0.2], [0.5, 1.0, 1.7]]], np.float32)
    assert to_uint8(rgb)[0].tolist() == [[0, 0, 51], [128, 255, 255]]


def test_pairs_of_images_have_the_photos_pixels_and_the_renders_points() -> None:
    pairs = ImagePairs(
        np.array([[10, 20], [30, 40]], np.float32), np.array([[12, 22], [33, 44]], np.float32), np.ones(2, np.float32)
    )
    images: Any = SimpleNamespace(query=QUERY, resized=lambda size: np.zeros((48, 64, 3), np.uint8))
    matcher: Any = SimpleNamespace(match_images=lambda photo, render: pairs)
    rasterizer: Any = SimpleNamespace(
        cameras_at_once=1, render=lambda cameras: [frame_of(np.full((48, 64), 2.0, np.float32))]
    )
    ((found, _),) = render_and_match.render_and_match([CAMERA], rasterizer, images, matcher)
    # The photo has 416 x 312 pixels: 6.5 times as many in each direction.
    assert found.photo_px.tolist() == [[65, 130], [195, 260]]
    assert found.view_px.tolist() == pairs.b_px.tolist()
    few: Any = SimpleNamespace(photo_px=np.zeros((7, 2)), view_px=np.zeros((7, 2)))
    assert render_and_match.epipolar_inliers(few, SMALL).tolist() == [False] * 7


# ------------------------------------------------------------------ iNeRF's pixels


def test_inerf_draws_pixels_of_the_interest_regions_and_all_where_those_are_small(monkeypatch) -> None:
    region = np.zeros((10, 20), bool)
    region[2:5, 3:9] = True
    monkeypatch.setattr(inerf, "interest_region", lambda photo: region)
    photo = np.zeros((10, 20, 3), np.uint8)
    draw = inerf._pixel_sampler(photo, 18, np.random.default_rng(0))
    assert (draw()[..., 0] > 0).tolist() == region.tolist()
    draw = inerf._pixel_sampler(photo, 5, np.random.default_rng(0))
    one, other = draw()[..., 0], draw()[..., 0]
    for mask in (one, other):
        assert mask.mean() == pytest.approx(1.0)
        assert sorted(np.unique(mask)) == [0.0, 40.0]
        assert not (mask > 0)[~region].any()
    assert (one != other).any()
    few = inerf._pixel_sampler(photo, 19, np.random.default_rng(0))()[..., 0]
    assert (few > 0).sum() == 19
    assert (few > 0)[~region].any()
    assert inerf._pixel_sampler(photo, 1000, np.random.default_rng(0))().tolist() == np.ones((10, 20, 1)).tolist()
    loss = inerf._on_pixels(lambda render: (0.7, render + 2), one[..., None])
    value, gradient = loss(np.ones((10, 20, 3), np.float32))
    assert (value, gradient.tolist()) == (0.7, (3 * np.repeat(one[..., None], 3, 2)).tolist())


# ------------------------------------------------------------------ the supplement's loops


def decoupled(monkeypatch: pytest.MonkeyPatch, supports: list[float | None], solver: str = "least_squares"):
    """Optimize where each render's matches are solved with such a support, a unit further each time."""
    poses = [moved(HERE, np.array([0, 0, 0, k + 1.0, 0, 0])) for k in range(len(supports))]
    solved = iter(
        None if support is None else SimpleNamespace(pose=pose, support=support)
        for pose, support in zip(poses, supports, strict=True)
    )
    rounds: list[Any] = []
    monkeypatch.setattr(mc_do, "_solve", lambda m, pose, query, tools, number: rounds.append(number) or next(solved))
    monkeypatch.setattr(mc_do, "render_and_match", lambda cameras, *_: iter([(None, None)]))
    monkeypatch.setattr(mc_do, "_record", lambda stage, pose, *_: IterationRecord(stage, pose))
    options = mc_do.Options(iterations=len(supports), solver=solver)  # type: ignore[arg-type]
    tools: Any = SimpleNamespace(rasterizer=None, image_matcher=None)
    records, best = drained(mc_do._optimize_decoupled(HERE, SimpleNamespace(query=QUERY), tools, options))  # type: ignore[arg-type]
    return [record.pose.position_in_world[0] for record in records], best.position_in_world[0], rounds, records


def test_the_decoupled_pose_is_the_one_with_the_most_support(monkeypatch) -> None:
    shown, best, rounds, records = decoupled(monkeypatch, [5.0, 9.0, 9.0, 4.0])
    assert (shown, best, rounds) == ([1, 2, 2, 2], 2, [None] * 4)
    assert [record.step_units for record in records] == pytest.approx([1.0] * 4)
    assert decoupled(monkeypatch, [0.0, 0.0])[1] == 1
    # Without enough matches it ends.
    shown, best, rounds, _ = decoupled(monkeypatch, [5.0, None, 9.0], "gradient")
    assert (shown, best, rounds) == ([1, 1], 1, [0, 1])
    assert decoupled(monkeypatch, [None])[1] == 0


def test_the_descents_pose_is_the_one_of_least_loss(monkeypatch) -> None:
    steps = [
        SimpleNamespace(pose=moved(HERE, np.array([0, 0, 0, k + 1.0, 0, 0])), loss=loss)
        for k, loss in enumerate((3.0, 1.0, 1.0, 2.0))
    ]
    monkeypatch.setattr(mc_do, "descend", lambda *_: iter(steps))
    monkeypatch.setattr(mc_do, "loss_against", lambda *_: None)
    images: Any = SimpleNamespace(query=QUERY, resized=lambda size: None, valid_mask=lambda size: None)
    tools: Any = SimpleNamespace(prepared=SimpleNamespace(focus=None), rasterizer=None)
    records = list(mc_do._descend(HERE, images, tools, mc_do.Options()))
    assert [(record.pose.position_in_world[0], record.loss) for record in records] == [(1, 3), (2, 1), (2, 1), (2, 2)]


def test_a_gaussians_contribution_is_its_largest_in_any_view() -> None:
    # Derivatives by the base coefficient are weights times its basis value, 1 / (2 sqrt(pi)).
    base = 0.5 / np.sqrt(np.pi)
    found = iter(
        [
            SimpleNamespace(index=np.array([0, 2]), sh=base * np.array([[[1.0, 4, 2]], [[7.0, 0, 0]]])),
            SimpleNamespace(index=np.array([2, 3]), sh=base * np.array([[[5.0, 6, 1]], [[0.0, 0, 2]]])),
        ]
    )
    asked: list[np.ndarray] = []
    rasterizer: Any = SimpleNamespace(scene_gradients=lambda camera, ones: asked.append(ones) or next(found))
    scene: Any = SimpleNamespace(count=5)
    assert contributions(scene, rasterizer, [CAMERA, CAMERA]) == pytest.approx([4, 0, 7, 2, 0])
    assert asked[0].shape == (48, 64, 3)


# ------------------------------------------------------------------ viewpoints of an index


@pytest.mark.parametrize(("count", "depths"), [(47, 24), (48, 24), (49, 17), (5, 5)])
def test_the_depth_of_about_24_cameras_spaces_the_viewpoints(monkeypatch, count: int, depths: int) -> None:
    asked: list[Any] = []
    spacing: list[float] = []
    values = iter([0.0, *np.arange(1.0, 100)])
    monkeypatch.setattr(viewpoints, "centre_depth", lambda _, camera: asked.append(camera) or next(values))
    monkeypatch.setattr(
        viewpoints, "choose_spread_poses", lambda poses, depth, config: spacing.append(depth) or np.array([2, 0])
    )
    cameras = [
        SimpleNamespace(camera=Camera(SMALL, look_at(np.array([k, 0.0, 0]), np.array([k, 0.0, 1]), np.eye(3)[1])))
        for k in range(count)
    ]
    scene: Any = SimpleNamespace(cameras=cameras, info=SimpleNamespace(cameras_doubtful=False))
    found = viewpoints.index_cameras(scene, None, np.random.default_rng(0))  # type: ignore[arg-type]
    assert [camera.pose.position_in_world[0] for camera in found] == [2, 0]
    assert {camera.intrinsics.width for camera in found} == {384}
    assert len(asked) == depths
    # Of those that see anything: the first one sees nothing.
    assert spacing == [depths / 2]
    monkeypatch.setattr(viewpoints, "centre_depth", lambda *_: 0.0)
    viewpoints.index_cameras(scene, None, np.random.default_rng(0))  # type: ignore[arg-type]
    assert spacing[-1] == 1.0
    placed = Camera(SMALL, CAMERA.pose)
    monkeypatch.setattr(viewpoints, "find_views", lambda *_: SimpleNamespace(cameras=(placed,)))
    scene.info.cameras_doubtful = True
    assert len(viewpoints.index_cameras(scene, None, np.random.default_rng(0))) == 3  # type: ignore[arg-type]
    scene.cameras = []
    (only,) = viewpoints.index_cameras(scene, None, np.random.default_rng(0))  # type: ignore[arg-type]
    assert only.pose is placed.pose


# ------------------------------------------------------------------ what a localization asks and adds


def test_an_image_matcher_needs_a_method_that_matches_images(monkeypatch) -> None:
    methods = {"pairs": SimpleNamespace(MATCHES_IMAGES=True), "features": SimpleNamespace()}
    monkeypatch.setattr(localizing, "ESTIMATORS", SimpleNamespace(load=methods.__getitem__))
    of_images: Any = SimpleNamespace(image_matcher=SimpleNamespace(name="dense"))
    without: Any = SimpleNamespace(image_matcher=None)
    localizing._require_matching("pairs", of_images)
    localizing._require_matching("features", without)
    with pytest.raises(InvalidOptions, match="'dense' has no features of one image, which 'features' needs"):
        localizing._require_matching("features", of_images)


def test_a_pose_that_readings_move_is_one_more_record(monkeypatch) -> None:
    there = moved(HERE, np.array([0, 0, 0, 1.0, 0, 0]))
    told: Any = SimpleNamespace(status=Status.LOCALIZED)
    loaded: Any = SimpleNamespace(scene=SimpleNamespace(info=SimpleNamespace(sha256="0")))
    last = IterationRecord("verify", HERE)
    monkeypatch.setattr(localizing, "contradictions", lambda *_: ("the compass is off",))
    query: Any = replace(QUERY, warnings=("first",), scene_priors=object())
    for pose in (HERE, there):
        monkeypatch.setattr(localizing, "fused", lambda query, before, verdict, pose=pose: (pose, verdict))
        trace = localizing._Trace(localizing.Clock(), None)
        found, _ = localizing._with_readings(query, told, last, trace, loaded, localizing.Request())
        assert found.warnings == ("first", "the compass is off")
        assert [(record.stage, record.pose) for record in trace.records] == (
            [("fuse_readings", there)] if pose is there else []
        )
    none = localizing._with_readings(QUERY, told, last, trace, loaded, localizing.Request())
    assert none == (QUERY, told)


# ------------------------------------------------------------------ features of renders


class OnDevice:
    """Finds features by itself, or on the renderer's device for several pictures at once."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def extract(self, image, limit):
        self.asked.append("one")
        return "features"

    def extract_rendered(self, frames, limit):
        self.asked.append(f"{len(frames)} on the device")
        return ["features"] * len(frames)


@pytest.mark.parametrize(
    ("sizes", "on_device", "asked"),
    [
        ([(4, 5), (4, 5)], True, ["2 on the device"]), ([(4, 5)], True, ["1 on the device"]),
        ([(4, 5), (4, 6)], True, ["one", "one"]), ([(4, 5), (4, 5)], False, ["one", "one"]),
    ],
)  # fmt: skip
def test_renders_of_one_size_that_are_on_the_device_stay_there(sizes, on_device, asked, monkeypatch):
    monkeypatch.setattr(rendered_views, "backprojected", lambda *each: each)
    frames: list[Any] = [
        SimpleNamespace(alpha=np.zeros(size), rgb=np.zeros((*size, 3), np.float32), device_rgb=on_device or None)
        for size in sizes
    ]
    matcher: Any = OnDevice()
    cameras: Any = list("ab"[: len(sizes)])
    found = rendered_views.views_of(frames, cameras, matcher)
    assert matcher.asked == asked
    assert found == [("features", frame, camera) for frame, camera in zip(frames, cameras, strict=True)]
    plain: Any = SimpleNamespace(extract=matcher.extract)
    assert len(rendered_views.views_of(frames, cameras, plain)) == len(sizes)
    assert matcher.asked[-1] == "one"
